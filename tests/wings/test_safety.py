"""The supervisor: what it refuses, what stops the robot, and that only a person lets it go again."""

from __future__ import annotations

import math
import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import Robot, Segment, Tendon
from fastrod.errors import InputError, UnknownNameError
from fastrod.model.robotfile import load_robot
from fastrod_device.clock import SteppedClock
from fastrod_device.errors import RefusedError
from fastrod_device.limits import Limits, limited
from fastrod_device.readings import Emergency, Readings
from fastrod_device.safety import KINDS, TRANSITIONS, CameraWatch, Fault, SafetyState, Supervisor
from fastrod_device.safety_words import drive_state

ROBOT = load_robot("prototype")
NODES = (4, 5, 6, 7)
DT = 0.01
SEES = CameraWatch(age=0.05, frozen=False)
BLIND = CameraWatch(age=2.0, frozen=False)
SLOW = Limits(cycle=0.5, command_age=1.0)
BENT = np.array([-0.002, 0.001, 0.002, -0.001])
quickly = settings(derandomize=True, max_examples=120, deadline=None)


def healthy(t: float = 0.0, **other: Any) -> Readings:
    """Four enabled drives that hold; `name=(drive, value)` sets one drive's figure, `name=value` all of
    them."""
    base = Readings(
        t=t,
        dl=np.zeros(4),
        rate=np.zeros(4),
        tension=np.full(4, 2.0),
        current=np.zeros(4),
        following_error=np.zeros(4),
        statusword=np.full(4, 0x1637),
        age=np.full(4, 0.004),
        heartbeat_age=np.full(4, 0.02),
        nmt=np.full(4, 5),
        emergencies=(),
        lost="",
    )
    for name, value in other.items():
        if isinstance(value, tuple) and name != "emergencies":
            array = getattr(base, name).copy()
            array[value[0]] = value[1]
            base = replace(base, **{name: array})
        else:
            base = replace(base, **{name: value})
    return base


class Bench:
    """A supervisor, the stops that it sent, and time."""

    def __init__(self, *, running: bool = True, limits: Limits | None = None) -> None:
        self.stops: list[Fault] = []
        self.fails = 0
        self.now = 100.0
        self.supervisor = Supervisor(
            ROBOT, limits or Limits(), on_stop=self._stop, nodes=NODES, words=lambda code: f"code {code:04X}"
        )
        if running:
            self.supervisor.enabled(self.now)
            self.watch()
            self.supervisor.check(BENT, self.now)

    def _stop(self, fault: Fault) -> None:
        assert self.supervisor.state is SafetyState.STOPPED  # no command passes while the stop is on its way
        self.stops.append(fault)
        if self.fails:
            self.fails -= 1
            raise OSError("bus is gone")

    def watch(
        self, dt: float = DT, jump: float = 0.0, camera: CameraWatch | None = SEES, **other: Any
    ) -> Fault | None:
        self.now += dt
        return self.supervisor.watch(self.now, 1.7e9 + self.now + jump, healthy(self.now, **other), camera)


