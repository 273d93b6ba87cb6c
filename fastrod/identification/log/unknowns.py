"""What is not known: parameters of the robot and of effects, each with a prior; and the model that a vector
of them makes."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fastrod.effects.base import columns, effect_names, get_effect, read_values
from fastrod.effects.pipeline import named_effects
from fastrod.errors import RobotError, nearest
from fastrod.model.robot import Robot
from fastrod.model.routing import Routing, route
from fastrod.types import Floats

_SEGMENT = {
    "length": "m",
    "bending_stiffness": "N m^2",
    "torsional_stiffness": "N m^2",
    "line_density": "kg/m",
    "damping_time": "s",
    "axial_stiffness": "N",
    "shear_stiffness": "N",
}
_TENDON = {"offset": "m", "angle": "rad", "compliance": "m/N", "pretension": "N", "gain": "", "zero": "m"}
MOTION = ("damping_time", "axial_stiffness", "shear_stiffness", "mass")
"""Parameters that only a fit in motion changes."""
# a shared one of these is the same number for all; of the others, the same factor
_ADDED = ("angle", "gain", "zero")
_POSITIVE: tuple[str, ...] = (
    "length",
    "bending_stiffness",
    "torsional_stiffness",
    "offset",
    "axial_stiffness",
)
_POSITIVE += ("shear_stiffness",)
STIFFNESS_SD = 0.3
"""Relative prior of EI and GJ where the robot file says nothing."""
FREE_CAMERA = {"registration_sd": (0.01, 0.05), "marker_offset_sd": 0.02, "latency_sd": 0.15}
"""Priors of a camera that nobody calibrated: m and rad, m, s."""
ROUGH = (0.1, 0.2)
"""Prior of a rough registration: robot lengths, rad. With 0.55 mm of backlash one was 0.003 rad and 1.3 mm
off."""
_WIDE = 5.0  # typical sizes: width of the prior of an effect's size


@dataclass(frozen=True)
class Unknown:
    """One number to be fitted."""

    name: str
    """`segment.1.length`, `tendon.*.gain`, or `backlash.half_width`."""
    unit: str
    start: float
    """Where a fit begins; of the robot's own parameters, the nominal value and the mean of the prior."""
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

    def inside(self, theta: float) -> float:
        """The value of a fitted number."""
        return math.exp(theta) if self.log else theta

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
        split: bool = False,
    ) -> Model:
        """This model with one more effect, all its parameters unknown but those named in `drop`, which stay
        neutral."""
        added = effect_unknowns(name, self.wiring, start or {}, drop, split)
        names = tuple(known for known in effect_names() if known in (*self.effects, name))
        return replace(self, effects=names, unknowns=self.unknowns + added)

    def without(self, name: str) -> Model:
        """This model without an effect."""
        kept = tuple(u for u in self.unknowns if u.place[:2] != ("effect", name))
        return replace(self, effects=tuple(e for e in self.effects if e != name), unknowns=kept)

    def values(self, theta: Floats) -> dict[str, Floats]:
        """Effect name -> (n_columns,) values at the fitted numbers `theta` (p,); what is not unknown, as the
        robot has it or neutral."""
        known = named_effects(self.robot)
        values = {name: read_values(name, known.get(name, {}), self.wiring, "robot") for name in self.effects}
        for unknown, number in zip(self.unknowns, theta, strict=True):
            if unknown.place[0] == "effect":
                values[unknown.place[1]][[int(c) for c in unknown.place[2:]]] = unknown.inside(float(number))
        return values

    def robot_at(self, theta: Floats) -> Robot:
        """The robot with the fitted numbers `theta` (p,), without its effects."""
        robot = replace(self.robot, effects=())
        for unknown, number in zip(self.unknowns, theta, strict=True):
            if unknown.place[0] == "robot":
                robot = _changed(robot, self.robot, unknown, unknown.inside(float(number)))
        return _whole(robot, self.robot)

    def identified(self, theta: Floats) -> Robot:
        """The robot with its effects as tables; `[fit]` and `[sensor]` are left out, for what they asked for
        is in it now."""
        tables = []
        for name, values in self.values(theta).items():
            table: dict[str, Any] = {"name": name}
            at = 0
            for parameter in get_effect(name).parameters:
                count = self.wiring.count(parameter.per)
                group = [float(v) for v in values[at : at + count]]
                at += count
                table[parameter.name] = group[0] if len(set(group)) == 1 else group
            tables.append(table)
        return replace(self.robot_at(theta), effects=tuple(tables), fit={}, sensor={})


