"""Pictures of a PyBullet world: colours in their channels, metric depth, the right way up."""

import math

import numpy as np
import pytest

from fastrod.errors import InputError
from fastrod.hosts import HostCamera, connect

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")
FROM, AHEAD = (0.0, 0.0, 0.0), (0.0, 1.0, 0.0)


@pytest.fixture
def world():
    return connect()


def box(b, at, half, color=(1.0, 1.0, 1.0, 1.0)):
    return b.createMultiBody(0.0, -1, b.createVisualShape(b.GEOM_BOX, halfExtents=half, rgbaColor=color), at)


@pytest.mark.parametrize("channel", [0, 1, 2], ids=["red", "green", "blue"])
def test_a_colour_is_in_its_own_channel(world, channel):
    box(world, [0.0, 0.0, 0.0], [0.1] * 3, [*np.eye(3)[channel], 1.0])
    image = HostCamera(width=64, height=48).look(world, (0.0, -0.5, 0.0), (0.0, 0.0, 0.0))
    middle = image.rgb[24, 32].tolist()
    assert (image.rgb.dtype, image.rgb.shape) == (np.uint8, (48, 64, 3))
    assert middle.pop(channel) > 100
    assert max(middle) < 30


@pytest.mark.parametrize("distance", [0.05, 0.3, 1.5])
def test_depth_is_the_distance_along_the_optical_axis(world, distance):
    """A wall is equally deep everywhere, also far from the axis, where the ray to it is longer."""
    wall = box(world, [0.0, distance + 0.01, 0.0], [5.0, 0.01, 5.0])
    image = HostCamera(width=80, height=60, near=0.005, far=4.0).look(world, FROM, AHEAD)
    assert (image.segmentation == wall).all()
    assert np.abs(image.depth - distance).max() < 1e-3


def test_nothing_is_infinitely_far(world):
    cube = box(world, [0.0, 1.0, 0.0], [0.1] * 3)
    image = HostCamera(width=80, height=60).look(world, FROM, AHEAD)
    assert np.array_equal(np.isinf(image.depth), image.segmentation == -1)
    assert set(np.unique(image.segmentation)) == {-1, cube}


def test_the_picture_is_upright_and_not_mirrored(world):
    """Seen along +y with z upward, +x is on the right; each cube is where the pinhole puts it, to a pixel."""
    above, right = (box(world, at, [0.02] * 3) for at in ([0, 1, 0.3], [0.3, 1, 0]))
    seen = HostCamera(width=160, height=120, fov=60.0).look(world, FROM, AHEAD).segmentation
    shift = 60.0 / math.tan(math.radians(30.0)) * 0.3  # pixels, at 1 m; the cubes' near faces stand at 0.98 m
    for body, row, column in ((above, 59.5 - shift, 79.5), (right, 59.5, 79.5 + shift)):
        assert np.argwhere(seen == body).mean(axis=0) == pytest.approx([row, column], abs=1.5)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"width": 0}, "Camera.width is 0; it must be a whole number, at least 1"),
        ({"fov": 180.0}, "Camera.fov is 180.0 deg; it must be a number between 0 and 180 deg"),
        ({"near": 1.0, "far": 0.5}, "it must be 0 < near < far"),
    ],
)
def test_a_camera_that_cannot_be_says_so(arguments, sentence):
    with pytest.raises(InputError, match=sentence):
        HostCamera(**arguments)


@pytest.mark.parametrize(
    ("target", "sentence"),
    [((0, 0, 0), "different directions"), ((0, 0, math.nan), "target holds a value that is not fi")],
)
def test_a_view_that_cannot_be_says_so(target, sentence, world):
    with pytest.raises(InputError, match=sentence):
        HostCamera().look(world, (0, 0, 1), target)
