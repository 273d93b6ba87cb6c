"""Logs in motion: replayed in time, and the robot's own parameters fitted to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod import Modal, Robot, Segment, Simulator, Tendon, save_robot
from fastrod.commands.cli import main
from fastrod.errors import InputError, LogError, RobotError
from fastrod.identification.attribution import identify
from fastrod.identification.log import motion
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.motion import MotionReplay, beginnings, let_go
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.report.result import Result
from fastrod.identification.search.motion import MotionRod, SideBySide
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model.robot import Lump

NOISE = 1e-4  # m
TRUE = {"density": 0.33, "mass": 0.025, "damping": 0.006, "axial": 300.0, "shear": 80.0, "pretension": 1.5}
ALL = {
    "segment.1.line_density": {"sd": 0.1},
    "segment.1.lump.1.mass": {"sd": 0.01},
    "segment.1.damping_time": {"sd": 0.005},
    "segment.1.axial_stiffness": {"sd": 150.0},
    "segment.1.shear_stiffness": {"sd": 50.0},
    "tendon.*.pretension": {"sd": 1.0, "shared": True},
    "segment.*.bending_stiffness": {"sd": 1e-6, "shared": True},
    "segment.*.torsional_stiffness": {"sd": 1e-6, "shared": True},
}

DAMPED = {"segment.1.damping_time": {"sd": 0.005}}


def robot(
    density: float = 0.3,
    mass: float = 0.02,
    damping: float = 0.004,
    axial: float = 400.0,
    shear: float = 100.0,
    pretension: float = 1.0,
    **more: Any,
) -> Robot:
    """Four tendons at right angles on 0.12 m, a disk at the tip."""
    angles = 0.5 * np.pi * np.arange(4)
    tendons = [Tendon(offset=0.0075, angle=a, compliance=1e-4, pretension=pretension) for a in angles]
    segment = Segment(
        length=0.12,
        bending_stiffness=(0.0022, 0.0022),
        torsional_stiffness=1e-3,
        body_radius=0.012,
        line_density=density,
        damping_time=damping,
        axial_stiffness=axial,
        shear_stiffness=shear,
        lumps=(Lump(at=0.12, mass=mass),),
        tendons=tuple(tendons),
    )
    return Robot(name="moving", segments=(segment,), **more)


def commands(seed: int, t: np.ndarray) -> np.ndarray:
    """(n, 4) smooth changes of tendon length [m] from rest, up to 5 Hz, antagonists and a common pull."""
    rng, dl = np.random.default_rng(seed), np.zeros((len(t), 4))
    for frequency in (0.5, 1.3, 2.9, 5.1):
        for j in range(2):
            phase = rng.uniform(0.0, 6.0)
            wave = np.sin(2.0 * np.pi * frequency * t + phase) - np.sin(phase)
            dl[:, j] += rng.uniform(-1.5e-3, 1.5e-3) * wave
    dl[:, 2:] = -dl[:, :2]
    return dl - 4e-4 * (1.0 - np.cos(2.0 * np.pi * 3.7 * t))[:, None]


def recorded(plant: Robot, runs: dict[str, int], t: np.ndarray, noise: float, step: float = 5e-4) -> RunLog:
    """Return what a plant does in motion at a time step finer than the fit's, with noise; a run for each
    seed."""
    dl = np.concatenate([commands(seed, t) for seed in runs.values()])
    labels = np.repeat(list(runs), len(t))
    log = RunLog(
        name="motion", t=np.tile(t, len(runs)), run=labels, dl=dl, tip_position=np.zeros((len(dl), 3))
    )
    samples = sample(log)
    (pose,) = MotionReplay(samples, longest_step=step).poses([[plant]])
    tip = pose.position + noise * np.random.default_rng(7).normal(size=pose.position.shape)
    return replace(log, tip_position=tip)


@pytest.fixture(scope="module")
def found() -> Result:
    log = recorded(robot(**TRUE), {"fitted": 1, "other": 2}, np.arange(100) * 0.01, NOISE)
    return identify(log, robot(fit=ALL), held_out=["other"], dynamics=True)


@pytest.mark.study
def test_parameters_are_recovered_within_their_standard_errors(found: Result) -> None:
    """Six of them, from commands and tip alone; 3 standard errors, or one log of 70 fails by chance."""
    names = {
        "segment.1.line_density": TRUE["density"],
        "segment.1.lump.1.mass": TRUE["mass"],
        "segment.1.damping_time": TRUE["damping"],
        "segment.1.axial_stiffness": TRUE["axial"],
        "segment.1.shear_stiffness": TRUE["shear"],
    }
    for name, true in names.items():
        estimate = found.base_parameters[name]
        assert abs(estimate.value - true) < 3.0 * estimate.stderr, (name, estimate)
        assert estimate.stderr < estimate.prior_sd
    pretension = found.base_parameters["tendon.*.pretension"]  # a factor on the nominal 1 N
    assert abs(pretension.value - TRUE["pretension"]) < 3.0 * pretension.stderr
    tight = {"segment.1.lump.1.mass": 0.02, "segment.1.damping_time": 0.02, "segment.1.line_density": 0.05}
    for name, relative in tight.items():
        assert found.base_parameters[name].stderr < relative * names[name]


@pytest.mark.study
def test_held_out_error_falls_to_the_noise(found: Result) -> None:
    assert found.verdict == "none"
    assert found.as_given_rms is not None
    assert found.as_given_rms[1] > 3.0 * NOISE * np.sqrt(3.0)
    assert_allclose(found.test.after, NOISE * np.sqrt(3.0), rtol=0.1)
    (segment,) = found.identified.segments
    assert segment.damping_time == found.base_parameters["segment.1.damping_time"].value
    assert segment.lumps[0].mass == found.base_parameters["segment.1.lump.1.mass"].value


@pytest.mark.study
@pytest.mark.parametrize(
    "law",
    [{"name": "backlash", "half_width": 4e-4}, {"name": "latency", "delay": 0.03}],
    ids=lambda law: law["name"],
)
def test_an_effect_that_nobody_declared_is_named_in_motion(law: dict[str, Any]) -> None:
    """Beside inertia and damping, with its size, down to the noise on a run that no fit has seen."""
    plant = robot(damping=0.006, effects=(law,))
    log = recorded(plant, {"fitted": 1, "other": 2}, np.arange(100) * 0.01, NOISE)
    found = identify(log, robot(fit=DAMPED), held_out=["other"], dynamics=True)
    assert [effect.name for effect in found.effects][:1] == [law["name"]]
    assert found.verdict == "explained"
    assert found.test.after < 1.1 * NOISE * np.sqrt(3.0)
    assert found.test.before > 3.0 * found.test.after
    size = next(key for key in law if key != "name")
    assert found.effects[0].parameters[size].value == pytest.approx(law[size], rel=0.05)


@pytest.mark.study
def test_damping_that_the_file_does_not_have_is_named() -> None:
    log = recorded(robot(damping=0.006), {"fitted": 1, "other": 2}, np.arange(100) * 0.01, NOISE)
    found = identify(log, robot(damping=0.0), held_out=["other"], dynamics=True)
    assert [effect.name for effect in found.effects] == ["damping"]
    assert found.verdict == "explained"
    assert found.effects[0].parameters["segment.1.damping_time"].value == pytest.approx(0.006, rel=0.02)
    assert found.test.before > 5.0 * found.test.after


@pytest.mark.study
def test_a_bound_in_motion_is_three_standard_errors() -> None:
    """Of a delay, whose response is the velocity of the tip, and of a camera that is aside; the model knows
    its numbers."""
    known = robot(damping=0.006, fit={"segment.1.bending_stiffness": {"sd": 1e-9}})
    log = recorded(known, {"fitted": 1, "other": 2}, np.arange(60) * 0.01, NOISE, step=1e-3)
    found = identify(log, known, held_out=["other"], dynamics=True, max_effects=0)
    late = replace(known, effects=({"name": "latency", "delay": 1e-4},))
    (pose,), (after,) = (MotionReplay(sample(log)).poses([[one]]) for one in (known, late))
    sigma = found.noise.sigma
    response = ((after.position - pose.position) / (1e-4 * sigma))[:60]
    left, power = ((log.tip_position - pose.position) / sigma)[:60], float((response**2).sum())
    bounds = {f"{bound.name} {bound.parameter}": bound.value for bound in found.bounds}
    expected = abs(float((response * left).sum())) / power + 3.0 / np.sqrt(power)
    assert bounds["latency delay"] == pytest.approx(expected, rel=0.1)
    expected = (sigma * (np.abs(left.mean(0)) + 3.0 / np.sqrt(len(left)))).max()
    assert bounds["frame_misalignment shift"] == pytest.approx(expected, rel=0.1)


def let_it_go(damping: float, seconds: float) -> tuple[RunLog, Robot]:
    """A rod without tendons, pulled aside by a force, held for 0.2 s and let go, twice; and that rod."""
    (segment,) = robot(damping=damping).segments
    bare = Robot(name="bare", segments=(replace(segment, tendons=(), lumps=(), mode="passive"),))
    sim = Simulator(bare, n_robots=2, dt=1e-3, dynamics=True, points_per_segment=4)
    sim.settle(tip_force=np.array([[0.15, 0.0, 0.0], [0.0, 0.25, 0.0]]))
    held = sim.measure().tip_position
    tips = [held] * 20
    for k in range(round(1e3 * seconds)):
        sim.step()
        tips += [sim.measure().tip_position] if k % 10 == 9 else []
    n, tip = len(tips), np.stack(tips, axis=1)
    tip = tip + NOISE * np.random.default_rng(5).normal(size=tip.shape)
    t, run = np.tile(0.01 * np.arange(n), 2), np.repeat(["a", "b"], n)
    log = RunLog(name="released", t=t, run=run, dl=np.zeros((2 * n, 0)), tip_position=tip.reshape(-1, 3))
    return log, bare


@pytest.mark.study
def test_inertia_and_damping_are_named_where_a_robot_was_let_go() -> None:
    """A file that has a mass and no damping, evaluated at rest: the log does not say how it was held."""
    log, bare = let_it_go(0.01, 2.0)
    still = replace(bare, segments=(replace(bare.segments[0], damping_time=0.0),))
    found = identify(log, still, held_out=["b"])
    assert [effect.name for effect in found.effects] == ["inertia", "damping"]
    damping = found.effects[1].parameters["segment.1.damping_time"]
    assert damping.value == pytest.approx(0.01, rel=0.03)
    assert found.identified.segments[0].damping_time == damping.value
    assert found.test.before > 10.0 * found.test.after
    assert found.test.after < 2.0 * NOISE * np.sqrt(3.0)  # it starts from one noisy sample


def test_a_log_that_was_let_go_begins_where_it_turns_back() -> None:
    log, _ = let_it_go(0.02, 1.0)
    cut = let_go(log)
    for run, axis in (("a", 0), ("b", 1)):
        rows = log.run == run
        begun = int(np.flatnonzero(np.isfinite(cut.t[rows]))[0])
        x = log.tip_position[rows, axis]
        assert begun > 20  # it was held for as long
        assert x[begun] == pytest.approx(x.min(), abs=3.0 * NOISE)  # the other side
    n = len(log)
    driven = replace(log, dl=commands(1, log.t) + np.arange(n)[:, None] * 1e-6)
    assert let_go(driven) is driven
    t = np.arange(200) * 0.01
    tip = 0.05 * np.exp(-3.0 * t)[:, None] + NOISE * np.random.default_rng(1).normal(size=(200, 3))
    creeps = RunLog(name="c", t=t, run=np.full(200, "a"), dl=np.zeros((200, 4)), tip_position=tip)
    assert let_go(creeps) is creeps


@pytest.mark.study
def test_replay_in_motion_is_the_simulator() -> None:
    """Step by step, with the robot's own effects and each run from rest."""
    plant = robot(effects=({"name": "friction", "half_width": 3e-4}, {"name": "marker_offset", "z": 5e-3}))
    t = np.arange(40) * 2e-3
    log = recorded(plant, {"a": 3, "b": 4}, t, 0.0, step=1e-3)
    shown = replay(log, plant, dynamics=True)
    assert shown.dynamics
    assert shown.converged.all()
    for run, seed in (("a", 3), ("b", 4)):
        solver, dl, tips = Modal(dynamics=True, jumps=False), commands(seed, t), []
        sim = Simulator(plant, dt=1e-3, solver=solver, points_per_segment=4)
        between = np.stack([np.interp(np.arange(79) * 1e-3, t, row) for row in dl.T], axis=1)
        for k, now in enumerate(plant.rest_tendon_length + between):
            sim.step(now) if k else sim.settle(now)
            tips.append(sim.measure().tip_position[0])
        assert_allclose(shown.tip_position[log.run == run], tips[::2], atol=1e-12)
    still = replay(log.only("a"), plant)
    assert np.abs(still.tip_position - shown.tip_position[log.run == "a"]).max() > 1e-3


