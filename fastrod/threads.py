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

from threadpoolctl import ThreadpoolController

FEW = 64
"""Robots whose products BLAS does by one thread anyway (it starts more from 9,216 numbers on): to hold it
costs a robot's step 4 % of its time."""
_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")


@cache
def _libraries(with_scipy: bool) -> list[tuple[Callable[[], int], Callable[[int], object]]]:  # noqa: ARG001
    """Return how to ask and set the threads of each BLAS library of this process; scipy brings one of its
    own. Found once: to look takes 5 ms. OpenBLAS is asked itself: by way of threadpoolctl a call costs 5
    us more, which is 1 % of a robot's step."""
    found = list[tuple[Callable[[], int], Callable[[int], object]]]()
    for lib in ThreadpoolController().lib_controllers:
        names = [name for name in lib.check_symbols if hasattr(lib.dynlib, name)]
        if lib.internal_api == "openblas" and lib.threading_layer == "pthreads":
            found.append((lib.dynlib[names[0]], lib.dynlib[names[0].replace("_get_", "_set_")]))
        elif lib.user_api == "blas":
            found.append((lib.get_num_threads, lib.set_num_threads))
    return found


class _Held:
    """Count of callers that hold BLAS at one thread, and the threads of each library before the first of
    them."""

    lock = threading.Lock()
    callers = 0
    before: list[tuple[Callable[[int], object], int]]

    @classmethod
    def enter(cls) -> None:
        """Hold it, or wait for nobody: others that hold it already do so for this caller, too."""
        with cls.lock:
            cls.callers += 1
            if cls.callers == 1:
                libraries = _libraries("scipy.linalg" in sys.modules)
                cls.before = [(allow, n) for count, allow in libraries if (n := count()) != 1]
                for allow, _ in cls.before:
                    allow(1)

    @classmethod
    def leave(cls) -> None:
        """Let go; the last one gives every library its threads back."""
        with cls.lock:
            cls.callers -= 1
            if cls.callers == 0:
                for allow, n in cls.before:
                    allow(n)


def one_blas_thread(function: Callable[_Given, _Answer]) -> Callable[_Given, _Answer]:
    """Call `function` with one thread of BLAS in this process, restored after."""

    @wraps(function)
    def held(*args: _Given.args, **kwargs: _Given.kwargs) -> _Answer:
        _Held.enter()
        try:
            return function(*args, **kwargs)
        finally:
            _Held.leave()

    return held
