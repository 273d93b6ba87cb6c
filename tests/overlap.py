"""Kernels run as Python, and their arrays watched: prints in which of them a place is written that two
arguments reach, which `noalias` (`kernels.jit.kernel`) rules out. To be run with NUMBA_DISABLE_JIT=1."""

import inspect
from collections import Counter, defaultdict
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import trimesh
from numpy.lib.array_utils import byte_bounds

from fastrod.kernels import jit

MOST = 4  # calls of a function that are watched
ran, overlaps = Counter[str](), Counter[str]()


class Watched(np.ndarray):
    """A view that notes, for every call that it was handed on to, which of its numbers are read and
    written."""

    def __array_finalize__(self, of: Any) -> None:
        self.marks = getattr(of, "marks", ())

    def note(self, at: Any, written: bool) -> None:
        each = zip(at if isinstance(at, tuple) else (at,), self.shape, self.strides, strict=True)
        place = self.ctypes.data + sum(int(i) % n * step for i, n, step in each)
        for reached, argument in self.marks:
            reached[place][argument] |= written

    def __getitem__(self, at: Any) -> Any:
        found = super().__getitem__(at)
        if self.marks and not isinstance(found, np.ndarray):
            self.note(at, False)
        return found

    def __setitem__(self, at: Any, value: Any) -> None:
        if self.marks:
            self.note(at, True)
        super().__setitem__(at, value)


def watched(given: Any, reached: Any, arrays: list[Watched]) -> Any:
    """An argument whose arrays, all `arrays`, note what one call more reaches by each."""
    if isinstance(given, tuple):
        made = [watched(one, reached, arrays) for one in given]
        return given._make(made) if hasattr(given, "_make") else tuple(made)
    if isinstance(given, np.ndarray):
        arrays.append(given.view(Watched))
        arrays[-1].marks = (*getattr(given, "marks", ()), (reached, len(arrays)))
        return arrays[-1]
    return given


def watch(function: Any) -> Any:
    """In place of `kernels.jit.kernel`."""
    name = f"{function.__module__}.{function.__name__}{inspect.signature(function)}"

    def call(*given: Any) -> Any:
        reached: Any = defaultdict(lambda: defaultdict(bool))
        arrays = list[Watched]()
        views = watched(given, reached, arrays)
        bounds = sorted(byte_bounds(a) for a in arrays if a.size)
        if all(a[1] <= b[0] for a, b in pairwise(bounds)) or ran[name] >= MOST:
            ran[name] += 0
            return function(*given)
        ran[name] += 1
        answer = function(*views)
        overlaps[name] += any(len(by) > 1 and any(by.values()) for by in reached.values())
        return answer

    return call


def exercise() -> None:
    """Rods at rest, in motion, on a body that gives way, and pressed on a mesh and on themselves."""
    import fastrod
    from fastrod.contact import ContactScene, mesh

    robot = fastrod.load_robot("tdcr_a")
    robot = replace(robot, segments=tuple(replace(one, line_density=0.1) for one in robot.segments))
    lengths = robot.rest_tendon_length - 1e-3 * np.eye(len(robot.rest_tendon_length))[0]
    force = (0.0, 0.01, 0.01)
    loads: Any = {"tip_force": force, "line_force": force, "point_force": [(0.03, force)]}
    modes = fastrod.Modes(2, 1, strain=1, pieces=2)
    moving, rest = fastrod.Modal(modes=modes, dynamics=True), fastrod.Modal(modes=modes)
    for solver in (fastrod.Observer(), rest, moving):
        sim = fastrod.Simulator(robot, 1, 1e-3, 4, solver=solver)
        sim.step(lengths)
        sim.step(lengths, follower_tip_force=force, **loads)
        sim.jacobian()
    sim.step(lengths, inverse_inertia=np.eye(6))
    ball = mesh(trimesh.creation.icosphere(1, 0.02), name="ball", position=(0.022, 0.0, 0.06))
    scene = ContactScene(obstacles=[ball], self_contact=True, rod_radius=0.003)
    for solver in (rest, moving):
        fastrod.Simulator(robot, 1, 1e-3, 6, solver=solver, contact=scene).step(lengths)


def shift(to: Any, by: Any) -> None:
    """What it writes, it reads by its other argument: found, or nothing is watched."""
    for i in range(3):
        to[i] = by[i]


if __name__ == "__main__":
    jit.kernel = watch
    exercise()
    numbers = np.zeros(4)
    watch(shift)(numbers[1:], numbers[:-1])
    print(len(ran), [name for name, n in overlaps.items() if n])