def known_model(robot: Robot) -> Model:
    """A robot with its own effects, nothing unknown."""
    return Model(robot, route(robot), tuple(named_effects(robot)), ())


def base_model(
    robot: Robot, *, free_camera: bool = False, registered: bool = False, dynamics: bool = False
) -> Model:
    """The model before anything is found: the robot's `[fit]` and `[sensor]`, and its stiffness.

    `registered`: the camera's place in `robot` comes from a rough registration, and is fitted. `dynamics`:
    it is fitted in motion. Raises `RobotError` for a target that is none, naming the nearest, and for one
    that only motion shows without it.
    """
    wiring = route(robot)
    unknowns: list[Unknown] = []
    effects = list(named_effects(robot))
    for target, prior in robot.fit.items():
        unknowns += _targets(robot, wiring, target, prior)
        if not dynamics and unknowns[-1].place[1] in MOTION:
            raise RobotError(
                f"robot {robot.name!r}: [fit] {target!r} is fitted in motion; identify with --dynamics "
                "(dynamics=True)."
            )
    for kind in ("bending_stiffness", "torsional_stiffness"):
        if not any(u.place[:2] == ("robot", kind) for u in unknowns):
            name = f"segment.*.{kind}"
            numbers = tuple(str(k) for k in range(robot.n_segments))
            unknowns.append(
                Unknown(
                    name,
                    "x nominal",
                    1.0,
                    1.0,
                    STIFFNESS_SD,
                    (0.05, 20.0),
                    0.05,
                    ("robot", kind, *numbers),
                    log=True,
                )
            )
    sensor = dict(robot.sensor) | (FREE_CAMERA if free_camera else {})
    if registered:
        sensor["registration_sd"] = _wider(
            sensor.get("registration_sd", 0.0), (ROUGH[0] * robot.length, ROUGH[1])
        )
    unknowns += _camera(sensor, robot, wiring)
    effects += [u.place[1] for u in unknowns if u.place[0] == "effect"]
    return Model(robot, wiring, tuple(name for name in effect_names() if name in effects), tuple(unknowns))


