"""Object dictionaries of drives (CiA 301, CiA 402): a table of facts about an EPOS4, or a maker's file.

The maker's EDS or DCF file is not free, so none ships; `object_dictionary` reads yours.
"""

from __future__ import annotations

import codecs
import csv
import re
from collections.abc import Iterable, Mapping
from configparser import Error, RawConfigParser
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastrod.errors import InputError
from fastrod.reading import reading
from fastrod_device.can.bus import guest

if TYPE_CHECKING:
    import canopen


_OBJECT = re.compile(r"([0-9a-f]{4})(?:\s*sub\s*([0-9a-f]{1,2}))?", re.IGNORECASE)
_NODE_ID = re.compile(r" ?\+? ?\$nodeid ?\+? ?", re.IGNORECASE)
_SIGNED = (0x02, 0x03, 0x10, 0x04, 0x15)
"""Signed whole numbers among the data types of CiA 301."""
_TEXTS = (0x09, 0x0B)
_BYTES = 0x0F
"""DOMAIN: the type of what has none that is known."""
_MEMBERS = 254
"""Most subindices of an object, beside 0."""
_MOST = 20_000
"""Sections, and variables, of a file; EPOS4's have some 600."""
_LARGEST = 16 * 2**20
"""Bytes of a file that can be an EDS; EPOS4's have about 10^5."""


def read_eds(path: Path) -> Any:
    """The canopen object dictionary of a file.

    A value with `$NODEID` is kept without it; a DCF's own values take the place of defaults.
    Raises `InputError` in a sentence: no such file, no EDS, without objects, or with too many.
    """
    where = f"the EDS file {path}"
    with reading(path, where, InputError, most=_LARGEST):
        try:
            sections = _sections(_text(path.read_bytes()))
        except Error as error:
            raise ValueError(f"it is no EDS ({' '.join(str(error).split())})") from error
    if not sections:
        raise InputError(f"{where} describes no object; an EDS has sections such as [6040].")
    members = {key: _members(options) for key, options in sections.items()}
    if len(sections) + sum(members.values()) > _MOST:
        raise InputError(f"{where} cannot be read: it describes more than {_MOST} variables.")
    library = guest("canopen.objectdictionary")
    od = library.ObjectDictionary()
    parents = {index for index, sub in sections if sub is not None}
    for (index, sub), options in sections.items():
        name = options.get("parametername") or "object"
        own = f"{name} 0x{index:04X}" if name in od.names or name == "object" else name
        compact = members[index, sub]
        if index not in od.indices and (index in parents or compact):
            od.add_object(library.ODRecord(own, index))
        if sub is not None:
            od.indices[index].add_member(_variable(library, index, sub, options, name))
        elif compact:
            od.indices[index].add_member(_variable(library, index, 0, {"datatype": "5"}, "number of entries"))
            for member in range(1, compact + 1):
                od.indices[index].add_member(_variable(library, index, member, options, f"{name} {member}"))
        elif index not in parents:
            od.add_object(_variable(library, index, 0, options, own))
    return od


def _members(options: dict[str, str]) -> int:
    """Return the members of an object that is described in one section with all its members."""
    return max(0, min(_number(options.get("compactsubobj", "")) or 0, _MEMBERS))


def _text(data: bytes) -> str:
    """EDS files name no encoding: that of their first bytes, UTF-8, or else Windows'."""
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252", errors="replace")


def _sections(text: str) -> dict[tuple[int, int | None], dict[str, str]]:
    """Options of objects by index and subindex; keys in small letters. A section that comes twice adds up.

    Raises `configparser.Error`.
    """
    parser = RawConfigParser(
        strict=False, allow_no_value=True, delimiters=("=",), comment_prefixes=(";", "#"), default_section=""
    )
    # an indent continues nothing, and a row of spaces would cost the parser the square of its length
    lines = [" ".join(line.replace("\0", "").split()) for line in text.splitlines()]
    if sum(line.startswith("[") for line in lines) > _MOST:
        raise Error(f"it has more than {_MOST} sections")
    parser.read_string("\n".join(line for line in lines if not line.startswith("=")))
    found: dict[tuple[int, int | None], dict[str, str]] = {}
    for name in parser.sections():
        match = _OBJECT.fullmatch(name.strip())
        if match is not None:
            sub = None if match[2] is None else int(match[2], 16)
            options = {key: (value or "").partition(";")[0].strip() for key, value in parser.items(name)}
            found.setdefault((int(match[1], 16), sub), {}).update(options)
    return found


def _variable(library: Any, index: int, sub: int, options: dict[str, str], name: str) -> Any:
    var = library.ODVariable(name, index, sub)
    kind = _number(options.get("datatype", "")) or _BYTES
    var.data_type = kind if kind in library.ODVariable.STRUCT_TYPES or kind in _TEXTS else _BYTES
    access = options.get("accesstype", "").lower()
    var.access_type = access if access in ("ro", "wo", "rw", "rwr", "rww", "const") else "ro"
    var.pdo_mappable = bool(_number(options.get("pdomapping", "")))
    raw = options.get("parametervalue") or options.get("defaultvalue") or ""
    if var.data_type in _TEXTS:
        var.default = raw or None
    elif var.data_type != _BYTES and (value := _number(raw)) is not None:
        bits, least = len(var), 2 ** (len(var) - 1) if var.data_type in _SIGNED else 0
        var.default = (value + least) % 2**bits - least  # 0xFD is -3 where it has a sign
    return var


def _number(text: str) -> int | None:
    """A whole number; None where it is none. `0x-3` is how canopen writes -3."""
    plain = _NODE_ID.sub("", text).strip().replace("0x-", "-0x") or ("0" if text.strip() else "")
    for base in (0, 10):
        with suppress(ValueError):
            return int(plain, base)
    return None


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
