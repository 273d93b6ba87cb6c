"""The package's contact against the constrained minimum of energy: forces, shape and place of contact,
without friction."""

from __future__ import annotations

from typing import Any

import contact_cases
import numpy as np
import pytest
from numpy.testing import assert_allclose

import fastrod
from fastrod.contact import ContactScene, Obstacle, box, cylinder, mesh, plane, sphere
from fastrod.model.robot import Robot, Segment, Tendon

CASES = contact_cases.cases()


def quaternion(turn: np.ndarray) -> tuple[float, float, float, float]:
    """w x y z of a rotation by less than half a turn."""
    w = 0.5 * np.sqrt(1.0 + np.trace(turn))
    x, y, z = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / (
        4.0 * w
    )
    return float(w), float(x), float(y), float(z)


def to_axis(axis: list[float]) -> tuple[float, float, float, float]:
    """Quaternion that turns z to the axis."""
    a = np.asarray(axis) / np.linalg.norm(axis)
    q = np.array([1.0 + a[2], -a[1], a[0], 0.0])
    return tuple(map(float, q / np.linalg.norm(q)))


def robot_of(case: dict[str, Any]) -> Robot:
    n = len(case["length"])
    offsets = np.zeros((n, 0, 2)) if case["offsets"] is None else np.array(case["offsets"], dtype=float)
    routed: list[list[Tendon]] = [[] for _ in range(n)]
    for t in range(offsets.shape[1]):
        places = [p for p in offsets[:, t] if np.isfinite(p).all()]
        offset, angle = (
            [float(f) for f in v]
            for v in ((np.hypot(*p) for p in places), (np.arctan2(p[1], p[0]) for p in places))
        )
        routed[len(places) - 1].append(
            Tendon(offset=tuple(offset), angle=tuple(angle), compliance=case["compliance"])
        )
    segments = tuple(
        Segment(
            length=case["length"][k],
            bending_stiffness=tuple(case["K"][k][:2]),
            torsional_stiffness=case["K"][k][2],
            mode="tendon_length" if routed[k] else "passive",
            tendons=tuple(routed[k]),
        )
        for k in range(n)
    )
    return Robot(name="case", segments=segments, base_quaternion=quaternion(np.array(case["base_rotation"])))


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

    # a hole with 400 sides of the same mean radius: 0.3 um in and out, and facets of 0.16 mm, on which a tip
    # may rest anywhere
    wide = o["radius"] / np.sqrt(np.cos(np.pi / 400))
    return mesh(
        trimesh.creation.annulus(wide, wide + 0.01, 0.3, sections=400),
        position=o["point"],
        quaternion=to_axis(o["axis"]),
    )


@pytest.mark.parametrize("name", list(CASES))
def test_forces_and_shape(name: str) -> None:
    case = CASES[name]
    coarse, fine = (contact_cases.solve(case, elements=n) for n in (20, 40))
    assert fine.converged
    tip, force = (
        (4.0 * np.asarray(f) - np.asarray(c)) / 3.0
        for c, f in zip(
            (coarse.tip_position, coarse.total_force), (fine.tip_position, fine.total_force), strict=True
        )
    )
    sim = fastrod.Simulator(
        robot_of(case),
        contact=ContactScene(obstacles=[obstacle_of(case["obstacle"])], rod_radius=case["rho"]),
    )
    state = sim.settle(
        case["tendon_length"] or None, tip_force=case["tip_force"], line_force=case["line_force"]
    )
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
