"""`Holder`: which page has the controls, and how another one gets them."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    import viser

from collections.abc import Callable, Collection
from typing import Literal

IDLE = 30.0
"""s without an action, after which the controls go to the first page that requests them."""
PATIENCE = 5.0
"""s in which the holder may refuse a request; after that the controls go to the page that requested them."""
AGAIN = 10.0
"""s after a refusal in which requests of the same page are ignored."""

Standing = Literal["free", "has", "requested", "other", "asking", "refused"]
"""State of one page: the controls are free; it has them; another page requests them from it; another has
them; it requests them; its request was refused."""


@final
class Holder:
    """One page drives at a time: the first that acts, until it leaves, hands over, or does not refuse a
    request.

    A page is a number. Every method may be called from any thread. Any page may stop the robot, and needs
    none of this.
    """

    def __init__(
        self,
        pages: Callable[[], Collection[int]],
        *,
        changed: Callable[[], None] = lambda: None,
        moved: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`pages` are those that are open and answer; `changed` hears when a standing has changed, and
        `moved` when the controls have left a page: every motion stops then."""
        self._pages, self._changed, self._moved, self._clock = pages, changed, moved, clock
        self._lock = threading.RLock()
        self._has: int | None = None
        self._asks: int | None = None
        self._acted = self._since = 0.0
        self._refused: dict[int, float] = {}

    def acts(self, page: int | None) -> bool:
        """Return whether this page may act now; it takes controls that are free. None stands for the program
        itself, which may."""
        if page is None:
            return True
        with self._lock:
            left = self._has not in (None, page) and self._has not in self._pages()
            came = self._has is None or left
            if left:
                self._moved()
            if came:
                self._has, self._asks = page, None if self._asks == page else self._asks
            may = self._has == page
            if may:
                self._acted = self._clock()
        if came:
            self._changed()
        return may

    def request(self, page: int) -> None:
        """Request the controls for this page: granted at once where nobody holds on to them, else unless
        refused in time. Ignored while a third page's request is open."""
        with self._lock:
            now = self._clock()
            if self._has == page or now - self._refused.get(page, -AGAIN) < AGAIN:
                return
            waits = self._asks is not None and self._asks != page and self._asks in self._pages()
            if self._has is None or self._has not in self._pages() or now - self._acted > IDLE:
                self._assign(page)
            elif not waits and self._asks != page:
                self._asks, self._since = page, now
        self._changed()

    def keep(self, page: int) -> None:
        """Refuse the request, from the page that has the controls."""
        with self._lock:
            if page != self._has or self._asks is None:
                return
            self._refused[self._asks], self._asks, self._acted = self._clock(), None, self._clock()
        self._changed()

    def grant(self, page: int) -> None:
        """Grant the request, from the page that has the controls."""
        with self._lock:
            if page != self._has or self._asks is None:
                return
            self._assign(self._asks)
        self._changed()

    def tick(self) -> None:
        """Hand over where the time to refuse is up, and forget pages that have left."""
        with self._lock:
            before, pages, now = (self._has, self._asks, len(self._refused)), self._pages(), self._clock()
            self._refused = {page: at for page, at in self._refused.items() if now - at < AGAIN}
            if self._asks is not None and self._asks not in pages:
                self._asks = None
            left = self._has is not None and self._has not in pages
            if left or (self._asks is not None and now - self._since >= PATIENCE):
                self._assign(self._asks)
            same = before == (self._has, self._asks, len(self._refused))
        if not same:
            self._changed()

    def standing(self, page: int) -> Standing:
        """Return how this page stands."""
        with self._lock:
            if self._has is None:
                return "free"
            if self._has == page:
                return "has" if self._asks is None else "requested"
            if self._asks == page:
                return "asking"
            return "refused" if page in self._refused else "other"

    def _assign(self, page: int | None) -> None:
        self._has, self._asks, self._acted = page, None, self._clock()
        self._moved()


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
        """Return whether the page that an event of viser comes from may act now: it is still there, and has
        the controls. A page that may not reads why."""
        if event.client_id in (None, *self.server.get_clients()) and self.holder.acts(event.client_id):
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
