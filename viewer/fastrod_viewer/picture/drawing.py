"""`Drawing`: a world on a canvas, picture by picture."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import numpy as np

from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_matrix
from fastrod.types import Floats
from fastrod_viewer.drive.session import ViewFrame
from fastrod_viewer.picture.arrows import Trail, frames
from fastrod_viewer.picture.batches import Picture
from fastrod_viewer.picture.canvas import Canvas
from fastrod_viewer.picture.legend import Entry, legend
from fastrod_viewer.picture.options import FINE, ViewOptions
from fastrod_viewer.picture.palette import MEASURED, TRAIL
from fastrod_viewer.picture.scene_graph import bounds
from fastrod_viewer.picture.shapes import Instances, instances
from fastrod_viewer.worlds.world import World

_TRAIL = 100  # pieces
_GLASS = 0.3  # opacity of what the tip is inside of

_WIDE, _THIN = 1.15, 0.2  # of the body's radius: the plate that stands for a measured tip


@final
class Drawing:
    """Robots, surroundings, loads, the tip's trail, and what was measured beside them."""

    def __init__(
        self,
        canvas: Canvas,
        world: World,
        options: ViewOptions,
        *,
        trail: bool = True,
        measured: bool = False,
    ) -> None:
        """`measured`: frames will report where the tip was measured, and the legend says what that looks
        like."""
        self.canvas, self.world = canvas, world
        self.options, self.trail, self._tips = options, trail, measured
        rods = world.rods[0]
        self.middle, self.size = bounds(rods, world.bodies, world.poses())
        self.radius = max(rods.radius)
        """Radius of the robot's body [m]."""
        self._pictures = [Picture(r, options) for r in world.rods]
        self._trails = self._new_trails()
        self._track = Trail(_TRAIL, 0.3 * self.radius)
        self._ends: Floats = np.array(
            [[b.vertices.min(axis=0), b.vertices.max(axis=0)] for b in world.bodies]
        ).reshape(-1, 2, 3)
        canvas.clear()
        canvas.add_bodies(world.bodies, world.poses())
        lowest = min(float(r.state.position[..., 2].min()) for r in world.rods)
        if not any(body.name.startswith(("plane", "floor")) for body in world.bodies):
            canvas.floor(self.size, min(lowest, 0.0 if lowest > -1e-6 else lowest), self.middle)

    def look(self, options: ViewOptions, *, trail: bool) -> None:
        """Draw so from the next picture on."""
        if options != self.options:
            self._pictures = [Picture(rods, options) for rods in self.world.rods]
        self.options, self.trail = options, trail

    def forget(self) -> None:
        """The trail begins anew."""
        self._trails = self._new_trails()
        self._track.clear()

    @property
    def legend(self) -> str:
        """HTML of what the colours mean."""
        made = legend(self.world.rods[0], self.options, self._pictures[0])
        tips = (Entry("of the model", TRAIL), Entry("as measured", MEASURED)) if self._tips else ()
        return replace(made, tips=tips).html()

    def tip(self) -> Floats:
        """Return where the tip of the driven robot is drawn (3,) [m]."""
        rods = self.world.rods[0]
        return np.asarray(rods.state.tip_position[0] + rods.place[0])

    def draw(self, frame: ViewFrame) -> None:
        """One picture."""
        command = frame.command
        force = None
        if command is not None:
            weight = command.payload * command.gravity * np.array(self.world.robot.gravity)
            force = command.tip_force + weight
        for k, (rods, picture) in enumerate(zip(self.world.rods, self._pictures, strict=True)):
            shown = picture.frame(rods, tip_force=force if k == 0 else None)
            if self.trail:
                for i, (path, tip) in enumerate(
                    zip(self._trails[k], rods.state.tip_position + rods.place, strict=False)
                ):
                    path.add(tip)
                    shown[f"trail {i}"] = path.instances(0.12 * self.radius, TRAIL)
            self.canvas.show_all(shown, f"rod{k}/")
        poses = self.world.poses()
        self.canvas.move_bodies(poses)
        self._see_through(poses)
        self._measured(frame)
        text = (
            f"{np.linalg.norm(command.tip_force):.3g} N"
            if command is not None and command.tip_force.any()
            else ""
        )
        self.canvas.note("force", text, self.tip() + 1.5 * self.radius if text else None)

    def _see_through(self, poses: Floats) -> None:
        """Make see-through what the tip has entered."""
        if not len(poses):
            return
        tip = self.world.rods[0].state.tip_position[0]
        inside = np.einsum("nji,nj->ni", matrix_from_quaternion(poses[:, 3:]), tip - poses[:, :3])
        within = ((inside > self._ends[:, 0] - self.radius) & (inside < self._ends[:, 1] + self.radius)).all(
            axis=1
        )
        for k, body in enumerate(self.world.bodies):
            self.canvas.fade(k, min(body.opacity, _GLASS) if within[k] else body.opacity)

    def _measured(self, frame: ViewFrame) -> None:
        """Draw the tip that the robot itself reports: a plate with axes, and its trail."""
        now = frame.measured
        seen = now is not None and bool(np.isfinite(now.tip_position).all())
        if now is None or not seen:
            for name in ("measured", "measured axes"):
                self.canvas.show(name, None)
        else:
            rods = self.world.rods[0]
            base = rods.state.rotation[0, 0]
            place = rods.state.position[0, 0] + base @ now.tip_position + rods.place[0]
            self._track.add(place)
            upright = not np.isfinite(now.tip_quaternion).all()
            own = np.array([1.0, 0.0, 0.0, 0.0]) if upright else now.tip_quaternion
            orientation = product(quaternion_from_matrix(base[None])[0], own)
            self.canvas.show("measured", _plate(place, orientation, self.radius))
            self.canvas.show(
                "measured axes",
                None if upright else frames(place[None], orientation[None], 1.7 * self.radius),
            )
        self.canvas.show(
            "measured trail",
            self._track.instances(0.12 * self.radius, MEASURED) if self.trail and len(self._track) else None,
        )

    def _new_trails(self) -> list[list[Trail]]:
        """Make the trails of each robot, where they are few."""
        counts = [len(rods.state.tip_position) for rods in self.world.rods]
        return [[Trail(_TRAIL, 0.6 * self.radius) for _ in range(n if n <= FINE else 0)] for n in counts]


def _plate(place: Floats, orientation: Floats, radius: float) -> Instances:
    """Return a disc at `place` (3,), rotated by `orientation` (4,), somewhat larger than the tip of a body of
    `radius` [m]."""
    return instances("disc", place, orientation, radius * np.array([_WIDE, _WIDE, _THIN]), MEASURED)
