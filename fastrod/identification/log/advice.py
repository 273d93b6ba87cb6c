"""Words for what a log cannot say, and for the run that would say it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fastrod.effects.base import get_effect, trait
from fastrod.identification.log.noise import at_rest
from fastrod.identification.log.samples import LogSamples
from fastrod.model.robot import Robot
from fastrod.types import Floats


def separating_run(one: str, other: str) -> str:
    """Which run would tell two effects apart."""
    first, second = get_effect(one), get_effect(other)
    run = trait(first, "separated_by").get(other) or trait(second, "separated_by").get(one)
    if run is None:
        both = [trait(what, "excited_by") for what in (first, second)]
        run = (
            "; ".join(dict.fromkeys(text for text in both if text))
            or "motion over the whole workspace at two speeds, with holds"
        )
    return f"to tell {one.replace('_', ' ')} from {other.replace('_', ' ')}: {run}"


def look_at(pattern: str) -> str:
    """Return what to do about a pattern that no effect of the library makes."""
    return f"look at the robot: {pattern}; fix it, or register an effect of your own for it, and run again"


def loaded(samples: LogSamples, robot: Robot) -> bool:
    """A load is known: in the log, or the robot's own weight in its file."""
    log = samples.log
    weight = any(segment.line_density > 0.0 for segment in robot.segments) and bool(
        np.any(np.array(robot.gravity) != 0.0)
    )
    return (
        weight
        or log.tension is not None
        or any(a is not None and bool(np.any(np.nan_to_num(a) != 0.0)) for a in (log.tip_force, log.payload))
    )


def why_unknown(name: str, samples: LogSamples, robot: Robot) -> str:
    """Why this log says nothing about a parameter of the robot."""
    log = samples.log
    if "stiffness" in name and not loaded(samples, robot):
        return (
            "this log has no known load, so tendon lengths alone fix the shape and stiffness cannot be "
            "estimated"
        )
    if "stiffness" in name:
        return "the known loads in this log bend the robot too little to show it"
    if "line_density" in name and not _base_rotates(log.base_quaternion):
        return "one base orientation only: self-weight looks like a bent robot"
    return "this log does not move it: its effect is within the noise, or others do the same"


def missing_excitation(samples: LogSamples, bend: Floats) -> list[str]:
    """Return what this run lacks to separate effects, in a sentence each. `bend` (n, n_segments, 2)
    commanded [rad]."""
    return [cannot for there, _, cannot in excitation(samples, bend) if not there]


def excitation(samples: LogSamples, bend: Floats) -> list[tuple[bool, str, str]]:
    """Each kind of excitation: whether the run has it, what it shows, and what is not seen without it. `bend`
    (n, n_segments, 2) commanded [rad]."""
    log = samples.log
    size = np.linalg.norm(bend, axis=-1)
    largest = float(size.max()) if size.size else np.inf
    holds = [
        rows
        for rows in at_rest(samples)
        if samples.time[samples.rows[rows[-1]]] - samples.time[samples.rows[rows[0]]] >= 2.0
    ]
    moved = size > 0.1
    alone = any(
        (moved[:, k] & ~np.delete(moved, k, axis=1).any(1)).mean() > 0.03 for k in range(bend.shape[1])
    )
    return [
        (
            _base_rotates(log.base_quaternion),
            "several base orientations: gravity and payload apart from zeros and registration",
            "one base orientation only: gravity and payload cannot be distinguished from zeros, "
            "registration or precurvature",
        ),
        (
            log.payload is not None or log.tip_force is not None or log.tension is not None,
            "known loads: stretch of the tendons apart from the gain of the drives, and stiffness",
            "no known load: stretch of the tendons cannot be distinguished from the gain of the drives, "
            "stiffness is not seen",
        ),
        (
            largest >= 0.45,
            "wide bends: stiffening, taper, compression and a set",
            f"bends to {np.degrees(largest):.0f} degrees only: stiffening, taper, compression "
            "and a set hardly show",
        ),
        (
            bool(holds),
            "holds: creep apart from friction, and the noise",
            "no holds: creep cannot be distinguished from friction, and the noise is not known from rest",
        ),
        (
            alone,
            "segments that move alone: coupling apart from zeros and gains",
            "no segment ever moves alone: coupling between segments looks like their own zeros and gains",
        ),
    ][: 5 if bend.shape[1] > 1 else 4]  # one segment is coupled to no other


def unique(lines: Sequence[str]) -> list[str]:
    """Each line once, in order."""
    return list(dict.fromkeys(lines))


def _base_rotates(quaternion: Floats | None) -> bool:
    return quaternion is not None and bool(np.nanmax(np.ptp(quaternion, axis=0)) > 0.1)
