"""The package's contact without friction against the constrained minimum of energy."""

from __future__ import annotations

from typing import Any

import contact_cases
import numpy as np
import pytest
from numpy.testing import assert_allclose

import fastrod
from fastrod.contact import ContactScene, Obstacle, box, cylinder, mesh, plane, sphere

CASES = contact_cases.cases()


def to_axis(axis: list[float]) -> tuple[float, float, float, float]:
    """Quaternion that turns z to the axis."""
    a = np.asarray(axis) / np.linalg.norm(axis)
    q = np.array([1.0 + a[2], -a[1], a[0], 0.0])
    return tuple(map(float, q / np.linalg.norm(q)))


def obstacle_of(o: dict[str, Any]) -> Obstacle:
    if o["kind"] == "half_space":
        return plane(point=o["point"], normal=o["normal"])
    if o["kind"] == "sphere":
        return sphere(o["radius"], position=o["centre"])
    if o["kind"] == "cylinder":
        return cylinder(o["radius"], 1.0, position=o["point"], quaternion=to_axis(o["axis"]))
    if o["kind"] == "box":
        return box(tuple(2.0 * h for h in o["half"]), position=o["centre"])
    import trimesh

    # a hole with 400 sides of the same mean radius: 0.3 um in and out, and facets of 0.16 mm
    wide = o["radius"] / np.sqrt(np.cos(np.pi / 400))
    hole = trimesh.creation.annulus(wide, wide + 0.01, 0.3, sections=400)
    return mesh(hole, position=o["point"], quaternion=to_axis(o["axis"]))


@pytest.mark.study
@pytest.mark.parametrize("name", list(CASES))
def test_forces_and_shape(name: str) -> None:
    case = CASES[name]
    coarse, fine = (contact_cases.solve(case, elements=n) for n in (20, 40))
    assert fine.converged
    tip, force = (
        (4.0 * np.asarray(getattr(fine, what)) - np.asarray(getattr(coarse, what))) / 3.0
        for what in ("tip_position", "total_force")
    )
    scene = ContactScene(obstacles=[obstacle_of(case["obstacle"])], rod_radius=case["rho"])
    sim = fastrod.Simulator(contact_cases.robot_of(case), contact=scene)
    loads = {"tip_force": case["tip_force"], "line_force": case["line_force"]}
    state = sim.settle(case["tendon_length"] or None, **loads)
    assert state.ok.all(), state.problems
    size = np.linalg.norm(force)
    facet, turn = (8e-5, 0.008) if name == "tube" else (0.0, 0.0)  # half a facet's width [m] and angle [rad]
    assert_allclose(state.tip_position[0], tip, rtol=0, atol=1e-5 + facet)
    assert_allclose(state.contacts.total_force[0], force, rtol=0, atol=(2e-3 + turn) * size)
    along = sim.shape(fine.arclength).position[0]
    assert_allclose(along, fine.positions, rtol=0, atol=2e-5 + facet)
    # the force stands where the truth's does; a corner of a mesh may hold it by two walls
    where = np.average(state.contacts.arclength[0], weights=np.linalg.norm(state.contacts.force[0], axis=1))
    weights = np.linalg.norm(fine.contact_force, axis=1)
    assert where == pytest.approx(np.average(fine.arclength, weights=weights), abs=2e-3)
