"""Random jumps of the tendons of heavy upright robots in motion: is one lost, not finite, or given energy?

python perf/motion_steps.py --steps 1000000 --seed 1 --minutes 60. Exit code 1 where a number is not finite,
or a robot is lost whose step two steps of half the time take.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cases import Array
from fastrod import Robot, Simulator, State, load_robot
from report import Row, Section, bench, note_progress, table

N_ROBOTS = 64
LINE_DENSITY = 0.3  # kg/m: three times what five segments would hold up without their tendons
JUMP = 20.0  # N: the most that a tendon's tension jumps by
OFTEN = 0.05  # of the robots jump in a step
GROWN = 0.01  # of the energy of one tendon (1e-5 m/N) at JUMP, 2 mJ: what counts as growth
_PRETENSION = 1.0  # N, of tendons that only pull


def upright(slack: bool) -> Robot:
    """Five segments of the prototype, three tendons each that pull and push, or only pull."""
    prototype = load_robot("prototype")
    (segment,) = prototype.segments
    segments = []
    for k in range(5):
        some: dict[str, Any] = {"unilateral": slack, "pretension": _PRETENSION * slack}
        tendons = tuple(
            replace(t, offset=(0.0075,) * (k + 1), angle=(2.0 * np.pi / 3.0 * i + 0.4 * k,) * (k + 1), **some)
            for i, t in enumerate(segment.tendons[:3])
        )
        segments.append(replace(segment, tendons=tendons, line_density=LINE_DENSITY))
    return replace(prototype, name="upright", segments=tuple(segments), gravity=(0.0, 0.0, -9.81))


def energy(robot: Robot, state: State) -> Array:
    """(n_robots,) kinetic, of backbone and tendons, and of weight [J]; only steps in time take from it."""
    assert state.kinetic_energy is not None
    assert state.strain_energy is not None
    compliance = np.array([tendon.compliance for tendon in robot.tendons])
    tendons = 0.5 * (compliance * state.tension**2).sum(1)
    n = len(robot.segments)
    s = state.arclength.reshape(len(state.arclength), -1)
    m = (s.shape[1] - 1) // n
    simpson = np.ones(m + 1)
    simpson[1:-1] = np.where(np.arange(1, m) % 2, 4.0, 2.0)
    z = state.position[:, :, 2]
    weight = np.zeros(len(z))
    for k in range(n):
        here = slice(k * m, (k + 1) * m + 1)
        h = (s[:, (k + 1) * m] - s[:, k * m]) / m
        weight += 9.81 * LINE_DENSITY * h / 3.0 * (z[:, here] @ simpson)
    return np.asarray(state.kinetic_energy + state.strain_energy + tendons + weight)


@dataclass
class Count:
    """Counts of the robots of one campaign."""

    steps: int = 0  # robot-steps
    lost: int = 0
    solvable: int = 0  # of those, which two steps of half the time take
    not_finite: int = 0  # robot-steps that are ok and have a number that is not finite
    passes: int = 0
    most: int = 0  # passes of a step
    holds: int = 0  # from a jump to the next: no work is done on the robot
    grown: int = 0  # of those, at whose end there is more energy than at their first step
    growth: float = 0.0  # the most of that [J]
    peaks: int = 0  # steps of a hold with more energy than its first, and gone with the next step
    peak: float = 0.0  # the most of that [J]


class Holds:
    """Energy of every robot [J]: at the first step after its last jump, and at the last two steps."""

    def __init__(self, count: Count, first: Array) -> None:
        self.count, self.first, self.before, self.last = count, first, first, first
        self.steps = np.full(len(first), -1)  # since the jump; below 0 until one came and nothing was lost

    def note(self, now: Array, ok: Any, jumped: Any) -> None:
        enough = GROWN * 0.5 * 1e-5 * JUMP**2
        ended = jumped & (self.steps > 1)
        growth = np.minimum(self.last, self.before) - self.first  # a peak at the very end is one
        self.count.holds += int(ended.sum())
        self.count.grown += int((growth[ended] > enough).sum())
        self.count.growth = max(self.count.growth, float(growth[ended].max(initial=0.0)))
        inside = ~jumped & (self.steps > 1)
        peak = self.last - np.maximum(now, self.before)
        self.count.peaks += int((peak[inside] > enough).sum())
        self.count.peak = max(self.count.peak, float(peak[inside].max(initial=0.0)))
        self.first = np.where(jumped, now, self.first)
        self.before, self.last = self.last, now
        self.steps = np.where(jumped, 0, np.where(self.steps >= 0, self.steps + 1, -1))
        self.steps[~ok] = -1


def run(slack: bool, dt: float, steps: int, seed: int, until: float) -> Count:
    """At most so many robot-steps, and none after `until` [s of the clock]."""
    robot, rng, count = upright(slack), np.random.default_rng(seed), Count()
    sim, half = (Simulator(robot, N_ROBOTS, one, 4, dynamics=True) for one in (dt, 0.5 * dt))
    rest = robot.rest_tendon_length
    state = sim.settle(rest)
    half.settle(rest)
    if not state.ok.all():
        raise RuntimeError(f"{int((~state.ok).sum())} of {N_ROBOTS} upright robots do not stand.")
    change = np.zeros((N_ROBOTS, robot.n_tendons))
    holds = Holds(count, energy(robot, state))
    compliance = np.array([tendon.compliance for tendon in robot.tendons])
    while count.steps < steps and time.monotonic() < until:
        jumped, before, then = rng.random(N_ROBOTS) < OFTEN, change.copy(), sim.snapshot()
        jumps = compliance * rng.uniform(-JUMP, JUMP, change.shape) / 2.0
        if (
            not slack
        ):  # without the mean, which nothing answers in a rod that has one length; still within JUMP
            each = jumps.reshape(N_ROBOTS, 5, 3)
            jumps = 0.75 * (each - each.mean(2, keepdims=True)).reshape(change.shape)
        change[jumped] = jumps[jumped]
        state = sim.step(rest + change)
        count.steps += N_ROBOTS
        count.passes += int(state.passes[state.ok].sum())
        count.most = max(count.most, int(state.passes.max()))
        numbers = state.position, state.velocity, state.tension, state.kinetic_energy
        finite = np.all(
            [np.isfinite(a.reshape(N_ROBOTS, -1)).all(1) for a in numbers if a is not None], axis=0
        )
        count.not_finite += int((~finite & state.ok).sum())
        if (lost := ~state.ok).any():
            half.restore(then)
            first, second = half.step(rest + 0.5 * (before + change)), half.step(rest + change)
            count.lost += int(lost.sum())
            count.solvable += int((lost & first.ok & second.ok).sum())
        holds.note(energy(robot, state), state.ok, jumped)
    return count


def measure(options: Any) -> list[Section]:
    rows: list[Row] = []
    kinds = [(slack, dt) for slack in (False, True) for dt in (1e-3, 1e-2)]
    steps = 4 * 3 * N_ROBOTS if options.quick else options.steps
    failed = False
    for slack, dt in kinds:
        note_progress(f"tendons that {'only pull' if slack else 'push, too'}, {1e3 * dt:g} ms")
        start = time.monotonic()
        count = run(slack, dt, steps // 4, options.seed, start + 60.0 * options.minutes / 4.0)
        row: Row = {"tendons": "only pull" if slack else "pull and push", "ms": 1e3 * dt, **vars(count)}
        row["passes"] = count.passes / max(count.steps - count.lost, 1)
        rows.append(row | {"seconds": time.monotonic() - start})
        failed = failed or count.not_finite > 0 or count.solvable > 0
    return [
        table(
            "motion_steps",
            "Random jumps of the tendons of heavy upright robots in motion",
            "tendons | ms:g dt~[ms] | steps:,d robot-~steps | lost:,d | solvable:,d of them, half~a step "
            "solves| not_finite:,d not~finite | passes:.2f passes~/ step | most:d at~most | holds:,d"
            "| grown:,d energy~grew | growth:.1e at most~[J] | peaks:,d peaks of~one step | peak:.1e at "
            "most~[J]| seconds:.0f s",
            rows,
            f"{N_ROBOTS} robots of five segments of the prototype, {LINE_DENSITY:g} kg/m, base below, "
            f"fifteen tendons; in a step {OFTEN:.0%} of them are commanded anew, a jump of up to {JUMP:g} N "
            "in each tendon. Generalized-alpha, rho 0.5, as a simulator has it; it halves a step by itself "
            "where Newton's method does not end.",
            "A hold is from one jump of a robot to its next: nothing works on it, so that its energy "
            "(kinetic, of backbone, tendons and weight) must not grow. It grew where there is more at the "
            f"end than after the first step, by over {GROWN:.0%} of what one tendon holds at {JUMP:g} N (2 "
            "mJ). Peaks: as much for one step alone, where a tendon goes slack or taut in the one Newton "
            "step that was taken, so that its tension is not yet that of the path.",
            failed=failed,
        )
    ]


main = bench(
    __doc__,
    measure,
    ("--steps", 1_000_000, "robot-steps in all"),
    ("--seed", 1, "of the jumps"),
    ("--minutes", 60.0, "no longer than so many"),
)
