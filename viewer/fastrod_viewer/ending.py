"""Ctrl+C and SIGTERM end what is served, whatever runs when they come."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType, TracebackType
from typing import Any, final


class _EndedError(KeyboardInterrupt):
    """By a type of its own: Python ends by SIGINT, whatever was caught, once a plain one has crossed
    `exec` of a text (dataclasses are made so)."""


@final
class Ending:
    """A context that Ctrl+C and SIGTERM end quietly where the main thread opens it; `come` says whether
    one came.

    What runs at that time is interrupted. A compiler that is may raise an error of its own instead, which
    goes the same way, or only print one and continue: then `come` is all that says so.
    """

    def __init__(self) -> None:
        self.come = False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Ending:
        if threading.current_thread() is threading.main_thread():
            for kind in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(kind) is not signal.SIG_IGN:  # as a shell has it for jobs beside it
                    self._before[kind] = signal.signal(kind, self._end)
        return self

    def _end(self, _: int, __: FrameType | None) -> None:
        self.come = True
        sys.unraisablehook = lambda _: None  # of a compiler's callback that swallows the next line
        raise _EndedError

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> bool:
        for number, before in self._before.items():
            signal.signal(number, before)
        return self.come or isinstance(error, KeyboardInterrupt)
