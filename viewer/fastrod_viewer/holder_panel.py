"""`HolderPanels`: where more than one page is open, each says who has the controls, and offers to request
them."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, final

from fastrod_viewer.holder import AGAIN, PATIENCE, Holder, Standing

if TYPE_CHECKING:
    import viser

_TEXTS: dict[Standing, str] = {
    "free": "No page has the controls. The first that moves something gets them.",
    "has": "This page has the controls. The others watch; STOP works on all of them.",
    "requested": f"Another page requests control and gets it after {PATIENCE:g} s, unless you keep them.",
    "other": "Another page has the controls. This one watches; STOP works here, too.",
    "asking": f"The other page may refuse within {PATIENCE:g} s.",
    "refused": f"The other page keeps the controls. Request them again {AGAIN:g} s after that.",
}
_QUIET = 3.0  # s between two notes on one page that it may not act


@final
class HolderPanels:
    """A small window of its own on each page: it shifts no other button while somebody moves to STOP."""

    def __init__(self, server: viser.ViserServer, holder: Holder) -> None:
        self.server, self.holder = server, holder
        self._lock = threading.Lock()
        self._panels: dict[int, _Panel] = {}
        self._noted: dict[int, float] = {}

    def may(self, event: Any) -> bool:
        """Return whether the page that an event of viser comes from may act now; a page that may not reads
        why."""
        if self.holder.acts(event.client_id):
            return True
        now = time.monotonic()
        if now - self._noted.get(event.client_id, -_QUIET) >= _QUIET:
            self._noted[event.client_id] = now
            why = "Another page has the controls. Request them in the window Controls."
            event.client.add_notification("Not done", why, auto_close_seconds=5.0, color="yellow")
        return False

    def show(self) -> None:
        """Have every page say how it stands; one page alone needs no such window."""
        with self._lock:
            clients = self.server.get_clients() if len(self.server.get_clients()) > 1 else {}
            for gone in self._panels.keys() - clients.keys():
                self._panels.pop(gone).remove()
            for number, client in clients.items():
                if number not in self._panels:
                    self._panels[number] = _Panel(client, self.holder)
                self._panels[number].show(self.holder.standing(number))


@final
class _Panel:
    """Panel of one page."""

    def __init__(self, client: Any, holder: Holder) -> None:
        gui, page = client.gui, client.client_id
        self._standing: Standing | None = None
        self._panel: Any = gui.add_panel()
        with self._panel.add_tab("Controls"):
            self._text = gui.add_markdown("")
            self._request = gui.add_button("Request control", visible=False)
            self._keep = gui.add_button("Keep control", visible=False)
            self._grant = gui.add_button("Yield control", color="gray", visible=False)
        self._panel.float(x=15, y=-260, width=250)  # below viser's notes, above the plot of a log
        self._request.on_click(lambda _: holder.request(page))
        self._keep.on_click(lambda _: holder.keep(page))
        self._grant.on_click(lambda _: holder.grant(page))

    def show(self, standing: Standing) -> None:
        if standing == self._standing:
            return
        self._standing, self._text.content = standing, _TEXTS[standing]
        self._request.visible = standing == "other"
        self._keep.visible = self._grant.visible = standing == "requested"

    def remove(self) -> None:
        self._panel.remove()
