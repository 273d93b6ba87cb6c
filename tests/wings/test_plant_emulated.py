"""The emulated robot against the simulator and closed forms, its effects against what the seal claims, and
the seal itself."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
import subprocess
import sys

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rods import rod

from fastrod import Simulator
from fastrod.errors import InputError, UnknownNameError
from fastrod.rotation import matrix_from_quaternion
from fastrod_device.emulator import plant, plant_rod
from fastrod_device.emulator.plant import Plant
from fastrod_device.emulator.plant_rod import EI, LENGTH, OFFSET, PlantRod
from fastrod_device.emulator.seal import KINDS, NAMES, Seal, seal
from fastrod_device.errors import DeviceError

DOWN = np.array([0.0, 0.0, -1.0])
STILL = np.zeros(3)
ABOUT_X = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)


def tendons(bend_x: float, bend_y: float) -> np.ndarray:
    """(4,) lengths that ask for these bends about x and y [rad]."""
    return OFFSET * np.array([-bend_y, bend_x, bend_y, -bend_x])


def bend_of(rotation: np.ndarray) -> float:
    """Bend of a planar shape, by its tip [rad]."""
    return math.acos(min(1.0, rotation[2, 2]))


def hidden(name: str) -> Seal:
    """One that holds an effect of this name, the first there is."""
    kind = name if name in NAMES else "outside"
    return next(s for s in (seal(k, kind) for k in range(50)) if name in s.open())


def drive(robot: Plant, times: list[float], bends: list[tuple[float, float]], rate: float = 100.0) -> None:
    """Straight from each bend about x and y [rad] to the next, from the plant's rest at time 0."""
    fine = np.append(np.arange(times[0], times[-1], 1.0 / rate), times[-1])
    x, y = (np.interp(fine, times, axis) for axis in np.array(bends).T)
    for t, a, b in zip(fine, x, y, strict=True):
        robot.advance(float(t), tendons(a, b))


# ---------------------------------------------------------------- the rod


def test_without_effect_it_is_the_simulator_at_rest() -> None:
    rng = np.random.default_rng(0)
    n = 60
    angle, size = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.0, 1.0, n)
    dl = np.array([tendons(s * math.cos(a), s * math.sin(a)) for a, s in zip(angle, size, strict=True)])
    force = rng.normal(size=(n, 3))
    force *= 9.81 * rng.uniform(0.0, 0.1, (n, 1)) / np.linalg.norm(force, axis=1, keepdims=True)
    robot = rod()
    state = Simulator(robot, n, dt=0.01).settle(robot.rest_tendon_length + dl, tip_force=force)
    assert state.ok.all()
    cold = [PlantRod().rest(a, f, DOWN) for a, f in zip(dl, force, strict=True)]
    # both are discretised far finer than the 0.02 mm that the camera could ever tell
    assert_allclose([r.position for r in cold], state.tip_position, rtol=0, atol=2e-6)
    assert_allclose([r.rotation for r in cold], state.tip_rotation, rtol=0, atol=1e-4)
    assert_allclose([r.tension for r in cold], state.tension, rtol=0, atol=2e-3)


def test_line_weight_is_the_simulators() -> None:
    robot = rod()
    for down in np.array([[0.0, 1.0, 0.0], [0.6, 0.0, -0.8]]):
        state = Simulator(robot, dt=0.01).settle(
            robot.rest_tendon_length + tendons(0.5, -0.6), line_force=5.0 * down
        )
        assert_allclose(
            PlantRod(weight=5.0).rest(tendons(0.5, -0.6), STILL, down).position,
            state.tip_position[0],
            rtol=0,
            atol=2e-6,
        )


def test_tensions_change_with_the_wires_by_their_slope() -> None:
    it = PlantRod(compliance=3e-4, settling=0.3, weight=3.0)
    dl = tendons(0.3, 0.5)
    force = np.array([0.2, 0.1, -0.5])
    h = 1e-6
    here = it.rest(dl, force, DOWN)
    for i, step in enumerate(h * np.eye(4)):
        ahead, behind = it.rest(dl + step, force, DOWN, here), it.rest(dl - step, force, DOWN, here)
        # the slope is that of the last pass but one, 3e-4 rad away at most
        assert_allclose(
            (ahead.tension - behind.tension) / (2.0 * h),
            here.slope[:, i],
            rtol=0,
            atol=1e-3 * np.abs(here.slope).max(),
        )