EMCY = (Emergency(drive=1, code=0x8611, register=0x21, t=0.0),)
NAN, INF = math.nan, math.inf
CASES: list[tuple[str, dict[str, Any], tuple[str, ...]]] = [
    ("clock jump", {"jump": 0.5}, ("500 ms", "200 ms")),
    ("clock jump", {"jump": -3600.0}, ("-3.6e+06 ms",)),
    ("clock jump", {"dt": -0.5}, ("500 ms", "ran back")),
    ("controller stalled", {"dt": 0.3}, ("300 ms", "50 ms")),
    ("bus off", {"lost": "can0 is bus-off."}, ("can0 is bus-off",)),
    ("node reboot", {"nmt": (1, 0)}, ("drive 2 (node 5)", "0 (booting)")),
    ("node reboot", {"nmt": (3, 127)}, ("drive 4 (node 7)", "pre-operational")),
    ("emergency message", {"emergencies": EMCY}, ("drive 2 (node 5)", "0x8611", "code 8611", "0x21")),
    ("drive fault", {"statusword": (1, 0x0238)}, ("drive 2 (node 5)", "in fault", "0x0238")),
    ("drive fault", {"statusword": (2, 0x0250)}, ("drive 3 (node 6)", "switch on disabled", "0x0250")),
    ("foreign SYNC", {"foreign_syncs": 3}, ("another node sends SYNC (3 since the last cycle)",)),
    ("drive fault", {"statusword": (0, 0x0217)}, ("drive 1 (node 4)", "quick stop")),
    ("heartbeat lost", {"heartbeat_age": (1, 0.16)}, ("drive 2 (node 5)", "160 ms", "150 ms")),
    ("heartbeat lost", {"heartbeat_age": (1, INF), "nmt": (1, -1)}, ("drive 2 (node 5)", "inf")),
    ("feedback stale", {"age": (1, 0.031)}, ("drive 2 (node 5)", "31 ms", "30 ms")),
    ("feedback stale", {"age": (0, NAN)}, ("drive 1 (node 4)", "nan")),
    ("encoder jump", {"dl": (1, 0.0009)}, ("drive 2 (node 5)", "0.9 mm", "10 ms", "0.8 mm")),
    ("encoder jump", {"dl": (1, NAN)}, ("drive 2 (node 5)", "nan")),
    ("following error", {"following_error": (1, -0.0011)}, ("drive 2 (node 5)", "-1.1 mm", "1 mm")),
    ("tension", {"tension": (1, 15.5)}, ("drive 2 (node 5)", "15.5 N", "15 N")),
    ("tension", {"tension": (3, -16.0)}, ("drive 4 (node 7)", "-16 N")),
    (
        "displacement",
        {"dl": (1, -0.0093), "dt": 0.3, "limits": SLOW},
        ("drive 2 (node 5)", "-9.3 mm", "9 mm"),
    ),
    (
        "slack tendon",
        {"tension": (1, 0.1), "limits": Limits(slack=0.2)},
        ("drive 2 (node 5)", "0.1 N", "0.2 N"),
    ),
    ("camera frozen", {"camera": CameraWatch(age=0.3, frozen=True)}, ("repeats its frames", "300 ms")),
    ("marker lost", {"camera": CameraWatch(age=0.6, frozen=False)}, ("600 ms", "500 ms")),
    ("marker lost", {"camera": CameraWatch(age=INF, frozen=False)}, ("inf",)),
    ("marker lost", {"camera": CameraWatch(age=-5.0, frozen=False)}, ("-5000 ms", "500 ms")),
    ("marker lost", {"camera": CameraWatch(age=0.6, frozen=False, flag="outlier")}, ("flagged 'outlier'",)),
    (
        "command stale",
        {"dt": 0.6, "rate": (1, 0.02), "limits": Limits(cycle=1.0)},
        ("20 mm/s", "600 ms", "500 ms"),
    ),
]


@pytest.mark.parametrize(("kind", "other", "words"), CASES)
def test_every_kind_of_fault_stops_in_the_call_that_finds_it_and_says_what_it_was(
    kind: str, other: dict[str, Any], words: tuple[str, ...]
) -> None:
    other = dict(other)
    bench = Bench(limits=other.pop("limits", None))
    if kind == "displacement":  # it came there slowly enough
        bench.watch(dl=(1, -0.0045), dt=0.3)
        bench.supervisor.check(BENT, bench.now)
    assert (bench.supervisor.state, bench.stops) == (SafetyState.RUNNING, [])
    found = bench.watch(**other)
    assert found is not None
    assert (found.kind, found.t, bench.stops) == (kind, bench.now, [found])
    assert bench.supervisor.state is SafetyState.STOPPED
    assert all(word in found.sentence for word in words), found.sentence
    assert found.sentence.endswith(".")
    assert found.sentence.count(". ") == 0  # one sentence
    if "drive" in words[0]:
        assert found.drive is not None
        assert words[0] == f"drive {found.drive + 1} (node {NODES[found.drive]})"
    with pytest.raises(RefusedError, match="stopped"):
        bench.supervisor.check(BENT, bench.now)
    assert kind in bench.supervisor.status


