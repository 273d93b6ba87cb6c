"""Runs on the emulated prototype in stepped time: what hands are asked for, what is recorded, what is kept
when it is stopped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import Simulator, load_robot
from fastrod.control import references
from fastrod.control.inverse import InversePlan
from fastrod.identification.excite import Excitation
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog
from fastrod.model.routing import route
from fastrod.types import Floats
from fastrod_device.bench.experiment import excite, follow, tracking
from fastrod_device.bench.latency import play, sweep
from fastrod_device.bench.loop import APPROACH, planned
from fastrod_device.bench.workbench import EmulatedBench, emulated
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.hardware import load_hardware
from fastrod_device.prototype import Prototype

ROBOT = load_robot("prototype")
MASS = 0.01
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
TILTED = np.array([0.9659258262890683, 0.25881904510252074, 0.0, 0.0])
SECONDS = 1.6  # of a block


@pytest.fixture
def bench() -> Iterator[EmulatedBench]:
    with emulated(load_hardware(), seed=11, effect="none", home=False) as made:
        yield made


@dataclass
class Noting:
    """Hands that note what they were asked for, and when; those of the emulator then do it."""

    bench: EmulatedBench
    asked: list[tuple[str, float]] = field(default_factory=list)
    at: list[float] = field(default_factory=list)
    stops: bool = False

    def hang(self, mass: float) -> None:
        self._note("hang", mass)
        self.bench.assistant.hang(mass)

    def rotate(self, quaternion: Floats) -> None:
        self._note("turn", float(quaternion[1]))
        self.bench.assistant.rotate(quaternion)

    def _note(self, what: str, number: float) -> None:
        self.asked.append((what, number))
        self.at.append(self.bench.prototype.elapsed)
        if self.stops:
            self.bench.prototype.stop()


def tendons(bend: Floats) -> Floats:
    """(n, 4) of bends (n, 2) [rad]."""
    return route(ROBOT).tendon_change(bend[:, None])


def short_run() -> Excitation:
    """Four blocks of one loop each: without load, with it, with it on a tilted base, and again without."""
    t = np.arange(0.0, 4.0 * SECONDS, 1.0 / 15.0)
    block = (t / SECONDS).astype(int)
    phase = 2.0 * np.pi * t / SECONDS
    payload = np.where((block == 1) | (block == 2), MASS, 0.0)
    base = np.where((block == 2)[:, None], TILTED, UPRIGHT)
    log = RunLog(
        name="short",
        t=t,
        run=np.full(len(t), "run"),
        dl=tendons(0.3 * np.stack([np.sin(phase), np.sin(phase) ** 2], axis=1)),
        tip_position=np.full((len(t), 3), np.nan),
        payload=payload,
        base_quaternion=base,
    )
    return Excitation(log=log, phases=())


def circle_plan() -> InversePlan:
    return planned(ROBOT, references(ROBOT.length)["circle"])


# ---------------------------------------------------------------- excite


@pytest.mark.study
def test_hands_are_asked_in_the_order_of_the_run(bench: EmulatedBench, tmp_path: Path) -> None:
    hands, run, reported = Noting(bench), short_run(), []
    log = excite(
        bench.prototype,
        run,
        hands,
        tmp_path / "run.csv",
        progress=lambda what, done, total: reported.append((what, done, total)),
    )
    assert hands.asked == [("hang", MASS), ("turn", TILTED[1]), ("hang", 0.0), ("turn", 0.0)]
    first, second, third = np.diff(hands.at)
    # after each, the robot waits until hands have left the marker free
    assert min(first, second) >= SECONDS
    assert max(first, second) < SECONDS + 1.5
    assert third == pytest.approx(0.0, abs=0.1)
    # a row for each frame, at 15 Hz, and nearly all with the tip
    assert len(log) == pytest.approx(4.0 * SECONDS * 15.0, abs=6)
    assert log.measured.mean() > 0.9
    # the load and the base are those of the block in which the frame was taken
    assert log.payload is not None
    assert log.base_quaternion is not None
    order = [log.payload[0], *log.payload[1:][np.diff(log.payload) != 0.0]]
    assert order == [0.0, MASS, 0.0]
    tilted = log.base_quaternion[:, 1] > 0.1
    assert (log.payload[tilted] == MASS).all()
    assert tilted.sum() == pytest.approx(SECONDS * 15.0, abs=3)
    assert reported[0][1] == 0
    assert (np.diff([done for _, done, _ in reported]) >= 0).all()


@pytest.mark.study
def test_the_wires_go_where_the_run_says(bench: EmulatedBench, tmp_path: Path) -> None:
    run = short_run()
    log = excite(bench.prototype, run, bench.assistant, tmp_path / "run.csv")
    log = log.rows(log.t < SECONDS)  # later, hands have taken their time
    asked = np.stack([np.interp(log.t, run.log.t, column) for column in run.log.dl.T], axis=1)
    # a drive follows its set-point a cycle or two late: 0.02 s of the quickest tendon
    quickest = np.abs(np.diff(run.log.dl, axis=0)).max() * 15.0
    assert np.abs(log.dl - asked).max() < 0.03 * quickest + 2e-5
    # and the tip is where a model with these tendons has it, to what a body that is a little stiffer leaves
    free = log.measured & (log.payload == 0.0)
    state = Simulator(ROBOT, int(free.sum()), dt=0.05).settle(ROBOT.rest_tendon_length + log.dl[free])
    assert np.sqrt(np.mean((state.tip_position - log.tip_position[free]) ** 2)) < 1e-3


@pytest.mark.study
def test_what_is_returned_is_what_is_on_disk(bench: EmulatedBench, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    log = excite(bench.prototype, short_run(), bench.assistant, path)
    again = read_log(path, ROBOT)
    for name in ("t", "dl", "tip_position", "payload"):
        assert_array_equal(getattr(again, name), getattr(log, name))
    assert {"current_1", "marker_error", "marker_flag", "seen_x", "tension_4", "cmd_dl_1"} <= set(again.extra)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["run.csv"]


def test_a_stop_half_way_keeps_the_rows(bench: EmulatedBench, tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    with pytest.raises(DeviceError, match="stop") as caught:
        excite(bench.prototype, short_run(), Noting(bench, stops=True), path)
    assert "\n" not in str(caught.value)
    kept = read_log(path, ROBOT)
    assert kept.t[-1] == pytest.approx(SECONDS, abs=0.2)
    assert kept.measured.mean() > 0.9
    assert not path.with_name("run.csv.part").exists()
    assert bench.prototype.recorder is None


# ---------------------------------------------------------------- follow


@pytest.mark.study
def test_a_plan_is_followed_by_the_model_and_by_the_policy(bench: EmulatedBench, tmp_path: Path) -> None:
    pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'fastrod[envs]'")
    from fastrod_envs.learning.policies import Policy, find
    from fastrod_envs.learning.policy_driver import PolicyDriver

    made = circle_plan()
    model = tracking("circle", follow(bench.prototype, made, tmp_path / "model.csv"), made)
    pilot = PolicyDriver(Policy(find("Track", "shipped")), "circle", ROBOT)
    bench.prototype.follow(lambda s: (1.0 - min(s, 1.0)) * made.dl[-1], 1.2)  # a policy begins at home
    law = follow(
        bench.prototype, made, tmp_path / "policy.csv", law=lambda tip, t: pilot.command(tip, t - APPROACH)
    )
    policy = tracking("circle", law, made)
    for found in (model, policy):
        on_path = np.isfinite(found.path).all(axis=1)
        assert on_path.sum() == pytest.approx(references(ROBOT.length)["circle"].period * 15.0, abs=4)
        assert found.log.measured[on_path].mean() > 0.9
    # 20 mm of circle by a body that is some per cent stiffer or softer than the model's: the tendons decide,
    # to some tenths of a millimetre;
    # the policy sees the tip, a frame and a latency late: its own residual is about a millimetre
    assert model.distance < 1e-3
    assert policy.distance < 2e-3


@pytest.mark.study
def test_a_stop_on_the_way_keeps_the_rows(bench: EmulatedBench, tmp_path: Path) -> None:
    emulator, made = bench.emulator, circle_plan()
    assert emulator is not None

    def covered(tip: Floats, t: float) -> Floats:
        emulator.hidden = t > 1.5
        return made.dl[0]

    with pytest.raises(DeviceError, match=r"camera|marker|sighting"):
        follow(bench.prototype, made, tmp_path / "covered.csv", law=covered)
    kept = read_log(tmp_path / "covered.csv", ROBOT)
    assert kept.t[-1] == pytest.approx(2.0, abs=0.3)
    assert kept.measured[kept.t < 1.5].mean() > 0.9
    assert not kept.measured[kept.t > 1.6].any()


@pytest.mark.study
def test_a_law_beyond_the_limits_is_refused(bench: EmulatedBench, tmp_path: Path) -> None:
    made = circle_plan()
    with pytest.raises((RefusedError, DeviceError)) as caught:
        follow(
            bench.prototype,
            made,
            tmp_path / "far.csv",
            law=lambda tip, t: made.dl[0] if t < 0.5 else np.full(4, 0.05),
        )
    assert "\n" not in str(caught.value)
    assert len(read_log(tmp_path / "far.csv", ROBOT)) > 4


# ---------------------------------------------------------------- tracking


def test_tracking_numbers_by_hand() -> None:
    """Off by 1 mm along x; the nearest points in reach are 2 mm above the path; the robot lags by the plan's
    lead."""
    n, lead = 40, 0.1
    t = 0.05 * np.arange(n)
    target = np.stack([0.02 * np.cos(t), 0.02 * np.sin(t), np.full(n, 0.07)], axis=1)
    target[:8] = np.nan
    nearest = target + np.array([0.0, 0.0, 2e-3])
    made = InversePlan(
        robot=ROBOT,
        t=t,
        dl=np.zeros((n, 4)),
        ext=np.zeros((n, 1)),
        target=target,
        predicted=nearest,
        nearest=nearest,
        lead=lead,
        n_approach=8,
        rms_predicted=0.0,
        rms_nearest=0.0,
        rms_distance=0.0,
        rollouts=1,
    )
    tip = np.where(np.isfinite(target), target + np.array([1e-3, 0.0, 0.0]), 9.0)
    tip[20] = np.nan
    late = np.append(t + lead, t[-1] + 5.0)  # a row after the plan
    log = RunLog(
        name="x",
        t=late,
        run=np.full(n + 1, ""),
        dl=np.zeros((n + 1, 4)),
        tip_position=np.vstack([tip, [9.0] * 3]),
    )
    found = tracking("circle", log, made)
    assert_allclose(found.rms, [1e-3, 0.0, 0.0], atol=1e-12)
    assert_allclose(found.floor_rms, [0.0, 0.0, 2e-3], atol=1e-12)
    assert found.distance == pytest.approx(np.sqrt(5.0) * 1e-3)
    assert np.isfinite(found.seen).all(axis=1).sum() == n - 8 - 1
    assert_allclose(found.predicted[10], nearest[10], atol=1e-12)


# ---------------------------------------------------------------- the sweep that tells the latency


def test_the_sweep_keeps_within_half_of_the_limits() -> None:
    hardware = load_hardware()
    tight = replace(hardware, limits=replace(hardware.limits, displacement=0.002))
    t = np.arange(0.0, 15.0, 0.001)
    for chosen in (hardware, tight):
        way, limits = sweep(chosen, t), chosen.limits
        assert np.abs(way).max() <= 0.5 * limits.displacement + 1e-9
        assert np.abs(np.diff(way, axis=0)).max() / 0.001 <= 0.51 * limits.rate
        assert np.abs(route(ROBOT).bend(way)).max() / ROBOT.length <= 0.5 * limits.curvature
        assert_allclose(way[[0, -1]], 0.0, atol=1e-5)
        assert np.abs(way).max() > 0.25 * min(limits.displacement, 0.008)


def test_play_stays_until_it_is_dragged() -> None:
    up_and_down = np.array([0.0, 1.0, 2.0, 3.0, 2.5, 2.0, 1.0, 0.0])[:, None]
    assert_array_equal(play(up_and_down, 0.5)[:, 0], [0.0, 0.5, 1.5, 2.5, 2.5, 2.5, 1.5, 0.5])
    assert_array_equal(play(up_and_down, 0.0), up_and_down)


def test_a_prototype_that_is_not_started_says_so(tmp_path: Path) -> None:
    with emulated(load_hardware(), seed=1, effect="none", home=False) as other:
        spare = Prototype(load_hardware(), "virtual:nobody", None, clock=other.prototype.clock)
        with spare, pytest.raises(DeviceError, match="call start first"):
            spare.wait(0.1)
