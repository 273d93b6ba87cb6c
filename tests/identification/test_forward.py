"""A log through the model in one go, against a simulator that goes through it step by step."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments, wave
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import fastrod.effects.base as registry
from fastrod import Robot, Simulator
from fastrod.effects.base import Parameter, Seam, Signal, Static, effect, get_effect, has_memory, signal_of
from fastrod.effects.executor import reads_bend
from fastrod.effects.ports import EffectPorts
from fastrod.errors import EffectError
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import (
    N_STEPS,
    PredictedPose,
    PredictedRod,
    effects_at,
    predict,
    prepare_log,
)
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.search.linearised import LinearisedModel, target_of
from fastrod.logs.runlog import RunLog
from fastrod.model.routing import route
from fastrod.types import Floats

N = 30
GIVEN: dict[str, dict[str, Any]] = {
    "latency": {"delay": 0.13},
    "slip": {"step": [4e-4, 0.0, -3e-4, 0.0], "at": 0.7},
    "temperature": {"gain": 0.1, "time_constant": 20.0},
    "backlash": {"half_width": [3e-4, 5e-4], "rounding": 0.2},
    "friction": {"half_width": [4e-4, 3e-4], "presliding": 6e-4, "growth": 0.5, "spread": 0.7},
    "creep": {"share": 0.15, "time_constant": 0.4},
    "capstan_friction": {"mu": [0.4, 0.3, 0.5, 0.4], "presliding": 6e-4, "spread": 0.7},
    "body_friction": {"bend": [0.02, 0.03], "width": 0.04},
    "body_hysteresis": {"bend": [0.03, 0.02], "width": 0.05, "spread": 1.0},
    "plastic_set": {"share": 0.2, "yield_at": 0.3},
    "second_order_lag": {"period": 0.08, "damping": 0.2},
    "time_drift": {"x": 1e-4, "y": -2e-4, "z": 5e-5},
    "rotation_drift": {"x": 2e-3, "y": -1e-3, "z": 4e-3},
    "settling_drift": {"x": 1e-3, "y": -2e-3, "z": 5e-4, "time_constant": 5.0},
}
TABLES: dict[str, dict[str, Any]] = {
    name: GIVEN.get(name)
    or {p.name: p.on(route(two_segments())).starts[0] for p in get_effect(name).parameters}
    for name in registry.effect_names()
    if has_memory(get_effect(name)) or signal_of(get_effect(name)) is Signal.TIME
}
"""Every effect with a memory or a clock; one that is not given above as a fit starts it."""
MEMORIES = [{"name": name} | table for name, table in TABLES.items()]
STATIC: list[dict[str, Any]] = [
    {"name": "drum_gain", "gain": [0.03, -0.02, 0.04, 0.01]},
    {"name": "encoder_offset", "offset": 1e-4},
    {"name": "coupling", "from_distal": 0.1, "from_proximal": -0.05},
    {"name": "slack", "half_width": 2e-4},
    {"name": "stiffening", "cubic": 0.05},
    {"name": "routing_angle", "angle": [0.05, -0.04, 0.02, 0.03]},
    {"name": "tendon_stretch", "compliance": 3e-4},
    {"name": "axial_compression", "per_bend": 0.02, "common_share": 0.5},
    {"name": "precurvature", "uniform_x": 0.5, "bow_y": 1.0},
    {"name": "gravity", "line_density": 0.1},
    {"name": "payload", "mass": 0.01},
    {"name": "marker_offset", "x": 2e-3, "z": 1e-3},
    {"name": "frame_misalignment", "rotation_x": 0.03, "shift_y": 1e-3},
]


def times(n: int = N) -> np.ndarray:
    """(n,) irregular, from 3 s on."""
    return 3.0 + np.cumsum(np.random.default_rng(2).uniform(0.02, 0.08, n))


def log(robot: Robot, n: int = N) -> RunLog:
    """Every kind of input: tendons, extensions, loads, another base half way."""
    turned = Rotation.from_rotvec(np.where(np.arange(n)[:, None] < n // 2, 0.0, [0.9, -0.5, 0.3]))
    return log_of(
        robot,
        wave(robot, n),
        t=times(n),
        payload=np.where(np.arange(n) % 20 < 10, 0.0, 0.02),
        ext=np.full((n, robot.n_segments), 1e-3),
        tip_force=np.outer(np.sin(np.arange(n)), [0.02, 0.01, -0.01]),
        base_quaternion=turned.as_quat(scalar_first=True),
        points=np.zeros((n, len(robot.log_points), 3)),
    )


def stepped(robot: Robot, what: RunLog) -> PredictedPose:
    """Return what a simulator of the robot measures, settled at every sample, its clock that of the log."""
    sim = Simulator(robot, points_per_segment=N_STEPS)
    seen = []
    for i in range(len(what)):
        sim.dt = float(what.t[i] - what.t[i - 1]) if i else 1.0  # the first is no step
        rotation = Rotation.from_quat(what.base_quaternion[i].copy(), scalar_first=True)
        state = sim.settle(
            robot.rest_tendon_length + what.dl[i],
            tip_force=rotation.apply(what.tip_force[i].copy()) + what.payload[i] * np.array(robot.gravity),
            base_pose=np.concatenate([robot.base_position, what.base_quaternion[i]]),
            extension=what.ext[i],
            tolerance=1e-10 * robot.length,
        )
        assert state.ok.all()
        seen.append(sim.measure())
    position, rotation, points = (np.concatenate(parts) for parts in zip(*seen, strict=True))
    return PredictedPose(position, rotation, points, np.ones(len(what), bool))


def predicted(robot: Robot, what: RunLog) -> PredictedPose:
    """The rows of a log as identification sees them: the robot's effects are known, no more is fitted."""
    samples = sample(what)
    model = base_model(robot)
    pose = predict(model, model.start, samples, PredictedRod(samples, robot, points=True))
    assert pose.ok.all()
    return pose


