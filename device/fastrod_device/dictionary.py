"""The objects of a drive, as an object dictionary: CiA 301, CiA 402 and a few of an EPOS4's own, built from facts.

The maker's EDS file is not free; who has one may pass it instead.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastrod_device.bus import guest
from fastrod_device.errors import DeviceError

if TYPE_CHECKING:
    import canopen

U8, U16, U32, I8, I16, I32, TEXT = 0x05, 0x06, 0x07, 0x02, 0x03, 0x04, 0x09
"""Data types of CiA 301."""
_MIN, _MAX = -(2**31), 2**31 - 1

# index: name, type, access, value at power-on, may be mapped into a PDO
_VARIABLES: dict[int, tuple[str, int, str, int | str, bool]] = {
    0x1000: ("Device type", U32, "ro", 0x00020192, False),
    0x1001: ("Error register", U8, "ro", 0, True),
    0x1005: ("COB-ID SYNC", U32, "rw", 0x80, False),
    0x1008: ("Manufacturer device name", TEXT, "const", "EPOS4", False),
    0x1014: ("COB-ID EMCY", U32, "rw", 0x80, False),
    0x1017: ("Producer heartbeat time", U16, "rw", 0, False),
    0x30B0: ("Home position", I32, "rw", 0, False),
    0x30B1: ("Home offset move distance", I32, "rw", 0, False),
    0x30B2: ("Current threshold for homing mode", U16, "rw", 500, False),
    0x6007: ("Abort connection option code", I16, "rw", 1, False),
    0x603F: ("Error code", U16, "ro", 0, True),
    0x6040: ("Controlword", U16, "rw", 0, True),
    0x6041: ("Statusword", U16, "ro", 0x40, True),
    0x605A: ("Quick stop option code", I16, "rw", 2, False),
    0x605B: ("Shutdown option code", I16, "rw", 0, False),
    0x605C: ("Disable operation option code", I16, "rw", 1, False),
    0x605D: ("Halt option code", I16, "rw", 1, False),
    0x605E: ("Fault reaction option code", I16, "rw", 2, False),
    0x6060: ("Modes of operation", I8, "rw", 1, True),
    0x6061: ("Modes of operation display", I8, "ro", 1, True),
    0x6064: ("Position actual value", I32, "ro", 0, True),
    0x6065: ("Following error window", U32, "rw", 2000, False),
    0x6066: ("Following error time out", U16, "rw", 0, False),
    0x606C: ("Velocity actual value", I32, "ro", 0, True),
    0x6072: ("Max torque", U16, "rw", 3000, False),
    0x6073: ("Max current", U16, "rw", 3000, False),
    0x6075: ("Motor rated current", U32, "rw", 2151, False),
    0x6076: ("Motor rated torque", U32, "ro", 54000, False),
    0x6077: ("Torque actual value", I16, "ro", 0, True),
    0x607A: ("Target position", I32, "rw", 0, True),
    0x607C: ("Home offset", I32, "rw", 0, False),
    0x607F: ("Max profile velocity", U32, "rw", 50000, False),
    0x6081: ("Profile velocity", U32, "rw", 1000, True),
    0x6083: ("Profile acceleration", U32, "rw", 10000, True),
    0x6084: ("Profile deceleration", U32, "rw", 10000, True),
    0x6085: ("Quick stop deceleration", U32, "rw", 10000, False),
    0x6098: ("Homing method", I8, "rw", 7, False),
    0x609A: ("Homing acceleration", U32, "rw", 1000, False),
    0x60A9: ("SI unit velocity", U32, "rw", 0x00B44700, False),
    0x60F4: ("Following error actual value", I32, "ro", 0, True),
    0x6502: ("Supported drive modes", U32, "ro", 0x000003A5, False),
}
_RECORDS: dict[int, tuple[str, tuple[tuple[str, int, str, int, bool], ...]]] = {
    0x1003: ("Pre-defined error field", tuple((f"Error {k}", U32, "ro", 0, False) for k in range(1, 6))),
    0x1016: ("Consumer heartbeat time", tuple((f"Consumer {k}", U32, "rw", 0, False) for k in (1, 2))),
    0x1018: (
        "Identity object",
        tuple((name, U32, "ro", value, False) for name, value in (("Vendor-ID", 0xFB), ("Product code", 0x6550_0000),
                                                                 ("Revision number", 0x0160_0000), ("Serial number", 0))),
    ),
    0x1029: ("Error behavior", (("Communication error", U8, "rw", 0, False),)),
    0x30D1: ("Torque actual values", (("Torque actual value averaged", I16, "ro", 0, True),)),
    0x607D: ("Software position limit", (("Min position limit", I32, "rw", _MIN, False), ("Max position limit", I32, "rw", _MAX, False))),
    0x6099: ("Homing speeds", (("Speed for switch search", U32, "rw", 100, False), ("Speed for zero search", U32, "rw", 10, False))),
    0x60C2: ("Interpolation time period", (("Time period value", U8, "rw", 1, False), ("Time index", I8, "rw", -3, False))),
}  # fmt: skip
_NEEDED = (
    (0x1000, 0), (0x1016, 1), (0x1017, 0), (0x1018, 1), (0x6007, 0), (0x6040, 0), (0x6041, 0), (0x605A, 0), (0x6060, 0), (0x6061, 0),
    (0x6064, 0), (0x6065, 0), (0x606C, 0), (0x6072, 0), (0x6076, 0), (0x6077, 0), (0x607A, 0), (0x607D, 1), (0x607D, 2), (0x607F, 0),
    (0x6081, 0), (0x6083, 0), (0x6084, 0), (0x6085, 0), (0x6098, 0), (0x6099, 1), (0x609A, 0), (0x60A9, 0), (0x60C2, 1), (0x60F4, 0),
    (0x6502, 0), (0x30B0, 0), (0x30B1, 0), (0x30B2, 0), (0x1400, 1), (0x1600, 1), (0x1800, 1), (0x1801, 1), (0x1A00, 1), (0x1A01, 1),
)  # fmt: skip


def object_dictionary(eds: str | Path | None = None) -> canopen.ObjectDictionary:
    """The dictionary of one drive; from an EDS or DCF file where one is given.

    Raises `DeviceError`: the file cannot be read, or lacks an object that is needed here.
    """
    if eds is not None:
        return _from_file(Path(eds))
    od: canopen.ObjectDictionary = guest("canopen").ObjectDictionary()
    for index, (name, kind, access, value, mappable) in _VARIABLES.items():
        od.add_object(_variable(name, index, 0, kind, access, value, mappable))
    for index, (name, members) in _RECORDS.items():
        _add_record(od, index, name, members)
    for k in range(4):
        _add_record(od, 0x1400 + k, f"RPDO {k + 1} parameter", _communication(0x8000_0000 + 0x200 + 0x100 * k))
        _add_record(od, 0x1800 + k, f"TPDO {k + 1} parameter", _communication(0xC000_0000 + 0x180 + 0x100 * k))
        for base, word in ((0x1600, "RPDO"), (0x1A00, "TPDO")):
            objects = tuple((f"Mapped object {n}", U32, "rw", 0, False) for n in range(1, 9))
            _add_record(od, base + k, f"{word} {k + 1} mapping", objects, count_access="rw", count=0)
    return od


def _communication(cob_id: int) -> tuple[tuple[str, int, str, int, bool], ...]:
    return (("COB-ID", U32, "rw", cob_id, False), ("Transmission type", U8, "rw", 255, False), ("Inhibit time", U16, "rw", 0, False))


def _variable(name: str, index: int, sub: int, kind: int, access: str, value: int | str, mappable: bool) -> Any:
    var = guest("canopen.objectdictionary").ODVariable(name, index, sub)
    var.data_type, var.access_type, var.default, var.pdo_mappable = kind, access, value, mappable
    return var


def _add_record(od: Any, index: int, name: str, members: Any, *, count_access: str = "ro", count: int | None = None) -> None:
    record = guest("canopen.objectdictionary").ODRecord(name, index)
    record.add_member(_variable("Number of entries", index, 0, U8, count_access, len(members) if count is None else count, False))
    for sub, (member, kind, access, value, mappable) in enumerate(members, start=1):
        record.add_member(_variable(member, index, sub, kind, access, value, mappable))
    od.add_object(record)


def _from_file(path: Path) -> canopen.ObjectDictionary:
    if not path.is_file():
        raise DeviceError(f"the EDS file {path} does not exist; give the path of the drive's .eds file, or none.")
    try:
        od: canopen.ObjectDictionary = guest("canopen").import_od(str(path))
    except Exception as error:  # its parser raises of many kinds
        raise DeviceError(f"the EDS file {path} cannot be read: {type(error).__name__}: {error}.") from error
    for index, sub in _NEEDED:
        if od.get_variable(index, sub) is None:
            raise DeviceError(f"the EDS file {path} has no object 0x{index:04X}:{sub:02X}; is it that of a CiA 402 drive (EPOS4)?")
    return od
