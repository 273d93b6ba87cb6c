"""Homing is watched: what goes wrong on the way stops the drives at once and is named, and a camera that is
wrong moves no tendon far."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from fastrod_device import homing
from fastrod_device.clock import SteppedClock
from fastrod_device.drive import DriveBus
from fastrod_device.emulator import Emulator
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_device.homing import home, trouble
from fastrod_device.readings import DriveFeedback, Emergency
from fastrod_device.seal import seal
from fastrod_device.tracker import MarkerSighting, MarkerTracker
from fastrod_device.units import Transmission

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

HARDWARE = load_hardware()
TRANSMISSION = Transmission(HARDWARE.drives)
_names = itertools.count()


class Rig:
    """Drives of an emulated prototype, connected, and a camera whose sightings can be moved; no
    supervisor."""

    def __init__(self) -> None:
        name, self.clock = f"virtual:homing-{next(_names)}", SteppedClock()
        self.emulator = Emulator(HARDWARE, name, clock=self.clock, seal=seal(4, "none"), seed=4)
        self.nodes = self.emulator.drives
        self.bus = DriveBus(HARDWARE.drives, name, clock=self.clock, rate=HARDWARE.rate)
        self.tracker = MarkerTracker(HARDWARE.camera, HARDWARE.marker)
        self.shifted = self.by = np.zeros(3)
        self.shown = 0
        self.bus.connect(
            following_error=int(HARDWARE.limits.following_error / HARDWARE.drives[0].metres_per_count)
        )

    def look(self) -> MarkerSighting | None:
        frame = self.emulator.read()
        if frame is None:
            return None
        sighting = self.tracker.look(frame)
        self.shown += 1
        return replace(sighting, position=sighting.position + self.shifted) if sighting.ok else sighting

    def home(self, *, camera: bool = True) -> Any:
        return home(self.bus, HARDWARE, self.clock, self.look if camera else None)

    def rest(self) -> None:
        for _ in range(10):
            self.clock.sleep_until(self.clock.now() + 0.01)
            self.bus.exchange()


@contextmanager
def rig() -> Iterator[Rig]:
    made = Rig()
    try:
        yield made
    finally:
        made.bus.close()
        made.emulator.close()


def well(**changed: Any) -> DriveFeedback:
    """Four drives that do as they are told."""
    zero = np.zeros(4, dtype=np.int64)
    given: dict[str, Any] = {
        "t": 1.0,
        "position": zero,
        "velocity": zero,
        "torque": TRANSMISSION.torque(np.ones(4)),
        "following_error": zero,
        "statusword": np.full(4, 0x1637),
        "age": np.full(4, 0.001),
        "heartbeat_age": np.full(4, 0.02),
        "nmt": np.full(4, 5),
        "emergencies": (),
        "lost": "",
    }
    return DriveFeedback(**(given | changed))


def test_nothing_is_wrong_with_drives_that_do_as_they_are_told() -> None:
    assert trouble(well(), HARDWARE) == ""
    # an error is gone
    assert trouble(well(emergencies=(Emergency(drive=1, code=0, register=0, t=1.0),)), HARDWARE) == ""
    assert trouble(well(torque=TRANSMISSION.torque(np.array([4.9, 0.0, -4.9, 1.0]))), HARDWARE) == ""


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (
            {"lost": "nothing can be sent: no buffer."},
            "the bus carries nothing: nothing can be sent: no buffer",
        ),
        (
            {"emergencies": (Emergency(drive=2, code=0x2310, register=3, t=1.0),)},
            "node 3 sent an emergency: over-current (0x2310)",
        ),
        ({"age": np.array([0.0, 0.06, 0.0, 0.0])}, "node 2 was last heard 60 ms ago; 50 ms are allowed"),
        ({"age": np.array([0.0, 0.0, 0.0, np.inf])}, "node 4 was last heard inf ms ago"),
        (
            {"statusword": np.array([0x1637, 0x1637, 0x1637, 0x1618])},
            "node 4 went to the state 'fault' (statusword 0x1618)",
        ),
        (
            {"following_error": np.array([1, -200, 3, 2])},
            "node 2 is 0.12 mm from where it was told to be; 0.075 mm are allowed",
        ),
        (
            {"torque": TRANSMISSION.torque(np.array([1.0, 5.5, 1.0, 1.0]))},
            "the tendon of node 2 pulls with 5.56 N; 5 N are allowed",
        ),
        (
            {"torque": TRANSMISSION.torque(np.array([1.0, 1.0, -6.0, 1.0]))},
            "the tendon of node 3 pulls with -6.01 N; 5 N are allowed",
        ),
    ],
)
def test_what_is_wrong_names_the_node_and_the_figure(changed: dict[str, Any], sentence: str) -> None:
    assert sentence in trouble(well(**changed), HARDWARE)


def test_a_drive_that_moves_may_be_further_behind() -> None:
    # 0.12 mm
    told = well(
        following_error=np.array([0, -200, 0, 0]), torque=TRANSMISSION.torque(np.array([1.0, 1.0, 1.0, 7.0]))
    )
    assert trouble(told, HARDWARE, speed=0.0).startswith("the drive at node 2")
    fast = trouble(told, HARDWARE, speed=0.015)
    assert fast == (
        "the tendon of node 4 pulls with 7.03 N; 5 N are allowed, and the drive at node 2 is 0.12 "
        "mm from where it was told to be"
    )
    assert "0.3 mm are allowed" in trouble(well(following_error=np.full(4, 600)), HARDWARE, speed=1.0)


@pytest.mark.parametrize(
    ("pretension", "largest", "most"),
    [(0.2, 15.0, 3.0), (2.0, 15.0, 10.0), (2.0, 6.0, 6.0)],
    ids=["least", "by pretension", "limit"],
)
def test_how_much_a_wire_may_pull(pretension: float, largest: float, most: float) -> None:
    hardware = replace(HARDWARE, pretension=pretension, limits=replace(HARDWARE.limits, tension=largest))
    assert trouble(well(torque=TRANSMISSION.torque(np.full(4, most - 0.1))), hardware) == ""
    assert f"{most:g} N are allowed" in trouble(
        well(torque=TRANSMISSION.torque(np.full(4, most + 0.1))), hardware
    )


FAULTS: dict[str, tuple[Callable[[Rig], None], str]] = {
    "silent": (lambda rig: rig.nodes.silent(0), "node 1 was last heard 5. ms ago"),
    "emergency": (
        lambda rig: rig.nodes.emergency(2, 0x3210),
        r"node 3 sent an emergency: over-voltage "
        r"\(0x3210\)",
    ),
    "reboot": (lambda rig: rig.nodes.reboot(3), "node 4 "),
    "bus off": (lambda rig: rig.nodes.bus_off(), "the bus carries nothing|was last heard"),
    "encoder": (
        lambda rig: rig.nodes.encoder_jump(1, 3000),
        r"node 2 sent an emergency: following error "
        r"\(0x8611\)",
    ),
    "paused": (
        lambda rig: rig.clock.sleep_until(rig.clock.now() + 0.5),
        r"the controller paused for 0\.5|no heartbeat of the master",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_while_the_wires_move_stops_all_at_once_and_is_named(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    inject, sentence = FAULTS[name]
    with rig() as made:
        exchange, cycles, since = DriveBus.exchange, [0], [0.0]

        def counted(self: DriveBus, target: Any = None) -> DriveFeedback:
            cycles[0] += target is not None
            if cycles[0] == 20 and target is not None:
                inject(made)
                since[0] = made.clock.now()
            return exchange(self, target)

        monkeypatch.setattr(DriveBus, "exchange", counted)
        with pytest.raises(DeviceError, match=sentence) as told:
            made.home()
        monkeypatch.undo()
        assert str(told.value).count("\n") == 0
        assert made.clock.now() - since[0] < 0.15
        assert made.bus.stop_reason != ""
        made.nodes.restore()
        made.rest()
        where = made.nodes.true_pulled
        assert not made.nodes.moving.any()
        assert "operation enabled" not in made.nodes.states
        made.rest()
        np.testing.assert_array_equal(made.nodes.true_pulled, where)


@pytest.mark.parametrize("part", ["_tightened", "_straightened"])
@pytest.mark.parametrize("drive", [0, 1, 2, 3])
def test_a_blocked_drive_is_the_one_that_is_blamed(
    drive: int, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = getattr(homing, part)
    with rig() as made:

        def blocked(*given: Any) -> Any:
            made.nodes.block(drive)
            since.append(made.clock.now())
            return whole(*given)

        since: list[float] = []
        monkeypatch.setattr(homing, part, blocked)
        with pytest.raises(
            DeviceError,
            match=rf"the drive at node {drive + 1} is .* from where it was told "
            r"to be",
        ):
            made.home()
        assert made.clock.now() - since[0] < 2.0
        assert made.bus.stop_reason == "homing did not end"


def test_a_camera_that_stands_elsewhere_pulls_no_wire() -> None:
    with rig() as made:
        made.shifted = np.array([0.025, 0.0, 0.0])
        with pytest.raises(
            DeviceError,
            match=r"the tip is seen 25 mm beside the axis; .* 1 mm at most; "
            r".*`fastrod drive register`",
        ):
            made.home()
        made.rest()
        assert "operation enabled" not in made.nodes.states
        bending = made.nodes.true_pulled - made.emulator._slack
        assert np.abs(bending[:2] - bending[2:]).max() < 2e-4  # m: where tension alone had left it


def test_a_camera_that_turns_left_into_right_is_found_in_the_second_round() -> None:
    with rig() as made:
        look = made.look

        def mirrored() -> MarkerSighting | None:
            sighting = look()
            if sighting is None or not sighting.ok:
                return sighting
            x, y, z = sighting.position
            return replace(sighting, position=np.array([-x - 1e-3, -y, z]))

        made.look = mirrored
        with pytest.raises(
            DeviceError, match=r"mm before did not bring it nearer; is the camera registered\?"
        ):
            made.home()
        assert made.bus.stop_reason == "homing did not end"


def test_a_marker_that_is_not_seen_stops_the_drives_too() -> None:
    with rig() as made:
        made.emulator.hidden = True
        with pytest.raises(DeviceError, match=r"saw the marker 0 times"):
            made.home()
        made.rest()
        assert made.nodes.states == ("quick stop active",) * 4


@pytest.mark.parametrize("camera", [True, False])
def test_the_tensions_are_those_where_zero_is(camera: bool) -> None:
    with rig() as made:
        transmission, robot = made.home(camera=camera)
        np.testing.assert_allclose(transmission.dl(made.bus.newest.position), 0.0, atol=1e-6)
        told = [tendon.pretension for tendon in robot.segments[0].tendons]
        true = made.emulator.plant.tension()
        np.testing.assert_allclose(told, true, atol=0.08)  # a count of torque is 0.11 N; it is told rounded
        assert made.bus.stop_reason == ""
