"""A maker's EDS or DCF file for the controller and the emulator; what a drive lacks, and what follows."""

from __future__ import annotations

import csv
import itertools
import os
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from fastrod.driving import _bench
from fastrod.errors import InputError
from fastrod.types import Floats
from fastrod_device.clock import SteppedClock
from fastrod_device.dictionary import NEEDED, find, object_dictionary
from fastrod_device.drive import DriveBus
from fastrod_device.eds import read_eds
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_device.nodes import EmulatedDrives
from fastrod_device.units import DriveSpec

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")

FOLDER = Path(os.environ.get("FASTROD_DATA", Path(__file__).parents[3] / "shared" / "data"))
DATA = FOLDER / "epos4_objects.csv"
SPECS = [DriveSpec(node=k + 2, drum_radius=0.008) for k in range(2)]
_names = itertools.count()


class Fact(NamedTuple):
    kind: int
    access: str
    mappable: bool
    value: int | None


Facts = dict[tuple[int, int], Fact]


def shipped() -> Facts:
    """A Module 50/5."""
    od = object_dictionary()
    members = ((index, sub) for index in od for sub in getattr(od[index], "subindices", (0,)))
    found = {key: find(od, *key) for key in members}
    return {
        key: Fact(
            var.data_type,
            var.access_type,
            var.pdo_mappable,
            var.default if isinstance(var.default, int) else None,
        )
        for key, var in found.items()
    }


def module_50_15() -> Facts:
    """The other drive: greater currents, another access of the controlword, COB-IDs of a DCF's own node."""
    facts = shipped()
    del facts[(0x2200, 2)]
    facts[(0x3001, 1)], facts[(0x3001, 2)] = Fact(7, "rww", True, 15_000), Fact(7, "rww", True, 30_000)
    facts[(0x6040, 0)] = Fact(6, "rw", True, 0)
    for index in (0x1400, 0x1401, 0x1402, 0x1403, 0x1800, 0x1801, 0x1802, 0x1803):
        facts[(index, 1)] = facts[(index, 1)]._replace(value=(facts[(index, 1)].value or 0) | 1)
    return facts


def without(index: int) -> Facts:
    """The drive, but for one object."""
    return {key: fact for key, fact in shipped().items() if key[0] != index}


DRIVES: dict[str, Callable[[], Facts]] = {"50/5": shipped, "50/15": module_50_15}


def eds(facts: Facts, *, value: str = "DefaultValue", node: str = "") -> list[str]:
    """Lines as makers write them."""
    lines = [
        "[FileInfo]",
        "FileName=drive.eds",
        "EDSVersion=4.0",
        "CreationDate=",
        "[DeviceInfo]",
        "VendorName=Müller & Söhne",
        "NrOfRXPDO=",
    ]
    lines += [
        "[Comments]",
        "Line1=100 % µN m",
        "[DummyUsage]",
        "Dummy0001=",
        "[MandatoryObjects]",
        "SupportedObjects=1",
        "1=0x1000",
    ]
    lines += ["[DeviceComissioning]", f"NodeID={node or 1}", "Baudrate=1000"]
    for index in dict.fromkeys(index for index, _ in facts):
        members = {sub: fact for (i, sub), fact in facts.items() if i == index}
        var = list(members) == [0]
        if not var:
            lines += [
                f"[{index:X}]",
                f"ParameterName=Record {index:X}",
                f"SubNumber={len(members)}",
                "ObjectType=0x9",
                "",
            ]
        for sub, fact in members.items():
            number = "" if fact.value is None else str(fact.value)
            if number and fact.kind in (4, 7):
                number = f"{int(number) % 2**32:#x}"
            if index in (0x1400, 0x1800) and sub == 1 and not node:
                number = f"$NODEID+0x{fact.value:X}"
            lines += [
                f"[{index:X}]" if var else f"[{index:X}sub{sub:X}]",
                f"ParameterName=Thing {index:X} {sub}",
                "ObjectType=0x7",
            ]
            lines += [
                f"DataType=0x{fact.kind:04X}",
                f"AccessType={fact.access}",
                f"{value}={number}",
                f"PDOMapping={int(fact.mappable)}",
            ]
            lines += ["LowLimit=$NODEID+0x80", "HighLimit=", "ObjFlags=1", ""]
    return lines


