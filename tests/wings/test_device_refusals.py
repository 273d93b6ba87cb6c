"""Impossible demands on the device's modules give one sentence: a row is what is given, and what is said."""

import math
from dataclasses import replace

import numpy as np
import pytest
from benches import BusBench, Springs

from fastrod import Robot, Segment
from fastrod.errors import InputError, UnknownNameError
from fastrod.model.robotfile import load_robot
from fastrod_device.can.bus import open_bus
from fastrod_device.can.clock import SteppedClock
from fastrod_device.can.dictionary import object_dictionary
from fastrod_device.can.drive import DriveBus
from fastrod_device.can.pacer import Pacer
from fastrod_device.emulator.nodes import EmulatedDrives
from fastrod_device.emulator.plant import Plant
from fastrod_device.emulator.plant_rod import PlantRod
from fastrod_device.emulator.seal import seal
from fastrod_device.errors import CalibrationError, DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_device.limits import Limits, limited
from fastrod_device.prototype import Prototype
from fastrod_device.safety import Fault, Supervisor
from fastrod_device.units import DriveSpec
from fastrod_device.vision.calibration import CharucoBoard, calibrate, register_base
from fastrod_device.vision.camera import Camera, CameraFrame, Marker, load_camera
from fastrod_device.vision.drawing import DrawnScene
from fastrod_device.vision.tracker import MarkerTracker

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

NAN, INF = math.nan, math.inf
ROBOT = load_robot("prototype")
STIFFNESS = {"bending_stiffness": (0.002, 0.002), "torsional_stiffness": 0.001}
BARE = Robot(name="bare", segments=(Segment(length=0.07, mode="passive", **STIFFNESS),))
SPECS = [DriveSpec(node=k + 1, drum_radius=0.008) for k in range(4)]
CAMERA = Camera(matrix=((800.0, 0.0, 319.5), (0.0, 800.0, 239.5), (0.0, 0.0, 1.0)), size=(640, 480))
MARKER = Marker(size=0.015, id=7)
BOARD = CharucoBoard(columns=7, rows=5, square=0.02, marker=0.015, dictionary="DICT_4X4_50")
NONE, SMALL = (np.zeros(shape, dtype=np.uint8) for shape in ((480, 640), (100, 640)))
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def spec(**given):
    return DriveSpec(**({"node": 1, "drum_radius": 0.008} | given))


def drives(*specs, rate=200.0):
    return EmulatedDrives(specs, "virtual:none", clock=SteppedClock(), tendons=Springs(), rate=rate)


def drive_bus(rate):
    return DriveBus(SPECS, "virtual:none", clock=SteppedClock(), rate=rate)


def step(wanted, rate, dt):
    return limited(np.zeros(4), np.full(4, wanted), rate, dt)


def register(images, position=np.zeros(3), quaternion=UPRIGHT):  # noqa: B008
    return register_base(images, BOARD, CAMERA, position=position, quaternion=quaternion)


