"""The eye and the tracker: pixels where OpenCV has them, exact coverage, no bias, no flips; what is doubtful
is flagged; camera files."""

import math
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from bench_camera import pose
from fastrod.errors import InputError
from fastrod.model.robot import Segment
from fastrod.model.robotfile import load_robot
from fastrod.rotation import quaternion_from_vector
from fastrod_device.errors import DeviceError
from fastrod_device.vision import camera as camera_module
from fastrod_device.vision import camera as cameras
from fastrod_device.vision.drawing import DrawnScene, Eye, draw, project
from fastrod_device.vision.gates import FrameOrder, Workspace
from fastrod_device.vision.tracker import MarkerTracker

CAMERA = cameras.Camera(matrix=((800.0, 0.0, 319.5), (0.0, 800.0, 239.5), (0.0, 0.0, 1.0)), size=(640, 480))
BENT = replace(CAMERA, distortion=(-0.2, 0.08, 0.001, -0.0005, 0.0))
MARKER = cameras.Marker(size=0.015, id=7)
SHARP = DrawnScene(blur=0.0, noise=0.0, gradient=(0.0, 0.0), vignetting=0.0)
SQUARE = 0.0075 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
FACING = np.array([0.0, 1.0, 0.0, 0.0])  # the marker's z toward the camera


def angle(a, b):
    return 2.0 * math.acos(min(1.0, abs(float(a @ b))))


def framed(image, t=0.0, number=1):
    return cameras.CameraFrame(image=image, t=t, number=number)


def frames(camera, poses, scene=None):
    rng = np.random.default_rng(0)
    images = [draw(camera, MARKER, *p, rng=rng, scene=scene) for p in poses]
    return [framed(image, k / 15.0, k + 1) for k, image in enumerate(images)]


def test_projection_is_opencvs():
    points = np.random.default_rng(0).uniform((-0.05, -0.04, 0.1), (0.05, 0.04, 0.3), (50, 3))
    theirs, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), BENT.intrinsics, BENT.lens)
    assert_allclose(project(BENT, points), theirs.reshape(-1, 2), atol=1e-9)


def test_a_pixel_is_covered_by_its_area():
    # edges at thirds of a pixel, parallel to the rows: 15 mm at 0.1 m are 120 px, pixel (0, 0) reaches from
    # -0.5 to 0.5
    camera = replace(CAMERA, matrix=((800.0, 0.0, 319.5 + 1.0 / 3.0), (0.0, 800.0, 239.5), (0.0, 0.0, 1.0)))
    scene, rng = replace(SHARP, white=240.0, black=0.0), np.random.default_rng(0)
    image = draw(camera, MARKER, *pose(0.1, 0.0, 0.0, 0.0), rng=rng, scene=scene)
    # black from 319.833 - 60 = 259.833 on: of pixel 260 (259.5 to 260.5) a third is white
    assert image[240, 258:263].tolist() == [240, 240, 80, 0, 0]
    assert image[178:182, 262].tolist() == [240, 240, 0, 0]


def test_drawing_is_a_slow_obvious_twin():
    position, quaternion = pose(0.12, 0.6, 0.4, 0.3)
    image = draw(BENT, MARKER, position, quaternion, rng=np.random.default_rng(0), scene=SHARP)
    n, some = 12, np.s_[200:215, 265:380]
    rows, columns = np.mgrid[some]
    offset = (np.arange(n) + 0.5) / n - 0.5
    x, y = columns[..., None, None] + offset, rows[..., None, None] + offset[:, None]
    fine = np.stack(np.broadcast_arrays(x, y), -1).reshape(-1, 1, 2).astype(np.float64)
    many = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    rays = cv2.undistortPoints(fine, BENT.intrinsics, BENT.lens, criteria=many).reshape(-1, 2)
    R = cameras.rotation(quaternion)
    rays = np.column_stack([rays, np.ones(len(rays))])
    on = (rays * (R[:, 2] @ position / (rays @ R[:, 2]))[:, None] - position) @ R[:, :2]
    cell = MARKER.size / 6.0
    i = np.floor((on[:, 0] + 4.0 * cell) / cell).astype(int)
    j = np.floor((4.0 * cell - on[:, 1]) / cell).astype(int)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    texture = np.pad(cv2.aruco.generateImageMarker(dictionary, 7, 6), 1, constant_values=255)
    inside = (i >= 0) & (i < 8) & (j >= 0) & (j < 8)
    level = np.where(texture[np.clip(j, 0, 7), np.clip(i, 0, 7)] > 0, SHARP.white, SHARP.black)
    slow = np.where(inside, level, SHARP.background).reshape(*rows.shape, n * n).mean(-1)
    assert np.ptp(slow) > 150.0
    assert np.abs(slow - image[some]).max() < 0.6 + 170.0 / n / 2.0
    assert np.abs(slow - image[some]).mean() < 0.6