def test_a_wire_whose_strands_settle_gives_less_the_more_it_is_pulled() -> None:
    it = PlantRod(compliance=4e-4, settling=0.3, knee=1.5)
    dl = tendons(0.0, 0.9)
    rest = it.rest(dl, STILL, DOWN)
    pulled = rest.tension
    extension = 4e-4 * (0.7 * pulled + 0.3 * 1.5 * np.arcsinh(pulled / 1.5))
    path = LENGTH + OFFSET * bend_of(rest.rotation) * np.array([-1.0, 0.0, 1.0, 0.0])  # of an arc
    assert_allclose(path, LENGTH + dl + extension, rtol=0, atol=1e-8)


# ---------------------------------------------------------------- loads on the plant


@pytest.mark.parametrize(
    "quaternion", [(1.0, 0.0, 0.0, 0.0), ABOUT_X, (0.5, -0.5, 0.5, 0.5), (0.8, 0.0, 0.6, 0.0)]
)
def test_a_mass_pulls_down_in_the_world_however_the_base_stands(quaternion: tuple[float, ...]) -> None:
    robot = Plant(seal(0, "none"))
    robot.rotate(quaternion)
    free, _ = robot.tip()
    robot.hang(0.005)
    pulled, _ = robot.tip()
    world = matrix_from_quaternion(np.array(quaternion)) @ (pulled - free)
    aside = matrix_from_quaternion(np.array(quaternion))[:, :2]
    lever = np.linalg.norm(aside[2])  # the rod gives way only across itself
    assert world[2] == pytest.approx(-0.005 * 9.81 * LENGTH**3 / (12.0 * EI) * lever**2, rel=0.03, abs=2e-6)
    assert world[2] < (1e-12 if lever < 1e-9 else -1e-5)


def test_hidden_weight_turns_with_the_base_and_a_mass_adds_to_it() -> None:
    robot = Plant(seal(3, "gravity"))
    upright, _ = robot.tip()
    robot.rotate(ABOUT_X)  # y of the base is up
    aside, _ = robot.tip()
    weight = seal(3, "gravity").open()["gravity"]["weight"]
    assert_allclose(upright, [0.0, 0.0, LENGTH], rtol=0, atol=1e-9)
    assert aside[1] == pytest.approx(-weight * LENGTH**4 / (24.0 * EI), rel=0.15)  # its spread is not even
    robot.hang(0.05)
    assert robot.tip()[0][1] < aside[1] - 2e-3
    robot.hang(0.0)
    assert_allclose(robot.tip()[0], aside, rtol=0, atol=1e-9)


# ---------------------------------------------------------------- effects


def test_backlash_is_a_flat_spot_of_the_sealed_width() -> None:
    numbers = hidden("backlash").open()["backlash"]
    width = 2.0 * numbers["half_width"]
    robot = Plant(hidden("backlash"))
    drive(robot, [0.0, 1.0], [(0.0, 0.0), (0.0, 0.8)])
    at = bend_of(robot.tip()[1])
    passed = []
    for k, back in enumerate(np.linspace(0.0, 3.0 * width, 31)):
        robot.advance(1.0 + 0.01 * k, tendons(0.0, 0.8 - back / OFFSET))
        passed.append(OFFSET * (at - bend_of(robot.tip()[1])))
    back = np.linspace(0.0, 3.0 * width, 31)
    flat = np.array(passed)
    # corners take a fraction 1 / sharpness of the gap
    assert flat[back < 0.5 * width].max() < 0.02 * width
    assert back[-1] - flat[-1] == pytest.approx(width, rel=0.03)
    half_speed = np.interp(0.5, np.diff(flat) / np.diff(back), 0.5 * (back[1:] + back[:-1]))
    assert half_speed == pytest.approx(width, rel=0.1)


