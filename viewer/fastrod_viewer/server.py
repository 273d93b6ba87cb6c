"""The viser server: which port, which host. Light, so that a browser loads the page while the simulator is
still being imported."""

from __future__ import annotations

import functools
from typing import Any

from fastrod.access import Served, free_port, serve_guarded
from fastrod_viewer.inbox import heed_sense


def serve(host: str = "127.0.0.1", port: int | None = None) -> Served:
    """Start a server; `port` None takes the first free one from 8080 on, 0 any. Raises `InputError` where
    viser is missing, or host or port cannot be had."""
    served = serve_guarded(host, free_port(host, port))
    _push_from_any_thread()
    heed_sense(served)
    return served


@functools.cache
def _push_from_any_thread() -> None:
    """viser 1.1 wakes its senders from the thread that draws, while its own thread may be changing the queue
    of those who wait: once in some hours of motion that raises in the middle of a picture. By then the
    message is in the buffer; only the waking is left to do. A page that leaves while a thread draws for it
    takes no message any more: viser would warn, and keep what it never sends."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    plain: Any = AsyncMessageBuffer.push

    @functools.wraps(plain)
    def push(self: Any, message: Any) -> None:
        if self.done:
            return
        try:
            plain(self, message)
        except RuntimeError as error:
            if "mutated during iteration" not in str(error):
                raise
            self.event_loop.call_soon_threadsafe(self.message_event.set)

    setattr(AsyncMessageBuffer, "push", push)  # noqa: B010 - mypy forbids assigning to a method
