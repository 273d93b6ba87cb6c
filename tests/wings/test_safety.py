"""The supervisor: what it refuses, what stops the robot, and that only a person lets it go again."""

import math
import threading
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import Robot, Tendon
from fastrod.errors import InputError
from fastrod.model.robotfile import load_robot
from fastrod_device.can.clock import SteppedClock
from fastrod_device.errors import RefusedError
from fastrod_device.limits import Limits, limited
from fastrod_device.readings import Emergency, Readings
from fastrod_device.safety import KINDS, TRANSITIONS, CameraWatch, SafetyState, Supervisor
from fastrod_device.safety_words import drive_state

ROBOT = load_robot("prototype")
NODES = (4, 5, 6, 7)
DT = 0.01
OFF, READY, RUNNING, STOPPED = SafetyState.OFF, SafetyState.READY, SafetyState.RUNNING, SafetyState.STOPPED
BENT = np.array([-0.002, 0.001, 0.002, -0.001])
NAN, INF = math.nan, math.inf
SEES = CameraWatch(age=0.05, frozen=False)
quickly = settings(derandomize=True, max_examples=120, deadline=None)


def camera(age, frozen=False, flag=""):
    return {"camera": CameraWatch(age=age, frozen=frozen, flag=flag)}


def healthy(t=0.0, **other):
    """Four enabled drives that hold; `name=(drive, value)` sets one drive's figure, `name=value` all of
    them."""
    still = dict.fromkeys(("dl", "rate", "current", "following_error"), np.zeros(4))
    ages = {"age": np.full(4, 0.004), "heartbeat_age": np.full(4, 0.02)}
    said = {"statusword": np.full(4, 0x1637), "nmt": np.full(4, 5), "emergencies": (), "lost": ""}
    figures = {"tension": np.full(4, 2.0), **still, **ages, **said}
    for name, value in other.items():
        if isinstance(value, tuple) and name != "emergencies":
            drive, value = value
            value = np.where(np.arange(4) == drive, value, figures[name])
        figures[name] = value
    return Readings(t=t, **figures)


class Bench:
    """A supervisor, the stops that it sent, and time."""

    def __init__(self, *, running=True, limits=None):
        self.stops, self.fails, self.now = [], 0, 100.0
        given = {"on_stop": self._stop, "nodes": NODES, "words": lambda code: f"code {code:04X}"}
        self.supervisor = Supervisor(ROBOT, limits or Limits(), **given)
        if running:
            self.supervisor.enabled(self.now)
            self.watch()
            self.check()

    def _stop(self, fault):
        assert self.state is STOPPED  # no command passes while the stop is on its way
        self.stops.append(fault)
        if self.fails:
            self.fails -= 1
            raise OSError("bus is gone")

    def watch(self, dt=DT, jump=0.0, camera=SEES, **other):
        self.now += dt
        return self.supervisor.watch(self.now, 1.7e9 + self.now + jump, healthy(self.now, **other), camera)

    def check(self, dl=BENT, **stamp):
        return self.supervisor.check(dl, self.now, **stamp)

    def acknowledge(self):
        self.supervisor.acknowledge(self.now)

    @property
    def state(self):
        return self.supervisor.state

    @property
    def status(self):
        return self.supervisor.status

    @property
    def kinds(self):
        return [fault.kind for fault in self.supervisor.faults]

    @property
    def sent(self):
        return [fault.kind for fault in self.stops]


