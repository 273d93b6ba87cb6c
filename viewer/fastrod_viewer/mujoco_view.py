"""`MujocoView`: a scene in a MuJoCo model, played: its soft robot, and the geoms of everything else."""

from __future__ import annotations

from typing import Any, NoReturn, final

import numpy as np

from fastrod.errors import HostError, InputError
from fastrod.hosts.mujoco_body_contact import obstacle_of
from fastrod.model.robot import Robot
from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats
from fastrod_scenes.scene import MujocoScene
from fastrod_viewer.robots import actions_of, radii
from fastrod_viewer.world import Body, DrawnRods, ManualCommand, World

_GROUND = 2.0  # m, edge of a plane


@final
class MujocoView(World):
    """One scene, moved by its script alone."""

    drivable = False
    scripted = True
    host = True
    base_moves = False
    loads = False

    def __init__(self, scene: MujocoScene) -> None:
        """Raises `HostError` where MuJoCo is missing, and for a geom that `obstacle_of` refuses."""
        self.scene = scene
        self.name, self.about, self.dt, self.duration = scene.name, scene.about, scene.dt, scene.duration
        self.reset()
        self.robot: Robot = self._stage.rod.rod.robot
        self.actions = actions_of(self.robot)
        self._radius = radii(self.robot)
        model, own = self._stage.model, set(self._stage.rod.capsule_bodies)
        self._geoms = [g for g in range(model.ngeom) if model.geom_bodyid[g] not in own]
        self._bodies = tuple(_body(model, g) for g in self._geoms)

    @property
    def t(self) -> float:
        """Steps since the last reset times dt [s]."""
        return self._steps * self.dt

    @property
    def rods(self) -> tuple[DrawnRods, ...]:
        """The stage's one rod."""
        return (DrawnRods((self.robot,), self._stage.rod.rod.state, np.zeros((1, 3)), self._radius),)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """The model's geoms, the rod's capsules left out, each in its own frame."""
        return self._bodies

    def poses(self) -> Floats:
        """(n_bodies, 7) of the geoms' frames, world."""
        data = self._stage.data
        orientation = quaternion_from_matrix(data.geom_xmat[self._geoms].reshape(-1, 3, 3))
        return np.concatenate([data.geom_xpos[self._geoms], orientation], axis=1)

    def play(self) -> None:
        """One step of the script, or from its end back to its beginning. Raises `HostError` where the rod is
        lost, after a reset."""
        if self._steps >= round(self.duration / self.dt):
            self.reset()
            return
        try:
            self._stage.advance(self.t)
        except HostError:
            self.reset()
            raise
        self._steps += 1

    def drive(self, command: ManualCommand) -> NoReturn:  # noqa: ARG002
        """Raises `InputError`: only the script moves this world."""
        self._refuse()

    def jacobian(self) -> NoReturn:
        """Raises `InputError`: only the script moves this world."""
        self._refuse()

    def reset(self) -> None:
        """A new model and data, as the scene sets them up."""
        self._stage = self.scene.stage()
        self._steps = 0

    def close(self) -> None:
        """All is in MuJoCo's own arrays, which go with them."""

    def _refuse(self) -> NoReturn:
        raise InputError(
            f"scene {self.name!r} has a script that moves its robots; they cannot be driven by hand."
        )


def _body(model: Any, geom: int) -> Body:
    shape = obstacle_of(model, geom, f"geom {geom}")
    drawn = shape.as_trimesh()
    vertices = np.asarray(drawn.vertices) * (_GROUND if shape.shape == "plane" else 1.0)
    red, green, blue, alpha = model.geom_rgba[geom].tolist()
    color = (round(255.0 * red), round(255.0 * green), round(255.0 * blue))
    return Body(
        shape.name, vertices.astype(np.float32), np.asarray(drawn.faces).astype(np.uint32), color, alpha
    )
