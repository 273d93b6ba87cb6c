"""A maker's EDS or DCF file for the controller and the emulator; what a drive lacks, and what follows."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from benches import BusBench, Springs

from fastrod.commands.drive import _bench, _Drives
from fastrod.errors import InputError
from fastrod_device.can.dictionary import NEEDED, find, object_dictionary, read_eds
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_device.units import DriveSpec

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")

FOLDER = Path(os.environ.get("FASTROD_DATA", Path(__file__).parents[3] / "shared" / "data"))
DATA = FOLDER / "epos4_objects.csv"
SPECS = [DriveSpec(node=k + 2, drum_radius=0.008) for k in range(2)]


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
    values = {key: var.default if isinstance(var.default, int) else None for key, var in found.items()}
    return {k: Fact(v.data_type, v.access_type, v.pdo_mappable, values[k]) for k, v in found.items()}


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


DRIVES = {"50/5": shipped, "50/15": module_50_15}
HEAD = """[FileInfo] | FileName=drive.eds | EDSVersion=4.0 | CreationDate= | [DeviceInfo] | \
VendorName=Müller & Söhne | NrOfRXPDO= | [Comments] | Line1=100 % µN m | [DummyUsage] | Dummy0001= | \
[MandatoryObjects] | SupportedObjects=1 | 1=0x1000 | [DeviceComissioning] | NodeID={node} | Baudrate=1000"""
RECORD = "[{name}] | ParameterName=Record {index:X} | SubNumber={size} | ObjectType=0x9 | "
VARIABLE = """[{name}] | ParameterName=Thing {index:X} {sub} | ObjectType=0x7 | DataType=0x{kind:04X} | \
AccessType={access} | {key}={number} | PDOMapping={mappable:d} | LowLimit=$NODEID+0x80 | HighLimit= | \
ObjFlags=1 | """


def eds(facts: Facts, *, key: str = "DefaultValue", node: str = "") -> list[str]:
    """Lines as makers write them."""
    texts = [HEAD.format(node=node or 1)]
    for index in dict.fromkeys(index for index, _ in facts):
        members = {sub: fact for (i, sub), fact in facts.items() if i == index}
        record = list(members) != [0]
        if record:
            texts.append(RECORD.format(name=f"{index:X}", index=index, size=len(members)))
        for sub, fact in members.items():
            number = "" if fact.value is None else str(fact.value)
            if number and fact.kind in (4, 7):
                number = f"{int(number) % 2**32:#x}"
            if index in (0x1400, 0x1800) and sub == 1 and not node:
                number = f"$NODEID+0x{fact.value:X}"
            name = f"{index:X}sub{sub:X}" if record else f"{index:X}"
            given = {"name": name, "index": index, "sub": sub, "key": key, "number": number}
            texts.append(VARIABLE.format(**given, **fact._asdict()))
    return [line for text in texts for line in text.split(" | ")]


def untidy(lines: list[str]) -> list[str]:
    """Small letters, indents, comments, lines without a key, a section twice, a parent that is missing."""
    out = ["; made by hand"]
    out += [line.lower() if line.startswith("[") else f"  {line} ; note" if line else "" for line in lines]
    missing = out.index("[607d]")
    return [*out[:missing], *out[out.index("[607dsub0]") :], "just words", "=3", "[1000]", "  ObjectType=0x7"]


WRITTEN = {
    "Windows": lambda lines: "\r\n".join(lines).encode("cp1252"),
    "UTF-8 with its mark": lambda lines: "\n".join(lines).encode("utf-8-sig"),
    "UTF-16": lambda lines: "\r\n".join(lines).encode("utf-16"),
    "objects alone": lambda lines: "\n".join(lines[lines.index("[1000]") :]).encode(),
    "untidy": lambda lines: "\r".join(untidy(lines)).encode("cp1252"),
    "ends early": lambda lines: "\r\n".join(lines).encode("cp1252")[:-20],
}


@pytest.fixture
def write(tmp_path):
    """Write facts as a file of a maker; its path."""

    def write(facts, **how):
        path = tmp_path / "drive.eds"
        path.write_bytes(WRITTEN["Windows"](eds(facts, **how)))
        return path

    return write


def bench(own=None, *, emulated=None):
    return BusBench(SPECS, Springs(2000.0), own=own, emulated=emulated)


@pytest.mark.study
@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("writing", WRITTEN)
def test_a_file_is_read_however_it_is_written(drive, writing, tmp_path):
    facts, path = DRIVES[drive](), tmp_path / "drive.eds"
    path.write_bytes(WRITTEN[writing](eds(facts)))
    od = object_dictionary(path)
    assert {(i, s) for i in od for s in getattr(od[i], "subindices", (0,))} == set(facts)
    for key, fact in facts.items():
        var = find(od, *key)
        kind = 15 if fact.kind == 10 else fact.kind  # bytes
        assert (var.data_type, var.access_type, var.default) == (kind, fact.access, fact.value), key
        assert var.pdo_mappable == fact.mappable or (writing == "ends early" and key == (0x6502, 0))


@pytest.mark.study
@pytest.mark.parametrize("drive", DRIVES)
@pytest.mark.parametrize("how", [{}, {"key": "ParameterValue", "node": "1"}], ids=["EDS", "DCF"])
def test_a_drive_with_a_makers_file_connects_homes_and_moves(drive, how, write):
    path = write(DRIVES[drive](), **how)
    with bench(path, emulated=path) as made:
        made.bus.connect(torque_limit=500, velocity_limit=77_000, position_limit=100_000)
        assert made.bus.notices == ()
        # 500/1000 x 54 mN m / 25.1 mN m/A; 77,000 counts/s / 4096 x 60,000 mrpm
        assert made.held(0x3001, 2) == [1076] * 2
        assert made.held(0x6080) == made.held(0x607F) == [1_127_930] * 2
        assert (made.held(0x607D, 1), made.held(0x607D, 2)) == ([-100_000] * 2, [100_000] * 2)
        end = made.bus.homing(np.full(2, 100), 4000, rounds=1)
        np.testing.assert_array_equal(end.position, np.zeros(2))
        for k in range(40):
            end = made.run(1, np.full(2, 30 * k))[0]
        assert np.all(end.position > 1000)
        assert made.bus.emergency_log == ()


@pytest.mark.skipif(not DATA.is_file(), reason="no epos4_objects.csv here; FASTROD_DATA names its folder")
def test_the_shipped_table_is_what_a_drive_lists():
    with DATA.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["drive"] == "module50_5"]
    listed = {(int(row["index"], 16), int(row["sub"])): row for row in rows}
    facts = shipped()
    assert facts.keys() == listed.keys()
    for key, fact in facts.items():
        row = listed[key]
        expected = (int(row["type"]), row["access"], row["pdo"] == "1")
        assert (fact.kind, fact.access, fact.mappable) == expected, key
        assert row["value"] in ("", str(fact.value)), key


LACKED = {
    "607F": ": the profile velocity is not limited.",
    "6080": ": the speed of its motor is not limited by the drive.",
    "3001": ":02: the current of its motor is not limited.",
    "607D": ":01: the target position is not limited by the drive.",
    "6065": ": the following error is not limited by the drive.",
    "6085": ": the deceleration of a quick stop is the drive's own.",
    "605A": ": after a quick stop it does what it was set to do before.",
    "60C2": ":01: how long it interpolates set-points is the drive's own.",
    "6076": ": its rated torque is not compared with DriveSpec.rated_torque.",
    **dict.fromkeys(("6066", "1018", "1403")),  # nothing follows
}


@pytest.mark.study
@pytest.mark.parametrize("index", LACKED)
@pytest.mark.parametrize("known", [True, False], ids=["by the file", "by the drive alone"])
def test_what_a_drive_lacks_is_left_out_and_said(index, known, write):
    path = write(without(int(index, 16))) if known else None
    with bench(path, emulated=path) as made:
        if not known:
            made.nodes.drop(1, int(index, 16))
        made.bus.connect()
        said = [notice for notice in made.bus.notices if "0x607D:02" not in notice]
        nodes = (2, 3) if known else (3,)  # its file says so of both
        follows = LACKED[index]
        assert sorted(said) == [f"Node {n} has no object 0x{index}{follows}" for n in nodes if follows]
        made.bus.enable()
        for k in range(30):
            end = made.run(1, np.full(2, 20 * k))[0]
        assert np.all(end.position > 400)
        made.bus.quick_stop()
        made.run(10)
        assert not made.nodes.moving.any()


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize(("index", "sub"), [key for key in NEEDED if key[1] < 2])
def test_what_is_needed_is_demanded_by_name(index, sub, write):
    path = write(without(index))
    with pytest.raises(InputError, match=rf"has no object 0x{index:04X}:\d\d \(.+\); is it that of"):
        object_dictionary(path)
    says = rf"the drive at node 3 has no object 0x{index:04X}:0\d \(.+\), which is needed\.$"
    if index in (0x6041, 0x6064, 0x606C, 0x6077, 0x60F4):  # it is mapped and never read
        says = r"node 3 refuses object 0x1A0[01]:0\d"
    late = index in (0x6060, 0x6061, 0x607A)
    if late:
        says = rf"node 3 (refuses|has no) object 0x(1600|{index:X}):0\d"
    with bench() as made:
        made.nodes.drop(1, index)
        with pytest.raises(DeviceError, match=says):  # noqa: PT012 - some are missed when it is enabled only
            made.bus.connect()
            if late:
                made.bus.enable()


@pytest.mark.parametrize(
    ("modes", "says"),
    [
        (0x225, r"profile position, profile velocity, homing, cyclic synchronous torque \(.*225\)\.$"),
        (0x10000, r"none \(object 0x6502 is 0x10000\)\.$"),
    ],
)
def test_a_drive_without_the_cyclic_mode_is_refused_at_once(modes, says, write):
    facts = shipped()
    facts[(0x6502, 0)] = facts[(0x6502, 0)]._replace(value=modes)
    path, lacks = write(facts), "has no cyclic synchronous position mode, which is needed"
    with bench(path, emulated=path) as made:
        before = made.held(0x60A9)
        with pytest.raises(DeviceError, match=f"the drive at node 2 {lacks}; it supports {says}"):
            made.bus.connect()
        assert made.held(0x60A9) == before


EIGHT = r"answers 4 bytes for object 0x6502:00 .* says 8\. Is the EDS file that of this drive\?$"


@pytest.mark.parametrize(
    ("key", "fact", "says"),
    [
        ((0x6040, 0), Fact(2, "rw", True, 0), r"node 2 refuses object 0x6040:00"),
        ((0x6502, 0), Fact(27, "ro", True, None), EIGHT),
        (
            (0x60A9, 0),
            Fact(5, "rw", False, 0),
            r"does not fit object 0x60A9:00 .* data type is 0x05 in its dictionary\.$",
        ),
    ],
)
@pytest.mark.study(beyond=1)
def test_a_file_of_another_drive_is_found_out(key, fact, says, write):
    with bench(write(shipped() | {key: fact})) as made, pytest.raises(DeviceError, match=says):
        made.bus.connect()


def test_rows_of_spaces_are_read_in_no_time(tmp_path):
    path, gap = tmp_path / "wide.eds", " " * 100_000  # hours, where time grows with a power of its length
    path.write_text(
        f"[6040]\nDataType=6\na{gap}b\nDefaultValue=1{gap}2\n[6041]\nDefaultValue={gap}3\nDataType=6\n"
    )
    od = read_eds(path)
    assert (find(od, 0x6040).default, find(od, 0x6041).default) == (None, 3)


def test_what_is_not_limited_is_printed_and_in_the_journal(tmp_path, capsys, write):
    pytest.importorskip(
        "cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'"
    )
    options = _Drives(emulate=True, no_home=True, seed=1, eds=write(without(0x607F)))
    with _bench(options, load_hardware(), journal=tmp_path / "run.csv") as made:
        lacks = "has no object 0x607F: the profile velocity is not limited."
        says = [f"Node {node} {lacks}" for node in range(1, 5)]
        assert capsys.readouterr().err.splitlines() == says
        kept = [line[1:] for line in made.prototype.journal.lines]
        assert kept == [("not limited", sentence) for sentence in says]
        assert [len(node.objects.object_dictionary) for node in made.emulator.drives._nodes] == [163] * 4