EMCY = (Emergency(drive=1, code=0x8611, register=0x21, t=0.0),)
SECOND = "drive 2 (node 5)"
CASES = [
    ("clock jump", {"jump": 0.5}, ("500 ms", "200 ms")),
    ("clock jump", {"jump": -3600.0}, ("-3.6e+06 ms",)),
    ("clock jump", {"dt": -0.5}, ("500 ms", "ran back")),
    ("controller stalled", {"dt": 0.3}, ("300 ms", "50 ms")),
    ("bus off", {"lost": "can0 is bus-off."}, ("can0 is bus-off",)),
    ("node reboot", {"nmt": (1, 0)}, (SECOND, "0 (booting)")),
    ("node reboot", {"nmt": (3, 127)}, ("drive 4 (node 7)", "pre-operational")),
    ("emergency message", {"emergencies": EMCY}, (SECOND, "0x8611", "code 8611", "0x21")),
    ("drive fault", {"statusword": (1, 0x0238)}, (SECOND, "in fault", "0x0238")),
    ("drive fault", {"statusword": (2, 0x0250)}, ("drive 3 (node 6)", "switch on disabled", "0x0250")),
    ("foreign SYNC", {"foreign_syncs": 3}, ("another node sends SYNC (3 since the last cycle)",)),
    ("drive fault", {"statusword": (0, 0x0217)}, ("drive 1 (node 4)", "quick stop")),
    ("heartbeat lost", {"heartbeat_age": (1, 0.16)}, (SECOND, "160 ms", "150 ms")),
    ("heartbeat lost", {"heartbeat_age": (1, INF), "nmt": (1, -1)}, (SECOND, "inf")),
    ("feedback stale", {"age": (1, 0.031)}, (SECOND, "31 ms", "30 ms")),
    ("feedback stale", {"age": (0, NAN)}, ("drive 1 (node 4)", "nan")),
    ("encoder jump", {"dl": (1, 0.0009)}, (SECOND, "0.9 mm", "10 ms", "0.8 mm")),
    ("encoder jump", {"dl": (1, NAN)}, (SECOND, "nan")),
    ("following error", {"following_error": (1, -0.0011)}, (SECOND, "-1.1 mm", "1 mm")),
    ("tension", {"tension": (1, 15.5)}, (SECOND, "15.5 N", "15 N")),
    ("tension", {"tension": (3, -16.0)}, ("drive 4 (node 7)", "-16 N")),
    ("displacement", {"dl": (1, -0.0093), "dt": 0.3}, (SECOND, "-9.3 mm", "9 mm")),
    ("slack tendon", {"tension": (1, 0.1)}, (SECOND, "0.1 N", "0.2 N")),
    ("camera frozen", camera(0.3, frozen=True), ("repeats its frames", "300 ms")),
    ("marker lost", camera(0.6), ("600 ms", "500 ms")),
    ("marker lost", camera(INF), ("inf",)),
    ("marker lost", camera(-5.0), ("-5000 ms", "500 ms")),
    ("marker lost", camera(0.6, flag="outlier"), ("flagged 'outlier'",)),
    ("command stale", {"dt": 0.6, "rate": (1, 0.02)}, ("20 mm/s", "600 ms", "500 ms")),
]
LIMITS = {
    "displacement": Limits(cycle=0.5, command_age=1.0),
    "slack tendon": Limits(slack=0.2),
    "command stale": Limits(cycle=1.0),
}


@pytest.mark.parametrize(("kind", "other", "words"), CASES)
def test_every_kind_of_fault_stops_in_the_call_that_finds_it_and_says_what_it_was(kind, other, words):
    bench = Bench(limits=LIMITS.get(kind))
    if kind == "displacement":  # it came there slowly enough
        bench.watch(dl=(1, -0.0045), dt=0.3)
        bench.check()
    assert (bench.state, bench.stops) == (RUNNING, [])
    found = bench.watch(**other)
    assert (found.kind, found.t, bench.stops, bench.state) == (kind, bench.now, [found], STOPPED)
    assert all(word in found.sentence for word in words), found.sentence
    assert (found.sentence[-1], found.sentence.count(". ")) == (".", 0)  # one sentence
    if "drive" in words[0]:
        assert words[0] == f"drive {found.drive + 1} (node {NODES[found.drive]})"
    with pytest.raises(RefusedError, match="stopped"):
        bench.check()
    assert kind in bench.status


