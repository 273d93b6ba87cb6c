"""The tip's pose from frames: a square marker, its sides fitted to parts of a pixel, both poses that a square
allows, the likelier kept.

Which of both: each solution costs (misfit of the sides / `sigma`)^2, the squared distances of its eight
points from the sides seen, plus (angle to the last accepted sighting / its sigma)^2, plus (angle to the
expected pose / its sigma)^2 where one is given. The angle terms end at `_CAP`, so that no belief outweighs a
picture that says otherwise for long. The cheaper one is taken. A sighting is "ambiguous" where the costs
differ by less than `_DECISIVE`, the solutions by more than `_ALIKE`: then nothing tells them apart. It is an
"outlier" where its corners do not fit a square, or where a side could not be fitted: covered, cut off, or too
small, and then off by millimetres.

A marker of the right number need not be the robot's. Its tip is refused where the robot's cannot be ("outside
the workspace"), where it is "far from the model", and where it cannot have come since the last accepted one
("too fast"), in this order; of "two markers" in one picture neither is believed. What is refused leaves
nothing behind: the next frame is looked at as if it had not been there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError
from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats
from fastrod_device.vision.camera import (
    Camera,
    CameraFrame,
    Marker,
    Picture,
    Pose,
    compose,
    dictionary_named,
    inverse,
)
from fastrod_device.vision.edges import SideFit, Sides
from fastrod_device.vision.gates import (
    AHEAD,
    ASTRAY,
    BACK,
    FROZEN,
    OUTSIDE,
    REPEATED,
    TOO_FAST,
    TWICE,
    FrameOrder,
    Workspace,
)

if TYPE_CHECKING:
    import cv2

FLAGS = (
    *("", "no marker", "outlier", "ambiguous"),
    *(FROZEN, OUTSIDE, ASTRAY, TOO_FAST, TWICE, REPEATED, BACK, AHEAD),
)
"""Flags of a sighting that may be wrong; a log has the place in this list, so new ones go to its end."""
_CAP = 36.0
_DECISIVE = 4.6  # twice the logarithm of a likelihood ratio of 10
_ALIKE = math.radians(6.0)
_LAST_ANGLE, _SPIN, _EXPECTED_ANGLE = 0.05, 1.5, 0.1  # [rad], [rad/s], [rad]
_SIX = np.eye(6)
_GAUSS = 1.0 / math.sqrt(3.0)  # two points that weigh on a line as much as all points of a side do


@dataclass(frozen=True, kw_only=True, eq=False)
class MarkerSighting:
    """Sighting of the tip's marker in one frame; nan where it says nothing."""

    t: float
    """The frame's [s]; where its stamp is not believed, a time between those of its neighbours."""
    number: int
    """The frame's."""
    flag: str
    """"" where it is to be trusted; else another of `FLAGS`."""
    position: Floats
    """(3,) of base_from_tip [m]."""
    quaternion: Floats
    """(4,) of base_from_tip, w x y z."""
    other_position: Floats
    """(3,) of the second solution [m]."""
    other_quaternion: Floats
    """(4,) of the second solution."""
    error: float
    """Root mean square distance of the marker's corners from the picture's [px]."""
    other_error: float
    """The same of the second solution [px]."""
    size_px: float
    """Mean side of the marker in the picture [px]."""
    corners: Floats
    """(4, 2) of the marker in the picture, clockwise from its top left [px]."""

    @property
    def ok(self) -> bool:
        """To be trusted."""
        return not self.flag


