"""Calibration, registration and latency: what was put in comes out within its standard error; views that do
not show it are refused."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod.errors import InputError
from fastrod.rotation import product, quaternion_from_vector
from fastrod_device.bench.latency import estimate_latency
from fastrod_device.errors import CalibrationError
from fastrod_device.vision.calibration import CharucoBoard, calibrate, register_base
from fastrod_device.vision.camera import Camera, compose, rotation
from fastrod_device.vision.drawing import DrawnScene, draw_board

BOARD = CharucoBoard(columns=7, rows=5, square=0.02, marker=0.015, dictionary="DICT_4X4_50")
LENS = (-0.2, 0.08, 0.001, -0.0005, 0.0)
CAMERA = Camera(
    matrix=((800.0, 0.0, 322.3), (0.0, 805.0, 238.1), (0.0, 0.0, 1.0)), distortion=LENS, size=(640, 480)
)
MIDDLE = np.array([0.07, 0.05, 0.0])
NONE = np.zeros((480, 640), dtype=np.uint8)


def view(rng, tilt):
    azimuth, roll = rng.uniform(0.0, 6.28), rng.uniform(-0.5, 0.5)
    lean = quaternion_from_vector(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    quaternion = product(lean, quaternion_from_vector(np.array([0.0, 0.0, roll])))
    return rng.uniform((-0.04, -0.03, 0.18), (0.04, 0.03, 0.32)) - rotation(quaternion) @ MIDDLE, quaternion


@pytest.fixture(scope="module")
def views():
    rng = np.random.default_rng(3)
    return [view(rng, rng.uniform(0.1, 0.7)) for _ in range(14)]


@pytest.fixture(scope="module")
def images(views):
    rng = np.random.default_rng(4)
    return [draw_board(CAMERA, BOARD, *there, rng=rng) for there in views]


def test_drawn_board_is_the_printed_one():
    print_ = BOARD.draw(64)
    height, width = print_.shape
    camera = Camera(matrix=((640.0, 0.0, 31.5), (0.0, 640.0, 31.5), (0.0, 0.0, 1.0)), size=(width, height))
    scene = DrawnScene(white=255.0, black=0.0, blur=0.0, noise=0.0, gradient=(0.0, 0.0), vignetting=0.0)
    there = np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0])
    seen = draw_board(camera, BOARD, *there, rng=np.random.default_rng(0), scene=scene)
    assert (height, width) == (6 * 64, 8 * 64)
    assert np.abs(seen.astype(int) - print_).max() <= 1


def test_calibration_finds_the_camera(images):
    found = calibrate([*images, NONE + np.uint8(128)], BOARD)
    assert (found.refused, found.used) == (((14, "no board seen"),), tuple(range(14)))
    assert found.error < 0.1
    assert_allclose(found.matrix, CAMERA.intrinsics, atol=2.5)
    assert_allclose(found.distortion[:2], CAMERA.lens[:2], atol=0.04)
    off = (found.matrix - CAMERA.intrinsics)[(0, 1, 0, 1), (0, 1, 2, 2)]  # fx, fy, cx, cy
    assert (np.abs(off) < 5.0 * found.stderr[:4]).all()
    assert found.stderr[8] == 0.0
    camera = found.camera(rate=15.0, latency=0.02)
    assert (camera.size, camera.rate, camera.latency) == ((640, 480), 15.0, 0.02)
    assert_allclose(camera.intrinsics, found.matrix)


def test_views_that_do_not_show_the_board_well(images):
    rng = np.random.default_rng(5)
    flat = [draw_board(CAMERA, BOARD, *view(rng, 0.0), rng=rng) for _ in range(6)]
    refused = [
        (flat, "all alike|focal length|do not determine"),
        (images[:3], "3 of 3 views show the board well enough; 5 or more are needed"),
        ([NONE] * 6, r"0 of 6 views .* \(no board seen\)"),
    ]
    for pictures, sentence in refused:
        with pytest.raises(CalibrationError, match=sentence):
            calibrate(pictures, BOARD)


def test_registration_finds_the_place(views):
    stand = (np.array([0.04, -0.02, 0.25]), quaternion_from_vector(np.array([2.8, 0.4, 0.1])))
    camera = replace(CAMERA, position=tuple(stand[0]), quaternion=tuple(stand[1]))
    rng = np.random.default_rng(6)
    places = [compose(stand, there) for there in views[:6]]
    pictures = [draw_board(camera, BOARD, *place, rng=rng) for place in places]
    position, quaternion = map(np.array, zip(*places, strict=True))
    found = register_base(pictures, BOARD, CAMERA, position=position, quaternion=quaternion)
    assert found.used == tuple(range(6))
    assert found.error < 0.1
    assert_allclose(found.position, stand[0], atol=2e-4)
    assert (np.abs(found.position - stand[0]) < 4.0 * found.position_stderr).all()
    assert 2.0 * np.arccos(min(1.0, abs(found.quaternion @ stand[1]))) < 1e-3
    assert (found.position_stderr < 5e-4).all()
    placed = found.camera(CAMERA)
    assert (placed.position, placed.matrix) == (tuple(found.position), CAMERA.matrix)
    # one board that stays, one place for all
    still = register_base(pictures[:1] * 2, BOARD, CAMERA, position=position[0], quaternion=quaternion[0])
    assert_allclose(still.position, stand[0], atol=3e-4)
    # a board that is held worse than it is seen: the scatter says so
    shaken = position + 1e-3 * rng.standard_normal((6, 3))
    held = register_base(pictures, BOARD, CAMERA, position=shaken, quaternion=quaternion)
    assert (held.position_stderr > 1.5e-4).all()


def recording(seed, rate, delay, amplitude=0.003, noise=3e-4):
    """Four tendons that bend a 70 mm arc, and the tip as a camera sees it, late."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 15.0, 0.01)
    f, phase = rng.uniform(0.1, 0.8, 4), rng.uniform(0.0, 6.28, 4)
    wave = amplitude * np.sin(2.0 * np.pi * f[:, None] * t + phase[:, None])
    x, y = wave[0] + 0.5 * wave[1], wave[2] + 0.5 * wave[3]
    seen = np.arange(0.003, 15.0, 1.0 / rate)
    a, b = (np.interp(seen - delay, t, w) / 0.008 for w in (x, y))
    theta = np.hypot(a, b) + 1e-9
    across = 0.07 * (1.0 - np.cos(theta)) / theta**2
    tip = np.stack([across * a, across * b, 0.07 * np.sin(theta) / theta], axis=1)
    tip += noise * rng.standard_normal((len(seen), 3))
    tip[rng.random(len(seen)) < 0.1] = np.nan
    return t, np.stack([x, y, -x, -y], axis=1), seen, tip