def test_the_cases_and_the_calls_cover_every_kind() -> None:
    assert {kind for kind, _, _ in CASES} | {"emergency stop", "nobody watches", "exception"} == set(KINDS)


def test_a_healthy_robot_runs_on() -> None:
    bench = Bench()
    for k in range(200):
        bench.supervisor.check(BENT, bench.now)
        assert bench.watch(dl=np.full(4, 0.0003 * (k % 2)), tension=np.full(4, 14.9), emergencies=()) is None
    reset = (Emergency(drive=0, code=0x0000, register=0, t=0.0),)  # CiA 301: the error is gone
    assert bench.watch(emergencies=reset) is None
    assert bench.watch(camera=None) is None
    assert (bench.supervisor.state, bench.supervisor.status) == (
        SafetyState.RUNNING,
        "The robot follows commands.",
    )


def test_a_late_sample_has_gone_further_and_is_no_jump() -> None:
    bench = Bench()
    bench.watch(age=np.full(4, 0.025))
    # 34 ms between samples: 1.02 mm by rate, and 0.5
    assert bench.watch(dl=(1, 0.00135), age=np.full(4, 0.001)) is None
    assert bench.watch(dl=(1, 0.0030)) is not None
    assert bench.stops[0].kind == "encoder jump"


def test_readings_that_are_looked_at_again_grow_old() -> None:
    bench = Bench()
    same = healthy(bench.now)
    found = [bench.supervisor.watch(bench.now + k * DT, None, same, None) for k in range(1, 5)]
    assert found[1] is None
    assert [fault.kind for fault in bench.supervisor.faults] == ["bus off", "feedback stale"]


def test_all_drives_silent_is_the_bus_and_one_of_them_a_drive() -> None:
    bench, other = Bench(), Bench()
    found, one = bench.watch(age=np.array([0.05, 0.04, 0.06, 0.05])), other.watch(age=(2, 0.04))
    assert found is not None
    assert one is not None
    assert (found.kind, found.drive) == ("bus off", None)
    assert "no drive has sent process data for 40 ms; the limit is 30 ms" in found.sentence
    assert (one.kind, one.drive) == ("feedback stale", 2)


def test_an_encoder_jump_is_the_cause_of_a_drives_following_error() -> None:
    bench = Bench()
    found = bench.watch(dl=(1, 0.003), emergencies=EMCY, statusword=(1, 0x0238))
    assert found is not None
    assert [fault.kind for fault in bench.supervisor.faults] == [
        "encoder jump",
        "emergency message",
        "drive fault",
    ]


def test_a_watchdog_stops_a_loop_that_does_not_look_any_more() -> None:
    bench = Bench()
    assert bench.supervisor.stalled(bench.now + 0.05) is None
    found = bench.supervisor.stalled(bench.now + 0.07)
    assert found is not None
    assert (found.kind, bench.stops) == ("controller stalled", [found])
    assert "70 ms" in found.sentence
    assert "50 ms" in found.sentence
    assert bench.supervisor.stalled(bench.now + 9.0) is None  # it is stopped
    bench.watch()
    bench.supervisor.acknowledge(bench.now)
    assert bench.supervisor.stalled(bench.now + 9.0) is None  # it is off


def test_a_robot_that_stands_needs_no_command_and_one_that_is_steered_none_too_many() -> None:
    bench = Bench()
    for _ in range(100):
        assert bench.watch() is None  # stands
    for _ in range(100):
        bench.supervisor.check(BENT, bench.now)
        assert bench.watch(rate=(1, 0.03)) is None  # steered
    found = [bench.watch(rate=(1, 0.03)) for _ in range(52)]
    assert found[47] is None
    assert [fault.kind for fault in bench.stops] == ["command stale"]


def test_a_stamp_of_the_future_does_not_keep_a_command_young() -> None:
    bench = Bench()
    bench.supervisor.check(BENT, bench.now, stamp=bench.now + 0.4)
    found = [bench.watch(rate=(1, 0.03)) for _ in range(55)]
    assert any(fault is not None and fault.kind == "command stale" for fault in found)