def test_what_cannot_be_seen_is_not_drawn():
    def drawn(*there, **options):
        return Eye(CAMERA, MARKER, scene=SHARP).draw(*there, **options)

    ahead, away = np.array([0.0, 0.0, 0.1]), np.array([1.0, 0.0, 0.0, 0.0])
    empty, outside = drawn(*pose(0.1, 0.0, 0.0, 0.0), marker=False), pose(0.1, 0.2, 0.0, 0.3, x=0.2)
    assert (empty == 110).all()
    for unseen in ((ahead, away), (-ahead, FACING), (ahead, pose(0.1, math.pi, 0, 0)[1]), outside):
        assert_array_equal(drawn(*unseen), empty)


def test_a_marker_across_the_border_is_the_same_picture_cut():
    wide = replace(CAMERA, size=(800, 480))
    blurred = replace(SHARP, blur=1.0)
    there = pose(0.1, 0.4, 0.3, 0.2, x=0.04)
    small, large = (Eye(camera, MARKER, scene=blurred).draw(*there) for camera in (CAMERA, wide))
    assert np.ptp(small[:, -1].astype(int)) > 50
    assert_array_equal(small, large[:, :640])


def test_eye_repeats_by_its_seed():
    there = pose(0.15, 0.3, 0.2, 0.1)
    first, same, other = (Eye(CAMERA, MARKER, seed=seed).draw(*there) for seed in (1, 1, 2))
    assert_array_equal(first, same)
    assert (first != other).mean() > 0.5
    clean = Eye(CAMERA, MARKER, scene=DrawnScene(noise=0.0)).draw(*there)
    assert (first.astype(float) - clean).std() == pytest.approx(2.0, rel=0.05)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("camera", [CAMERA, BENT], ids=["straight", "bent"])
@pytest.mark.parametrize("tilt", [0.0, 30.0, 60.0])
def test_clean_pictures_have_no_bias(camera, tilt):
    rng = np.random.default_rng(int(tilt))
    tracker, corner, moved = MarkerTracker(camera, MARKER), [], []
    scene = replace(SHARP, blur=0.7)
    for k in range(25):
        there = pose(0.15, math.radians(tilt), *rng.uniform(0.0, 6.28, 2), *rng.uniform(-0.015, 0.015, 2))
        tracker.reset()
        seen = tracker.look(framed(draw(camera, MARKER, *there, rng=rng, scene=scene), number=k), there)
        assert seen.flag in ("", "ambiguous")
        corner.append(seen.corners - project(camera, SQUARE @ cameras.rotation(there[1]).T + there[0]))
        moved.append(seen.position - there[0])
    assert np.abs(np.mean(corner, axis=0)).max() < 0.02
    assert np.std(corner) < 0.03
    assert np.abs(np.mean(moved, axis=0)).max() < 3e-5
    assert np.abs(moved)[:, :2].max() < 3e-5
    assert np.abs(moved)[:, 2].max() < 2e-4


@pytest.mark.study
@pytest.mark.parametrize(("distance", "largest"), [(0.10, 0.2e-3), (0.20, 0.9e-3), (0.40, 3e-3)])
def test_error_of_noisy_pictures(distance, largest):
    rng = np.random.default_rng(2)
    tracker, error = MarkerTracker(BENT, MARKER), []
    for k in range(30):
        tilt, angles, aside = rng.uniform(0.0, 0.8), rng.uniform(0.0, 6.28, 2), rng.uniform(-0.1, 0.1, 2)
        there = pose(distance, tilt, *angles, *aside * distance)
        tracker.reset()
        image = draw(BENT, MARKER, *there, rng=rng, scene=DrawnScene(noise=3.0, blur=0.9))
        error.append(tracker.look(framed(image, number=k), there).position - there[0])
    assert np.isfinite(error).all()
    assert math.sqrt((np.array(error) ** 2).sum(1).mean()) < 0.5 * largest


