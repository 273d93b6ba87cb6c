"""Count of the arithmetic of an observer pass: a process of its own, this module as a script, runs the
kernels as plain Python, one lane wide, on numbers that count what is done with them.

Each integration step costs the same, so with N >= 2 steps a segment operations(N) = operations(2) + (N - 2)
(operations(3) - operations(2)) is exact. What the compiler saves by common subexpressions is not taken off,
index arithmetic is not counted, negation is free.
"""

from __future__ import annotations

import importlib
import json
import math
import pkgutil
import sys
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from report import in_fresh_process


class Tally(NamedTuple):
    """Floating operations of one pass of one robot."""

    add: float = 0.0
    multiply: float = 0.0
    divide: float = 0.0
    root: float = 0.0
    fused: float = 0.0  # additions that take a product with them, as one fused multiply-add

    @property
    def flops(self) -> float:
        return self.add + self.multiply + self.divide + self.root

    @property
    def instructions(self) -> float:
        """Return what remains when every product that is added at once goes into a fused multiply-add."""
        return self.flops - self.fused

    def __add__(self, other: Any) -> Tally:
        return Tally(*(a + b for a, b in zip(self, other, strict=True)))

    def __mul__(self, k: Any) -> Tally:
        return Tally(*(k * a for a in self))


class Counted(float):
    """A number that notes in `now`, by the fields of `Tally`, what is done with it."""

    product = False  # whether it is a product, which an addition would fuse with
    __array_ufunc__ = None  # a numpy number on the left leaves the operation to this class
    now = [0.0] * 5

    def __pow__(self, power: int) -> Counted:
        return _noted(1, float(self) ** power, power - 1)

    def __neg__(self) -> Counted:
        made = Counted(-float(self))
        made.product = self.product
        return made

    def __abs__(self) -> Counted:
        return Counted(abs(float(self)))


def _noted(operation: int, value: float, times: int = 1) -> Counted:
    Counted.now[operation] += times
    made = Counted(value)
    made.product = operation == 1
    return made


def _operator(name: str, operation: int) -> Callable[[Counted, Any], Counted]:
    plain = getattr(float, name)

    def run(self: Counted, other: Any) -> Counted:
        if operation == 0:
            Counted.now[4] += self.product or getattr(other, "product", False)
        return _noted(operation, plain(self, float(other)))

    return run


for _operation, _names in enumerate(("add radd sub rsub", "mul rmul", "truediv rtruediv")):
    for _name in _names.split():
        setattr(Counted, f"__{_name}__", _operator(f"__{_name}__", _operation))


class _Math:
    """Stands in for `math` in the kernels."""

    @staticmethod
    def sqrt(x: Any) -> Counted:
        return _noted(3, math.sqrt(float(x)))

    def __getattr__(self, name: str) -> Any:
        return getattr(math, name)


def count(wanted: dict[str, int], forces: bool) -> dict[str, Tally]:
    """Robot key -> operations of a pass of that many points per segment; `forces`: the tip force moves."""
    two, three = counted(list(wanted), forces, (2, 3))
    return {key: two[key] * (3 - points) + three[key] * (points - 2) for key, points in wanted.items()}


def counted(robots: Sequence[str], forces: bool, points: Sequence[int]) -> list[dict[str, Tally]]:
    """See `count`, without the formula: for each number of points, the operations of every robot."""
    found = in_fresh_process(__file__, [list(robots), forces, list(points)], NUMBA_DISABLE_JIT="1")
    return [{key: Tally(*tally) for key, tally in one.items()} for one in found]


def _counted_pass(case: Any, points: int, forces: bool) -> list[float]:
    """Operations of the third step: by then a moving force has its columns."""
    from fastrod import Simulator

    sim = Simulator(case.robot, 1, points_per_segment=points, outputs="tip", threads=1)
    for step in range(3):
        Counted.now[:] = [0.0] * 5
        sim.step(**case.inputs(case.at(step, forces)))
    return list(Counted.now)


def _instrument() -> None:
    """Make the kernels one lane wide and countable."""
    from fastrod.kernels import jit

    jit.LANES = 1
    from fastrod.kernels import rod
    from fastrod.solver import boundary
    from fastrod.types import Memory, RodShape

    rods = pkgutil.walk_packages(rod.__path__, rod.__name__ + ".")
    for name in ("fastrod.kernels.batch", "fastrod.kernels.vec", *(info.name for info in rods)):
        held = vars(importlib.import_module(name))
        held.update({name: _Math() for name, value in held.items() if value is math})
        held["float"] = lambda value: value if isinstance(value, Counted) else float(value)
    body = vars(boundary)["pass_robots"]

    def counting(*arguments: Any) -> None:
        counted: list[Any] = [a if isinstance(a, RodShape) else _countable(a) for a in arguments]
        body(*counted)
        (memory,) = (i for i, argument in enumerate(arguments) if isinstance(argument, Memory))
        # what the next step begins from
        for kept, new in zip(arguments[memory], counted[memory], strict=True):
            kept[...] = new.astype(float)

    vars(boundary)["pass_robots"] = counting


def _countable(argument: Any) -> Any:
    """Arrays of floats, also inside named tuples, as arrays of counted numbers."""
    if isinstance(argument, tuple) and hasattr(argument, "_fields"):
        return type(argument)(*(_countable(a) for a in argument))
    if isinstance(argument, np.ndarray) and argument.dtype.kind == "f":
        made = np.empty(argument.shape, object)
        made.reshape(-1)[:] = [Counted(value) for value in argument.ravel().tolist()]
        return made
    return argument


if __name__ == "__main__":
    robots, forces, points = json.load(sys.stdin)
    _instrument()
    import cases

    chosen = [case for case in cases.cases(1) if case.key in robots]
    print(json.dumps([{case.key: _counted_pass(case, n, forces) for case in chosen} for n in points]))
