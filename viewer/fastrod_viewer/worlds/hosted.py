"""`StagedView`: a scene in the world of a physics engine, played; `HostedView`: one in PyBullet, also driven
by hand: its soft robots, the arm that carries them, and its other bodies."""

from __future__ import annotations

from typing import Any, NoReturn, final

import numpy as np
from numpy.typing import NDArray

from fastrod.control import SoftTip
from fastrod.errors import HostError, InputError
from fastrod.hosts import BulletArm, MountedRod, Visuals
from fastrod.hosts.mujoco_body_contact import obstacle_of
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_matrix, quaternion_from_vector
from fastrod.types import Floats
from fastrod_scenes.scene import (
    HostedScene,
    HostedWorld,
    MujocoScene,
    MujocoStage,
    SceneStage,
    SoftBody,
    Stage,
    StagedScene,
)
from fastrod_viewer.worlds.robots import Loads, actions_of, moved, radii, tendon_inputs
from fastrod_viewer.worlds.world import Body, DrawnRods, ManualCommand, World

SWING = 1.0
"""Largest displacement of a joint to a commanded flange pose [rad]: what is farther is another posture of the
arm."""
_INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # of a unit quaternion w x y z


class StagedView(World):
    """One scene, played in a world of its own, again and again."""

    scripted = True
    host = True
    _stage: Stage

    def __init__(self, scene: StagedScene) -> None:
        """Raises `HostError` where the physics engine is missing."""
        self.scene = scene
        self.name, self.about, self.dt, self.duration = scene.name, scene.about, scene.dt, scene.duration
        self._set_up()
        self.robot: Robot = self._soft[0].robot
        self.actions = actions_of(self.robot)
        self._radius = [radii(soft.robot) for soft in self._soft]

    @property
    @final
    def t(self) -> float:
        """Steps since the last reset, by hand or by script, times dt [s]."""
        return self._steps * self.dt

    @property
    @final
    def rods(self) -> tuple[DrawnRods, ...]:
        """The stage's soft robots, where they are in the world: none is drawn elsewhere."""
        still = np.zeros((1, 3))
        return tuple(
            DrawnRods((soft.robot,), soft.state, still, radius)
            for soft, radius in zip(self._soft, self._radius, strict=True)
        )

    @final
    def play(self) -> None:
        """Play one step of the script; from its end, or after a manual command, go back to its beginning.
        Raises `HostError` where the rod is lost, after a reset."""
        if self._driven or self._steps >= round(self.duration / self.dt):
            self.reset()
            return
        try:
            self._stage.advance(self.t)
        except HostError:
            self.reset()
            raise
        self._arrived()

    @final
    def reset(self) -> None:
        """A new world, as the scene sets it up; the old one is closed."""
        self.close()
        self._set_up()

    @final
    def close(self) -> None:
        """Let go of the world; once more does nothing."""
        self._stage.close()

    def _set_up(self) -> None:
        self._stage = self.scene.stage()
        self._soft: tuple[SoftBody, ...] = self._stage.soft_bodies
        self._steps, self._driven = 0, False

    def _arrived(self) -> None:
        self._soft = self._stage.soft_bodies
        self._steps += 1

    def _not_driven(self, what: str = "they cannot be driven by hand.") -> InputError:
        return InputError(f"scene {self.name!r} has a script that moves its robots; {what}")


