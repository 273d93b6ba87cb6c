"""The tip of a soft robot on a UR5 follows five paths (SoftManiSim, CoRL 2024), and how much of its motion is
by each of the two."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NamedTuple, final

import numpy as np

from fastrod.control import Trajectory, trajectory
from fastrod.types import Floats
from fastrod_scenes.scene import HostedScene, SceneStage
from fastrod_scenes.ur5.soft_ur5 import DEPTH, Movers, SoftUR5

CENTER = (0.5, 0.0, 0.3)
"""Center of the paths, world [m]."""
PERIOD = 20.0
"""Period of a path [s]."""
APPROACH = 2.0
"""The tip starts from the center while the goal is on the path from t = 0 on; from here on it must have
caught up [s]."""
LARGEST_ERROR = 1e-6
"""Mean square, over time and over x, y and z [m^2]."""
LEAST_FRACTION = 0.5
"""Least fraction of the motion by the soft robot."""
LEAST_CLEARANCE = 0.005
"""Least clearance of the soft robot from the arm [m]."""
LARGEST_LAG = 2e-4
"""Largest distance of a step's tip from where it would come to rest [m]."""
_SAMPLE = 0.5  # s, between two looks at clearance and lag


class Record(NamedTuple):
    """A run: a row is what there is at the end of a step, and what the step did."""

    t: Floats
    """(n,) [s]."""
    goal: Floats
    """(n, 3) world [m]."""
    tip: Floats
    """(n, 3) world [m]."""
    displacement: Floats
    """(n, 3) of the tip in the step [m]."""
    by_soft: Floats
    """(n, 3) the component of it by the soft robot (`ArmStep`) [m]."""
    by_arm: Floats
    """(n, 3) the component of it by the arm [m]."""
    q: Floats
    """(n, 12)."""
    clearance: float
    """Least, of the soft robot from the arm [m]."""
    lag: float
    """Largest after the approach, of the tip from where it would come to rest [m]."""

    def mean_square(self, start: float, end: float = np.inf) -> float:
        """Mean square of the tip's error between two times [s], mean over the steps and over x, y and z
        [m^2]."""
        on = (self.t > start + 1e-9) & (self.t <= end + 1e-9)
        return float(((self.goal - self.tip)[on] ** 2).mean())

    def soft_fraction(self, start: float) -> float:
        """Return `fraction_of` the soft robot's motion, from a time [s] on."""
        on = self.t > start + 1e-9
        return fraction_of(self.by_soft[on], self.displacement[on])

    def lengths(self, start: float) -> tuple[float, float]:
        """Lengths of the tip's paths by the soft robot alone and by the arm alone, from a time [s] on [m]."""
        on = self.t > start + 1e-9
        by_soft, by_arm = (
            float(np.linalg.norm(component[on], axis=1).sum()) for component in (self.by_soft, self.by_arm)
        )
        return by_soft, by_arm


def fraction_of(component: Floats, displacement: Floats) -> float:
    """Return the fraction of the tip's motion by one of those that move it: sum of component . displacement
    over the sum of displacement . displacement, both (n, 3), step by step [m]. The fractions of all add up to
    1; one that moves across the path has none, one that works against it less."""
    return float((component * displacement).sum() / (displacement * displacement).sum())


@final
class TrackingError(SceneStage):
    """The UR5 and its soft robot, whose tip is sent along a path."""

    def __init__(self, path: Trajectory, *, dt: float, movers: Movers = "both", depth: float = DEPTH) -> None:
        """`depth`: of the path's center below the soft robot's base at the start [m]."""
        self.path, self.dt = path, dt
        self.robot = SoftUR5(dt=dt, tip=path.center, depth=depth, movers=movers)
        self.world, self.rods, self.arm = self.robot.world, (self.robot.rod,), self.robot.arm
        self.tip: Floats = self.robot.tip()
        """(3,) measured, world [m]."""
        self.steps: list[tuple[Floats, ...]] = []
        """Goal, tip, displacement, displacement by the soft robot, displacement by the arm and q of each
        step."""

    def advance(self, t: float) -> None:
        """The tip makes up for its error at t [s] and goes with the goal; what it did is added to `steps`."""
        goal = self.path.position(t + self.dt)
        step = self.robot.advance(self.path.position(t) - self.tip, self.feedforward(t))
        self.steps.append((goal, step.tip, step.tip - self.tip, step.by_soft, step.by_arm, self.robot.q()))
        self.tip = step.tip

    def follow_arm(self) -> None:
        """Put the bracket where the flange is."""
        self.robot.bracket.follow()

    def feedforward(self, t: float) -> Floats:
        """(3,) mean velocity of the goal in the step that begins at time t [s], world [m/s]: around corners
        it ends on the goal too."""
        return np.asarray((self.path.position(t + self.dt) - self.path.position(t)) / self.dt)