def test_friction_loses_the_sealed_bend_and_more_the_further_it_bends() -> None:
    numbers = hidden("friction").open()["friction"]
    robot = Plant(hidden("friction"))
    lost = {}
    drive(robot, [0.0, 1.0], [(0.0, 0.0), (0.3, 0.0)])
    lost["up", 0.3] = bend_of(robot.tip()[1])
    drive(robot, [1.0, 2.0, 3.0], [(0.3, 0.0), (1.0, 0.0), (1.6, 0.0)])
    robot.advance(3.01, tendons(1.0, 0.0))
    lost["down", 1.0] = bend_of(robot.tip()[1])
    drive(robot, [3.01, 4.0], [(1.0, 0.0), (0.3, 0.0)])
    lost["down", 0.3] = bend_of(robot.tip()[1])
    stretch = 1.0 + EI / LENGTH * plant_rod.COMPLIANCE / (2.0 * OFFSET**2)  # of the tendons themselves
    slid = 1.0 - math.exp(-0.6 / numbers["late"])
    for bend in (0.3, 1.0):
        claim = numbers["loss"] * math.exp(numbers["growth"] * bend)
        assert lost["down", bend] * stretch - bend == pytest.approx(claim, rel=0.03 + 2.0 * (1.0 - slid))
    assert 0.3 - lost["up", 0.3] * stretch > 0.6 * numbers["loss"]
    assert lost["down", 0.3] - lost["up", 0.3] > 1.5 * numbers["loss"]


@pytest.mark.parametrize("name", ["backlash", "friction", "ripple"])
def test_the_path_counts_and_not_its_pace(name: str) -> None:
    corners = [(0.0, 0.0), (0.7, 0.2), (-0.3, 0.5), (-0.25, 0.4), (0.1, -0.6)]
    slow, fast, rare = (Plant(hidden(name)) for _ in range(3))
    drive(slow, [0.0, 3.0, 6.0, 8.0, 11.0], corners)
    drive(fast, [0.0, 0.3, 0.6, 0.8, 1.1], corners, rate=730.0)
    for k, corner in enumerate(corners):
        rare.advance(0.2 * k, tendons(*corner))
    # steps of drive() do not end in the corners: they are cut by a step, up to 0.01 rad
    assert_allclose(fast.tip()[0], slow.tip()[0], rtol=0, atol=5e-6)
    assert_allclose(rare.tip()[0], slow.tip()[0], rtol=0, atol=5e-5 if name == "friction" else 5e-6)
    assert np.linalg.norm(slow.tip()[0] - still(corners[-1])) > 1e-4


def still(bend: tuple[float, float]) -> np.ndarray:
    """(3,) tip of the robot without effect [m]."""
    return PlantRod().rest(tendons(*bend), STILL, DOWN).position


def test_creep_comes_after_a_step_and_ends_at_the_command() -> None:
    numbers = hidden("creep").open()["creep"]
    whole = numbers["share"] + numbers["slow_share"]
    robot, finer = Plant(hidden("creep")), Plant(hidden("creep"))
    for it in (robot, finer):
        it.advance(0.0, tendons(0.0, 0.0))
        it.advance(0.01, tendons(0.0, 0.8))
    aim = bend_of(PlantRod().rest(tendons(0.0, 0.8), STILL, DOWN).rotation)
    left = [aim - bend_of(robot.tip()[1])]
    assert left[0] / aim == pytest.approx(whole, rel=0.03)  # of 10 ms nearly all is left
    for t in (1.0, 4.0, 16.0, 64.0, 1000.0):
        robot.advance(t, tendons(0.0, 0.8))
        left.append(aim - bend_of(robot.tip()[1]))
    assert np.all(np.diff(left) < 0.0)
    assert left[-1] == pytest.approx(0.0, abs=1e-6)
    # slower than the quick time alone and quicker than the slow one with its activation
    late = math.exp(-4.0 / numbers["slow_time_constant"])
    assert 0.3 * late * numbers["slow_share"] * aim < left[2] < whole * aim
    for t in np.arange(0.02, 4.0, 0.05):
        finer.advance(float(t), tendons(0.0, 0.8))
    finer.advance(4.0, tendons(0.0, 0.8))
    assert aim - bend_of(finer.tip()[1]) == pytest.approx(left[2], abs=1e-9)


def test_stretch_loses_the_sealed_share_of_a_small_bend_and_lets_a_load_turn_the_tip() -> None:
    lost = hidden("tendon_stretch").open()["tendon_stretch"]["gain_loss"]
    robot = Plant(hidden("tendon_stretch"))
    robot.advance(0.0, tendons(0.05, 0.0))
    # beside it the tendons' own 0.3 percent
    assert bend_of(robot.tip()[1]) == pytest.approx(0.05 * (1.0 - lost), rel=0.01)
    loaded, plain = Plant(hidden("tendon_stretch")), Plant(seal(0, "none"))
    for it in (loaded, plain):
        it.rotate(ABOUT_X)
        it.hang(0.05)
    assert bend_of(loaded.tip()[1]) > 5.0 * bend_of(plain.tip()[1])


