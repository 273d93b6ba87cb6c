"""Bodies that taper, tendons driven by forces, and markers on the body in place of a tip."""

from __future__ import annotations

import math
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod.commands.cli import main
from fastrod.errors import FastrodError, LogError, RobotError
from fastrod.identification.excite import excitation
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model import taper
from fastrod.model.robot import Robot
from fastrod.model.robotfile import dumps, loads
from fastrod.types import Floats

BASE, END, LENGTH, MODULUS = 0.0154, 0.0064, 0.2, 1.0e5
PLACES, BESIDE = (0.05, 0.1, 0.15, 0.19), (0.012, 0.010, 0.008, 0.007)


def text(*, cone: bool = True, density: float = 1070.0, more: str = "") -> str:
    radius, offset = ([BASE, END], [0.0114, 0.0047]) if cone else (BASE, 0.0114)
    tendons = ",".join(
        f"{{offset = {offset}, angle = {k * math.pi / 2:.10g}, unilateral = true}}" for k in range(4)
    )
    return f"""
name = "arm"
[[segment]]
length = {LENGTH}
body_radius = {radius}
youngs_modulus = {MODULUS}
poisson = 0.5
density = {density}
mode = "tendon_tension"
tendons = [{tendons}]
[base]
position = [0, 0, 0]
quaternion = [0, 1, 0, 0]
[log]
points = {list(PLACES)}
point_offsets = {[[x, 0.0] for x in BESIDE]}
{more}
"""


def arm(**given: object) -> Robot:
    return loads(text(**given))  # type: ignore[arg-type]


def forces(n: int, seed: int = 0, most: float = 0.5) -> Floats:
    """Smooth forces (n, 4) of tendons that pull [N]."""
    rng, t = np.random.default_rng(seed), np.arange(n) * 0.1
    wave = sum(
        np.sin(2 * np.pi * rng.uniform(0.02, 0.1, 4) * t[:, None] + rng.uniform(0, 6, 4)) for _ in range(2)
    )
    return np.clip(0.5 * most * np.asarray(wave), 0.0, None)


def seen(robot: Robot, tension: Floats, noise: float = 0.0) -> RunLog:
    """A log of markers alone."""
    sim = fastrod.Simulator(replace(robot, effects=()), n_robots=len(tension))
    sim.settle(tension=tension)
    points = sim.measure().points + noise * np.random.default_rng(3).standard_normal((len(tension), 4, 3))
    n = len(tension)
    return RunLog(
        name="arm",
        t=0.1 * np.arange(n),
        run=np.full(n, ""),
        dl=np.zeros((n, 4)),
        tension=tension,
        tip_position=points[:, -1],
        points=points[:, :-1],
        without_tip=True,
    )


# -- the body