def test_of_several_faults_the_cause_is_first_and_the_rest_is_kept() -> None:
    bench = Bench()
    first = bench.watch(
        heartbeat_age=np.full(4, 1.0),
        age=np.full(4, 1.0),
        lost="bus-off",
        camera=CameraWatch(age=9.0, frozen=True),
    )
    assert first is not None
    kinds = [fault.kind for fault in bench.supervisor.faults]
    assert kinds == ["bus off", "heartbeat lost", "feedback stale", "camera frozen", "marker lost"]
    assert kinds == sorted(kinds, key=KINDS.index)
    assert bench.watch(tension=(0, 99.0), statusword=(2, 0x8)) is None
    assert bench.supervisor.first is first
    assert [fault.kind for fault in bench.supervisor.faults[5:]] == ["drive fault", "tension"]
    assert len(bench.stops) == 1


def test_slowing_down_after_a_stop_is_no_new_fault() -> None:
    bench = Bench()
    bench.supervisor.emergency_stop(bench.now, "a test")
    for dl in (0.0012, 0.0024):
        off = {"statusword": np.full(4, 0x0240), "following_error": np.full(4, 0.004), "tension": np.zeros(4)}
        assert bench.watch(dt=0.2, dl=np.full(4, dl), rate=np.full(4, 0.02), **off) is None
    assert [fault.kind for fault in bench.supervisor.faults] == ["emergency stop"]
    assert "a test" in bench.supervisor.status


def test_what_is_off_is_looked_at_and_not_stopped() -> None:
    bench = Bench(running=False)
    assert (
        bench.watch(
            statusword=np.full(4, 0x0240), heartbeat_age=np.full(4, INF), nmt=np.full(4, -1), emergencies=EMCY
        )
        is None
    )
    assert bench.supervisor.client_lost(bench.now) is None
    assert (bench.supervisor.state, bench.supervisor.status) == (SafetyState.OFF, "The drives are off.")
    bench.now += 5.0  # until it is enabled nobody need look
    bench.supervisor.enabled(bench.now)
    assert bench.watch() is None
    assert bench.supervisor.status == "The drives are enabled and hold."
    assert bench.watch(dt=0.06) is not None


@pytest.mark.parametrize(
    ("dl", "words"),
    [
        ([0.001, -0.0091, 0.0, 0.0], "tendon 2 was told -9.1 mm; this robot's limit is 8 mm."),
        ([0.0, 0.0, NAN, 0.0], "tendon 3 was told nan"),
        ([0.0, 0.0, 0.0, INF], "tendon 4 was told inf"),
        ([0.0, 0.0, 0.0], r"shape \(3,\)"),
        ([[0.0] * 4], r"shape \(1, 4\)"),
        (["a"] * 4, "must be 4 numbers"),
        (None, "shape"),
        (
            [-0.0079, -0.0079, 0.0079, 0.0079],
            "segment 1 was told to bend with 21.2[0-9]* 1/m; this robot's limit is 20 1/m",
        ),
    ],
)
def test_a_command_beyond_a_limit_is_refused_with_its_figures(dl: Any, words: str) -> None:
    bench = Bench(running=False)
    bench.supervisor.enabled(bench.now)
    with pytest.raises(RefusedError, match=words):
        bench.supervisor.check(dl, bench.now)
    assert (bench.supervisor.state, bench.stops) == (SafetyState.READY, [])


def test_curvature_is_that_of_the_constant_curvature_arc() -> None:
    """Tendons at 7.5 mm, bend 1.05 rad over 70 mm: dl = -offset * bend * (cos, sin); 15 1/m."""
    bend = 0.07 * 15.0
    dl = -0.0075 * bend * np.array([1.0, 0.0, -1.0, 0.0])
    for most, fits in ((14.999, False), (15.001, True)):
        supervisor = Supervisor(ROBOT, Limits(curvature=most))
        supervisor.enabled(0.0)
        if fits:
            assert_array_equal(supervisor.check(dl, 0.0), dl)
        else:
            with pytest.raises(RefusedError, match=r"15 1/m; this robot's limit is 14\.999"):
                supervisor.check(dl, 0.0)