def test_smooth_motion_through_the_frontal_pose_does_not_flip():
    t = np.arange(60) / 15.0
    poses = [pose(0.2, 0.35 * math.sin(1.1 * s), 0.6, 0.1, x=0.01 * math.sin(s)) for s in t]
    tracker = MarkerTracker(CAMERA, MARKER)
    seen = [tracker.look(frame) for frame in frames(CAMERA, poses, DrawnScene(noise=3.0))]
    good = [(s, p, q) for s, (p, q) in zip(seen, poses, strict=True) if s.ok]
    assert len(good) > 0.9 * len(seen)
    assert max(angle(s.quaternion, q) for s, _, q in good) < math.radians(5.0)
    assert np.std([s.position[0] - p[0] for s, p, _ in good]) < 2e-5


def test_the_expected_pose_keeps_the_solutions_apart():
    there = pose(0.6, math.radians(25.0), 0.5, 0.2)  # 20 px: the picture hardly shows which it is
    frame = frames(CAMERA, [there], DrawnScene(noise=2.0))[0]
    alone = MarkerTracker(CAMERA, MARKER, sigma=0.5).look(frame)
    assert (alone.flag, alone.ok) == ("ambiguous", False)
    assert np.isfinite([*alone.position, *alone.other_position, alone.other_error]).all()
    for expected in ((alone.position, alone.quaternion), (alone.other_position, alone.other_quaternion)):
        helped = MarkerTracker(CAMERA, MARKER, sigma=0.5).look(frame, expected)
        assert helped.flag == ""
        assert angle(helped.quaternion, expected[1]) < 0.02


def test_place_of_camera_and_marker():
    def placed(it, position, *vector):
        return replace(it, position=position, quaternion=tuple(quaternion_from_vector(np.array(vector))))

    camera = placed(CAMERA, (0.04, 0.0, 0.215), 0.3, 2.7, 0.1)
    marker = placed(MARKER, (0.001, -0.002, 0.003), 0.05, 0.1, 0.7)
    base_from_marker = cameras.compose(camera.base_from_camera, pose(0.13, 0.3, 0.3, 0.4))
    base_from_tip = cameras.compose(base_from_marker, cameras.inverse(marker.tip_from_marker))
    image = Eye(camera, marker).draw(*base_from_tip)
    seen = MarkerTracker(camera, marker).look(framed(image, 1.0, 4))
    assert (seen.flag, seen.t, seen.number) == ("", 1.0, 4)
    assert_allclose(seen.position, base_from_tip[0], atol=5e-5)
    assert angle(seen.quaternion, base_from_tip[1]) < 2e-3
    assert seen.size_px == pytest.approx(800.0 * 0.015 / 0.13, rel=0.05)


def test_doubtful_frames_are_flagged_and_forgotten():
    near, far = pose(0.15, 0.4, 0.0, 0.0), pose(0.15, 0.4, 0.0, 0.0, x=0.03)
    images = [f.image for f in frames(CAMERA, [near, near, near, far, near, far])]
    tracker = MarkerTracker(CAMERA, MARKER, gate=0.5, slack=0.002)

    def look(image, t, number):
        return tracker.look(framed(image, t, number))

    assert look(images[0], 0.0, 1).ok
    assert look(images[1], 0.03, 1).flag == "frozen"
    again = look(images[0], 0.03, 2)
    assert again.flag == "frozen"
    assert np.isnan([*again.position, *again.quaternion, again.error, *again.corners.ravel()]).all()
    none = look(np.full((480, 640), 100, dtype=np.uint8), 0.03, 3)
    assert none.flag == "no marker"
    assert np.isnan(none.position).all()
    jump = look(images[3], 0.04, 4)  # 30 mm in 40 ms
    assert jump.flag == "too fast"
    assert jump.position[0] == pytest.approx(0.03, abs=1e-4)
    assert look(images[4], 0.05, 5).ok
    assert look(images[5], 0.12, 6).ok  # 0.5 m/s for 70 ms is 35 mm
    tracker.reset()
    assert look(images[0], 0.121, 7).ok


