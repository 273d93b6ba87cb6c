"""The unknowns: parameters of the robot and of effects, each with a prior; and the model that a vector of
them makes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from fastrod.effects.base import columns, effect_names, get_effect, read_values
from fastrod.effects.pipeline import named_effects
from fastrod.model.robot import Robot, Segment
from fastrod.model.routing import Routing, route
from fastrod.types import Floats

SEGMENT_UNITS = {
    "length": "m",
    "bending_stiffness": "N m^2",
    "torsional_stiffness": "N m^2",
    "line_density": "kg/m",
    "damping_time": "s",
    "axial_stiffness": "N",
    "shear_stiffness": "N",
}
"""Parameters of a segment that can be fitted, and their units."""
MATERIAL = ("youngs_modulus", "density", "taper")
"""Those of all segments together, `material.youngs_modulus` and so on: a factor on all stiffness, one on all
mass, and the fraction by which the radius that makes both is larger at the base and smaller at the tip."""
TENDON_UNITS = {
    "offset": "m",
    "angle": "rad",
    "compliance": "m/N",
    "pretension": "N",
    "gain": "",
    "zero": "m",
}
"""Those of a tendon."""
ADDED = ("angle", "gain", "zero")
"""A shared one of these is the same number for all; of the others, the same factor."""
_KEPT = 64  # robots of a model
_WIDE = 5.0  # typical sizes: width of the prior of an effect's size


@dataclass(frozen=True)
class Unknown:
    """One number to be fitted."""

    name: str
    """`segment.1.length`, `tendon.*.gain`, or `backlash.half_width`."""
    unit: str
    start: float
    """Start of a fit; of the robot's own parameters, the nominal value and the mean of the prior."""
    mean: float
    sd: float
    """Prior, in the unit; of `log` ones, of the logarithm."""
    bounds: tuple[float, float]
    scale: float
    """A typical size, for differences."""
    place: tuple[str, ...]
    """("robot", field, numbers...) or ("effect", name, columns...). The field of a lump is "mass", and its
    number "segment.lump"."""
    log: bool = False
    """Fitted as a logarithm."""
    shape: bool = False
    """Shapes an effect, and has no size of its own."""
    session: int = 0
    """Number of the session that it is of alone; 0: of the robot, and of the first session."""

    def inside(self, theta: float) -> float:
        """The value of a fitted number; a bound itself where only rounding leads beyond it."""
        value = math.exp(theta) if self.log else theta
        return next((edge for edge in self.bounds if math.isclose(value, edge, rel_tol=1e-12)), value)

    def outside(self, value: float) -> float:
        """The fitted number of a value."""
        return math.log(value) if self.log else value

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds of the fitted number."""
        return (self.outside(self.bounds[0]), self.outside(self.bounds[1])) if self.log else self.bounds


@dataclass(frozen=True, eq=False)
class Model:
    """A robot, the effects that act on it, and what of both is unknown."""

    robot: Robot
    """Nominal; its own effects are known ones."""
    wiring: Routing
    effects: tuple[str, ...]
    """Names, in the order in which they act."""
    unknowns: tuple[Unknown, ...]
    sessions: tuple[str, ...] = ("",)
    """Labels of the sessions: what is of one of them alone holds there in place of what is of the robot."""

    @cached_property
    def _given(self) -> dict[str, Floats]:
        """Effect name -> (n_columns,) values that the robot has, or neutral."""
        known = named_effects(self.robot)
        return {name: read_values(name, known.get(name, {}), self.wiring, "robot") for name in self.effects}

    @cached_property
    def _robots(self) -> dict[tuple[float, ...], Robot]:
        """Robots by the fitted numbers that are theirs, for effects change and they do not."""
        return {}

    @property
    def start(self) -> Floats:
        """(p,) fitted numbers where a fit begins; of `log` unknowns the logarithms."""
        return np.array([u.outside(u.start) for u in self.unknowns])

    @property
    def limits(self) -> tuple[Floats, Floats]:
        """(p,) least and (p,) largest fitted numbers; of `log` unknowns the logarithms."""
        pairs = np.array([u.limits for u in self.unknowns]).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    @property
    def prior(self) -> tuple[Floats, Floats]:
        """(p,) mean and sd of the fitted numbers."""
        return np.array([u.outside(u.mean) for u in self.unknowns]), np.array([u.sd for u in self.unknowns])

    def with_effect(
        self,
        name: str,
        start: Mapping[str, float] | None = None,
        drop: Sequence[str] = (),
        drive: int | None = None,
        alike: bool = False,
    ) -> Model:
        """This model with one more effect, all its parameters unknown but those named in `drop`, which stay
        neutral. With `drive` (from 0 on) only that drive has it; with `alike` all drives have it in one
        size."""
        added = effect_unknowns(name, self.wiring, start or {}, drop, drive, alike)
        names = tuple(known for known in effect_names() if known in (*self.effects, name))
        return replace(self, effects=names, unknowns=self.unknowns + added)

    def without(self, name: str) -> Model:
        """This model without an effect."""
        kept = tuple(u for u in self.unknowns if u.place[:2] != ("effect", name))
        return replace(self, effects=tuple(e for e in self.effects if e != name), unknowns=kept)

    def drive_of(self, name: str) -> int | None:
        """The one drive that has an effect, from 0 on; None where all have it."""
        shared = {p.name for p in get_effect(name).parameters if p.shared}
        every = columns(get_effect(name), self.wiring)
        for unknown in self.unknowns if shared and self.wiring.n_drives > 1 else ():
            if unknown.place[:2] == ("effect", name) and len(unknown.place) == 3:
                label, _, number = every[int(unknown.place[2])].rpartition("_")
                if label in shared:
                    return int(number) - 1
        return None

    def alike(self, name: str) -> bool:
        """Whether all drives have an effect in one size that may differ between them."""
        own = {p.name for p in get_effect(name).parameters if p.per == "drive" and not p.shared}
        return any(u.place[:2] == ("effect", name) and u.name.partition(".")[2] in own for u in self.unknowns)

    def values(self, theta: Floats, session: int = 0) -> dict[str, Floats]:
        """Effect name -> (n_columns,) values in a session at the fitted numbers `theta` (p,); what is not
        unknown, as the robot has it or neutral."""
        values = {name: own.copy() for name, own in self._given.items()}
        # what is of the robot comes first, and what is of the session in its place
        for unknown, number in sorted(zip(self.unknowns, theta, strict=True), key=lambda u: u[0].session):
            if unknown.place[0] == "effect" and unknown.session in (0, session):
                values[unknown.place[1]][[int(c) for c in unknown.place[2:]]] = unknown.inside(float(number))
        return values

    def by_session(self, theta: Floats) -> dict[str, Floats]:
        """Effect name -> (1, n_columns) values, or (n_sessions, n_columns) where a session has its own."""
        own = {u.place[1] for u in self.unknowns if u.session}
        every = [self.values(theta, k) for k in range(len(self.sessions) if own else 1)]
        return {
            name: np.stack([values[name] for values in (every if name in own else every[:1])])
            for name in self.effects
        }

    def robot_at(self, theta: Floats) -> Robot:
        """The robot with the fitted numbers `theta` (p,), without its effects."""
        own = [
            (unknown, float(number))
            for unknown, number in zip(self.unknowns, theta, strict=True)
            if unknown.place[0] == "robot"
        ]
        key = tuple(number for _, number in own)
        if key not in self._robots:
            robot = replace(self.robot, effects=())
            for unknown, number in own:
                robot = _changed(robot, self.robot, unknown, unknown.inside(number))
            if len(self._robots) >= _KEPT:
                self._robots.clear()
            self._robots[key] = _whole(robot, self.robot)
        return self._robots[key]

    def identified(self, theta: Floats, session: int = 0) -> Robot:
        """The robot with its effects in a session as tables; `[fit]` and `[sensor]` are left out, for what
        they asked for is in it now."""
        tables = []
        for name, values in self.values(theta, session).items():
            table: dict[str, Any] = {"name": name}
            at = 0
            for parameter in get_effect(name).parameters:
                count = self.wiring.count(parameter.per)
                group = [float(v) for v in values[at : at + count]]
                at += count
                table[parameter.name] = group[0] if len(set(group)) == 1 else group
            tables.append(table)
        return replace(self.robot_at(theta), effects=tuple(tables), fit={}, sensor={})

    def in_sessions(self, theta: Floats) -> tuple[Robot, ...]:
        """The robot as `identified` in each session; once, where none has anything of its own."""
        count = len(self.sessions) if any(u.session for u in self.unknowns) else 1
        return tuple(self.identified(theta, k) for k in range(count))


def known_model(robot: Robot) -> Model:
    """A robot with its own effects, nothing unknown."""
    return Model(robot, route(robot), tuple(named_effects(robot)), ())


def effect_unknowns(
    name: str,
    wiring: Routing,
    start: Mapping[str, float] | None = None,
    drop: Sequence[str] = (),
    drive: int | None = None,
    alike: bool = False,
) -> tuple[Unknown, ...]:
    """The parameters of an effect as unknowns; one for all segments, and of `shared` ones, or where drives
    are `alike`, one for all drives. With `drive` the `shared` ones are of that drive alone, from 0 on; those
    of other drives stay neutral."""
    found = []
    at = 0
    every = columns(get_effect(name), wiring)
    for raw in get_effect(name).parameters:
        parameter = raw.on(wiring)
        count = wiring.count(parameter.per)
        own = range(at, at + count)
        at += count
        one = (parameter.per == "segment" and not parameter.apart) or parameter.shared
        tied = (one or (alike and parameter.per == "drive" and not parameter.shape)) and count > 0
        groups = [(parameter.name, tuple(own))] if tied else [(every[c], (c,)) for c in own]
        if parameter.shared and drive is not None:
            groups = [(every[at - count + drive], (at - count + drive,))]
        for label, places in groups:
            if label in drop:
                continue
            begin = (start or {}).get(parameter.name, parameter.starts[0])
            log = parameter.shape and parameter.bounds[0] > 0.0
            mean = parameter.starts[len(parameter.starts) // 2] if parameter.shape else parameter.neutral
            if parameter.shape and parameter.name in (start or {}):  # found otherwise
                mean = begin
            sd = 1.5 if log else _WIDE * parameter.scale
            found.append(
                Unknown(
                    f"{name}.{label}",
                    parameter.unit,
                    begin,
                    mean,
                    sd,
                    parameter.bounds,
                    parameter.scale,
                    ("effect", name, *map(str, places)),
                    log,
                    parameter.shape,
                )
            )
    return tuple(found)


def nominal_of(robot: Robot, kind: str, k: int) -> float:
    """The value in the robot file of a parameter of tendon or segment `k`; of several, their mean."""
    owner = robot.tendons[k] if kind in TENDON_UNITS else robot.segments[k]
    return float(np.mean(getattr(owner, kind)))


def _changed(robot: Robot, nominal: Robot, unknown: Unknown, value: float) -> Robot:
    """`robot` with one unknown set; a shared one is a factor on, or an addition to, each nominal value."""
    _, kind, *numbers = unknown.place
    segments = list(robot.segments)
    if kind == "material":
        return replace(robot, segments=_of_material(robot, numbers[0], value))
    if kind == "mass":
        k, m = map(int, numbers[0].split("."))
        masses = list(segments[k].lumps)
        masses[m] = replace(masses[m], mass=value)
        segments[k] = replace(segments[k], lumps=tuple(masses))
        return replace(robot, segments=tuple(segments))
    shared = len(numbers) > 1 or unknown.unit == "x nominal"
    for number in map(int, numbers):
        was = nominal_of(nominal, kind, number)
        now = value if not shared else was + value if kind in ADDED else was * value
        if kind in SEGMENT_UNITS:
            own: Any = getattr(nominal.segments[number], kind)
            new: Any = tuple(v * now / was for v in own) if isinstance(own, tuple) else now
            if kind == "length":
                old = segments[number]
                lumps = tuple(replace(lump, at=lump.at * now / old.length) for lump in old.lumps)
                segments[number] = replace(old, length=now, extension=_range(old.extension, now), lumps=lumps)
            else:
                segments[number] = replace(segments[number], **{kind: new})
        else:
            k = int(nominal.tendon_segment[number])
            place = number - int(np.searchsorted(nominal.tendon_segment, k))
            tendons = list(segments[k].tendons)
            own = getattr(nominal.tendons[number], kind)
            new = now
            if isinstance(own, tuple):
                new = tuple(v + now - was if kind == "angle" else v * now / was for v in own)
            if kind == "angle":  # a turn more or less is the same
                new = tuple(map(_wrapped, new)) if isinstance(new, tuple) else _wrapped(new)
            tendons[place] = replace(tendons[place], **{kind: new})
            # set again when all is known
            segments[k] = replace(segments[k], tendons=tuple(tendons), body_radius=0.0)
    return replace(robot, segments=tuple(segments), log_points=(), log_offsets=())


def _of_material(robot: Robot, kind: str, value: float) -> tuple[Segment, ...]:
    """The segments with another modulus or density, a factor, or as stiff and heavy as if their radius were
    larger by this fraction at the base and smaller at the tip."""
    middle = np.cumsum([s.length for s in robot.segments]) - 0.5 * np.array(
        [s.length for s in robot.segments]
    )
    made = []
    for segment, at in zip(robot.segments, middle, strict=True):
        radius = 1.0 + value * (1.0 - 2.0 * at / robot.length) if kind == "taper" else 1.0
        modulus = value if kind == "youngs_modulus" else 1.0
        bending, area = float(modulus * radius**4), float(modulus * radius**2)
        density = (value if kind == "density" else 1.0) * float(radius**2)
        made.append(
            replace(
                segment,
                bending_stiffness=(
                    bending * segment.bending_stiffness[0],
                    bending * segment.bending_stiffness[1],
                ),
                torsional_stiffness=bending * segment.torsional_stiffness,
                axial_stiffness=area * segment.axial_stiffness,
                shear_stiffness=area * segment.shear_stiffness,
                line_density=density * segment.line_density,
            )
        )
    return tuple(made)


def _wrapped(angle: float) -> float:
    return angle if abs(angle) <= 2.0 * math.pi else math.remainder(angle, 2.0 * math.pi)


def _whole(robot: Robot, nominal: Robot) -> Robot:
    """Return what a change of lengths and offsets must not lose: log points and body radii, moved where
    they would not fit."""
    widest = [0.0] * robot.n_segments
    for tendon, end in zip(robot.tendons, robot.tendon_segment, strict=True):
        for k, place in enumerate(tendon.position(int(end) + 1)):
            widest[k] = max(widest[k], math.hypot(*place))
    segments = tuple(
        replace(s, body_radius=max(n.body_radius, w) if n.body_radius else 0.0)
        for s, n, w in zip(robot.segments, nominal.segments, widest, strict=True)
    )
    points = tuple(min(s, robot.length) for s in nominal.log_points)
    return replace(robot, segments=segments, log_points=points, log_offsets=nominal.log_offsets)


def _range(extension: tuple[float, float], length: float) -> tuple[float, float]:
    return max(extension[0], -0.99 * length), extension[1]
