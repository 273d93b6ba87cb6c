"""`Tip`: a body at a rod's tip weighs, swings and is held as the rod's statics have it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")

from fastrod.hosts import connect
from fastrod.hosts.link import to_xyzw
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod_envs.tip import UNLOADED, Tip
from fastrod_scenes.ur5.carried import soft_robot

STEP, WITHIN, ARM = 0.01, 5, 0.03  # s, steps of the world in one of the rod, m from the tip to what it holds


class Held:
    """A rod that stands out sideways with a ball at its tip, and maybe a cube fixed to that."""

    def __init__(self, ball, cube=0.0, gravity=9.81, effects=()):
        robot = replace(soft_robot("rod", 2, line_density=0.03), effects=effects)
        actions = SegmentActions(robot)
        self.inputs = {"base_pose": (0.0, 0.0, 0.5, 0.5**0.5, 0.0, 0.5**0.5, 0.0)}
        self.inputs |= actions.inputs(np.ravel([(0.0, 0.3 * offset, 0.0) for offset in actions.offset]))
        self.rod = Simulator(robot, dt=STEP * WITHIN, points_per_segment=10, threads=1)
        state = self.rod.settle(**self.inputs, **UNLOADED)
        self.world = connect(dt=STEP, gravity=(0.0, 0.0, -gravity))
        self.ball = self._body(ball)
        self.tip = Tip(self.rod, STEP, self.world, self.ball, np.eye(3))
        self.cube, rotation = self._body(max(cube, 1e-9)), state.tip_rotation[0]
        at = state.tip_position[0] + ARM * rotation[:, 2]
        self.world.resetBasePositionAndOrientation(
            self.cube, at.tolist(), to_xyzw(quaternion_from_matrix(rotation)).tolist()
        )
        if cube:
            fixed = [[0.0] * 3, [0.0, 0.0, ARM], [0.0] * 3]
            self.world.createConstraint(self.ball, -1, self.cube, -1, self.world.JOINT_FIXED, *fixed)

    def _body(self, mass):
        half = [0.01] * 3
        body = self.world.createMultiBody(
            mass, self.world.createCollisionShape(self.world.GEOM_BOX, halfExtents=half)
        )
        self.world.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
        self.world.setCollisionFilterGroupMask(body, -1, 0, 0)
        return body

    def run(self, n):
        """(n WITHIN, 3) places of the ball [m]."""
        places = []
        for _ in range(n):
            assert self.tip.solve(**self.inputs).ok[0]
            self.tip.follow(WITHIN)
            for _ in range(WITHIN):
                self.tip.pull()
                self.world.stepSimulation()
                places.append(self.world.getBasePositionAndOrientation(self.ball)[0])
        return np.array(places)


@pytest.mark.parametrize("cube", [0.005, 0.05, 0.1])
def test_a_cube_that_is_held_bends_the_rod_as_its_weight_does(cube):
    held = Held(0.05, cube)
    ball = held.run(160)[-1]
    weight = np.array([0.0, 0.0, -9.81 * cube])
    at = np.array(held.world.getBasePositionAndOrientation(held.cube)[0])
    load = {"tip_force": weight, "tip_moment": np.cross(at - ball, weight)}
    bent = held.rod.settle(**held.inputs, **load).tip_position[0]
    free = held.rod.settle(**held.inputs, **UNLOADED).tip_position[0]
    assert_allclose(ball - free, bent - free, atol=2e-3 * np.linalg.norm(bent - free))
    assert np.linalg.norm(bent - free) > 0.2 * cube


def test_a_ball_without_weight_swings_at_its_frequency_and_comes_to_rest_where_it_was():
    held = Held(0.2, gravity=0.0)
    start = np.array(held.world.getBasePositionAndOrientation(held.ball)[0])
    held.world.resetBaseVelocity(held.ball, [0.0, 0.05, 0.0])
    y = held.run(60)[:, 1] - start[1]
    inertia = np.diag([0.2] * 3 + [0.2 * 0.02**2 / 6.0] * 3)
    stiffness = np.linalg.inv(held.rod.compliance(moments=True)[0])
    rate = np.sqrt(np.linalg.eigvals(np.linalg.solve(inertia, stiffness)).real.min())
    crossings = np.flatnonzero(np.diff(np.sign(y[5:])))
    assert np.diff(crossings[:4]).mean() * STEP == pytest.approx(np.pi / rate, rel=0.1)
    assert np.abs(y[-20:]).max() < 0.05 * np.abs(y).max()


def test_effects_pass_with_the_time_of_the_rod():
    held = Held(0.05, gravity=0.0, effects=({"name": "latency", "delay": 2 * WITHIN * STEP},))
    before = held.run(1)[-1]
    held.inputs["tendon_length"] = held.inputs["tendon_length"] + 1e-3 * np.resize([0, 1, 0, -1], 8)
    moved = np.abs(held.run(3)[WITHIN - 1 :: WITHIN] - before).max(axis=1)
    assert moved[1] < 1e-5
    assert moved[2] > 1e-3
