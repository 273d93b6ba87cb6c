"""The simulator as its users meet it: batches, threads, memory, neighbours, errors."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba import float64
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod

import fastrod
from fastrod import Observer, Simulator, load_robot
from fastrod.errors import InputError
from fastrod.kernels.rod.columns import step_column
from fastrod.model.robotfile import dumps, loads
from fastrod.solver.boundary import BoundarySolver


def random_lengths(n: int, seed: int, reach: float = 1.0) -> np.ndarray:
    robot = load_robot("prototype")
    angle = np.random.default_rng(seed).uniform(-reach, reach, (n, 2))
    return np.stack([bend(robot, *a) for a in angle])


THREADS = """
import sys
import numpy as np
from dataclasses import replace
from fastrod import Simulator, load_robot
robot = load_robot("prototype")
robot = replace(robot, segments=tuple(replace(s, line_density=0.1) for s in robot.segments))
lengths, how = np.load(sys.argv[1]), {"dynamics": sys.argv[3] == "in motion", "points_per_segment": 6}
for name, threads in (("one", 1), ("two", 2)):
    sim = Simulator(robot, 200, 1e-3, threads=threads, **how)
    settled, stepped = sim.settle(lengths).position, sim.step(1.001 * lengths)
    moved = stepped.velocity if sim.dynamics else stepped.curvature
    np.savez(sys.argv[2] + name, settled=settled, moved=moved)
"""


@pytest.mark.study
@pytest.mark.parametrize("how", ["observer", "in motion"])
def test_threads_change_no_bit(tmp_path: Path, how: str) -> None:
    """In a process of its own, which has two threads wherever this one has one."""
    np.save(tmp_path / "lengths.npy", random_lengths(200, 3))
    words = [sys.executable, "-c", THREADS, str(tmp_path / "lengths.npy"), f"{tmp_path}/", how]
    subprocess.run(words, check=True, env={**os.environ, "NUMBA_NUM_THREADS": "2"})
    one, two = (np.load(tmp_path / f"{name}.npz") for name in ("one", "two"))
    assert np.abs(one["moved"]).max() > 0.0
    for key in ("settled", "moved"):
        assert_array_equal(one[key], two[key])


def test_hot_loops_are_simd_code() -> None:
    rod_sim = Simulator(rod(), points_per_segment=3)
    rod_sim.step(rod().rest_tendon_length)
    if not step_column.signatures:  # loaded from the cache: compile this one for its assembly
        step_column.compile((float64[::1],) * 5)
    assembly = step_column.inspect_asm(step_column.signatures[0])
    assert assembly.count("zmm") + assembly.count("ymm") > 200


def test_a_load_that_no_number_of_steps_would_bring_on_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps are in proportion to one over the load: 10 kN on 2 N mm^2 would take thousands."""
    sim, ran = Simulator(rod(), n_robots=2, points_per_segment=6), 0
    run = BoundarySolver.run

    def counted(*args: Any, **keywords: Any) -> None:
        nonlocal ran
        ran += 1
        run(*args, **keywords)

    monkeypatch.setattr(BoundarySolver, "run", counted)
    state = sim.settle(rod().rest_tendon_length, tip_force=[[0.0, 0.0, 0.0], [1e4, 0.0, 0.0]])
    assert ran < 100
    assert state.ok.tolist() == [True, False]
    assert "settle did not bring" in state.problems[1]
    assert state.residual[1] > 1e-9
    assert np.isfinite(state.position[0]).all()
    assert np.isnan(state.position[1]).all()  # it never had a shape that was solved


def test_one_bad_robot_leaves_its_neighbours_alone() -> None:
    lengths = random_lengths(40, 5)
    clean = Simulator(load_robot("prototype"), n_robots=40).settle(lengths)
    broken = lengths.copy()
    broken[7, 2] = np.nan
    broken[11] = -0.07
    sim = Simulator(load_robot("prototype"), n_robots=40)
    state = sim.settle(broken)
    good = np.setdiff1d(np.arange(40), [7, 11])
    assert_array_equal(np.flatnonzero(~state.ok), [7, 11])
    assert set(state.problems) == {7, 11}
    assert "finite" in state.problems[7]
    assert "impossible" in state.problems[11]
    assert np.isnan(state.position[[7, 11]]).all()
    assert_array_equal(state.position[good], clean.position[good])
    repaired = sim.settle(lengths)
    assert repaired.ok.all()
    assert_allclose(repaired.tip_position, clean.tip_position, atol=1e-8)