def test_cone_bends_under_tip_force_as_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cantilever of a circular cone: 4 F l^3 / (3 pi E a^3 b) (Euler-Bernoulli, M = F x, EI(x) integrated);
    the error falls with the square of the number of pieces."""
    force, errors = 1e-4, []
    expected = 4.0 * force * LENGTH**3 / (3.0 * math.pi * MODULUS * BASE**3 * END)
    for n in (5, 10):
        monkeypatch.setattr(taper, "PIECES", n)
        robot = replace(arm(density=0.0), base_quaternion=(1.0, 0.0, 0.0, 0.0))
        state = fastrod.Simulator(robot).settle(tension=np.zeros(4), tip_force=(force, 0.0, 0.0))
        shear = force * sum(s.length / s.shear_stiffness for s in robot.segments)
        errors.append(abs(float(state.tip_position[0, 0]) / (expected + shear) - 1.0))
    assert errors[1] < 0.015
    assert_allclose(math.log2(errors[0] / errors[1]), 2.0, atol=0.2)


def test_tendon_on_cone_bends_as_integral_of_its_moment() -> None:
    """theta = T integral d(s) / EI(s) ds of a tendon whose distance d falls with the radius r."""
    pull = 0.01
    robot = replace(arm(density=0.0), base_quaternion=(1.0, 0.0, 0.0, 0.0))
    state = fastrod.Simulator(robot).settle(tension=(pull, 0.0, 0.0, 0.0))
    s = np.linspace(0.0, 1.0, 4001)
    radius, offset = BASE + (END - BASE) * s, 0.0114 + (0.0047 - 0.0114) * s
    theta = pull * LENGTH * np.trapezoid(offset / (MODULUS * math.pi / 4.0 * radius**4), s)
    found = math.atan2(state.tip_rotation[0, 0, 2], state.tip_rotation[0, 2, 2])
    assert_allclose(found, theta, rtol=5e-3)


def test_mass_of_cone() -> None:
    volume = math.pi * LENGTH / 3.0 * (BASE**2 + BASE * END + END**2)
    assert_allclose(sum(s.length * s.line_density for s in arm().segments), 1070.0 * volume, rtol=1e-12)


def test_even_body_of_material_is_one_segment() -> None:
    (segment,) = arm(cone=False).segments
    assert_allclose(segment.bending_stiffness, MODULUS * math.pi / 4.0 * BASE**4)
    assert loads(dumps(arm())) == arm()


def test_pieces_keep_place_of_lumps_and_angles() -> None:
    lumped = text().replace("density = 1070.0", "density = 1070.0\nlumps = [{at = 0.16, mass = 0.01}]")
    pieces = loads(lumped).segments
    at = np.cumsum([0.0, *(s.length for s in pieces)])
    ((k, lump),) = [(k, lump) for k, s in enumerate(pieces) for lump in s.lumps]
    assert_allclose(at[k] + lump.at, 0.16)


ODD = [
    0,
    0.0,
    -1,
    1e-300,
    1e300,
    10**18,
    math.nan,
    math.inf,
    "",
    True,
    [],
    [0.0],
    [1, "a"],
    [0.01, 0.005],
    {},
    0.01,
]


@pytest.mark.parametrize("seed", range(4))
def test_odd_body_is_a_robot_or_a_sentence(seed: int) -> None:
    """A hundred files each in which one to three values are of another kind or size."""
    rng = np.random.default_rng(seed)
    names = ["length", "body_radius", "youngs_modulus", "poisson", "density", "mode", "tendons", "extension"]
    for _ in range(100):
        data = tomllib.loads(text())
        (segment,) = data["segment"]
        for _ in range(rng.integers(1, 4)):
            odd = ODD[rng.integers(len(ODD))]
            place = rng.integers(4)
            if place == 0 and segment["tendons"] and isinstance(segment["tendons"], list):
                if isinstance(segment["tendons"][0], dict):
                    segment["tendons"][0]["offset" if rng.integers(2) else "angle"] = odd
            elif place == 1:
                segment["lumps"] = [{"at": odd, "mass": 0.01}]
            elif place == 2:
                data["log"]["point_offsets"] = odd
            else:
                segment[names[rng.integers(len(names))]] = odd
        said, robot = "", None
        try:
            robot = loads(tomli_w.dumps(data))
        except FastrodError as error:
            said = str(error)
        assert (robot is None) == (said.count("\n") == 0 and said != "")
        assert robot is None or loads(dumps(robot)) == robot


# -- the log


def test_log_of_forces_and_markers_comes_back(tmp_path: Path) -> None:
    robot = arm()
    log = seen(robot, forces(30))
    write_log(log, tmp_path / "log.csv")
    back = read_log(tmp_path / "log.csv", robot)
    assert back.without_tip
    assert_array_equal(back.tension, log.tension)
    assert_array_equal(back.tip_position, log.tip_position)
    assert_array_equal(back.points, log.points)
    assert "tip_x" not in (tmp_path / "log.csv").read_text()


def test_replay_of_forces_and_markers(tmp_path: Path) -> None:
    robot = arm()
    log = seen(robot, forces(60))
    made = fastrod.replay(log, robot)
    assert made.rms < 1e-8
    assert_allclose(made.points, log.points, atol=1e-8)
    assert not made.questions


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda log: replace(log, tension=-log.tension), "does not push"),
        (lambda log: replace(log, points=1e3 * log.points, tip_position=1e3 * log.tip_position), "in mm"),
    ],
)
def test_log_that_cannot_be_is_refused(change: object, sentence: str, tmp_path: Path) -> None:
    robot = arm()
    write_log(change(seen(robot, forces(30))), tmp_path / "log.csv")  # type: ignore[operator]
    with pytest.raises(LogError, match=sentence):
        read_log(tmp_path / "log.csv", robot)


def test_forces_for_robot_driven_by_lengths_are_refused(tmp_path: Path) -> None:
    write_log(seen(arm(), forces(30)), tmp_path / "log.csv")
    lengths = loads(text().replace('mode = "tendon_tension"', ""))
    with pytest.raises(LogError, match="tendon_tension"):
        read_log(tmp_path / "log.csv", lengths)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("youngs_modulus", "#", "lacks youngs_modulus"),
        ("offset = [0.0114, 0.0047]", "offset = [0.0114, 0.0047, 0.001]", "on a cone"),
        ("[0.012, 0.0], ", "", "point_offsets"),
        (f"body_radius = [{BASE}, {END}]", "body_radius = [0.01, 0.01, 0.01]", "base and end"),
    ],
)
def test_body_that_cannot_be_is_refused(old: str, new: str, sentence: str) -> None:
    assert old in text()
    with pytest.raises(RobotError, match=sentence):
        loads(text().replace(old, new))


# -- effects and the loop


def test_latency_acts_on_forces() -> None:
    """A delay of three steps is the command of three steps before."""
    robot, n = arm(cone=False), 40
    late = replace(robot, effects=({"name": "latency", "delay": 0.3},))
    tension = forces(n)
    plain, delayed = (fastrod.Simulator(each, dt=0.1) for each in (robot, late))
    a = np.array([plain.step(tension=row).tip_position[0] for row in tension])
    b = np.array([delayed.step(tension=row).tip_position[0] for row in tension])
    assert_allclose(b[10:], a[7:-3], atol=1e-4 * LENGTH)
    assert np.abs(b[10:] - a[10:]).max() > 5e-3 * LENGTH


def test_gain_of_drives_multiplies_forces() -> None:
    robot = replace(arm(cone=False, density=0.0), base_quaternion=(1.0, 0.0, 0.0, 0.0))
    strong = replace(robot, effects=({"name": "drum_gain", "gain": 0.1},))
    pull = np.array([0.05, 0.0, 0.01, 0.02])
    bent = fastrod.Simulator(strong).settle(tension=pull).tip_position
    assert_allclose(bent, fastrod.Simulator(robot).settle(tension=1.1 * pull).tip_position, atol=1e-9)


def test_excitation_of_forces_pulls_and_bends_as_far_as_asked() -> None:
    log = excitation(arm(density=0.0), bend=0.5, payload=0.0, turn=False).log
    assert log.tension is not None
    assert log.tension.min() == 0.0
    assert not log.dl.any()
    few = log.tension[:: len(log) // 60]
    state = fastrod.Simulator(arm(density=0.0), n_robots=len(few)).settle(tension=few)
    cosine = -state.tip_rotation[:, 2, 2]  # it hangs
    assert 0.4 < np.arccos(np.clip(cosine, -1.0, 1.0)).max() < 0.65


@pytest.mark.study(beyond=0)
def test_tensions_exchanged_are_refused() -> None:
    robot = arm()
    log = seen(robot, forces(80))
    assert log.tension is not None
    found = fastrod.check(replace(log, tension=log.tension[:, [1, 0, 2, 3]]), robot)
    assert "dl_1 and dl_2 exchanged" not in found.refusal
    assert "tension_1 and tension_2 exchanged" in found.refusal


@pytest.mark.study(beyond=0)
def test_force_in_other_unit_is_questioned() -> None:
    robot = arm()
    log = seen(robot, forces(80))
    assert log.tension is not None
    found = fastrod.check(replace(log, tension=log.tension / 9.80665), robot)
    assert "kgf to N" in " ".join([found.refusal, *found.questions])


@pytest.mark.study(beyond=0)
def test_robot_that_hangs_and_is_said_to_stand_is_refused() -> None:
    log = seen(arm(), forces(80))
    found = fastrod.check(log, replace(arm(), base_quaternion=(1.0, 0.0, 0.0, 0.0)))
    assert "[0, 1, 0, 0] of one that hangs" in found.refusal


@pytest.mark.study(beyond=0)
def test_modulus_density_and_taper_are_fitted() -> None:
    """A body that is 1.3 times as stiff, 0.9 times as heavy and more tapered than its file says."""
    from fastrod.identification.log.unknowns import _of_material

    asked = '[fit]\n"material.youngs_modulus" = {sd = 0.5}\n"material.density" = {sd = 0.2}\n'
    robot = arm(more=asked + '"material.taper" = {sd = 0.1}\n')
    true = robot
    for kind, value in (("youngs_modulus", 1.3), ("density", 0.9), ("taper", 0.05)):
        true = replace(true, segments=_of_material(true, kind, value))
    found = fastrod.identify(seen(true, forces(200), noise=2e-4), robot)
    assert found.verdict == "none"
    values = {name.removeprefix("material."): e.value for name, e in found.base_parameters.items()}
    assert_allclose(values["youngs_modulus"], 1.3, rtol=0.02)
    assert_allclose(values["density"], 0.9, rtol=0.03)
    assert_allclose(values["taper"], 0.05, atol=0.01)


@pytest.mark.study(beyond=0)
def test_latency_of_forces_is_named() -> None:
    robot = arm(cone=False)
    late = replace(robot, effects=({"name": "latency", "delay": 0.25},))
    tension = forces(300, most=0.8)
    sim = fastrod.Simulator(late, dt=0.1)
    points = []
    for row in tension:
        sim.step(tension=row)
        points.append(sim.measure().points[0])
    noisy = np.array(points) + 2e-4 * np.random.default_rng(1).standard_normal((300, 4, 3))
    log = replace(seen(robot, tension), tip_position=noisy[:, -1], points=noisy[:, :-1])
    found = fastrod.identify(log, robot)
    assert [each.name for each in found.effects] == ["latency"]
    assert_allclose(found.effects[0].parameters["delay"].value, 0.25, atol=0.02)


# -- the commands


def test_own_file_in_grams_to_run_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`new`, `check` and `import` of a file with forces in gf and markers in mm."""
    robot = arm()
    log = seen(robot, forces(60))
    assert log.tension is not None
    assert log.points is not None
    places = np.concatenate([log.points, log.tip_position[:, None]], axis=1).reshape(len(log), -1)
    names = ["t_ms", *(f"cell{k}_gf" for k in range(1, 5))]
    names += [f"m{k}_{axis}_mm" for k in range(1, 5) for axis in "xyz"]
    table = np.column_stack([1e3 * log.t, log.tension / 9.80665e-3, 1e3 * places])
    raw, made = tmp_path / "raw.csv", tmp_path / "arm.toml"
    np.savetxt(raw, table, delimiter=",", header=",".join(names), comments="", fmt="%.9g")
    options = (
        "--length 200 --tendons 4 --offset 11.4 --drive force --radius 15.4,6.4 --markers 50,100,150,190 "
        "--marker-offset 12,10,8,7 --base hangs"
    )
    command = ["new", str(made), "--log", str(raw), *options.split()]
    assert main(command) == 0
    assert main(["check", str(raw), "--robot", str(made)]) == 0
    assert " N" in capsys.readouterr().out
    assert main(["import", str(raw), "--robot", str(made), "--out", str(tmp_path / "run.csv")]) == 0
    back = read_log(tmp_path / "run.csv", made)
    assert_allclose(back.tension, log.tension, atol=1e-8)
    assert_allclose(back.tip_position, log.tip_position, atol=1e-9)
    assert main(["drive", "track", "--emulate", "--robot", str(made)]) == 2
    assert "driven by forces" in capsys.readouterr().err


def test_unit_of_length_for_forces_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    raw = tmp_path / "raw.csv"
    raw.write_text("t,f1,f2,f3,x,y,z\n0,0,0,0,0,0,0.1\n1,0,0,0,0,0,0.1\n")
    command = f"new {tmp_path}/a.toml --log {raw} --drive force --motor-unit mm"
    assert main(command.split()) == 2
    assert "with --drive force it is one of N, mN, kgf, gf" in capsys.readouterr().err