def assert_alike(one: PredictedPose, two: PredictedPose, length: float) -> None:
    """Both settled, one to 1e-8 of the length: some of that at the tip, and over the length in angle."""
    assert_allclose(one.position, two.position, atol=3e-8 * length)
    assert_allclose(one.points, two.points, atol=3e-8 * length)
    assert_allclose(one.rotation, two.rotation, atol=3e-7)


def elastic(robot: Robot) -> Robot:
    """With tendons that give way to the body: stiff ones hold it, whatever rubs in it."""
    return replace(
        robot,
        segments=tuple(
            replace(s, tendons=tuple(replace(t, compliance=2e-3) for t in s.tendons)) for s in robot.segments
        ),
    )


def having(robot: Robot, *tables: dict[str, Any]) -> Robot:
    return replace(robot, effects=tables)


def test_every_effect_with_a_memory_or_a_clock_is_here() -> None:
    assert set(GIVEN) <= set(TABLES)
    assert {"temperature", "time_drift", "backlash", "latency"} <= set(TABLES)
    assert not set(TABLES) & {table["name"] for table in STATIC}


@pytest.mark.study(beyond=6)
@pytest.mark.parametrize("name", TABLES)
def test_a_log_in_one_go_is_a_simulator_step_by_step(name: str) -> None:
    bare = elastic(two_segments()) if reads_bend(get_effect(name)) else two_segments()
    robot = having(bare, {"name": name} | TABLES[name])
    what = log(robot)
    found = predicted(robot, what)
    assert_alike(found, stepped(robot, what), robot.length)
    # and the effect is there
    assert np.abs(found.position - predicted(bare, what).position).max() > 1e-4


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("tables", [STATIC, [*MEMORIES, *STATIC]], ids=["static", "all"])
def test_effects_at_once_are_the_simulator(tables: list[dict[str, Any]]) -> None:
    """With static ones before, between and after those with a memory."""
    robot = having(two_segments(), *tables)
    what = log(robot)
    assert_alike(predicted(robot, what), stepped(robot, what), robot.length)