def test_a_diverged_robot_starts_anew_and_nothing_continues_on_nan() -> None:
    sim = Simulator(load_robot("prototype"), n_robots=2)
    rest = load_robot("prototype").rest_tendon_length
    sim.settle(rest)
    wild = np.array([[0.0, 0.0, 0.0], [0.0, 1e6, 0.0]])
    for _ in range(5):
        state = sim.step(rest, tip_force=wild)
    assert state.ok[0]
    assert not state.ok[1]
    assert "diverged" in state.problems[1]
    for _ in range(6):
        state = sim.step(rest, tip_force=0.0 * wild)
    assert state.ok.all()
    assert_allclose(state.tip_position[1], [0.0, 0.0, 0.07], atol=1e-9)


def test_settle_says_who_did_not_converge() -> None:
    sim = Simulator(load_robot("prototype"), n_robots=2)
    rest = load_robot("prototype").rest_tendon_length
    state = sim.settle(rest, tip_force=[[0.0, 0.1, 0.0], [0.0, 1e7, 0.0]])
    assert state.ok.tolist() == [True, False]
    assert state.passes[1] == -1


def test_steep_loads_arrive_by_continuation() -> None:
    force = np.array([[0.0, 20.0 * 0.0022 / 0.07**2, 0.0]])  # P l^2/EI = 20
    state = Simulator(rod("passive"), points_per_segment=40).settle(tip_force=force)
    assert state.ok.all()
    assert 0.0 < state.tip_position[0, 2] < 0.03
    assert 0.05 < state.tip_position[0, 1] < 0.07


def test_settled_means_that_the_state_handed_out_is_within_tolerance() -> None:
    """Hard moves, loose tolerance: a step that was tried and taken back must not be what the caller gets."""
    rng = np.random.default_rng(2)
    robot = load_robot("prototype")
    sim = Simulator(robot, n_robots=200, points_per_segment=8)
    for _ in range(6):
        state = sim.settle(
            random_lengths(200, int(rng.integers(1000)), 1.4),
            tip_force=rng.uniform(-1.5, 1.5, (200, 3)),
            tolerance=1e-4,
        )
        assert (state.residual[state.ok] <= 1e-4).all()
        assert state.ok.mean() > 0.95


def test_a_lost_robot_has_no_response_and_takes_none_from_others() -> None:
    lengths = random_lengths(3, 9)
    lengths[1] = np.nan
    sim = Simulator(load_robot("prototype"), n_robots=3)
    sim.settle(lengths)
    for response in (sim.jacobian(), sim.compliance()):
        assert np.isfinite(response[[0, 2]]).all()
        assert np.isnan(response[1]).all()


def test_a_buffer_that_its_owner_writes_into_is_a_new_input() -> None:
    rest = load_robot("prototype").rest_tendon_length
    one, two = (Simulator(load_robot("prototype")) for _ in range(2))
    force = np.zeros((1, 3))
    one.settle(rest, tip_force=force)
    two.settle(rest, tip_force=force)
    for k in range(1, 6):
        force[:] = [0.0, 0.01 * k, 0.0]
        expected = two.step(rest, tip_force=force.copy()).position
        assert_array_equal(one.step(rest, tip_force=force).position, expected)


def test_a_soft_observer_follows_slowly_whatever_the_time_step() -> None:
    robot = load_robot("prototype")
    lengths = bend(robot, 0.5, 0.0)
    for dt in (1e-3, 1e-1, 10.0):
        sim = Simulator(robot, dt=dt, solver=Observer(process_noise=1.0 / dt, measurement_noise=1e-4 * dt))
        residual = [sim.step(robot.rest_tendon_length).residual[0]]
        residual += [sim.step(lengths).residual[0] for _ in range(60)]
        assert np.isfinite(residual).all()
        assert residual[2] > 0.1 * residual[1]
        assert residual[-1] < 0.1 * residual[1]


def test_tip_outputs_keep_little_memory() -> None:
    robot = load_robot("five_segment_reacher")
    sim = Simulator(robot, n_robots=64, points_per_segment=4, outputs="tip")
    state = sim.settle(robot.rest_tendon_length)
    names = "residual ok position rotation tension base_wrench tip_position tip_rotation"
    kept = [*sim._rods.passes.memory, *(getattr(state, name) for name in names.split())]
    assert sum(a.nbytes for a in kept) / 64 <= 2000
    with pytest.raises(InputError, match="outputs='full'"):
        sim.shape([0.1])