def test_the_cases_and_the_calls_cover_every_kind():
    assert {kind for kind, _, _ in CASES} | {"emergency stop", "nobody watches", "exception"} == set(KINDS)


def test_a_healthy_robot_runs_on():
    bench = Bench()
    for k in range(200):
        bench.check()
        assert bench.watch(dl=np.full(4, 0.0003 * (k % 2)), tension=np.full(4, 14.9), emergencies=()) is None
    reset = (Emergency(drive=0, code=0x0000, register=0, t=0.0),)  # CiA 301: the error is gone
    assert bench.watch(emergencies=reset) is None
    assert bench.watch(camera=None) is None
    assert (bench.state, bench.status) == (RUNNING, "The robot follows commands.")


def test_a_late_sample_has_gone_further_and_is_no_jump():
    bench = Bench()
    bench.watch(age=np.full(4, 0.025))
    # 34 ms between samples: 1.02 mm by rate, and 0.5
    assert bench.watch(dl=(1, 0.00135), age=np.full(4, 0.001)) is None
    assert bench.watch(dl=(1, 0.0030)).kind == bench.stops[0].kind == "encoder jump"


def test_readings_that_are_looked_at_again_grow_old():
    bench = Bench()
    same = healthy(bench.now)
    found = [bench.supervisor.watch(bench.now + k * DT, None, same, None) for k in range(1, 5)]
    assert found[1] is None
    assert bench.kinds == ["bus off", "feedback stale"]


def test_all_drives_silent_is_the_bus_and_one_of_them_a_drive():
    found, one = Bench().watch(age=np.array([0.05, 0.04, 0.06, 0.05])), Bench().watch(age=(2, 0.04))
    assert (found.kind, found.drive) == ("bus off", None)
    assert "no drive has sent process data for 40 ms; the limit is 30 ms" in found.sentence
    assert (one.kind, one.drive) == ("feedback stale", 2)


def test_an_encoder_jump_is_the_cause_of_a_drives_following_error():
    bench = Bench()
    assert bench.watch(dl=(1, 0.003), emergencies=EMCY, statusword=(1, 0x0238)) is not None
    assert bench.kinds == ["encoder jump", "emergency message", "drive fault"]


def test_a_watchdog_stops_a_loop_that_does_not_look_any_more():
    bench = Bench()
    assert bench.supervisor.stalled(bench.now + 0.05) is None
    found = bench.supervisor.stalled(bench.now + 0.07)
    assert (found.kind, bench.stops) == ("controller stalled", [found])
    assert all(words in found.sentence for words in ("70 ms", "50 ms"))
    assert bench.supervisor.stalled(bench.now + 9.0) is None  # it is stopped
    bench.watch()
    bench.acknowledge()
    assert bench.supervisor.stalled(bench.now + 9.0) is None  # it is off


def test_a_robot_that_stands_needs_no_command_and_one_that_is_steered_none_too_many():
    bench = Bench()
    for _ in range(100):
        assert bench.watch() is None  # stands
    for _ in range(100):
        bench.check()
        assert bench.watch(rate=(1, 0.03)) is None  # steered
    found = [bench.watch(rate=(1, 0.03)) for _ in range(52)]
    assert found[47] is None
    assert bench.sent == ["command stale"]


def test_a_stamp_of_the_future_does_not_keep_a_command_young():
    bench = Bench()
    bench.check(stamp=bench.now + 0.4)
    found = [bench.watch(rate=(1, 0.03)) for _ in range(55)]
    assert any(fault is not None and fault.kind == "command stale" for fault in found)


