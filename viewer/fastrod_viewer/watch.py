"""`Watch`: which pages are open, and how long they take to answer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    import viser

_EVERY = 1.0  # s
_PATIENCE = 3.0  # s without an answer: the page is lost, though its connection may still stand
_KEY = "fastrod-echo"


@final
class Watch:
    """Asks every page for an answer every second, and tells who came and went, `lost(client, clients left)` for the latter.

    A page that does not answer within three seconds counts as gone until it answers again.
    """

    def __init__(self, server: viser.ViserServer, *, lost: Callable[[int, int], None], tick: Callable[[], None] = lambda: None) -> None:
        """`tick` is called every second."""
        self.server = server
        self.echo: float = float("nan")
        """Half of the slowest page's last round trip [s]; nan where no page is open."""
        self._lost, self._tick = lost, tick
        self._silent: set[int] = set()
        self._closed = threading.Event()
        server.on_client_disconnect(lambda client: self._gone(client.client_id))
        self._thread = threading.Thread(target=self._ask, name="watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ask no more."""
        self._closed.set()

    def __len__(self) -> int:
        return len([c for c in self.server.get_clients() if c not in self._silent])

    def _gone(self, client: int) -> None:
        self._silent.discard(client)
        if not self._closed.is_set():
            self._lost(client, len(self))

    def _ask(self) -> None:
        while not self._closed.wait(_EVERY):
            slowest = float("nan")
            for number, client in self.server.get_clients().items():
                began = time.perf_counter()
                try:
                    client.local_storage.get_item(_KEY, timeout=_PATIENCE)
                except TimeoutError:
                    if number not in self._silent:
                        self._silent.add(number)
                        self._lost(number, len(self))
                    continue
                except RuntimeError:  # it has just left, or keeps no storage: either way it has answered
                    pass
                self._silent.discard(number)
                half = 0.5 * (time.perf_counter() - began)
                slowest = half if not slowest >= half else slowest
            self.echo = slowest
            self._tick()
