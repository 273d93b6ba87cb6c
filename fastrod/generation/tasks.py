"""One task: a shard, made by a pure function of plan and index, and written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fastrod.generation.columns import Column
from fastrod.generation.plan import Plan
from fastrod.generation.shards import Shard, write


def columns_of(plan: Plan, index: int) -> list[Column]:
    """Return the columns of a shard: the same in whichever process, and however often.

    It is drawn at full length and cut, so that a row stays what it is when the data set grows.
    """
    rows = plan.rows(index)
    columns = plan.work.make(rows.start, plan.shard_rows, (plan.seed, index))
    if len(rows) == plan.shard_rows:
        return columns
    units = next(np.asarray(column.values) for column in columns if column.name == plan.work.index)
    stays = np.flatnonzero(units < rows.stop)
    return [replace(one, values=np.asarray(one.values)[stays]) for one in columns]


def make_shard(plan: Plan, folder: str, index: int) -> Shard:
    """Make a shard and write it; only what it is called and how much it holds goes back."""
    return write(plan, Path(folder), index, columns_of(plan, index))


def missing(plan: Plan, whole: dict[int, Shard]) -> list[int]:
    """Indices of the shards that are not there yet."""
    return [index for index in range(plan.n_shards) if index not in whole]
