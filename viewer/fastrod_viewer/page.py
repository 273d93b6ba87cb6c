"""`ViewerPage`: what the window shows at a time; a robot that is driven, or a log that is replayed."""

from __future__ import annotations

import html
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fastrod.errors import FastrodError
from fastrod.types import Floats

if TYPE_CHECKING:
    import viser

_LARGEST_PICTURE = 1920, 1080
_FIELD = 0.75  # rad, vertical
_SPELT = {"tdcr": "TDCR", "a": "A", "b": "B", "ethz": "ETH Zurich", "mujoco": "MuJoCo", "ur5": "UR5"}
_WAIT = 20.0  # s for a page to draw its picture


class ViewerPage(ABC):
    """One thing on the canvas, with controls of its own."""

    title: str
    """A few words."""
    sight: PageView
    """Sphere of the first look."""

    @abstractmethod
    def export(self) -> str:
        """This page as one self-contained HTML file."""

    @abstractmethod
    def lost(self, client: int, left: int) -> None:
        """A client is gone, `left` remain."""

    @abstractmethod
    def passed_on(self) -> None:
        """The page that had the controls has left, or handed them over."""

    @abstractmethod
    def rest(self, on: bool) -> None:
        """Compute nothing while another page is being made, or resume after all."""

    @abstractmethod
    def tick(self) -> None:
        """Called every second."""

    @abstractmethod
    def close(self) -> None:
        """Take everything away that this page has made, and finish what it does."""


@dataclass(frozen=True, eq=False)
class PageView:
    """Sphere that a first look shows, about `middle` (3,) of radius `size` [m], from in front and a little
    above."""

    middle: Floats
    size: float

    def show(self, camera: Any, *, upright: bool = False) -> None:
        """Point a camera at it; in an upright window it stands in the upper half, above the controls."""
        away = np.array([0.62, -0.70, 0.30])
        distance = (2.6 if upright else 1.12) * self.size / np.sin(0.5 * _FIELD)
        at = self.middle - np.array([0.0, 0.0, 1.4 * self.size if upright else 0.0])
        camera.near, camera.far, camera.fov = 0.02 * self.size, 60.0 * self.size, _FIELD
        camera.position, camera.look_at = at + distance * away / np.linalg.norm(away), at

    def correct(self, client: Any) -> None:
        """Show it again to an upright window that looks as a wide one does: its first look came late."""
        if is_upright(client) and np.allclose(client.camera.look_at, self.middle, atol=1e-3 * self.size):
            self.show(client.camera, upright=True)


def stand_back(server: viser.ViserServer, sight: PageView) -> None:
    """All clients, present and to come, look at this."""
    sight.show(server.initial_camera)
    for client in server.get_clients().values():
        sight.show(client.camera, upright=is_upright(client))


def is_upright(client: Any) -> bool:
    """The client's window is that of a phone."""
    return bool(client.camera.image_height > 1.2 * client.camera.image_width)


def picture(client: Any) -> bytes:
    """PNG of what a client sees. Raises `TimeoutError` where it does not draw, `RuntimeError` where it has
    left."""
    from matplotlib.image import imsave

    width = min(int(client.camera.image_width), _LARGEST_PICTURE[0])
    height = min(int(client.camera.image_height), _LARGEST_PICTURE[1])
    seen = client.get_render(height=height, width=width, transport_format="jpeg", timeout=_WAIT)
    out = io.BytesIO()
    imsave(out, np.ascontiguousarray(seen[..., :3]), format="png")
    return out.getvalue()


def plain(name: str) -> str:
    """A name as one reads it.

    >>> plain("five_segment_reacher"), plain("tdcr_a")
    ('Five segment reacher', 'TDCR A')
    """
    words = [_SPELT.get(word, word) for word in name.split("_")]
    return " ".join([words[0][:1].upper() + words[0][1:], *words[1:]])


def heading(title: str, about: str, hint: str) -> str:
    """HTML of what is seen, and of what to try."""
    return (
        f'<div style="padding:2px 9px 6px">'
        f'<div style="font-size:15px;font-weight:600">{html.escape(title)}</div>'
        f'<div style="font-size:12.5px;color:#4b5563">{html.escape(f"{about} {hint}".strip())}</div></div>'
    )


def millimetres(place: Floats) -> str:
    """(3,) [m] as text, without a minus before a zero."""
    return ", ".join(f"{round(1e3 * x, 1) + 0.0:.1f}" for x in np.asarray(place).tolist()) + " mm"


def facts(rows: Sequence[tuple[str, str]], problem: str = "", *, news: str = "") -> str:
    """HTML of names and values in two columns, and below them what is wrong, or worth knowing."""
    cells = "".join(
        f'<div style="color:#6b7280">{html.escape(name)}</div><div '
        f'style="font-variant-numeric:tabular-nums">{html.escape(value)}</div>'
        for name, value in rows
    )
    warning = "".join(
        f'<div style="grid-column:1/3;color:{color};margin-top:4px">{html.escape(text)}</div>'
        for text, color in ((problem, "#b91c1c"), (news, "#1d4ed8"))
        if text
    )
    style = (
        "display:grid;grid-template-columns:fit-content(60%) 1fr;gap:2px 12px;font-size:13px;padding:4px 9px"
    )
    return f'<div style="{style}">{cells}{warning}</div>'


def save_name(path: Path) -> str:
    """A file's name as a page shows it: from the folder that the command was called in."""
    try:
        return str(path.resolve().relative_to(Path.cwd()))
    except ValueError:
        return str(path)


def notify(client: Any, title: str, body: str, *, failed: bool = False) -> None:
    """A note in the corner of one client's page, if it is still there."""
    if client is not None:
        client.add_notification(
            title, body, auto_close_seconds=None if failed else 5.0, color="red" if failed else "green"
        )


def send(client: Any, name: str, make: Callable[[], bytes]) -> None:
    """Have one client save a file; a note where it cannot be made."""
    if client is None:
        return
    try:
        client.send_file_download(name, make(), save_immediately=True)
    except (FastrodError, TimeoutError, RuntimeError) as error:
        notify(client, f"{name} was not saved", str(error), failed=True)
