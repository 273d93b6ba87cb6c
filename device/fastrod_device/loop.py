"""The whole loop on one robot: excite, record, identify, name the effect, add it, plan anew, track; the error before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np

from fastrod.control import Trajectory, circle, square, triangle
from fastrod.control.inverse import plan
from fastrod.identification.attribution import identify
from fastrod.identification.excite import excitation
from fastrod.identification.result import Result
from fastrod.robot import Robot
from fastrod_device.experiment import Hands, Progress, Tracking, excite, follow, tracking
from fastrod_device.prototype import Prototype

PERIOD = 9.0
"""Of a turn of a path [s]."""
APPROACH = 2.0
"""From straight to the path [s]."""
RATE = 20.0
"""Of the plans [Hz]."""


def paths(height: float) -> dict[str, Trajectory]:
    """The paper's three references, in the plane of the straight robot's tip, which stands at `height` [m]."""
    center = (0.0, 0.0, height)
    return {
        "triangle": triangle(side=0.04, period=PERIOD, center=center),
        "square": square(side=0.025, period=PERIOD, center=center),
        "circle": circle(radius=0.02, period=PERIOD, center=center),
    }


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """What came out of it."""

    result: Result
    """Of the identification."""
    before: Sequence[Tracking]
    """With plans by the model as it was."""
    after: Sequence[Tracking]
    """With plans by the identified model."""


def close_loop(
    prototype: Prototype, hands: Hands, out: Path, *, payload: float | None = None, turn: bool = True, progress: Progress | None = None
) -> Loop:
    """Run it on a prototype that is started; logs, plans and the identified robot go to the folder `out`, which is there and empty.

    `payload`: known load of the excitation [kg], None: one that suits the robot, 0: none; `turn`: the base is turned for a part of it.
    Raises what a stopped prototype raises, and `LogError` where a log cannot tell anything.
    """
    tell = progress or (lambda *_: None)
    robot = prototype.robot
    run = excitation(robot, payload=payload, turn=turn, rate=prototype.hardware.camera.rate)
    log = excite(prototype, run, hands, out / "excite.csv", progress=tell)
    _rest(prototype, hands)
    before = [_track(prototype, name, path, robot, out / f"{name}_before.csv", tell) for name, path in paths(robot.length).items()]
    result = identify(log, robot, progress=tell)
    after = [
        _track(prototype, name, path, result.identified, out / f"{name}_after.csv", tell) for name, path in paths(robot.length).items()
    ]
    return Loop(result=result, before=before, after=after)


def _rest(prototype: Prototype, hands: Hands) -> None:
    """Load off, base as in the robot's file."""
    hands.hang(0.0)
    own = np.array(prototype.robot.base_quaternion)
    hands.turn(own)
    prototype.payload, prototype.base_quaternion = 0.0, own


def _track(prototype: Prototype, name: str, path: Trajectory, model: Robot, out: Path, tell: Progress) -> Tracking:
    tell(f"{name}: planning by the model", 0, 1)
    made = plan(model, path.position(np.arange(0.0, PERIOD, 1.0 / RATE)), RATE, approach=APPROACH)
    tell(f"{name}: tracking", 0, 1)
    return tracking(name, follow(prototype, made, out), made)
