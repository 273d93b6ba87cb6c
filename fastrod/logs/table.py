"""Tables of columns from .csv, .parquet and .mat files, not interpreted."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from importlib import import_module
from itertools import chain
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fastrod.errors import LogError
from fastrod.logs.bag import read_bag
from fastrod.reading import reading
from fastrod.types import Floats

Table: TypeAlias = dict[str, Sequence[str] | Floats]

# of a Parquet file unpacked: 1.5 GB at its peak; the bytes of a CSV, too
_MOST_VALUES, _MOST_BYTES = 30_000_000, 500_000_000
DATE = re.compile(r"\d{4}-\d\d-\d\d")
"""Beginning of a date."""


def read_table(path: str | Path) -> Table:
    """The columns of a .csv, .parquet or .mat, or of a ROS 2 bag, by name, not interpreted: texts of a CSV,
    numbers elsewhere.

    Raises `LogError` for a file that is not there, is empty, or whose rows do not fit its header.
    """
    path = Path(path)
    try:
        if (path / "metadata.yaml").is_file() or path.suffix in (".mcap", ".db3"):
            return dict(read_bag(path, _MOST_BYTES))
        if path.exists() and not path.is_file():  # a pipe or a device may have no end
            raise ValueError("it is no file")
        return _READERS.get(path.suffix.lower(), _read_csv)(path)
    except LogError:
        raise
    # ValueError: bytes that are no text, or a path that no file can have
    except (OSError, ValueError, csv.Error) as error:
        why = (
            "it is not text"
            if isinstance(error, UnicodeDecodeError)
            else getattr(error, "strerror", None) or str(error)
        )
        raise LogError(f"log {str(path)!r} cannot be read: {why}.") from error


def numbers(table: Table, name: str, where: str) -> Floats:
    """(n,) floats of the column `name`; an empty cell is nan. `where` names the file in errors
    (`LogError`)."""
    cells = table[name]
    if isinstance(cells, np.ndarray):
        values = cells
    else:
        try:
            values = np.array([float(cell or "nan") for cell in cells])
        except ValueError:
            values = np.array([_number(cell, row, name, where) for row, cell in enumerate(cells, 1)])
    if np.isinf(values).any():
        row = int(np.argmax(np.isinf(values)))
        raise LogError(
            f"{where} row {row + 1}, column {name} is {values[row]}; it must be finite, or empty "
            "where it is missing."
        )
    return values


def _read_csv(path: Path) -> Table:
    if (size := path.stat().st_size) > _MOST_BYTES:
        raise LogError(f"{path.name} has {size} bytes; a log may have {_MOST_BYTES}. Cut it in parts.")
    lines = (line for line in io.StringIO(_decoded(path.read_bytes()), newline="") if line[0] != "#")
    first = next((line for line in lines if line.strip()), "")
    delimiter = max(",;\t", key=first.count)
    rows = [row for row in csv.reader(chain([first], lines), delimiter=delimiter) if row]
    if delimiter == ";":  # of a spreadsheet where a comma is the decimal point
        rows[1:] = [[cell.replace(",", ".") for cell in row] for row in rows[1:]]
    if not rows:
        raise LogError(
            f"{path.name} is empty; a run log starts with a header such as t,dl_1,tip_x,tip_y,tip_z."
        )
    header = [name.strip() for name in rows[0]]
    _check_header(header, path.name)
    for number, row in enumerate(rows[1:], 1):
        if len(row) != len(header):
            raise LogError(
                f"{path.name} row {number} has {len(row)} values; the header names {len(header)} columns."
            )
    return dict(
        zip(header, zip(*rows[1:], strict=True) if len(rows) > 1 else ((),) * len(header), strict=True)
    )


def _decoded(content: bytes) -> str:
    """A text in UTF-8, or as a spreadsheet writes it: UTF-16 with its mark, or the letters of Windows. Raises
    `UnicodeDecodeError` for bytes that are no text."""
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        return content.decode("utf-16")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        if b"\0" in content:
            raise
        return content.decode("cp1252")


def _check_header(header: list[str], where: str) -> None:
    twice = sorted({name for name in header if header.count(name) > 1})
    if twice:
        raise LogError(f"{where} has column {twice[0]!r} more than once; each name stands for one column.")


def _read_parquet(path: Path) -> Table:
    parquet, pyarrow = arrow("pyarrow.parquet"), arrow("pyarrow")
    table: Table = {}
    try:
        with parquet.ParquetFile(path) as file:
            _check_declared(file.metadata, path.name)
            words = [column.path for column in file.metadata.schema if column.physical_type == "BYTE_ARRAY"]
        content = parquet.read_table(path, read_dictionary=words)  # a word of a million rows is held once
        _check_header(content.column_names, path.name)
        for name in content.column_names:
            column = content.column(name)
            _check_words(column, path.name)
            try:
                cells = column.to_pylist()
            except ValueError:  # times finer than Python's
                cells = column.cast("string").to_pylist()
            table[name] = _cells(cells)
    except pyarrow.ArrowException as error:
        raise LogError(
            f"{path.name} is not a Parquet file: {str(error).splitlines()[0].rstrip('.')}."
        ) from error
    if not table:
        raise LogError(f"{path.name} has no columns.")
    return table


def _check_declared(metadata: Any, where: str) -> None:
    """Raise `LogError` where a file unpacks to more than a run log has; a few kB may declare any number of
    rows."""
    chunks = [
        metadata.row_group(k).column(j)
        for k in range(metadata.num_row_groups)
        for j in range(metadata.row_group(k).num_columns)
    ]
    n_values = max(metadata.num_rows * metadata.num_columns, sum(chunk.num_values for chunk in chunks))
    n_bytes = sum(chunk.total_uncompressed_size for chunk in chunks)
    if n_values > _MOST_VALUES or n_bytes > _MOST_BYTES:
        raise LogError(
            f"{where} declares {n_values} values of {n_bytes} bytes; a log may have {_MOST_VALUES} of "
            f"{_MOST_BYTES} bytes. Split it."
        )


def _check_words(column: Any, where: str) -> None:
    """Raise `LogError` where words that are held once would be too much as cells."""
    compute, n_bytes = arrow("pyarrow.compute"), 0
    for chunk in column.chunks:
        if hasattr(chunk, "dictionary") and len(chunk):
            n_bytes += (
                compute.sum(compute.take(compute.binary_length(chunk.dictionary), chunk.indices)).as_py() or 0
            )
    if n_bytes > _MOST_BYTES:
        raise LogError(
            f"{where} declares a column of {n_bytes} bytes of text; a log may have {_MOST_BYTES}. Split it."
        )


def _cells(cells: Sequence[Any]) -> Sequence[str] | Floats:
    """A column as numbers; as texts, where it holds anything else, such as texts, times or lists."""
    try:
        if not any(isinstance(cell, (str, bytes)) for cell in cells):
            values = np.array([np.nan if cell is None else cell for cell in cells], dtype=np.float64)
            if values.shape == (len(cells),):
                return values
    except (TypeError, ValueError, OverflowError):
        pass
    return ["" if cell is None else str(cell) for cell in cells]


def arrow(name: str) -> Any:
    """The module of pyarrow of this name. Raises `LogError` where it is not installed."""
    try:
        return import_module(name)
    except ImportError as error:
        raise LogError(
            "a .parquet log needs the package pyarrow, which is not installed; install it, or "
            "give the log as .csv."
        ) from error


def _number(cell: str, row: int, name: str, where: str) -> float:
    try:
        return float(cell.strip() or "nan")
    except ValueError:
        dated = ", or for dates [log] of the robot file says units.time = 'iso'" if DATE.match(cell) else ""
        raise LogError(
            f"{where} row {row}, column {name} is {cell!r}; it must be a number, or empty where "
            f"it is missing{dated}."
        ) from None


def _read_mat(path: Path) -> Table:
    """Vectors of one length of a MATLAB file up to version 7.2, and columns of its matrices, numbered; fields
    of a struct as STRUCT_FIELD."""
    from scipy.io import loadmat, whosmat

    with reading(path, path.name, LogError, "is not a MATLAB file", most=_MOST_BYTES):
        try:
            declared = sum(math.prod(shape) for _, shape, _ in whosmat(path))
            if declared > _MOST_VALUES:
                raise LogError(
                    f"{path.name} declares {declared} values; a log may have {_MOST_VALUES}. Split it."
                )
            content = loadmat(path, squeeze_me=False, struct_as_record=True)
        except NotImplementedError as error:
            raise LogError(f"{path.name} is a MATLAB file of version 7.3; save it with -v7.") from error
    every = {name: array for name, array in content.items() if not name.startswith("__")}
    for name, array in list(every.items()):
        if array.dtype.names and array.size == 1:
            every |= {f"{name}_{key}": array[key].item() for key in array.dtype.names}
    numeric = {
        name: np.asarray(array, dtype=np.float64)
        for name, array in every.items()
        if isinstance(array, np.ndarray) and array.dtype.kind in "fiub" and array.ndim == 2 and array.size
    }
    n = max((max(array.shape) for array in numeric.values()), default=0)
    table: Table = {}
    for name, array in numeric.items():
        if n not in array.shape:
            continue
        columns = array if array.shape[0] == n else array.T
        alone = columns.shape[1] == 1
        table |= {name if alone else f"{name}_{k}": column for k, column in enumerate(columns.T, 1)}
    if not table:
        raise LogError(f"{path.name} has no numeric vectors.")
    return table


_READERS = {".parquet": _read_parquet, ".mat": _read_mat}
