"""Is this a log of this robot? What a user who mixed up units, signs, order, frame or time should be asked,
before any fit.

The model as the robot file has it is laid beside some hundred rows: as it is, seen by a camera that stands
elsewhere, seen in a left-handed frame, and with other inputs. Where another reading follows the measurement
far better, that is the question.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from fastrod.identification.log.camera import sentences
from fastrod.identification.log.clock import clock_offset, clock_sentence
from fastrod.identification.log.forward import PredictedPose, PredictedRod, predict
from fastrod.identification.log.order import column_order
from fastrod.identification.log.registration import CameraRegistration, align, size
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.log.unknowns import known_model
from fastrod.logs.runlog import RunLog, on_one_clock
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats, Ints

_ROWS = 300  # rows that are looked at
_FEW = 6  # tendons, of which any two may be exchanged; of more, neighbours
_LEAST = 12  # of them solved; fewer say nothing
_FOLLOWS = 0.45  # of the motion: a reading that leaves less follows it; 0.55 mm of backlash left 0.18
# of it: less is an effect's matter; two tendons of different segments exchanged left 0.42
_CLOSELY = 0.15
_BETTER = 0.6  # of what is left otherwise: less is another reading's merit
_LEVER = 0.3  # robot lengths: what a measured rotation counts beside positions
_STILL = 0.01  # robot lengths: a log that moves less says nothing
_FURTHER = 1.1  # times the motion: what is left of a model that moves otherwise
_SCALES = {
    1e-3: "mm to m",
    1e-2: "cm to m",
    0.1: "a decimal place",
    0.0254: "inches to m",
    np.pi / 180.0: "degrees to radians",
    0.5: "a diameter for a radius",
    2.0: "a radius for a diameter",
    10.0: "a decimal place",
    1e3: "converted twice",
}
_FORCES = {
    9.80665: "kgf to N",
    9.80665e-3: "gf to N",
    4.448222: "lbf to N",
    1e-3: "mN to N",
    0.1: "a decimal place",
}
_HANGS = (
    "gravity the other way along the base: [base] quaternion is [1, 0, 0, 0] of a robot that stands, and "
    "[0, 1, 0, 0] of one that hangs"
)
_AS_GOOD = 1.3  # times what a moved camera leaves
# times as closely by other signs or another order: no effect is that; two tendons exchanged: 9 times
_MANY = 2.5
_RIGHT = (
    "Are the units, the signs (negative = pulled) and the order of the dl_ columns right, and is it "
    "this robot?"
)
_PACE = 1.0  # s from row to row; a dense log that takes longer has its time in another unit
_SLOWEST = 4.0  # s: such a log is refused; the rows of a grid, measured one by one, have 1 s each
_DENSE = 0.1  # of the motion from row to row


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Reading of a log at first look."""

    registration: CameraRegistration | None
    """Registration of a camera that stands far from where the robot file says; None where it does not, or
    where nothing would follow from it."""
    questions: tuple[str, ...]
    """Questions to the user, a sentence each."""
    refusal: str
    """Why nothing can be identified, in a sentence; empty where it may."""
    guess: str
    """Which other reading the model would follow, in a sentence; empty where none."""


def questions(log: RunLog, robot: Robot, *, threads: int | None = None) -> tuple[str, ...]:
    """Return what `log` makes one ask about its units, signs, order, frame and time; nothing where it fits
    `robot`."""
    if int(log.measured.sum()) < _LEAST:
        return ()
    samples = sample(log)
    clock = clock_offset(samples, robot, threads)
    if clock:
        samples = sample(on_one_clock(log, clock))
    reading = read(samples, robot, threads=threads)
    moved = (
        ()
        if reading.registration is None
        else (f"{reading.registration.sentence()}; fastrod identify takes it from there.",)
    )
    late = (f"{clock_sentence(log, clock)}; fastrod identify lays them on one.",) if clock else ()
    return (*sentences(log), *late, *moved, *reading.questions)