def flat():
    return replace(CAMERA, matrix=((0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (0.0, 0.0, 1.0)))


def look_at(image):
    return MarkerTracker(CAMERA, MARKER).look(CameraFrame(image=image, t=0.0, number=1))


MS, STEP, WHOLE = "whole number of ms", r"finite|must be positive", "it must be a whole number from 0"
ALONE = {
    # limits and the supervisor
    "limit in mm": (lambda: Limits(displacement=8.0), "given in mm"),
    "limit in mm/s": (lambda: Limits(rate=30.0), "given in mm/s"),
    "limit in ms": (lambda: Limits(cycle=100.0), "given in ms"),
    "slack above tension": (lambda: Limits(slack=15.0), "least must be below"),
    "step to nowhere": (lambda: step(NAN, 0.03, 0.01), STEP),
    "step to infinity": (lambda: step(INF, 0.03, 0.01), STEP),
    "step back in time": (lambda: step(0.0, 0.03, -0.01), STEP),
    "step without rate": (lambda: step(0.0, 0.0, 0.01), STEP),
    "step without time": (lambda: step(0.0, 0.03, NAN), STEP),
    "no tendons": (lambda: Supervisor(BARE, Limits()), "has no tendons"),
    "too few nodes": (
        lambda: Supervisor(ROBOT, Limits(), nodes=(1, 2, 3)),
        "nodes has 3 node ids and the robot 4 tendons",
    ),
    "fault": (lambda: Fault(kind="bus of", sentence="", t=0.0), "did you mean 'bus off'", UnknownNameError),
    # drives and their bus
    "no rate": (lambda: drive_bus(0.0), MS),
    "rate of 10/3 ms": (lambda: drive_bus(300.0), MS),
    "negative rate": (lambda: drive_bus(-100.0), MS),
    "nan for a rate": (lambda: drive_bus(NAN), MS),
    "rate of 1/2 ms": (lambda: drive_bus(2000.0), MS),
    "pacer": (lambda: Pacer(SteppedClock(), 0.0), "a number, positive"),
    "interface": (lambda: open_bus("virtul:a"), "did you mean 'virtual'", DeviceError),
    "no channel": (lambda: open_bus("virtual"), "lacks its channel", DeviceError),
    "no such bus": (lambda: open_bus("socketcan:no-such-can"), "cannot be opened", DeviceError),
    "port": (lambda: open_bus("udp_multicast:239.74.163.2:many"), "port 'many'", DeviceError),
    "large port": (lambda: open_bus("udp_multicast:239.74.163.2:99999"), "port '99999'", DeviceError),
    "prototype's bus": (
        lambda: Prototype(load_hardware(), "soketcan:can0", None),
        "no CAN interface 'soketcan'",
        DeviceError,
    ),
    "no such EDS": (lambda: object_dictionary("none.eds"), "No such file"),
    "node 0": (lambda: spec(node=0), "node"),
    "node 200": (lambda: spec(node=200), "node"),
    "no direction": (lambda: spec(direction=0), "direction"),
    "drum in mm": (lambda: spec(drum_radius=8.0), "drum_radius"),
    "negative gear": (lambda: spec(gear=-1.0), "gear"),
    "efficiency": (lambda: spec(efficiency=1.5), "efficiency"),
    "emulated rate": (lambda: drives(SPECS[0], rate=0), "rate is 0"),
    "a node twice": (lambda: drives(SPECS[0], SPECS[0]), "each once"),
    # the sealed plant
    "sealed effect": (
        lambda: seal(1, "backlsh"),
        r"no effect 'backlsh' can be sealed; did you mean 'backlash'\?",
        UnknownNameError,
    ),
    "negative seed": (lambda: seal(-1), WHOLE),
    "seed of 1.5": (lambda: seal(1.5), WHOLE),
    "true for a seed": (lambda: seal(True), WHOLE),
    "word for a seed": (lambda: seal("1"), WHOLE),
    "plant without a seal": (lambda: Plant({"backlash": {}}), "it needs a Seal"),
    "a robot that snaps": (
        lambda: PlantRod().rest(np.zeros(4), np.array([0.0, 300.0, 0.0]), np.array([0.0, 0.0, -1.0])),
        "finds no rest",
        DeviceError,
    ),
    # camera, marker and tracker
    "no such camera file": (lambda: load_camera("none.toml"), "cannot be read: No such file"),
    "flat camera": (flat, r"Camera\.matrix is .*fx and fy positive"),
    "camera without rows": (lambda: replace(CAMERA, size=(640, 0)), r"Camera\.size"),
    "marker in mm": (lambda: Marker(size=15.0), "Was it given in mm"),
    "marker's dictionary": (
        lambda: Marker(size=0.015, dictionary="DICT_4X4_5O"),
        "did you mean 'DICT_4X4_50'",
        UnknownNameError,
    ),
    "no gate": (lambda: MarkerTracker(CAMERA, MARKER, gate=0.0), "gate is 0"),
    "small picture": (lambda: look_at(NONE[:10, :10]), r"must be uint8 of \(480, 640\)"),
    "black above white": (lambda: DrawnScene(black=200.0, white=100.0), "0 <= black < white <= 255"),
    # calibration and registration
    "no pictures": (lambda: calibrate([], BOARD), "no pictures were given", CalibrationError),
    "two sizes": (lambda: calibrate([NONE, SMALL], BOARD), "one size"),
    "no board": (lambda: register([NONE]), "none of 1 views shows the board", CalibrationError),
    "two places": (lambda: register([NONE] * 14, np.zeros((2, 3))), "or a row for each picture"),
    "norm 2": (lambda: register([NONE], quaternion=2.0 * UPRIGHT), "norm 1"),
    "another camera's": (lambda: register([SMALL]), "those of the camera"),
    "two columns": (lambda: replace(BOARD, columns=2), "3 x 3 or more"),
    "large markers": (lambda: replace(BOARD, marker=0.03), "0 < marker < square"),
    "many markers": (lambda: replace(BOARD, columns=12, rows=10), "needs 60 markers; DICT_4X4_50 has 50"),
    "board's dictionary": (
        lambda: replace(BOARD, dictionary="DICT_4X4_500"),
        "did you mean",
        UnknownNameError,
    ),
    "coarse board": (lambda: BOARD.draw(4), "16 or more"),
}


@pytest.mark.parametrize("name", ALONE)
def test_what_cannot_be_is_named(name):
    call, sentence, *error = ALONE[name]
    with pytest.raises(*error or [InputError], match=sentence) as caught:
        call()
    assert "\n" not in str(caught.value)


ZERO = np.zeros(4, dtype=int)
ENABLED = {
    "three targets": (lambda it: it.bus.exchange(ZERO[:3]), r"must be \(4,\) whole counts"),
    "targets that are no counts": (lambda it: it.bus.exchange(np.zeros(4)), r"must be \(4,\) whole counts"),
    "large targets": (lambda it: it.bus.exchange(np.full(4, 2**40)), "32 bits"),
    "velocity": (lambda it: it.bus.profile_move(ZERO, velocity=0.0, acceleration=1.0), r"velocity is 0\.0"),
    "order": (
        lambda it: it.bus.homing(np.full(4, 100), 100, order=[0, 0, 1, 2]),
        "each drive from 0 to 3 once",
    ),
    "torque": (lambda it: it.bus.homing(np.zeros(4), 100), "positive thousandths"),
    "mode": (lambda it: it.bus.enable("cps"), "did you mean 'csp'"),
    "position limits": (lambda it: it.bus.connect(position_limit=np.array([1, 2])), "position_limit"),
    "emulated drive": (lambda it: it.nodes.block(4), "there is no drive 4"),
}


@pytest.mark.parametrize("name", ENABLED)
def test_enabled_drives_name_what_cannot_be(name):
    call, sentence = ENABLED[name]
    with BusBench(SPECS, Springs()) as made:
        made.bus.connect()
        made.bus.enable()
        with pytest.raises(UnknownNameError if name == "mode" else InputError, match=sentence) as caught:
            call(made)
        assert "\n" not in str(caught.value)


HEAD = b"matrix = [[800, 0, 320], [0, 800, 240], [0, 0, 1]]\nsize = [640, 480]\n"
ONE = b"[6040]\nParameterName=only one\nDataType=0x6\n"
MANY = b"".join(b"[%04X]\nCompactSubObj=254\n" % k for k in range(100))
COMPACT = b"[6040]\nDataType=\nCompactSubObj=0xFFFFFFFF\nPDOMapping=yes\nDefaultValue=$NODEID\n"
FILES = {
    "EDS: empty": (b"", r"describes no object; an EDS has sections such as \[6040\]\."),
    "EDS: words": (b"no dictionary", r"cannot be read: it is no EDS \(File contains no section headers\."),
    "EDS: no object": (b"[FileInfo]\nFileName=a.eds\n", "describes no object"),
    "EDS: bytes": (bytes(range(256)) * 8, "it is no EDS"),
    "EDS: one object": (ONE, r"has no object 0x1000:00 \(device type\)"),
    "EDS: compact": (COMPACT, "has no object 0x1000:00"),
    "EDS: variables": (MANY, r"describes more than 20000 variables\."),
    "EDS: sections": (b"[a]\n" * 20_001, "it has more than 20000 sections"),
    "camera: key": (b"latncy = 0.1\n" + HEAD, r"unknown key 'latncy'; did you mean 'latency'\?"),
    "camera: in ms": (b"latency = 30\n" + HEAD, "it must be a number between 0 and 10 s. Was it given in ms"),
    "camera: norm": (b"quaternion = [1.0, 1.0, 0.0, 0.0]\n" + HEAD, "must have norm 1, not 1.41421"),
    "camera: position": (b"position = [1.0, 0.0]\n" + HEAD, "position"),
    "camera: TOML": (b"=\n" + HEAD, "is not TOML"),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_that_is_none_is_one_sentence(name, tmp_path):
    data, sentence = FILES[name]
    path, read = tmp_path / "file", object_dictionary if name.startswith("EDS") else load_camera
    path.write_bytes(data)
    error = UnknownNameError if "key" in name else InputError
    with pytest.raises(error, match=sentence) as caught:
        read(path)
    assert "\n" not in str(caught.value)