ROBOT = load_robot("prototype")  # one segment of 70 mm
SEGMENT = ROBOT.segments[0]
TELESCOPE = replace(ROBOT, segments=(replace(SEGMENT, extension=(-0.01, 0.03)),))
CURVED = replace(ROBOT, segments=(replace(SEGMENT, precurvature=(0.0, 40.0, 0.0)),))
HANGING = Segment(length=0.1, bending_stiffness=(0.002, 0.002), torsional_stiffness=0.001, mode="passive")
LIMP = replace(ROBOT, segments=(SEGMENT, HANGING))
OUT = "outside the workspace"


@pytest.mark.parametrize(
    ("robot", "position", "expected", "flag"),
    [
        (ROBOT, (0.0, 0.0, 0.07), None, ""),  # straight
        (ROBOT, (0.0, 0.0, 0.0734), None, ""),  # 5 % for lens and registration
        (ROBOT, (0.0, 0.0, 0.0736), None, OUT),
        (ROBOT, (0.074, -0.058, -0.008), None, OUT),  # in the picture's corner
        (ROBOT, (0.05, 0.0, 0.0), None, OUT),  # it would have to turn by more than pi / 2
        (ROBOT, (0.0, 0.0, -0.05), None, OUT),
        (ROBOT, (0.03, 0.0, 0.06), (0.03, 0.034, 0.06), ""),
        (ROBOT, (0.03, 0.0, 0.06), (0.03, -0.036, 0.06), "far from the model"),
        (ROBOT, (0.0, 0.0, 0.08), (0.0, 0.0, 0.01), OUT),  # and far from the model
        (TELESCOPE, (0.0, 0.0, 0.104), None, ""),
        (TELESCOPE, (0.0, 0.0, 0.106), None, OUT),
        (CURVED, (0.05, 0.0, -0.004), None, ""),
        (LIMP, (0.0, 0.0, -0.16), None, ""),  # what hangs from a base that stands on its head
        (LIMP, (0.0, 0.0, -0.18), None, OUT),
    ],
)
def test_the_workspace_is_the_robots(robot, position, expected, flag):
    workspace = Workspace.of(robot, 16.0)
    assert workspace.refusal(np.array(position), None if expected is None else np.array(expected)) == flag


@pytest.mark.study
def test_no_curve_that_bends_within_the_limit_is_outside_the_workspace():
    rng = np.random.default_rng(0)
    for robot, bent in ((ROBOT, 32.0), (CURVED, 72.0), (LIMP, 200.0)):
        workspace, n = Workspace.of(robot, 16.0), 200
        ds, lowest = robot.length / n, math.inf
        for k in range(40):
            frame, tip = np.eye(3), np.zeros(3)
            axis = rng.normal(size=(1 if k % 2 else n, 3)) * (1.0, 1.0, 0.0)  # a circle, or wild
            for u in np.broadcast_to(bent * axis / np.linalg.norm(axis, axis=1)[:, None], (n, 3)):
                half = cameras.rotation(quaternion_from_vector(0.5 * ds * u))
                tip = tip + ds * (frame @ half)[:, 2]
                frame = frame @ half @ half
            assert workspace.refusal(tip, tip) == ""
            lowest = min(lowest, float(tip[2]))
        if robot is ROBOT:  # and the bound is no wider than a circle of that curvature and the slack
            assert lowest - workspace.height < 1.01 * 0.05 * robot.length


UP = np.array([1.0, 0.0, 0.0, 0.0])
BASE = replace(CAMERA, position=(0.02, 0.0, 0.24), quaternion=(-0.057847298, 0.0, 0.998325443, 0.0))


