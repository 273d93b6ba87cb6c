"""The hardware file: what it says is what comes out, the camera in it or beside it, and one sentence for each
mistake."""

from dataclasses import replace

import numpy as np
import pytest

from fastrod import load_robot
from fastrod.errors import FastrodError, InputError, UnknownNameError
from fastrod.model.robotfile import save_robot
from fastrod_device.hardware import SHIPPED, load_hardware
from fastrod_device.limits import Limits
from fastrod_device.units import Transmission
from fastrod_device.vision.camera import save_camera

TEXT = SHIPPED.read_text(encoding="utf-8")
START, END = TEXT.index("[camera]"), TEXT.index("[[drive]]")
BESIDE = 'camera = "camera.toml"\n' + TEXT[:START] + TEXT[END:]
"""The file that ships, with its camera in a file of its own."""


@pytest.fixture
def load(tmp_path):
    """The hardware of this text, or of the file that ships with one piece replaced."""

    def load(*words):
        assert len(words) == 1 or words[0] in TEXT
        path = tmp_path / "mine.toml"
        path.write_text(words[0] if len(words) == 1 else TEXT.replace(*words, 1), encoding="utf-8")
        return load_hardware(path)

    return load


def test_the_shipped_file_is_the_prototype():
    hardware = load_hardware()
    assert hardware.robot == load_robot("prototype")
    assert [drive.node for drive in hardware.drives] == [1, 2, 3, 4]
    assert [drive.direction for drive in hardware.drives] == [1, 1, -1, -1]
    assert (hardware.rate, hardware.pretension, hardware.homing_speed) == (100.0, 1.0, 0.001)
    assert (hardware.camera.size, hardware.marker.id) == ((640, 480), 7)
    assert load_hardware(SHIPPED) == hardware


def test_what_is_left_out_has_defaults(load):
    hardware = load(TEXT[: TEXT.index("rate")] + TEXT[TEXT.index("[marker]") :])
    assert hardware.limits == Limits()
    assert (hardware.rate, hardware.pretension, hardware.homing_speed) == (100.0, 1.0, 0.005)


def test_the_camera_may_be_a_file_beside_it(load, tmp_path):
    shipped = load_hardware()
    matrix = (812.5, 0.0, 318.25), (0.0, 811.125, 240.5), (0.0, 0.0, 1.0)
    camera = replace(shipped.camera, matrix=matrix, distortion=(-0.2, 0.1, 0, 0, 0))
    save_camera(camera, tmp_path / "camera.toml")
    assert load(BESIDE).camera == camera
    assert replace(load(BESIDE), camera=shipped.camera) == shipped


def test_the_robot_may_be_a_file_beside_it_or_given(load, tmp_path):
    own = replace(load_robot("prototype"), name="mine")
    save_robot(own, tmp_path / "own.toml")
    assert load('robot = "prototype"', 'robot = "own.toml"').robot == own
    assert load_hardware(None, own).robot is own


def typo(wrong, right):
    return f"has an unknown key {wrong!r}; did you mean {right!r}?"