def test_of_several_faults_the_cause_is_first_and_the_rest_is_kept():
    bench, old = Bench(), np.full(4, 1.0)
    first = bench.watch(heartbeat_age=old, age=old, lost="bus-off", **camera(9.0, frozen=True))
    assert bench.kinds == ["bus off", "heartbeat lost", "feedback stale", "camera frozen", "marker lost"]
    assert bench.kinds == sorted(bench.kinds, key=KINDS.index)
    assert bench.watch(tension=(0, 99.0), statusword=(2, 0x8)) is None
    assert bench.supervisor.first is first is not None
    assert bench.kinds[5:] == ["drive fault", "tension"]
    assert len(bench.stops) == 1


def test_slowing_down_after_a_stop_is_no_new_fault():
    bench = Bench()
    bench.supervisor.emergency_stop(bench.now, "a test")
    off = {"statusword": np.full(4, 0x0240), "following_error": np.full(4, 0.004), "tension": np.zeros(4)}
    for dl in (0.0012, 0.0024):
        assert bench.watch(dt=0.2, dl=np.full(4, dl), rate=np.full(4, 0.02), **off) is None
    assert bench.kinds == ["emergency stop"]
    assert "a test" in bench.status


def test_what_is_off_is_looked_at_and_not_stopped():
    bench, silent = Bench(running=False), {"heartbeat_age": np.full(4, INF), "nmt": np.full(4, -1)}
    assert bench.watch(statusword=np.full(4, 0x0240), emergencies=EMCY, **silent) is None
    assert bench.supervisor.client_lost(bench.now) is None
    assert (bench.state, bench.status) == (OFF, "The drives are off.")
    bench.now += 5.0  # until it is enabled nobody need look
    bench.supervisor.enabled(bench.now)
    assert bench.watch() is None
    assert bench.status == "The drives are enabled and hold."
    assert bench.watch(dt=0.06) is not None


@pytest.mark.parametrize(
    ("dl", "words"),
    [
        ([0.001, -0.0091, 0.0, 0.0], "tendon 2 was commanded -9.1 mm; this robot's limit is 8 mm."),
        ([0.0, 0.0, 0.0, 1.8e305], "tendon 4 was commanded inf mm; this robot's limit is 8 mm."),
        ([0.0, 0.0, NAN, 0.0], "tendon 3 was commanded nan"),
        ([0.0, 0.0, 0.0, INF], "tendon 4 was commanded inf"),
        ([0.0, 0.0, 0.0], r"shape \(3,\)"),
        ([[0.0] * 4], r"shape \(1, 4\)"),
        (["a"] * 4, "must be 4 numbers"),
        (None, "shape"),
        (
            [-0.0079, -0.0079, 0.0079, 0.0079],
            "segment 1 was commanded to bend with 21.2[0-9]* 1/m; this robot's limit is 20 1/m",
        ),
    ],
)
def test_a_command_beyond_a_limit_is_refused_with_its_figures(dl, words):
    bench = Bench(running=False)
    bench.supervisor.enabled(bench.now)
    with pytest.raises(RefusedError, match=words):
        bench.check(dl)
    assert (bench.state, bench.stops) == (READY, [])


def test_curvature_is_that_of_the_constant_curvature_arc():
    """Tendons at 7.5 mm, bend 1.05 rad over 70 mm: dl = -offset * bend * (cos, sin); 15 1/m."""
    dl = -0.0075 * 0.07 * 15.0 * np.array([1.0, 0.0, -1.0, 0.0])
    assert_array_equal(Bench(limits=Limits(curvature=15.001)).check(dl), dl)
    with pytest.raises(RefusedError, match=r"15 1/m; this robot's limit is 14\.999"):
        Bench(limits=Limits(curvature=14.999)).check(dl)


@pytest.mark.parametrize("stamp", [99.4, -INF, NAN, 101.0])
def test_a_command_that_was_meant_long_ago_is_refused(stamp):
    supervisor = Bench().supervisor
    with pytest.raises(RefusedError, match=r"meant .* ms ago; the limit is 500 ms"):
        supervisor.check(BENT, 100.0, stamp=stamp)
    assert_array_equal(supervisor.check(BENT, 100.0, stamp=99.6), BENT)


