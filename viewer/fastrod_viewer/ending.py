"""Ctrl+C and SIGTERM end what is served, whatever runs when they come."""

from __future__ import annotations

import os
import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any, final

_SOON = 0.05  # s


class _EndedError(KeyboardInterrupt):
    """By a type of its own: Python ends by SIGINT, whatever was caught, once a plain one has crossed
    `exec` of a text (dataclasses are made so)."""


@final
class Ending:
    """A context that Ctrl+C and SIGTERM end quietly where the main thread opens it; `come` says whether
    one came.

    What runs at that time is interrupted. A compiler that is may raise an error of its own instead, which
    goes the same way. A callback or a finalizer that is swallows it: then it comes again.
    """

    def __init__(self) -> None:
        self.come = False
        self._over = False
        self._before: dict[signal.Signals, Any] = {}
        self._hook = sys.unraisablehook

    def __enter__(self) -> Ending:
        if threading.current_thread() is threading.main_thread():
            for kind in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(kind) is not signal.SIG_IGN:  # as a shell has it for jobs beside it
                    self._before[kind] = signal.signal(kind, self._end)
        return self

    def _end(self, number: int, _: FrameType | None) -> None:
        def again() -> None:
            if not self._over:
                os.kill(os.getpid(), number)

        def swallowed(what: Any) -> None:
            if issubclass(what.exc_type, _EndedError):
                threading.Timer(_SOON, again).start()

        self.come, sys.unraisablehook = True, swallowed
        raise _EndedError

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> bool:
        self._over = True
        for number, before in self._before.items():
            signal.signal(number, before)
        sys.unraisablehook = self._hook
        return self.come or isinstance(error, KeyboardInterrupt)