def untidy(lines: list[str]) -> list[str]:
    """Small letters, indents, comments, lines without a key, a section twice, a parent that is missing."""
    out = [
        "; made by hand",
        *(line.lower() if line.startswith("[") else f"  {line} ; note" if line else "" for line in lines),
    ]
    missing = out.index("[607d]")
    return [*out[:missing], *out[out.index("[607dsub0]") :], "just words", "=3", "[1000]", "  ObjectType=0x7"]


WRITTEN: dict[str, Callable[[list[str]], bytes]] = {
    "Windows": lambda lines: "\r\n".join(lines).encode("cp1252"),
    "UTF-8 with its mark": lambda lines: "\n".join(lines).encode("utf-8-sig"),
    "UTF-16": lambda lines: "\r\n".join(lines).encode("utf-16"),
    "objects alone": lambda lines: "\n".join(lines[lines.index("[1000]") :]).encode(),
    "untidy": lambda lines: "\r".join(untidy(lines)).encode("cp1252"),
    "ends early": lambda lines: "\r\n".join(lines).encode("cp1252")[:-20],
}


class Springs:
    """Tendons as springs."""

    def move(self, t: float, pulled: Floats) -> Floats:
        return np.maximum(0.0, 2000.0 * pulled)


def connected_and_enabled(bus: DriveBus) -> None:
    bus.connect()
    bus.enable()


class Bench:
    """Both ends on one bus, each with the dictionary of this file."""

    def __init__(self, own: Path | None = None, *, emulated: Path | None = None) -> None:
        name, self.clock = f"virtual:eds-{next(_names)}", SteppedClock()
        self.nodes = EmulatedDrives(SPECS, name, clock=self.clock, wires=Springs(), eds=emulated)
        self.bus = DriveBus(SPECS, name, clock=self.clock, rate=100.0, eds=own)

    def held(self, index: int, sub: int = 0) -> list[int]:
        return [node.objects.values[(index, sub)] for node in self.nodes._nodes]

    def __enter__(self) -> Bench:
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.close()
        self.nodes.close()


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("writing", WRITTEN)
def test_a_file_is_read_however_it_is_written(drive: str, writing: str, tmp_path: Path) -> None:
    facts, path = DRIVES[drive](), tmp_path / "drive.eds"
    path.write_bytes(WRITTEN[writing](eds(facts)))
    od = object_dictionary(path)
    assert {(i, s) for i in od for s in getattr(od[i], "subindices", (0,))} == set(facts)
    for key, fact in facts.items():
        var = find(od, *key)
        kind = 15 if fact.kind == 10 else fact.kind  # bytes
        assert (var.data_type, var.access_type, var.default) == (kind, fact.access, fact.value), key
        assert var.pdo_mappable == fact.mappable or (writing == "ends early" and key == (0x6502, 0))


@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("value", ["DefaultValue", "ParameterValue"])
def test_a_drive_with_a_makers_file_connects_homes_and_moves(drive: str, value: str, tmp_path: Path) -> None:
    path = tmp_path / "drive.dcf"
    node = "1" if value == "ParameterValue" else ""
    path.write_bytes(WRITTEN["Windows"](eds(DRIVES[drive](), value=value, node=node)))
    with Bench(path, emulated=path) as bench:
        bench.bus.connect(torque_limit=500, velocity_limit=77_000, position_limit=100_000)
        assert bench.bus.notices == ()
        # 500/1000 x 54 mN m / 25.1 mN m/A; 77,000 counts/s / 4096 x 60,000 mrpm
        assert (bench.held(0x3001, 2), bench.held(0x6080), bench.held(0x607F)) == (
            [1076] * 2,
            [1_127_930] * 2,
            [1_127_930] * 2,
        )
        assert (bench.held(0x607D, 1), bench.held(0x607D, 2)) == ([-100_000] * 2, [100_000] * 2)
        end = bench.bus.homing(np.full(2, 100), 4000, rounds=1)
        np.testing.assert_array_equal(end.position, np.zeros(2))
        for k in range(40):
            bench.clock.sleep_until(bench.clock.now() + 0.01)
            end = bench.bus.exchange(np.full(2, 30 * k))
        assert np.all(end.position > 1000)
        assert bench.bus.emergency_log == ()