def test_a_command_is_a_copy():
    mine = BENT.copy()
    reported = Bench().check(mine)
    mine[0] = 1.0
    assert_array_equal(reported, BENT)


lengths = st.lists(st.floats(-0.02, 0.02), min_size=4, max_size=4).map(np.array)


@quickly
@given(lengths, lengths, st.floats(0.001, 0.1), st.floats(0.0, 1.0))
@pytest.mark.study
def test_a_limited_step_goes_straight_and_no_tendon_beyond_its_rate(a, b, rate, dt):
    c = limited(a, b, rate, dt)
    assert np.abs(c - a).max() <= rate * dt * (1.0 + 1e-12) + 1e-17
    fraction = np.linalg.norm(c - a) / max(np.linalg.norm(b - a), 1e-300)
    assert_allclose(c, a + min(fraction, 1.0) * (b - a), atol=1e-15)
    assert np.array_equal(c, b) or np.abs(b - a).max() > rate * dt
    assert_array_equal(Supervisor(ROBOT, Limits(rate=rate)).limited(a, b, dt), c)


@pytest.mark.parametrize("running", [False, True])
def test_a_stop_can_be_pressed_in_any_state_and_again(running):
    bench = Bench(running=running)
    fault = bench.supervisor.emergency_stop(bench.now, "the red button.")
    assert (fault.kind, bench.state) == ("emergency stop", STOPPED)
    assert fault.sentence == "the emergency stop was pressed: the red button."
    bench.supervisor.emergency_stop(bench.now + 1.0)
    assert len(bench.stops) == 2  # sent again: the first may have been lost
    assert bench.supervisor.faults == (fault,)


def test_a_stop_that_cannot_be_sent_raises_nothing_is_told_and_tried_again():
    bench = Bench()
    bench.fails = 2
    bench.supervisor.emergency_stop(bench.now)
    assert "COULD NOT BE SENT (OSError: bus is gone)" in bench.status
    assert bench.watch() is None
    with pytest.raises(RefusedError, match="could not be sent"):
        bench.acknowledge()
    bench.watch()
    assert (len(bench.stops), "COULD NOT" in bench.status) == (3, False)
    bench.watch()
    assert len(bench.stops) == 3
    assert bench.kinds == ["emergency stop", "exception"]


def test_nobody_watches():
    bench = Bench()
    fault = bench.supervisor.client_lost(bench.now)
    assert (fault.kind, bench.stops, bench.state) == ("nobody watches", [fault], STOPPED)
    assert bench.supervisor.client_lost(bench.now) is None


NINE = RefusedError("tendon 1 was commanded 9 mm.")


@pytest.mark.parametrize("error", [ValueError("no such\nthing"), KeyboardInterrupt(), SystemExit(0), NINE])
def test_whatever_leaves_a_guarded_block_stops_first(error):
    bench, clock = Bench(), SteppedClock()
    clock.sleep_until(7.0)
    with pytest.raises(type(error)), bench.supervisor.guard(clock):  # noqa: PT012
        assert bench.stops == []
        raise error
    assert [(fault.kind, fault.t) for fault in bench.stops] == [("exception", 7.0)]
    assert ("tendon 1 was commanded 9 mm" if error is NINE else type(error).__name__) in bench.stops[
        0
    ].sentence
    assert "\n" not in bench.stops[0].sentence
    with bench.supervisor.guard(clock):
        pass
    assert len(bench.stops) == 1


def test_an_exception_that_cannot_be_told_stops_all_the_same():
    class MuteError(Exception):
        def __str__(self):
            raise RuntimeError

    bench = Bench()
    assert "MuteError" in bench.supervisor.exception(bench.now, MuteError()).sentence
    assert len(bench.stops) == 1


