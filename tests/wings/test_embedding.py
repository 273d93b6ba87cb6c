"""The recipe of the page on embedding keeps to physics on an engine of its own."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bullets import soft_robot
from numpy.testing import assert_allclose

import fastrod.hosts
from fastrod.contact import ContactScene, plane
from fastrod.hosts import Rod
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector

PAGE = (Path(fastrod.hosts.__file__).parent / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, flags=re.S)
RECIPE = next(block for block in BLOCKS if "def embedded_step" in block)


class TinyEngine:
    """One rigid body on a spring: x y z w, forces at the centre of mass, torque and inertia in the body
    frame, semi-implicit Euler."""

    mass, inertia = 1.0, np.array([0.1, 0.2, 0.15])

    def __init__(self, spring=0.0, twist=0.0, damping=0.0, gravity=0.0) -> None:
        self.spring, self.twist, self.damping = spring, twist, damping
        self.gravity = np.array([0.0, 0.0, -gravity])
        self.position, self.orientation = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
        self.velocity, self.spin = np.zeros(3), np.zeros(3)
        self._force, self._torque = np.zeros(3), np.zeros(3)

    def apply(self, force, torque) -> None:
        self._force, self._torque = np.array(force), np.array(torque)

    def vector(self):
        """Rotation vector, world, for small turns."""
        return 2.0 * np.array(self.orientation[:3]) * np.sign(self.orientation[3])

    def acceleration(self):
        """(6,) world, of what acts on it now."""
        rotation = matrix_from_quaternion(np.roll(self.orientation, 1)[None])[0]
        held = self.spring * np.array(self.position) + self.damping * self.velocity
        force = self._force + self.mass * self.gravity - held
        inertia = rotation @ np.diag(self.inertia) @ rotation.T
        moment = rotation @ self._torque - self.twist * self.vector() - 0.2 * self.damping * self.spin
        gyration = np.cross(self.spin, inertia @ self.spin)
        return np.concatenate([force / self.mass, np.linalg.solve(inertia, moment - gyration)])

    def step(self, dt) -> None:
        gained = self.acceleration()
        self.velocity, self.spin = self.velocity + dt * gained[:3], self.spin + dt * gained[3:]
        self.position = (np.array(self.position) + dt * self.velocity).tolist()
        turned = product(quaternion_from_vector(dt * self.spin), np.roll(self.orientation, 1))
        self.orientation = np.roll(turned / np.linalg.norm(turned), -1).tolist()
        self._force, self._torque = np.zeros(3), np.zeros(3)


@pytest.fixture
def embedded_step() -> Any:
    found: dict[str, Any] = {}
    exec(compile(RECIPE, "README.md", "exec"), found)
    return found["embedded_step"]


@pytest.mark.study
@pytest.mark.parametrize("dt", [0.003, 0.025])
def test_rod_hangs_on_the_spring_with_its_weight_and_turns_it_with_its_moment(embedded_step, dt) -> None:
    # at rest: k z = -(m g + w), and the torsion spring holds the weight's moment about the centre of mass,
    # kappa phi = arm x w
    robot = soft_robot(line_density=0.5, damping_time=0.05)
    body = TinyEngine(spring=200.0, twist=40.0, damping=20.0, gravity=9.81)
    rod, offset = Rod(robot, dt=0.01, dynamics=True), np.array([0.1, 0.0, 0.05])
    for _ in range(round(2.0 / dt)):
        embedded_step(rod, body, offset, dt)
    weight = 0.5 * robot.length * 9.81
    assert body.position[2] == pytest.approx(-(9.81 + weight) / 200.0, rel=1e-6)
    # where the rod's mass is: the mean of its curve, by the trapezoid of its 21 nodes
    state = rod.state
    middle = np.trapezoid(state.position[0], state.arclength[0], axis=0) / robot.length - body.position
    expected = np.cross(middle, [0.0, 0.0, -weight]) / 40.0
    assert_allclose(2.0 * np.arcsin(0.5 * body.vector()), expected, rtol=2e-3, atol=1e-6)
    assert rod.time == pytest.approx(round(2.0 / dt) * dt)


def test_impulse_of_the_tip_force_is_the_bodys_momentum(embedded_step) -> None:
    # the rod has no mass: what pulls at its tip moves the body, at once and by all of it
    body, rod = TinyEngine(), Rod(soft_robot(), dt=0.01)
    force = np.array([0.02, 0.01, -0.03])
    for _ in range(100):
        embedded_step(rod, body, np.array([0.0, 0.02, 0.03]), 0.005, tip_force=force)
    assert_allclose(body.mass * body.velocity, 0.5 * force, rtol=1e-6)
    assert np.linalg.norm(body.spin) > 0.01  # and turns it


@pytest.mark.study
@pytest.mark.parametrize("dt", [0.001, 0.004])
def test_a_body_on_a_spring_gains_what_the_page_says(embedded_step, dt: float) -> None:
    # straight up and down, 1/2 m v^2 + 1/2 k z^2 + w z, from above rest; velocities stand half a step before
    robot = soft_robot(line_density=0.5)
    body, rod, energy = TinyEngine(spring=100.0), Rod(robot, dt=0.01, dynamics=True), []
    own = 0.5 * robot.length
    for _ in range(round(3.0 / dt)):
        embedded_step(rod, body, np.array([0.0, 0.0, 0.03]), dt)
        z, v = body.position[2] + own * 9.81 / 100.0, body.velocity[2]
        energy.append(0.5 * (body.mass + own) * v**2 + 50.0 * z**2)
    squared = 100.0 / (body.mass + own)
    period = round(2.0 * np.pi / np.sqrt(squared) / dt)
    first, last = np.mean(energy[:period]), np.mean(energy[-period:])
    rate = np.log(last / first) / (dt * (len(energy) - period))  # twice that of the amplitude
    assert rate == pytest.approx(0.5 * squared * dt * own / (body.mass + own), rel=0.02)


def test_tilted_body_feels_the_torque_in_its_own_frame(embedded_step) -> None:
    # one step from rest: I dw = R^T (M + arm x F) dt, in the body frame
    half = np.sqrt(0.5)
    body, offset = TinyEngine(), np.array([0.1, 0.0, 0.05])
    rod = Rod(soft_robot(line_density=0.5), dt=0.01, dynamics=True)
    body.orientation = [half, 0.0, 0.0, half]
    rotation = matrix_from_quaternion(np.array([[half, half, 0.0, 0.0]]))[0]
    embedded_step(rod, body, offset, 0.001)
    moment = rotation.T @ (rod.wrench[3:] + np.cross(rotation @ offset, rod.wrench[:3]))
    assert_allclose(rotation.T @ body.spin, 0.001 * moment / body.inertia, rtol=1e-9, atol=1e-15)
    assert np.abs(moment).max() > 0.05


@pytest.mark.parametrize(("fraction", "calm"), [(0.9, True), (1.1, False)])
def test_limit_of_the_time_step_is_where_the_page_has_it(fraction: float, calm: bool) -> None:
    # x' = x + dt v', v' = v - dt K / m (x + dt v): eigenvalues leave the unit circle where dt^2 K / m is 4/3
    robot, dt, rotation = soft_robot(), 0.01, (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    floor = plane(point=(0, 0, -0.005), normal=(0, 0, 1), name="floor", stiffness=4.0)
    rod = Rod(robot, dt=dt, contact=ContactScene(obstacles=[floor]))
    start = 0.006

    def press(z: float) -> float:
        rod.settle((0.0, 0.0, z, *rotation))
        return float(rod.wrench[2])

    stiffness = -(press(start + 1e-4) - press(start - 1e-4)) / 2e-4
    mass = stiffness * dt**2 / (4.0 / 3.0 * fraction)
    z, v, rest = start + 1e-6, 0.0, press(start)
    runs = []
    for _ in range(60):
        rod.advance((0.0, 0.0, z, *rotation), (0.0, 0.0, v, 0.0, 0.0, 0.0), dt)
        v += dt / mass * (rod.wrench[2] - rest)
        z += dt * v
        runs.append(abs(z - start))
    assert stiffness > 0.1
    assert (max(runs[-5:]) < 1e-7) == calm