def seen_at(tips):
    """Pictures of the tip at these places over the base, or of several tips in one picture."""
    eye = Eye(BASE, MARKER, scene=SHARP)
    empty, pictures = eye.draw(np.zeros(3), UP, marker=False), []
    for places in tips:
        picture = empty
        for place in np.atleast_2d(places):
            one = eye.draw(np.asarray(place, dtype=float), UP)
            picture = np.where(one != empty, one, picture)
        pictures.append(picture)
    return pictures


TRUE, CORNER, NEAR_IT = (0.0, 0.0, 0.068), (0.07, -0.05, -0.008), (0.02, 0.0, 0.06)


LEFT = (-0.045, 0.0, 0.045)


@pytest.mark.parametrize(
    ("places", "expected", "flags"),
    [
        ([TRUE, CORNER, TRUE, CORNER], TRUE, ["", OUT, "", OUT]),
        ([TRUE, *[CORNER] * 9, TRUE], None, ["", *[OUT] * 9, ""]),
        ([TRUE, LEFT, TRUE], TRUE, ["", "far from the model", ""]),
        ([TRUE, LEFT, LEFT], None, ["", "too fast", ""]),  # 51 mm in 33 ms
        ([TRUE, [TRUE, CORNER], CORNER, TRUE], TRUE, ["", "two markers", OUT, ""]),
        ([[TRUE, NEAR_IT], [TRUE, NEAR_IT]], TRUE, ["two markers", "two markers"]),
    ],
    ids=["corner", "corner for long", "off the model", "fast", "two", "two near"],
)
def test_a_marker_of_the_right_number_need_not_be_the_robots(places, expected, flags):
    tracker = MarkerTracker(BASE, MARKER, workspace=Workspace.of(ROBOT, 16.0))
    rng = np.random.default_rng(0)
    shaken = [np.atleast_2d(place) + 1e-4 * rng.normal(size=3) for place in places]
    pose_there = None if expected is None else (np.array(expected), UP)
    images = enumerate(seen_at(shaken))
    seen = [tracker.look(framed(image, k / 30.0, k), pose_there, now=k / 30.0 + 0.03) for k, image in images]
    assert [s.flag for s in seen] == flags
    for sighting, place in zip(seen, shaken, strict=True):
        if sighting.flag != "two markers":
            assert_allclose(sighting.position, place[0], atol=1e-3)  # of what was refused, too
    assert all(np.isnan(s.position).all() for s in seen if s.flag == "two markers")


NEW, OLD, BACK, AHEAD = "", "repeated", "out of order", "from the future"


@pytest.mark.parametrize(
    ("frames", "flags"),
    [
        # (picture, stamp [s], number); frame k is looked at 0.1 k + 0.13 s
        ([(0, 0.0, 1), (1, 0.1, 2), (0, 0.2, 3), (2, 0.3, 4), (1, 0.4, 5)], [NEW, NEW, OLD, NEW, OLD]),
        ([(0, 0.0, 1), (1, 0.1, 2), (0, 0.2, 3), (1, 0.3, 4), (0, 0.4, 5)], [NEW, NEW, OLD, OLD, OLD]),
        ([(0, 0.0, 1), (1, 0.1, 2), (2, 0.05, 3), (3, 0.2, 4), (4, 0.0, 5)], [NEW, NEW, BACK, NEW, BACK]),
        ([(0, 0.0, 4), (1, 0.1, 5), (2, 0.2, 2), (3, 0.3, 6), (4, 0.4, 3)], [NEW, NEW, BACK, NEW, BACK]),
        ([(0, 0.0, 1), (1, 1e3, 2), (2, 0.2, 3), (3, math.inf, 4)], [NEW, AHEAD, NEW, AHEAD]),
        ([(0, 1e3, 1), (1, 0.1, 2), (2, math.nan, 3), (3, 0.3, 4)], [AHEAD, NEW, AHEAD, NEW]),
        ([(0, 0.0, 1), (1, 0.1, 2), (1, 0.2, 3), (2, 0.4, 5)], [NEW, NEW, "frozen", NEW]),
        ([(0, 0.1, 1), (1, 0.05, 2), (2, 0.06, 3), (3, 0.07, 4), (4, 0.4, 5)], [NEW, BACK, BACK, BACK, NEW]),
    ],
    ids=["new, old", "two in turn", "stamps", "numbers", "future", "future first", "frozen", "back for long"],
)
def test_old_and_misdated_frames_are_flagged_and_leave_nothing_behind(frames, flags):
    pictures = np.random.default_rng(0).integers(0, 255, (6, 4, 4), dtype=np.uint8)
    order = FrameOrder(replace(CAMERA, rate=10.0, latency=0.13))
    made = [framed(pictures[i], t, n) for i, t, n in frames]
    found = [order.check(frame, 0.1 * k + 0.13) for k, frame in enumerate(made)]
    assert [flag for _, flag in found] == flags
    assert (np.diff([t for t, _ in found]) > 0.0).all()  # rows of a log stay in order
    assert all(t == f.t or flag in (BACK, AHEAD) for (t, flag), f in zip(found, made, strict=True))