def test_a_look_that_fails_stops_the_robot():
    bench = Bench()
    with pytest.raises(InputError, match=r"readings\.dl has shape \(3,\); the robot has 4 drives"):
        bench.watch(dl=np.zeros(3))
    assert bench.sent == ["exception"]


@pytest.mark.parametrize(
    "still",
    [{"heartbeat_age": (1, 0.4)}, {"lost": "gone"}, {"nmt": (0, 127)}, {"tension": (2, 20.0)}, camera(2.0)],
)
def test_a_release_is_refused_while_the_cause_is_there(still):
    bench = Bench()
    first = bench.watch(**still)
    with pytest.raises(RefusedError) as refused:
        bench.acknowledge()
    assert first.sentence in str(refused.value)
    assert "not released" in bench.status
    bench.watch()
    with pytest.raises(RefusedError, match="last looked at"):
        bench.supervisor.acknowledge(bench.now + 60.0)
    bench.acknowledge()
    assert (bench.state, bench.supervisor.faults) == (OFF, ())
    with pytest.raises(RefusedError, match="off, not stopped"):
        bench.acknowledge()
    with pytest.raises(RefusedError, match="drives are off"):
        bench.check()


def test_an_encoder_that_has_jumped_is_no_more_to_be_trusted():
    bench = Bench()
    assert bench.watch(dl=(1, 0.003)) is not None
    for _ in range(10):
        bench.watch(dl=(1, 0.003))
    with pytest.raises(RefusedError, match=r"drive 2 \(node 5\) moved its tendon .* start anew, and home it"):
        bench.acknowledge()


def test_a_drives_own_fault_is_reset_after_the_release():
    bench = Bench()
    bench.watch(statusword=(1, 0x0238))
    bench.acknowledge()
    assert bench.state is OFF
    bench.supervisor.enabled(bench.now)
    assert bench.watch(statusword=(1, 0x0238)) is not None  # it was not reset


def test_a_stop_while_drives_are_being_enabled_is_sent_once_more():
    bench = Bench(running=False)
    bench.supervisor.emergency_stop(bench.now)  # between the drives' enabling and its report
    with pytest.raises(RefusedError, match="enabled, but the robot is stopped"):
        bench.supervisor.enabled(bench.now)
    assert (len(bench.stops), bench.state) == (2, STOPPED)


def test_history_tells_when_and_why():
    bench = Bench()
    bench.watch(heartbeat_age=(1, 0.4))
    t = bench.now
    bench.watch()
    bench.acknowledge()
    assert [state for _, state, _ in bench.supervisor.history] == [READY, RUNNING, STOPPED, OFF]
    when, _, why = bench.supervisor.history[2]
    assert (when, SECOND in why) == (t, True)


def test_only_a_person_leads_out_of_a_stop_and_a_stop_is_always_possible():
    moves = [(before, event, after) for (before, event), after in TRANSITIONS.items() if before is not after]
    assert {move[1:] for move in moves if move[0] is STOPPED} == {("acknowledged", OFF)}
    assert all(TRANSITIONS[state, "fault"] is STOPPED for state in SafetyState)
    assert {move[:2] for move in moves if move[2] is RUNNING} == {(READY, "command")}


CALLS = ["enabled", "disabled", "acknowledge", "client_lost", "emergency_stop"]
LOOKS = ["check", "wild", "watch", "sick", "late", "exception"]
DRIVEN = ["enabled", "check"]