@pytest.mark.skipif(not DATA.is_file(), reason="no epos4_objects.csv here; FASTROD_DATA names its folder")
def test_the_shipped_table_is_what_a_drive_lists() -> None:
    with DATA.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["drive"] == "module50_5"]
    listed = {(int(row["index"], 16), int(row["sub"])): row for row in rows}
    facts = shipped()
    assert facts.keys() == listed.keys()
    for key, fact in facts.items():
        row = listed[key]
        assert (fact.kind, fact.access, fact.mappable) == (
            int(row["type"]),
            row["access"],
            row["pdo"] == "1",
        ), key
        assert row["value"] in ("", str(fact.value)), key


@pytest.mark.parametrize(
    ("index", "says"),
    [
        (0x607F, "Node 3 has no object 0x607F: the profile velocity is not limited."),
        (0x6080, "Node 3 has no object 0x6080: the speed of its motor is not limited by the drive."),
        (0x3001, "Node 3 has no object 0x3001:02: the current of its motor is not limited."),
        (0x607D, "Node 3 has no object 0x607D:01: the target position is not limited by the drive."),
        (0x6065, "Node 3 has no object 0x6065: the following error is not limited by the drive."),
        (0x6085, "Node 3 has no object 0x6085: the deceleration of a quick stop is the drive's own."),
        (0x605A, "Node 3 has no object 0x605A: after a quick stop it does what it was set to do before."),
        (
            0x60C2,
            "Node 3 has no object 0x60C2:01: how long it interpolates set-points is the drive's own.",
        ),
        (
            0x6076,
            "Node 3 has no object 0x6076: its rated torque is not compared with DriveSpec.rated_torque.",
        ),
        (0x6066, ""),
        (0x1018, ""),
        (0x1403, ""),
    ],
)
@pytest.mark.parametrize("known", [True, False], ids=["by the file", "by the drive alone"])
def test_what_a_drive_lacks_is_left_out_and_said(index: int, says: str, known: bool, tmp_path: Path) -> None:
    path = tmp_path / "poor.eds"
    path.write_bytes(WRITTEN["Windows"](eds(without(index))))
    with Bench(path if known else None, emulated=path if known else None) as bench:
        if not known:
            bench.nodes.drop(1, index)
        bench.bus.connect()
        said = [notice for notice in bench.bus.notices if "0x607D:02" not in notice]
        also = [says.replace("Node 3", "Node 2")] if known and says else []  # its file says so of both
        assert sorted(said) == sorted([*also, *([says] if says else [])])
        bench.bus.enable()
        for k in range(30):
            bench.clock.sleep_until(bench.clock.now() + 0.01)
            end = bench.bus.exchange(np.full(2, 20 * k))
        assert np.all(end.position > 400)
        bench.bus.quick_stop()
        for _ in range(10):
            bench.clock.sleep_until(bench.clock.now() + 0.01)
            bench.bus.exchange()
        assert not bench.nodes.moving.any()


@pytest.mark.parametrize(("index", "sub"), [key for key in NEEDED if key[1] < 2])
def test_what_is_needed_is_demanded_by_name(index: int, sub: int, tmp_path: Path) -> None:
    path = tmp_path / "poor.eds"
    path.write_bytes(WRITTEN["Windows"](eds(without(index))))
    with pytest.raises(InputError, match=rf"has no object 0x{index:04X}:\d\d \(.+\); is it that of"):
        object_dictionary(path)
    with Bench() as bench:
        bench.nodes.drop(1, index)
        if index in (0x6041, 0x6064, 0x606C, 0x6077, 0x60F4):  # it is mapped and never asked for
            with pytest.raises(DeviceError, match=r"node 3 refuses object 0x1A0[01]:0\d"):
                bench.bus.connect()
        elif index in (0x6060, 0x6061, 0x607A):
            with pytest.raises(DeviceError, match=rf"node 3 (refuses|has no) object 0x(1600|{index:X}):0\d"):
                connected_and_enabled(bench.bus)
        else:
            with pytest.raises(
                DeviceError,
                match=rf"the drive at node 3 has no object 0x{index:04X}:0\d \(.+\), which is needed\.$",
            ):
                bench.bus.connect()


