"""The constrained minimum of energy against published figures, the free minimum, and the package's rod."""

from __future__ import annotations

from functools import cache
from typing import Any

import contact_cases
import contact_energy
import contact_shapes
import energy
import numpy as np
import pytest
from numpy.testing import assert_allclose

import fastrod

CASES = contact_cases.cases()
WALL = contact_shapes.HalfSpace([0.012, 0.0, 0.0], [-1.0, 0.0, 0.0])
RING = contact_cases.ring(4, 0.0075)


@cache
def at_rest(name: str, elements: int = 40) -> contact_energy.Minimum:
    return contact_cases.solve(CASES[name], elements=elements)


def pressed(kappa: float, compliance: float, elements: int = 20, **options: Any) -> contact_energy.Minimum:
    """The prototype, bent to a mean curvature kappa [1/m] that would take its tip through the wall."""
    lengths = contact_cases.bent([0.07], [RING], [kappa], [0.0])
    rod = 0.07, [0.0022, 0.0022, 0.001], RING, lengths, compliance
    return contact_energy.minimise(*rod, obstacle=WALL, elements=elements, load_steps=4, **options)


def extrapolated(coarse: Any, fine: Any) -> Any:
    """The elements' error runs in even powers of h."""
    return (4.0 * np.asarray(fine) - np.asarray(coarse)) / 3.0


# tip force [N] and tip z [m]; they belong to tendons that do not stretch: 1e-7 m/N moves z by less than 1e-6
# m
@pytest.mark.study
@pytest.mark.parametrize(
    ("kappa", "force", "z"), [(8.0, 0.576, 0.067955), (12.0, 1.323, 0.066458), (16.0, 2.071, 0.064271)]
)
def test_tip_on_a_wall(kappa: float, force: float, z: float) -> None:
    coarse, fine = pressed(kappa, 1e-7, planar=True), pressed(kappa, 1e-7, 40, planar=True)
    assert coarse.converged
    assert fine.converged
    assert fine.tip_position[0] == pytest.approx(0.012, abs=1e-9)
    found = extrapolated(coarse.total_force, fine.total_force)
    assert_allclose(found, [-force, 0.0, 0.0], rtol=0, atol=0.002 * force)
    assert extrapolated(coarse.tip_position, fine.tip_position)[2] == pytest.approx(z, abs=3e-6)
    # the whole of it acts on the tip
    assert [p.arclength for p in contact_energy.patches(fine)] == pytest.approx([0.07])


@pytest.mark.study
def test_wires_that_stretch_press_less() -> None:
    stiff, soft = pressed(8.0, 1e-7, planar=True), pressed(8.0, 1e-5, planar=True)
    # 0.575 and 0.567 N: the rod answers at the wall like a spring in series with its tendons
    assert soft.total_force[0] / stiff.total_force[0] == pytest.approx(0.985, abs=2e-3)


@pytest.mark.study
def test_bent_far_the_planar_answer_is_a_ridge() -> None:
    """The tip slides along the wall and leaves the plane from a mean curvature of about 12.4 1/m."""
    assert pressed(12.0, 1e-5).stability > 0.05
    ridge, valley = pressed(16.0, 1e-5, planar=True), pressed(16.0, 1e-5, nudge=[0.0, 0.01, 0.0])
    assert ridge.stability < -0.5
    assert valley.converged
    assert valley.stability > 0.5
    assert valley.energy < ridge.energy - 1e-4
    # 4 mm to the side, and 3 % less force
    assert valley.tip_position[1] == pytest.approx(0.00404, abs=5e-5)
    assert valley.total_force[0] / ridge.total_force[0] == pytest.approx(0.974, abs=2e-3)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ["sphere", "two_segments"])
