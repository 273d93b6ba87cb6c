"""Say on stderr that a kernel is being compiled: a first run that prints nothing for half a minute looks
hung."""

from __future__ import annotations

import os
import sys
from typing import Any

from numba.core import event

_register: Any = event.register  # it has no types
_LONG = ("fastrod.kernels.", "fastrod.solver.")
_SHORT = "fastrod.kernels.vec"  # of a kernel, or of a shape of contact, which is compiled in a second
_CONTACT = ("iterate_serial", "iterate_parallel", "search_serial", "search_parallel")


class _Notice(event.Listener):
    """Print one line when the first kernel of a process is compiled, and one for the first of contact."""

    def __init__(self, cached: bool) -> None:
        why = "in each process, for no cache folder can be written (FASTROD_CACHE_DIR names one)"
        self._how_often = "once" if cached else why
        self._printed: set[str] = set()

    def on_start(self, what: Any) -> None:
        """Print, unless `FASTROD_QUIET` is set or this line was printed before."""
        function = what.data["dispatcher"].py_func
        module = function.__module__
        if os.environ.get("FASTROD_QUIET") or not module.startswith(_LONG) or module == _SHORT:
            return
        contact = function.__name__ in _CONTACT
        work = "Compiling contact kernels, about two minutes" if contact else "Compiling kernels, about 30 s"
        if work not in self._printed:
            self._printed.add(work)
            print(f"{work}, {self._how_often}.", file=sys.stderr, flush=True)

    def on_end(self, what: Any) -> None:
        """Print nothing: the answer to the call follows."""


def announce(cached: bool) -> None:
    """Print a line on stderr before kernels are compiled in this process, `cached` for later ones or not."""
    _register("numba:compile", _Notice(cached))