STEPS = "tells torque in steps of"
RATES = "it must be a number from 50 to 500 Hz."
NAMES = "give a shipped robot's name, or a robot file's in quotes."
ARUCO = "no marker dictionary 'DICT_4X4_5'; did you mean 'DICT_4X4_50'?"
SECOND = "[[drive]]\nnode = 2\ndrum_radius = 0.008\n"
DRUM, COARSE = "node = 3\ndrum_radius = 0.008", "node = 3\ndrum_radius = 0.0008"
WEAK = f"the drive at node 1 {STEPS} 0.113 N of its tendon, so it must be at least 0.114 N."
TWICE = "the drives have node ids [1, 2, 3, 3]; each must be there once."
MISTAKES = {
    "top key": ("pretension", "pretention", typo("pretention", "pretension")),
    "drive key": ("node = 3", "nod = 3", f"drive 3 {typo('nod', 'node')}"),
    "camera key": ("latency = 0.03", "latancy = 0.03", f"[camera] {typo('latancy', 'latency')}"),
    "limit key": ("displacement =", "displacements =", f"[limits] {typo('displacements', 'displacement')}"),
    "no robot": ('robot = "prototype"', "", "lacks robot."),
    "drive without drum": ("drum_radius = 0.008     # m", "", "drive 1 lacks drum_radius."),
    "a word for a number": ("size = 0.018", 'size = "18 mm"', "[marker]: size: Expected 'float', got 'str'."),
    "one of many": ("[640, 480]", '[640, "480"]', "[camera]: size[1]: Expected 'int', got 'str'."),
    "a word for the rate": ("rate = 100.0 ", 'rate = "fast" ', f"rate is 'fast' Hz; {RATES}"),
    "weak pretension": ("pretension = 1.0 ", "pretension = 0.1 ", f"pretension is 0.1 N; {WEAK}"),
    "a coarser drive": (DRUM, COARSE, f"node 3 {STEPS} 1.13 N of its tendon, so it must"),
    "rate out of range": ("rate = 100.0 ", "rate = 5.0 ", f"rate is 5.0 Hz; {RATES}"),
    "drum in mm": ("= 0.008     # m", "= 8", "drive 1: DriveSpec.drum_radius is 8.0 m"),
    "dictionary": ("DICT_4X4_50", "DICT_4X4_5", f"[marker]: {ARUCO}"),
    "number": ("id = 7", "id = 70", "[marker]: Marker.id is 70; it must be a whole number from 0 to 49."),
    "a node twice": ("node = 4", "node = 3", TWICE),
    "too few drives": (SECOND, "", "there are 3 drives and robot 'prototype' has 4 tendons."),
    "robot is a number": ('"prototype"', "3", f"robot is 3; {NAMES}"),
    "no such robot": ('"prototype"', '"prototyp"', "no robot 'prototyp'; did you mean 'prototype'?"),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_sentence(name, load, tmp_path):
    old, new, sentence = MISTAKES[name]
    with pytest.raises(FastrodError) as caught:
        load(old, new)
    said = str(caught.value)
    assert sentence in said
    assert not set("\n`") & set(said)
    assert said.startswith("no robot") or repr(str(tmp_path / "mine.toml")) in said  # a name is the robot's


def test_the_least_pretension_that_is_reported_is_taken(load):
    hardware = load("pretension = 1.0 ", "pretension = 0.114 ")
    assert hardware.pretension == 0.114
    assert np.abs(Transmission(hardware.drives).torque(np.full(4, hardware.pretension))).tolist() == [1] * 4


NO_TABLES = {
    "limits": ("limits = 3\n" + TEXT.replace("[limits]", "[limit]"), "unknown key 'limit'"),
    "camera": (BESIDE.replace('"camera.toml"', "3"), r"\[camera\] is 3; it must be a table"),
    "no camera file": (
        BESIDE.replace("camera.toml", "none.toml"),
        "there is no file .*none.toml.*; give a camera file, or a table",
    ),
    "one drive": ("drive = 3\n" + TEXT[:END], r"drive is one table; write \[\[drive\]\]"),
    "drives": ("drive = [3]\n" + TEXT[:END], "drive 1 is 3; it must be a table"),
    "no TOML": ("robot = ", r"hardware file '.*mine.toml' is not TOML"),
    "camera file": (BESIDE, rf"camera file '.*camera.toml' {typo('rat', 'rate')[:-1]}\?"),
}


@pytest.mark.parametrize("name", NO_TABLES)
def test_tables_and_files_that_are_none(name, load, tmp_path):
    text, sentence = NO_TABLES[name]
    path = tmp_path / "camera.toml"
    save_camera(load_hardware().camera, path)
    path.write_text(path.read_text(encoding="utf-8").replace("rate = ", "rat = "), encoding="utf-8")
    error = UnknownNameError if "unknown key" in sentence else InputError
    with pytest.raises(error, match=sentence):
        load(text)
    with pytest.raises(InputError, match=r"hardware file '.*none.toml' cannot be read: No such file"):
        load_hardware(tmp_path / "none.toml")
