"""`ReplayDrawing`: one moment of a playback on a canvas; the models' rods, the measured tip, and the residual
between them."""

from __future__ import annotations

from typing import final

import numpy as np

from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.solver.state import State
from fastrod.types import Floats
from fastrod_viewer.page import PageView
from fastrod_viewer.picture.arrows import Trail, arrows, ghost
from fastrod_viewer.picture.batches import Picture
from fastrod_viewer.picture.canvas import Canvas
from fastrod_viewer.picture.legend import Entry, Legend
from fastrod_viewer.picture.options import ViewOptions
from fastrod_viewer.picture.palette import CONTACT, GHOST, MEASURED
from fastrod_viewer.picture.shapes import ball
from fastrod_viewer.replay.playback import Playback, PlayedShapes
from fastrod_viewer.worlds.robots import radii
from fastrod_viewer.worlds.world import DrawnRods

BOTH = "both"
"""In the place of a model's label: all of them, the last one in full."""
_TRAIL = 120  # pieces
_UPRIGHT = 0.7  # cosine of the base's tilt, beyond which a robot may hang below its base


@final
class ReplayDrawing:
    """Draws frames of a playback, one model in full, on request the other as a thin line beside it."""

    def __init__(self, canvas: Canvas, playback: Playback) -> None:
        self.canvas, self.playback = canvas, playback
        robot = playback.before.robot
        self.length = robot.length
        radius = radii(robot)
        self._radius = max(radius)
        self._rods = [self._first(k, track.robot, radius) for k, track in enumerate(playback.tracks)]
        self._pictures = [Picture(rods, ViewOptions(contacts=False, loads=False)) for rods in self._rods]
        self._trail = Trail(_TRAIL, 0.02 * robot.length)
        up = matrix_from_quaternion(playback.base_quaternion)[:, 2, 2].min() > _UPRIGHT
        middle, size, floor = (0.22, 0.95, 0.0) if up else (-0.4, 1.5, -1.15)
        self.sight = PageView(np.array([0.0, 0.0, middle * robot.length]), size * robot.length)
        """View of the robot in the upper half of the picture, above the plot, and all around its base where
        that rotates."""
        canvas.clear()
        canvas.floor(1.5 * robot.length, floor * robot.length, np.zeros(3))

    @property
    def legend(self) -> str:
        """HTML of what is what."""
        entries = [
            Entry("measured tip, and its trail", MEASURED),
            Entry("residual, from the predicted tip", CONTACT),
        ]
        if len(self.playback.tracks) > 1:
            entries.append(Entry("the model before", GHOST))
        return Legend("Measured beside predicted", "", tuple(entries)).html()

    def forget(self) -> None:
        """The trail begins anew."""
        self._trail.clear()

    def draw(self, frame: int, choice: str, magnify: float) -> None:
        """A frame, with the model of the label `choice`, or `BOTH`; the residual is drawn `magnify` times as
        long."""
        playback, last = self.playback, len(self.playback.tracks) - 1
        quaternion, row = playback.base_quaternion[frame], playback.frames[frame]
        orientation = matrix_from_quaternion(quaternion[None])[0]
        for k, (track, rods, picture) in enumerate(
            zip(playback.tracks, self._rods, self._pictures, strict=True)
        ):
            state = state_of(track.shapes, frame, quaternion, rods.robots[0].n_tendons)
            full = choice == track.label or (choice == BOTH and k == last)
            self.canvas.show_all(picture.frame(rods._replace(state=state)) if full else {}, f"model{k}/")
            thin = (
                ghost(state.position[0], 0.12 * self._radius, GHOST) if choice == BOTH and not full else None
            )
            self.canvas.show(f"ghost{k}", thin)
        shown = next((track for track in playback.tracks if track.label == choice), playback.tracks[last])
        measured, predicted = orientation @ playback.measured_tip[row], orientation @ shown.tip_position[row]
        self._measured(measured)
        self._residual(measured, predicted, magnify)

    def _first(self, k: int, robot: Robot, radius: tuple[float, ...]) -> DrawnRods:
        state = state_of(self.playback.tracks[k].shapes, 0, self.playback.base_quaternion[0], robot.n_tendons)
        return DrawnRods((robot,), state, np.zeros((1, 3)), radius)

    def _measured(self, tip: Floats) -> None:
        if not np.isfinite(tip).all():
            self.canvas.show("measured", None)
            return
        self._trail.add(tip)
        self.canvas.show("measured", ball(tip, 0.45 * self._radius, MEASURED))
        self.canvas.show("measured_trail", self._trail.instances(0.1 * self._radius, MEASURED))

    def _residual(self, measured: Floats, predicted: Floats, magnify: float) -> None:
        residual = measured - predicted
        if not np.isfinite(residual).all():
            self.canvas.show_all({}, "residual/")
            self.canvas.note("residual", "", None)
            return
        size = float(np.linalg.norm(residual))
        along = residual[None] / max(size, 1e-12)
        shaft, head = arrows(predicted[None], along, np.array([magnify * size]), 0.08 * self._radius, CONTACT)
        self.canvas.show_all({"shaft": shaft, "head": head}, "residual/")
        self.canvas.note(
            "residual", f"{1e3 * size:.2f} mm", measured + np.array([0.0, 0.0, 1.2 * self._radius])
        )


def state_of(shapes: PlayedShapes, frame: int, quaternion: Floats, n_tendons: int) -> State:
    """The rod of one frame as a `State` in the world of `quaternion` (4,) world_from_log; tensions, which a
    log does not hold, are nan."""
    orientation = matrix_from_quaternion(quaternion[None])[0]
    position, rotation = shapes.position[frame] @ orientation.T, orientation @ shapes.rotation[frame]
    arclength = shapes.arclength[frame]
    step = np.diff(arclength)
    relative = np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]
    small = [
        relative[:, 2, 1] - relative[:, 1, 2],
        relative[:, 0, 2] - relative[:, 2, 0],
        relative[:, 1, 0] - relative[:, 0, 1],
    ]
    bend = 0.5 * np.stack(small, axis=1) / step[:, None]
    none, unknown = np.zeros((1, len(position), 3)), np.full((1, n_tendons), np.nan)
    return State(
        position=position[None],
        rotation=rotation[None],
        curvature=np.concatenate([bend, bend[-1:]])[None],
        arclength=arclength[None],
        moment=none,
        force=none,
        tip_position=position[None, -1],
        tip_rotation=rotation[None, -1],
        tension=unknown,
        path_length=unknown,
        base_wrench=np.zeros((1, 6)),
        residual=np.zeros(1),
        ok=shapes.ok[frame : frame + 1],
        passes=np.ones(1, np.int64),
        problems={},
    )