@final
class MarkerTracker:
    """Follows one marker through the frames of one camera. Nothing is smoothed: a doubtful sighting is
    flagged, and forgotten."""

    def __init__(
        self,
        camera: Camera,
        marker: Marker,
        *,
        workspace: Workspace | None = None,
        gate: float = 1.0,
        slack: float = 0.004,
        limit: float = 1.0,
        sigma: float = 0.05,
    ) -> None:
        """`workspace`: where the tip can be, None: anywhere; `gate`: fastest that it can move [m/s]; `slack`:
        what it may jump besides [m]; `limit`: largest `error` of a sighting [px];

        `sigma`: how far a side that was seen is off [px]: noise, and what the lens model leaves. Raises
        `InputError`.
        """
        for name, value in (("gate", gate), ("slack", slack), ("limit", limit), ("sigma", sigma)):
            check_number(name, value, Bound(above=0.0, infinite=True))
        self.camera, self.marker = camera, marker
        self._matrix, self._base_from_camera = camera.intrinsics, camera.base_from_camera
        self._workspace, self._gate, self._slack = workspace, gate, slack
        self._limit, self._sigma = limit, sigma
        self._fit, self._detector, self._order = SideFit(camera), _detector(marker), FrameOrder(camera)
        self._cells = dictionary_named(marker.dictionary).markerSize + 2
        half = marker.size / 2.0
        self._corners = half * np.array(
            [[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]]
        )
        ahead = np.roll(self._corners, -1, axis=0)
        middle, along = 0.5 * (ahead + self._corners), 0.5 * (ahead - self._corners)
        # (8, 3), side k is points k and k + 4
        self._points = np.concatenate([middle - _GAUSS * along, middle + _GAUSS * along])
        self._marker_from_tip = inverse(marker.tip_from_marker)
        self.reset()

    def reset(self) -> None:
        """Forget the last sighting, and the frames."""
        self._last: MarkerSighting | None = None
        self._order.reset()

    def look(
        self, frame: CameraFrame, expected: Pose | None = None, *, now: float | None = None
    ) -> MarkerSighting:
        """Return what the frame says. `expected`: base_from_tip by a model, position (3,) [m] and quaternion
        (4,), by which both solutions are judged; `now`: the clock [s], None where frames may have any stamp.

        A frame is "frozen" where its number or its whole image is that of the frame before, "repeated" where
        its image is an older one's, "out of order" where its stamp or number runs back, and "from the future"
        where its stamp is after `now`. Raises `InputError` for a picture that is not (h, w) grey levels of
        the camera's size.
        """
        image = frame.image
        if image.dtype != np.uint8 or image.shape != self.camera.size[::-1]:
            raise InputError(
                f"the frame is {image.dtype} of shape {image.shape}; it must be uint8 of "
                f"{self.camera.size[::-1]}."
            )
        t, flag = self._order.check(frame, now)
        found = [] if flag else self._find(image)
        if len(found) != 1:
            return _nothing(t, frame.number, flag or (TWICE if found else "no marker"))
        sides = self._fit(image, found[0], self._cells)
        orientations, shifts, cost = self._solve(sides)
        poses = [
            self._tip(orientation, shift) for orientation, shift in zip(orientations, shifts, strict=True)
        ]
        belief = np.array([self._belief(t, quaternion, expected) for _, quaternion in poses])
        total = cost / self._sigma**2 + belief
        best = int(np.argmin(total))
        other = 1 - best if len(poses) > 1 else best
        errors = self._errors(orientations, shifts, sides.corners)
        if not sides.fitted or errors[best] > self._limit:
            flag = "outlier"
        elif not (flag := self._refusal(t, poses[best][0], expected)) and (
            other != best
            and total[other] - total[best] < _DECISIVE
            and _angle(poses[0][1], poses[1][1]) > _ALIKE
        ):
            flag = "ambiguous"
        pixels = self._fit.distorted(sides.corners)
        sighting = MarkerSighting(
            t=t,
            number=frame.number,
            flag=flag,
            position=poses[best][0],
            quaternion=poses[best][1],
            other_position=poses[other][0] if other != best else np.full(3, np.nan),
            other_quaternion=poses[other][1] if other != best else np.full(4, np.nan),
            error=float(errors[best]),
            other_error=float(errors[other]) if other != best else math.nan,
            size_px=float(np.linalg.norm(np.roll(pixels, -1, axis=0) - pixels, axis=1).mean()),
            corners=pixels,
        )
        if sighting.ok:
            self._last = sighting
        return sighting

    def _find(self, image: Picture) -> list[Floats]:
        """(4, 2) corners of each marker of its number in the picture, about, the largest first.

        The whole picture is searched each time: a second marker may be anywhere. Smoothed first, as noise
        makes contours, and each takes time: 1.8 ms of a core in place of 5.9 ms where noise is strong.
        """
        import cv2

        for picture in (cv2.blur(image, (3, 3)), image):
            corners, ids, _ = self._detector.detectMarkers(picture)
            quads = [np.asarray(quad, dtype=np.float64).reshape(4, 2) for quad in corners]
            known = () if ids is None else np.ravel(ids)
            mine = [quad for quad, number in zip(quads, known, strict=True) if number == self.marker.id]
            if mine:
                return _apart(sorted(mine, key=_area, reverse=True))
        return []

    def _solve(self, sides: Sides) -> tuple[Floats, Floats, Floats]:
        """Camera_from_marker by both solutions: rotations (n, 3, 3), positions (n, 3) [m], and squared misfit
        (n,) [px^2]."""
        import cv2

        _, orientations, shifts, _ = cv2.solvePnPGeneric(
            self._corners, sides.corners, self._matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        orientation = np.stack(
            [np.asarray(cv2.Rodrigues(orientation)[0], dtype=np.float64) for orientation in orientations]
        )
        shift = np.stack([np.asarray(np.ravel(shift), dtype=np.float64) for shift in shifts])
        targets = self._targets(sides)
        fine = self._refine(orientation, shift, targets)
        if len(orientation) > 1 and np.linalg.norm(fine[0][0] - fine[0][1]) < 0.01:
            # both went to one minimum: the other solution is none of its own. It is reported as it was, and
            # never taken
            return (
                np.stack([fine[0][0], orientation[1]]),
                np.stack([fine[1][0], shift[1]]),
                np.array([fine[2][0], np.inf]),
            )
        return fine

    def _targets(self, sides: Sides) -> Floats:
        """(8, 3) of each of the eight points: weighted normal and offset of its side, for points that are
        divided by their depth [px]."""
        k = self._matrix
        lines = sides.lines
        rows = np.column_stack(
            [lines[:, 0] * k[0, 0], lines[:, 1] * k[1, 1], lines[:, :2] @ k[:2, 2] - lines[:, 2]]
        )
        return np.concatenate([sides.weights[:, None] * rows] * 2)

    def _misfit(self, arm: Floats, shift: Floats, targets: Floats) -> tuple[Floats, Floats]:
        """Weighted distances (n, 8) of points arm + shift from their sides [px], and their derivatives (n, 8,
        6) by rotation and shift."""
        y = arm + shift[:, None]
        ray = y / y[..., 2:]
        r = (ray * targets).sum(-1)
        bx, by = targets[:, 0] / y[..., 2], targets[:, 1] / y[..., 2]
        bz = -(bx * ray[..., 0] + by * ray[..., 1])
        ax, ay, az = arm[..., 0], arm[..., 1], arm[..., 2]
        return r, np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx, bx, by, bz], axis=-1)

    def _refine(self, orientation: Floats, shift: Floats, targets: Floats) -> tuple[Floats, Floats, Floats]:
        """Levenberg's descent from each solution to the nearest least misfit: rotations, positions [m],
        squared misfits [px^2]."""
        r, J = self._misfit(self._points @ orientation.transpose(0, 2, 1), shift, targets)
        cost, damping = (r * r).sum(1), np.full(len(r), 1e-4)
        for _ in range(8):
            across = J.transpose(0, 2, 1)
            H = across @ J
            H += (damping[:, None] * np.einsum("nii->ni", H) + 1e-12)[:, :, None] * _SIX
            step: Floats = np.asarray(-np.linalg.solve(H, across @ r[..., None])[..., 0], dtype=np.float64)
            new_orientation, new_shift = _rotation_of(step[:, :3]) @ orientation, shift + step[:, 3:]
            new_r, new_J = self._misfit(self._points @ new_orientation.transpose(0, 2, 1), new_shift, targets)
            new_cost = (new_r * new_r).sum(1)
            better = new_cost < cost
            done = bool((cost - new_cost < 1e-6).all())
            damping = np.where(better, 0.1 * damping, 30.0 * damping)
            if better.all():
                orientation, shift, r, J, cost = new_orientation, new_shift, new_r, new_J, new_cost
            else:
                each = better[:, None]
                orientation = np.where(each[..., None], new_orientation, orientation)
                J = np.where(each[..., None], new_J, J)
                shift = np.where(each, new_shift, shift)
                r = np.where(each, new_r, r)
                cost = np.where(better, new_cost, cost)
            if done:
                break
        return orientation, shift, cost

    def _tip(self, orientation: Floats, shift: Floats) -> Pose:
        """Base_from_tip, w not negative."""
        position, quaternion = compose(
            compose(self._base_from_camera, (shift, quaternion_from_matrix(orientation))),
            self._marker_from_tip,
        )
        return position, -quaternion if quaternion[0] < 0.0 else quaternion

    def _belief(self, t: float, quaternion: Floats, expected: Pose | None) -> float:
        """Return what a solution costs by its angles to the last sighting and to the expected pose."""
        cost = 0.0
        if self._last is not None:
            sigma = _LAST_ANGLE + _SPIN * abs(t - self._last.t)
            if sigma < 1.0:
                cost += min((_angle(quaternion, self._last.quaternion) / sigma) ** 2, _CAP)
        if expected is not None:
            cost += min((_angle(quaternion, expected[1]) / _EXPECTED_ANGLE) ** 2, _CAP)
        return cost

    def _errors(self, orientation: Floats, shift: Floats, corners: Floats) -> Floats:
        """(n,) root mean square distance of the corners [px]."""
        y = self._corners @ orientation.transpose(0, 2, 1) + shift[:, None]
        k = self._matrix
        pixels = y[..., :2] / y[..., 2:] * (k[0, 0], k[1, 1]) + k[:2, 2]
        return np.asarray(np.sqrt(((pixels - corners) ** 2).sum(-1).mean(-1)))

    def _refusal(self, t: float, position: Floats, expected: Pose | None) -> str:
        """Flag of a tip that is not the robot's; "" where it may be."""
        there = None if expected is None else expected[0]
        flag = "" if self._workspace is None else self._workspace.refusal(position, there)
        if flag or self._last is None:
            return flag
        far = float(np.linalg.norm(position - self._last.position))
        return "" if far <= self._slack + self._gate * abs(t - self._last.t) else TOO_FAST


