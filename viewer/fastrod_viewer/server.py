"""The viser server: which port, which host. Light, so that a browser loads the page while the simulator is
still being imported."""

from __future__ import annotations

import functools
from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

from fastrod.access import Ignored, Served, free_port, serve_guarded


def heed_sense(served: Served) -> None:
    """Have a server drop what its own pages never send, and survive callbacks that fail on it.

    viser sets any attribute of a control that a message names, takes a file for a slider's value, and prints
    the traceback of every callback that fails.
    """
    from viser import _messages

    server = served.viser
    handlers = server._websock_server._incoming_handlers
    for kind in (_messages.FileTransferStartUpload, _messages.FileTransferPart):  # there is nothing to upload
        handlers.pop(kind, None)
    known: Any = handlers[_messages.GuiUpdateMessage]
    checked = [_checked(handler, server.gui, served.ignored) for handler in known]
    handlers[_messages.GuiUpdateMessage] = checked
    pool: Any = server._thread_executor
    plain = pool.submit

    def submit(job: Callable[..., Any], *arguments: Any, **options: Any) -> Future[Any]:
        future: Future[Any] = plain(_survived(job, served.ignored), *arguments, **options)
        return future

    pool.submit = submit


def fits(handle: Any, updates: object) -> bool:
    """Return whether a control can have what a page says that it has now."""
    if not isinstance(updates, dict) or set(updates) != {"value"}:
        return False
    value, now = updates["value"], handle.value
    options = getattr(handle, "options", None)
    if options is not None:
        return isinstance(value, str) and value in options
    if isinstance(now, bool):
        return isinstance(value, bool)
    if isinstance(now, (int, float)):
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return False
        step = float(getattr(handle, "step", 0.0) or 0.0)  # a page rounds to steps, past an end
        return bool(handle.min - step <= value <= handle.max + step)
    return type(value) is type(now)


def _checked(handler: Callable[[Any, Any], Any], gui: Any, ignored: Ignored) -> Callable[[Any, Any], Any]:
    async def heed(client: Any, message: Any) -> None:
        handle = gui._gui_input_handle_from_uuid.get(message.uuid) if isinstance(message.uuid, str) else None
        if handle is None:
            return  # removed before the message arrived
        if fits(handle, message.updates):
            await handler(client, message)
        else:
            ignored()

    return heed


def _survived(job: Callable[..., Any], ignored: Ignored) -> Callable[..., Any]:
    @functools.wraps(job)
    def run(*arguments: Any, **options: Any) -> Any:
        try:
            return job(*arguments, **options)
        except Exception as error:  # of whatever kind: nobody waits for it who could handle it
            ignored.failed(error)

    return run


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
