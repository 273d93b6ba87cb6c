"""`Holder`: which page has the controls, and how another one gets them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from typing import Literal, final

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
