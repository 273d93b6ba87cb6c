"""Homing is watched: what goes wrong on the way stops the drives at once and is named, and a camera that is
wrong moves no tendon far."""

from dataclasses import replace

import numpy as np
import pytest
from benches import own_bus

from fastrod_device import homing
from fastrod_device.can.clock import SteppedClock
from fastrod_device.can.drive import DriveBus
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.emulator.seal import seal
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_device.homing import home, trouble
from fastrod_device.readings import DriveFeedback, Emergency
from fastrod_device.units import Transmission
from fastrod_device.vision.tracker import MarkerTracker

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

HARDWARE = load_hardware()
ENABLED = "operation enabled"


class Rig:
    """Drives of an emulated prototype, connected, and a camera whose sightings can be moved; no
    supervisor."""

    def __init__(self):
        name, self.clock = own_bus(), SteppedClock()
        self.emulator = Emulator(HARDWARE, name, clock=self.clock, seal=seal(4, "none"), seed=4)
        self.nodes = self.emulator.drives
        self.bus = DriveBus(HARDWARE.drives, name, clock=self.clock, rate=HARDWARE.rate)
        self.tracker = MarkerTracker(HARDWARE.camera, HARDWARE.marker)
        self.moved = lambda position: position
        error = HARDWARE.limits.following_error / HARDWARE.drives[0].metres_per_count
        self.bus.connect(following_error=int(error))

    def look(self):
        frame = self.emulator.read()
        if frame is None:
            return None
        sighting = self.tracker.look(frame)
        return replace(sighting, position=self.moved(sighting.position)) if sighting.ok else sighting

    def home(self, *, camera=True):
        return home(self.bus, HARDWARE, self.clock, self.look if camera else None)

    def rest(self):
        for _ in range(10):
            self.clock.sleep_until(self.clock.now() + 0.01)
            self.bus.exchange()


@pytest.fixture
def rig():
    made = Rig()
    yield made
    made.bus.close()
    made.emulator.close()


def torque(*tension):
    """Return the torque of all drives [thousandths of the rated one], at tensions [N]."""
    return {"torque": Transmission(HARDWARE.drives).torque(np.array(tension))}


def well(**changed):
    """Four drives that do as they should."""
    zero = dict.fromkeys(("position", "velocity", "following_error"), np.zeros(4, dtype=np.int64))
    ages = {"age": np.full(4, 0.001), "heartbeat_age": np.full(4, 0.02)}
    words = {"statusword": np.full(4, 0x1637), "nmt": np.full(4, 5), "emergencies": (), "lost": ""}
    return DriveFeedback(**({"t": 1.0} | zero | torque(1.0, 1.0, 1.0, 1.0) | ages | words | changed))


def emergency(drive, code, register):
    return {"emergencies": (Emergency(drive=drive, code=code, register=register, t=1.0),)}


def test_nothing_is_wrong_with_drives_that_do_as_they_should():
    for fine in ({}, emergency(1, 0, 0), torque(4.9, 0.0, -4.9, 1.0)):  # an emergency of code 0: it is gone
        assert trouble(well(**fine), HARDWARE) == ""


LOST = "nothing can be sent: no buffer"
BEHIND = {"following_error": np.array([1, -200, 3, 2])}


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        ({"lost": f"{LOST}."}, f"the bus carries nothing: {LOST}"),
        (emergency(2, 0x2310, 3), "node 3 sent an emergency: over-current (0x2310)"),
        ({"age": np.array([0.0, 0.06, 0.0, 0.0])}, "node 2 was last heard 60 ms ago; 50 ms are allowed"),
        ({"age": np.array([0.0, 0.0, 0.0, np.inf])}, "node 4 was last heard inf ms ago"),
        (
            {"statusword": np.array([0x1637, 0x1637, 0x1637, 0x1618])},
            "node 4 went to the state 'fault' (statusword 0x1618)",
        ),
        (BEHIND, "node 2 is 0.12 mm from where it was commanded to be; 0.075 mm are allowed"),
        (torque(1.0, 5.5, 1.0, 1.0), "the tendon of node 2 pulls with 5.56 N; 5 N are allowed"),
        (torque(1.0, 1.0, -6.0, 1.0), "the tendon of node 3 pulls with -6.01 N; 5 N are allowed"),
    ],
)
def test_what_is_wrong_names_the_node_and_the_figure(changed, sentence):
    assert sentence in trouble(well(**changed), HARDWARE)


def test_a_drive_that_moves_may_be_further_behind():
    feedback = well(following_error=np.array([0, -200, 0, 0]), **torque(1.0, 1.0, 1.0, 7.0))
    behind = "the drive at node 2 is 0.12 mm from where it was commanded to be"
    assert trouble(feedback, HARDWARE, speed=0.0).startswith("the drive at node 2")
    pulls = "the tendon of node 4 pulls with 7.03 N; 5 N are allowed"
    assert trouble(feedback, HARDWARE, speed=0.015) == f"{pulls}, and {behind}"
    assert "0.3 mm are allowed" in trouble(well(following_error=np.full(4, 600)), HARDWARE, speed=1.0)


