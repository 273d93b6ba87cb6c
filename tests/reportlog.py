"""A small log of a robot whose tendons have play: 28 s in three runs, seconds to identify."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fastrod.identification.log.replay import replay
from fastrod.logs.runlog import RunLog
from fastrod.model.robotfile import load_robot
from fastrod.model.routing import route

GAP = 3e-4
"""Half width of the play [m]."""


def backlash_log() -> RunLog:
    """420 samples of the prototype: rest, then two bends at different periods; 0.2 mm of noise an axis."""
    robot = load_robot("prototype")
    t = np.arange(420) / 15.0
    size = np.interp(t, [0.0, 3.0, 28.0], [0.0, 0.8, 0.25])
    x, y = size * np.sin(2.0 * np.pi * t / 4.2), 0.5 * size * np.cos(2.0 * np.pi * t / 6.7)
    bend = np.stack([x, y], axis=1)
    bend[:45] = 0.0
    dl = route(robot).tendon_change(bend[:, None])
    felt, at = np.empty_like(dl), dl[0]
    for i, commanded in enumerate(dl):
        felt[i] = at = np.clip(at, commanded - GAP, commanded + GAP)
    run = np.repeat(["one", "two", "three"], 140)
    log = RunLog(name="small", t=t, run=run, dl=felt, tip_position=np.zeros((420, 3)))
    tip = replay(log, robot).tip_position + np.random.default_rng(1).normal(0.0, 2e-4, (420, 3))
    return replace(log, dl=dl, tip_position=tip)
