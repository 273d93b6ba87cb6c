"""Compilation of kernels: one set of flags, and a cache that never goes stale.

numba keys its cache on the one file of the cached function, so an edit in a helper module would give stale
results. The cache directory is therefore named after a hash of every kernel source, of the arrays' names and
of numba's version; that of a function which is called by its address (`pointed`) also after its own file.
"""

from __future__ import annotations

import gc
import hashlib
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
import numpy as np
from numba import types
from numba.core import cgutils, event
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic

_register: Any = event.register  # it has no types
_PLACE = "fastrod."
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


_Function = TypeVar("_Function", bound=Callable[..., Any])
_config: Any = numba.config
_njit: Any = numba.njit  # its type does not know _nrt
_intrinsic: Any = intrinsic  # untyped
_star: Any = types.StarArgTuple
_typeof: Any = numba.typeof


def _let_threads_sleep() -> None:
    """Load OpenMP so that its threads sleep while they wait: spinning, they take the cores from whoever they
    wait for (a training took eight times as long on two busy cores). It reads this variable once."""
    if ours := "OMP_WAIT_POLICY" not in os.environ:
        os.environ["OMP_WAIT_POLICY"] = "passive"
    with suppress(ImportError):  # numba then takes another pool
        import_module("numba.np.ufunc.omppool")
    if ours:
        del os.environ["OMP_WAIT_POLICY"]


LANES = 16
"""Robots that one pass of a kernel's inner loop holds side by side; the loop over them becomes SIMD code."""

# contract: fused multiply-add. arcp: x / 6 is x times 1/6. nsz: x + 0 is x. None of them may assume that NaN
# is absent:
# NaN is how a lost robot is seen.
_FAST = {"arcp", "contract", "nsz"}


def _cache_dir() -> str | None:
    """A writable folder for compiled kernels, or None."""
    digest = hashlib.sha256(numba.__version__.encode())
    here = Path(__file__).parent
    for source in (*sorted(here.rglob("*.py")), here.parent / "types.py"):
        digest.update(source.name.encode() + source.read_bytes())
    name = digest.hexdigest()[:16]
    homes = [
        os.environ.get("FASTROD_CACHE_DIR"),
        os.environ.get("XDG_CACHE_HOME"),
        Path.home() / ".cache",
        tempfile.gettempdir(),
    ]
    for home in homes:
        if not home:
            continue
        folder = Path(home) / "fastrod" / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                return str(folder)
        except OSError:
            continue
    return None


CACHE_DIR = _cache_dir()
"""Folder of compiled kernels, or None."""
announce(cached=CACHE_DIR is not None)
_let_threads_sleep()


def kernel(function: _Function) -> _Function:
    """Compile `function` as part of the `entry` that calls it.

    Without numba's reference counts: an atomic increment for each array of a NamedTuple at each call cost as
    much as the arithmetic. A kernel may therefore slice arrays but not make them.

    Its array arguments are `noalias` for LLVM: what it writes by one of them it must not reach by another.
    Where LLVM has to check for overlap, a loop over sixteen lanes does not become SIMD code (a step of rods
    of modes took twice as long).
    """
    made = _inner(function, nogil=True)
    if _NUMBA_IS_KNOWN and isinstance(made, _Inner):
        cast(Any, made)._compiler._customize_flags = _noalias
    return made


def entry(function: _Function, folder: str | None = CACHE_DIR) -> _Function:
    """Compile what Python calls, on first call, and keep it across processes in a `folder`, where there is
    one. It may make arrays."""
    return _compile(function, folder)


def parallel_entry(function: _Function) -> _Function:
    """See `entry`, with `prange` spread over threads."""
    return _compile(function, parallel=True)


def inline(function: _Function) -> _Function:
    """A helper that LLVM pastes into its caller: a call left in a loop over lanes would keep it from becoming
    SIMD code.

    numba's own inline="always" pastes before typing and compiles three times as long.
    """
    return _inner(function, forceinline=True)


