"""`ContactScene(collision="fcl")`: FCL measures distances to meshes, and the loads are the same."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose

import fastrod
from fastrod.contact import ContactScene, mesh, plane, sphere
from fastrod.contact.direct import BroadPhase
from fastrod.contact.tree import pack
from fastrod.errors import InputError
from fastrod.rotation import matrix_from_quaternion
from fastrod.solver.state import State

SOLIDS: dict[str, Any] = {
    "ball": lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.03),
    "block": lambda: trimesh.creation.box((0.04, 0.05, 0.03)),
    "ring": lambda: trimesh.creation.torus(0.03, 0.008),
}


def pushed(solid: str, collision: Any, n: int = 1, steps: int = 14) -> list[State]:
    """A prototype that a mesh with friction bends over a ball near its tip: pressed between the two at one
    place it takes any force that locks, and there is no load to compare."""
    robot = fastrod.load_robot("prototype")
    obstacles = [
        mesh(SOLIDS[solid](), name=solid, friction=0.3),
        sphere(0.02, name="round", position=(-0.036, 0.0, 0.068)),
    ]
    scene = ContactScene(obstacles=obstacles, collision=collision)
    sim = fastrod.Simulator(robot, n, points_per_segment=10, contact=scene)
    assert solid in repr(sim)
    assert ("by fcl" in repr(sim)) == (collision == "fcl")
    pull, states = np.zeros((n, len(robot.rest_tendon_length))), []
    for k in range(steps):
        pull[:, 0] = 4e-5 * k * np.linspace(1.0, 0.5, n)
        turn = 0.02 * k
        pose = [0.047 - 0.0008 * k, 0.003, 0.05, np.cos(turn), 0.0, np.sin(turn), 0.0]
        states.append(sim.step(robot.rest_tendon_length - pull, obstacle_pose={solid: pose}))
    return states


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("solid", SOLIDS)
def test_loads_and_shapes_are_the_same(solid: str) -> None:
    most = 0.0
    for ours, fcl in zip(pushed(solid, "bvh"), pushed(solid, "fcl"), strict=True):
        assert (ours.ok == fcl.ok).all()
        assert ours.contacts is not None
        assert fcl.contacts is not None
        assert (ours.contacts.count == fcl.contacts.count).all()
        assert_allclose(fcl.base_wrench, ours.base_wrench, rtol=0.0, atol=1e-9)
        assert_allclose(fcl.position, ours.position, rtol=0.0, atol=1e-9)
        assert_allclose(fcl.contacts.force, ours.contacts.force, rtol=0.0, atol=1e-9)
        most = max(most, float(np.abs(ours.base_wrench).max()))
    assert most > 0.05


@pytest.mark.study
def test_it_measures_on_many_threads_and_after_a_copy() -> None:
    robot = fastrod.load_robot("prototype")
    obstacle = mesh(SOLIDS["ball"](), name="ball", position=(0.04, 0.0, 0.05))
    scene = ContactScene(obstacles=[obstacle], collision="fcl")
    sim = fastrod.Simulator(robot, 80, points_per_segment=10, contact=scene, threads=2)
    state = sim.settle(robot.rest_tendon_length)
    again = pickle.loads(pickle.dumps(sim._engine))
    assert again.surfaces.primitive[0, 2] != 0
    other = copy.deepcopy(sim)
    pull = robot.rest_tendon_length - 5e-4
    assert_allclose(other.step(pull).base_wrench, sim.step(pull).base_wrench, rtol=0.0, atol=0.0)
    assert state.ok.all()


def test_the_tree_names_the_rods_that_may_touch() -> None:
    """Boxes at random about obstacles that are turned at random: whoever overlaps is named, and many that are
    away are not."""
    rng = np.random.default_rng(0)
    obstacles = [mesh(SOLIDS["ring"](), name="ring"), sphere(0.02, name="ball")]
    surfaces = pack(obstacles)
    tree = BroadPhase(obstacles, surfaces.sphere)
    for _ in range(20):
        quaternion = rng.normal(size=(2, 4))
        quaternion /= np.linalg.norm(quaternion, axis=1, keepdims=True)
        poses = np.concatenate([rng.uniform(-0.1, 0.1, (2, 3)), quaternion], axis=1)
        corners = matrix_from_quaternion(quaternion[:1])[0] @ obstacles[0].vertices.T + poses[0, :3, None]
        low = rng.uniform(-0.2, 0.2, (40, 3))
        high = low + rng.uniform(0.01, 0.05, (40, 3))
        near = tree.near(low, high, poses[None])
        inside = ((low[:, None] < corners.T) & (high[:, None] > corners.T)).all(2).any(1)
        inside |= ((poses[1, :3] > low) & (poses[1, :3] < high)).all(1)
        assert (near | ~inside).all()
        assert 0 < near.sum() < 30
    wall = BroadPhase([plane(point=(0, 0, 0), normal=(0, 0, 1))], np.array([[0.0, 0.0, 0.0, np.inf]]))
    assert wall.near(low, high, poses[None, :1]).all()


def test_the_choice_is_a_word() -> None:
    assert ContactScene().collision == "bvh"  # auto: the cheaper one
    with pytest.raises(InputError, match=r"^ContactScene.collision is 'flc'; .*fcl"):
        ContactScene(collision="flc")  # type: ignore[arg-type]
