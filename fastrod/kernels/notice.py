"""Notices around the compilation of a kernel: a line on stderr, for a first run that prints nothing for
half a minute looks hung, and no garbage collection, which finds nothing and takes a tenth of the time."""

from __future__ import annotations

import gc
import os
import sys
from typing import Any

from numba.core import event

_register: Any = event.register  # it has no types
_PLACE = "fastrod.kernels."
SECONDS = {
    "pass_some": ("the rod", 40),
    "search_some": ("contact", 45),
    "press_some": ("contact", 45),
    "pass_modes": ("modes", 50),
    "derive_modes": ("derivatives of modes", 15),
}
"""Purpose of the large kernels, and the time that each group takes to compile on one core of 2025 [s]
(`fastrod warmup`)."""


class _Around(event.Listener):
    """Print one line before each group of kernels that is compiled in a process, and collect no garbage until
    the outermost compilation has ended."""

    def __init__(self, cached: bool) -> None:
        why = "in each process, for no cache folder can be written (FASTROD_CACHE_DIR names one)"
        self._how_often = "once" if cached else why
        self._printed: set[str] = set()
        self._depth, self._collects = 0, False

    def on_start(self, what: Any) -> None:
        """Print, unless `FASTROD_QUIET` is set or this line was printed before."""
        if self._depth == 0:
            self._collects = gc.isenabled()
            gc.disable()
        self._depth += 1
        function = what.data["dispatcher"].py_func
        group = SECONDS.get(function.__name__) if function.__module__.startswith(_PLACE) else None
        if group and not os.environ.get("FASTROD_QUIET") and group[0] not in self._printed:
            self._printed.add(group[0])
            line = f"Compiling the kernels of {group[0]}, about {group[1]} s, {self._how_often}."
            print(line, file=sys.stderr, flush=True)

    def on_end(self, what: Any) -> None:  # noqa: ARG002
        """Collect garbage again, if it was collected before."""
        self._depth -= 1
        if self._depth == 0 and self._collects:
            gc.enable()


def announce(cached: bool) -> None:
    """Print a line on stderr before kernels are compiled in this process, `cached` for later ones or not."""
    _register("numba:compile", _Around(cached))