_UNWRAPPED = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}


# how it keeps code is its own affair: with a version that was not tried, inner code is made as numba does
_NUMBA_IS_KNOWN = numba.version_info[:2] == (0, 68)


class _Linked(JITCodeLibrary):
    """Optimised code that is linked into its callers, and of which no machine code is made: nobody would call
    it, and it took a fifth of the time of the compiler. As code that numba reads from its cache is linked."""

    @property
    def codegen(self) -> Any:
        """Whoever takes the environment of the function, of which code that has no address has no need."""
        return self

    def set_env(self, env_name: str, env: Any) -> None:
        """Ignore the environment: a function that is never called by itself has none."""

    def get_pointer_to_function(self, name: str) -> int:  # noqa: ARG002
        """None; optimised it is from here on."""
        cast(Any, self)._ensure_finalized()
        return 0

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _Inner(CPUDispatcher):
    """Function that kernels call. Numba's wrappers for Python and C took half the time of the compiler, so
    it has none; the first call from Python compiles the function once more, with them."""

    wrapped: Callable[..., Any] | None = None

    def compile(self, sig: Any) -> Any:
        """Compile it, and whatever it calls, to be linked."""
        made_by: Any = cast(Any, self.targetctx).codegen()
        before = made_by._library_class
        made_by._library_class = _Linked if _NUMBA_IS_KNOWN else before
        try:
            return super().compile(sig)
        finally:
            made_by._library_class = before

    def __call__(self, *given: Any) -> Any:
        if self.wrapped is None:
            left_out = {*_UNWRAPPED, "nopython", "boundscheck"}
            self.wrapped = _njit(**{k: v for k, v in self.targetoptions.items() if k not in left_out})(
                self.py_func
            )
        return self.wrapped(*given)


def _inner(function: _Function, **options: bool) -> _Function:
    made = _njit(error_model="numpy", fastmath=_FAST, _nrt=False, **_UNWRAPPED, **options)(function)
    if not _config.DISABLE_JIT:
        made.__class__ = _Inner
    return cast(_Function, made)


def _noalias(flags: Any) -> Any:
    """Numba's flags for a function whose array arguments do not overlap."""
    flags.noalias = True
    return flags


def _compile(function: _Function, folder: str | None = CACHE_DIR, **options: bool) -> _Function:
    before = _config.CACHE_DIR
    _config.CACHE_DIR = folder or before
    try:
        options = {"nogil": True} | options
        made = _njit(cache=folder is not None, error_model="numpy", fastmath=_FAST, **options)(function)
    finally:
        _config.CACHE_DIR = before
    return cast(_Function, made)


def pointed(function: _Function, signature: Any, **options: bool) -> tuple[_Function, int]:
    """`function` compiled by itself for one signature, and its address in this process for a `caller`: the
    kernels that call it need not be compiled again. Without the compiler a number that stands for it.
    `options` of numba's njit, such as nogil=False where Python is called."""
    function = getattr(function, "py_func", function)
    folder = own_folder(getattr(sys.modules.get(function.__module__), "__file__", None))
    compiled = function if _config.DISABLE_JIT else _compile(function, folder, **options)
    return compiled, _address_of(compiled, signature)


def _address_of(compiled: Any, signature: Any) -> int:
    _POINTED.append(compiled)
    if _config.DISABLE_JIT:
        return len(_POINTED)
    result = compiled.get_compile_result(signature)
    return int(result.library.get_pointer_to_function(result.fndesc.llvm_func_name))


_POINTED: list[Any] = []
"""Compiled code stays where it is as long as somebody holds it."""


def own_folder(file: str | None) -> str | None:
    """Return where the code of functions in this file is kept: a folder for each state of it."""
    if CACHE_DIR is None or file is None:  # of a notebook
        return None
    source = Path(file)
    try:
        folder = Path(CACHE_DIR) / f"{source.stem}-{hashlib.sha256(source.read_bytes()).hexdigest()[:16]}"
        folder.mkdir(exist_ok=True)
    except OSError:
        return None
    return str(folder)