@pytest.mark.study
def test_uneven_samples_are_interpolated() -> None:
    """The same motion sampled off the steps: a cubic through steps of 1 ms."""
    plant, t = robot(), np.arange(60) * 0.01
    log = recorded(plant, {"a": 3}, t, 0.0, step=1e-3)
    odd = np.sort(np.concatenate([t, t[:-1] + 0.0037]))
    dl = np.stack([np.interp(odd, t, row) for row in log.dl.T], axis=1)
    uneven = RunLog(name="u", t=odd, run=np.full(119, "a"), dl=dl, tip_position=np.zeros((119, 3)))
    (at,) = MotionReplay(sample(uneven)).poses([[plant]])
    assert at.ok.all()
    # another time step, second order: the motion is of 1e-2 m, 5 Hz and below, and its tendons have corners
    assert_allclose(at.position[np.isin(odd, t)], log.tip_position, atol=1e-4)


def test_a_payload_is_a_mass_at_the_tip() -> None:
    """The log's payload moves as a lump of the robot does; one that changes within a run is refused."""
    log = recorded(robot(mass=0.03), {"a": 3}, np.arange(30) * 0.01, 0.0, step=1e-3)
    loaded = replace(log, payload=np.full(len(log), 0.01))
    assert_allclose(replay(loaded, robot(mass=0.02), dynamics=True).tip_position, log.tip_position, atol=1e-9)
    with pytest.raises(LogError, match="payload changes within run 'a'"):
        replay(replace(log, payload=np.linspace(0.0, 0.01, len(log))), robot(), dynamics=True)


