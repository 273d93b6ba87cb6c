"""`SceneWatch`: which pages are open, and how long they take to answer."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, final

if TYPE_CHECKING:
    import viser

_EVERY = 1.0  # s
_PATIENCE = 3.0  # s without an answer: the page is lost, though its connection may still stand
_KEY = "fastrod-echo"


@final
class SceneWatch:
    """Pings every page every second, and reports which came and went, `lost(client, clients left)` for the
    latter.

    A page that does not answer within three seconds counts as gone until it answers again. Each is pinged in
    a thread of its own, so that those which do not answer hide no other.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        *,
        lost: Callable[[int, int], None],
        tick: Callable[[], None] = lambda: None,
    ) -> None:
        """`tick` is called every second."""
        self.server = server
        self._lost, self._tick = lost, tick
        self._silent: set[int] = set()
        self._echoes: dict[int, float] = {}
        self._closed = threading.Event()
        server.on_client_connect(self._came)
        server.on_client_disconnect(lambda client: self._gone(client.client_id))
        self._thread = threading.Thread(target=self._run, name="watch", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop pinging."""
        self._closed.set()

    @property
    def echo(self) -> float:
        """Half of the slowest page's last round trip [s]; nan where no page is open."""
        return max(list(self._echoes.values()), default=float("nan"))

    def present(self) -> set[int]:
        """Return the pages that are open and answer."""
        return set(self.server.get_clients()) - self._silent

    def __len__(self) -> int:
        return len(self.present())

    def _came(self, client: Any) -> None:
        name = f"watch {client.client_id}"
        threading.Thread(target=self._query, args=(client,), name=name, daemon=True).start()

    def _gone(self, client: int) -> None:
        self._silent.discard(client)
        self._echoes.pop(client, None)
        if not self._closed.is_set():
            self._lost(client, len(self))

    def _query(self, client: Any) -> None:
        number = client.client_id
        while not self._closed.wait(_EVERY) and number in self.server.get_clients():
            began = time.perf_counter()
            try:
                client.local_storage.get_item(_KEY, timeout=_PATIENCE)
            except TimeoutError:
                if number not in self._silent and number in self.server.get_clients():
                    self._silent.add(number)
                    self._echoes.pop(number, None)
                    self._lost(number, len(self))
                continue
            except RuntimeError:  # it has just left, or keeps no storage: in both cases it has answered
                pass
            self._silent.discard(number)
            self._echoes[number] = 0.5 * (time.perf_counter() - began)
        self._silent.discard(number)
        self._echoes.pop(number, None)

    def _run(self) -> None:
        while not self._closed.wait(_EVERY):
            self._tick()