@pytest.mark.parametrize(
    ("modes", "says"),
    [
        (
            0x225,
            r"it supports profile position, profile velocity, homing, cyclic synchronous torque \(.*225\)\.$",
        ),
        (0x10000, r"it supports none \(object 0x6502 is 0x10000\)\.$"),
    ],
)
def test_a_drive_without_the_cyclic_mode_is_refused_at_once(modes: int, says: str, tmp_path: Path) -> None:
    facts, path = shipped(), tmp_path / "old.eds"
    facts[(0x6502, 0)] = facts[(0x6502, 0)]._replace(value=modes)
    path.write_bytes(WRITTEN["Windows"](eds(facts)))
    with Bench(path, emulated=path) as bench:
        before = bench.held(0x60A9)
        with pytest.raises(
            DeviceError,
            match="the drive at node 2 has no cyclic synchronous position mode, which is needed; " + says,
        ):
            bench.bus.connect()
        assert bench.held(0x60A9) == before


@pytest.mark.parametrize(
    ("facts", "says"),
    [
        ({(0x6040, 0): Fact(2, "rw", True, 0)}, r"node 2 refuses object 0x6040:00"),
        (
            {(0x6502, 0): Fact(27, "ro", True, None)},
            r"answers 4 bytes for object 0x6502:00 .* says 8\. Is the EDS file that of this drive\?$",
        ),
        (
            {(0x60A9, 0): Fact(5, "rw", False, 0)},
            r"does not fit object 0x60A9:00 .* data type is 0x05 in its dictionary\.$",
        ),
    ],
)
def test_a_file_of_another_drive_is_found_out(facts: Facts, says: str, tmp_path: Path) -> None:
    path = tmp_path / "other.eds"
    path.write_bytes(WRITTEN["Windows"](eds(shipped() | facts)))
    with Bench(path) as bench, pytest.raises(DeviceError, match=says):
        bench.bus.connect()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "describes no object; an EDS has sections such as [6040]."),
        (b"no dictionary", "it is no EDS (File contains no section headers."),
        (b"[FileInfo]\nFileName=a.eds\n", "describes no object"),
        (bytes(range(256)) * 8, "it is no EDS"),
        (b"[6040]\nParameterName=only one\nDataType=0x6\n", "has no object 0x1000:00 (device type)"),
        (
            b"[6040]\nDataType=\nCompactSubObj=0xFFFFFFFF\nPDOMapping=yes\nDefaultValue=$NODEID\n",
            "has no object 0x1000:00",
        ),
        (
            b"".join(b"[%04X]\nCompactSubObj=254\n" % k for k in range(100)),
            "describes more than 20000 variables.",
        ),
        (b"[a]\n" * 20_001, "it has more than 20000 sections"),
    ],
)
def test_what_is_no_such_file_is_one_sentence(data: bytes, says: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.eds"
    path.write_bytes(data)
    with pytest.raises(InputError) as caught:
        object_dictionary(path)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_rows_of_spaces_are_read_in_no_time(tmp_path: Path) -> None:
    path, gap = tmp_path / "wide.eds", " " * 100_000  # hours, where time grows with a power of its length
    path.write_text(f"[6040]\nDataType=6\na{gap}b\nDefaultValue=1{gap}2\n[6041]\nDefaultValue={gap}3\nDataType=6\n")
    od = read_eds(path)
    assert (find(od, 0x6040).default, find(od, 0x6041).default) == (None, 3)


def test_what_is_not_limited_is_printed_and_in_the_journal(tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")
    path, events = tmp_path / "poor.eds", tmp_path / "run.csv"
    path.write_bytes(WRITTEN["Windows"](eds(without(0x607F))))
    options = Namespace(emulate=True, no_home=True, seed=1, real_time=False, eds=path, bus=None, camera=None)
    with _bench(options, load_hardware(), journal=events) as bench:
        lacks = "has no object 0x607F: the profile velocity is not limited."
        says = [f"Node {node} {lacks}" for node in range(1, 5)]
        assert capsys.readouterr().err.splitlines() == says
        kept = [line[1:] for line in bench.prototype.journal.lines]
        assert kept == [("not limited", sentence) for sentence in says]
        assert [len(node.objects.object_dictionary) for node in bench.emulator.drives._nodes] == [163] * 4