def test_away_from_the_obstacle_it_is_the_free_rod(name: str) -> None:
    case = {key: value for key, value in CASES[name].items() if key not in ("obstacle", "rho")}
    far = contact_shapes.Sphere([1.0, 0.0, 0.0], 0.1)
    coarse, fine = (contact_energy.minimise(**case, obstacle=far, elements=n, load_steps=3) for n in (20, 40))
    case.pop("base_rotation")  # upright in both
    free = energy.minimise(**case, levels=3)
    assert not fine.contact_force.any()
    # two extrapolations of different rules: the fourth power of h is left
    for name, atol in (("tip_position", 2e-8), ("tip_rotation", 2e-6), ("tension", 1e-4)):
        found = extrapolated(getattr(coarse, name), getattr(fine, name))
        assert_allclose(found, getattr(free, name), rtol=0, atol=atol)


@pytest.mark.study
@pytest.mark.parametrize("name", CASES)
def test_signorini(name: str) -> None:
    """No node inside, no force that pulls, no force across a gap; and it is a minimum, not a ridge."""
    found = at_rest(name)
    assert found.converged
    assert found.stability > 0.05
    assert found.gap.min() > -1e-9
    size = np.linalg.norm(found.contact_force, axis=1)
    assert (size * np.abs(found.gap)).max() < 1e-9
    touching = size > 1e-6
    normal = contact_shapes.obstacle(CASES[name]["obstacle"]).distance(found.positions[touching]).normal
    assert_allclose(found.contact_force[touching], size[touching, None] * normal, rtol=0, atol=1e-9)
    assert 0.1 < size.max() < 3.0


@pytest.mark.study
@pytest.mark.parametrize("name", CASES)
def test_a_force_between_the_ends_is_square_to_the_rod(name: str) -> None:
    """The normal has no component along the rod at the minimum of phi; a node that held it would fail
    this."""
    found = at_rest(name)
    for i in np.flatnonzero(np.linalg.norm(found.contact_force[:-1], axis=1) > 1e-6):
        # both sides are arcs of one curvature: the tangent is the mean of both chords, weighted
        behind, ahead = np.diff(found.positions[i - 1 : i + 2], axis=0)
        a, b = np.linalg.norm(ahead), np.linalg.norm(behind)
        tangent = (ahead / a * b + behind / b * a) / (a + b)
        across = found.contact_force[i] @ tangent / np.linalg.norm(found.contact_force[i])
        assert across == pytest.approx(0.0, abs=1e-5)


@pytest.mark.study
@pytest.mark.parametrize("name", CASES)
def test_balance(name: str) -> None:
    """Moment: the curvature at the base holds all loads. Force: by definition here; by virtual work below."""
    case, found = CASES[name], at_rest(name)
    line = np.asarray(case["line_force"])
    step = np.diff(found.arclength)
    share = 0.5 * (np.append(0.0, step) + np.append(step, 0.0))
    force = found.contact_force + share[:, None] * line
    force[-1] += case["tip_force"]
    assert_allclose(found.base_force + force.sum(axis=0), 0.0, rtol=0, atol=1e-6)
    moment = np.cross(found.positions - found.positions[0], force).sum(axis=0)
    # carried from the middles of three elements; a line force on the ends of its element is f h^2 / 8
    atol = 1e-4 * np.abs(moment).max() + np.linalg.norm(line) * step.max() ** 2 / 6.0
    assert_allclose(found.base_moment, -moment, rtol=0, atol=atol)


@pytest.mark.study
@pytest.mark.parametrize("name", ["bar", "sphere", "tube"])
def test_base_force_is_the_work_of_moving_the_base(name: str) -> None:
    """dV/d(base position), by differences: it knows nothing of multipliers."""
    case, step = CASES[name], 2e-5

    def least(move: np.ndarray) -> float:
        return contact_cases.solve(case, elements=10, load_steps=3, base_position=move).energy

    slope = [(least(step * axis) - least(-step * axis)) / (2.0 * step) for axis in np.eye(3)]
    # the difference's own error: the square of the step over the obstacle's radius, and rounding of 1e-12 J
    assert_allclose(at_rest(name, 10).base_force, slope, rtol=0, atol=2e-5)


