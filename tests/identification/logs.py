"""Small logs of small robots, and the model that answers to them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from rods import rod

from fastrod import Robot, Tendon
from fastrod.identification.excite import excitation
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.logs.runlog import RunLog
from fastrod.model.routing import route


def one_segment(line_density: float = 0.0, **changes: Any) -> Robot:
    robot = rod(line_density=line_density, extension=(-0.01, 0.01))
    return replace(robot, name="one", log_points=(0.03,), **changes)


def one_sided() -> Robot:
    """Four elastic tendons that can only pull, two on a drive, on a body that shortens."""
    (segment,) = one_segment().segments
    tendons = tuple(
        Tendon(offset=0.006, angle=np.pi / 2.0 * k, compliance=6e-4, pretension=0.6, unilateral=True)
        for k in range(4)
    )
    whole = replace(segment, tendons=tendons, extension=(0.0, 0.0), axial_stiffness=80.0)
    return replace(one_segment(), segments=(whole,), log_points=())


def two_segments(line_density: float = 0.0, **changes: Any) -> Robot:
    """Antagonistic tendons, those of the far segment at places of their own in the near one."""
    (near,) = one_segment(line_density).segments
    routed = tuple(replace(t, offset=(0.006, 0.005), angle=(t.angle + 0.7, t.angle)) for t in near.tendons)
    far = replace(near, length=0.06, bending_stiffness=(0.0015, 0.002), tendons=routed)
    return Robot(name="two", segments=(near, far), log_points=(0.05, 0.1), **changes)


def displacement_of(robot: Robot, bends: np.ndarray) -> np.ndarray:
    """(n, n_tendons) dl of bends (n, n_segments, 2)."""
    return route(robot).tendon_change(bends)


def wave(robot: Robot, n: int, dt: float = 0.05, size: float = 0.7, seed: int = 0) -> np.ndarray:
    """(n, n_tendons) dl: every segment there and back at many amplitudes, with a hold."""
    t = dt * np.arange(n)
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, (robot.n_segments, 2))
    held = np.where((t > 0.3 * t[-1]) & (t < 0.4 * t[-1]), 0.3 * t[-1], t)
    way = np.sin(2.1 * held[:, None, None] + phase) * (0.6 + 0.4 * np.cos(0.7 * held[:, None, None]))
    return displacement_of(robot, size * way)


def log_of(robot: Robot, dl: np.ndarray, dt: float | np.ndarray = 0.05, **columns: Any) -> RunLog:
    """A run with these inputs, whose tip is at the base unless `columns` says where."""
    n = len(dl)
    t = dt * np.arange(n) if isinstance(dt, float) else np.cumsum(dt)
    given = {"name": "log", "run": np.full(n, ""), "tip_position": np.zeros((n, 3)), "t": t} | columns
    return RunLog(dl=dl, **given)


def bare_run(rate: float) -> LogSamples:
    """The designed run, its beginning once more at the end; no load, one base."""
    run = excitation(one_segment(), rate=rate).log
    return sample(replace(run, tip_position=np.zeros((len(run), 3)), payload=None, base_quaternion=None))


def runs_of(
    name: str = "log", labels: tuple[str, ...] = ("a", "b"), n: int = 40, begin: float = 5.0
) -> RunLog:
    """Runs of 4 s at 10 Hz, whose clocks begin at `begin`."""
    t = np.tile(begin + 0.1 * np.arange(n), len(labels))
    dl = np.full((n * len(labels), 4), 1e-3)
    return log_of(one_segment(), dl, name=name, t=t, run=np.repeat(labels, n))
