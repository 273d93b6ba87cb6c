"""Threads that do not fight: one thread of BLAS while fastrod works; the kernels have threads of their own.

numpy's OpenBLAS starts threads for a product of (1024, k) already. They spin while they wait, and take the
cores from the kernels: Reach with 1,024 robots ran at a quarter of its speed.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from functools import cache, wraps
from typing import ParamSpec, TypeVar

from threadpoolctl import LibController, ThreadpoolController

_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")


@cache
def _libraries(with_scipy: bool) -> list[LibController]:  # noqa: ARG001
    """The BLAS libraries of this process; scipy brings one of its own. Found once: to look takes 5 ms."""
    return [lib for lib in ThreadpoolController().lib_controllers if lib.user_api == "blas"]


class _Held:
    """How many callers hold BLAS at one thread, and what each library had before the first of them."""

    lock = threading.Lock()
    callers = 0
    before: list[tuple[LibController, int]]

    @classmethod
    def enter(cls) -> None:
        """Hold it, or wait for nobody: others that hold it already do so for this caller, too."""
        with cls.lock:
            cls.callers += 1
            if cls.callers == 1:
                libraries = _libraries("scipy.linalg" in sys.modules)
                cls.before = [(lib, n) for lib in libraries if (n := lib.num_threads) != 1]
                for lib, _ in cls.before:
                    lib.set_num_threads(1)

    @classmethod
    def leave(cls) -> None:
        """Let go; the last one gives every library its threads back."""
        with cls.lock:
            cls.callers -= 1
            if cls.callers == 0:
                for lib, n in cls.before:
                    lib.set_num_threads(n)


def one_blas_thread(function: Callable[_Given, _Answer]) -> Callable[_Given, _Answer]:
    """Call `function` with one thread of BLAS in this process; restored after."""

    @wraps(function)
    def held(*args: _Given.args, **kwargs: _Given.kwargs) -> _Answer:
        _Held.enter()
        try:
            return function(*args, **kwargs)
        finally:
            _Held.leave()

    return held