@pytest.mark.study
@pytest.mark.parametrize("name", ["bar", "sphere", "heavy", "tube"])
def test_error_falls_with_the_square_of_the_element(name: str) -> None:
    found = [at_rest(name, n) for n in (10, 20, 40)]
    for values in ([one.total_force for one in found], [one.tip_position for one in found]):
        far, near = np.linalg.norm(np.diff(values, axis=0), axis=1)
        # where in its element the rod touches changes from grid to grid: no clean power of four
        assert near < 0.5 * far
    assert near < 2e-5  # of the tip


@pytest.mark.study
@pytest.mark.parametrize("name", CASES)
def test_the_package_has_the_same_rod_under_these_forces(name: str) -> None:
    """Contact forces as point forces on the package's rod, a boundary value problem without obstacles."""
    case, found = CASES[name], at_rest(name, 80)
    on = np.flatnonzero(np.linalg.norm(found.contact_force[:-1], axis=1) > 1e-9)
    state = fastrod.Simulator(contact_cases.robot_of(case), points_per_segment=80).settle(
        case["tendon_length"] or None,
        tip_force=found.contact_force[-1] + np.asarray(case["tip_force"]),
        line_force=case["line_force"],
        point_force=[(found.arclength[i], found.contact_force[i]) for i in on] or None,
    )
    assert state.ok.all()
    # what 80 elements leave, mostly by the contact force: 3e-6 m, and 7e-6 m for the rod of 0.3 m
    assert_allclose(state.tip_position[0], found.tip_position, rtol=0, atol=1e-5)
    assert_allclose(state.tension[0], found.tension, rtol=0, atol=5e-4)
    # on the host, so of the other sign
    assert_allclose(state.base_wrench[0, :3], -found.base_force, rtol=0, atol=1e-6)
    assert_allclose(state.base_wrench[0, 3:], -found.base_moment, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    "solid",
    [
        contact_shapes.HalfSpace([0.1, 0.0, 0.0], [1.0, 2.0, 0.5]),
        contact_shapes.Sphere([0.1, 0.2, 0.3], 0.5),
        contact_shapes.Cylinder([0.0, 0.0, 0.1], [1.0, 0.3, 0.2], 0.3),
        contact_shapes.Cylinder([0.0, 0.0, 0.1], [1.0, 0.3, 0.2], 0.3, 0.5),
        contact_shapes.Box(
            [0.0, 0.1, 0.0], [0.3, 0.4, 0.5], [[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [-0.8, 0.0, 0.6]]
        ),
        contact_shapes.Tube([0.0, 0.1, 0.0], [0.0, 0.1, 1.0], 2.0),
    ],
    ids=lambda solid: type(solid).__name__,
)
def test_distances(solid: contact_shapes.Obstacle) -> None:
    """A signed distance has a unit gradient; and ours are the derivatives they say, by differences."""
    points = np.random.default_rng(0).normal(size=(200, 3))
    found, steps = solid.distance(points), 1e-6 * np.eye(3)
    sides = [(solid.distance(points + step), solid.distance(points - step)) for step in steps]
    normal = np.stack([(a.value - b.value) / 2e-6 for a, b in sides], axis=1)
    hessian = np.stack([(a.normal - b.normal) / 2e-6 for a, b in sides], axis=2)
    assert_allclose(np.linalg.norm(found.normal, axis=1), 1.0, rtol=1e-12)
    assert_allclose(found.normal, normal, rtol=0, atol=1e-8)
    assert_allclose(found.hessian, hessian, rtol=0, atol=1e-7)
    nearest = solid.distance(points - found.value[:, None] * found.normal)
    assert_allclose(nearest.value[found.value > 0], 0.0, rtol=0, atol=1e-12)
