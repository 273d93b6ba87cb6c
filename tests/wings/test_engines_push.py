"""A rod pushes cubes in PyBullet and in MuJoCo, and both engines keep momentum, friction and energy."""

import numpy as np
import pytest
from bullets import soft_robot
from engines import BEYOND, ENGINES, MASS, RADIUS, SIZE, SPEED, Cube
from numpy.testing import assert_allclose

from fastrod import load_robot
from fastrod.solver.touching import TouchingRods

DISPLACEMENT = {"axial": np.array([1.0, 0.0, 0.0]), "side": np.array([0.0, 1.0, 0.0])}
END = {"axial": [BEYOND, 0.0, 0.0], "side": [0.18, RADIUS + 0.002 + SIZE / 2, 0.0]}
pytestmark = pytest.mark.parametrize("stage", list(ENGINES.values()), ids=list(ENGINES))


def push(stage, dt, direction, gravity, duration=0.8, mass=MASS, place=None):
    """Carry a rod along x against a cube: the cube's speed along it, its momentum, the host's impulse."""
    cubes, floor = [Cube(SIZE, mass, place or END[direction], 1.0)], -SIZE / 2 if gravity else None
    s = stage(soft_robot(), dt=dt, gravity=gravity, cubes=cubes, floor=floor)
    s.rod.settle()
    direction, forces, speeds, ok = DISPLACEMENT[direction], [], [], True
    for k in range(round(duration / dt)):
        s.move(SPEED * k * dt * direction, SPEED * direction)
        state = s.rod.step()
        forces.append(s.rod.wrench[:3])
        speeds.append(s.velocity()[:3] @ direction)
        ok = ok and bool(state.ok[0])
    return np.array(speeds), mass * s.velocity()[:3], dt * np.cumsum(forces, axis=0), ok


@pytest.mark.study
@pytest.mark.parametrize("direction", ["axial", "side"])
@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_momentum_of_a_free_cube_is_the_impulse_on_the_host(stage, dt, direction):
    speeds, momentum, impulse, ok = push(stage, dt, direction, gravity=0.0, duration=0.5)
    assert ok
    assert momentum @ DISPLACEMENT[direction] > 0.9 * MASS * SPEED
    assert_allclose(momentum, -impulse[-1], atol=1e-9)
    # an elastic rod without any loss would leave it at twice the speed; along its axis this one is stiff, and
    # only stops it
    assert speeds.max() < (1.01 if direction == "axial" else 1.5) * SPEED


@pytest.mark.study
def test_speed_of_a_free_cube_hardly_depends_on_the_step(stage):
    fine, *coarse = (push(stage, dt, "side", gravity=0.0, duration=0.4)[0][-1] for dt in (0.001, 0.005, 0.01))
    assert fine > 1.2 * SPEED
    assert_allclose(coarse, fine, rtol=0.012)  # where the cube took steps of implicit Euler, 2.1 %


@pytest.mark.study
@pytest.mark.parametrize("direction", ["axial", "side"])
def test_steps_in_parts_give_a_free_cube_the_speed_of_whole_ones(stage, direction, monkeypatch):
    # the cube moves on from part to part, and feels the mean of their forces; parts are the finer steps
    def speed(longest):
        def one(rods, rows, acting, ports, how, *given):
            if how.dt > longest and not rods._resting:
                return np.zeros(rods.n_robots, bool)
            return solved(rods, rows, acting, ports, how, *given)

        monkeypatch.setattr(TouchingRods, "_one", one)
        speeds, _, _, ok = push(stage, 0.01, direction, gravity=0.0, duration=0.25)
        assert ok
        return speeds[-1]

    solved = TouchingRods._one
    assert speed(6e-3) == pytest.approx(speed(1.0), rel=0.005)
    assert speed(2e-3) == pytest.approx(speed(1.0), rel=0.01)


