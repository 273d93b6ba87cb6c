"""`Canvas`: what the scene graph says, on a viser server."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from fastrod.types import Floats
from fastrod_viewer.picture.shapes import SHAPES, Instances
from fastrod_viewer.worlds.world import Body

if TYPE_CHECKING:
    import viser

_STILL = 1e-7  # m, and in quaternions: a body that has moved by less is not sent again
_LAMPS = (("key", (1.0, -1.6, 2.2), 1.5), ("fill", (-1.8, 0.8, 0.9), 0.6))
_FLOOR = (226, 229, 235), (196, 202, 212)


@final
class Canvas:
    """The 3D view of a page. One thread draws; names are those of the scene graph."""

    def __init__(self, server: viser.ViserServer) -> None:
        self.server = server
        self._batches: dict[str, tuple[Any, Instances]] = {}
        self._bodies: list[Any] = []
        self._poses: Floats = np.zeros((0, 7))
        self._fixed: list[Any] = []
        self._notes: dict[str, tuple[Any, str, tuple[float, ...]]] = {}
        scene = server.scene
        scene.set_up_direction("+z")
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_hemisphere(
            "/lights/sky", sky_color=(255, 255, 255), ground_color=(205, 208, 216), intensity=1.9
        )
        for name, place, intensity in _LAMPS:
            scene.add_light_directional(f"/lights/{name}", position=place, intensity=intensity)
        scene.world_axes.visible = False

    @property
    def names(self) -> frozenset[str]:
        """Names of the batches that are drawn now."""
        return frozenset(self._batches)

    def clear(self) -> None:
        """Take everything away."""
        for handle in [
            *(batch for batch, _ in self._batches.values()),
            *self._bodies,
            *self._fixed,
            *(n[0] for n in self._notes.values()),
        ]:
            handle.remove()
        self._batches, self._bodies, self._fixed, self._notes = {}, [], [], {}
        self._poses = np.zeros((0, 7))

    def floor(self, size: float, height: float, middle: Floats) -> None:
        """A grid of half-width `size` [m] at z = `height` [m] under `middle` (3,)."""
        cell = 10.0 ** np.floor(np.log10(size / 2.0))
        extent = float(2.0 * np.ceil(size / (5.0 * cell)) * 5.0 * cell)
        grid = self.server.scene.add_grid(
            "/floor",
            width=extent,
            height=extent,
            plane="xy",
            cell_size=float(cell),
            section_size=float(5.0 * cell),
            cell_color=_FLOOR[0],
            section_color=_FLOOR[1],
            cell_thickness=1.0,
            section_thickness=1.2,
            shadow_opacity=0.0,
            position=(
                float(np.round(middle[0] / cell) * cell),
                float(np.round(middle[1] / cell) * cell),
                height,
            ),
        )
        self._fixed.append(grid)

    def add_bodies(self, bodies: Sequence[Body], poses: Floats) -> None:
        """Rigid things, at poses (n, 7) world."""
        for body, pose in zip(bodies, poses, strict=True):
            self._bodies.append(
                self.server.scene.add_mesh_simple(
                    f"/bodies/{body.name}",
                    body.vertices,
                    body.faces,
                    color=body.color,
                    opacity=None if body.opacity >= 1.0 else body.opacity,
                    side="double",
                    position=pose[:3],
                    wxyz=pose[3:],
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
        self._poses = np.array(poses)

    def move_bodies(self, poses: Floats) -> None:
        """Those of `add_bodies`, now at poses (n, 7)."""
        for k in np.flatnonzero((np.abs(poses - self._poses) > _STILL).any(axis=1)):
            self._bodies[k].position, self._bodies[k].wxyz = poses[k, :3], poses[k, 3:]
            self._poses[k] = poses[k]

    def fade(self, k: int, opacity: float) -> None:
        """Set the opacity of a body."""
        wanted = None if opacity >= 1.0 else opacity
        if self._bodies[k].opacity != wanted:
            self._bodies[k].opacity = wanted

    def show(self, name: str, batch: Instances | None, *, opacity: float | None = None) -> None:
        """Draw a batch, or draw it anew where it was before; None takes it away."""
        known = self._batches.get(name)
        if batch is None or len(batch.position) == 0:
            if known is not None:
                known[0].remove()
                del self._batches[name]
            return
        if known is not None and (
            known[1].shape != batch.shape or len(known[1].position) != len(batch.position)
        ):
            known[0].remove()
            known = None
        if known is None:
            unit = SHAPES[batch.shape]
            handle = self.server.scene.add_batched_meshes_simple(
                f"/{name}",
                unit.vertices,
                unit.faces,
                batch.wxyz,
                batch.position,
                batched_scales=batch.scale,
                batched_colors=batch.color,
                lod="off",
                opacity=opacity,
                side="front",
                cast_shadow=False,
                receive_shadow=False,
            )
            self._batches[name] = handle, batch
            return
        handle, before = known
        for here, there in (
            ("position", "batched_positions"),
            ("wxyz", "batched_wxyzs"),
            ("scale", "batched_scales"),
            ("color", "batched_colors"),
        ):
            value = getattr(batch, here)
            if not np.array_equal(value, getattr(before, here)):
                setattr(handle, there, value)
        self._batches[name] = handle, batch

    def show_all(self, batches: Mapping[str, Instances], prefix: str) -> None:
        """Draw these, those of one shape together, and take away what had this prefix before: each array
        costs as much to send as its bytes, and a good deal on top."""
        by_shape: dict[str, list[Instances]] = {}
        for batch in batches.values():
            by_shape.setdefault(batch.shape, []).append(batch)
        for name in [
            name
            for name in self._batches
            if name.startswith(prefix) and name.removeprefix(prefix) not in by_shape
        ]:
            self.show(name, None)
        for shape, some in by_shape.items():
            arrays = (np.concatenate(columns) for columns in zip(*(batch[1:] for batch in some), strict=True))
            self.show(prefix + shape, some[0] if len(some) == 1 else Instances(shape, *arrays))

    def note(self, name: str, text: str, position: Sequence[float] | NDArray[np.floating] | None) -> None:
        """A few words at a place [m]; none where `position` is None."""
        known = self._notes.get(name)
        if position is None or not text:
            if known is not None:
                known[0].remove()
                del self._notes[name]
            return
        x, y, z = (float(v) for v in position)
        at = (x, y, z)
        if known is None:
            self._notes[name] = self.server.scene.add_label(f"/notes/{name}", text, position=at), text, at
            return
        handle, before, where = known
        if before != text:
            handle.text = text
        if where != at:
            handle.position = at
        self._notes[name] = handle, text, at
