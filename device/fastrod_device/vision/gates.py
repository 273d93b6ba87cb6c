"""`Workspace`: where the tip of a robot can be, by length and model; `FrameOrder`: which frames are new;
`Expectation`: where the model has the tip."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.types import Floats
from fastrod_device.vision.camera import Camera, CameraFrame

OUTSIDE, ASTRAY, TOO_FAST, TWICE = "outside the workspace", "far from the model", "too fast", "two markers"
"""Flags of sightings that are refused."""
FROZEN, REPEATED, BACK, AHEAD = "frozen", "repeated", "out of order", "from the future"
"""Flags of frames that say nothing new."""
_STRETCH = 0.05  # of the length: what registration and the lens may add to the tip's distance
_BENT = 2.0  # of the limit on curvature: what loads and friction may add to it
_ASTRAY = 0.5  # of the length: between the tip that is seen and the model's
_ROUNDED = 0.01  # s by which a source may round its stamps up
_KEPT = 20_000  # pictures that are known again: twenty minutes at 15 Hz


@final
@dataclass(frozen=True, kw_only=True)
class Workspace:
    """Bounds of a tip's position in the base frame, for every shape of the robot, and by its model.

    No shape is farther from the base than the backbone is long. A backbone whose curvature is at most k has
    turned by at most k s at arclength s, so its tip is at least the integral of cos(min(k s, pi)) high above
    the base plate: behind the plate only where it can turn that far. A passive segment bends without limit,
    and its robot comes as far down as up.

    `python perf/bench_camera.py` set the figures (its table "gates"): emulators of the 70 mm prototype behind
    every kind of sealed effect were driven to random bends at the full rate, with and without 30 g. In 5,397
    frames the tip was at most 1.005 lengths from the base (1.05 are allowed), at least 55 mm high (21 mm),
    and at most 0.33 lengths from the model's (0.5): that by a camera 150 ms late, 0.08 by anything else.
    """

    length: float
    """Largest distance of the tip from the base [m]."""
    height: float
    """Least height of the tip above the base plate [m]; negative is behind it."""
    astray: float
    """Largest distance of the tip from where the model has it [m]."""

    @classmethod
    def of(cls, robot: Robot, curvature: float) -> Workspace:
        """Bounds of `robot`, whose tendons may ask for `curvature` [1/m] in any segment."""
        length = [robot.length + sum(segment.extension[end] for segment in robot.segments) for end in (0, 1)]
        bent = 0.0
        for segment in robot.segments:
            own = math.inf if segment.mode == "passive" else math.hypot(*segment.precurvature[:2])
            bent = max(bent, own + _BENT * curvature)
        slack = _STRETCH * length[1]
        height = min(_height(bent, each) for each in length) - slack
        return cls(length=length[1] + slack, height=height, astray=_ASTRAY * length[1])

    def refusal(self, position: Floats, expected: Floats | None) -> str:
        """Flag of a tip (3,) that cannot be there [m]; "" where it can. `expected`: the model's, or None."""
        if not (float(np.linalg.norm(position)) <= self.length and position[2] >= self.height):
            return OUTSIDE
        if expected is not None and not float(np.linalg.norm(position - expected)) <= self.astray:
            return ASTRAY
        return ""


def _height(curvature: float, length: float) -> float:
    """Least height of the end of a curve that leaves the plate upright [m]: an arc, then straight down."""
    if curvature * length <= 0.0:
        return length
    arc = min(length, math.pi / curvature)
    return math.sin(curvature * arc) / curvature - (length - arc) if math.isfinite(curvature) else -length


@final
class FrameOrder:
    """Separates new frames from repeated, late and misdated ones.

    A camera draws no picture twice, so one that was there before is repeated, however it is stamped. A stamp
    must not run back, nor lie in the future. A frame whose stamp is not believed gets a time between the
    frame before and the one that is due, so that rows of a log stay in order and no later frame is refused by
    it.
    """

    def __init__(self, camera: Camera) -> None:
        """No frame was seen yet."""
        self._period, self._latency = 1.0 / camera.rate, camera.latency
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._number: int | None = None
        self._picture: int | None = None
        self._pictures: dict[int, None] = {}
        self._last = self._given = -math.inf

    def check(self, frame: CameraFrame, now: float | None) -> tuple[float, str]:
        """Time of the frame [s] and its flag, "" where it is new. `now`: the clock [s], or None."""
        picture = hash(frame.image.tobytes())
        t, stamp = self._time(frame, now)
        frozen = self._number is not None and (frame.number == self._number or picture == self._picture)
        known = picture in self._pictures
        self._pictures.pop(picture, None)  # the newest go to the end
        self._pictures[picture] = None
        if len(self._pictures) > _KEPT:
            del self._pictures[next(iter(self._pictures))]
        if frozen:
            return t, stamp if stamp == AHEAD else FROZEN
        late = self._number is not None and frame.number < self._number
        if not late and not stamp:
            self._number = frame.number
        self._picture = picture
        return t, stamp or (BACK if late else REPEATED if known else "")

    def _time(self, frame: CameraFrame, now: float | None) -> tuple[float, str]:
        if now is not None and not frame.t <= now + _ROUNDED:
            flag = AHEAD
        elif not frame.t >= self._given:
            flag = BACK
        else:
            self._last = self._given = frame.t
            return frame.t, ""
        if not math.isfinite(self._given):  # the first of all
            self._last = self._given = frame.t if now is None else now - self._latency
        else:
            self._given += 0.5 * (self._last + self._period - self._given)
        return self._given, flag


@final
class Expectation:
    """Expected pose of the tip by the model, so that the right one of a marker's two planar poses is
    taken: a robot without its effects, followed step by step, good to some degrees."""

    def __init__(self, robot: Robot) -> None:
        self._robot = replace(robot, effects=())
        self._simulator = Simulator(self._robot, dt=0.05, points_per_segment=8, threads=1, outputs="tip")
        self._cold = True

    def pose(
        self, dl: Floats, payload: float, base_quaternion: Floats | None
    ) -> tuple[Floats, Floats] | None:
        """(3,) [m] and (4,) base_from_tip for these tendons (n_tendons,) [m], a mass at the tip [kg] and
        world_from_base (4,); None where the tendons are not known or the model finds no rest."""
        if not np.isfinite(dl).all():
            return None
        base = np.array(self._robot.base_quaternion) if base_quaternion is None else base_quaternion
        lengths = self._robot.rest_tendon_length + dl
        inputs: dict[str, Any] = {
            "base_pose": np.concatenate([np.zeros(3), base]),
            "tip_force": payload * np.array(self._robot.gravity),
        }
        state = (
            self._simulator.settle(lengths, **inputs)
            if self._cold
            else self._simulator.step(lengths, **inputs)
        )
        self._cold = not bool(state.ok[0])
        if self._cold:
            return None
        base_from_world = matrix_from_quaternion(base).T
        return base_from_world @ state.tip_position[0], quaternion_from_matrix(
            (base_from_world @ state.tip_rotation[0])[None]
        )[0]
