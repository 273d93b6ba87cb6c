"""Numbers of a robot by name: "segment.1.line_density", "segment.1.lump.2.mass", "tendon.3.compliance"."""

from __future__ import annotations

import dataclasses
from typing import Any

from fastrod.errors import InputError, nearest
from fastrod.model.robot import Robot

_LISTS = {"segment": "segments", "lump": "lumps"}


def number(robot: Robot, name: str) -> float:
    """The value. Raises `InputError` where this is no number of the robot."""
    at: Any = robot
    for step, _ in _steps(robot, name):
        at = at[step] if isinstance(step, int) else getattr(at, step)
    return float(at)


def with_number(robot: Robot, name: str, value: float) -> Robot:
    """The robot with another value there. Raises `InputError` as `number`, `RobotError` where the value
    cannot be."""
    return _replaced(robot, [step for step, _ in _steps(robot, name)], value)  # type: ignore[no-any-return]


def _replaced(at: Any, steps: list[Any], value: float) -> Any:
    if not steps:
        return value
    first, *rest = steps
    if isinstance(first, int):
        return (*at[:first], _replaced(at[first], rest, value), *at[first + 1 :])
    return dataclasses.replace(at, **{first: _replaced(getattr(at, first), rest, value)})


def _steps(robot: Robot, name: str) -> list[tuple[Any, Any]]:
    """Attributes and indices that lead to the number, each with what stands there."""
    words, found = name.split("."), []
    at: Any = robot
    if words[0] == "tendon" and len(words) > 1:
        k = _index(words[1], robot.n_tendons, "tendon", name)
        for s, segment in enumerate(robot.segments):
            if k < len(segment.tendons):
                words = ["segment", str(s + 1), "tendons", str(k + 1), *words[2:]]
                break
            k -= len(segment.tendons)
    for word in words:
        if isinstance(at, tuple):
            step: Any = _index(word, len(at), "entry", name)
            at = at[step]
        else:
            step = _LISTS.get(word, word)
            known = [field.name for field in dataclasses.fields(at)] if dataclasses.is_dataclass(at) else []
            if step not in known:
                raise InputError(f"the robot has no number {name!r}: {word!r}; {nearest(word, known)}")
            at = getattr(at, step)
        found.append((step, at))
    if isinstance(at, bool) or not isinstance(at, (int, float)):
        more = f"; name one of its entries, {name}.1" if isinstance(at, tuple) and at else ""
        raise InputError(f"{name!r} is no number of the robot{more}.")
    return found


def _index(word: str, count: int, what: str, name: str) -> int:
    if not word.isdigit() or not 1 <= int(word) <= count:
        raise InputError(f"{name!r}: {word!r} is no {what} of {count}; they are counted from 1.")
    return int(word) - 1
