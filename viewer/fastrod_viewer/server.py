"""The viser server: which port, which host. Light, so that a browser loads the page while the simulator is
still being imported."""

from __future__ import annotations

import errno
import functools
import socket
from typing import Any

from fastrod.access import Served, serve_guarded
from fastrod.errors import InputError
from fastrod_viewer.inbox import heed_sense

PORT = 8080
"""The first that is tried."""
_TRIES = 20


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
    message is in the buffer; only the waking is left to do."""
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    plain: Any = AsyncMessageBuffer.push

    @functools.wraps(plain)
    def push(self: Any, message: Any) -> None:
        try:
            plain(self, message)
        except RuntimeError as error:
            if "mutated during iteration" not in str(error):
                raise
            self.event_loop.call_soon_threadsafe(self.message_event.set)

    setattr(AsyncMessageBuffer, "push", push)  # noqa: B010 - mypy forbids assigning to a method


def free_port(host: str, port: int | None) -> int:
    """`port` if it is free, or for None the first free one from 8080 on. Raises `InputError`, one sentence,
    where there is none."""
    if port is not None and not 0 <= port < 65536:
        raise InputError(f"port is {port}; it must be between 1 and 65535, or 0 for any that is free.")
    for candidate in range(PORT, PORT + _TRIES) if port is None else [port]:
        if _free(host, candidate):
            return candidate
    if port is None:
        raise InputError(
            f"ports {PORT} to {PORT + _TRIES - 1} are all in use on {host}; name a free one with --port."
        )
    other = next((p for p in range(port + 1, min(port + 1 + _TRIES, 65536)) if _free(host, p)), None)
    raise InputError(
        f"port {port} is in use on {host}; "
        + (f"{other} is free: --port {other}." if other else "name another with --port.")
    )


def _free(host: str, port: int) -> bool:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    except OSError as error:
        raise InputError(
            f"host {host!r} is not an address of this machine; 127.0.0.1 is, and 0.0.0.0 stands for all of "
            "its addresses."
        ) from error
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f"host {host!r} is not an address of this machine; 127.0.0.1 is, and 0.0.0.0 stands for "
                    "all of its addresses."
                ) from error
            return False
    return True