@pytest.mark.parametrize("rate", [15.0, 30.0])
@pytest.mark.parametrize("delay", [0.0, 0.03, 0.2])
def test_latency_within_five_milliseconds(rate, delay):
    found = [estimate_latency(*recording(seed, rate, delay)) for seed in range(4)]
    off, stderr = np.array([(one.delay - delay, one.stderr) for one in found]).T
    assert np.abs(off).max() < 0.005
    assert (np.abs(off) < 5.0 * stderr).all()
    assert stderr.max() < 0.003


def test_latency_without_noise_is_exact():
    t = np.arange(0.0, 10.0, 0.001)
    motion = np.stack([np.sin(3.0 * t), np.cos(1.7 * t)], axis=1)
    late = np.arange(0.5, 9.5, 1.0 / 30.0)
    u, v = np.sin(3.0 * (late - 0.0723)), np.cos(1.7 * (late - 0.0723))
    found = estimate_latency(t, motion, late, np.stack([u, u * v, v * v], axis=1))
    assert found.delay == pytest.approx(0.0723, abs=2e-4)
    assert found.stderr < 1e-4


NO_LATENCY = {
    "still": (lambda t, dl, seen, tip: (t, 0.0 * dl, seen, tip), "nothing moved"),
    "noise": (
        lambda t, dl, seen, tip: (t, dl, seen, 3e-4 * np.random.default_rng(0).standard_normal(tip.shape)),
        "the motion explains",
    ),
    "apart": (lambda t, dl, seen, tip: (t, dl, seen + 100.0, tip), "positions fall within the motion"),
    "rows": (lambda t, dl, seen, tip: (t, dl[:-1], seen, tip), "would be right"),
    "back": (lambda t, dl, seen, tip: (t[::-1], dl, seen, tip), "must rise"),
}


@pytest.mark.parametrize("name", NO_LATENCY)
def test_a_latency_that_cannot_be_found(name):
    change, sentence = NO_LATENCY[name]
    with pytest.raises(InputError if name in ("rows", "back") else CalibrationError, match=sentence):
        estimate_latency(*change(*recording(0, 15.0, 0.03)))


def test_a_latency_beyond_the_longest():
    with pytest.raises(CalibrationError, match=r"search longer than 0\.1 s"):
        estimate_latency(*recording(0, 15.0, 0.2), longest=0.1)
    with pytest.raises(InputError, match="longest is 0"):
        estimate_latency(*recording(0, 15.0, 0.03), longest=0.0)
