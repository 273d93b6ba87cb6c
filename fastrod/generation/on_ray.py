"""Shards as Ray tasks: each holds one native batch, writes its file itself, and reports only its name to the
driver."""

from __future__ import annotations

import re
import socket
import uuid
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fastrod.errors import HostError, InputError
from fastrod.generation.here import ONE_THREAD, cores
from fastrod.generation.plan import Plan
from fastrod.generation.shards import Shard

_RETRIES = 20  # of a task whose worker or machine is lost
_AHEAD = 2  # tasks for every core of the cluster
_ANSWER = 5.0  # s for the head to take a connection
_NO_CLUSTER = "no Ray cluster answers at {!r}: {} Start one with `ray start --head`, or give --ray local."
_PATIENCE = 120.0  # s until every machine has shown that it sees the folder


def run_on_ray(
    plan: Plan, folder: Path, todo: Sequence[int], address: str, workers: int | None
) -> Generator[Shard, None, None]:
    """Make the shards `todo` on a cluster, in any order: `address` of its head, `auto` for the one here,
    `local` for a new one here of
    `workers` cores. A Ray that is initialised already is used as it is, and left running.

    `workers` bounds the pending tasks. A machine that is lost is no matter: its tasks go elsewhere. Raises
    `HostError` where the cluster does not answer, `InputError` where a machine does not see the folder, and
    what a task raises.
    """
    with _cluster(address, workers) as ray:
        _probe(ray, folder)
        remote = ray.remote(num_cpus=1, max_retries=_RETRIES, runtime_env={"env_vars": ONE_THREAD})(_make)
        what = ray.put(plan)
        coming, pending = iter(todo), list[Any]()
        try:
            while True:
                most = workers or _AHEAD * max(1, int(ray.cluster_resources().get("CPU", 1)))
                while len(pending) < most and (index := next(coming, None)) is not None:
                    pending.append(remote.remote(what, str(folder), index))
                if not pending:
                    return
                ended, pending = ray.wait(pending, num_returns=1)
                yield from (Shard(*_got(ray, reference)) for reference in ended)
        finally:
            for reference in pending:
                ray.cancel(reference, force=True)


def _make(plan: Plan, folder: str, index: int) -> tuple[int, ...]:
    """In a worker."""
    from fastrod.generation.tasks import make_shard

    return tuple(make_shard(plan, folder, index))


def _got(ray: Any, reference: Any) -> Any:
    """A task's result, or what it raised."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        raise error.cause if isinstance(error.cause, Exception) else HostError(_one_line(error)) from error
    except ray.exceptions.RayError as error:
        raise HostError(f"a task on the cluster was lost for good: {_one_line(error)}") from error


@contextmanager
def _cluster(address: str, workers: int | None) -> Iterator[Any]:
    """Ray, connected. Raises `HostError`."""
    import ray

    if ray.is_initialized():
        yield ray
        return
    if match := re.fullmatch(r"(\S+):(\d{1,5})", address):  # Ray itself would try for two minutes
        try:
            socket.create_connection((match[1], int(match[2])), timeout=_ANSWER).close()
        except (OSError, OverflowError) as error:
            raise HostError(_NO_CLUSTER.format(address, _one_line(error))) from error
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "error"}
    try:
        if address == "local":
            ray.init(num_cpus=workers or cores(), include_dashboard=False, **quiet)
        else:
            ray.init(address=address, **quiet)
    except (ConnectionError, ValueError, RuntimeError, TimeoutError) as error:
        raise HostError(_NO_CLUSTER.format(address, _one_line(error))) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _probe(ray: Any, folder: Path) -> None:
    """Every machine writes a file; the driver must find them all. Raises `InputError`."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    answers = {}
    for node in ray.nodes():
        if node["Alive"] and node["Resources"].get("CPU"):
            path = folder / f".probe-{uuid.uuid4().hex[:12]}.part"
            where = NodeAffinitySchedulingStrategy(node_id=node["NodeID"], soft=False)
            answers[node["NodeName"]] = (
                path,
                ray.remote(num_cpus=0, scheduling_strategy=where)(_write_probe).remote(str(path)),
            )
    for name, (path, reference) in answers.items():
        try:
            why = ray.get(reference, timeout=_PATIENCE)
        except ray.exceptions.RayError as error:
            raise HostError(
                f"machine {name} of the cluster cannot run fastrod's tasks: {_one_line(error)}"
            ) from error
        seen = path.is_file()
        path.unlink(missing_ok=True)
        if why or not seen:
            raise InputError(
                f"machine {name} of the cluster does not see folder "
                f"{str(folder)!r}{f' ({why})' if why else ''}; "
                "give --out a folder that all machines see."
            )


def _write_probe(path: str) -> str:
    """In a worker: what is wrong, or nothing."""
    try:
        Path(path).write_text("", encoding="utf-8")
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _one_line(error: BaseException) -> str:
    """The last line that says something, as a sentence."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return (lines[-1] if lines else type(error).__name__).rstrip(".") + "."
