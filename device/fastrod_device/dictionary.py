"""Object dictionaries of drives (CiA 301, CiA 402): a table of facts about an EPOS4, or a maker's file.

The maker's EDS or DCF file is not free, so none ships; `object_dictionary` reads yours.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastrod.errors import InputError
from fastrod_device.bus import guest
from fastrod_device.eds import read_eds

if TYPE_CHECKING:
    import canopen

Key = tuple[int, int]
"""Index and subindex."""
_NUMBERS = {"bool": 1, "i8": 2, "i16": 3, "i32": 4, "u8": 5, "u16": 6, "u32": 7, "u64": 27}
_KINDS = {**_NUMBERS, "text": 9, "bytes": 10}
"""Data types (CiA 301) by the table's words."""
NEEDED: tuple[Key, ...] = (
    *((index, 0) for index in (0x1000, 0x1017, 0x6007, 0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x606C)),
    *((index, 0) for index in (0x6077, 0x607A, 0x60A9, 0x60F4, 0x6502)),
    *((index, sub) for index in (0x1400, 0x1800, 0x1801) for sub in (1, 2)),
    *((index, sub) for index in (0x1600, 0x1A00, 0x1A01) for sub in (0, 1, 2)),
    (0x1016, 1),
    (0x1A00, 3),
)
"""Objects without which a drive is not driven: state, PDOs, and what stops it when its controller dies."""


@dataclass(frozen=True, kw_only=True)
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

    Raises `InputError`: the file cannot be read, or lacks an object that is needed here.
    """
    if eds is None:
        return _assembled(_table())
    dictionary: canopen.ObjectDictionary = read_eds(Path(eds))
    for index, sub in NEEDED:
        if find(dictionary, index, sub) is None:
            lacks = f"the EDS file {eds} has no object {titled(index, sub)}"
            raise InputError(f"{lacks}; is it that of a CiA 402 drive (EPOS4)?")
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
    number, names = f"0x{index:04X}:{sub:02X}", {(row.index, row.sub or 0): row.name for row in _table()}
    name = names.get((index, sub)) or names.get((index, 0))
    return f"{number} ({name})" if name else number


@cache
def at_power_on() -> Mapping[Key, int]:
    """Values of the shipped table's numbers: an emulated drive's where its own file says nothing."""
    return {(row.index, row.sub or 0): row.value for row in _table() if isinstance(row.value, int)}


@cache
def _table() -> tuple[Row, ...]:
    text = (files("fastrod_device") / "epos4.csv").read_text(encoding="utf-8")
    return tuple(row for line in csv.DictReader(text.splitlines()) for row in _rows(line))


def _rows(line: Mapping[str, str]) -> Iterable[Row]:
    value = None if not line["value"] else line["value"] if line["type"] == "text" else int(line["value"], 0)
    for index in _spread(line["index"]):
        for sub in _spread(line["sub"]) if line["sub"] else (None,):
            yield Row(
                index=index,
                sub=sub,
                kind=_KINDS[line["type"]],
                access=line["access"],
                mappable=line["mappable"] == "x",
                value=value,
                name=line["name"],
            )


def _spread(text: str) -> range:
    """Numbers of `5` or `5-7`."""
    first, _, last = text.partition("-")
    return range(int(first, 0), int(last or first, 0) + 1)


def _assembled(rows: Iterable[Row]) -> canopen.ObjectDictionary:
    library = guest("canopen.objectdictionary")
    od: canopen.ObjectDictionary = library.ObjectDictionary()
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
        var.data_type, var.access_type = row.kind, row.access
        var.default, var.pdo_mappable = row.value, row.mappable
    return od
