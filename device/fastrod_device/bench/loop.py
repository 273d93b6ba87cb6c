"""The whole loop on one robot: excite, record, identify, name the effect, add it, plan anew, track; the error
before and after."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import numpy as np

from fastrod.control import Trajectory, references
from fastrod.control.inverse import InversePlan, plan
from fastrod.identification.attribution import identify
from fastrod.identification.excite import excitation
from fastrod.identification.report.result import Result
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod_device.bench.experiment import (
    BenchAssistant,
    Progress,
    TrackingRun,
    drive_lag,
    excite,
    follow,
    tracking,
)
from fastrod_device.prototype import Prototype

APPROACH = 2.0
"""Time from the straight pose to the path [s]."""
RATE = 20.0
"""Rate of the plans [Hz]."""


def planned(model: Robot, path: Trajectory) -> InversePlan:
    """One turn of a path by a model, from straight."""
    return plan(
        model, path.position(np.arange(round(path.period * RATE) + 1) / RATE), RATE, approach=APPROACH
    )


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class Loop:
    """Result of the loop."""

    result: Result
    """Result of the identification."""
    before: Sequence[TrackingRun]
    """With plans by the model as it was."""
    after: Sequence[TrackingRun]
    """With plans by the identified model."""


def close_loop(
    prototype: Prototype,
    assistant: BenchAssistant,
    out: Path,
    *,
    payload: float | None = None,
    turn: bool = True,
    progress: Progress | None = None,
) -> Loop:
    """Run it on a prototype that is started; logs, plans and the identified robot go to the folder `out`,
    which is there and empty.

    `payload`: known load of the excitation [kg], None: one that suits the robot, 0: none; `turn`: the base is
    turned for a part of it. Raises what a stopped prototype raises, and `LogError` where a log cannot tell
    anything.
    """
    notify = progress or (lambda *_: None)
    robot = prototype.robot
    run = excitation(robot, payload=payload, turn=turn, rate=prototype.hardware.camera.rate)
    log = excite(prototype, run, assistant, out / "excite.csv", progress=notify)
    _rest(prototype, assistant)
    known, lag = references(robot.length), drive_lag(log)
    before = [
        _track(prototype, path, robot, lag, out / f"{name}_before.csv", f"tracking before: {name}", notify)
        for name, path in known.items()
    ]
    result = identify(
        log, robot, progress=lambda what, done, total: notify(f"identification: {what}", done, total)
    )
    better = result.identified
    after = [
        _track(prototype, path, better, lag, out / f"{name}_after.csv", f"tracking after: {name}", notify)
        for name, path in known.items()
    ]
    return Loop(
        result=result,
        # what is in reach is for the better model to say, in both
        before=[
            tracking(name, run, replace(old, nearest=new.nearest))
            for name, (run, old), (_, new) in zip(known, before, after, strict=True)
        ],
        after=[tracking(name, run, new) for name, (run, new) in zip(known, after, strict=True)],
    )


def _rest(prototype: Prototype, assistant: BenchAssistant) -> None:
    """Load off, base as in the robot's file."""
    own = np.array(prototype.robot.base_quaternion)
    with prototype.resting():
        assistant.hang(0.0)
        assistant.rotate(own)
    prototype.payload, prototype.base_quaternion = 0.0, own


def _track(
    prototype: Prototype, path: Trajectory, model: Robot, lag: float, out: Path, stage: str, notify: Progress
) -> tuple[RunLog, InversePlan]:
    notify(f"{stage}, planning", 0, 2)
    made = planned(model, path)
    notify(stage, 1, 2)
    return follow(prototype, made, out, lead=lag), made
