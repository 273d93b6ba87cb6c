"""Robots of all sizes, each with one effect under seal: what rules that were set on one robot do on others.

The effects are the library's own laws. `plant` is the other way round: other laws, on one robot.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from plant import LIBRARY

from fastrod import Robot, Segment, Tendon
from fastrod.effects.base import get_effect, trait
from fastrod.identification.excite import excitation
from fastrod.identification.log.replay import replay
from fastrod.logs.runlog import RunLog
from fastrod.model.routing import route

HIDDEN = (*LIBRARY, "tip_spring")


def any_robot(rng: np.random.Generator) -> Robot:
    """One to three segments of 12 to 50 cm in all, three or four elastic tendons each. Held sideways, it
    sinks by 3 to 30 % of its length."""
    length, n = rng.uniform(0.12, 0.5), int(rng.integers(1, 4))
    lengths, radius = rng.uniform(0.6, 1.4, n), length * rng.uniform(0.02, 0.06)
    weight = 1100.0 * math.pi * radius**2 * rng.uniform(0.2, 1.0)  # kg/m, of rubber with holes
    stiffness = float(rng.uniform(0.4, 4.0) * 9.81 * weight * length**3)
    segments = []
    for own, first in zip(length * lengths / lengths.sum(), np.cumsum(rng.uniform(0.2, 1.0, n)), strict=True):
        count, offset = int(rng.integers(3, 5)), radius * rng.uniform(0.5, 0.9)
        given = {"offset": offset, "compliance": rng.uniform(0.02, 0.3) * offset**2 * own / stiffness}
        angles = (first + 2.0 * np.pi * np.arange(count) / count) % (2.0 * np.pi)
        segments.append(
            Segment(
                length=float(own),
                body_radius=radius,
                bending_stiffness=(stiffness, stiffness),
                torsional_stiffness=stiffness / 1.3,
                line_density=weight,
                tendons=tuple(Tendon(angle=float(angle), **given) for angle in angles),
            )
        )
    return Robot(name="any", segments=tuple(segments))


def effect(rng: np.random.Generator, name: str, robot: Robot, share: float = 1.0) -> dict[str, Any]:
    """The effect, as a table of a robot file: `share` of one to three times its typical size, to either side
    where it has two."""
    made: dict[str, Any] = {"name": name}
    for parameter in get_effect(name).parameters:
        here = parameter.on(route(robot))
        low, high = here.bounds
        size = here.scale * rng.uniform(1.0, 3.0) * share
        value = here.neutral + size * rng.choice([-1.0, 1.0] if low <= here.neutral - size else [1.0])
        made[parameter.name] = float(min(here.starts[0] if here.shape else value, high))
    return made


def sealed(seed: int, name: str, most: float = 0.1) -> tuple[RunLog, Robot, dict[str, Any]]:
    """The designed run of a robot of its own, which has the effect `name` or, where one segment cannot show
    that, a friction; the robot without it; and what is hidden. It moves the tip by at most `most` of the
    length; noise of 0.05 to 0.3 % of the length, and at most a third of what the effect moves."""
    rng = np.random.default_rng(seed)
    robot = any_robot(rng)
    name = name if trait(get_effect(name), "least_segments") <= robot.n_segments else "friction"
    log = excitation(robot, seed=seed, bend=rng.uniform(0.5, 0.9)).log
    log = replace(log, tip_position=np.zeros((len(log), 3)))
    without, moved, share = np.asarray(replay(log, robot).tip_position), np.inf, 2.0
    while moved > most * robot.length:
        share *= 0.5
        hidden = effect(np.random.default_rng(seed), name, robot, share)
        tip = np.asarray(replay(log, replace(robot, effects=(hidden,))).tip_position)
        moved = float(np.sqrt(np.nanmean(((tip - without) ** 2).sum(1))))
    noise = min(robot.length * rng.uniform(0.0005, 0.003), moved / 5.0)
    return replace(log, tip_position=tip + rng.normal(0.0, noise, tip.shape)), robot, hidden