def test_a_covered_side_is_an_outlier():
    image = frames(CAMERA, [pose(0.15, 0.2, 0.0, 0.0)])[0].image.copy()
    whole = MarkerTracker(CAMERA, MARKER).look(framed(image))
    assert whole.ok
    left, top = whole.corners[0]
    # a tendon as dark as the ink along the left side
    image[int(top) - 8 : int(top) + 70, int(left) + 5 : int(left) - 20 : -1] = 40
    assert MarkerTracker(CAMERA, MARKER).look(framed(image)).flag in ("outlier", "no marker")


def test_other_markers_are_not_taken():
    image = Eye(CAMERA, replace(MARKER, id=3)).draw(*pose(0.15, 0.2, 0.0, 0.0))
    assert MarkerTracker(CAMERA, MARKER).look(framed(image)).flag == "no marker"
    apriltag = cameras.Marker(size=0.015, id=5, dictionary="DICT_APRILTAG_16h5")
    there = pose(0.12, 0.3, 0.0, 0.0)
    seen = MarkerTracker(CAMERA, apriltag).look(framed(Eye(CAMERA, apriltag).draw(*there)))
    assert seen.ok
    assert_allclose(seen.position, there[0], atol=1e-4)


def test_camera_file_round_trip(tmp_path):
    camera = replace(BENT, position=(0.1, 0.2, 0.3), quaternion=(0.6, 0.0, 0.8, 0.0), rate=15.0, latency=0.03)
    cameras.save_camera(camera, tmp_path / "camera.toml")
    assert cameras.load_camera(tmp_path / "camera.toml") == camera
    with pytest.raises(InputError, match=r"does not end in \.toml"):
        cameras.save_camera(camera, tmp_path / "camera.json")


class Capture:
    """OpenCV's capture of a camera that gives five pictures, then none."""

    def __init__(self, opened=True, shape=(480, 640, 3)):
        self.shape, self.given, self.released = shape, 0, False
        self.isOpened, self.set = lambda: opened, lambda _key, _value: True

    def read(self):
        self.given += 1
        return (True, np.full(self.shape, self.given, dtype=np.uint8)) if self.given <= 5 else (False, None)

    def release(self):
        self.released = True


def test_video_camera(monkeypatch):
    capture = Capture()
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: capture)
    monkeypatch.setattr(camera_module, "_STILL", 3)
    still = SimpleNamespace(stepped=False, now=lambda: 7.0, sleep_until=lambda _: None)  # a clock at 7 s
    source = cameras.VideoCamera(replace(CAMERA, latency=0.25), 0, clock=still)
    source._thread.join(5.0)
    frame = source.read()
    assert (frame.number, frame.t, frame.image.shape) == (5, 6.75, (480, 640))
    assert (frame.image == 5).all()
    with pytest.raises(DeviceError, match="no picture 3 times in a row"):
        source.read()
    source.close()
    source.close()
    assert capture.released


SIZES = "gives pictures of 200 x 100 px; it must give 640 x 480 px"


@pytest.mark.parametrize(
    ("capture", "sentence"),
    [({"opened": False}, "camera 3 cannot be opened"), ({"shape": (100, 200, 3)}, SIZES)],
)
def test_video_camera_that_is_not_there(capture, sentence, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", lambda _: Capture(**capture))
    with pytest.raises(DeviceError, match=sentence):
        cameras.VideoCamera(CAMERA, 3)