@pytest.mark.study
def test_jobs_side_by_side_share_their_questions() -> None:
    """Each has as many as it likes, and jobs of its own; an error is that of its job alone."""
    rounds: list[set[str]] = []
    desk = SideBySide(lambda questions: rounds.append(set(questions)))

    def job(name: str, count: int) -> Callable[[], str]:
        def asks() -> str:
            for k in range(count):
                desk.ask({f"{name}{k}": ()})
            return name

        return asks

    def parent() -> list[str]:
        return [*desk.each([job("b", 2), job("c", 3)]), job("d", 1)()]

    assert desk.each([job("a", 3), parent, job("none", 0)]) == ["a", ["b", "c", "d"], "none"]
    assert rounds == [{"a0", "b0", "c0"}, {"a1", "b1", "c1"}, {"a2", "c2"}, {"d0"}]
    assert desk.each([]) == []

    def fails() -> str:
        raise LogError("no")

    with pytest.raises(LogError, match="no"):
        desk.each([fails, job("e", 2)])
    assert rounds[4:] == [{"e0"}, {"e1"}]
    assert job("f", 1)() == "f"


def test_robots_that_forces_drive_are_moved_together_whatever_their_stiffness() -> None:
    """Their stiffness is part of what an effect of their tendons does."""
    pulled = robot(effects=({"name": "latency", "delay": 0.01},))
    (segment,) = pulled.segments
    robots = [
        (replace(pulled, segments=(replace(segment, mode="tendon_tension", bending_stiffness=(k, k)),)),)
        for k in (0.0022, 0.0025)
    ]
    t, pull = 0.01 * np.arange(6), np.array([1.0, 0.0, -1.0, 0.0])
    tension = 2.0 + 0.3 * np.sin(20.0 * t)[:, None] * pull
    log = RunLog(
        name="forces",
        t=t,
        run=np.full(6, "a"),
        dl=np.zeros((6, 4)),
        tension=tension,
        tip_position=np.zeros((6, 3)),
    )
    together = MotionRod(sample(log)).poses(robots)
    for each, pose in zip(robots, together, strict=True):
        (alone,) = MotionReplay(sample(log)).poses([each])
        assert_allclose(pose.position, alone.position, atol=1e-15)
    assert np.abs(together[0].position - together[1].position).max() > 1e-6