def _detector(marker: Marker) -> cv2.aruco.ArucoDetector:
    import cv2

    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    options.minMarkerPerimeterRate = 0.06  # of the picture's longer side: noise has many small contours
    options.relativeCornerRefinmentWinSize = 0.4  # of a cell: the window must not reach the next
    options.adaptiveThreshWinSizeMin = 9
    options.adaptiveThreshWinSizeMax = 29
    options.adaptiveThreshWinSizeStep = 20
    return cv2.aruco.ArucoDetector(dictionary_named(marker.dictionary), options)


def _area(quad: Floats) -> float:
    ahead = np.roll(quad, -1, axis=0)
    return abs(float((quad[:, 0] * ahead[:, 1] - quad[:, 1] * ahead[:, 0]).sum()))


def _apart(quads: list[Floats]) -> list[Floats]:
    """Those that lie in no larger one before them: a detector may give the two edges of one black frame."""
    kept: list[Floats] = []
    for quad in quads:
        away = [float(np.linalg.norm(quad.mean(0) - other.mean(0))) for other in kept]
        if all(far > 0.5 * math.sqrt(0.5 * _area(other)) for far, other in zip(away, kept, strict=True)):
            kept.append(quad)
    return kept


def _angle(a: Floats, b: Floats) -> float:
    """Between two orientations [rad]."""
    return 2.0 * math.acos(min(1.0, abs(float(a @ b))))


