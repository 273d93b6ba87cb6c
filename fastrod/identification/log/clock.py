"""Offset between the clock of the commands and that of the camera, before anything is fitted.

A drive or a camera that is late is an effect (`latency`). Commands that come after what they cause are no
effect of any robot: two clocks are off.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.registration import align, size
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import known_model
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.types import Ints

MARGIN = 0.2
"""Delay [s] that is left for the fit to find once commands are laid on the camera's clock, so that it may
come out smaller as well as larger: 0.54 mm of play made a first look 0.1 s wrong."""
LONGEST = 1.0
"""Offset that is looked for [s]."""
_STEPS = 10  # of the offsets on each side, and of each of these steps
_STRETCHES, _LASTS = 5, 7.0  # of time that are looked at; s
_FINEST, _COARSEST = 0.06, 0.25  # s between rows of these
_LEAST = 30  # of them compared
_FOLLOWS = 0.5  # of the motion
_BETTER = 0.8  # of what is left without it: less is the offset's merit


def clock_offset(samples: LogSamples, robot: Robot, threads: int | None = None) -> float:
    """Time by which commands stand later in the log than they acted [s]; 0 where they do not, or where the
    log does not show it."""
    stretches = _stretches(samples)
    if not stretches:
        return 0.0
    rows = np.concatenate(stretches)
    model, some = known_model(robot), samples.on(rows)
    pose = predict(model, model.start, some, PredictedRod(some, robot, threads=threads))
    time, made = samples.time[rows], np.where(pose.ok[:, None], pose.position, np.nan)
    tip = np.asarray(samples.log.tip_position)[rows]
    each = np.cumsum([0, *map(len, stretches)])

    def left(offset: float) -> float:
        """Distance that is left with the prediction from that much later rows [m]."""
        later = np.full_like(made, np.nan)
        for a, b in pairwise(each):
            inside = (time[a:b] + LONGEST <= time[b - 1]) & (time[a:b] - LONGEST >= time[a])
            for axis in range(3):
                at = np.interp(time[a:b] + offset, time[a:b], made[a:b, axis])
                later[a:b, axis] = np.where(inside, at, np.nan)
        known = np.isfinite(later).all(1) & np.isfinite(tip).all(1)
        return align(tip[known], later[known]).left if known.sum() >= _LEAST else np.inf

    rough = min(np.linspace(-LONGEST, LONGEST, 2 * _STEPS + 1), key=left)
    best = float(min(rough + np.linspace(-1.0, 1.0, 2 * _STEPS + 1) * LONGEST / _STEPS, key=left))
    step = float(np.median(np.diff(time)))
    # a model that does not follow says nothing of a clock
    least = min(_BETTER * left(0.0), _FOLLOWS * size(tip - np.median(tip, axis=0)))
    known = best > max(step, 2.0 * LONGEST / _STEPS**2) and left(best) < least
    return best if known else 0.0


def clock_sentence(log: RunLog, offset: float) -> str:
    """Say to a user what was found."""
    return (
        f"the commands of log {log.name!r} stand {offset:.2f} s later than the motion that they cause: "
        "commands and camera have two clocks"
    )


def _stretches(samples: LogSamples) -> list[Ints]:
    """Rows of stretches of time, evenly over the runs that are long enough and dense enough to tell an
    offset."""
    found: list[Ints] = []
    for span in samples.runs:
        time = samples.time[span]
        step = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
        if time[-1] < _LASTS or not 0.0 < step < _COARSEST:
            continue
        for first in np.linspace(0.0, time[-1] - _LASTS, _STRETCHES):
            inside = np.flatnonzero((time >= first) & (time <= first + _LASTS))
            rows = span.start + inside[:: max(1, round(_FINEST / step))]
            if len(rows) >= _LEAST:
                found.append(rows)
    return found[:: max(1, len(found) // _STRETCHES)][:_STRETCHES]
