"""Control of a soft tip on an arm, by the analytic Jacobian and by the paper's finite differences."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from fastrod import Robot, Segment, Simulator, Tendon
from fastrod.control import ResolvedRate, SoftTip, circle
from report import Row, Section, bench, goal, note_progress, seconds, table

RATE_TARGET, RATIO_TARGET = 1000.0, 20.0
"""Control steps a second, and how many times as fast as with finite differences; one thread."""
DT = 0.01
_A = np.array([0.0, -0.425, -0.39225, 0.0, 0.0, 0.0])
_D = np.array([0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823])
_SA = np.array([1.0, 0.0, 0.0, 1.0, -1.0, 0.0])
"""A UR5: a [m], d [m], sine of alpha of each joint (Denavit and Hartenberg), as the maker prints them."""
_CA = 1.0 - np.abs(_SA)


class SerialArm:
    """A six-joint arm in plain numpy, which stands in for a rigid-body library."""

    n_joints = 6

    def __init__(self) -> None:
        self._q, self._frames, self._links = np.full(6, np.nan), np.zeros((7, 4, 4)), np.zeros((6, 4, 4))
        self._links[:, 2:, 1:] = np.moveaxis([[_SA, _CA, _D], [0.0 * _D, 0.0 * _D, 1.0 + 0.0 * _D]], -1, 0)

    def _chain(self, q: Any) -> Any:
        """(7, 4, 4) world from each joint's frame."""
        if np.array_equal(q, self._q):
            return self._frames
        links, c, s = self._links, np.cos(q), np.sin(q)
        links[:, 0, 0], links[:, 0, 1], links[:, 0, 2], links[:, 0, 3] = c, -s * _CA, s * _SA, _A * c
        links[:, 1, 0], links[:, 1, 1], links[:, 1, 2], links[:, 1, 3] = s, c * _CA, -c * _SA, _A * s
        frames = np.empty((7, 4, 4))
        frames[0] = np.eye(4)
        for i in range(6):
            np.matmul(frames[i], links[i], out=frames[i + 1])
        self._q, self._frames = np.array(q), frames
        return frames

    def frame(self, q: Any) -> Any:
        end = self._chain(q)[-1]
        (a, b, c), (d, e, f), (g, h, i) = end[:3, :3].tolist()
        # four times the largest component times the quaternion (Shepperd 1978)
        rows = (
            (1 + a + e + i, h - f, c - g, d - b),
            (h - f, 1 + a - e - i, b + d, c + g),
            (c - g, b + d, 1 - a + e - i, f + h),
            (d - b, c + g, f + h, 1 - a - e + i),
        )
        found = rows[max(range(4), key=lambda k: rows[k][k])]
        size = math.hypot(*found)
        return np.array([*end[:3, 3].tolist(), *(x / size for x in found)])

    def jacobian(self, q: Any) -> Any:
        frames = self._chain(q)
        z, arm = frames[:6, :3, 2].T, (frames[6, :3, 3] - frames[:6, :3, 3]).T
        cross = [z[1] * arm[2] - z[2] * arm[1], z[2] * arm[0] - z[0] * arm[2], z[0] * arm[1] - z[1] * arm[0]]
        return np.concatenate([cross, z])


class Loop:
    """A tip that follows a circle: six joints, two segments of four tendons, six intervals a segment."""

    def __init__(self) -> None:
        tendons = tuple(Tendon(offset=0.0075, angle=k * np.pi / 2) for k in range(4))
        stiffness: Any = {"bending_stiffness": (0.0022, 0.0022), "torsional_stiffness": 0.001}
        segment = Segment(length=0.1, extension=(0.0, 0.03), line_density=0.1, tendons=tendons, **stiffness)
        robot = Robot(name="two", segments=(segment, segment))
        self.tip = SoftTip(Simulator(robot, dt=DT, points_per_segment=6, threads=1), SerialArm())
        self.q = np.array([0.3, -1.2, 1.4, -0.9, -1.1, 0.4, 0.015, 0.002, -0.001, 0.015, -0.001, 0.002])
        low, high = self.tip.limits()
        limits = {"lower": [-6.3] * 6 + low.tolist(), "upper": [6.3] * 6 + high.tolist()}
        limits["rate"] = [2.0] * 6 + [0.05] * 6
        self.control = ResolvedRate(gain=5.0, weight=[1.0] * 6 + [25.0] * 6, **limits)
        start = self.tip.place(self.q, settle=True).tip_position[0]
        self.path, self.t = circle(radius=0.05, center=start - [0.05, 0.0, 0.0]), 0.0

    def step(self, jacobian: Callable[[], Any]) -> tuple[float, float, float, float]:
        """One control step; seconds of place, Jacobian and rates, and the error of the tip [m]."""
        target, velocity = self.path.position(self.t), self.path.velocity(self.t)
        began = time.perf_counter()
        self.tip.place(self.q)
        at_place = time.perf_counter()
        J = jacobian()
        known = time.perf_counter()
        error = target - self.tip.position
        self.q = self.q + DT * self.control.rates(self.q, J, error, velocity, DT)
        done = time.perf_counter()
        self.t += DT
        return at_place - began, known - at_place, done - known, float(np.linalg.norm(error))


def follow(loop: Loop, jacobian: Callable[[], Any], steps: int) -> Row:
    """Medians over so many steps, after some that are not counted."""
    for _ in range(min(20, steps)):
        loop.step(jacobian)
    _, taken = seconds(lambda: [loop.step(jacobian) for _ in range(steps)])
    place, derive, rates, error = (statistics.median(column) for column in zip(*taken, strict=True))
    total = statistics.median(a + b + c for a, b, c, _ in taken)
    times = {"place_us": 1e6 * place, "jacobian_us": 1e6 * derive, "rates_us": 1e6 * rates}
    return {"rate": 1.0 / total, "total_us": 1e6 * total, **times, "error_m": error, "steps": steps}


def measure(options: Any) -> list[Section]:
    """The same loop with the analytic Jacobian and with finite differences."""
    loop, twin = Loop(), Loop()
    note_progress("the analytic Jacobian")
    exact = follow(loop, loop.tip.jacobian, 50 if options.quick else 1500)
    note_progress("finite differences")
    slow = follow(twin, lambda: twin.tip.finite_differences(twin.q), 5 if options.quick else 100)
    ratio = slow["total_us"] / exact["total_us"]
    exact |= goal(exact["rate"], RATE_TARGET, least=True, name="rate_")
    exact |= {"ratio": ratio, **goal(ratio, RATIO_TARGET, least=True, name="ratio_")}
    return [
        table(
            "control_step",
            "One control step",
            "kind Jacobian | rate:,.0f control steps/s~1 thread | rate_target:,.0f target | rate_met met"
            "| ratio:.1f times as fast~as differences | ratio_target:.0f target | ratio_met met"
            "| total_us:,.0f step~us | place_us:,.0f place~us | jacobian_us:,.0f Jacobian~us"
            "| rates_us:,.0f rates~us | error_m:.1e error [m]~median | steps:d",
            [{"kind": "analytic", **exact}, {"kind": "finite differences", **slow}],
            "Two segments of 100 mm, four tendons and extension; a circle of 50 mm in 20 s, 100 control "
            "steps a second of its time. Medians, warm.",
            "Place: the arm's frame, tendon lengths of the action and one step of the rod. Differences: "
            "central, 24 settled tips, from the same snapshot.",
        )
    ]


main = bench(__doc__, measure)