def test_latency_is_the_past_of_the_motion_and_the_tip_itself_is_not_late() -> None:
    numbers = hidden("latency").open()["latency"]
    late, plain = Plant(hidden("latency")), Plant(seal(0, "none"))
    for k in range(201):
        t = 0.005 * k
        dl = tendons(0.8 * math.sin(2.0 * t), 0.5 * t)
        late.advance(t, dl)
        plain.advance(t, dl)
        if k >= 100 and k % 20 == 0:
            wandering = numbers["wander"] * math.sin(2.0 * math.pi * t / numbers["period"] + numbers["phase"])
            then = t - numbers["delay"] * (1.0 + wandering)
            past = plain.tip(then)
            now = plain.tip_seen(t)
            assert_allclose(late.tip_seen(t)[0], past[0], rtol=0, atol=1e-9)
            assert_allclose(late.tip_seen(t)[1], past[1], rtol=0, atol=1e-8)
            assert_allclose(late.tip()[0], now[0], rtol=0, atol=1e-9)
            assert np.linalg.norm(past[0] - now[0]) > 3e-4
    assert 0.03 < numbers["delay"] < 0.16
    late.advance(2.0, tendons(0.3, 0.5))
    late.advance(3.0, tendons(0.3, 0.5))
    assert_allclose(late.tip_seen()[0], late.tip()[0], rtol=0, atol=1e-9)


def test_a_bumped_camera_sees_another_tip_and_the_robot_stays() -> None:
    numbers = hidden("bump").open()["bump"]
    robot = Plant(hidden("bump"))
    robot.advance(5.0, tendons(0.2, 0.1))
    robot.advance(5.0 + numbers["at"] - 0.1, tendons(0.2, 0.1))
    before = robot.tip_seen()
    robot.advance(5.0 + numbers["at"] + 0.1, tendons(0.2, 0.1))
    after = robot.tip_seen()
    assert_allclose(before[0], robot.tip()[0], rtol=0, atol=1e-12)
    assert 5e-4 < np.linalg.norm(after[0] - before[0]) < 6e-3
    turned = np.array([numbers[f"about_{axis}"] for axis in "xyz"])
    assert np.trace(after[1] @ before[1].T) == pytest.approx(
        1.0 + 2.0 * math.cos(np.linalg.norm(turned)), abs=1e-12
    )
    assert_allclose(robot.tip()[0], before[0], rtol=0, atol=1e-12)


def test_ripple_comes_again_with_every_turn_of_the_drum() -> None:
    numbers = hidden("ripple").open()["ripple"]
    robot = Plant(hidden("ripple"))
    bend = np.linspace(0.0, 2.0, 81)
    error = []
    for k, b in enumerate(bend):
        robot.advance(0.01 * k, tendons(0.0, b))
        error.append(
            bend_of(robot.tip()[1]) - bend_of(PlantRod().rest(tendons(0.0, b), STILL, DOWN).rotation)
        )
    error = OFFSET * np.array(error)
    swing = numbers["amplitude"] + numbers["tooth_amplitude"]
    assert 0.3 * swing < np.ptp(error) < 2.1 * swing
    tooth = 2.0 * math.pi * numbers["drum_radius"] / numbers["teeth"] / OFFSET  # rad of bend
    assert np.count_nonzero(np.diff(np.sign(np.diff(error)))) >= int(2.0 / tooth)  # up and down in each


@pytest.mark.study
@pytest.mark.parametrize("kind", [*KINDS, "outside"])
@pytest.mark.parametrize("seed", range(3))
def test_every_effect_moves_the_tip_by_millimetres(kind: str, seed: int) -> None:
    robot, plain, apart = Plant(seal(seed, kind)), Plant(seal(0, "none")), []
    for it in (robot, plain):
        it.rotate(ABOUT_X)
    rng = np.random.default_rng(9)
    frequency, phase = rng.uniform(0.02, 0.2, (2, 3)), rng.uniform(0.0, 6.0, (2, 3))
    for k in range(3001):  # 120 s
        bend = 0.45 * np.sin(2.0 * np.pi * frequency * 0.04 * k + phase).sum(axis=1)
        for it in (robot, plain):
            it.advance(0.04 * k, tendons(*bend.tolist()))
        if k % 50 == 0:
            apart.append(robot.tip_seen()[0] - plain.tip_seen()[0])
    assert 0.5e-3 < np.sqrt(np.mean(np.sum(np.array(apart) ** 2, axis=1))) < 6e-3