@quickly
@given(
    st.lists(st.sampled_from(CALLS + LOOKS), max_size=40),
    st.lists(st.floats(allow_nan=True, allow_infinity=True), min_size=4, max_size=4),
)
@example(
    [*DRIVEN, "emergency_stop", *DRIVEN, "watch", "disabled", "check", "acknowledge", "check"],
    [0.0, 0.0, 0.0, NAN],
)
def test_whatever_happens_only_a_release_ends_a_stop(events, wild):
    bench = Bench(running=False)
    s = bench.supervisor
    for event in events:
        before, first, stops, reported = s.state, s.first, len(bench.stops), None
        try:
            if event in ("check", "wild"):
                reported = bench.check(BENT if event == "check" else wild)
            elif event in ("watch", "sick", "late"):
                sick = (0, 9.0 if event == "sick" else 0.01)
                bench.watch(dt=0.3 if event == "late" else DT, heartbeat_age=sick)
            elif event == "exception":
                s.exception(bench.now, OSError())
            else:
                getattr(s, event)(bench.now)
        except RefusedError:
            assert event in ("check", "wild", "enabled", "acknowledge")
        if before is STOPPED:
            assert s.state is STOPPED or (event, s.state) == ("acknowledge", OFF)
            assert s.first is first or event == "acknowledge"
            assert reported is None
        elif s.state is STOPPED:
            assert len(bench.stops) == stops + 1
            assert s.first is bench.stops[-1]
        if event == "emergency_stop":
            assert s.state is STOPPED
        if reported is not None:
            assert before in (READY, RUNNING)
            assert np.isfinite(reported).all()
            assert np.abs(reported).max() <= s.limits.displacement
        assert (s.state is STOPPED) == bool(s.faults)


@quickly
@given(st.lists(st.floats(-0.012, 0.012), min_size=4, max_size=4))
def test_a_command_passes_as_it_is_or_not_at_all(dl):
    x, y = dl[0] - dl[2], dl[1] - dl[3]
    # the closed form of four tendons
    fits = max(map(abs, dl)) <= 0.008 and math.hypot(x, y) / (2.0 * 0.0075) / 0.07 <= 20.0
    try:
        reported = Bench().check(dl)
    except RefusedError:
        reported = None
    assert (reported is not None) == fits
    assert reported is None or np.array_equal(reported, dl)


def test_stop_is_pressed_by_another_thread_while_the_loop_watches():
    for _ in range(20):
        bench, begun, pressed, refused = Bench(), threading.Event(), threading.Event(), 0

        def press(bench=bench, begun=begun, pressed=pressed):
            begun.wait()
            bench.supervisor.emergency_stop(bench.now, "from a page")
            pressed.set()

        thread = threading.Thread(target=press)
        thread.start()
        for k in range(100_000):
            bench.watch()
            over = pressed.is_set()
            try:
                bench.check()
                assert not over
            except RefusedError:
                refused += 1
            if k == 3:
                begun.set()
            if over:
                break
        thread.join()
        assert refused >= 1
        assert (bench.sent, bench.state) == (["emergency stop"], STOPPED)


def test_a_slow_stop_holds_up_nobody_else():
    """The lock is not held while the stop is sent: another thread sees the state, and its own stop goes
    through."""
    inside, go, sent = threading.Event(), threading.Event(), []

    def on_stop(fault):
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


def test_a_camera_that_stops_nothing():
    limits = Limits(sighting_age=None)
    assert limits.slack is None
    assert Bench(limits=limits).watch(**camera(INF, frozen=True)) is None


def test_names_without_node_ids_and_codes_without_words():
    twisted = replace(ROBOT.segments[0], tendons=(Tendon(offset=0.0075, angle=0.0),) * 4)
    supervisor = Supervisor(Robot(name="one", segments=(twisted,)), Limits())
    supervisor.enabled(0.0)
    fault = supervisor.watch(0.01, None, healthy(0.01, emergencies=EMCY))
    assert fault.sentence == "drive 2 sent an emergency: 0x8611 (error register 0x21)."


STATES = """0000 not ready, 0240 switched off, 0221 ready to switch on, 0233 switched on, 0637 enabled, \
0217 quick stop, 021F reacting to a fault, 0218 in fault, 0002 no state"""


@pytest.mark.parametrize("row", STATES.split(", "))
def test_statuswords_in_words(row):
    word, state = row.split(" ", 1)
    assert state in drive_state(int(word, 16))
