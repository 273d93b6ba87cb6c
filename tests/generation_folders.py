"""Shared by the tests of data sets: a small plan, and the bits of a folder."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import pyarrow.parquet as parquet

import fastrod
from fastrod.generation import Plan, Shapes, Trajectories
from fastrod.loading import with_line_density
from fastrod.model.robotfile import dumps


def small(count: int = 600, shard_rows: int = 50, seed: int = 3, **words: Any) -> Plan:
    """Shapes of the prototype in tiny shards."""
    work = Shapes(robot=dumps(fastrod.load_robot("prototype")), **words)
    return Plan(work=work, count=count, shard_rows=shard_rows, seed=seed)


def moving(count: int = 2, seed: int = 0, **words: Any) -> Plan:
    """A few short episodes of the prototype with 0.1 kg/m, in motion, in one shard."""
    heavy = with_line_density(fastrod.load_robot("prototype"), 0.1)
    given = {"robot": dumps(heavy), "dynamics": True, "steps": 12, "dt": 0.004} | words
    return Plan(work=Trajectories(**given), count=count, shard_rows=count, seed=seed)


def bits(folder: Path) -> dict[str, str]:
    """Digest of each file in the folder of shards, hidden ones too; none where there is no such folder."""
    paths = sorted((folder / "shards").glob("*"))
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def rows_of(folder: Path, column: str = "row") -> list[int]:
    """The values of a column over all shards, sorted."""
    return sorted(parquet.read_table(folder / "shards", columns=[column]).column(column).to_pylist())
