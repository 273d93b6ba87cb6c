"""A UR5's soft tip on five paths: `fastrod bench tracking`, or this file as a script; `--json` for programs,
`--quick` for a smoke run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import report
from report import Column, Row, Section, note_progress

if TYPE_CHECKING:
    from fastrod.control import Trajectory
    from fastrod_scenes.ur5.tracking import Record, TrackingError, TrackingScene

ERROR_TARGET, SHARE_TARGET = 1e-6, 0.5
"""Mean squared error after the approach [m^2], and the soft robot's share of the motion."""
SCENES = ("track_square", "track_circle", "track_figure_eight", "track_helix", "track_square_helix")
POINTS = 40
"""Of a period, for reach."""
DEPTHS = np.arange(0.02, 0.235, 0.01)
"""Of a path's center below the base of the soft robot, for reach [m]."""
SCALES = np.arange(1.0, 0.0, -0.05)
"""Of a path, for reach."""
NEAR = 1e-5
"""A point this near is reached [m]."""


class Reach:
    """Inverse kinematics of the soft robot alone, its base fixed above a path's center and its tip down."""

    def __init__(self) -> None:
        from fastrod import Simulator
        from fastrod.control import FixedBase, ResolvedRate, SoftTip
        from fastrod_scenes.ur5.soft_ur5 import DOWN, LARGEST_BEND, OFFSET, STRAIGHT, track_robot

        self.tip = SoftTip(Simulator(track_robot(), threads=1), FixedBase((0.0, 0.0, 0.0, *DOWN)))
        self.low, self.high = self.tip.limits(LARGEST_BEND)
        # in the same metric as the tracks: extension by its range, bends by a radian
        weight = [1.0 / self.high[0] ** 2, 1.0 / OFFSET**2, 1.0 / OFFSET**2] * 2
        self.control = ResolvedRate(
            gain=1.0, lower=self.low, upper=self.high, weight=weight, error_limit=0.02, damping=1e-3
        )
        self.straight, self.bend = np.array(STRAIGHT), 1.5 * OFFSET

    def solve(self, goal: Any, q: Any) -> Any:
        """Actions from q on that bring the resting tip within `NEAR` of the goal (3,) [m], or None."""
        self.tip.simulator.reset()
        self.tip.place(q, settle=True)
        for _ in range(50):
            error = goal - self.tip.position
            if np.linalg.norm(error) < NEAR:
                state = self.tip.place(q, settle=True)
                if not state.ok[0]:
                    return None
                if np.linalg.norm(goal - self.tip.position) < NEAR:
                    return q
            q = np.clip(
                q + self.control.rates(q, self.tip.jacobian(), error, np.zeros(3), 1.0), self.low, self.high
            )
            if not self.tip.place(q).ok[0]:
                return None
        return None

    def points(self, path: Trajectory, depth: float, whole: bool) -> float:
        """Part of the path's points that are in reach; where the `whole` path is asked for, 0 after the first
        that is not."""
        start = np.array(path.center) + np.array([0.0, 0.0, depth])
        goals = path.position(np.arange(POINTS + 1) * path.period / POINTS) - start
        found, last = 0, None
        for goal in goals:
            away = float(np.hypot(*goal[:2]))
            x, y = goal[:2] / away if away > 1e-6 else (1.0, 0.0)
            bent = np.array([self.high[0], self.bend * x, -self.bend * y, self.high[0], 0.0, 0.0])
            # short, its tip near the axis
            folded = self.bend * np.array([0.0, 0.6 * x, -0.6 * y, 0.0, -1.2 * x, 1.2 * y])
            starts = [bent, folded, self.straight] if last is None else [last, bent, folded, self.straight]
            q = next((q for q in (self.solve(goal, start) for start in starts) if q is not None), None)
            found, last = found + (q is not None), q if q is not None else last
            if whole and q is None:
                return 0.0
        return found / len(goals)

    def best(self, scene: TrackingScene) -> tuple[float, float, float]:
        """Largest part of the path in reach from one place of the base; the largest scale at which all of it
        is; a depth for that."""
        part = max(self.points(scene.path(), depth, False) for depth in DEPTHS[::2])
        for scale in SCALES:
            depths = [depth for depth in DEPTHS if self.points(scene.path(scale), depth, True) == 1.0]
            if depths:
                return part, float(scale), float(depths[len(depths) // 2])
        return part, 0.0, 0.0


def steps(stage: TrackingError, seconds: float) -> Iterator[float]:
    """Advance the stage, t [s] by t, and close it."""
    try:
        for k in range(round(seconds / stage.dt)):
            stage.advance(k * stage.dt)
            yield (k + 1) * stage.dt
    finally:
        stage.close()


def figures(name: str, run: Record) -> Row:
    """Errors of one run."""
    from fastrod_scenes.ur5.tracking import APPROACH, PERIOD

    return {f"{name}_after": run.mean_square(APPROACH), f"{name}_with": run.mean_square(0.0, PERIOD)}


def row(name: str, reach: Reach | None, dt: float | None, seconds: float | None) -> Row:
    """One path by both, by the arm alone and by the soft robot alone; without `reach` the last as far as it
    needs no search."""
    from fastrod_scenes import load
    from fastrod_scenes.ur5.soft_ur5 import DEPTH
    from fastrod_scenes.ur5.tracking import APPROACH, TrackingError, TrackingScene, record

    scene = load(name)
    assert isinstance(scene, TrackingScene)
    dt, seconds = dt or scene.dt, seconds or scene.duration
    note_progress(f"{name}: both")
    both = record(stage := TrackingError(scene.path(), dt=dt), steps(stage, seconds))
    by_soft, by_arm = both.lengths(APPROACH)
    after, part = both.mean_square(APPROACH), both.soft_fraction(APPROACH)
    found: Row = {
        "path": scene.shape,
        "paper": scene.paper,
        **figures("both", both),
        "error_target": ERROR_TARGET,
        "error_met": after <= ERROR_TARGET,
        "share": part,
        "share_target": SHARE_TARGET,
        "share_met": part >= SHARE_TARGET,
        "by_soft": by_soft,
        "by_arm": by_arm,
        "lag": both.lag,
        "clearance": both.clearance,
    }
    note_progress(f"{name}: the arm alone")
    found |= figures(
        "arm", record(stage := TrackingError(scene.path(), dt=dt, movers="arm"), steps(stage, seconds))
    )
    note_progress(f"{name}: the soft robot alone")
    reached, scale, depth = reach.best(scene) if reach else (1.0, 0.5, DEPTH)
    alone = record(
        stage := TrackingError(scene.path(scale), dt=dt, movers="soft", depth=depth), steps(stage, seconds)
    )
    found |= {"reach": reached, "scale": scale, "depth": depth, **figures("soft", alone)}
    return found


def tracking_sections(quick: bool, dt: float | None) -> list[Section]:
    """The tracks, and who moved the tip."""
    reach = None if quick else Reach()
    rows = [row(name, reach, dt, 2.5 if quick else None) for name in SCENES[: 1 if quick else None]]
    errors = [
        Column("path", "path"),
        Column("paper", "paper\nm^2", ".2e"),
        Column("both_after", "both, after\napproach m^2", ".1e"),
        Column("error_target", "target", ".0e"),
        Column("error_met", "met"),
        Column("both_with", "with it\nm^2", ".1e"),
        Column("arm_after", "arm alone,\nafter m^2", ".1e"),
        Column("arm_with", "with it\nm^2", ".1e"),
        Column("reach", "soft alone:\nin reach", ".2f"),
        Column("scale", "tracked\nat scale", ".2f"),
        Column("depth", "base above\ncenter m", ".2f"),
        Column("soft_after", "after\nm^2", ".1e"),
        Column("soft_with", "with it\nm^2", ".1e"),
    ]
    shares = [
        Column("path", "path"),
        Column("share", "soft fraction", ".3f"),
        Column("share_target", "target", ".1f"),
        Column("share_met", "met"),
        Column("by_soft", "tip by soft\nrobot m", ".2f"),
        Column("by_arm", "tip by arm\nm", ".2f"),
        Column("lag", "off rest\nm", ".0e"),
        Column("clearance", "clearance\nm", ".3f"),
    ]
    return [
        Section(
            "tracking",
            "Mean squared error of the tip over time and x, y, z",
            errors,
            rows,
            [
                "A period is 20 s. The goal is on the path from t = 0 on, the tip rests at the path's center "
                "(soft alone: straight below its "
                "base). With the approach: the first 20 s from the jump on; after it: 20 s from t = 2 s on.",
                "Soft alone: the UR5's joints are held, the base is above the center. In reach: part of the "
                "full-size path that inverse "
                "kinematics finds from the best height; then the largest scale at which it finds all, in "
                "steps "
                "of 0.05.",
                "The paper moves both; its figures are those of SoftManiSim (CoRL 2024).",
            ],
        ),
        Section(
            "motion",
            "Who moves the tip, after the approach",
            shares,
            rows,
            [
                "Share: sum over the steps of way by the soft robot . way of the tip, over that of the way "
                "squared. Lengths: of the ways by "
                "each alone. Off rest: largest distance of a step's tip from the rod at rest with the same "
                "inputs. Clearance: soft robot to "
                "the arm's links."
            ],
        ),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_tracking", description=__doc__)
    parser.add_argument("--dt", type=float, help="time step [s], by default the scenes'")
    return report.command(parser, argv, lambda options: tracking_sections(options.quick, options.dt))


if __name__ == "__main__":
    sys.exit(main())