def _rotation_of(vector: Floats) -> Floats:
    """(n, 3, 3) rotation by vectors (n, 3) [rad], Cayley's: right to second order, and a rotation to the last
    bit."""
    a = 0.5 * vector
    square = (a * a).sum(-1)[:, None, None]
    zero = np.zeros(len(a))
    skew = np.stack(
        [zero, -a[:, 2], a[:, 1], a[:, 2], zero, -a[:, 0], -a[:, 1], a[:, 0], zero], axis=-1
    ).reshape(-1, 3, 3)
    return np.asarray(np.eye(3) + 2.0 / (1.0 + square) * (skew + skew @ skew))


def _nothing(t: float, number: int, flag: str) -> MarkerSighting:
    """A frame without a pose."""
    return MarkerSighting(
        t=t,
        number=number,
        flag=flag,
        position=np.full(3, np.nan),
        quaternion=np.full(4, np.nan),
        other_position=np.full(3, np.nan),
        other_quaternion=np.full(4, np.nan),
        error=math.nan,
        other_error=math.nan,
        size_px=math.nan,
        corners=np.full((4, 2), np.nan),
    )


def outlined(image: Picture, sighting: MarkerSighting) -> Picture:
    """(h, w, 3) red, green, blue: a frame with the marker's sides, green where the sighting is trusted, red
    where it is not."""
    import cv2

    shown = np.repeat(image[:, :, None], 3, axis=2)
    if np.isfinite(sighting.corners).all():
        corners = np.rint(16.0 * sighting.corners).astype(np.int32)
        cv2.polylines(
            shown,
            [corners.reshape(-1, 1, 2)],
            True,
            (30, 170, 80) if sighting.ok else (220, 50, 40),
            2,
            cv2.LINE_AA,
            4,
        )
    return shown
