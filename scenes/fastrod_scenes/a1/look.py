"""A quadruped looks into a box, over its wall."""

from __future__ import annotations

import math
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from fastrod.hosts import Bullet, HostCamera, MountedRod
from fastrod.hosts.camera import Image
from fastrod.model.segment_actions import SegmentActions, TendonInputs
from fastrod_scenes.a1.quadruped import RADIUS, neck, standing
from fastrod_scenes.scene import HostedScene, SceneStage

PITCH = 0.9
"""Pitch of the neck's mount, above forward [rad]."""
STRETCH = 0.03
"""Stretch of each segment [m]."""
MIDDLE = (0.67, 0.0)
"""Middle of the box, world [m]."""
WIDTH, HEIGHT, WALL = 0.3, 0.26, 0.01
"""Size of the box inside, its walls and their thickness [m]."""
SWAY = 0.25
"""Bend of the neck to either side while it looks [rad]."""
CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
PIXELS = 20
"""A marker of which so many are in the picture has been seen."""


class Seen(NamedTuple):
    """Corners that the camera at the tip has seen so far."""

    pixels: NDArray[np.int64]
    """(4,) most pixels of each corner's marker in one picture."""
    depth_error: float
    """Largest difference of the depth picture from where a marker is [m]."""


@final
class _Look(SceneStage):
    def __init__(self, dt: float) -> None:
        self.world, self.mount = standing(dt, PITCH)
        self.walls = _box(self.world)
        self.markers = _markers(self.world)
        self.robot = neck(4, STRETCH)
        self.actions = SegmentActions(self.robot)
        self.camera = HostCamera(width=96, height=96, fov=80.0, near=0.01, far=2.0)
        self.rod = MountedRod(
            self.robot,
            self.mount,
            contact_bodies=self.walls,
            points_per_segment=8,
            capsules_per_segment=8,
            color=(0.9, 0.55, 0.15, 1.0),
            head_color=(0.15, 0.15, 0.2, 1.0),
        )
        self.rods = (self.rod,)
        self.rod.settle(**self.bends(0.0, 0.0))

    def bends(self, over: float, aside: float) -> TendonInputs:
        """`over` from 0 (straight) to 1 (the tip looks down), `aside` to the left [rad]; the same in every
        segment."""
        n = self.robot.n_segments
        action = np.zeros(self.actions.n_actions)
        action[0::3] = STRETCH * over
        action[1::3] = -(PITCH + 0.5 * math.pi) * over / n * self.actions.offset
        action[2::3] = -aside / n * self.actions.offset
        return self.actions.inputs(action)

    def advance(self, t: float) -> None:
        self.rod.step(**self.bends(*_script((t + self.world.dt) / NeckLook.duration)))

    def picture(self) -> Image:
        """Picture of the camera in the tip, which looks along the neck; d1 is up in it."""
        state = self.rod.state
        assert state is not None
        axes = state.tip_rotation[0]
        eye = state.tip_position[0] + (RADIUS + 0.002) * state.tip_rotation[0, :, 2]
        return self.camera.look(self.world, eye, eye + axes[:, 2], axes[:, 0])


def _script(fraction: float) -> tuple[float, float]:
    """Bend over the wall in the first two fifths of the run, look to both sides, and go back in the last two
    fifths."""
    over = min(1.0, 2.5 * fraction, 2.5 * (1.0 - fraction))
    return 0.5 - 0.5 * math.cos(math.pi * max(over, 0.0)), SWAY * math.sin(
        2.0 * math.pi * min(max(5.0 * (fraction - 0.4), 0.0), 1.0)
    )


def _box(world: Bullet) -> list[int]:
    """Four walls; the floor is that of the room."""
    half, walls = 0.5 * (WIDTH + WALL), []
    for x, y in ((half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half)):
        size = [WALL / 2, WIDTH / 2 + WALL, HEIGHT / 2] if x else [WIDTH / 2, WALL / 2, HEIGHT / 2]
        shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=size)
        picture = world.createVisualShape(world.GEOM_BOX, halfExtents=size, rgbaColor=[0.55, 0.6, 0.68, 1.0])
        walls.append(
            int(world.createMultiBody(0.0, shape, picture, [MIDDLE[0] + x, MIDDLE[1] + y, HEIGHT / 2]))
        )
    return walls