@pytest.mark.study
@pytest.mark.parametrize("direction", ["axial", "side"])
def test_cube_on_the_floor_follows_the_tip(stage, direction):
    # from the side the rod bends by some 3 cm until 20 g slide; 100 g would bend it as far as it is long
    mass = MASS if direction == "axial" else 0.02
    speeds, _, impulse, ok = push(stage, 0.005, direction, gravity=9.81, duration=1.2, mass=mass)
    assert ok
    assert speeds[len(speeds) // 2 :].mean() == pytest.approx(SPEED, rel=0.02)
    assert speeds.max() < (stage.hop if direction == "axial" else stage.hop_aside) * SPEED  # no launch
    assert -impulse[-1] @ DISPLACEMENT[direction] > 0.0


@pytest.mark.study
def test_push_against_friction_is_the_friction(stage):
    # once it slides the host holds mu N against the way; N is the weight, and what the tip's own friction
    # presses the cube down with
    dt, window = 0.005, 0.6
    _, _, impulse, _ = push(stage, dt, "axial", gravity=9.81, duration=1.2)
    held, _, lifted = (impulse[-1] - impulse[-1 - round(window / dt)]) / window
    assert -held == pytest.approx(0.5 * (MASS * 9.81 + lifted), rel=0.01)


@pytest.mark.study
@pytest.mark.parametrize("mass", [0.01, 1.0])
def test_light_and_heavy_cubes_are_not_launched(stage, mass):
    speeds, momentum, impulse, ok = push(stage, 0.01, "axial", gravity=0.0, duration=0.4, mass=mass)
    assert ok
    assert speeds[-1] == pytest.approx(SPEED, rel=0.05)
    assert_allclose(momentum, -impulse[-1], atol=1e-9)


@pytest.mark.study
def test_cube_that_is_hit_off_its_middle_rotates_and_is_not_launched(stage):
    place = [BEYOND, 0.03, 0.02]
    speeds, momentum, impulse, ok = push(stage, 0.005, "axial", gravity=0.0, duration=0.4, place=place)
    assert ok
    assert speeds.max() < 1.5 * SPEED
    assert_allclose(momentum, -impulse[-1], atol=1e-9)


FALLS = [  # at the last three a step is taken in parts
    ((0.135, 0.0, 0.1), 0.02),
    ((0.15, 0.0, 0.1), 0.02),
    ((0.162, 0.0, 0.1), 0.02),
    ((0.1, 0.0, 0.1), 0.1),
    ((0.18, 0.0, 0.1), 0.1),
    ((0.0523, -0.0055, 0.1438), 0.1),
    ((0.0517, 0.0022, 0.1128), 0.1),
    ((0.0566, 0.0051, 0.0632), 0.3),
]


@pytest.mark.study
@pytest.mark.parametrize(("place", "mass"), FALLS)
def test_cube_that_falls_on_a_long_soft_rod_gains_no_energy(stage, place, mass):
    cube, height = Cube(0.06, mass, list(place)), place[2]
    s = stage(load_robot("five_segment_reacher"), dt=0.01, gravity=9.81, cubes=[cube])
    inertia, energy = mass * 0.06**2 / 6.0, []
    for _ in range(40):
        assert s.rod.step().ok[0]
        linear, angular = np.split(s.velocity(), 2)
        moving = 0.5 * (mass * linear @ linear + inertia * angular @ angular)
        energy.append(mass * 9.81 * s.position()[2] + moving)
    assert max(energy) < mass * 9.81 * height * (1.0 + 1e-6)
    assert min(energy[-5:]) < 0.9 * max(energy)  # what it hit took some


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("dt", [0.002, 0.01])
def test_body_without_a_word_to_the_rod_gets_the_speed_of_the_capsule(stage, dt):
    beside = Cube(0.04, 0.1, [0.2, RADIUS + 0.001 + 0.02, 0.0])
    s = stage(soft_robot(), dt=dt, cubes=[beside], contact_bodies=False)
    s.rod.settle()
    speeds = []
    for k in range(round(0.3 / dt)):
        s.move([0.0, 0.1 * k * dt, 0.0], [0.0, 0.1, 0.0])
        s.rod.step()
        speeds.append(s.velocity()[1])
    assert speeds[-1] == pytest.approx(0.1, rel=0.02)
    assert max(speeds) < 0.11