@pytest.mark.parametrize("stamp", [99.4, -INF, NAN, 101.0])
def test_a_command_that_was_meant_long_ago_is_refused(stamp: float) -> None:
    bench = Bench()
    with pytest.raises(RefusedError, match=r"meant .* ms ago; the limit is 500 ms"):
        bench.supervisor.check(BENT, 100.0, stamp=stamp)
    assert_array_equal(bench.supervisor.check(BENT, 100.0, stamp=99.6), BENT)


def test_a_command_is_a_copy() -> None:
    bench = Bench()
    mine = BENT.copy()
    told = bench.supervisor.check(mine, bench.now)
    mine[0] = 1.0
    assert_array_equal(told, BENT)


lengths = st.lists(st.floats(-0.02, 0.02), min_size=4, max_size=4).map(np.array)


@quickly
@given(lengths, lengths, st.floats(0.001, 0.1), st.floats(0.0, 1.0))
def test_a_limited_step_goes_straight_and_no_wire_beyond_its_rate(
    a: np.ndarray, b: np.ndarray, rate: float, dt: float
) -> None:
    c = limited(a, b, rate, dt)
    assert np.abs(c - a).max() <= rate * dt * (1.0 + 1e-12) + 1e-17
    part = np.linalg.norm(c - a) / max(np.linalg.norm(b - a), 1e-300)
    assert_allclose(c, a + min(part, 1.0) * (b - a), atol=1e-15)
    whole = np.abs(b - a).max() <= rate * dt
    assert np.array_equal(c, b) or not whole
    assert_array_equal(Supervisor(ROBOT, Limits(rate=rate)).limited(a, b, dt), c)


@pytest.mark.parametrize(
    ("wanted", "rate", "dt"),
    [(NAN, 0.03, 0.01), (INF, 0.03, 0.01), (0.0, 0.03, -0.01), (0.0, 0.0, 0.01), (0.0, 0.03, NAN)],
)
def test_a_step_that_cannot_be_is_named(wanted: float, rate: float, dt: float) -> None:
    with pytest.raises(InputError, match=r"finite|must be positive"):
        limited(np.zeros(4), np.full(4, wanted), rate, dt)


def test_a_stop_can_be_pressed_in_any_state_and_again() -> None:
    for running in (False, True):
        bench = Bench(running=running)
        fault = bench.supervisor.emergency_stop(bench.now, "the red button.")
        assert (fault.kind, fault.sentence) == (
            "emergency stop",
            "the emergency stop was pressed: the red button.",
        )
        assert bench.supervisor.state is SafetyState.STOPPED
        bench.supervisor.emergency_stop(bench.now + 1.0)
        assert len(bench.stops) == 2  # sent again: the first may have been lost
        assert bench.supervisor.faults == (fault,)


def test_a_stop_that_cannot_be_sent_raises_nothing_is_told_and_tried_again() -> None:
    bench = Bench()
    bench.fails = 2
    bench.supervisor.emergency_stop(bench.now)
    assert "COULD NOT BE SENT (OSError: bus is gone)" in bench.supervisor.status
    assert bench.watch() is None
    with pytest.raises(RefusedError, match="could not be sent"):
        bench.supervisor.acknowledge(bench.now)
    bench.watch()
    assert len(bench.stops) == 3
    assert "COULD NOT" not in bench.supervisor.status
    bench.watch()
    assert len(bench.stops) == 3
    assert [fault.kind for fault in bench.supervisor.faults] == ["emergency stop", "exception"]


def test_nobody_watches() -> None:
    bench = Bench()
    fault = bench.supervisor.client_lost(bench.now)
    assert fault is not None
    assert (fault.kind, bench.stops, bench.supervisor.state) == (
        "nobody watches",
        [fault],
        SafetyState.STOPPED,
    )
    assert bench.supervisor.client_lost(bench.now) is None


