"""`DragHandle`: the ball at the tip that a person drags."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, final

import numpy as np

from fastrod.types import Floats
from fastrod_viewer.drive.session import Session
from fastrod_viewer.picture.palette import ACCENT

if TYPE_CHECKING:
    import viser

_HINT = "drag me"


@final
class DragHandle:
    """Ball that follows the tip, or the page that drags it; `Teleop` then moves the tip there by inverse
    kinematics, or pulls by a spring what has inertia."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        radius: float,
        place: Floats,
        *,
        may: Callable[[Any], bool],
    ) -> None:
        """`radius` of the ball [m]; `place` (3,) is where the world's origin is drawn for the robot that is
        driven [m]; `may` says of an event whether the page it comes from may act."""
        self.session, self._place, self._may = session, place, may
        self._held_by: int | None = None
        self._ball: Any = server.scene.add_icosphere(
            "/drag_handle",
            radius,
            color=ACCENT,
            opacity=0.55,
            subdivisions=3,
            cast_shadow=False,
            receive_shadow=False,
        )
        # of a robot that moves by itself the page's heading says it: a label would follow it about
        self._hint: Any = server.scene.add_label(
            "/drag_handle/hint", "" if session.scripted else _HINT, position=(0.0, 0.0, 2.2 * radius)
        )
        self._ball.on_drag("left")(session.in_order(self._drag))

    def follow(self, tip: Floats) -> None:
        """Move to the tip (3,) as it is drawn [m], or to the drag point."""
        goal = self.session.teleop.dragged_to
        at = tip if goal is None else goal + self._place
        if np.isfinite(at).all() and math.dist(at, self._ball.position) > 1e-6:
            self._ball.position = at

    def lost(self, client: int) -> None:
        """Let go: a client is gone, or has released the ball."""
        if self._held_by == client:
            self._held_by = None
            self.session.teleop.drag(None)

    def remove(self) -> None:
        """Take the ball away."""
        self._ball.remove()

    def _drag(self, event: Any) -> None:
        session = self.session
        if event.phase == "end":
            self.lost(event.client_id)
        elif session.stopped or not np.isfinite(event.end_position).all() or not self._may(event):
            return
        else:
            if self._hint is not None:
                self._hint.remove()
                self._hint = None
            self._held_by = event.client_id
            session.take_over()
            session.teleop.drag(np.array(event.end_position) - self._place)
