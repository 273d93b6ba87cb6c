"""The model before anything is found: what the robot file's `[fit]` and `[sensor]` leave unknown, and its
stiffness."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fastrod.effects.base import columns, effect_names, get_effect, read_values
from fastrod.effects.pipeline import named_effects
from fastrod.errors import RobotError, nearest
from fastrod.identification.log.unknowns import (
    ADDED,
    MATERIAL,
    SEGMENT_UNITS,
    TENDON_UNITS,
    Model,
    Unknown,
    nominal_of,
)
from fastrod.model.robot import Robot
from fastrod.model.routing import Routing, route

MOTION = ("damping_time",)
"""Parameters that only motion shows."""
_POSITIVE = (
    "length",
    "bending_stiffness",
    "torsional_stiffness",
    "line_density",
    "offset",
    "axial_stiffness",
    "shear_stiffness",
)
STIFFNESS_SD = 0.3
"""Relative prior of EI and GJ where the robot file says nothing."""
FREE_CAMERA: dict[str, Any] = {"registration_sd": (0.01, 0.05), "marker_offset_sd": 0.02, "latency_sd": 0.15}
"""Priors of a camera that nobody calibrated: m and rad, m, s."""
_ZERO_SD = 0.1
"""Prior of a drive's zero in another session, where `[fit]` says nothing: rad, as a bend of its segment."""
_TIGHTER_SD = 0.5
"""Prior of a session's pretension, relative."""
_HANGS_SD = 0.05
"""Prior of where a session's load hangs, per axis, robot lengths."""
ROUGH = (0.1, 0.2)
"""Prior of a rough registration: robot lengths, rad. With 0.55 mm of backlash one was 0.003 rad and 1.3 mm
off."""


