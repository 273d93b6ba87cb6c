"""The paths: velocity is the slope of position, and sizes are what their options say."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusals import refusals

from fastrod.control import Trajectory, circle, figure_eight, helix, names, square, square_helix, trajectory
from fastrod.errors import InputError, UnknownNameError

CENTER = (0.4, -0.2, 0.6)


@pytest.mark.parametrize("name", names())
@pytest.mark.parametrize("period", [20.0, 3.0])
def test_velocity_is_the_derivative_of_position(name: str, period: float) -> None:
    path = trajectory(name, period=period, center=CENTER)
    t = np.random.default_rng(1).uniform(-2.0 * period, 3.0 * period, (4, 50))
    sides = 3.0 if name == "triangle" else 4.0
    corner = np.abs((sides * t / period + 0.5) % 1.0 - 0.5) < 1e-3
    t = np.where(corner & ("square" in name or name == "triangle"), t + 0.01 * period, t)
    h = 1e-5 * period
    slope = (path.position(t + h) - path.position(t - h)) / (2.0 * h)
    assert path.velocity(t).shape == (4, 50, 3)
    # (2 w)^3 h^2 / 6 of the figure eight is 2e-8 / period^3 of its size; rounding adds 1e-16 / h
    assert_allclose(slope, path.velocity(t), atol=1e-8)


@pytest.mark.parametrize("name", ["square", "circle", "figure_eight"])
def test_a_path_in_the_plane_is_closed(name: str) -> None:
    path = trajectory(name, center=CENTER)
    t = np.linspace(0.0, 20.0, 41)
    assert_allclose(path.position(t + path.period), path.position(t), atol=1e-12)
    assert_array_equal(path.position(t)[:, 2], CENTER[2])
    half = path.position(t + 0.5 * path.period) - path.position(t)
    assert np.abs(half).max() > 0.1  # and not before


@pytest.mark.parametrize(("name", "pitch"), [("helix", 0.1), ("square_helix", 0.02)])
def test_a_helix_is_its_lap_that_sinks_by_the_pitch(name: str, pitch: float) -> None:
    t, path = np.linspace(-7.0, 45.0, 60), trajectory(name, center=CENTER)
    flat = circle(center=CENTER, radius=0.2) if name == "helix" else square(center=CENTER, side=0.2)
    assert_array_equal(path.position(t)[:, :2], flat.position(t)[:, :2])
    sunk = np.broadcast_to([0.0, 0.0, -pitch], (60, 3))
    assert_allclose(path.position(t + 20.0) - path.position(t), sunk, atol=1e-12)
    assert_allclose(path.velocity(t)[:, 2], -pitch / 20.0, rtol=1e-12)
    up = trajectory(name, center=CENTER, downward=False)
    assert_allclose(up.position(t)[:, 2] - CENTER[2], CENTER[2] - path.position(t)[:, 2], atol=1e-12)


def test_a_triangle_has_three_equal_sides_around_its_centre() -> None:
    path = trajectory("triangle", side=0.04, period=9.0, center=CENTER)
    corners = path.position(np.array([0.0, 3.0, 6.0]))
    assert_allclose(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1), 0.04, rtol=1e-12)
    assert_allclose(corners.mean(0), CENTER, atol=1e-15)
    assert_allclose(np.linalg.norm(path.velocity(np.linspace(0.0, 9.0, 40)), axis=1), 0.12 / 9.0, rtol=1e-12)


def test_sizes_are_those_of_the_paper() -> None:
    t = np.linspace(0.0, 20.0, 2001)
    for path in (square(), circle(), figure_eight(), helix(), square_helix()):
        p, width = path.position(t), 0.2 if path.name == "square_helix" else 0.4
        assert_allclose(np.ptp(p[:, 0]), width, rtol=1e-5)
        assert_allclose(np.ptp(p[:, 1]), width, rtol=1e-5)
        assert path.period == 20.0
    assert_allclose(np.linalg.norm(circle().position(t), axis=1), 0.2, rtol=1e-12)
    assert_allclose(figure_eight().position(t)[:, 0], 0.2 * np.sin(2.0 * np.pi * t / 10.0), atol=1e-15)
    assert_allclose(figure_eight().position(t)[:, 1], 0.2 * np.sin(np.pi * t / 10.0), atol=1e-15)


def test_a_square_has_one_speed_and_at_a_corner_that_of_the_side_that_begins() -> None:
    path = square()
    speed = np.linalg.norm(path.velocity(np.linspace(-20.0, 40.0, 777)), axis=-1)
    assert_allclose(speed, 0.4 / 5.0, rtol=1e-12)
    corners = [[-0.2, -0.2, 0], [0.2, -0.2, 0], [0.2, 0.2, 0], [-0.2, 0.2, 0]]
    assert_allclose(path.position([0.0, 5.0, 10.0, 15.0]), corners, atol=1e-15)
    begin = 0.08 * np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 0, 0]])
    assert_allclose(path.velocity([0.0, 5.0, 10.0, 15.0, 20.0]), begin, rtol=1e-12)
    odd = square(period=0.7)
    corners = 0.175 * np.arange(4000)  # where rounding falls on either side
    assert_allclose(np.abs(odd.position(corners)[:, :2]), 0.2, atol=1e-12)
    assert_array_equal(np.flatnonzero(odd.velocity(corners)[:, 0] > 0.0) % 4, 0)


def test_one_time_or_many() -> None:
    path = circle(center=CENTER)
    assert path.position(3).shape == path.velocity(3.0).shape == (3,)
    assert_array_equal(path.position([[3.0]])[0, 0], path.position(3.0))
    assert path.position(np.empty(0)).shape == (0, 3)


MUST = "it must be a number, positive and finite."
REFUSED = {
    UnknownNameError: {
        "no trajectory 'sqare'; did you mean 'square'?": lambda: trajectory("sqare"),
        (
            "no trajectory 'spiral'; known: circle, figure_eight, helix, square, square_helix, triangle."
        ): lambda: trajectory("spiral", pitch=1.0),
        "circle has no option 'radios'; did you mean 'radius'?": lambda: trajectory("circle", radios=0.1),
    },
    InputError: {
        f"side of square is -0.1 m; {MUST}": lambda: square(side=-0.1),
        f"radius of circle is nan m; {MUST}": lambda: circle(radius=np.nan),
        f"pitch of helix is 0.0 m; {MUST}": lambda: helix(pitch=0.0),
        f"period of figure_eight is 'long' s; {MUST}": lambda: figure_eight(period="long"),
        "center of circle has shape (2,); it must be (3,), world [m].": lambda: circle(center=(0.0, 1.0)),
        "t holds a time that is not finite; give times [s].": lambda: circle().position(np.inf),
        "t is 'now'; give times [s], a number or an array of them.": lambda: circle().velocity("now"),
    },
}


@refusals(REFUSED)
def test_refusals(error: type[Exception], sentence: str, call: Callable[[], object]) -> None:
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == sentence


def test_a_trajectory_cannot_be_changed() -> None:
    path = circle()
    assert isinstance(path, Trajectory)
    with pytest.raises(AttributeError):
        path.period = 3.0