def test_several_runs_begin_with_no_memory() -> None:
    """Two runs, interleaved in the file, the second at another time of day: each as if it were alone."""
    robot = having(two_segments(), *MEMORIES)
    alone = log(robot)
    other = replace(alone, dl=wave(robot, N, seed=5), t=alone.t + 100.0)
    order = np.argsort(np.concatenate([np.arange(N), np.arange(N) + 0.5]), kind="stable")
    names = ("t", "dl", "tip_position", "payload", "ext", "tip_force", "base_quaternion", "points")
    columns = {n: np.concatenate([getattr(alone, n), getattr(other, n)])[order] for n in names}
    both = RunLog(name="both", run=np.repeat(["a", "b"], N)[order], **columns)
    samples = sample(both)
    assert [(part.start, part.stop) for part in samples.runs] == [(0, N), (N, 2 * N)]
    assert_allclose(samples.time[[0, N]], 0.0)
    assert_array_equal(samples.dt[[0, N]], 0.0)
    assert_allclose(samples.dt[1:N], np.diff(alone.t), rtol=1e-12)
    found = predicted(robot, both)
    for part, single in zip(samples.runs, (alone, other), strict=True):
        assert_alike(PredictedPose(*(a[part] for a in found)), predicted(robot, single), robot.length)
    # and as one run they would be something else
    merged = replace(both, run=np.full(2 * N, ""), t=0.05 * np.arange(2 * N))
    assert np.abs(predicted(robot, merged).position - found.position).max() > 1e-4