def _call(context: Any, builder: Any, made: Any, given: Any) -> Any:
    """Code that calls the function at the address given[0]."""
    kind = context.call_conv.get_function_type(made.return_type, made.args[1:]).as_pointer()
    status, result = context.call_conv.call_function(
        builder, builder.inttoptr(given[0], kind), made.return_type, made.args[1:], given[1:]
    )
    with cgutils.if_unlikely(builder, status.is_error):  # type: ignore[no-untyped-call]
        context.call_conv.return_status_propagate(builder, status)
    return result


def caller(signature: Any) -> Any:
    """A function for kernels, (address, a, b) -> what the function of this signature that is `pointed` there
    returns for a and b."""
    if _config.DISABLE_JIT:
        return lambda address, a, b: _POINTED[address - 1](a, b)

    def call(_: Any, address: Any, a: Any, b: Any) -> Any:  # noqa: ARG001
        return signature.return_type(types.intp, *signature.args), _call

    return _intrinsic(call)


def _call_at(_: Any, address: Any, task: Any, *given: Any) -> Any:  # noqa: ARG001
    """Call the function of a task that is at this address: (task, *given) -> None."""
    made = types.none(types.intp, types.intp, _star(given))

    def generate(context: Any, builder: Any, made: Any, packed: Any) -> Any:
        each = cgutils.unpack_tuple(builder, packed[2])  # type: ignore[no-untyped-call]
        return _call(context, builder, types.none(*made.args[:2], *given), [*packed[:2], *each])

    return made, generate


call_at: Any = (
    (lambda address, *given: _POINTED[address - 1](*given)) if _config.DISABLE_JIT else _intrinsic(_call_at)
)


def _take_next(_: Any, taken: Any) -> Any:
    """Number of the next piece of work: `taken` (1,) counts, for all threads, those that somebody does."""

    def generate(context: Any, builder: Any, made: Any, given: Any) -> Any:
        array = context.make_array(made.args[0])(context, builder, given[0])
        one = context.get_constant(types.int64, 1)
        return builder.atomic_rmw("add", array.data, one, "monotonic")

    return types.int64(taken), generate


def _take_next_alone(taken: Any) -> int:
    taken[0] += 1
    return int(taken[0] - 1)


take_next: Any = _take_next_alone if _config.DISABLE_JIT else _intrinsic(_take_next)


class OnThreads:
    """A kernel of many pieces of work, each for whoever is free: for one thread, or for several.

    Every task calls it with (task, taken, ...), a workspace of its own, and takes piece after piece
    (`take_next`): a thread that another process holds up then does fewer of them, and the others more.

    The loop over threads calls what is compiled already by its address. Had it the kernel in it, LLVM would
    compile that a second time (30 s for a pass of the rod, 3 s for the loop alone).
    """

    def __init__(self, one: Callable[..., None], loop: Callable[..., None]) -> None:
        self.one, self._loop, self._address = one, loop, 0

    def __call__(self, n_tasks: int, *given: Any) -> None:
        """Do all the work in `n_tasks`, side by side if there is more than one."""
        taken = np.zeros(1, np.int64)
        if n_tasks == 1:
            self.one(0, taken, *given)
            return
        if not self._address:
            self._address = self._compiled((taken, *given))
        self._loop(self._address, n_tasks, taken, *given)

    def _compiled(self, given: Sequence[Any]) -> int:
        """Compile both for what is given, and refuse anything else: the loop trusts the address."""
        if _config.DISABLE_JIT:
            return _address_of(self.one, None)
        each, loop = [_typeof(one) for one in given], cast(Any, self._loop)
        loop.compile(types.none(types.intp, types.intp, *each))
        loop.disable_compile()
        # by its types alone, as a call does: by a signature the cache would keep it a second time
        cast(Any, self.one).compile((types.intp, *each))
        return _address_of(self.one, types.none(types.intp, *each))
