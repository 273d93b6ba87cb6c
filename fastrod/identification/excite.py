"""The run that separates effects: which way to move a robot, so that its log can tell what the model lacks.

Rest; four blocks in base orientations A-B-B-A with a known load off-on-off-on; rest; the first block's start
again. Each block moves one segment at a time and then all, in triangles of decreasing amplitude, circles,
holds and at random. Which phase separates which pair of effects was measured on simulated logs by leaving it
out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fastrod.errors import InputError
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.rotation import matrix_from_quaternion, product
from fastrod.types import Floats

REST = 12.0  # s
_PAUSE = 1.5  # s, for turning the base and hanging the load
_HOLD = 4.0  # s
_RANDOM = 10.0  # s
_REPEAT = 20.0  # s of the first block, at the end
_RANGES = {"bend": (0.01, 3.0), "rate": (0.5, 1000.0), "speed": (0.01, 100.0)}
"""Ranges that make a run of some rows and of less than a gigabyte [rad], [Hz], [rad/s]."""
_LADDER = (1.0, 0.6, 0.28)  # of the largest bend: triangles of decreasing amplitude


@dataclass(frozen=True)
class MotionPhase:
    """A stretch of the run, and what it is for."""

    name: str
    start: float
    """[s]."""
    end: float
    """[s]."""
    purpose: str


@dataclass(frozen=True, eq=False)
class Excitation:
    """A run to be driven: inputs as a log whose tip is empty, and its parts."""

    log: RunLog
    phases: tuple[MotionPhase, ...]

    @property
    def comment(self) -> str:
        """The parts as text, a line each."""
        lines = [
            f"{phase.start:7.1f} to {phase.end:6.1f} s  {phase.name}: {phase.purpose}"
            for phase in self.phases
        ]
        return (
            "Inputs of a run that separates effects; drive them, fill tip_x tip_y tip_z, and give the file "
            "to fastrod identify.\n" + "\n".join(lines)
        )


def excitation(
    robot: Robot,
    *,
    bend: float = 0.9,
    payload: float | None = None,
    turn: bool = True,
    rate: float = 15.0,
    speed: float = 1.0,
    seed: int = 1,
) -> Excitation:
    """The run for `robot`: largest bend of a segment `bend` [rad], known tip mass `payload` [kg] on and off,
    samples at `rate` [Hz], triangles at `speed` [rad/s]. Without `payload`, one that bends the robot well but
    does not make it snap, F l^2 / EI = 1. Without
    `turn` the base stays as it is, where a bench cannot be turned.

    Raises `InputError` for a robot that tendons do not drive, or for numbers that are not positive.
    """
    if not robot.n_tendons:
        raise InputError(f"robot {robot.name!r} has no tendons; there is nothing to excite.")
    for name, value, unit in (("bend", bend, "rad"), ("rate", rate, "Hz"), ("speed", speed, "rad/s")):
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"{name} is {value!r} {unit}; it must be positive.")
        low, high = _RANGES[name]
        if value < low or (value > high and name != "bend"):
            raise InputError(f"{name} is {value!r} {unit}; it must be between {low:g} and {high:g} {unit}.")
    if payload is None:
        softest = min(min(segment.bending_stiffness) for segment in robot.segments)
        payload = round(softest / robot.length**2 / 9.81, 3)
    if not 0.0 <= payload <= 10.0:
        raise InputError(f"payload is {payload!r} kg; it must be between 0 and 10 kg.")
    if bend > _RANGES["bend"][1]:
        raise InputError(f"bend is {bend!r} rad; a segment bends by 3 rad at most. Was it given in degrees?")
    wiring = route(robot)
    rng = np.random.default_rng(seed)
    rows: list[Floats] = []
    phases: list[MotionPhase] = []

    def add(name: str, what: Floats, purpose: str) -> None:
        start = sum(len(r) for r in rows) / rate
        rows.append(what)
        phases.append(MotionPhase(name, start, start + len(what) / rate, purpose))

    def still(seconds: float) -> Floats:
        return np.zeros((round(seconds * rate), n_sections, 2))

    each = wiring.of_sections(wiring.bend(np.eye(robot.n_tendons)))  # of a pull of each tendon alone
    n_sections = each.shape[1]
    blocks = [_block(n_sections, bend, rate, speed, number, rng) for number in range(4)]
    add("rest", still(REST), "noise of the camera, zero of the drives")
    turned, loaded = [np.zeros(len(rows[0]), bool)], [np.zeros(len(rows[0]), bool)]
    for number, (pieces, other, load) in enumerate(
        zip(blocks, (False, True, True, False), (False, True, False, True), strict=True)
    ):
        other = other and turn
        label = f"block {number + 1}, base {'B' if other else 'A'}{', load on' if load and payload else ''}"
        before = sum(len(r) for r in rows)
        add(
            f"{label}: pause",
            still(_PAUSE),
            "turn the base and hang the load: gravity against frame and precurvature, stretch against gain",
        )
        for name, what, purpose in pieces:
            add(f"{label}: {name}", what, purpose)
        added = sum(len(r) for r in rows) - before
        turned.append(np.full(added, other))
        loaded.append(np.full(added, load))
    first = np.concatenate([what for _, what, _ in blocks[0]])[: round(_REPEAT * rate)]
    add("rest", still(REST), "the same again: slow drift, plastic set")
    add(
        "repeat",
        first,
        "the start of the first block again: drift, temperature, plastic set, a base that slipped",
    )
    add("return", _line(first[-1], np.zeros_like(first[-1]), bend, rate, speed), "back to rest")
    path = np.concatenate(rows)
    pulls: Floats = path.reshape(len(path), -1) @ np.linalg.pinv(each.reshape(robot.n_tendons, -1))
    rest = len(path) - sum(len(a) for a in turned)
    turned.append(np.zeros(rest, bool))
    loaded.append(np.zeros(rest, bool))
    own = np.array(robot.base_quaternion)
    down = matrix_from_quaternion(own).T @ np.array(robot.gravity)
    # about the base's x, or y where x is the steeper: gravity must change
    quarter = np.zeros(4)
    quarter[[0, 1 + int(abs(down[1]) < abs(down[0]))]] = np.sqrt(0.5)
    tilted = product(own, quarter) if turn else own
    log = RunLog(
        name=f"{robot.name}_excitation",
        t=np.arange(len(path)) / rate,
        run=np.full(len(path), ""),
        dl=np.zeros_like(pulls) if robot.by_tension else np.round(pulls, 9),
        tension=np.round(_pulling(-pulls, robot), 6) if robot.by_tension else None,
        tip_position=np.full((len(path), 3), np.nan),
        payload=np.where(np.concatenate(loaded), payload, 0.0),
        base_quaternion=np.where(np.concatenate(turned)[:, None], tilted, own),
    )
    return Excitation(log, tuple(phases))


def _pulling(force: Floats, robot: Robot) -> Floats:
    """Forces (n, n_tendons) that bend alike [N], with none below 0 on tendons that only pull: those of a
    segment have a force in common."""
    made, ends = force.copy(), np.asarray(robot.tendon_segment)
    for end in np.unique(ends):
        own = ends == end
        if any(t.unilateral for t, mine in zip(robot.tendons, own, strict=True) if mine):
            made[:, own] -= made[:, own].min(axis=1, keepdims=True)
    return made


def _block(
    n: int, bend: float, rate: float, speed: float, number: int, rng: np.random.Generator
) -> list[tuple[str, Floats, str]]:
    """Pieces of one block, each (name, (n, n_segments, 2) bends [rad], purpose), from straight to
    straight."""
    zero = np.zeros((n, 2))
    pieces: list[tuple[str, Floats, str]] = []
    for k in range(n):
        direction = number * np.pi / 2.0 + k * np.pi / 4.0
        unit = np.zeros((n, 2))
        unit[k] = np.cos(direction), np.sin(direction)
        corners = [
            zero,
            *(side * fraction * bend * unit for fraction in _LADDER for side in (1.0, -1.0)),
            zero,
        ]
        alone = f" of segment {k + 1} alone" if n > 1 else ""
        pieces.append(
            (
                f"triangles{alone}",
                _through(corners, bend, rate, speed),
                "friction against backlash and slack, by reversals of many sizes",
            )
        )
    slow = number % 2 == 0
    circles = _circle(n, 0.75 * bend, rate, 6.0 if slow else 2.5, 1.0 if slow else -1.0)
    approach = _through([zero, circles[0]], bend, rate, speed)
    back = _through([circles[-1], zero], bend, rate, speed)
    pieces.append(
        (
            "slow circle" if slow else "fast circle",
            np.concatenate([approach, circles, back]),
            "routing, anisotropy; two speeds: latency and lag against creep",
        )
    )
    for hold in range(3):
        angle = 2.0 * np.pi * (hold / 3.0 + number / 4.0) + np.arange(n)
        place = bend * (1.0, 0.55, 0.85)[hold] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        jump = _through([zero, place], bend, rate, 3.0 * speed)
        stay = np.broadcast_to(place, (round(_HOLD * rate), n, 2))
        pieces.append(
            (
                f"step and hold {hold + 1}",
                np.concatenate([jump, stay, _through([place, zero], bend, rate, 3.0 * speed)]),
                "creep against friction and drift",
            )
        )
    pieces.append(("random", _random(n, bend, rate, rng), "everything else; coverage of the workspace"))
    return pieces


def _line(start: Floats, end: Floats, bend: float, rate: float, speed: float) -> Floats:
    """Straight from start (excluded) to end at `speed`."""
    distance = float(np.linalg.norm(end - start, axis=-1).max())
    steps = max(2, int(np.ceil(max(distance, 0.02 * bend) / speed * rate)))
    fraction = (np.arange(1, steps + 1) / steps)[:, None, None]
    return np.asarray(start + fraction * (end - start))


def _through(corners: list[Floats], bend: float, rate: float, speed: float) -> Floats:
    return np.concatenate([_line(a, b, bend, rate, speed) for a, b in pairwise(corners)])


def _circle(n: int, radius: float, rate: float, period: float, sense: float) -> Floats:
    angle = sense * 2.0 * np.pi * np.arange(1, round(period * rate) + 1) / (period * rate)
    phase = angle[:, None] + np.arange(n) * np.pi / 2.0
    return radius * np.stack([np.cos(phase), np.sin(phase)], axis=-1)


def _random(n: int, bend: float, rate: float, rng: np.random.Generator) -> Floats:
    """Smooth noise of up to 1 Hz that begins and ends straight."""
    steps = round(_RANDOM * rate)
    t = np.arange(1, steps + 1) / rate
    frequency = rng.uniform(0.1, 1.0, (8, n, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (8, n, 2))
    noise = np.sin(2.0 * np.pi * frequency * t[:, None, None, None] + phase).sum(1) / np.sqrt(8.0)
    window = np.minimum(1.0, np.minimum(t, t[-1] - t) / 1.0)[:, None, None]
    wave = 0.6 * bend * noise * window
    size = np.linalg.norm(wave, axis=-1, keepdims=True)
    return np.asarray(wave * np.minimum(1.0, bend / np.maximum(size, 1e-12)))
