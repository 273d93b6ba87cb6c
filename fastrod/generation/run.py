"""`generate`: a plan into a folder of shards; begins, continues, or finds everything there."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, final

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError, shown
from fastrod.generation.here import cores, run_here
from fastrod.generation.on_ray import run_on_ray
from fastrod.generation.plan import PLAN, SHARDS, Plan, settle_plan
from fastrod.generation.shards import counted, found, remove_partial_files
from fastrod.generation.tasks import missing

_LOCK = ".lock"


@final
@dataclass(frozen=True, kw_only=True)
class Summary:
    """Content of a folder, and what this run added."""

    folder: str
    kind: str
    count: int
    """Rows or episodes of the plan; each occurs exactly once."""
    rows: int
    """Lines of all shards together."""
    failed: int
    """Rows or episodes that did not succeed; they are there, and marked."""
    shards: int
    made: int
    """Shards made by this run."""
    made_count: int
    """Rows or episodes of those."""
    seconds: float
    """Duration of this run, start and check included [s]."""
    bytes: int

    @property
    def rate(self) -> float:
        """Rows or episodes a second that this run made; 0 where it made none."""
        return self.made_count / self.seconds if self.made else 0.0


def generate(
    plan: Plan,
    folder: str | Path,
    *,
    workers: int | None = None,
    ray: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Summary:
    """Make all shards of `plan` that are not in `folder` yet, and check that every row is there once.

    `workers` processes here, one for each core by default; with `ray` the tasks of a cluster (`run_on_ray`),
    by default as many as it has cores for. A run that was killed is finished by the same call: a shard is
    there whole or not at all, and is the same whichever process makes it. Call it below `if __name__ ==
    "__main__":`, as with every program that starts processes.

    Raises `InputError` where the folder holds another plan, where another run writes into it, or cannot be
    written; `HostError` where workers or cluster are lost; `OSError` where the disk is full.
    """
    start = time.perf_counter()
    if not isinstance(plan, Plan):
        raise InputError(f"plan is {shown(plan)}; give a fastrod.generation.Plan.")
    if not isinstance(folder, (str, os.PathLike)):
        raise InputError(f"folder is {shown(folder)}; give a path.")
    if ray is not None and not isinstance(ray, str):
        raise InputError(
            f"ray is {shown(ray)}; give the address of a cluster, 'auto' for the one here, or "
            "'local' to start one."
        )
    if workers is not None:
        check_number("workers", workers, Bound(least=1, most=4096), whole=True)
    for module, extra in (("pyarrow", "parquet"), *((("ray", "ray"),) if ray is not None else ())):
        if find_spec(module) is None:
            raise InputError(f"fastrod generate needs {module}: pip install 'fastrod[{extra}]'.")
    folder = Path(folder).absolute()
    with _own(folder) as keep:
        files = folder / SHARDS
        if files.exists() and not files.is_dir():
            raise InputError(
                f"{str(files)!r} is a file; it must be a folder: remove it, or give --out another folder."
            )
        settle_plan(plan, folder)
        files.mkdir(exist_ok=True)
        remove_partial_files(files)
        whole = found(plan, files)
        todo = missing(plan, whole)
        done, made = sum(shard.units for shard in whole.values()), 0
        if progress is not None:
            progress(plan.kind, done, plan.count)
        if todo:
            run = (
                run_here(plan, files, todo, workers or cores())
                if ray is None
                else run_on_ray(plan, files, todo, ray, workers)
            )
            try:
                for shard in run:
                    keep()
                    whole[shard.number] = shard
                    made += shard.units
                    if progress is not None:
                        progress(plan.kind, done + made, plan.count)
            finally:
                run.close()
                remove_partial_files(files)
        rows = counted(plan, files)
        return Summary(
            folder=str(folder),
            kind=plan.kind,
            count=plan.count,
            rows=rows,
            failed=sum(shard.failed for shard in whole.values()),
            shards=plan.n_shards,
            made=len(todo),
            made_count=made,
            seconds=time.perf_counter() - start,
            bytes=sum(path.stat().st_size for path in files.iterdir() if path.suffix == ".parquet"),
        )


@contextmanager
def _own(folder: Path) -> Iterator[Callable[[], None]]:
    """The folder, made where it is not there, for this process alone. What comes is called once there is
    something to keep: an error before leaves the folder as it was. Raises `InputError`."""
    fresh = [path for path in (folder, *folder.parents) if not path.exists()]
    name = folder / _LOCK
    locked_before = name.exists()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = name.open("w")
    except OSError as error:
        why = "it is a file" if folder.is_file() else error.strerror or str(error)
        raise InputError(f"folder {str(folder)!r} cannot be written: {why}.") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(
                f"another fastrod generate writes into {str(folder)!r}; wait for it, or give "
                "--out another folder."
            ) from error
        except OSError:
            pass  # a file system without locks
        before, kept = _State.of(folder), list[bool]()
        try:
            yield lambda: kept.append(True)
        except BaseException:
            if not kept and before.put_back(folder):
                if not locked_before:
                    name.unlink(missing_ok=True)
                with contextlib.suppress(OSError):  # what is not empty stays
                    for path in fresh:
                        path.rmdir()
            raise


class _State(NamedTuple):
    """Content of a folder before the run."""

    plan: bytes | None
    files: frozenset[str] | None
    """In its folder of shards, or None where it has none."""

    @classmethod
    def of(cls, folder: Path) -> _State:
        plan, files = folder / PLAN, folder / SHARDS
        return cls(
            plan.read_bytes() if plan.is_file() else None,
            frozenset(path.name for path in files.iterdir()) if files.is_dir() else None,
        )

    def put_back(self, folder: Path) -> bool:
        """Restore the plan and return True if nothing was made."""
        now = _State.of(folder)
        if (now.files or frozenset()) - (self.files or frozenset()):
            return False
        if self.plan is None:
            (folder / PLAN).unlink(missing_ok=True)
        elif self.plan != now.plan:
            (folder / PLAN).write_bytes(self.plan)
        if self.files is None and now.files is not None:
            (folder / SHARDS).rmdir()
        return True
