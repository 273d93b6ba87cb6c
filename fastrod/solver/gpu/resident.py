"""`Resident`: the observer's memory on the device and on the host, each array as new as it must be and not
copied before."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numba import cuda

from fastrod.types import Ints, Memory

_cuda: Any = cuda
FIELDS = Memory._fields


def fill(device: Any, array: Any) -> None:
    """Copy into an array on the device that is as large: as rows of numbers, for the simulator stumbles over
    axes of length 1."""
    if device.size:
        device.reshape(-1).copy_to_device(np.ascontiguousarray(array).reshape(-1))


class Resident:
    """The two copies of a `Memory`. A field is stale on the device after the host was let write to it, and
    the other way round."""

    def __init__(self, memory: Memory) -> None:
        self._host = memory
        self._device: dict[str, Any] = {}
        self._stale_here: set[str] = set()
        self._stale_there: set[str] = set(FIELDS)

    def shape(self, field: str) -> tuple[int, ...]:
        """Shape of a field, without a copy."""
        found: tuple[int, ...] = getattr(self._host, field).shape
        return found

    def read(self, fields: Iterable[str] = FIELDS) -> Memory:
        """The memory, in which these fields are up to date: to be read only."""
        for name in self._stale_here.intersection(fields):
            self._device[name].copy_to_host(getattr(self._host, name))
            self._stale_here.discard(name)
        return self._host

    def write(self, fields: Iterable[str] = FIELDS) -> Memory:
        """See `read`, and the caller may write into these fields: the device takes them over before its
        next pass."""
        self._stale_there.update(fields)
        return self.read(fields)

    def there(self) -> Memory:
        """The arrays on the device, up to date."""
        for name in self._stale_there:
            array = getattr(self._host, name)
            if name in self._device:
                fill(self._device[name], array)
            else:
                self._device[name] = _cuda.to_device(np.ascontiguousarray(array))
        self._stale_there.clear()
        return Memory(**self._device)

    def written_there(self, fields: Iterable[str]) -> None:
        """The device has written into these fields."""
        self._stale_here.update(name for name in fields if self._device[name].size)

    def put(self, rows: Ints, new: Memory) -> None:
        """Take these robots' rows from another memory of the same shape."""
        from fastrod.solver.gpu.batch import launch, put_rows

        own, at = self.there(), _cuda.to_device(rows)
        for name in FIELDS:
            into = getattr(own, name)
            values = np.ascontiguousarray(getattr(new, name)[rows]) if len(getattr(new, name)) else None
            if values is not None and values.size:
                flat = _cuda.to_device(values.reshape(len(rows), -1))
                launch(put_rows, len(rows), at, flat, into.reshape(into.shape[0], into.size // into.shape[0]))
        self.written_there(FIELDS)
