"""Plain arrays in a .npz from anywhere: sizes are looked at first, and nothing in it is unpickled."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy

from fastrod.errors import InputError
from fastrod.reading import reading

LARGEST = 64_000_000
"""Bytes that the arrays of a file may have, unless `read_arrays` is given another number; a shipped actor has
0.3 million."""
_MOST = 1000  # arrays of a file
_KINDS = "fiubU"  # numbers, flags and words: no objects, which are pickles


def read_arrays(path: Path, what: str, largest: int = LARGEST) -> dict[str, np.ndarray]:
    """Arrays of a .npz by name. Raises `InputError` for a damaged, too large or foreign file, which is no
    `what`."""
    where = f"{str(path)!r} is {what}, and it"
    context = reading(path, where, InputError, most=4 * largest, hint="; is it whole?")
    with context, zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if len(members) > _MOST or total > largest:
            raise ValueError(
                f"it declares {len(members)} arrays of {total} bytes, more than {_MOST} or {largest}"
            )
        found = {member.filename.removesuffix(".npy"): _array(archive, member) for member in members}
    return found  # noqa: RET504  (as in `read_text`)


def write_arrays(path: Path, arrays: Mapping[str, Any], *, compress: bool = False) -> None:
    """Write a .npz that `read_arrays` reads."""
    with path.open("wb") as file:
        (np.savez_compressed if compress else np.savez)(file, allow_pickle=False, **arrays)


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """The array of a member, whose header must declare as many bytes as it has. Raises `ValueError`."""
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{member.filename!r} is packed as numpy never packs")
    data = archive.read(member)
    held = io.BytesIO(data)
    if npy.read_magic(held) != (1, 0):
        raise ValueError(f"{member.filename!r} is an array of another version than 1.0")
    shape, by_column, dtype = npy.read_array_header_1_0(held)
    if dtype.kind not in _KINDS or dtype.itemsize == 0:
        raise ValueError(f"{member.filename!r} is an array of {dtype}; numbers and words alone are read")
    start = held.tell()
    if math.prod(shape) * dtype.itemsize != len(data) - start:
        raise ValueError(
            f"{member.filename!r} declares shape {shape} of {dtype} and has {len(data) - start} bytes"
        )
    values = np.frombuffer(data, dtype, offset=start) if len(data) > start else np.empty(0, dtype)
    return values.reshape(shape, order="F" if by_column else "C").copy()