def read(samples: LogSamples, robot: Robot, *, threads: int | None = None) -> Reading:
    """Look at the rows of `samples`; nothing is fitted but where the camera stands."""
    late = "" if "time" in robot.log.units else time_question(samples)
    questions = [late] if late else []
    wrong = late if samples.step >= _SLOWEST else ""
    look = _Look(samples, robot, threads)
    nothing = Reading(registration=None, questions=tuple(questions), refusal=wrong, guess="")
    frame, far = look.frame, look.frame.is_large(robot.length)
    # a small misalignment is for the search to name
    as_it_is = look.as_it_is if far else min(look.as_it_is, frame.left)
    if look.motion < _STILL * robot.length or not (look.solved or robot.n_tendons):
        return nothing
    if as_it_is < _CLOSELY * look.motion and not far:
        return nothing
    follows = as_it_is < _FOLLOWS * look.motion and not far
    enough = as_it_is / _MANY if follows else min(_FOLLOWS * look.motion, _BETTER * as_it_is)
    moved = far and frame.left < enough
    tried = [(look.with_inputs(dl), words) for dl, words in _other_inputs(samples, robot, look.scale)]
    if any(s.line_density > 0.0 for s in robot.segments) and samples.log.base_quaternion is None:
        tried.append((look.upside_down(), _HANGS))
    least = 1.02 * min((left for left, _ in tried), default=np.inf)
    # of readings that are alike the one that is said in the fewest words
    left, words = min(
        (pair for pair in tried if pair[0] <= least), key=lambda pair: len(pair[1]), default=(np.inf, "")
    )
    mixed_up = left < enough
    # a rotation about the base's axis looks like other signs or another order: then the columns are asked for
    if mixed_up and moved:
        mixed_up = left < _AS_GOOD * frame.left and not _declared(robot, frame)
    mirrored = look.mirrored.left < min(enough, _BETTER * frame.left)
    if mirrored and mixed_up:
        # drives of both signs are rarer than a reversed axis, other readings more frequent
        plain = "the sign of dl_" not in words and "the sign of tension_" not in words
        mirrored = look.mirrored.left < (_BETTER if plain else 1.0 / _BETTER) * left
    guess = ""
    if mirrored:
        guess = (
            "In a left-handed frame the model would follow: is an axis of the camera reversed, or are "
            "two of them exchanged?"
        )
    elif mixed_up:
        times = f" {as_it_is / left:.0f} times as closely" if np.isfinite(as_it_is) else ""
        guess = f"The model would follow{times} with {words}."
        if moved:
            rotation = f"{np.degrees(frame.angle):.0f} deg"
            guess += (
                f" A camera turned by {rotation} would look the same: if yours is, give [sensor] "
                "registration_sd in the robot file."
            )
    further = look.centred > _FURTHER * look.motion and not (moved and not guess)
    name = samples.log.name
    refusal = wrong
    if further:
        questions.append(further_than_still(samples, robot, look.scale, guess))
    elif guess:
        questions.append(
            f"log {name!r} fits robot {robot.name!r} badly. {guess}" + ("" if mirrored else f" {_RIGHT}")
        )
    many = mixed_up and as_it_is > _MANY * left
    if mirrored or (guess and "times" not in words and (further or many)):
        refusal = questions[-1]
    return Reading(
        registration=frame if moved and not guess else None,
        questions=tuple(questions),
        refusal=refusal,
        guess=guess,
    )


def left_by(samples: LogSamples, robot: Robot, threads: int | None = None) -> float:
    """Distance that the model as the robot file has it leaves of some rows of `samples`, root mean square
    without the farthest, seen by a camera that stands where it fits best [m]."""
    return _Look(samples, robot, threads).frame.left


def further_than_still(samples: LogSamples, robot: Robot, scale: float, guess: str = "") -> str:
    """The question to a user whose model moves otherwise than the measurement, `scale` times as predicted
    along with it."""
    moves = (
        f"it moves {scale:.2g} times as predicted"
        if np.isfinite(scale)
        else "the model cannot be solved for its inputs"
    )
    return (
        f"log {samples.log.name!r} is further from robot {robot.name!r} than from a robot that stands "
        f"still: {moves}. {_RIGHT}"
        f"{' ' if guess else ''}{guess}"
    )


def time_question(samples: LogSamples) -> str:
    """Whether the time of a dense log is in another unit; empty where it is not."""
    tip, pace = np.asarray(samples.log.tip_position)[samples.rows], samples.step
    if len(tip) < _LEAST:
        return ""
    motion = size(tip - np.median(tip, axis=0))
    if pace < _PACE or size(np.diff(tip, axis=0)) > _DENSE * motion:
        return ""
    name, last = samples.log.name, float(samples.time.max())
    return (
        f"log {name!r} has a row every {pace:.3g} s and lasts {last:.3g} s; is column t in ms? It takes "
        'seconds, or [log] units = {time = "ms"} in the robot file, and "s" where it is so slow.'
    )


