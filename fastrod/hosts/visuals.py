"""`Visuals`: what the bodies of a PyBullet world look like, as triangles, for a viewer of its own."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from fastrod.contact.meshfile import MeshLimits, read_mesh
from fastrod.errors import InputError
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.link import from_xyzw
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats

_PLANE = 2.0  # m, edge of a ground without end
_ENDLESS = 20.0  # m; a flat mesh wider than this is such a ground
_THICK = 1e-4  # m, of a plane
# m, edge of the cube that stands for what has neither a mesh that can be read nor a collision shape
_UNKNOWN = 0.05


class VisualShape(NamedTuple):
    """Mesh of everything on one link that has one colour."""

    name: str
    """Unique in its world."""
    vertices: NDArray[np.float32]
    """(n, 3) frame of the link [m]: the URDF's, not that of the centre of mass."""
    faces: NDArray[np.uint32]
    """(m, 3)"""
    rgba: tuple[float, float, float, float]
    """Each from 0 to 1."""


@final
class Visuals:
    """The visual shapes of all bodies that a PyBullet world has now, and where they are from step to step.

    Mesh files are read as `fastrod.contact.mesh` reads them, within `MeshLimits()`; those that are not, and
    meshes without a file, become the box around their link's collision shape.
    """

    def __init__(self, bullet: Any, ignore: Collection[int] = ()) -> None:
        """`ignore`: numbers of bodies that are left out. Raises `HostError` where there is no such world."""
        self.bullet = b = Bullet(bullet)
        known = [b.getBodyUniqueId(i) for i in range(b.getNumBodies())]
        self._links: dict[int, list[int]] = {}
        self._frame_from_com: dict[int, tuple[Any, Any]] = {}
        shapes: list[VisualShape] = []
        places: list[tuple[int, int]] = []
        for body in known:
            if body in ignore:
                continue
            inertial = b.getDynamicsInfo(body, -1)
            self._frame_from_com[body] = b.invertTransform(inertial[3], inertial[4])
            for (link, rgba), visuals in _grouped(b, body).items():
                label = b.getBodyInfo(body)[1].decode() or "body"
                name = f"{label} {body}" + (f" link {link}" if link >= 0 else "")
                meshes = [_in_link_frame(*self._mesh(body, link, visual), visual) for visual in visuals]
                taken = sum(place == (body, link) for place in places)
                shapes.append(
                    VisualShape(name + (f" colour {taken + 1}" if taken else ""), *_joined(meshes), rgba)
                )
                places.append((body, link))
        self._places = places
        for body, link in places:
            if link >= 0 and link not in self._links.setdefault(body, []):
                self._links[body].append(link)
        self.shapes: tuple[VisualShape, ...] = tuple(shapes)

    def poses(self) -> Floats:
        """(n_shapes, 7) position [m] and quaternion w x y z of each shape's link now, world. Raises
        `HostError` where a body is gone."""
        b, found = self.bullet, dict[tuple[int, int], tuple[Any, Any]]()
        for body, back in self._frame_from_com.items():
            found[body, -1] = b.multiplyTransforms(*b.getBasePositionAndOrientation(body), *back)
        for body, links in self._links.items():
            for link, state in zip(
                links, b.getLinkStates(body, links, computeForwardKinematics=1), strict=True
            ):
                found[body, link] = state[4], state[5]
        poses = np.empty((len(self._places), 7))
        for k, place in enumerate(self._places):
            position, quaternion = found[place]
            poses[k, :3], poses[k, 3:] = position, from_xyzw(quaternion)
        return poses

    def _mesh(self, body: int, link: int, visual: Any) -> tuple[Floats, NDArray[np.int64], bool]:
        """Vertices, faces, and whether they are in the visual's frame; otherwise they are in the link's."""
        import trimesh

        b, kind, size = self.bullet, visual[2], visual[3]
        if kind == b.GEOM_BOX:
            made = trimesh.creation.box(extents=size)
        elif kind == b.GEOM_SPHERE:
            made = trimesh.creation.icosphere(subdivisions=2, radius=size[0])
        elif kind == b.GEOM_CYLINDER:
            made = trimesh.creation.cylinder(radius=size[1], height=size[0], sections=32)
        elif kind == b.GEOM_CAPSULE:
            made = trimesh.creation.capsule(radius=size[1], height=size[0], count=[16, 16])
        elif kind == b.GEOM_PLANE:
            made = _ground()
        elif (read := _read(visual[4].decode(), size)) is not None:
            made = read
        else:
            vertices, faces = self._box_around(body, link, visual)
            return vertices, faces, False
        return np.asarray(made.vertices), np.asarray(made.faces), True

    def _box_around(self, body: int, link: int, visual: Any) -> tuple[Floats, NDArray[np.int64]]:
        """In the link's frame."""
        import trimesh

        b = self.bullet
        if not b.getCollisionShapeData(body, link):
            cube = trimesh.creation.box(extents=[_UNKNOWN] * 3)
            return np.asarray(cube.vertices) + visual[5], np.asarray(cube.faces)
        box = trimesh.creation.box(bounds=np.array(b.getAABB(body, link)))
        if link >= 0:
            position, quaternion = b.getLinkState(body, link, computeForwardKinematics=1)[4:6]
        else:
            position, quaternion = b.multiplyTransforms(
                *b.getBasePositionAndOrientation(body), *self._frame_from_com[body]
            )
        rotation = matrix_from_quaternion(from_xyzw(quaternion)[None])[0]
        return (np.asarray(box.vertices) - position) @ rotation, np.asarray(box.faces)


