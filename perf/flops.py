"""How much arithmetic an observer pass is.

The count comes from the kernels themselves: a child process runs them as plain Python, one lane wide, on
numbers that count what is done with them. Each integration step costs the same, so with N steps a segment (N
>= 2)

    operations(N) = operations(2) + (N - 2) (operations(3) - operations(2))

is exact; tendons and columns (unknowns, and three for a moving tip force) enter through the robot whose pass
is counted. What the compiler saves by common subexpressions is not taken off, index arithmetic is not
counted, negation is free.

Run as a script this module is that child: it reads what to count from stdin and prints the counts.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from types import ModuleType
from typing import Any

import numpy as np


@dataclass
class Tally:
    """Floating operations of one pass of one robot."""

    add: float = 0.0
    multiply: float = 0.0
    divide: float = 0.0
    root: float = 0.0
    fused: float = 0.0
    """Additions that take a product with them, as one fused multiply-add."""

    @property
    def flops(self) -> float:
        return self.add + self.multiply + self.divide + self.root

    @property
    def instructions(self) -> float:
        """What remains when every product that is added at once goes into a fused multiply-add."""
        return self.flops - self.fused

    def __add__(self, other: Tally) -> Tally:
        return Tally(*(a + b for a, b in zip(asdict(self).values(), asdict(other).values(), strict=True)))

    def __mul__(self, k: float) -> Tally:
        return Tally(*(k * a for a in asdict(self).values()))


class Counted:
    """A number that notes in `now` what is done with it."""

    __slots__ = ("product", "value")
    __array_ufunc__ = None  # a numpy number on the left leaves the operation to this class
    now = Tally()

    def __init__(self, value: float, product: bool = False) -> None:
        self.value = float(value)
        self.product = product

    def __float__(self) -> float:
        return self.value

    def _sum(self, other: Any, value: float) -> Counted:
        Counted.now.add += 1
        if self.product or (isinstance(other, Counted) and other.product):
            Counted.now.fused += 1
        return Counted(value)

    def __add__(self, other: Any) -> Counted:
        return self._sum(other, self.value + float(other))

    def __sub__(self, other: Any) -> Counted:
        return self._sum(other, self.value - float(other))

    def __rsub__(self, other: Any) -> Counted:
        return self._sum(other, float(other) - self.value)

    def __mul__(self, other: Any) -> Counted:
        Counted.now.multiply += 1
        return Counted(self.value * float(other), product=True)

    def __truediv__(self, other: Any) -> Counted:
        Counted.now.divide += 1
        return Counted(self.value / float(other))

    def __rtruediv__(self, other: Any) -> Counted:
        Counted.now.divide += 1
        return Counted(float(other) / self.value)

    def __pow__(self, power: int) -> Counted:
        Counted.now.multiply += power - 1
        return Counted(self.value**power, product=True)

    def __neg__(self) -> Counted:
        return Counted(-self.value, self.product)

    def __abs__(self) -> Counted:
        return Counted(abs(self.value))

    def __lt__(self, other: Any) -> bool:
        return self.value < float(other)

    def __le__(self, other: Any) -> bool:
        return self.value <= float(other)

    def __gt__(self, other: Any) -> bool:
        return self.value > float(other)

    def __ge__(self, other: Any) -> bool:
        return self.value >= float(other)

    __radd__ = __add__
    __rmul__ = __mul__


class _Math:
    """Stands in for `math` in the kernels."""

    @staticmethod
    def sqrt(x: Any) -> Counted:
        Counted.now.root += 1
        return Counted(math.sqrt(float(x)))

    def __getattr__(self, name: str) -> Any:
        return getattr(math, name)


def count(wanted: dict[str, int], forces: bool) -> dict[str, dict[str, Tally]]:
    """Robot key -> {kernel file: operations} of one pass with that many points per segment; `forces`: the tip
    force moves."""
    two, three = counted(list(wanted), forces, (2, 3))
    return {
        key: {name: two[key][name] * (3 - points) + three[key][name] * (points - 2) for name in two[key]}
        for key, points in wanted.items()
    }


def counted(robots: Sequence[str], forces: bool, points: Sequence[int]) -> list[dict[str, dict[str, Tally]]]:
    """As `count`, without the formula: for each number of points, the operations of every robot."""
    words = json.dumps({"robots": robots, "forces": forces, "points": points})
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(
        [sys.executable, __file__],
        input=words,
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env=environment,
    )
    found: list[dict[str, dict[str, dict[str, float]]]] = json.loads(done.stdout)
    return [
        {key: {name: Tally(**tally) for name, tally in parts.items()} for key, parts in one.items()}
        for one in found
    ]


def _child() -> None:
    asked = json.loads(sys.stdin.read())
    sections = _instrument()
    import cases

    chosen = [case for case in cases.cases(1) if case.key in asked["robots"]]
    found = [
        {case.key: _counted_pass(case, points, asked["forces"], sections) for case in chosen}
        for points in asked["points"]
    ]
    print(json.dumps(found))


def _counted_pass(
    case: Any, points: int, forces: bool, sections: dict[str, Tally]
) -> dict[str, dict[str, float]]:
    """Operations by kernel file of the third step: by then a moving force has its columns."""
    from fastrod import Simulator

    sim = Simulator(case.robot, 1, points_per_segment=points, outputs="tip", threads=1)
    for step in range(3):
        for name in sections:
            sections[name] = Tally()
        sim.step(**case.words(case.at(step, forces)))
    return {name: asdict(tally) for name, tally in sections.items() if tally.flops}


def _instrument() -> dict[str, Tally]:
    """Make the kernels one lane wide and countable, and sort the counts by the file of the kernel at work."""
    import importlib
    import pkgutil

    from fastrod.kernels import jit

    jit.LANES = 1
    import fastrod.kernels as package
    from fastrod.solver import boundary as passes
    from fastrod.types import Memory, RodShape

    modules = [
        importlib.import_module(info.name)
        for info in pkgutil.walk_packages(package.__path__, "fastrod.kernels.")
        if not info.ispkg
    ]
    sections = {_short(module): Tally() for module in modules}
    helpers = (
        "jit",
        "vec",
        "rod",
        "batch",
        "lanes",
        "workspace",
    )  # their arithmetic belongs to the kernel that calls
    wrapped: dict[int, Callable[..., Any]] = {}
    for module in modules:
        if _short(module) in helpers:
            continue
        for value in vars(module).values():
            if (
                callable(value)
                and getattr(value, "__module__", "") == module.__name__
                and not isinstance(value, type)
            ):
                wrapped[id(value)] = _attributed(value, _short(module), sections)
    for module in modules:
        names = vars(module)
        for name, value in list(names.items()):
            if id(value) in wrapped:
                names[name] = wrapped[id(value)]
            elif value is math:
                names[name] = _Math()
        names["float"] = _kept
    body = vars(passes)["pass_serial"]

    def counting(*arguments: Any) -> None:
        counted: list[Any] = [
            argument if isinstance(argument, RodShape) else _countable(argument) for argument in arguments
        ]
        body(*counted)
        (memory,) = (i for i, argument in enumerate(arguments) if isinstance(argument, Memory))
        # what the next step begins from
        for kept, new in zip(arguments[memory], counted[memory], strict=True):
            kept[...] = new.astype(float)

    vars(passes)["pass_serial"] = counting
    return sections


def _short(module: ModuleType) -> str:
    return module.__name__.rpartition(".")[2]


def _kept(value: Any) -> Any:
    return value if isinstance(value, Counted) else float(value)


def _attributed(function: Callable[..., Any], section: str, sections: dict[str, Tally]) -> Callable[..., Any]:
    def run(*arguments: Any) -> Any:
        before = Counted.now
        Counted.now = sections[section]
        try:
            return function(*arguments)
        finally:
            Counted.now = before

    return run


def _countable(argument: Any) -> Any:
    """Arrays of floats, also inside named tuples, as arrays of counted numbers."""
    if isinstance(argument, tuple) and hasattr(argument, "_fields"):
        return type(argument)(*(_countable(a) for a in argument))
    if isinstance(argument, np.ndarray) and argument.dtype.kind == "f":
        made = np.empty(argument.shape, object)
        flat = made.reshape(-1)
        for i, value in enumerate(argument.ravel().tolist()):
            flat[i] = Counted(value)
        return made
    return argument


if __name__ == "__main__":
    _child()