class _Look:
    """The model as the robot file has it beside some rows of a log."""

    def __init__(self, samples: LogSamples, robot: Robot, threads: int | None) -> None:
        rows = samples.rows
        if len(rows) > _ROWS:
            rows = rows[np.linspace(0, len(rows) - 1, _ROWS).round().astype(int)]
        log = samples.log.rows(rows)
        with_points = log.points is not None and len(robot.log_points) > 0
        self.samples, self.robot, self.model = samples.on(rows), robot, known_model(robot)
        self.rod = PredictedRod(self.samples, robot, points=with_points, threads=threads)
        self.tip = np.asarray(log.tip_position)
        self.points = log.points if with_points and log.points is not None else np.zeros((len(rows), 0, 3))
        self.turned = (
            np.zeros(len(rows), bool)
            if log.tip_quaternion is None
            else np.isfinite(log.tip_quaternion).all(1)
        )
        self.rotation = (
            np.eye(3)[None]
            if log.tip_quaternion is None
            else matrix_from_quaternion(np.nan_to_num(log.tip_quaternion, nan=0.5))
        )
        self.motion = size(self.tip - np.median(self.tip, axis=0))
        """[m]."""
        pose = self._pose(samples.log.pulls)
        # of inputs in another unit the rests are solved
        self.solved = int(pose.ok.sum()) >= max(_LEAST, len(rows) // 2)
        self.as_it_is = self.centred = np.inf
        """Distance that the model leaves as it is, and with both motions about their middles [m]."""
        self.scale = np.nan
        """Ratio of the measured motion to the predicted one."""
        self.frame = self.mirrored = CameraRegistration(rotation=np.eye(3), shift=np.zeros(3), left=np.inf)
        if self.solved:
            seen, made = self.tip[pose.ok], pose.position[pose.ok]
            self.as_it_is = size(seen - made)
            moves, moved = seen - np.median(seen, axis=0), made - np.median(made, axis=0)
            self.centred = size(moves - moved)
            self.scale = float((moves * moved).sum() / max(float((moved**2).sum()), 1e-30))
            self.frame, self.mirrored = (self._aligned(pose, mirrored=mirrored) for mirrored in (False, True))

    def with_inputs(self, dl: Floats) -> float:
        """Distance that other inputs would leave [m], with a camera that may stand where the search still
        finds it."""
        pose = self._pose(dl)
        if int(pose.ok.sum()) < max(_LEAST, len(pose.ok) // 2):
            return float("inf")
        frame = self._aligned(pose)
        return (
            frame.left if not frame.is_large(self.robot.length) else size((self.tip - pose.position)[pose.ok])
        )

    def upside_down(self) -> float:
        """Distance that gravity the other way would leave [m]."""
        x, y, z = self.robot.gravity
        moved = replace(self.robot, gravity=(-x, -y, -z))
        pose = predict(known_model(moved), self.model.start, self.samples, self.rod)
        good = int(pose.ok.sum()) >= max(_LEAST, len(pose.ok) // 2)
        return self._aligned(pose).left if good else float("inf")

    def _pose(self, pulls: Floats) -> PredictedPose:
        samples = replace(self.samples, log=self.samples.log.with_pulls(pulls))
        return predict(self.model, self.model.start, samples, self.rod)

    def _aligned(self, pose: PredictedPose, *, mirrored: bool = False) -> CameraRegistration:
        """The camera that lays a prediction on what was measured; its `left` is that of the tips."""
        both = pose.ok & np.isfinite(self.points).all((1, 2))
        seen = np.concatenate([self.tip[pose.ok], self.points[both].reshape(-1, 3)])
        made = np.concatenate([pose.position[pose.ok], pose.points[both].reshape(-1, 3)])
        rows = pose.ok & self.turned
        rotations = (
            self.rotation[rows] @ np.swapaxes(pose.rotation[rows], 1, 2)
            if rows.any() and not mirrored
            else None
        )
        found = align(seen, made, rotations=rotations, lever=_LEVER * self.robot.length, mirrored=mirrored)
        return replace(found, left=size((self.tip - pose.position @ found.rotation.T - found.shift)[pose.ok]))


def _declared(robot: Robot, found: CameraRegistration) -> bool:
    """Whether the robot file's [sensor] allows for a camera that is turned so far."""
    given = robot.sensor.get("registration_sd", 0.0)
    rotation = float(given[1]) if isinstance(given, (tuple, list)) else float(given)
    return found.angle < 3.0 * rotation


def _other_inputs(samples: LogSamples, robot: Robot, scale: float) -> Iterator[tuple[Floats, str]]:
    """Tendon lengths (n, n_tendons) as they may have been meant, and how in words."""
    dl, forces = samples.log.pulls, samples.log.tension is not None
    n, kind = dl.shape[1], "tension" if forces else "dl"
    if not n or not np.ptp(dl, axis=0).any():
        return
    if not forces:
        yield -dl, _words(np.arange(n), -np.ones(n), kind)
    if (found := column_order(samples, robot)) is not None:
        yield found.of(dl), _words(found.order, found.sign, kind)
    for i, j in combinations(range(n), 2):
        if n <= _FEW or j == i + 1:
            order = np.arange(n)
            order[[i, j]] = j, i
            yield dl[:, order], _words(order, np.ones(n), kind)
    for factor, words in (_FORCES if forces else _SCALES).items():
        # a rod that bends far moves less than in proportion: not the very factor
        fewer = not np.isfinite(scale) or scale < 1.0
        if (factor < 1.0) == fewer and (forces or factor * float(np.abs(dl).max()) < robot.length):
            yield factor * dl, f"every {kind}_ times {factor:.4g} ({words})"


def _words(order: Ints, sign: Floats, kind: str) -> str:
    """An order of the columns of a `kind` and their signs, as a user would say them."""
    moved = np.flatnonzero(order != np.arange(len(order))) + 1
    said = []
    if len(moved) == 2:
        said.append(f"{kind}_{moved[0]} and {kind}_{moved[1]} exchanged")
    elif len(moved):
        said.append(f"the {kind}_ columns in the order {', '.join(map(str, order + 1))}")
    reversed_ = np.sort(order[sign < 0.0]) + 1
    if len(reversed_) == len(order):
        said.append(f"the sign of every {kind}_ reversed")
    elif len(reversed_):
        said.append(f"the sign of {', '.join(f'{kind}_{k}' for k in reversed_)} reversed")
    return " and ".join(said)
