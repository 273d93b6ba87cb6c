"""`MujocoView`: a scene in a MuJoCo model, played: its soft robot, and the geoms of everything else."""

from __future__ import annotations

from typing import Any, NoReturn, final

import numpy as np

from fastrod.hosts.mujoco_body_contact import obstacle_of
from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats
from fastrod_scenes.scene import MujocoScene, MujocoStage
from fastrod_viewer.hosted import StagedView
from fastrod_viewer.world import Body, ManualCommand

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
