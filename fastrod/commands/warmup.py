"""`fastrod warmup`: the large kernels compiled ahead of time, so that no first step waits for them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from fastrod.contact import ContactScene, cylinder
from fastrod.errors import UnknownNameError, nearest
from fastrod.loading import load_robot
from fastrod.simulator import Simulator

Progress = Callable[[str, int, int], None]
_MANY = 128
"""Robots of a batch that is spread over threads."""
_PULL = np.array([-1.0, 0.0, 1.0, 0.0])
_WITH_MEMORY = (
    {"name": "backlash", "half_width": 1e-4},
    {"name": "friction", "half_width": 1e-4},
    {"name": "creep", "share": 0.1, "time_constant": 1.0},
    {"name": "latency", "delay": 0.01},
    {"name": "second_order_lag", "period": 0.1},
    {"name": "plastic_set", "share": 0.1},
)
"""One effect for each operator (`kernels.operators`)."""


def _rod() -> Iterator[None]:
    """Rods at rest, one and many, and what lies between their nodes; effects that remember."""
    robot = load_robot("prototype")
    for n in (1, _MANY):
        sim = Simulator(robot, n, points_per_segment=2)
        for pull in (0.0, 0.001):
            sim.settle(robot.rest_tendon_length + pull * _PULL)
        sim.step(robot.rest_tendon_length, tip_force=(0.0, 0.01, 0.0))
        yield
    sim.shape([0.5 * robot.length])
    sim = Simulator(replace(robot, effects=_WITH_MEMORY), points_per_segment=2)
    sim.step(robot.rest_tendon_length + 0.001 * _PULL)
    yield


def _contact() -> Iterator[None]:
    """A rod on a bar, alone and in a batch, at rest and in motion."""
    robot = load_robot("prototype")
    bar = cylinder(0.01, 0.2, name="bar", position=(0.018, 0, 0.05), quaternion=(0.5**0.5, 0.5**0.5, 0, 0))
    scene = ContactScene(obstacles=[bar], rod_radius=0.003)
    for n in (1, _MANY):
        sim = Simulator(robot, n, points_per_segment=5, contact=scene)
        for pull in np.linspace(0.0, 0.006, 20):
            sim.step(robot.rest_tendon_length + pull * _PULL)
        yield
    heavy = replace(robot, segments=tuple(replace(s, line_density=0.05) for s in robot.segments))
    sim = Simulator(heavy, points_per_segment=5, contact=scene, dynamics=True)
    sim.settle(robot.rest_tendon_length)
    for pull in np.linspace(0.0, 0.006, 20):
        sim.step(robot.rest_tendon_length + pull * _PULL)
    yield


def _modes() -> Iterator[None]:
    """A rod of modes, and its derivatives."""
    robot = load_robot("prototype")
    for n in (1, _MANY):  # few lanes, and many
        sim = Simulator(robot, n, points_per_segment=2, solver="modal")
        sim.settle(robot.rest_tendon_length)
        yield
        sim.jacobian()
        yield


GROUPS: Mapping[str, tuple[Callable[[], Iterator[None]], int]] = {
    "rod": (_rod, 3),
    "contact": (_contact, 3),
    "modes": (_modes, 4),
}
"""Kernels of each group, and its number of steps; contact also compiles what it needs of the others."""


def warm_up(groups: Sequence[str] = (), progress: Progress | None = None) -> None:
    """Compile the kernels of these `groups`, of all where none is named; `progress` (what, done, total).
    Raises `UnknownNameError`."""
    if unknown := [name for name in groups if name not in GROUPS]:
        raise UnknownNameError(f"no kernels {unknown[0]!r} to warm up; {nearest(unknown[0], GROUPS)}")
    chosen = [name for name in GROUPS if name in (groups or GROUPS)]
    total, done = sum(GROUPS[name][1] for name in chosen), 0
    for name in chosen:
        for _ in GROUPS[name][0]():
            done += 1
            if progress is not None:
                progress(name, done, total)
