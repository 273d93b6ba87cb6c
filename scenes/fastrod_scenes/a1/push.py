"""A quadruped pushes a cube over the floor with its neck."""

from __future__ import annotations

import math
from typing import final

import numpy as np
from numpy.typing import NDArray

from fastrod.hosts import Bullet, MountedRod
from fastrod.model.segment_actions import SegmentActions, TendonInputs
from fastrod_scenes.a1.quadruped import neck, standing
from fastrod_scenes.scene import HostedScene, SceneStage

SIZE, MASS = 0.08, 0.05
"""Edge [m] and mass [kg] of the cube."""
PLACE = (0.36, 0.0, SIZE / 2)
"""Place of its middle at first, world [m]."""
PITCH = -1.4
"""Pitch of the neck's mount [rad]."""
SWING = 1.1
"""Amplitude of the neck's bend, all segments together [rad]."""
STRETCH = 0.024
"""Stretch of each segment where the neck is bent most: a bent neck is shorter, and its tip would rise [m]."""
RATE = 2.0
"""omega of its gait [rad/s]."""
FOLLOWS = 0.1
"""Largest difference of the cube's speed from the tip's while it is pushed (rms), as a fraction of the tip's
largest: the tip slides up the cube as it swings."""
LAUNCH = 1.3
"""Largest speed of the cube, of the tip's."""
STANDS = 0.02
"""Largest displacement of the trunk [m]."""


@final
class _Push(SceneStage):
    def __init__(self, dt: float) -> None:
        self.world, mount = standing(dt, PITCH)
        self.cube = _cube(self.world)
        self.mount = mount
        self.robot = robot = neck(3, STRETCH)
        self.actions = SegmentActions(robot)
        self.rod = MountedRod(
            robot,
            mount,
            contact_bodies=[self.cube],
            points_per_segment=8,
            capsules_per_segment=8,
            color=(0.9, 0.55, 0.15, 1.0),
        )
        self.rods = (self.rod,)
        self.rod.settle(**self.gait(0.0))

    def gait(self, t: float) -> TendonInputs:
        """Back and forth in the sagittal plane, back at first, the same in every segment."""
        swing = math.sin(RATE * t - 0.5 * math.pi)
        action = np.zeros(self.actions.n_actions)
        action[0::3] = STRETCH * swing**2
        action[1::3] = SWING * swing / self.actions.robot.n_segments * self.actions.offset
        return self.actions.inputs(action)

    def advance(self, t: float) -> None:
        self.rod.step(**self.gait(t + self.world.dt))


def _cube(world: Bullet) -> int:
    half = [SIZE / 2] * 3
    shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=half)
    picture = world.createVisualShape(world.GEOM_BOX, halfExtents=half, rgbaColor=[0.2, 0.45, 0.8, 1.0])
    body = int(world.createMultiBody(MASS, shape, picture, list(PLACE)))
    world.changeDynamics(body, -1, lateralFriction=0.5, linearDamping=0.0, angularDamping=0.0)
    return body