class TrackingScene(HostedScene):
    """One path, from the jump of the goal onto it to the end of a period after the approach.

    As in the paper, the tip rests at the path's center when the goal begins to move along the path, and a
    longer error than 0.1 m counts as 0.1 m.
    """

    dt = 0.02
    duration = APPROACH + PERIOD
    shape: ClassVar[str]
    """Name of the trajectory; its sizes are the paper's."""
    sizes: ClassVar[dict[str, float]]
    """Sizes of the trajectory [m]."""

    paper: ClassVar[float]
    """The paper's mean squared error [m^2]."""

    @final
    def path(self, scale: float = 1.0) -> Trajectory:
        """The path, or one of the same form so many times as large."""
        return trajectory(
            self.shape,
            period=PERIOD,
            center=CENTER,
            **{name: scale * size for name, size in self.sizes.items()},
        )

    @final
    def stage(self) -> TrackingError:
        """A new world, its tip at the path's center."""
        return TrackingError(self.path(), dt=self.dt)

    @final
    def record(self, stage: TrackingError) -> Record:
        """Run to the end."""
        return record(stage, self.play(stage))

    @final
    def check(self) -> dict[str, float]:
        """The tip's error, the soft robot's fraction, room to the limits, clearance and lag must be within
        the bounds of this module."""
        stage = self.stage()
        lower, upper = stage.robot.lower, stage.robot.upper
        run = self.record(stage)
        error, fraction = run.mean_square(APPROACH), run.soft_fraction(APPROACH)
        by_soft, by_arm = run.lengths(APPROACH)
        room = float(np.minimum(run.q - lower, upper - run.q).min())
        self.expect(
            error <= LARGEST_ERROR,
            f"the mean squared error after the approach is {error:.3g} m^2; at most {LARGEST_ERROR:g}.",
        )
        self.expect(
            fraction >= LEAST_FRACTION,
            f"the soft robot does {fraction:.3f} of the tip's motion; it must be {LEAST_FRACTION} or more.",
        )
        self.expect(room >= -1e-6, f"a coordinate is {-room:.3g} beyond its limit.")
        self.expect(
            run.clearance >= LEAST_CLEARANCE,
            f"the soft robot comes as near as {run.clearance:.3g} m to the arm.",
        )
        self.expect(
            run.lag <= LARGEST_LAG, f"the tip of a step is {run.lag:.3g} m off where it would come to rest."
        )
        return {
            "mean squared error, m^2": error,
            "with the approach, m^2": run.mean_square(0.0, PERIOD),
            "soft fraction": fraction,
            "path by the soft robot, m": by_soft,
            "path by the arm, m": by_arm,
            "clearance, m": run.clearance,
            "lag, m": run.lag,
        }


def record(stage: TrackingError, times: Iterable[float]) -> Record:
    """Record of the stage at these times, the end of each step [s]."""
    t: list[float] = []
    clearance, lag = np.inf, 0.0
    every = round(_SAMPLE / stage.dt)
    for end in times:
        t.append(end)
        if len(t) % every == 0:
            clearance = min(clearance, stage.robot.clearance())
            if end > APPROACH:
                lag = max(lag, float(np.linalg.norm(stage.robot.rest() - stage.tip)))
    goal, tip, displacement, by_soft, by_arm, q = (
        np.array(column) for column in zip(*stage.steps, strict=True)
    )
    return Record(np.array(t), goal, tip, displacement, by_soft, by_arm, q, clearance, lag)


@final
class TrackSquare(TrackingScene):
    """Sides of 0.4 m."""

    name = "track_square"
    about = "The tip of a soft robot on a UR5 follows a square."
    shape = "square"
    sizes: ClassVar[dict[str, float]] = {"side": 0.4}
    paper = 351e-6


@final
class TrackCircle(TrackingScene):
    """Radius 0.2 m."""

    name = "track_circle"
    about = "The tip of a soft robot on a UR5 follows a circle."
    shape = "circle"
    sizes: ClassVar[dict[str, float]] = {"radius": 0.2}
    paper = 195e-6


@final
class TrackFigureEight(TrackingScene):
    """0.4 m in either direction."""

    name = "track_figure_eight"
    about = "The tip of a soft robot on a UR5 follows a figure eight."
    shape = "figure_eight"
    sizes: ClassVar[dict[str, float]] = {"size": 0.2}
    paper = 409e-6


@final
class TrackHelix(TrackingScene):
    """Radius 0.2 m, pitch 0.1 m."""

    name = "track_helix"
    about = "The tip of a soft robot on a UR5 follows a helix."
    shape = "helix"
    sizes: ClassVar[dict[str, float]] = {"radius": 0.2, "pitch": 0.1}
    paper = 153e-6


@final
class TrackSquareHelix(TrackingScene):
    """Sides of 0.2 m, pitch 0.02 m."""

    name = "track_square_helix"
    about = "The tip of a soft robot on a UR5 follows a helix with the corners of a square."
    shape = "square_helix"
    sizes: ClassVar[dict[str, float]] = {"side": 0.2, "pitch": 0.02}
    paper = 268e-6