def base_model(
    robot: Robot,
    *,
    free_camera: bool = False,
    registered: bool = False,
    dynamics: bool = False,
    sessions: Sequence[str] = ("",),
    only_session: bool = False,
    loaded: bool = False,
    margin: float = 0.0,
) -> Model:
    """The model before anything is found: the robot's `[fit]` and `[sensor]`, and its stiffness; and of each
    of its `sessions` but the first, its own zeros, pretension, registration and delay, and where a tip that
    is `loaded` bears its load.

    `registered`: the camera's place in `robot` comes from a rough registration, and is fitted. The commands
    were laid `margin` [s] too early, where that is not 0: about that is the delay, which is fitted.
    `dynamics`: it is fitted in motion. With `only_session` all is known but what is of a session. Raises
    `RobotError` for a target that is none, naming the nearest, and for one that only motion shows without it.
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
        known = (("robot", kind), ("robot", "material"))
        if not any(u.place[:2] in known and u.name != "material.density" for u in unknowns):
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
    if margin:
        sensor["latency_sd"] = max(float(sensor.get("latency_sd", 0.0)), FREE_CAMERA["latency_sd"])
    if registered:
        sensor["registration_sd"] = _wider(
            sensor.get("registration_sd", 0.0), (ROUGH[0] * robot.length, ROUGH[1])
        )
    unknowns += [
        replace(u, start=u.mean + margin, mean=u.mean + margin, bounds=(0.0, u.bounds[1] + margin))
        if margin and u.name == "latency.delay"
        else u
        for u in _camera(sensor, robot, wiring)
    ]
    if only_session:
        unknowns = _of_session(robot, wiring, sensor, loaded)
    for k, label in enumerate(sessions[1:], 1):
        unknowns += [
            replace(u, name=f"session {label or k + 1}.{u.name}", session=k)
            for u in _of_session(robot, wiring, sensor, loaded)
        ]
    effects += [u.place[1] for u in unknowns if u.place[0] == "effect"]
    return Model(
        robot,
        wiring,
        tuple(name for name in effect_names() if name in effects),
        tuple(unknowns),
        tuple(sessions),
    )


def _targets(robot: Robot, wiring: Routing, target: str, prior: Mapping[str, float]) -> list[Unknown]:
    """The unknowns of one line of `[fit]`."""
    match = re.fullmatch(r"(segment|tendon)\.(\*|\d+)\.(\w+)", target)
    kinds = {"segment": SEGMENT_UNITS, "tendon": TENDON_UNITS}
    names = [f"{word}.*.{kind}" for word, table in kinds.items() for kind in table]
    names += [f"material.{kind}" for kind in MATERIAL]
    if lump := re.fullmatch(r"segment\.(\d+)\.lump\.(\d+)\.mass", target):
        return [
            _lump_unknown(
                robot, target, (int(lump[1]) - 1, int(lump[2]) - 1), _checked_sd(robot, target, prior)
            )
        ]
    word, _, kind = target.partition(".")
    if word == "material" and kind in MATERIAL:
        sd, place = _checked_sd(robot, target, prior), ("robot", "material", kind)
        if kind == "taper":
            return [Unknown(target, "", 0.0, 0.0, sd, (-0.6, 0.6), min(0.02, 0.3 * sd), place)]
        step = min(0.05, 0.3 * sd)
        return [Unknown(target, "x nominal", 1.0, 1.0, sd, (0.02, 50.0), step, place, log=True)]
    if match is None or match[3] not in kinds[match[1]]:
        raise RobotError(f"robot {robot.name!r}: [fit] {target!r} is no parameter; {nearest(target, names)}")
    word, number, kind = match[1], match[2], match[3]
    count = robot.n_segments if word == "segment" else robot.n_tendons
    if number != "*" and not 1 <= int(number) <= count:
        raise RobotError(f"robot {robot.name!r}: [fit] {target!r}; the robot has {word}s 1 to {count}.")
    sd = _checked_sd(robot, target, prior)
    which = list(range(count)) if number == "*" else [int(number) - 1]
    if kind in ("gain", "zero"):
        return _drive_unknowns(robot, wiring, kind, which, sd, bool(prior.get("shared")), target)
    nominal = [nominal_of(robot, kind, k) for k in which]
    if not all(map(math.isfinite, nominal)):
        raise RobotError(
            f"robot {robot.name!r}: [fit] {target!r} has no value to begin from; give the segment "
            f"a finite {kind}."
        )
    unit = (SEGMENT_UNITS if word == "segment" else TENDON_UNITS)[kind]
    if prior.get("shared") and len(which) > 1:
        places = ("robot", kind, *map(str, which))
        if kind in ADDED:
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


def _of_session(robot: Robot, wiring: Routing, sensor: Mapping[str, Any], loaded: bool) -> list[Unknown]:
    """Return what another session has of its own: zeros of the drives, how tight tendons are that can only
    pull, registration and delay, and where the load hangs, about what the robot file says."""
    zero = float(
        robot.fit.get("tendon.*.zero", {}).get("sd", _ZERO_SD * float(np.mean(wiring.tendon_offset)))
    )
    shift, angle = _wider(sensor.get("registration_sd", 0.0), FREE_CAMERA["registration_sd"])
    delay = max(float(sensor.get("latency_sd", 0.0)), FREE_CAMERA["latency_sd"])
    every = list(range(robot.n_tendons))
    zeros = _drive_unknowns(robot, wiring, "zero", every, zero, False, "tendon.*.zero") if every else []
    tight = any(t.unilateral and t.pretension * t.compliance > 0.0 for t in robot.tendons)
    return [
        *zeros,
        *(_about(robot, wiring, "tightening", ["fraction"], _TIGHTER_SD) if tight else []),
        *_camera({"registration_sd": (shift, angle), "latency_sd": delay if every else 0.0}, robot, wiring),
        *(_about(robot, wiring, "load_offset", list("xyz"), _HANGS_SD * robot.length) if loaded else []),
    ]


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
    robot: Robot, wiring: Routing, kind: str, which: list[int], sd: float, shared: bool, target: str
) -> list[Unknown]:
    """Gains and zeros of tendons are those of their drives, about those that the effects of the robot file
    have: no bend tells antagonists of one drive apart."""
    name = "drum_gain" if kind == "gain" else "encoder_offset"
    unit = TENDON_UNITS[kind]
    drives = list(dict.fromkeys(int(wiring.drive[t]) for t in which))
    groups = [tuple(drives)] if shared else [(d,) for d in drives]
    known = read_values(name, named_effects(robot).get(name, {}), wiring, f"robot {robot.name!r}")
    least = -0.95 if kind == "gain" else -math.inf
    about = [(group, float(np.mean(known[list(group)]))) for group in groups]
    return [
        Unknown(
            target if shared else f"tendon.{int(np.flatnonzero(wiring.drive == group[0])[0]) + 1}.{kind}",
            unit,
            mean,
            mean,
            sd,
            (max(least, mean - 10.0 * sd), mean + 10.0 * sd),
            0.1 * sd,
            ("effect", name, *map(str, group)),
        )
        for group, mean in about
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
    shift, angle = _pair(sensor.get("registration_sd", 0.0))
    return [
        unknown
        for name, labels, sd in (
            ("frame_misalignment", [f"rotation_{a}" for a in "xyz"], angle),
            ("frame_misalignment", [f"shift_{a}" for a in "xyz"], shift),
            ("marker_offset", list("xyz"), float(sensor.get("marker_offset_sd", 0.0))),
            ("latency", ["delay"], float(sensor.get("latency_sd", 0.0))),
        )
        for unknown in (_about(robot, wiring, name, labels, sd) if sd > 0.0 else [])
    ]


def _about(robot: Robot, wiring: Routing, name: str, labels: list[str], sd: float) -> list[Unknown]:
    """Parameters of an effect that exists once per robot, about what the robot file says of them."""
    every, own = columns(get_effect(name), wiring), named_effects(robot).get(name, {})
    parameters = {p.name: p.on(wiring) for p in get_effect(name).parameters}
    made: list[Unknown] = []
    for label in labels:
        mean = float(own.get(label, 0.0))
        low, high, start = mean - 10.0 * sd, mean + 10.0 * sd, mean
        if name == "latency":
            low, start = 0.0, mean or min(0.5 * sd, 0.05)
        low = max(low, parameters[label].bounds[0])
        place = ("effect", name, str(every.index(label)))
        unit = parameters[label].unit
        made.append(Unknown(f"{name}.{label}", unit, start, mean, sd, (low, high), 0.1 * sd, place))
    return made
