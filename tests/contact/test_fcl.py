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
from fastrod.contact import ContactScene, mesh, sphere
from fastrod.errors import InputError
from fastrod.solver.state import State

SOLIDS: dict[str, Any] = {
    "ball": lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.03),
    "block": lambda: trimesh.creation.box((0.04, 0.05, 0.03)),
    "ring": lambda: trimesh.creation.torus(0.03, 0.008),
}


def pushed(solid: str, collision: Any, n: int = 1, steps: int = 14) -> list[State]:
    """A prototype that bends while a mesh with friction, and a ball without, are pushed into it."""
    robot = fastrod.load_robot("prototype")
    obstacles = [
        mesh(SOLIDS[solid](), name=solid, friction=0.3),
        sphere(0.02, name="round", position=(-0.036, 0.0, 0.05)),
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


def test_the_choice_is_a_word() -> None:
    assert ContactScene().collision == "bvh"  # auto: the cheaper one
    with pytest.raises(InputError, match=r"^ContactScene.collision is 'flc'; .*fcl"):
        ContactScene(collision="flc")  # type: ignore[arg-type]
