"""The hardware file: what it says is what comes out, the camera in it or beside it, and one sentence for each
mistake."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fastrod import load_robot
from fastrod.errors import FastrodError, InputError, UnknownNameError
from fastrod.model.robotfile import save_robot
from fastrod_device.camera import save_camera
from fastrod_device.hardware import SHIPPED, load_hardware
from fastrod_device.limits import Limits
from fastrod_device.units import Transmission

TEXT = SHIPPED.read_text(encoding="utf-8")


def written(folder: Path, old: str = "", new: str = "") -> Path:
    """The file that ships with one piece replaced."""
    assert old in TEXT
    path = folder / "mine.toml"
    path.write_text(TEXT.replace(old, new, 1) if old else TEXT + new, encoding="utf-8")
    return path


def without_camera() -> str:
    start, end = TEXT.index("[camera]"), TEXT.index("[[drive]]")
    return TEXT[:start] + TEXT[end:]


def test_the_shipped_file_is_the_prototype() -> None:
    hardware = load_hardware()
    assert hardware.robot == load_robot("prototype")
    assert [drive.node for drive in hardware.drives] == [1, 2, 3, 4]
    assert [drive.direction for drive in hardware.drives] == [1, 1, -1, -1]
    assert (hardware.rate, hardware.pretension, hardware.homing_speed) == (100.0, 1.0, 0.001)
    assert hardware.camera.size == (640, 480)
    assert hardware.marker.id == 7
    assert load_hardware(SHIPPED) == hardware


def test_what_is_left_out_has_defaults(tmp_path: Path) -> None:
    text = TEXT[: TEXT.index("rate")] + TEXT[TEXT.index("[marker]") :]
    (tmp_path / "short.toml").write_text(text, encoding="utf-8")
    hardware = load_hardware(tmp_path / "short.toml")
    assert hardware.limits == Limits()
    assert (hardware.rate, hardware.pretension, hardware.homing_speed) == (100.0, 1.0, 0.005)


def test_the_camera_may_be_a_file_beside_it(tmp_path: Path) -> None:
    shipped = load_hardware()
    camera = replace(
        shipped.camera,
        matrix=((812.5, 0.0, 318.25), (0.0, 811.125, 240.5), (0.0, 0.0, 1.0)),
        distortion=(-0.2, 0.1, 0, 0, 0),
    )
    save_camera(camera, tmp_path / "camera.toml")
    (tmp_path / "mine.toml").write_text('camera = "camera.toml"\n' + without_camera(), encoding="utf-8")
    hardware = load_hardware(tmp_path / "mine.toml")
    assert hardware.camera == camera
    assert replace(hardware, camera=shipped.camera) == shipped


def test_the_robot_may_be_a_file_beside_it_or_given(tmp_path: Path) -> None:
    own = replace(load_robot("prototype"), name="mine")
    save_robot(own, tmp_path / "own.toml")
    assert load_hardware(written(tmp_path, 'robot = "prototype"', 'robot = "own.toml"')).robot == own
    assert load_hardware(None, own).robot is own


MISTAKES = {
    "top key": ("pretension", "pretention", "has an unknown key 'pretention'; did you mean 'pretension'?"),
    "drive key": ("node = 3", "nod = 3", "drive 3 has an unknown key 'nod'; did you mean 'node'?"),
    "camera key": (
        "latency = 0.03",
        "latancy = 0.03",
        "[camera] has an unknown key 'latancy'; did you mean 'latency'?",
    ),
    "limit key": (
        "displacement =",
        "displacements =",
        "[limits] has an unknown key 'displacements'; did you mean 'displacement'?",
    ),
    "no robot": ('robot = "prototype"', "", "lacks robot."),
    "drive without drum": ("drum_radius = 0.008     # m", "", "drive 1 lacks drum_radius."),
    "a word for a number": ("size = 0.018", 'size = "18 mm"', "[marker]: size: Expected 'float', got 'str'."),
    "one number of many": (
        "size = [640, 480]",
        'size = [640, "480"]',
        "[camera]: size[1]: Expected 'int', got 'str'.",
    ),
    "a word for the rate": (
        "rate = 100.0 ",
        'rate = "fast" ',
        "rate is 'fast'; it must be from 50 to 500 Hz.",
    ),
    "pretension that no drive can tell": (
        "pretension = 1.0 ",
        "pretension = 0.1 ",
        "pretension is 0.1 N; the drive at node 1 tells torque in steps of 0.113 N of its tendon, so it must "
        "be at least 0.114 N.",
    ),
    "a coarser drive": (
        "node = 3\ndrum_radius = 0.008",
        "node = 3\ndrum_radius = 0.0008",
        "node 3 tells torque in steps of 1.13 N of its tendon, so it must",
    ),
    "rate out of range": ("rate = 100.0 ", "rate = 5.0 ", "rate is 5.0; it must be from 50 to 500 Hz."),
    "drum in mm": (
        "drum_radius = 0.008     # m",
        "drum_radius = 8",
        "drive 1: DriveSpec.drum_radius of node 1 is 8",
    ),
    "dictionary": (
        "DICT_4X4_50",
        "DICT_4X4_5",
        "[marker]: no marker dictionary 'DICT_4X4_5'; did you mean 'DICT_4X4_50'?",
    ),
    "marker's number": (
        "id = 7",
        "id = 70",
        "[marker]: Marker.id is 70; DICT_4X4_50 has the numbers 0 to 49.",
    ),
    "a node twice": (
        "node = 4",
        "node = 3",
        "the drives have node ids [1, 2, 3, 3]; each must be there once.",
    ),
    "too few drives": (
        "[[drive]]\nnode = 2\ndrum_radius = 0.008\n",
        "",
        "there are 3 drives and robot 'prototype' has 4 tendons.",
    ),
    "robot is a number": (
        'robot = "prototype"',
        "robot = 3",
        "robot is 3; give a shipped robot's name, or a robot file's in quotes.",
    ),
    "no such robot": (
        'robot = "prototype"',
        'robot = "prototyp"',
        "no robot 'prototyp'; did you mean 'prototype'?",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_sentence(name: str, tmp_path: Path) -> None:
    old, new, sentence = MISTAKES[name]
    path = written(tmp_path, old, new)
    with pytest.raises(FastrodError) as caught:
        load_hardware(path)
    told = str(caught.value)
    assert sentence in told
    assert "\n" not in told
    assert "`" not in told
    assert told.startswith("no robot") or repr(str(path)) in told  # a robot's name is a robot's mistake


def test_the_least_pretension_that_is_told_is_taken(tmp_path: Path) -> None:
    hardware = load_hardware(written(tmp_path, "pretension = 1.0 ", "pretension = 0.114 "))
    assert hardware.pretension == 0.114
    assert np.abs(Transmission(hardware.drives).torque(np.full(4, hardware.pretension))).tolist() == [1] * 4


def test_tables_that_are_none(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    for text, sentence in (
        ("limits = 3\n" + TEXT.replace("[limits]", "[limit]"), "unknown key 'limit'"),
        ("camera = 3\n" + without_camera(), r"\[camera\] is 3; it must be a table"),
        (
            'camera = "none.toml"\n' + without_camera(),
            "there is no file .*none.toml.*; give a camera file, or a table",
        ),
        ("drive = 3\n" + TEXT[: TEXT.index("[[drive]]")], r"drive is one table; write \[\[drive\]\]"),
        ("drive = [3]\n" + TEXT[: TEXT.index("[[drive]]")], "drive 1 is 3; it must be a table"),
    ):
        path.write_text(text, encoding="utf-8")
        with pytest.raises((InputError, UnknownNameError), match=sentence):
            load_hardware(path)


def test_files_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"hardware file '.*none.toml' cannot be read: No such file"):
        load_hardware(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("robot = ", encoding="utf-8")
    with pytest.raises(InputError, match=r"hardware file '.*bad.toml' is not TOML"):
        load_hardware(tmp_path / "bad.toml")
    save_camera(load_hardware().camera, tmp_path / "camera.toml")
    path = tmp_path / "camera.toml"
    path.write_text(path.read_text(encoding="utf-8").replace("rate = ", "rat = "), encoding="utf-8")
    (tmp_path / "mine.toml").write_text('camera = "camera.toml"\n' + without_camera(), encoding="utf-8")
    with pytest.raises(
        UnknownNameError,
        match=r"camera file '.*camera.toml' has an unknown key 'rat'; did "
        r"you mean 'rate'\?",
    ):
        load_hardware(tmp_path / "mine.toml")