@pytest.mark.parametrize(
    "error",
    [
        ValueError("no such\nthing"),
        KeyboardInterrupt(),
        SystemExit(0),
        RefusedError("tendon 1 was told 9 mm."),
    ],
)
def test_whatever_leaves_a_guarded_block_stops_first(error: BaseException) -> None:
    bench, clock = Bench(), SteppedClock()
    clock.sleep_until(7.0)
    with pytest.raises(type(error)), bench.supervisor.guard(clock):  # noqa: PT012
        assert bench.stops == []
        raise error
    assert [(fault.kind, fault.t) for fault in bench.stops] == [("exception", 7.0)]
    name = "tendon 1 was told 9 mm" if isinstance(error, RefusedError) else type(error).__name__
    assert name in bench.stops[0].sentence
    assert "\n" not in bench.stops[0].sentence
    with bench.supervisor.guard(clock):
        pass
    assert len(bench.stops) == 1


def test_an_exception_that_cannot_be_told_stops_all_the_same() -> None:
    class MuteError(Exception):
        def __str__(self) -> str:
            raise RuntimeError

    bench = Bench()
    assert "MuteError" in bench.supervisor.exception(bench.now, MuteError()).sentence
    assert len(bench.stops) == 1


def test_a_look_that_fails_stops_the_robot() -> None:
    bench = Bench()
    with pytest.raises(InputError, match=r"readings\.dl has shape \(3,\); the robot has 4 drives"):
        bench.watch(dl=np.zeros(3))
    assert [fault.kind for fault in bench.stops] == ["exception"]


@pytest.mark.parametrize(
    "still",
    [
        {"heartbeat_age": (1, 0.4)},
        {"lost": "gone"},
        {"nmt": (0, 127)},
        {"tension": (2, 20.0)},
        {"camera": CameraWatch(age=2.0, frozen=False)},
    ],
)
def test_a_release_is_refused_while_the_cause_is_there(still: dict[str, Any]) -> None:
    bench = Bench()
    first = bench.watch(**still)
    assert first is not None
    with pytest.raises(RefusedError) as refused:
        bench.supervisor.acknowledge(bench.now)
    assert first.sentence in str(refused.value)
    assert "not released" in bench.supervisor.status
    bench.watch()
    with pytest.raises(RefusedError, match="last looked at"):
        bench.supervisor.acknowledge(bench.now + 60.0)
    bench.supervisor.acknowledge(bench.now)
    assert (bench.supervisor.state, bench.supervisor.faults) == (SafetyState.OFF, ())
    with pytest.raises(RefusedError, match="off, not stopped"):
        bench.supervisor.acknowledge(bench.now)
    with pytest.raises(RefusedError, match="drives are off"):
        bench.supervisor.check(BENT, bench.now)


def test_an_encoder_that_has_jumped_is_no_more_to_be_trusted() -> None:
    bench = Bench()
    assert bench.watch(dl=(1, 0.003)) is not None
    for _ in range(10):
        bench.watch(dl=(1, 0.003))
    with pytest.raises(RefusedError, match=r"drive 2 \(node 5\) moved its tendon .* start anew, and home it"):
        bench.supervisor.acknowledge(bench.now)


def test_a_drives_own_fault_is_reset_after_the_release() -> None:
    bench = Bench()
    bench.watch(statusword=(1, 0x0238))
    bench.supervisor.acknowledge(bench.now)
    assert bench.supervisor.state is SafetyState.OFF
    bench.supervisor.enabled(bench.now)
    assert bench.watch(statusword=(1, 0x0238)) is not None  # it was not reset


def test_a_stop_while_drives_are_being_enabled_is_sent_once_more() -> None:
    bench = Bench(running=False)
    bench.supervisor.emergency_stop(bench.now)  # between the drives' enabling and its report
    with pytest.raises(RefusedError, match="enabled, but the robot is stopped"):
        bench.supervisor.enabled(bench.now)
    assert len(bench.stops) == 2
    assert bench.supervisor.state is SafetyState.STOPPED


def test_history_tells_when_and_why() -> None:
    bench = Bench()
    bench.watch(heartbeat_age=(1, 0.4))
    t = bench.now
    bench.watch()
    bench.supervisor.acknowledge(bench.now)
    states = [state for _, state, _ in bench.supervisor.history]
    assert states == [SafetyState.READY, SafetyState.RUNNING, SafetyState.STOPPED, SafetyState.OFF]
    assert bench.supervisor.history[2][0] == t
    assert "drive 2 (node 5)" in bench.supervisor.history[2][2]


