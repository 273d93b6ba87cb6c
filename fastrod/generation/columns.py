"""Columns of a shard: values, with their unit and meaning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Column:
    """One column of a shard."""

    name: str
    values: NDArray[Any] | Sequence[str]
    """(n_rows,)."""
    unit: str
    """SI; empty for what has none."""
    about: str
    """Description in a few words."""


def several(names: Sequence[str], values: NDArray[Any], unit: str, about: str) -> list[Column]:
    """A column for each of the last axis of `values` (n_rows, len(names))."""
    return [Column(name, np.ascontiguousarray(values[:, k]), unit, about) for k, name in enumerate(names)]


def numbered(prefix: str, values: NDArray[Any], unit: str, about: str) -> list[Column]:
    """Return columns of `values` (n_rows, m) named prefix_1 to prefix_m."""
    return several([f"{prefix}_{k}" for k in range(1, values.shape[1] + 1)], values, unit, about)
