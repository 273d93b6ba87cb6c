"""Robots that differ from episode to episode, in physical parameters and in effects: so that a policy
survives a real one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from fastrod.checks import Bound, check
from fastrod.effects.base import canonical_name, get_effect, read_values
from fastrod.effects.pipeline import named_effects
from fastrod.errors import InputError, nearest
from fastrod.loading import load_robot
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Floats

_FACTORS = ("bending_stiffness", "torsional_stiffness", "line_density", "compliance", "offset")
_SPREAD = 0.2
Range = tuple[float, float]


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """Distributions drawn, evenly from their ranges, at the start of every episode.

    >>> stiffness, play = {"bending_stiffness": (0.8, 1.2)}, {"backlash.half_width": (0.0, 3e-4)}
    >>> Randomisation(parameters=stiffness, effects=play).n_draws
    2
    """

    robot: Robot | None = None
    """Stands for the task's robot: an identified one with its effects. Its segments and tendons are those of
    the task's."""
    spread: Annotated[float, Bound(least=0.0, below=1.0)] = 0.0
    """Every number of the robot's own effects is drawn from (1 - spread, 1 + spread) of its value, within
    what it can be."""
    parameters: Mapping[str, Range] = field(default_factory=dict)
    """Factors on the robot's own numbers, all segments alike: bending_stiffness, torsional_stiffness,
    line_density, compliance (of the tendons) and, where it has no effects, offset."""
    effects: Mapping[str, Range] = field(default_factory=dict)
    """`backlash.half_width`: the range of an effect's parameter, in its unit. What a robot file says of it is
    replaced."""

    absent: Annotated[float, Bound(least=0.0, below=1.0)] = 0.0
    """Chance that an effect of `effects` is not there, its parameter neutral, each on its own: so that a
    policy meets plain robots too."""

    def __post_init__(self) -> None:
        check(self)
        for name in self.parameters:
            if name not in _FACTORS:
                raise InputError(f"no parameter {name!r} to randomise; {nearest(name, _FACTORS)}")
        for name in self.effects:
            effect, _, parameter = name.partition(".")
            known = [p.name for p in get_effect(canonical_name(effect)).parameters]
            if parameter not in known:
                raise InputError(f"{name!r} names no parameter of an effect; {nearest(parameter, known)}")
        for name, pair in [*self.parameters.items(), *self.effects.items()]:
            numbers = isinstance(pair, (tuple, list)) and all(
                isinstance(v, (int, float, np.number)) and math.isfinite(v) for v in pair
            )
            if not numbers or len(pair) != 2 or pair[0] > pair[1]:
                raise InputError(f"the range of {name!r} is {pair!r}; give (least, largest), finite.")
            if name in self.parameters and pair[0] <= 0.0:
                raise InputError(f"the range of {name!r} is {pair!r}; a factor must be positive.")

    @classmethod
    def of(cls, given: object) -> Randomisation | None:
        """Make one from any value that an option may hold: None, a robot or its file (its effects within
        20 %), a mapping with these fields, or ranges alone, in which a dot marks an effect. Raises
        `InputError`, and what `load_robot` raises."""
        if given is None or isinstance(given, Randomisation):
            return given
        if isinstance(given, Robot):
            return cls(robot=given, spread=_SPREAD)
        if isinstance(given, (str, Path)):
            return cls(robot=load_robot(given), spread=_SPREAD)
        if not isinstance(given, Mapping):
            raise InputError(
                f"randomise is {given!r}; give a Randomisation, a robot file, or a mapping of "
                "names to ranges."
            )
        own = {
            name: given[name]
            for name in ("robot", "spread", "parameters", "effects", "absent")
            if name in given
        }
        if isinstance(own.get("robot"), (str, Path)):
            own["robot"] = load_robot(own["robot"])
        ranges = {
            str(name): tuple(pair) if isinstance(pair, (list, np.ndarray)) else pair
            for name, pair in given.items()
            if name not in own
        }
        parameters = {
            **own.pop("parameters", {}),
            **{name: pair for name, pair in ranges.items() if "." not in name},
        }
        effects = {**own.pop("effects", {}), **{name: pair for name, pair in ranges.items() if "." in name}}
        return cls(parameters=parameters, effects=effects, **own)

    @property
    def n_draws(self) -> int:
        """Numbers from 0 to 1 that one robot takes."""
        spread = len(self._spread_over(self.robot)) if self.spread and self.robot is not None else 0
        return len(self.parameters) + len(self.effects) + spread

    def base(self, robot: Robot) -> Robot:
        """The robot of a task, with every effect that will be drawn at its neutral value. Raises `InputError`
        where the robot given here has other segments or tendons, `EffectError` for a range that goes beyond
        what an effect's parameter can be."""
        own = robot
        if self.robot is not None:
            if (self.robot.n_segments, self.robot.n_tendons) != (robot.n_segments, robot.n_tendons):
                raise InputError(
                    f"robot {self.robot.name!r} has {self.robot.n_segments} segments and "
                    f"{self.robot.n_tendons} tendons; "
                    f"this task's has {robot.n_segments} and {robot.n_tendons}."
                )
            own = replace(
                self.robot, base_position=robot.base_position, base_quaternion=robot.base_quaternion
            )
        if not self.effects:
            return own
        tables = named_effects(own)
        for name, ends in self.effects.items():
            effect, _, parameter = name.partition(".")
            tables.setdefault(canonical_name(effect), {})
            for value in ends:  # now, and not in the episode that draws it
                read_values(
                    canonical_name(effect),
                    {parameter: float(value)},
                    route(own),
                    f"randomise, robot {own.name!r}",
                )
        return replace(own, effects=tuple({"name": name, **table} for name, table in tables.items()))

    def draw(self, base: Robot, draws: Floats) -> list[Robot]:
        """A robot for each row of `draws` (k, n_draws), evenly from 0 to 1."""
        return [self._one(base, row) for row in draws]

    def _one(self, base: Robot, row: Floats) -> Robot:
        values = [
            low + u * (high - low)
            for u, (low, high) in zip(row, [*self.parameters.values(), *self.effects.values()], strict=False)
        ]
        factor = dict(zip(self.parameters, values, strict=False))
        given = dict(zip(self.effects, values[len(self.parameters) :], strict=True))
        for (name, (low, high)), u in zip(self.effects.items(), row[len(self.parameters) :], strict=False):
            left = (u - self.absent) / (1.0 - self.absent)
            given[name] = low + left * (high - low) if left >= 0.0 else _neutral(name)
        rest = row[len(values) :].tolist()
        tables = {name: dict(table) for name, table in named_effects(base).items()}
        for place, u in zip(self._spread_over(base) if self.spread else [], rest, strict=False):
            low, high = next(
                p.on(route(base)).bounds for p in get_effect(place[0]).parameters if p.name == place[1]
            )
            times = 1.0 + self.spread * (2.0 * u - 1.0)
            tables[place[0]][place[1]] = np.clip(
                np.multiply(tables[place[0]][place[1]], times), low, high
            ).tolist()
        for name, value in given.items():
            effect, _, parameter = name.partition(".")
            tables[canonical_name(effect)][parameter] = value
        effects = tuple({"name": name, **table} for name, table in tables.items())
        segments = tuple(_scaled(segment, factor) for segment in base.segments) if factor else base.segments
        return replace(base, segments=segments, effects=effects)

    @staticmethod
    def _spread_over(robot: Robot) -> Sequence[tuple[str, str]]:
        """Effect and key of every number, or list of numbers, of a robot's effects."""
        tables = named_effects(robot).items()
        return [
            (name, key)
            for name, table in tables
            for key, value in table.items()
            if isinstance(value, (int, float, list, tuple))
        ]


def _neutral(name: str) -> float:
    """The value of `backlash.half_width` at which there is none."""
    effect, _, parameter = name.partition(".")
    return float(
        next(p.neutral for p in get_effect(canonical_name(effect)).parameters if p.name == parameter)
    )


def _scaled(segment: Any, factor: Mapping[str, float]) -> Any:
    """A segment with factors on its numbers."""
    scaled_tendons = tuple(
        replace(
            tendon,
            compliance=tendon.compliance * factor.get("compliance", 1.0),
            offset=_times(tendon.offset, factor.get("offset", 1.0)),
        )
        for tendon in segment.tendons
    )
    bend = factor.get("bending_stiffness", 1.0)
    return replace(
        segment,
        bending_stiffness=(bend * segment.bending_stiffness[0], bend * segment.bending_stiffness[1]),
        torsional_stiffness=factor.get("torsional_stiffness", 1.0) * segment.torsional_stiffness,
        line_density=factor.get("line_density", 1.0) * segment.line_density,
        tendons=scaled_tendons,
    )


def _times(offset: float | tuple[float, ...], factor: float) -> float | tuple[float, ...]:
    return tuple(factor * value for value in offset) if isinstance(offset, tuple) else factor * offset
