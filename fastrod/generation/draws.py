"""Random parameters of a data set's robots: effects of the size that is seen on real robots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from fastrod.effects.base import canonical_name, effect_names, get_effect
from fastrod.effects.pipeline import named_effects
from fastrod.errors import InputError, shown
from fastrod.model.robot import Robot
from fastrod.model.robotfile import loads
from fastrod.model.routing import route
from fastrod.types import Floats

_SPREAD = (0.5, 1.5)
"""Fraction of the typical size."""


def robot_of(text: object) -> Robot:
    """The robot of a robot file's text. Raises `InputError` for what is no text, and what `loads` raises."""
    if not isinstance(text, str):
        raise InputError(
            f"robot is {shown(text, 60)}; give the text of a robot file, such as "
            "fastrod.model.robotfile.dumps(robot)."
        )
    return _loaded(text)


@cache
def _loaded(text: str) -> Robot:
    return loads(text, "the plan's robot")


def named(effects: Sequence[str]) -> tuple[str, ...]:
    """Their canonical names, in the order in which they act. Raises `InputError` for what are no names,
    `UnknownNameError` with the nearest."""
    if not isinstance(effects, (tuple, list)) or not all(isinstance(effect, str) for effect in effects):
        raise InputError(f"effects are {shown(effects)}; give a tuple of names, such as ('backlash',).")
    given = {canonical_name(effect) for effect in effects}
    return tuple(name for name in effect_names() if name in given)


def with_effects(
    robot: Robot, effects: Sequence[str], rng: np.random.Generator
) -> tuple[Robot, dict[str, float]]:
    """The robot with these effects, and their values by `effect.parameter` (with _1, _2 ... where there is
    one per segment or drive; of a `shared` parameter there is one for all).

    Every number is drawn evenly from half to one and a half of its typical size, with either sign where both
    can be, within its bounds.
    """
    wiring = route(robot)
    tables: dict[str, dict[str, Any]] = {name: dict(table) for name, table in named_effects(robot).items()}
    drawn: dict[str, float] = {}
    for effect in effects:
        table: dict[str, Any] = {}
        for parameter in (p.on(wiring) for p in get_effect(effect).parameters):
            # drives that are alike by default are drawn alike
            count = 1 if parameter.shared else wiring.count(parameter.per)
            size = parameter.scale * rng.uniform(*_SPREAD, count)
            if parameter.bounds[0] < 0.0 and not parameter.shape:
                size *= rng.choice((-1.0, 1.0), count)
            centre = 0.0 if parameter.shape else parameter.neutral
            values = np.clip(centre + size, *parameter.bounds)
            table[parameter.name] = float(values[0]) if count == 1 else values.tolist()
            names = [parameter.name] if count == 1 else [f"{parameter.name}_{k}" for k in range(1, count + 1)]
            drawn |= {f"{effect}.{name}": float(value) for name, value in zip(names, values, strict=True)}
        tables[effect] = table
    return replace(robot, effects=tuple({"name": name, **table} for name, table in tables.items())), drawn


def in_ball(rng: np.random.Generator, n: int, dimension: int) -> Floats:
    """(n, dimension) even in the unit ball."""
    v = rng.normal(size=(n, dimension + 2))
    return np.asarray((v / np.linalg.norm(v, axis=1, keepdims=True))[:, :dimension])
