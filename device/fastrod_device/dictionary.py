"""Object dictionaries of drives (CiA 301, CiA 402): the one that ships, a table of facts about an EPOS4, or a maker's EDS or DCF file.

The maker's file is not free, so none ships; `object_dictionary` reads yours.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastrod_device.bus import guest
from fastrod_device.eds import read_eds
from fastrod_device.errors import DeviceError

if TYPE_CHECKING:
    import canopen

Key = tuple[int, int]
"""Index and subindex."""
_KINDS = {"bool": 0x01, "i8": 0x02, "i16": 0x03, "i32": 0x04, "u8": 0x05, "u16": 0x06, "u32": 0x07, "text": 0x09, "bytes": 0x0A, "u64": 0x1B}
NEEDED: tuple[Key, ...] = (
    (0x1000, 0), (0x1016, 1), (0x1017, 0), (0x6007, 0), (0x6040, 0), (0x6041, 0), (0x6060, 0), (0x6061, 0), (0x6064, 0), (0x606C, 0),
    (0x6077, 0), (0x607A, 0), (0x60A9, 0), (0x60F4, 0), (0x6502, 0), (0x1400, 1), (0x1400, 2), (0x1600, 0), (0x1600, 1), (0x1600, 2),
    (0x1800, 1), (0x1800, 2), (0x1801, 1), (0x1801, 2), (0x1A00, 0), (0x1A00, 1), (0x1A00, 2), (0x1A00, 3), (0x1A01, 0), (0x1A01, 1),
    (0x1A01, 2),
)  # fmt: skip
"""Objects without which a drive is not driven: its state, its process data, and what stops it when its controller dies."""


@dataclass(frozen=True)
class Row:
    """One line of the table that ships."""

    index: int
    sub: int | None
    """None for an object without subindices."""
    kind: int
    """Data type (CiA 301)."""
    access: str
    mappable: bool
    value: int | str | None
    """At power-on; None where the drive alone knows."""
    name: str


def object_dictionary(eds: str | Path | None = None) -> canopen.ObjectDictionary:
    """The dictionary of one drive; from an EDS or DCF file where one is given.

    Raises `DeviceError`: the file cannot be read, or lacks an object that is needed here.
    """
    if eds is None:
        return _assembled(_table())
    dictionary = read_eds(Path(eds))
    for index, sub in NEEDED:
        if find(dictionary, index, sub) is None:
            raise DeviceError(f"the EDS file {eds} has no object {titled(index, sub)}; is it that of a CiA 402 drive (EPOS4)?")
    return dictionary


def find(dictionary: Any, index: int, sub: int = 0) -> Any:
    """The variable at this index and subindex, or None; canopen itself makes up members of arrays."""
    entry = dictionary.indices.get(index)
    if entry is None:
        return None
    members = getattr(entry, "subindices", None)
    return (entry if sub == 0 else None) if members is None else members.get(sub)


def titled(index: int, sub: int = 0) -> str:
    """An object's number, with its name where the shipped table has one.

    >>> titled(0x3001, 2)
    '0x3001:02 (output current limit [mA])'
    """
    number = f"0x{index:04X}:{sub:02X}"
    names = {row.index: row.name for row in _table() if not row.sub}
    name = next((row.name for row in _table() if (row.index, row.sub or 0) == (index, sub)), "") or names.get(index, "")
    return f"{number} ({name})" if name else number


@cache
def at_power_on() -> Mapping[Key, int]:
    """Values of the shipped table's numbers: what an emulated drive takes for an object that its own file gives no value, or lacks."""
    return {(row.index, row.sub or 0): row.value for row in _table() if isinstance(row.value, int)}


@cache
def _table() -> tuple[Row, ...]:
    text = (files("fastrod_device") / "epos4.csv").read_text(encoding="utf-8")
    rows: list[Row] = []
    for line in csv.DictReader(text.splitlines()):
        kind, value = _KINDS[line["type"]], line["value"]
        number = (int(value, 0) if kind != _KINDS["text"] else value) if value else None
        for index in _spread(line["index"]):
            for sub in _spread(line["sub"]) if line["sub"] else (None,):
                rows.append(Row(index, sub, kind, line["access"], line["mappable"] == "x", number, line["name"]))
    return tuple(rows)


def _spread(text: str) -> range:
    """Numbers of `5` or `5-7`."""
    first, _, last = text.partition("-")
    return range(int(first, 0), int(last or first, 0) + 1)


def _assembled(rows: Iterable[Row]) -> Any:
    library = guest("canopen.objectdictionary")
    od = library.ObjectDictionary()
    for row in rows:
        own = row.name if row.name and row.name not in od.names else f"{row.name} 0x{row.index:04X}".strip()
        if row.sub is None:
            var = library.ODVariable(own, row.index, 0)
            od.add_object(var)
        else:
            if row.index not in od.indices:
                od.add_object(library.ODRecord(own, row.index))
            name = "number of entries" if row.sub == 0 else row.name or f"entry {row.sub}"
            var = library.ODVariable(name, row.index, row.sub)
            od.indices[row.index].add_member(var)
        var.data_type, var.access_type, var.default, var.pdo_mappable = row.kind, row.access, row.value, row.mappable
    return od