def test_a_run_that_continues_another_continues_its_memories() -> None:
    """The same motion labelled as two runs: bit for bit, but for effects that count the time of a run."""
    robot = having(two_segments(), *(m for m in MEMORIES if has_memory(get_effect(m["name"]))))
    whole = log(robot)
    halves = replace(whole, run=np.repeat(["a", "b"], N // 2))
    assert len(sample(halves).runs) == 2
    assert [(part.start, part.stop) for part in sample(halves).histories] == [(0, N)]
    assert_array_equal(predicted(robot, halves).position, predicted(robot, whole).position)


def test_a_loss_that_looks_at_some_rows_does_not_shorten_the_memory() -> None:
    """The memory of tendons goes on; bends between the rows are interpolated."""
    robot = having(two_segments(), *(m for m in MEMORIES if not reads_bend(get_effect(m["name"]))))
    what = log(robot)
    whole = predicted(robot, what)
    samples = sample(what).on(np.array([3, 11, 12, 29]))
    model = base_model(robot)
    some = predict(model, model.start, samples, PredictedRod(samples, robot, points=True))
    assert_alike(some, PredictedPose(*(a[samples.rows] for a in whole)), robot.length)


@pytest.mark.parametrize("name", [n for n in TABLES if has_memory(get_effect(n)) and n != "capstan_friction"])
def test_memories_do_not_miss_what_the_short_samples_leave_out(name: str) -> None:
    """A log of 500 Hz at 40 of its rows, against every sample of it; laws that drag a bend along are of the
    first order in the step, which is 1 % of the largest command."""
    robot = two_segments()
    whole = sample(log_of(robot, wave(robot, 5000, dt=0.002), dt=0.002))
    few = whole.on(np.arange(60, 5000, 123))
    assert len(few.short.time) < 0.6 * len(whole.time)
    assert few.short.dt.sum() == pytest.approx(whole.dt.sum(), rel=1e-12)
    assert_array_equal(few.short.time[few.short.rows], whole.time[few.rows])
    model = base_model(made := having(robot, {"name": name} | TABLES[name]))
    links = effects_at(model, model.start)

    def driven(samples: LogSamples) -> Floats:
        opened = prepare_log(samples, made, route(made)).drive(links)
        return np.column_stack([opened.tendon_length, opened.rest_bend.reshape(len(samples.rows), -1)])

    every, some = driven(whole)[few.rows], driven(few)
    off = every - np.column_stack(
        [whole.log.pulls[few.rows] + robot.rest_tendon_length, np.zeros((len(some), 4))]
    )
    assert np.abs(some - every).max() < 0.03 * np.abs(off).max()


def test_rows_without_a_tip_are_driven_and_rows_without_an_input_are_not_there() -> None:
    robot = having(one_segment(), {"name": "creep", "share": 0.3, "time_constant": 0.3})
    what = log(robot)
    tip, dl = what.tip_position.copy(), what.dl.copy()
    tip[5:9], dl[20] = np.nan, np.nan
    samples = sample(replace(what, tip_position=tip, dl=dl))
    assert len(samples.log) == N - 1
    assert_array_equal(samples.rows, [i for i in range(N - 1) if i not in (5, 6, 7, 8)])
    assert_allclose(samples.dt[20], what.t[21] - what.t[19], rtol=1e-12)
    model = base_model(robot)
    found = predict(model, model.start, samples, PredictedRod(samples, robot))
    kept = np.delete(np.arange(N), [20])
    alone = stepped(robot, what.rows(kept))
    assert_allclose(found.position, alone.position[samples.rows], atol=3e-8 * robot.length)


# A user's own, without `sweep`


class Sluggish:
    """A wire that follows by a share of the way in every time constant.

    Equation: tau y' = l - y, a step at a time
    Source: this test
    Residual signature: lag
    """

    seam = Seam.ACTUATION
    order = 52.0
    parameters = (Parameter("tau", "s", bounds=(0.0, 10.0), typical=0.1),)

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.full((n_robots, n_tendons), np.nan)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        dl = ports.dl
        memory[:] = np.where(np.isnan(memory), dl, memory)
        memory += (dl - memory) * (dt / (dt + values))
        ports.shift_tendons(memory - dl)


class Poke(Static):
    """A force on the backbone, half way.

    Equation: F at l/2
    Source: this test
    Residual signature: bend
    """

    frame: ClassVar[Any] = "world"
    seam = Seam.LOAD
    parameters = (Parameter("force", "N", typical=0.05),)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        half = 0.5 * ports.routing.length.sum()
        ports.add_point_force(half, values * np.array([0.0, 1.0, 0.0]), self.frame)


@pytest.fixture
def strangers() -> Iterator[None]:
    registry.load_library()
    before = dict(registry._REGISTRY)
    effect(Sluggish)
    effect(Poke)
    yield
    registry._REGISTRY.clear()
    registry._REGISTRY.update(before)


@pytest.mark.usefixtures("strangers")
def test_a_users_effect_without_a_sweep_goes_step_by_step() -> None:
    """Between the library's, one before it and one after."""
    tables = [{"name": name} | TABLES[name] for name in ("backlash", "plastic_set")]
    robot = having(two_segments(), {"name": "sluggish", "tau": 0.2}, *tables)
    what = log(robot)
    found = predicted(robot, what)
    assert_alike(found, stepped(robot, what), robot.length)
    assert np.abs(found.position - predicted(having(two_segments(), *tables), what).position).max() > 1e-3
    assert registry.columns(get_effect("sluggish"), route(robot)) == ["tau"]


@pytest.mark.usefixtures("strangers")
def test_a_point_force_over_a_log_is_the_simulators(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the world's frame; one that turns with the rod needs a state, and a log carries none."""
    robot = having(two_segments(), {"name": "poke", "force": 0.1}, {"name": "backlash"} | TABLES["backlash"])
    what = log(robot)
    found = predicted(robot, what)
    assert_alike(found, stepped(robot, what), robot.length)
    assert np.abs(found.position - predicted(two_segments(), what).position).max() > 1e-4
    samples, model = sample(what), base_model(two_segments())
    rod = PredictedRod(samples, model.robot)
    target = target_of(samples, np.full(3, 1e-4), rotation_sigma=0.01, points=False)
    assert not LinearisedModel(model, model.start, samples, rod, target).is_light("poke")
    monkeypatch.setattr(Poke, "frame", "material")
    with pytest.raises(EffectError, match="material frame goes by the last shape; over a log no state"):
        predicted(robot, what)