def _grouped(b: Bullet, body: int) -> dict[tuple[int, tuple[float, float, float, float]], list[Any]]:
    """PyBullet's visual shapes of a body by link and colour; what nobody can see is left out."""
    groups: dict[tuple[int, tuple[float, float, float, float]], list[Any]] = {}
    for visual in b.getVisualShapeData(body):
        red, green, blue, alpha = (min(max(float(c), 0.0), 1.0) for c in visual[7])
        if alpha > 0.0:
            groups.setdefault((visual[1], (red, green, blue, alpha)), []).append(visual)
    return groups


def _read(path: str, scale: Any) -> Any:
    """A mesh file as a trimesh.Trimesh, in metres; None where it cannot be read."""
    import trimesh

    if not path:
        return None
    try:
        vertices, faces = read_mesh(Path(path), MeshLimits())
    except InputError:
        return None
    if (
        not len(faces)
        or not np.isfinite(vertices).all()
        or not 0 <= faces.min() <= faces.max() < len(vertices)
    ):
        return None
    mesh: Any = trimesh.Trimesh(vertices, faces, process=False)
    mesh.merge_vertices()  # files have one for each normal: a fifth of them is enough
    mesh.apply_scale(np.asarray(scale, float))
    extents = np.ptp(np.asarray(mesh.vertices), axis=0)
    return _ground() if extents[2] < 1e-6 and extents.max() > _ENDLESS else mesh


def _ground() -> Any:
    import trimesh

    ground = trimesh.creation.box(extents=(_PLANE, _PLANE, _THICK))
    ground.apply_translation([0.0, 0.0, -0.5 * _THICK])
    return ground


def _in_link_frame(
    vertices: Floats, faces: NDArray[np.int64], own: bool, visual: Any
) -> tuple[Floats, NDArray[np.int64]]:
    """In the link's frame."""
    if not own:
        return vertices, faces
    rotation = matrix_from_quaternion(from_xyzw(visual[6])[None])[0]
    return vertices @ rotation.T + visual[5], faces


def _joined(meshes: list[tuple[Floats, NDArray[np.int64]]]) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = np.concatenate([faces + k for (_, faces), k in zip(meshes, first, strict=False)])
    return np.concatenate([vertices for vertices, _ in meshes]).astype(np.float32), faces.astype(np.uint32)