@final
class NeckPush(HostedScene):
    """Unitree A1 with a neck of three segments that swings as sin(omega t)."""

    name = "neck_push"
    about = (
        "A Unitree A1 swings its three-segment neck as sin(w t) and pushes a cube over the floor, which "
        "its legs feel."
    )
    dt = 0.005
    duration = 2.0 * math.pi / RATE

    def stage(self) -> _Push:
        return _Push(self.dt)

    def check(self) -> dict[str, float]:
        stage = self.stage()
        world, rod, cube = stage.world, stage.rod, stage.cube
        weight = 0.4 * stage.robot.length * 9.81
        stood = np.array(world.getBasePositionAndOrientation(stage.mount.body)[0])
        start, before = np.array(PLACE), np.zeros(3)
        tips: list[NDArray[np.float64]] = []
        speeds: list[tuple[float, float, bool]] = []
        balance, momentum, pushed, gave, depth = np.zeros(3), 0.0, 0.0, 0.0, 0.0
        carried, weighed = np.zeros(3), weight
        for t in self.play(stage):
            state = rod.state
            assert state is not None
            assert state.contacts is not None
            self.expect(bool(state.ok[0]), f"at {t:.3g} s the neck is not ok: {state.problems.get(0)}")
            force = rod.body_contacts[0].exerted[:3]
            extended = weight * state.arclength[0, -1] / stage.robot.length
            fraction = self.dt / self.duration
            balance = balance + fraction * (rod.wrench[:3] + force - [0.0, 0.0, -extended])
            # what is paid out is as fast as what there was
            carries = rod.simulator.momentum()[0, :3]
            balance = balance + (carries - carried * extended / weighed) / self.duration
            carried, weighed = carries, extended
            velocity = np.array(world.getBaseVelocity(cube)[0])
            given = self.dt * (force + _floor_force(world, cube) - [0.0, 0.0, 9.81 * MASS])
            momentum = max(momentum, float(np.abs(MASS * (velocity - before) - given).max()))
            pushed += self.dt * float(force[0])
            before = velocity
            tips.append(state.tip_position[0])
            if len(tips) > 1:
                speeds.append(
                    (
                        float(velocity[0]),
                        float(tips[-1][0] - tips[-2][0]) / self.dt,
                        bool(state.contacts.count[0]),
                    )
                )
            gave = max(
                gave, float(np.linalg.norm(world.getBasePositionAndOrientation(stage.mount.body)[0] - stood))
            )
            depth = max(depth, float(np.nan_to_num(-state.contacts.gap, nan=0.0).max(initial=0.0)))
            moved = world.getBasePositionAndOrientation(cube)[0][0] - start[0]
        own, tip, touching = (np.array(column) for column in zip(*speeds, strict=True))
        pressing = touching & (tip > 0.2 * tip.max())
        self.expect(
            moved > SIZE, f"the cube moved {moved:.3g} m; the neck is to push it farther than it is wide."
        )
        self.expect(
            bool((np.abs(balance) < 1e-3).all()),
            f"in the mean the trunk feels {balance.round(5)} N more than the neck's weight and what pushes "
            "the cube.",
        )
        self.expect(
            momentum < 1e-6,
            f"the cube's momentum changes by {momentum:.3g} N s beside the "
            "impulses of neck, floor and weight.",
        )
        self.expect(
            pressing.sum() * self.dt > 0.3, f"the neck pushes for {pressing.sum() * self.dt:.3g} s only."
        )
        follows = float(np.sqrt(np.mean((own - tip)[pressing] ** 2)) / tip.max())
        self.expect(
            follows < FOLLOWS,
            f"the cube's speed differs by {100 * follows:.3g} % (rms) of the tip's largest from the tip's.",
        )
        launch = float(own.max() / tip.max())
        self.expect(launch < LAUNCH, f"the cube moves {launch:.3g} times as fast as the tip ever does.")
        self.expect(gave < STANDS, f"the trunk was pushed back by {gave:.3g} m.")
        return {
            "cube moved, m": float(moved),
            "impulse of the neck on the cube, N s": pushed,
            "balance of forces at the trunk, N": float(np.abs(balance).max()),
            "balance of the cube's momentum, N s": momentum,
            "cube's speed off the tip's while pushing, rms, fraction of its largest": follows,
            "cube's largest speed over the tip's": launch,
            "trunk displacement, m": gave,
            "cube displacement within a step, m": depth,
        }


def _floor_force(world: Bullet, body: int) -> NDArray[np.float64]:
    """(3,) of all contacts on a body in the last step, world [N]; PyBullet reports friction as it acts on the
    other body."""
    total = np.zeros(3)
    for contact in world.getContactPoints(bodyA=body):
        normal = contact[7]
        size = contact[9]
        first = contact[10]
        along = contact[11]
        second = contact[12]
        across = contact[13]
        total += size * np.array(normal) - first * np.array(along) - second * np.array(across)
    return total