@pytest.mark.parametrize("name", fastrod.robot_names())
def test_robot_files_survive_a_round_trip(name: str) -> None:
    robot = load_robot(name)
    assert loads(dumps(robot)) == robot


def test_moduli_stand_for_stiffness() -> None:
    moduli = "youngs_modulus = 3e5\nshear_modulus = 7e4\nsecond_moment = 7e-9\npolar_moment = 1.4e-8\n"
    text = f'name = "a"\n[[segment]]\nlength = 0.07\n{moduli}mode = "passive"'
    segment = loads(text).segments[0]
    assert segment.bending_stiffness == pytest.approx((2.1e-3, 2.1e-3))
    assert segment.torsional_stiffness == pytest.approx(9.8e-4)


def test_unknown_names_answer_with_the_near_ones() -> None:
    with pytest.raises(AttributeError, match="did you mean 'Simulator'"):
        fastrod.Simulater  # noqa: B018


@pytest.mark.study
def test_an_edit_in_a_kernel_is_never_stale(tmp_path: Path) -> None:
    """The cache folder is named after every kernel source: another source, another folder."""
    script = "from fastrod.kernels import jit; print(jit._cache_dir())"
    package = Path(fastrod.__file__).parent
    copy = tmp_path / "fastrod"
    copy.mkdir()
    for source in package.rglob("*.py"):
        target = copy / source.relative_to(package)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(source.read_bytes())
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "FASTROD_CACHE_DIR": str(tmp_path / "cache")}

    def folder() -> str:
        given = {"env": environment, "cwd": tmp_path}
        words = [sys.executable, "-c", script]
        return subprocess.run(words, capture_output=True, text=True, check=True, **given).stdout

    seen = [folder()]
    for edited in (copy / "kernels" / "vec.py", copy / "types.py"):
        edited.write_text(edited.read_text() + "\n# edited\n")
        seen.append(folder())
    assert len(set(seen)) == 3


@pytest.mark.parametrize("n_robots", [1, 2])
@pytest.mark.parametrize("force", [False, True])
def test_jacobian_that_comes_with_the_step_is_the_same(n_robots, force):
    robot = load_robot("prototype") if n_robots == 1 else load_robot("tdcr_a")
    plain, derived = (Simulator(robot, n_robots, points_per_segment=6) for _ in range(2))
    rng = np.random.default_rng(11)
    rest = robot.rest_tendon_length if robot.segments[0].mode == "tendon_length" else None
    for k in range(6):
        pull = 1e-3 * np.sin(0.3 * k + np.arange(robot.n_tendons))
        inputs = {"tendon_length": rest + pull} if rest is not None else {"tension": 2.0 + 1e3 * pull}
        inputs["base_pose"] = [0.01 * k, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
        if force:
            inputs["tip_force"] = 0.05 * rng.normal(size=(n_robots, 3))
        a, b = plain.step(**inputs), derived.step(**inputs, derive=True)
        # where derivatives are asked for, curvatures are iterated further: 1e-9 of the length
        np.testing.assert_allclose(a.position, b.position, atol=1e-9)
        np.testing.assert_allclose(a.tension, b.tension, atol=1e-6)
    for _ in range(3):  # to rest: the plain one is asked at the boundary after the pass
        plain.step(**inputs)
        derived.step(**inputs, derive=True)
    for turning in (False, True):
        a, b = (sim.jacobian(turning=turning) for sim in (plain, derived))
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-6)
    derived.settle(**inputs)
    np.testing.assert_allclose(plain.jacobian(), derived.jacobian(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("about_d1", "about_d2"), [(0.0, 0.0), (1.0, 0.0), (0.0, -2.0)])
def test_tendon_bend_is_how_much_shorter_the_inner_path_is(about_d1: float, about_d2: float) -> None:
    robot = rod()
    sim = Simulator(robot)
    with pytest.raises(InputError, match="tendon_bend needs a state"):
        sim.tendon_bend()
    state = sim.settle(bend(robot, about_d1, about_d2))  # an arc, along which it is the same everywhere
    assert_allclose(sim.tendon_bend(), 1.0 - state.path_length.min(1) / robot.length, atol=1e-6)
