"""A UR5's soft tip on five paths: by both, by the arm alone, by the soft robot alone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fastrod import Simulator
from fastrod.control import FixedBase, ResolvedRate, SoftTip, Trajectory
from fastrod_scenes import load
from fastrod_scenes.ur5.soft_ur5 import DEPTH, DOWN, LARGEST_BEND, OFFSET, STRAIGHT, track_robot
from fastrod_scenes.ur5.tracking import APPROACH, PERIOD, Record, TrackingError, TrackingScene, record
from report import Row, Section, bench, goal, note_progress, table

ERROR_TARGET, FRACTION_TARGET = 1e-6, 0.5
"""Mean squared error after the approach [m^2], and the soft robot's fraction of the motion."""
SCENES = ("track_square", "track_circle", "track_figure_eight", "track_helix", "track_square_helix")
POINTS = 40  # of a period, for the soft robot's workspace
DEPTHS = np.arange(0.02, 0.235, 0.01)  # m, of a path's center below the base of the soft robot
SCALES = np.arange(1.0, 0.0, -0.05)  # of a path
NEAR = 1e-5  # a point this near is in the workspace [m]


class Workspace:
    """Inverse kinematics of the soft robot alone, its base fixed above a path's center and its tip down."""

    def __init__(self) -> None:
        self.tip = SoftTip(Simulator(track_robot(), threads=1), FixedBase((0.0, 0.0, 0.0, *DOWN)))
        self.low, self.high = self.tip.limits(LARGEST_BEND)
        # in the same metric as the tracks: extension by its range, bends by a radian
        weight = [1.0 / self.high[0] ** 2, 1.0 / OFFSET**2, 1.0 / OFFSET**2] * 2
        limits = {"lower": self.low, "upper": self.high, "error_limit": 0.02}
        self.control = ResolvedRate(gain=1.0, weight=weight, damping=1e-3, **limits)
        self.straight, self.bend = np.array(STRAIGHT), 1.5 * OFFSET

    def solve(self, target: Any, q: Any) -> Any:
        """Actions from q on that bring the resting tip within `NEAR` of the target (3,) [m], or None."""
        self.tip.simulator.reset()
        self.tip.place(q, settle=True)
        for _ in range(50):
            error = target - self.tip.position
            if np.linalg.norm(error) < NEAR:
                if not self.tip.place(q, settle=True).ok[0]:
                    return None
                if np.linalg.norm(target - self.tip.position) < NEAR:
                    return q
            rates = self.control.rates(q, self.tip.jacobian(), error, np.zeros(3), 1.0)
            q = np.clip(q + rates, self.low, self.high)
            if not self.tip.place(q).ok[0]:
                return None
        return None

    def points(self, path: Trajectory, depth: float, whole: bool) -> float:
        """Fraction of the path's points in the workspace; with `whole`, 0 after the first that is not."""
        start = np.array(path.center) + np.array([0.0, 0.0, depth])
        targets = path.position(np.arange(POINTS + 1) * path.period / POINTS) - start
        found, last = 0, []
        for target in targets:
            away = float(np.hypot(*target[:2]))
            x, y = target[:2] / away if away > 1e-6 else (1.0, 0.0)
            bent = np.array([self.high[0], self.bend * x, -self.bend * y, self.high[0], 0.0, 0.0])
            # short, its tip near the axis
            folded = self.bend * np.array([0.0, 0.6 * x, -0.6 * y, 0.0, -1.2 * x, 1.2 * y])
            tried = (self.solve(target, start) for start in (*last, bent, folded, self.straight))
            q = next((q for q in tried if q is not None), None)
            found, last = found + (q is not None), last if q is None else [q]
            if whole and q is None:
                return 0.0
        return found / len(targets)

    def best(self, scene: TrackingScene) -> tuple[float, float, float]:
        """Largest fraction of the path from one place of the base; the largest scale at which all of it is in
        the workspace; a depth for that."""
        most = max(self.points(scene.path(), depth, False) for depth in DEPTHS[::2])
        for scale in SCALES:
            depths = [depth for depth in DEPTHS if self.points(scene.path(scale), depth, True) == 1.0]
            if depths:
                return most, float(scale), float(depths[len(depths) // 2])
        return most, 0.0, 0.0


def played(name: str, seconds: float, *given: Any, **options: Any) -> tuple[Record, Row]:
    """One run, and its errors by name."""

    def steps(stage: TrackingError) -> Iterator[float]:
        try:
            for k in range(round(seconds / stage.dt)):
                stage.advance(k * stage.dt)
                yield (k + 1) * stage.dt
        finally:
            stage.close()

    note_progress(name)
    stage = TrackingError(*given, **options)
    run = record(stage, steps(stage))
    errors = {"after": run.mean_square(APPROACH), "with": run.mean_square(0.0, PERIOD)}
    return run, {f"{name}_{kind}": error for kind, error in errors.items()}


def track(name: str, workspace: Workspace | None, dt: float | None, seconds: float | None) -> Row:
    """One path by both, by the arm alone and by the soft robot alone, at the scale of `workspace`."""
    scene: Any = load(name)
    note_progress(name)
    dt, seconds = dt or scene.dt, seconds or scene.duration
    both, found = played("both", seconds, scene.path(), dt=dt)
    by_soft, by_arm = both.lengths(APPROACH)
    moved = both.soft_fraction(APPROACH)
    within, scale, depth = workspace.best(scene) if workspace else (1.0, 0.5, DEPTH)
    row: Row = {"path": scene.shape, "paper": scene.paper, "lag": both.lag, "clearance": both.clearance}
    row |= found | goal(found["both_after"], ERROR_TARGET, name="error_") | {"fraction": moved}
    row |= goal(moved, FRACTION_TARGET, least=True, name="fraction_")
    row |= {"by_soft": by_soft, "by_arm": by_arm, "within": within, "scale": scale, "depth": depth}
    row |= played("arm", seconds, scene.path(), dt=dt, movers="arm")[1]
    return row | played("soft", seconds, scene.path(scale), dt=dt, movers="soft", depth=depth)[1]


def measure(options: Any) -> list[Section]:
    """The tracks, and the parts of the motion."""
    workspace = None if options.quick else Workspace()
    seconds = 2.5 if options.quick else None
    names = SCENES[: 1 if options.quick else None]
    rows = [track(name, workspace, options.dt, seconds) for name in names]
    return [
        table(
            "tracking",
            "Mean squared error of the tip over time and x, y, z",
            "path | paper:.2e paper~m^2 | both_after:.1e both, after~approach m^2 | error_target:.0e target"
            "| error_met met | both_with:.1e with it~m^2 | arm_after:.1e arm alone,~after m^2"
            "| arm_with:.1e with it~m^2 | within:.2f soft alone:~in workspace | scale:.2f tracked~at scale"
            "| depth:.2f base above~center m | soft_after:.1e after~m^2 | soft_with:.1e with it~m^2",
            rows,
            "A period is 20 s. The tip begins at rest at the path's center (soft alone: straight below its "
            "base). With the approach: the first 20 s from the jump on; after it: 20 s from t = 2 s on.",
            "In workspace: fraction of the full-size path that inverse kinematics finds from the best "
            "height; then the largest scale at which it finds all, in steps of 0.05.",
            "The paper moves both; its figures are those of SoftManiSim (CoRL 2024).",
        ),
        table(
            "motion",
            "What moves the tip, after the approach",
            "path | fraction:.3f soft robot's~fraction | fraction_target:.1f target | fraction_met met"
            "| by_soft:.2f tip by soft~robot m | by_arm:.2f tip by arm~m | lag:.0e off rest~m"
            "| clearance:.3f clearance~m",
            rows,
            "Fraction: sum over the steps of displacement by the soft robot . displacement of the tip, over "
            "that of the displacement squared. Lengths: of the displacements by each alone. Off rest: "
            "largest distance of a step's tip from the rod at rest with the same inputs. Clearance: soft "
            "robot to the arm's links.",
        ),
    ]


main = bench(__doc__, measure, ("--dt", float, "time step [s], by default the scenes'"))