# ---------------------------------------------------------------- the seal


def test_seeds_repeat_and_all_kinds_come_up() -> None:
    drawn = [seal(k).open() for k in range(60)]
    assert {name for one in drawn for name in one} == set(KINDS)
    assert all(len(one) == 1 for one in drawn)
    assert [seal(k).open() for k in range(60)] == drawn
    assert len({str(seal(k, "gravity").open()) for k in range(20)}) == 20
    assert len({str(seal().open()) for _ in range(5)}) == 5  # the system's entropy
    assert all(math.isfinite(v) for one in drawn for numbers in one.values() for v in numbers.values())


def test_names_are_kept_and_outside_is_in_no_library() -> None:
    assert all(set(seal(7, kind).open()) == {kind} for kind in KINDS)
    assert seal(7, "none").open() == {}
    assert {name for k in range(20) for name in seal(k, "outside").open()} == {"ripple", "bump"}


def test_a_seal_tells_nothing_until_it_is_opened() -> None:
    for kind in NAMES:
        closed = seal(4, kind)
        robot = Plant(closed)
        robot.advance(0.0, tendons(0.3, 0.3))
        robot.tip()
        assert repr(closed) == str(closed) == f"{closed}" == "sealed"
        assert repr(robot) == "Plant(sealed)"
        assert all(name.startswith("_") for name in vars(robot))
        assert not [
            word for name in vars(robot) for word in (*KINDS, "ripple", "bump") if word == name.strip("_")
        ]
        assert not hasattr(closed, "__dict__")
        assert "Rod(" not in repr(robot._rod)
        assert {name for name in dir(closed) if not name.startswith("_")} == {"open", "stiffness"}
    with pytest.raises(InputError, match="keep its seed"):
        pickle.dumps(closed)
    with pytest.raises(InputError, match="keep its seed"):
        copy.deepcopy(closed)


def test_the_plant_stands_alone() -> None:
    """The plant may import the simulator's errors and the names of array types."""
    for module in (plant, plant_rod, sys.modules[Seal.__module__]):
        lines = [
            line
            for line in inspect.getsource(module).splitlines()
            if "import" in line and "fastrod" in line and "device" not in line
        ]
        assert all("fastrod.errors" in line or "fastrod.types" in line for line in lines)
    code = (
        "from fastrod_device.emulator.plant import Plant; from fastrod_device.emulator.seal import seal; "
        "Plant(seal(3)).tip(); print('quiet')"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout == "quiet\n"
    assert said.stderr == ""


# ---------------------------------------------------------------- bad input


def test_wrong_names_and_seeds_say_so() -> None:
    with pytest.raises(
        UnknownNameError, match=r"no effect 'backlsh' can be sealed; did you mean 'backlash'\?"
    ):
        seal(1, "backlsh")
    for wrong in (-1, 1.5, True, "1"):
        with pytest.raises(InputError, match="it must be a whole number from 0"):
            seal(wrong)
    with pytest.raises(InputError, match="it needs a Seal"):
        Plant({"backlash": {}})


def test_a_robot_that_snaps_says_so() -> None:
    with pytest.raises(DeviceError, match="finds no rest"):
        PlantRod().rest(np.zeros(4), np.array([0.0, 300.0, 0.0]), DOWN)


def test_wrong_inputs_say_so() -> None:
    robot = Plant(seal(0, "friction"))
    robot.advance(1.0, tendons(0.2, 0.2))
    for call, words in (
        (lambda: robot.advance(1.1, [0.0] * 3), "it must be four lengths of tendon"),
        (lambda: robot.advance(1.1, [1.0, 0.0, -1.0, 0.0]), "Was it given in mm"),
        (lambda: robot.advance(math.nan, np.zeros(4)), "does not run back"),
        (lambda: robot.hang(50.0), "Was it given in g"),
        (lambda: robot.rotate((1.0, 1.0, 0.0, 0.0)), "it must be a unit quaternion"),
        (lambda: robot.tip(math.nan), "it must be finite"),
    ):
        with pytest.raises(InputError, match=words):
            call()
