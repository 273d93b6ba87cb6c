"""The objects inside an emulated node: read and written by SDO, mapped into process data as the master wrote."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

from fastrod_device.bus import guest
from fastrod_device.dictionary import I8, I16, I32, U8, U16, U32

_CODES = {U8: "B", U16: "H", U32: "I", I8: "b", I16: "h", I32: "i"}
_NO_OBJECT, _NOT_MAPPABLE, _TOO_LONG = 0x06020000, 0x06040041, 0x06040042
_READ_ONLY, _WRONG_LENGTH, _NO_SUB, _BAD_VALUE, _WRONG_STATE = 0x06010002, 0x06070010, 0x06090011, 0x06090030, 0x08000022
_INVALID, _NO_RTR = 0x8000_0000, 0x4000_0000  # bits of a COB-ID: this PDO does not exist, cannot be asked for

Key = tuple[int, int]
"""Index and subindex."""


@dataclass(frozen=True)
class ProcessData:
    """A PDO as it was mapped."""

    cob_id: int
    """Of its frames."""
    kind: int
    """Transmission type: 1 to 240 every so many SYNCs, 254 and 255 at once."""
    layout: struct.Struct
    """Of its bytes."""
    keys: tuple[Key, ...]
    """The objects in it."""


@final
class Objects:
    """Values of one node's objects; an SDO server's node.

    `live`: objects that are computed when read. `written`: called before a value is stored; it may raise an SDO abort.
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
        self._texts: dict[Key, str] = {}
        self._abort: Any = guest("canopen").SdoAbortedError
        self.reset()

    def reset(self) -> None:
        """Values of power-on."""
        self.values, self._texts = {}, {}
        for index in self.object_dictionary:
            entry = self.object_dictionary[index]
            for var in entry.values() if isinstance(entry, Mapping) else (entry,):
                key = (index, var.subindex)
                if isinstance(var.default, str):
                    self._texts[key] = var.default
                else:
                    follows = index == 0x1014 or ((index & 0xFC00) in (0x1400, 0x1800) and index & 0x200 == 0 and var.subindex == 1)
                    self.values[key] = int(var.default or 0) + (self.node if follows else 0)
        self.values.update(self.preset)

    def get_data(self, index: int, subindex: int, check_readable: bool = False) -> bytes:  # noqa: ARG002
        """What an SDO upload returns. Raises an SDO abort where there is no such object."""
        var = self._find(index, subindex)
        key = (index, subindex)
        if key in self._texts:
            return self._texts[key].encode()
        value = self.live[key]() if key in self.live else self.values[key]
        return bytes(var.encode_raw(value))

    def set_data(self, index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:  # noqa: ARG002
        """What an SDO download does. Raises an SDO abort: no such object, read only, of another length, or not possible now."""
        var = self._find(index, subindex)
        if not var.writable:
            raise self._abort(_READ_ONLY)
        if 8 * len(data) != len(var):
            raise self._abort(_WRONG_LENGTH)
        value = int(var.decode_raw(bytes(data)))
        key = (index, subindex)
        self._check_pdo(key, value)
        self.written(key, value)
        self.values[key] = value

    def refuse(self, code: int = _BAD_VALUE) -> Exception:
        """An SDO abort to be raised."""
        abort: Exception = self._abort(code)
        return abort

    def _find(self, index: int, sub: int) -> Any:
        if index not in self.object_dictionary:
            raise self._abort(_NO_OBJECT)
        var = self.object_dictionary.get_variable(index, sub)
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
        if not self.values[(index - 0x200, 1)] & _INVALID:
            raise self._abort(_WRONG_STATE)  # its PDO must be invalid while it is mapped
        if sub == 0:
            entries = [self.values[(index, n)] for n in range(1, value + 1)] if value <= 8 else []
            if value > 8 or sum(entry & 0xFF for entry in entries) > 64:
                raise self._abort(_TOO_LONG)
            for entry in entries:
                self._mappable(entry, into="w" if base == 0x1600 else "r")
        else:
            if self.values[(index, 0)] != 0:
                raise self._abort(_WRONG_STATE)
            if value:
                self._mappable(value, into="w" if base == 0x1600 else "r")

    def _mappable(self, entry: int, into: str) -> Any:
        var = self.object_dictionary.get_variable(entry >> 16, (entry >> 8) & 0xFF)
        if var is None or not var.pdo_mappable or len(var) != entry & 0xFF or var.data_type not in _CODES or into not in var.access_type:
            raise self._abort(_NOT_MAPPABLE)
        return var

    def process_data(self, base: int) -> list[ProcessData]:
        """PDOs that exist: RPDOs of base 0x1400, TPDOs of base 0x1800."""
        found = []
        for k in range(4):
            cob_id, n = self.values[(base + k, 1)], self.values[(base + k + 0x200, 0)]
            if cob_id & _INVALID or n == 0:
                continue
            entries = [self.values[(base + k + 0x200, m)] for m in range(1, n + 1)]
            keys = tuple((entry >> 16, (entry >> 8) & 0xFF) for entry in entries)
            codes = "".join(_CODES[self.object_dictionary.get_variable(*key).data_type] for key in keys)
            found.append(ProcessData(cob_id & 0x7FF, self.values[(base + k, 2)], struct.Struct("<" + codes), keys))
        return found


def _nothing(key: Key, value: int) -> None:
    """A value that means nothing to anybody."""