def test_only_a_person_leads_out_of_a_stop_and_a_stop_is_always_possible() -> None:
    out = {
        (event, after)
        for (before, event), after in TRANSITIONS.items()
        if before is SafetyState.STOPPED and after is not SafetyState.STOPPED
    }
    assert out == {("acknowledged", SafetyState.OFF)}
    assert all(TRANSITIONS[state, "fault"] is SafetyState.STOPPED for state in SafetyState)
    into = {
        (before, event)
        for (before, event), after in TRANSITIONS.items()
        if after is SafetyState.RUNNING and before is not SafetyState.RUNNING
    }
    assert into == {(SafetyState.READY, "command")}


EVENTS = (
    "enabled",
    "disabled",
    "check",
    "wild",
    "watch",
    "sick",
    "late",
    "stop",
    "lost",
    "exception",
    "acknowledge",
)


@quickly
@given(
    st.lists(st.sampled_from(EVENTS), max_size=40),
    st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=4, max_size=4),
)
@example(
    ["enabled", "check", "stop", "enabled", "check", "watch", "disabled", "check", "acknowledge", "check"],
    [0.0, 0.0, 0.0, NAN],
)
def test_whatever_happens_only_a_release_ends_a_stop(events: list[str], wild: list[float]) -> None:
    bench = Bench(running=False)
    s = bench.supervisor
    for event in events:
        before, first, stops = s.state, s.first, len(bench.stops)
        told: np.ndarray | None = None
        try:
            if event in ("check", "wild"):
                told = s.check(BENT if event == "check" else wild, bench.now)
            elif event in ("watch", "sick", "late"):
                bench.watch(
                    dt=0.3 if event == "late" else DT, heartbeat_age=(0, 9.0 if event == "sick" else 0.01)
                )
            elif event in ("enabled", "disabled", "acknowledge"):
                getattr(s, event)(bench.now)
            elif event == "stop":
                s.emergency_stop(bench.now)
            elif event == "lost":
                s.client_lost(bench.now)
            else:
                s.exception(bench.now, OSError())
        except RefusedError:
            assert event in ("check", "wild", "enabled", "acknowledge")
        if before is SafetyState.STOPPED:
            assert s.state is SafetyState.STOPPED or (event, s.state) == ("acknowledge", SafetyState.OFF)
            assert s.first is first or event == "acknowledge"
            assert told is None
        elif s.state is SafetyState.STOPPED:
            assert len(bench.stops) == stops + 1
            assert s.first is bench.stops[-1]
        if event == "stop":
            assert s.state is SafetyState.STOPPED
        if told is not None:
            assert before in (SafetyState.READY, SafetyState.RUNNING)
            assert np.isfinite(told).all()
            assert np.abs(told).max() <= s.limits.displacement
        assert (s.state is SafetyState.STOPPED) == bool(s.faults)


@quickly
@given(st.lists(st.floats(-0.012, 0.012), min_size=4, max_size=4))
def test_a_command_passes_as_it_is_or_not_at_all(dl: list[float]) -> None:
    supervisor = Supervisor(ROBOT, Limits())
    supervisor.enabled(0.0)
    x, y = dl[0] - dl[2], dl[1] - dl[3]
    # the closed form of four tendons
    fits = max(map(abs, dl)) <= 0.008 and math.hypot(x, y) / (2.0 * 0.0075) / 0.07 <= 20.0
    try:
        told: np.ndarray | None = supervisor.check(dl, 0.0)
    except RefusedError:
        told = None
    assert (told is not None) == fits
    assert told is None or np.array_equal(told, dl)


