"""`EnvPage`: the first environments of a task side by side in a browser, with viser."""

from __future__ import annotations

import math
import sys
from importlib.util import find_spec
from typing import Any, final

import numpy as np

from fastrod.access import free_port, serve_guarded
from fastrod.errors import InputError
from fastrod.types import Floats
from fastrod_envs.painter import DrawnPiece, pieces
from fastrod_envs.task import Backdrop, Task

SHOWN = 16
"""Environments that are shown, at most."""
_HOST = "127.0.0.1"
_STILL = 1e-7  # m: what has moved by less is not sent again
_LAMPS = (("key", (1.0, -1.6, 2.2), 1.5), ("fill", (-1.8, 0.8, 0.9), 0.6))


@final
class EnvPage:
    """A viser server on 127.0.0.1, on the first free port from 8080 on; its address, without which the page
    cannot be loaded, goes to stderr once."""

    def __init__(self, task: Task) -> None:
        """Raises `InputError` where viser is missing, or no port is free."""
        if find_spec("viser") is None:
            raise InputError("render_mode 'viser' needs viser; pip install fastrod[viewer] brings it.")
        self._served = serve_guarded(_HOST, free_port(_HOST, None), label=f"fastrod {task.name}")
        self._server, self.address = self._served.viser, self._served.address
        self._drawn: dict[str, tuple[Any, Floats]] = {}
        first = task.backdrop(0)
        self._places = _places(min(task.n_envs, SHOWN), _extent(first))
        self._furnish(first)
        self.update(task)
        print(f"{task.name}: {self.address}", file=sys.stderr, flush=True)

    def update(self, task: Task) -> None:
        """Show the environments as they are now."""
        scenes = [task.backdrop(i) for i in range(len(self._places))]
        with self._server.atomic():
            names = {name for i, backdrop in enumerate(scenes) for name in self._draw(f"/env{i}", backdrop)}
            for name in set(self._drawn) - names:
                self._drawn.pop(name)[0].remove()
        self._server.flush()

    def close(self) -> None:
        """Stop the server."""
        self._served.stop()

    def _furnish(self, backdrop: Backdrop) -> None:
        """Light, a floor, a frame for every environment, and from where one looks."""
        scene, self._server.initial_camera.fov = self._server.scene, math.radians(45.0)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        scene.set_up_direction("+z")
        scene.world_axes.visible = False
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        scene.add_light_hemisphere(
            "/lights/sky", sky_color=(255, 255, 255), ground_color=(205, 208, 216), intensity=1.9
        )
        for name, place, intensity in _LAMPS:
            scene.add_light_directional(f"/lights/{name}", position=place, intensity=intensity)
        width = 4.0 * math.ceil(1.0 + float(np.abs(self._places).max()))
        scene.add_grid(
            "/floor",
            width=width,
            height=width,
            plane="xy",
            cell_size=0.1,
            section_size=0.5,
            cell_color=(226, 229, 235),
            section_color=(196, 202, 212),
            shadow_opacity=0.0,
        )
        for i, place in enumerate(self._places):
            scene.add_frame(f"/env{i}", show_axes=False, position=place)
        eye, target = np.array(backdrop.eye), np.array(backdrop.target)
        away = eye - target
        back = 1.0 + 1.2 * float(np.ptp(self._places, axis=0).max()) / max(float(np.linalg.norm(away)), 1e-9)
        self._server.initial_camera.position = target + back * away
        self._server.initial_camera.look_at = target

    def _draw(self, at: str, backdrop: Backdrop) -> list[str]:
        """Everything of one environment; the names it has in the page."""
        names = []
        for piece in pieces(backdrop, sides=16, n_points=2):
            names.append(f"{at}/{piece.name}")
            self._mesh(names[-1], piece)
        for i, line in enumerate(backdrop.lines):
            names.append(f"{at}/line{i}")
            points = np.asarray(line.points, float)
            self._line(names[-1], np.stack([points[:-1], points[1:]], axis=1), line.color)
        return names

    def _mesh(self, name: str, piece: DrawnPiece) -> None:
        handle = self._known(name, piece.vertices)
        if handle is None:
            handle = self._server.scene.add_mesh_simple(
                name,
                piece.vertices.astype(np.float32),
                piece.faces.astype(np.uint32),
                color=_bytes(piece.color),
                opacity=None if piece.opacity >= 1.0 else piece.opacity,
                flat_shading=piece.flat,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        elif np.abs(self._drawn[name][1] - piece.vertices).max() > _STILL:
            handle.vertices = piece.vertices.astype(np.float32)
        else:
            return
        self._drawn[name] = handle, piece.vertices

    def _line(self, name: str, pairs: Floats, color: tuple[float, ...]) -> None:
        handle = self._known(name, pairs)
        if handle is None:
            handle = self._server.scene.add_line_segments(
                name, np.asarray(pairs, np.float32), _bytes(color), thickness=0.004
            )
        elif np.abs(self._drawn[name][1] - pairs).max(initial=0.0) > _STILL:
            handle.points = np.asarray(pairs, np.float32)
        else:
            return
        self._drawn[name] = handle, np.array(pairs)

    def _known(self, name: str, points: Floats) -> Any:
        """Return what is drawn under this name, if it has as many points."""
        handle, before = self._drawn.get(name, (None, np.zeros(0)))
        return handle if before.shape == np.shape(points) else None


def _bytes(color: tuple[float, ...]) -> tuple[int, int, int]:
    red, green, blue = (round(255.0 * channel) for channel in color)
    return red, green, blue


def _extent(backdrop: Backdrop) -> float:
    """Width of a square around an environment, from above [m]."""
    clouds = (
        [t.points for t in backdrop.tubes]
        + [s.vertices for s in backdrop.solids]
        + [line.points for line in backdrop.lines]
    )
    clouds += [np.asarray(ball.position)[None] for ball in backdrop.balls]
    points = np.concatenate([np.asarray(channel, float)[:, :2] for channel in clouds])
    lengths = [float(np.linalg.norm(np.diff(tube.points, axis=0), axis=1).sum()) for tube in backdrop.tubes]
    return float(max([np.ptp(points, axis=0).max(), *lengths])) + 0.2  # a rod may lie down


def _places(n: int, width: float) -> Floats:
    """(n, 3) middles of squares of this width, around the origin [m]."""
    columns = math.ceil(math.sqrt(n))
    i = np.arange(n)
    places = width * np.stack([i % columns, i // columns, np.zeros(n)], axis=1)
    return np.asarray(places - 0.5 * (places.min(0) + places.max(0)))
