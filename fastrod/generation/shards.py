"""Shards: Parquet files that are whole or not there, and say whose they are."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fastrod.errors import InputError
from fastrod.generation.columns import Column
from fastrod.generation.plan import Plan
from fastrod.generation.trajectories import Trajectories

_HASH, _INDEX, _FAILED, _UNITS = b"fastrod_plan", b"fastrod_shard", b"fastrod_failed", b"fastrod_units"
_DYNAMICS = b"fastrod_dynamics"
_NAME = re.compile(r"[a-z]+-(\d{6,})\.parquet")
_LEVEL = 1  # of zstd: random numbers hardly shrink, whatever the effort


class Shard(NamedTuple):
    """A whole file."""

    number: int
    units: int
    """Rows, or episodes."""
    rows: int
    failed: int
    """Units that did not succeed; they are in the file, and marked."""


def path_of(plan: Plan, folder: Path, index: int) -> Path:
    """The file of a shard."""
    return folder / f"{plan.kind}-{index:06d}.parquet"


def write(plan: Plan, folder: Path, index: int, columns: Sequence[Column]) -> Shard:
    """Write a shard, whole or not at all: under a name of its own, to the disk, and only then where it
    belongs.

    Raises `OSError` where the disk is full or the folder gone; nothing is left behind then.
    """
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    made = Shard(index, len(plan.rows(index)), len(columns[0].values), plan.work.failed(columns))
    arrays, kinds = [], []
    for column in columns:
        arrays.append(arrow.array(column.values))
        kinds.append(
            arrow.field(column.name, arrays[-1].type, metadata={"unit": column.unit, "about": column.about})
        )
    about = {_HASH: plan.hash, _INDEX: str(index), _FAILED: str(made.failed), _UNITS: str(made.units)}
    if isinstance(plan.work, Trajectories):
        about[_DYNAMICS] = json.dumps(plan.work.dynamics)
    table = arrow.Table.from_arrays(arrays, schema=arrow.schema(kinds, metadata=about))
    path = path_of(plan, folder, index)
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:12]}.part")
    try:
        with partial.open("wb") as file:
            parquet.write_table(
                table, file, compression="zstd", compression_level=_LEVEL, use_dictionary=False
            )
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)  # noqa: PTH105
    except OSError as error:
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
    return made


def found(plan: Plan, folder: Path) -> dict[int, Shard]:
    """The whole shards of this plan in the folder. One that is torn, whose index cannot be read, or that is
    too short for a count that has grown, is left out and will be written again. Raises `InputError` for a
    shard of another plan, and for one beyond the count."""
    shards: dict[int, Shard] = {}
    for path in sorted(folder.iterdir()):
        match = _NAME.fullmatch(path.name)
        if match is None:
            if path.suffix == ".parquet":
                raise InputError(f"{str(path)!r} is no shard of this plan; give --out a folder of its own.")
            continue
        index = int(match[1])
        metadata = _metadata_of(path)
        if metadata is None:
            continue
        if (
            metadata.get(_HASH, b"").decode() != plan.hash
            or path != path_of(plan, folder, index)
            or index >= plan.n_shards
        ):
            raise InputError(f"{str(path)!r} is a shard of another plan; give --out a folder of its own.")
        if (
            int(metadata[_INDEX]) == index
            and int(metadata[_UNITS]) == len(plan.rows(index))
            and _index(plan, path) is not None
        ):
            shards[index] = Shard(
                index, int(metadata[_UNITS]), int(metadata[b"rows"]), int(metadata[_FAILED])
            )
    return shards


def _metadata_of(path: Path) -> dict[bytes, bytes] | None:
    """Return the metadata of a file, or None where it is torn."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    try:
        with parquet.ParquetFile(path) as file:
            return {**(file.schema_arrow.metadata or {}), b"rows": str(file.metadata.num_rows).encode()}
    except (arrow.ArrowException, OSError):
        return None


def _index(plan: Plan, path: Path) -> Any:
    """The table of a file's index columns, or None where a page of them is broken."""
    import pyarrow as arrow
    import pyarrow.parquet as parquet

    names = [name] if (name := plan.work.index) == "row" else [name, "step"]
    try:
        with parquet.ParquetFile(path) as file:
            table = file.read(columns=names)
    except (arrow.ArrowException, OSError):
        return None
    return table if table.column_names == names else None


def remove_partial_files(folder: Path) -> int:
    """Remove what killed writers left half done; how many that were."""
    partials = [path for path in folder.iterdir() if path.suffix == ".part"]
    for path in partials:
        path.unlink(missing_ok=True)
    return len(partials)


def counted(plan: Plan, folder: Path) -> int:
    """Rows of all shards, after reading their index column: every index occurs, each in its own shard, once
    (an episode: with steps from
    0 on, each once). Raises `InputError` where one is lost or doubled, or a file cannot be read."""
    total, name = 0, plan.work.index
    for shard in range(plan.n_shards):
        path = path_of(plan, folder, shard)
        table = _index(plan, path)
        if table is None:
            raise InputError(f"{str(path)!r} cannot be read; remove it, and generate again.")
        unit: Any = table.column(name).to_numpy()
        wanted = np.arange(plan.rows(shard).start, plan.rows(shard).stop)
        if name == "row":
            good = np.array_equal(np.sort(unit), wanted)
        else:
            step: Any = table.column("step").to_numpy()
            order = np.lexsort((step, unit))
            unit, step = unit[order], step[order]
            begins = np.flatnonzero(np.diff(unit, prepend=-1))
            place = np.arange(len(unit)) - np.repeat(begins, np.diff(begins, append=len(unit)))
            good = np.array_equal(unit[begins], wanted) and np.array_equal(step, place)
        if not good:
            ends = f"from {wanted[0]} to {wanted[-1]}"
            raise InputError(
                f"{str(path)!r} does not hold each {name} {ends} once; remove it, and generate again."
            )
        total += len(unit)
    return total