def _markers(world: Bullet) -> list[int]:
    """A ball in each corner on the floor; they are seen, and touch nothing."""
    colours = ([0.85, 0.1, 0.1, 1.0], [0.1, 0.65, 0.15, 1.0], [0.1, 0.25, 0.9, 1.0], [0.95, 0.8, 0.1, 1.0])
    found = []
    for (x, y), colour in zip(CORNERS, colours, strict=True):
        picture = world.createVisualShape(world.GEOM_SPHERE, radius=0.015, rgbaColor=colour)
        place = [MIDDLE[0] + x * (0.5 * WIDTH - 0.03), MIDDLE[1] + y * (0.5 * WIDTH - 0.03), 0.015]
        found.append(int(world.createMultiBody(0.0, -1, picture, place)))
    return found


@final
class NeckLook(HostedScene):
    """Unitree A1 with a neck of four segments and a camera in its tip."""

    name = "neck_look"
    about = (
        "A Unitree A1 bends its four-segment neck over the wall of a box and looks into every corner of it."
    )
    dt = 0.01
    duration = 4.0

    def stage(self) -> _Look:
        return _Look(self.dt)

    def check(self) -> dict[str, float]:
        stage = self.stage()
        world, rod = stage.world, stage.rod
        stood = np.array(world.getBasePositionAndOrientation(stage.mount.body)[0])
        outside = self._look(stage, Seen(np.zeros(4, np.int64), 0.0))
        seen = Seen(np.zeros(4, np.int64), 0.0)
        clearance = math.inf
        force = 0.0
        gave = 0.0
        lowest = math.inf
        weighed = 0.0
        carried, before = 0.0, stage.robot.length
        for t in self.play(stage):
            state = rod.state
            assert state is not None
            assert state.contacts is not None
            self.expect(bool(state.ok[0]), f"at {t:.3g} s the neck is not ok: {state.problems.get(0)}")
            clearance = min(clearance, float(state.contacts.clearance[0]))
            force = max(force, float(np.linalg.norm(state.contacts.total_force[0])))
            length = float(state.arclength[0, -1])
            weighed += self.dt / self.duration * (float(rod.wrench[2]) + 0.4 * length * 9.81)
            # what is paid out is as fast as what there was
            carries = float(rod.simulator.momentum()[0, 2])
            weighed += (carries - carried * length / before) / self.duration
            carried, before = carries, length
            gave = max(
                gave, float(np.linalg.norm(world.getBasePositionAndOrientation(stage.mount.body)[0] - stood))
            )
            lowest = min(lowest, float(state.tip_position[0, 2]))
            if 0.4 <= t / self.duration <= 0.6 and round(t / self.dt) % 5 == 0:
                seen = self._look(stage, seen)
        self.expect(clearance > 0.0, f"the neck touches the box; clearance {clearance:.3g} m.")
        self.expect(
            bool((outside.pixels == 0).all()),
            f"from outside {int((outside.pixels > 0).sum())} of the corners can be seen.",
        )
        count = int((seen.pixels >= PIXELS).sum())
        self.expect(
            count == len(CORNERS),
            f"{count} of {len(CORNERS)} corners were seen; pixels of each: {seen.pixels.tolist()}.",
        )
        self.expect(
            seen.depth_error < 0.02,
            f"the depth picture is {seen.depth_error:.3g} m off a marker; it is 0.015 m in radius.",
        )
        self.expect(lowest < HEIGHT, f"the tip comes down to {lowest:.3g} m; the wall is {HEIGHT:g} m high.")
        self.expect(
            abs(weighed) < 1e-4, f"in the mean the trunk feels {weighed:.3g} N more than the neck's weight."
        )
        self.expect(gave < 0.02, f"the trunk was pushed back by {gave:.3g} m.")
        return {
            "corners seen": float(count),
            "pixels of a marker, least": float(seen.pixels.min()),
            "depth off a marker, m": seen.depth_error,
            "clearance of the neck to the box, m": clearance,
            "force on the box, N": force,
            "tip below the wall's edge, m": HEIGHT - lowest,
            "trunk displacement, m": gave,
        }

    def _look(self, stage: _Look, so_far: Seen) -> Seen:
        picture = stage.picture()
        counts = np.array([(picture.segmentation == marker).sum() for marker in stage.markers])
        error, state = so_far.depth_error, stage.rod.state
        assert state is not None
        for marker, count in zip(stage.markers, counts, strict=True):
            if count >= PIXELS:
                eye = state.tip_position[0] + (RADIUS + 0.002) * state.tip_rotation[0, :, 2]
                ahead = float(
                    (np.array(stage.world.getBasePositionAndOrientation(marker)[0]) - eye)
                    @ state.tip_rotation[0, :, 2]
                )
                error = max(
                    error, abs(float(np.median(picture.depth[picture.segmentation == marker])) - ahead)
                )
        return Seen(np.maximum(so_far.pixels, counts), error)