@final
class HostedView(StagedView):
    """Manual commands drive the first soft robot and the arm that carries it; other soft robots keep their
    last inputs.

    After a manual command, the script begins anew with the next `play`. Worlds whose soft robot is no
    `MountedRod` only play.
    """

    _stage: HostedWorld
    _kinematics: SoftTip | None
    _joints: Floats | None
    """Joints of the arm where manual commands drive it."""
    _base: Floats | None
    """The last that the arm has followed; None: something else has moved it since."""
    _frozen: bool

    def __init__(self, scene: HostedScene) -> None:
        """Raises `HostError` where PyBullet is missing."""
        super().__init__(scene)
        self._home: Floats = np.zeros(7)  # of the flange, where ManualCommand.base is zero
        self.drivable = self.loads = isinstance(self._stage, SceneStage)
        self.host = self.base_moves = isinstance(self._stage, SceneStage) and self._stage.arm is not None
        self._loads = Loads(self.robot, hosted=True)
        self._bodies = tuple(
            Body(shape.name, shape.vertices, shape.faces, _color(shape.rgba), shape.rgba[3])
            for shape in self._visuals.shapes
        )

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Visual shapes of the first stage, the soft robots' capsules left out; a reset brings the same
        again."""
        return self._bodies

    def poses(self) -> Floats:
        """(n_bodies, 7) of their links' URDF frames, world."""
        return self._visuals.poses()

    def drive(self, command: ManualCommand) -> None:
        """Do one step of a manual command. Where the arm cannot follow, it stays, the step is done, and
        `HostError` then says why; where the soft robot is lost the world is reset. Raises `InputError` for a
        command that no robot can follow; the world then has not moved."""
        stage = self._stage
        if not isinstance(stage, SceneStage):
            raise self._not_driven()
        given = self._loads.added(tendon_inputs(self.robot, command), command)
        moved(np.zeros(7), command.base)  # refuses what is no motion
        refused: HostError | None = None
        if stage.arm is not None:
            try:
                self._drive_arm(stage.arm, command)
            except HostError as error:
                refused = error
        try:
            for k, rod in enumerate(stage.rods):
                rod.begin(**(given if k == 0 else {}))
            stage.world.stepSimulation()
            for rod in stage.rods:
                rod.end()
            stage.follow_arm()
        except HostError:
            self.reset()
            raise
        self._driven = True
        self._arrived()
        if refused is not None:
            raise refused

    def jacobian(self) -> Floats:
        """(3, n_joints + n_actions): the arm's joints, then the actions; the columns of an arm that is frozen
        are zero. Raises `InputError` where there is none."""
        if not isinstance(self._stage, SceneStage):
            raise self._not_driven("there is no Jacobian for a drag.")
        if self.actions is None:
            raise InputError(
                f"robot {self.robot.name!r} is not driven by tendon lengths, so no drag can move its tip."
            )
        rod, arm = self._stage.rods[0], self._stage.arm
        if arm is None:
            jacobian = np.asarray(rod.simulator.jacobian()[0, :3] @ self.actions.matrix)
            if not np.isfinite(jacobian).all():
                raise InputError(
                    f"there is no Jacobian here: {self._soft[0].state.problems.get(0, 'the robot is not ok')}"
                )
            return jacobian
        if self._kinematics is None:
            self._kinematics = SoftTip(rod.simulator, arm, flange_from_base=_mount(arm, rod))
        # the tip's displacement by an action is the simulator's own
        q = np.concatenate([arm.position(), np.zeros(self.actions.n_actions)])
        self._kinematics.follow(q, self._soft[0].state, _unit(rod.host.motion().pose))
        jacobian = self._kinematics.jacobian()
        if self._frozen:
            jacobian[:, : arm.n_joints] = 0.0
        return jacobian

    def picture(self) -> NDArray[np.uint8] | None:
        """(height, width, 3) of the stage's own camera, where it has one."""
        image = self._stage.picture()
        return None if image is None else image.rgb

    def _set_up(self) -> None:
        super()._set_up()
        self._visuals = Visuals(self._stage.world, {body for soft in self._soft for body in soft.capsules})
        self._kinematics = self._joints = self._base = None
        self._frozen = False

    def _drive_arm(self, arm: BulletArm, command: ManualCommand) -> None:
        """Command the motors. Raises `HostError` where the flange cannot go there; the command before then
        holds."""
        if self._joints is None:
            self._joints = np.clip(arm.position(), arm.lower, arm.upper)
            self._home, self._base = arm.frame(self._joints), np.zeros(6)
        if command.freeze:
            if not self._frozen:
                arm.freeze()
                self._joints = np.clip(arm.position(), arm.lower, arm.upper)
            self._frozen, self._base = True, None
            return
        self._frozen = False
        base = np.asarray(command.base, dtype=np.float64)
        if command.base_rate is not None:
            rate = np.asarray(command.base_rate, dtype=np.float64)
            if rate.shape != (arm.n_joints,) or not np.isfinite(rate).all():
                raise HostError(
                    f"ManualCommand.base_rate is {command.base_rate!r}; give {arm.n_joints} finite numbers, "
                    "one a joint [rad/s]."
                )
            self._joints, self._base = np.clip(self._joints + self.dt * rate, arm.lower, arm.upper), None
            arm.drive(self._joints)
            return
        if self._base is None:  # from here the commanded base continues
            flange = arm.frame(self._joints)
            back = quaternion_from_vector(base[3:]) * _INVERSE
            self._home = np.concatenate([flange[:3] - base[:3], product(back, flange[3:])])
        elif not np.array_equal(base, self._base):
            to = arm.solve(moved(self._home, base), self._joints)
            if (far := float(np.abs(to - self._joints).max())) > SWING:
                raise HostError(
                    f"the flange would get there by a swing of {far:.2g} rad of one joint, into another "
                    "posture; the arm stays."
                )
            self._joints = to
        self._base = base.copy()
        arm.drive(self._joints)