def test_stop_is_pressed_by_another_thread_while_the_loop_watches() -> None:
    for _ in range(20):
        bench = Bench()
        begun, pressed, refused = threading.Event(), threading.Event(), 0

        def press(
            bench: Bench = bench, begun: threading.Event = begun, pressed: threading.Event = pressed
        ) -> None:
            begun.wait()
            bench.supervisor.emergency_stop(bench.now, "from a page")
            pressed.set()

        thread = threading.Thread(target=press)
        thread.start()
        for k in range(100_000):
            bench.watch()
            over = pressed.is_set()
            try:
                bench.supervisor.check(BENT, bench.now)
                assert not over
            except RefusedError:
                refused += 1
            if k == 3:
                begun.set()
            if over:
                break
        thread.join()
        assert refused >= 1
        assert [fault.kind for fault in bench.stops] == ["emergency stop"]
        assert bench.supervisor.state is SafetyState.STOPPED


def test_a_slow_stop_holds_up_nobody_else() -> None:
    """The lock is not held while the stop is sent: another thread sees the state, and its own stop goes
    through."""
    inside, go = threading.Event(), threading.Event()
    sent: list[str] = []

    def on_stop(fault: Fault) -> None:
        sent.append(fault.kind)
        if fault.kind == "nobody watches":
            inside.set()
            assert go.wait(10.0)

    supervisor = Supervisor(ROBOT, Limits(), on_stop=on_stop)
    supervisor.enabled(0.0)
    thread = threading.Thread(target=supervisor.client_lost, args=(1.0,))
    thread.start()
    assert inside.wait(10.0)
    with pytest.raises(RefusedError, match="stopped"):
        supervisor.check(BENT, 1.0)
    supervisor.emergency_stop(1.1)
    go.set()
    thread.join()
    assert sent == ["nobody watches", "emergency stop"]


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"displacement": 8.0}, "given in mm"),
        ({"rate": 30.0}, "given in mm/s"),
        ({"cycle": 100.0}, "given in ms"),
        ({"tension": 0.0}, r"Limits\.tension is 0\.0; it must be a positive number \[N\]"),
        ({"curvature": NAN}, r"curvature is nan.*\[1/m\]"),
        ({"heartbeat_age": True}, "heartbeat_age is True"),
        ({"command_age": None}, "command_age is None"),
        ({"slack": 15.0}, "least must be below"),
    ],
)
def test_limits_that_cannot_be_are_named(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        Limits(**wrong)
    assert Limits(sighting_age=None).slack is None


def test_a_camera_that_stops_nothing() -> None:
    bench = Bench(limits=Limits(sighting_age=None))
    assert bench.watch(camera=CameraWatch(age=INF, frozen=True)) is None


def test_a_supervisor_that_cannot_be_is_named() -> None:
    rod = Segment(length=0.07, bending_stiffness=(0.002, 0.002), torsional_stiffness=0.001, mode="passive")
    with pytest.raises(InputError, match="has no tendons"):
        Supervisor(Robot(name="bare", segments=(rod,)), Limits())
    with pytest.raises(InputError, match="nodes has 3 node ids and the robot 4 tendons"):
        Supervisor(ROBOT, Limits(), nodes=(1, 2, 3))
    with pytest.raises(UnknownNameError, match="did you mean 'bus off'"):
        Fault(kind="bus of", sentence="", t=0.0)


def test_names_without_node_ids_and_codes_without_words() -> None:
    one = Robot(
        name="one", segments=(replace(ROBOT.segments[0], tendons=(Tendon(offset=0.0075, angle=0.0),) * 4),)
    )
    supervisor = Supervisor(one, Limits())
    supervisor.enabled(0.0)
    fault = supervisor.watch(0.01, None, healthy(0.01, emergencies=EMCY))
    assert fault is not None
    assert fault.sentence == "drive 2 sent an emergency: 0x8611 (error register 0x21)."


@pytest.mark.parametrize(
    ("word", "state"),
    [
        (0x0000, "not ready"),
        (0x0240, "switched off"),
        (0x0221, "ready to switch on"),
        (0x0233, "switched on"),
        (0x0637, "enabled"),
        (0x0217, "quick stop"),
        (0x021F, "reacting to a fault"),
        (0x0218, "in fault"),
        (0x0002, "no state"),
    ],
)
def test_statuswords_in_words(word: int, state: str) -> None:
    assert state in drive_state(word)
