"""Bodies of a MuJoCo model as obstacles of a rod, pushed by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.contact import Obstacle, mesh, obstacle, plane
from fastrod.errors import HostError
from fastrod.hosts.body_contact import BodyContact, CollisionShape
from fastrod.hosts.host import Motion
from fastrod.hosts.mujoco_body import Applied, com_motion, mujoco
from fastrod.rotation import matrix_from_quaternion, product
from fastrod.types import Floats

_INVERSE = np.array([1.0, -1.0, -1.0, -1.0])  # of a unit quaternion w x y z


@final
class MujocoBodyContact(BodyContact):
    """Contact of a rod with a body of a MuJoCo model (`BodyContact`). Poses and velocities are as `data` have
    them: `MujocoBody.motion` has brought them up to date."""

    def __init__(self, model: Any, data: Any, body: int, *, dt: float, friction: float) -> None:
        """`friction` of rod on the body. Raises `HostError` where no geom of the body collides."""
        self.model, self.data, self.body = model, data, body
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        self.geoms: list[int] = np.flatnonzero(solid & (model.geom_bodyid == body)).tolist()
        if not self.geoms:
            raise HostError(
                f"body {model.body(body).name!r} has no geom that collides, so nothing can touch it."
            )
        still = model.body_weldid[body] == 0 or model.body_mocapid[model.body_weldid[body]] >= 0
        mass = 0.0 if still else float(model.body_mass[body])
        shapes = _shapes(model, body, self.geoms)
        self._applied = Applied(data, body)
        number, inertia = (id(data), body), model.body_inertia[body].copy()
        super().__init__(number, shapes, mass, inertia, dt=dt, friction=friction)

    def com(self) -> Motion:
        """Motion of the inertial frame (`data.xipos`, `data.ximat`), whose axes are those of the body's
        inertia."""
        return com_motion(self.model, self.data, self.body)

    def apply(self, wrench: Floats) -> None:
        """(6,) force [N] and moment about the centre of mass [N m], world, with the last; it acts until
        `release`."""
        self._applied.add(wrench)

    def release(self) -> None:
        """Feel no more of it."""
        self._applied.take()


def _shapes(model: Any, body: int, geoms: Sequence[int]) -> list[CollisionShape]:
    """The geoms of a body."""
    label = model.body(body).name or f"body {body}"
    rotation = matrix_from_quaternion(model.body_iquat[body][None])[0].T
    shapes = []
    for i, geom in enumerate(geoms):
        made = obstacle_of(model, geom, label + (f" shape {i}" if i else ""))
        position = rotation @ (model.geom_pos[geom] - model.body_ipos[body])
        shapes.append(
            CollisionShape(made, position, product(model.body_iquat[body] * _INVERSE, model.geom_quat[geom]))
        )
    return shapes


def obstacle_of(model: Any, geom: int, name: str) -> Obstacle:
    """A geom as an obstacle, in its own frame. Raises `HostError` for height fields and other shapes that a
    rod cannot touch."""
    kinds = mujoco().mjtGeom
    kind, (a, b, c) = kinds(int(model.geom_type[geom])), model.geom_size[geom].tolist()
    simple = {
        kinds.mjGEOM_BOX: ("box", (2.0 * a, 2.0 * b, 2.0 * c)),
        kinds.mjGEOM_SPHERE: ("sphere", (a,)),
        kinds.mjGEOM_CYLINDER: ("cylinder", (a, 2.0 * b)),
        kinds.mjGEOM_CAPSULE: ("capsule", (a, 2.0 * b)),
        kinds.mjGEOM_ELLIPSOID: ("ellipsoid", (a, b, c)),
    }
    if kind in simple:
        return obstacle(*simple[kind], name=name, widest=math.inf)
    if kind == kinds.mjGEOM_PLANE:
        return plane(point=(0.0, 0.0, 0.0), normal=(0.0, 0.0, 1.0), name=name)
    if kind == kinds.mjGEOM_MESH:
        return _hull(model, int(model.geom_dataid[geom]), name)
    word = str(kind).rsplit("_", 1)[-1].lower()
    raise HostError(
        f"geom {geom} of {name!r} is of the kind {word}, which a rod cannot touch; give it a "
        "mesh, or a simple shape."
    )


def _hull(model: Any, number: int, name: str) -> Obstacle:
    """MuJoCo takes the convex hull of a geom's mesh, and so does the rod."""
    import trimesh

    first, n = model.mesh_vertadr[number], model.mesh_vertnum[number]
    hull = trimesh.convex.convex_hull(np.asarray(model.mesh_vert[first : first + n], float))
    return mesh(hull, name=name, widest=math.inf)