@pytest.mark.parametrize(
    ("pretension", "largest", "most"),
    [(0.2, 15.0, 3.0), (2.0, 15.0, 10.0), (2.0, 6.0, 6.0)],
    ids=["least", "by pretension", "limit"],
)
def test_how_much_a_tendon_may_pull(pretension, largest, most):
    hardware = replace(HARDWARE, pretension=pretension, limits=replace(HARDWARE.limits, tension=largest))
    assert trouble(well(**torque(*[most - 0.1] * 4)), hardware) == ""
    assert f"{most:g} N are allowed" in trouble(well(**torque(*[most + 0.1] * 4)), hardware)


FAULTS = {
    "silent": (lambda rig: rig.nodes.silent(0), "node 1 was last heard 5. ms ago"),
    "emergency": (
        lambda rig: rig.nodes.emergency(2, 0x3210),
        r"node 3 sent an emergency: over-voltage \(0x3210\)",
    ),
    "reboot": (lambda rig: rig.nodes.reboot(3), "node 4 "),
    "bus off": (lambda rig: rig.nodes.bus_off(), "the bus carries nothing|was last heard"),
    "encoder": (
        lambda rig: rig.nodes.encoder_jump(1, 3000),
        r"node 2 sent an emergency: following error \(0x8611\)",
    ),
    "paused": (
        lambda rig: rig.clock.sleep_until(rig.clock.now() + 0.5),
        r"the controller paused for 0\.5|no heartbeat of the master",
    ),
}


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_while_the_tendons_move_stops_all_at_once_and_is_named(name, rig, monkeypatch):
    inject, sentence = FAULTS[name]
    exchange, cycles, since = DriveBus.exchange, [], []

    def counted(self, target=None):
        cycles.append(target is not None)
        if sum(cycles) == 20 and target is not None:
            inject(rig)
            since.append(rig.clock.now())
        return exchange(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(DriveBus, "exchange", counted)
        with pytest.raises(DeviceError, match=sentence) as caught:
            rig.home()
    assert "\n" not in str(caught.value)
    assert rig.clock.now() - since[-1] < 0.15
    assert rig.bus.stop_reason != ""
    rig.nodes.restore()
    rig.rest()
    where = rig.nodes.true_pulled
    assert not rig.nodes.moving.any()
    assert ENABLED not in rig.nodes.states
    rig.rest()
    np.testing.assert_array_equal(rig.nodes.true_pulled, where)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("phase", ["_tightened", "_straightened"])
@pytest.mark.parametrize("drive", [0, 1, 2, 3])
def test_a_blocked_drive_is_the_one_that_is_blamed(drive, phase, rig, monkeypatch):
    whole, since = getattr(homing, phase), []

    def blocked(*given):
        rig.nodes.block(drive)
        since.append(rig.clock.now())
        return whole(*given)

    monkeypatch.setattr(homing, phase, blocked)
    with pytest.raises(
        DeviceError, match=rf"the drive at node {drive + 1} is .* from where it was commanded to be"
    ):
        rig.home()
    assert rig.clock.now() - since[0] < 2.0
    assert rig.bus.stop_reason == "homing did not end"


@pytest.mark.study
def test_a_camera_that_stands_elsewhere_pulls_no_tendon(rig):
    rig.moved = lambda position: position + np.array([0.025, 0.0, 0.0])
    beside = "the tip is seen 25 mm beside the axis; .* 1 mm at most; .*`fastrod camera register`"
    with pytest.raises(DeviceError, match=beside):
        rig.home()
    rig.rest()
    assert ENABLED not in rig.nodes.states
    bending = rig.nodes.true_pulled - rig.emulator._slack
    assert np.abs(bending[:2] - bending[2:]).max() < 2e-4  # m: where tension alone had left it


@pytest.mark.study
def test_a_camera_that_turns_left_into_right_is_found_in_the_second_round(rig):
    rig.moved = lambda position: position * (-1.0, -1.0, 1.0) - (1e-3, 0.0, 0.0)
    with pytest.raises(DeviceError, match=r"mm before did not bring it nearer; is the camera registered\?"):
        rig.home()
    assert rig.bus.stop_reason == "homing did not end"


@pytest.mark.study
def test_a_marker_that_is_not_seen_stops_the_drives_too(rig):
    rig.emulator.hidden = True
    with pytest.raises(DeviceError, match=r"saw the marker 0 times"):
        rig.home()
    rig.rest()
    assert rig.nodes.states == ("quick stop active",) * 4


@pytest.mark.study
@pytest.mark.parametrize("camera", [True, False])
def test_the_tensions_are_those_where_zero_is(camera, rig):
    transmission, robot = rig.home(camera=camera)
    np.testing.assert_allclose(transmission.dl(rig.bus.newest.position), 0.0, atol=1e-6)
    stated = [tendon.pretension for tendon in robot.segments[0].tendons]
    # a count of torque is 0.11 N; it is rounded
    np.testing.assert_allclose(stated, rig.emulator.plant.tension(), atol=0.08)
    assert rig.bus.stop_reason == ""
