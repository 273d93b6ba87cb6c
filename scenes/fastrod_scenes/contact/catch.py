"""A soft robot that hangs from a post catches a cube: its hook closes around it, and holds it."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import numpy as np

from fastrod.hosts import BulletLink, MountedRod, connect
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.model.segment_actions import SegmentActions, TendonInputs
from fastrod_scenes.scene import HostedScene, SceneStage
from fastrod_scenes.ur5.carried import eased

HEIGHT = 0.6
"""Height of the mount, from which the robot hangs along -z [m]."""
STIFFNESS, DENSITY, DAMPING = 0.02, 0.1, 5e-3
"""EI [N m^2], line density [kg/m] and damping time [s] of the robot."""
SIZE, MASS, FRICTION = 0.06, 0.03, 0.8
"""Edge [m], mass [kg] and friction of the cube."""
START, SPEED = (0.29, 0.0, 0.319), (-0.6, 0.0, 1.74)
"""Place [m] and velocity [m/s] from which the cube is thrown, world."""
OPEN, CLOSED = 2.7, 6.0
"""Bend of the last three segments together, before and after [rad]."""
BEGINS, TAKES = 0.25, 0.3
"""Begin of the closing, and how long it takes [s]."""
STILL, MEAN = 0.02, 0.2
"""Largest speed of the cube at the end [m/s]; time over which forces are meant, before the end [s]."""
_CURLED = np.array([0.0, 0.0, 1.0, 1.0, 1.0]) / 3.0  # of the bend, by segment


def _robot() -> Robot:
    robot = load_robot("five_segment_reacher")
    segments = tuple(
        replace(
            segment,
            bending_stiffness=(STIFFNESS, STIFFNESS),
            torsional_stiffness=0.8 * STIFFNESS,
            line_density=DENSITY,
            damping_time=DAMPING,
        )
        for segment in robot.segments
    )
    return replace(robot, name="catcher", segments=segments)


@final
class _Catch(SceneStage):
    def __init__(self, dt: float) -> None:
        self.world, robot = connect(dt=dt), _robot()
        self.cube = self._box(MASS, [SIZE / 2] * 3, START, [0.2, 0.45, 0.8, 1.0])
        self.world.changeDynamics(
            self.cube, -1, lateralFriction=FRICTION, linearDamping=0.0, angularDamping=0.0
        )
        post = self._box(0.0, [0.04, 0.04, 0.01], (0.0, 0.0, HEIGHT + 0.01), [0.4, 0.4, 0.45, 1.0])
        self.actions = SegmentActions(robot)
        self.rod = MountedRod(
            robot,
            BulletLink(self.world, post, position=(0.0, 0.0, -0.01), quaternion=(0.0, 1.0, 0.0, 0.0)),
            contact_bodies=[self.cube],
            points_per_segment=8,
            capsules_per_segment=8,
            color=(0.9, 0.55, 0.15, 1.0),
        )
        self.rods = (self.rod,)
        self.rod.settle(**self.hook(0.0))
        self.world.resetBaseVelocity(self.cube, list(SPEED), [0.0, 0.0, 0.0])

    def _box(self, mass: float, half: list[float], place: tuple[float, ...], color: list[float]) -> int:
        shape = self.world.createCollisionShape(self.world.GEOM_BOX, halfExtents=half)
        picture = self.world.createVisualShape(self.world.GEOM_BOX, halfExtents=half, rgbaColor=color)
        return int(self.world.createMultiBody(mass, shape, picture, list(place)))

    def hook(self, t: float) -> TendonInputs:
        """Open, then closed, eased."""
        bend = OPEN + (CLOSED - OPEN) * eased((t - BEGINS) / TAKES)
        action = np.zeros(self.actions.n_actions)
        action[1::3] = bend * _CURLED * self.actions.offset
        return self.actions.inputs(action)

    def advance(self, t: float) -> None:
        self.rod.step(**self.hook(t + self.world.dt))


@final
class CatchCube(HostedScene):
    """Rod, contact and cube are solved together, in steps of 4 ms."""

    name = "catch"
    about = "A soft robot that hangs from a post catches a thrown cube: its hook closes and holds it."
    dt = 0.004
    duration = 1.6

    def stage(self) -> _Catch:
        return _Catch(self.dt)

    def check(self) -> dict[str, float]:
        stage = self.stage()
        world, rod, cube = stage.world, stage.rod, stage.cube
        before, momentum, passes = np.array(SPEED), 0.0, []
        last, count, holds, bears, fraction = 0.0, 0, 0.0, 0.0, self.dt / MEAN
        for t in self.play(stage):
            state = rod.state
            assert state is not None
            assert state.contacts is not None
            self.expect(bool(state.ok[0]), f"at {t:.3g} s the rod is lost: {state.problems.get(0)}")
            velocity = np.array(world.getBaseVelocity(cube)[0])
            given = self.dt * (rod.body_contacts[0].exerted[:3] - [0.0, 0.0, 9.81 * MASS])
            momentum = max(momentum, float(np.abs(MASS * (velocity - before) - given).max()))
            before, last, count = velocity, float(np.linalg.norm(velocity)), int(state.contacts.count[0])
            passes.append(float(state.passes[0]))
            if t > self.duration - MEAN + 0.5 * self.dt:
                holds += fraction * float(rod.body_contacts[0].exerted[2])
                bears -= fraction * float(rod.wrench[2])
        weight, together = 9.81 * MASS, 9.81 * (MASS + DENSITY * _robot().length)
        self.expect(
            momentum < 1e-6, f"the cube's momentum changes by {momentum:.3g} N s beside what acts on it."
        )
        self.expect(count >= 3, f"the hook holds the cube at {count} places only.")
        self.expect(last < STILL, f"the cube still moves at {last:.3g} m/s.")
        self.expect(
            abs(holds - weight) < 0.02 * weight,
            f"the hook holds {holds:.4f} N; the cube weighs {weight:.4f} N.",
        )
        self.expect(
            abs(bears - together) < 0.02 * together,
            f"the post bears {bears:.4f} N; robot and cube weigh {together:.4f} N.",
        )
        return {
            "speed of the cube at the end, m/s": last,
            "force of the hook, N": holds,
            "weight of the cube, N": weight,
            "force on the post, N": bears,
            "weight of both, N": together,
            "balance of the cube's momentum, N s": momentum,
            "contacts at the end": float(count),
            "passes, most": max(passes),
            "passes, mean": float(np.mean(passes)),
        }
