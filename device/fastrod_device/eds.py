"""EDS and DCF files (CiA 306) as makers write them: any line end or encoding, sections missing or twice.

canopen's own reader ends in a traceback at a byte that is not of the system's encoding, at a missing section
and at an empty figure. So the standard library's reader reads the files; only the objects are canopen's.
"""

from __future__ import annotations

import codecs
import re
from configparser import Error, RawConfigParser
from contextlib import suppress
from pathlib import Path
from typing import Any

from fastrod.errors import InputError
from fastrod_device.bus import guest

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
    if not path.is_file():
        raise InputError(f"{where} does not exist; give the path of the drive's .eds file, or none.")
    try:
        if path.stat().st_size > _LARGEST:
            raise InputError(f"{where} cannot be read: it is larger than {_LARGEST // 2**20} MiB.")
        sections = _sections(_text(path.read_bytes()))
    except OSError as error:
        raise InputError(f"{where} cannot be read: {error.strerror or error}.") from error
    except Error as error:
        why = " ".join(str(error).split())
        raise InputError(f"{where} cannot be read: it is no EDS ({why}).") from error
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