@pytest.mark.study
def test_what_rest_shows_is_fitted_at_rest() -> None:
    """Stretch and a lump's mass, from tips at rest: neither needs a time step."""
    plant, commanded = robot(**TRUE), 1.5 * commands(1, np.arange(80) * 0.025)
    sim, tips = Simulator(plant), []
    for dl in commanded:
        sim.settle(plant.rest_tendon_length + dl)
        tips.append(sim.measure().tip_position[0])
    tip = np.array(tips) + 1e-5 * np.random.default_rng(3).normal(size=(80, 3))
    log = RunLog(name="rest", t=np.arange(80.0), run=np.full(80, "a"), dl=commanded, tip_position=tip)
    fit = {k: v for k, v in ALL.items() if k.endswith(("axial_stiffness", ".mass"))}
    given = robot(density=TRUE["density"], pretension=TRUE["pretension"], fit=fit)
    found = identify(log, given, network=False)
    for name, true in zip(fit, (TRUE["mass"], TRUE["axial"]), strict=True):
        estimate = found.base_parameters[name]
        assert estimate.stderr < 0.4 * estimate.prior_sd
        assert abs(estimate.value - true) < 3.0 * estimate.stderr, (name, estimate)


def test_what_cannot_be_fitted_is_refused() -> None:
    log = recorded(robot(), {"a": 3}, np.arange(50) * 0.01, 0.0, step=1e-3)
    with pytest.raises(RobotError, match="fitted in motion; identify with --dynamics"):
        base_model(robot(fit={"segment.1.damping_time": {"sd": 1.0}}))
    with pytest.raises(RobotError, match="have 1 lumps, counted from 1"):
        base_model(robot(fit={"segment.1.lump.2.mass": {"sd": 1.0}}), dynamics=True)
    stiff = robot(axial=np.inf, fit={"segment.1.axial_stiffness": {"sd": 1.0}})
    with pytest.raises(RobotError, match="no value to begin from"):
        base_model(stiff, dynamics=True)
    with pytest.raises(InputError, match="needs a mass"):
        replay(log, robot(density=0.0, damping=0.0), dynamics=True)
    with pytest.raises(InputError, match="network=True is for a log at rest"):
        identify(log, robot(), dynamics=True, network=True)