def effect_unknowns(
    name: str,
    wiring: Routing,
    start: Mapping[str, float] | None = None,
    drop: Sequence[str] = (),
    split: bool = False,
) -> tuple[Unknown, ...]:
    """The parameters of an effect as unknowns; one for all segments, or with `split` one for each."""
    found = []
    at = 0
    every = columns(get_effect(name), wiring)
    for raw in get_effect(name).parameters:
        parameter = raw.on(wiring)
        count = wiring.count(parameter.per)
        own = range(at, at + count)
        at += count
        tied = parameter.per == "segment" and not split
        groups = [(parameter.name, tuple(own))] if tied else [(every[c], (c,)) for c in own]
        for label, places in groups:
            if label in drop:
                continue
            begin = (start or {}).get(parameter.name, parameter.starts[0])
            log = parameter.shape and parameter.bounds[0] > 0.0
            mean = parameter.starts[len(parameter.starts) // 2] if parameter.shape else parameter.neutral
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


def _targets(robot: Robot, wiring: Routing, target: str, prior: Mapping[str, float]) -> list[Unknown]:
    """The unknowns of one line of `[fit]`."""
    match = re.fullmatch(r"(segment|tendon)\.(\*|\d+)\.(\w+)", target)
    kinds = {"segment": _SEGMENT, "tendon": _TENDON}
    names = [f"{word}.*.{kind}" for word, table in kinds.items() for kind in table]
    if lump := re.fullmatch(r"segment\.(\d+)\.lump\.(\d+)\.mass", target):
        return [
            _lump_unknown(
                robot, target, (int(lump[1]) - 1, int(lump[2]) - 1), _checked_sd(robot, target, prior)
            )
        ]
    if match is None or match[3] not in kinds[match[1]]:
        raise RobotError(f"robot {robot.name!r}: [fit] {target!r} is no parameter; {nearest(target, names)}")
    word, number, kind = match[1], match[2], match[3]
    count = robot.n_segments if word == "segment" else robot.n_tendons
    if number != "*" and not 1 <= int(number) <= count:
        raise RobotError(f"robot {robot.name!r}: [fit] {target!r}; the robot has {word}s 1 to {count}.")
    sd = _checked_sd(robot, target, prior)
    which = list(range(count)) if number == "*" else [int(number) - 1]
    if kind in ("gain", "zero"):
        return _drive_unknowns(wiring, kind, which, sd, bool(prior.get("shared")), target)
    nominal = [_nominal(robot, kind, k) for k in which]
    if not all(map(math.isfinite, nominal)):
        raise RobotError(
            f"robot {robot.name!r}: [fit] {target!r} has no value to begin from; give the segment "
            f"a finite {kind}."
        )
    unit = (_SEGMENT if word == "segment" else _TENDON)[kind]
    if prior.get("shared") and len(which) > 1:
        places = ("robot", kind, *map(str, which))
        if kind in _ADDED:
            return [Unknown(target, unit, 0.0, 0.0, sd, (-10.0 * sd, 10.0 * sd), 0.3 * sd, places)]
        middle = float(np.mean(nominal)) or 1.0
        return [
            Unknown(
                target,
                "x nominal",
                1.0,
                1.0,
                sd / middle,
                (0.05, 20.0),
                min(0.05, 0.3 * sd / middle),
                places,
                log=True,
            )
        ]
    made = []
    for k, value in zip(which, nominal, strict=True):
        least = 0.05 * value if kind in _POSITIVE else 0.0
        if kind == "angle" or (kind == "pretension" and not robot.tendons[k].unilateral):
            least = -math.inf
        low = max(value - 10.0 * sd, least)
        step = min(0.3 * sd, 0.05 * abs(value) or math.inf)
        made.append(
            Unknown(
                f"{word}.{k + 1}.{kind}",
                unit,
                value,
                value,
                sd,
                (low, value + 10.0 * sd),
                step,
                ("robot", kind, str(k)),
            )
        )
    return made


def _checked_sd(robot: Robot, target: str, prior: Mapping[str, float]) -> float:
    unknown = [key for key in prior if key not in ("sd", "shared")]
    if unknown or "sd" not in prior:
        raise RobotError(
            f"robot {robot.name!r}: [fit] {target!r} is {dict(prior)!r}; give {{sd = ...}} in its unit, and "
            "shared = true for one for all."
        )
    sd = float(prior["sd"])
    if not (math.isfinite(sd) and sd > 0.0):
        raise RobotError(
            f"robot {robot.name!r}: [fit] {target!r} has sd {sd!r}; it must be positive: leave "
            "out what is known."
        )
    return sd


def _lump_unknown(robot: Robot, target: str, place: tuple[int, int], sd: float) -> Unknown:
    k, m = place
    if not (0 <= k < robot.n_segments and 0 <= m < len(robot.segments[k].lumps)):
        counts = ", ".join(str(len(s.lumps)) for s in robot.segments)
        raise RobotError(
            f"robot {robot.name!r}: [fit] {target!r}; its segments have {counts} lumps, counted from 1."
        )
    mass = robot.segments[k].lumps[m].mass
    step = min(0.3 * sd, 0.05 * mass or math.inf)
    bounds = max(mass - 10.0 * sd, 0.0), mass + 10.0 * sd
    return Unknown(target, "kg", mass, mass, sd, bounds, step, ("robot", "mass", f"{k}.{m}"))


def _drive_unknowns(
    wiring: Routing, kind: str, which: list[int], sd: float, shared: bool, target: str
) -> list[Unknown]:
    """Gains and zeros of tendons are those of their drives: no bend tells antagonists of one drive apart."""
    name = "drum_gain" if kind == "gain" else "encoder_offset"
    unit = _TENDON[kind]
    drives = list(dict.fromkeys(int(wiring.drive[t]) for t in which))
    groups = [tuple(drives)] if shared else [(d,) for d in drives]
    low = max(-0.95, -10.0 * sd) if kind == "gain" else -10.0 * sd
    return [
        Unknown(
            target if shared else f"tendon.{int(np.flatnonzero(wiring.drive == group[0])[0]) + 1}.{kind}",
            unit,
            0.0,
            0.0,
            sd,
            (low, 10.0 * sd),
            0.1 * sd,
            ("effect", name, *map(str, group)),
        )
        for group in groups
    ]


def _pair(registration: Any) -> tuple[float, float]:
    """Shift [m] and rotation [rad] of `registration_sd`; one number stands for both."""
    shift, angle = registration if isinstance(registration, (tuple, list)) else (registration, registration)
    return float(shift), float(angle)


def _wider(given: Any, least: tuple[float, float]) -> tuple[float, float]:
    shift, angle = _pair(given)
    return max(shift, least[0]), max(angle, least[1])


def _camera(sensor: Mapping[str, Any], robot: Robot, wiring: Routing) -> list[Unknown]:
    """The camera's unknowns, about where the effects of the robot file have it."""
    made: list[Unknown] = []
    known = named_effects(robot)
    shift, angle = _pair(sensor.get("registration_sd", 0.0))
    for names, sd, effect_name in (
        ([f"rotation_{a}" for a in "xyz"], angle, "frame_misalignment"),
        ([f"shift_{a}" for a in "xyz"], shift, "frame_misalignment"),
        (["x", "y", "z"], float(sensor.get("marker_offset_sd", 0.0)), "marker_offset"),
        (["delay"], float(sensor.get("latency_sd", 0.0)), "latency"),
    ):
        every = columns(get_effect(effect_name), wiring)
        unit = next(p.unit for p in get_effect(effect_name).parameters if p.name == names[0])
        table = known.get(effect_name, {})
        for label in names if sd > 0.0 else []:
            mean = float(table.get(label, 0.0))
            low, start = mean - 10.0 * sd, mean
            if effect_name == "latency":
                low, start = 0.0, mean or min(0.5 * sd, 0.05)
            place = ("effect", effect_name, str(every.index(label)))
            made.append(
                Unknown(
                    f"{effect_name}.{label}", unit, start, mean, sd, (low, mean + 10.0 * sd), 0.1 * sd, place
                )
            )
    return made


def _nominal(robot: Robot, kind: str, k: int) -> float:
    if kind in _TENDON:
        value = getattr(robot.tendons[k], kind)
        return float(np.mean(value))
    value = getattr(robot.segments[k], kind)
    return float(np.mean(value))


def _changed(robot: Robot, nominal: Robot, unknown: Unknown, value: float) -> Robot:
    """`robot` with one unknown set; a shared one is a factor on, or an addition to, each nominal value."""
    _, kind, *numbers = unknown.place
    segments = list(robot.segments)
    if kind == "mass":
        k, m = map(int, numbers[0].split("."))
        masses = list(segments[k].lumps)
        masses[m] = replace(masses[m], mass=value)
        segments[k] = replace(segments[k], lumps=tuple(masses))
        return replace(robot, segments=tuple(segments))
    shared = len(numbers) > 1 or unknown.unit == "x nominal"
    for number in map(int, numbers):
        was = _nominal(nominal, kind, number)
        now = value if not shared else was + value if kind in _ADDED else was * value
        if kind in _SEGMENT:
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
            new = (
                now
                if not isinstance(own, tuple)
                else tuple(v + now - was if kind == "angle" else v * now / was for v in own)
            )
            tendons[place] = replace(tendons[place], **{kind: new})
            # set again when all is known
            segments[k] = replace(segments[k], tendons=tuple(tendons), body_radius=0.0)
    return replace(robot, segments=tuple(segments), log_points=())


def _whole(robot: Robot, nominal: Robot) -> Robot:
    """What a change of lengths and offsets must not lose: log points and body radii, moved where they would
    not fit."""
    widest = [0.0] * robot.n_segments
    for tendon, end in zip(robot.tendons, robot.tendon_segment, strict=True):
        for k, place in enumerate(tendon.position(int(end) + 1)):
            widest[k] = max(widest[k], math.hypot(*place))
    segments = tuple(
        replace(s, body_radius=max(n.body_radius, w) if n.body_radius else 0.0)
        for s, n, w in zip(robot.segments, nominal.segments, widest, strict=True)
    )
    return replace(
        robot, segments=segments, log_points=tuple(min(s, robot.length) for s in nominal.log_points)
    )


def _range(extension: tuple[float, float], length: float) -> tuple[float, float]:
    return max(extension[0], -0.99 * length), extension[1]
