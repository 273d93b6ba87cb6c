"""The objects inside an emulated node, as its dictionary lists them: read and written by SDO, put in PDOs."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

from fastrod_device.can.bus import guest
from fastrod_device.can.dictionary import Key, at_power_on, find

_CODES = {0x01: "?", 0x02: "b", 0x03: "h", 0x04: "i", 0x05: "B", 0x06: "H", 0x07: "I", 0x15: "q", 0x1B: "Q"}
"""Layouts of the whole numbers of CiA 301 that a drive has."""
_NO_OBJECT, _NOT_MAPPABLE, _TOO_LONG = 0x06020000, 0x06040041, 0x06040042
_WRITE_ONLY, _READ_ONLY, _WRONG_LENGTH = 0x06010001, 0x06010002, 0x06070010
_NO_SUB, _BAD_VALUE, _WRONG_STATE = 0x06090011, 0x06090030, 0x08000022
_INVALID, _NO_RTR = 0x8000_0000, 0x4000_0000  # bits of a COB-ID: this PDO does not exist, cannot be asked for

_COB_IDS = (0x1014, *range(0x1400, 0x1404), *range(0x1800, 0x1804))
"""Objects that hold a COB-ID; its low seven bits are the node id."""
_NODE, _ENTRIES = 0x7F, 8
"""Bits of a node id in a COB-ID; the most objects in a PDO."""


@dataclass(frozen=True)
class ProcessData:
    """A PDO as it was mapped."""

    cob_id: int
    """COB-ID of its frames."""
    kind: int
    """Transmission type: 1 to 240 every so many SYNCs, 254 and 255 at once."""
    layout: struct.Struct
    """Layout of its bytes."""
    keys: tuple[Key, ...]
    """The objects in it."""


@final
class Objects:
    """Values of one node's objects; an SDO server's node.

    `live`: objects that are computed when read. `written`: called before a value is stored; it may raise an
    SDO abort.
    """

    def __init__(self, dictionary: Any, node: int) -> None:
        """All at their values of power-on."""
        self.object_dictionary = dictionary
        self.node = node
        self.live: dict[Key, Callable[[], int]] = {}
        self.written: Callable[[Key, int], None] = _nothing
        self.preset: dict[Key, int] = {}
        """Values at power-on that differ from the dictionary's."""
        self.values: dict[Key, int] = {}
        """Values of the objects that the dictionary has."""
        self.remapped = False
        """Process data was mapped anew since somebody set this back."""
        self._bytes: dict[Key, bytes] = {}
        self._abort: Any = guest("canopen").SdoAbortedError
        self.reset()

    def reset(self) -> None:
        """Values of power-on."""
        self.values, self._bytes = {}, {}
        for index, entry in self.object_dictionary.indices.items():
            for sub, var in getattr(entry, "subindices", {0: entry}).items():
                key = (index, sub)
                if var.data_type not in _CODES:
                    self._bytes[key] = str(var.default or "").encode("ascii", "replace")
                    continue
                default = at_power_on().get(key, 0) if var.default is None else int(var.default)
                value = self.preset.get(key, default)
                relative = index in _COB_IDS and sub == (0 if index == 0x1014 else 1)
                self.values[key] = value & ~_NODE | self.node if relative else value

    def drop(self, index: int) -> None:
        """The drive has this object no more."""
        entry = self.object_dictionary.indices.pop(index)
        self.object_dictionary.names.pop(entry.name, None)
        for key in [key for key in self.values if key[0] == index]:
            del self.values[key]

    def get(self, index: int, sub: int = 0) -> int:
        """A value as it is stored; for an object that the dictionary lacks, the shipped one's at power-on."""
        key = (index, sub)
        return self.values[key] if key in self.values else at_power_on().get(key, 0)

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:  # noqa: ARG002
        """Return what an SDO upload returns. Raises an SDO abort: no such object, or write only."""
        var = self._find(index, subindex)
        if not var.readable:
            raise self._abort(_WRITE_ONLY)
        key = (index, subindex)
        if key in self._bytes:
            return self._bytes[key]
        value = self.live[key]() if key in self.live else self.values[key]
        return bytes(var.encode_raw(value))

    def set_data(self, index: int, subindex: int, data: bytes, *_: object, **__: object) -> None:
        """Answer an SDO download. Raises an SDO abort: no such object, read only, of another length, or
        not possible now."""
        var = self._find(index, subindex)
        if not var.writable:
            raise self._abort(_READ_ONLY)
        key = (index, subindex)
        if key in self._bytes:
            self._bytes[key] = bytes(data)
            return
        if 8 * len(data) != len(var):
            raise self._abort(_WRONG_LENGTH)
        value = int(var.decode_raw(bytes(data)))
        self._check_pdo(key, value)
        self.written(key, value)
        self.values[key] = value
        self.remapped |= 0x1400 <= index < 0x1C00

    def refuse(self, code: int = _BAD_VALUE) -> Exception:
        """An SDO abort to be raised."""
        abort: Exception = self._abort(code)
        return abort

    def _find(self, index: int, sub: int) -> Any:
        if index not in self.object_dictionary.indices:
            raise self._abort(_NO_OBJECT)
        var = find(self.object_dictionary, index, sub)
        if var is None:
            raise self._abort(_NO_SUB)
        return var

    def _check_pdo(self, key: Key, value: int) -> None:
        index, sub = key
        base = index & 0xFFFC
        if base in (0x1400, 0x1800) and sub == 2:
            known = value >= 254 or (1 <= value <= 240) or (value == 0 and base == 0x1400)
            if not known:
                raise self._abort(_BAD_VALUE)
        if base == 0x1800 and sub == 1 and not value & _NO_RTR:
            raise self._abort(_BAD_VALUE)  # as drives do that answer no RTR
        if base not in (0x1600, 0x1A00):
            return
        if not self.get(index - 0x200, 1) & _INVALID:
            raise self._abort(_WRONG_STATE)  # its PDO must be invalid while it is mapped
        if sub == 0:
            entries = [self.get(index, n) for n in range(1, value + 1)] if value <= _ENTRIES else []
            if value > _ENTRIES or sum(entry & 0xFF for entry in entries) > 64:
                raise self._abort(_TOO_LONG)
            for entry in entries:
                self._mappable(entry, into="w" if base == 0x1600 else "r")
        else:
            if self.get(index) != 0:
                raise self._abort(_WRONG_STATE)
            if value:
                self._mappable(value, into="w" if base == 0x1600 else "r")

    def _mappable(self, entry: int, into: str) -> Any:
        var = find(self.object_dictionary, entry >> 16, (entry >> 8) & 0xFF)
        if (
            var is None
            or not var.pdo_mappable
            or len(var) != entry & 0xFF
            or var.data_type not in _CODES
            or into not in var.access_type
        ):
            raise self._abort(_NOT_MAPPABLE)
        return var

    def process_data(self, base: int) -> list[ProcessData]:
        """PDOs that exist: RPDOs of base 0x1400, TPDOs of base 0x1800."""
        found = []
        for k in range(4):
            cob_id, kind = self.values.get((base + k, 1), _INVALID), self.values.get((base + k, 2), 255)
            n = min(self.values.get((base + k + 0x200, 0), 0), _ENTRIES)
            entries = [self.values.get((base + k + 0x200, m), 0) for m in range(1, n + 1)]
            keys = tuple((entry >> 16, (entry >> 8) & 0xFF) for entry in entries)
            objects = [find(self.object_dictionary, *key) for key in keys]
            codes = [_CODES.get(var.data_type, "") for var in objects if var is not None]
            if cob_id & _INVALID or not keys or len(codes) < len(keys) or not all(codes):
                continue
            found.append(ProcessData(cob_id & 0x7FF, kind, struct.Struct("<" + "".join(codes)), keys))
        return found


def _nothing(key: Key, value: int) -> None:
    """A value that means nothing to anybody."""