@pytest.mark.study
def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = robot()
    log = recorded(plant, {"a": 3}, np.arange(30) * 0.01, 0.0, step=1e-3)
    save_robot(plant, tmp_path / "moving.toml")
    write_log(log, tmp_path / "log.csv")
    words = ["replay", str(tmp_path / "log.csv"), "--robot", str(tmp_path / "moving.toml")]
    assert main([*words, "--dynamics", "--out", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "the model is in motion" in shown
    assert (tmp_path / "out" / "residuals.csv").is_file()


@pytest.mark.study
def test_sessions_have_their_own_zeros_in_motion() -> None:
    """Two runs of one robot on two days: the second day's zero and frame are its own, the mass is shared."""
    monday = robot(effects=({"name": "marker_offset", "z": 0.0},))
    tuesday = robot(
        effects=(
            {"name": "encoder_offset", "offset": [4e-4, -3e-4]},
            {"name": "frame_misalignment", "shift_x": 2e-3},
        )
    )
    t, days = np.arange(120) * 0.01, {"monday": monday, "tuesday": tuesday}
    logs = [recorded(plant, {day: 1}, t, NOISE) for day, plant in days.items()]
    logs = [replace(log, name=day, session=log.run) for log, day in zip(logs, days, strict=True)]
    found = identify(logs, robot(density=0.25, fit={"segment.1.line_density": {"sd": 0.1}}), dynamics=True)
    assert found.verdict == "none"
    assert list(found.sessions) == ["tuesday"]
    for number, true in ((1, 4e-4), (2, -3e-4)):
        zero = found.base_parameters[f"session tuesday.tendon.{number}.zero"]
        assert abs(zero.value - true) < 3.0 * zero.stderr
        assert zero.stderr < 1e-4


def test_a_fit_begins_with_seconds_of_some_runs_and_ends_with_all() -> None:
    t = np.tile(np.arange(3000) * 0.01, 40)
    dl, run = commands(1, np.maximum(t - 7.0, 0.0)), np.repeat([f"{k}" for k in range(40)], 3000)
    log = RunLog(name="long", t=t, run=run, dl=dl, tip_position=np.zeros((len(t), 3)))
    rows = np.flatnonzero(np.arange(len(t)) % 5 > 0)
    first, *more = beginnings(sample(log), rows)
    assert len(np.unique(log.run[first])) == 8
    assert 10.9 < t[first].max() < 11.1  # nothing moves for 7 s
    assert all(np.isin(a, b).all() and len(a) < len(b) for a, b in pairwise([first, *more]))
    assert np.array_equal(more[-1], rows)


@pytest.mark.study
@pytest.mark.parametrize("slips", [False, True])
def test_a_beginning_of_a_long_log_is_fitted_where_it_does(slips: bool, monkeypatch: Any) -> None:
    monkeypatch.setattr(motion, "_BEGIN_S", 0.3)
    monkeypatch.setattr(motion, "_BEGIN_ROWS", 20)
    log = recorded(robot(damping=0.006), {"one": 1}, np.arange(120) * 0.01, NOISE, 1e-3)
    tip = log.tip_position + np.where(slips & (log.t > 0.9), 2e-3, 0.0)[:, None]
    known = DAMPED | {name: size for name, size in ALL.items() if "al_stiffness" in name}
    found = identify(replace(log, tip_position=tip), robot(fit=known), dynamics=True, max_effects=0)
    damping = found.base_parameters["segment.1.damping_time"]
    assert slips != any("beginnings" in note for note in found.notes)
    assert slips or abs(damping.value - 0.006) < 4.0 * damping.stderr
    assert slips or found.test.after < 1.1 * NOISE * np.sqrt(3.0)