def _mount(arm: BulletArm, rod: MountedRod) -> Floats:
    """(7,) flange_from_base of a rod on an arm."""
    flange, base = arm.frame(arm.position()), rod.host.motion().pose
    orientation = matrix_from_quaternion(flange[None, 3:])[0]
    mount: Floats = np.concatenate(
        [(base[:3] - flange[:3]) @ orientation, product(flange[3:] * _INVERSE, base[3:])]
    )
    return _unit(mount)


def _unit(pose: Floats) -> Floats:
    """With a quaternion of norm 1: PyBullet's is so to single precision."""
    return np.concatenate([pose[:3], pose[3:] / np.linalg.norm(pose[3:])])


def _color(rgba: Any) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * c) for c in rgba[:3])
    return red, green, blue


_GROUND = 2.0  # m, edge of a plane


@final
class MujocoView(StagedView):
    """Moved by the scene's script alone."""

    drivable = False
    base_moves = False
    loads = False
    _stage: MujocoStage

    def __init__(self, scene: MujocoScene) -> None:
        """Raises `HostError` where MuJoCo is missing, and for a geom that `obstacle_of` refuses."""
        super().__init__(scene)
        model, own = self._stage.model, set(self._soft[0].capsules)
        self._geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] not in own]
        self._bodies = tuple(_body(model, g) for g in self._geoms)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The model's geoms, the rod's capsules left out, each in its own frame."""
        return self._bodies

    def poses(self) -> Floats:
        """(n_bodies, 7) of the geoms' frames, world."""
        data = self._stage.data
        orientation = quaternion_from_matrix(data.geom_xmat[self._geoms].reshape(-1, 3, 3))
        return np.concatenate([data.geom_xpos[self._geoms], orientation], axis=1)

    def drive(self, command: ManualCommand) -> NoReturn:  # noqa: ARG002
        """Raises `InputError`: only the script moves this world."""
        raise self._not_driven()

    def jacobian(self) -> NoReturn:
        """Raises `InputError`: only the script moves this world."""
        raise self._not_driven()


def _body(model: Any, geom: int) -> Body:
    shape = obstacle_of(model, geom, f"geom {geom}")
    drawn = shape.as_trimesh()
    vertices = np.asarray(drawn.vertices) * (_GROUND if shape.shape == "plane" else 1.0)
    red, green, blue, alpha = model.geom_rgba[geom].tolist()
    color = (round(255.0 * red), round(255.0 * green), round(255.0 * blue))
    return Body(
        shape.name, vertices.astype(np.float32), np.asarray(drawn.faces).astype(np.uint32), color, alpha
    )
