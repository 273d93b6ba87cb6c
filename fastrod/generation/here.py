"""Shards on the cores here: processes of one thread each."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import connection, get_context, parent_process
from pathlib import Path

from fastrod.errors import HostError
from fastrod.generation.plan import Plan
from fastrod.generation.shards import Shard
from fastrod.generation.tasks import make_shard

MOST_DEATHS = 3
"""Pools in a row that die without a single shard: then the work itself kills them, and not somebody."""
ONE_THREAD = dict.fromkeys(
    ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
_AHEAD = 2  # tasks a worker has before it, so that it never waits for the driver


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1


def run_here(plan: Plan, folder: Path, todo: Sequence[int], workers: int) -> Generator[Shard, None, None]:
    """Make the shards `todo` with so many processes, in any order. Killed workers are replaced, and their
    shards made again.

    An interrupt lets the pending shards of several processes be finished; the one of a single process, this
    one, is dropped. Raises what a task raises, and `HostError` where every worker dies.
    """
    if workers == 1:
        for index in todo:
            yield make_shard(plan, str(folder), index)
        return
    left, deaths = list(todo), 0
    while left:
        done: set[int] = set()
        try:
            for shard in _pool(plan, folder, left, min(workers, len(left))):
                done.add(shard.number)
                yield shard
        except BrokenProcessPool as error:
            deaths = 0 if done else deaths + 1
            if deaths >= MOST_DEATHS:
                raise HostError(
                    f"the workers died {deaths} times without a shard; is there memory enough for {workers}?"
                ) from error
        left = [index for index in left if index not in done]


def _pool(plan: Plan, folder: Path, todo: Sequence[int], workers: int) -> Iterator[Shard]:
    """The shards of one pool. Raises `BrokenProcessPool` where a worker is killed; what was whole before has
    been handed out."""
    with one_thread():
        pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_begin)
        try:
            coming = iter(todo)
            pending: set[Future[Shard]] = set()
            while True:
                for index in coming:
                    pending.add(pool.submit(make_shard, plan, str(folder), index))
                    if len(pending) >= workers * _AHEAD:
                        break
                if not pending:
                    return
                ended, pending = wait(pending, return_when=FIRST_COMPLETED)
                broken: BrokenProcessPool | None = None
                for future in ended:
                    if isinstance(error := future.exception(), BrokenProcessPool):
                        broken = error
                    else:
                        yield future.result()
                if broken is not None:
                    raise broken
        finally:
            pool.shutdown(cancel_futures=True)


def _begin() -> None:
    """In a worker: the driver decides what an interrupt means, and without a driver there is no work."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_leave_with, args=(parent.sentinel,), daemon=True).start()


def _leave_with(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)


@contextmanager
def one_thread() -> Iterator[None]:
    """Set the environment of processes that are started meanwhile to one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
