"""Trajectories of a simulated robot: random commands of limited rate, effects drawn anew for each episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import InputError, shown
from fastrod.generation.columns import Column, numbered, several
from fastrod.generation.draws import in_ball, named, robot_of, with_effects
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.types import Flags, Floats

_HOLD = 1.0  # s between targets, on average
_POINTS = 8  # steps of a segment
_MOTION = 1e-3  # s: of the simulator's steps in motion, at most


@final
@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """Each segment goes at a limited rate toward a target in its disc of bends and its range of extension;
    targets change at random.

    The first step is settled, the others are steps of the simulator. What is measured has the drawn effects
    in it. With `dynamics` the rod has inertia: it starts at rest, and between two rows, while the commands
    go on evenly, the simulator takes as many even steps as keep each within a millisecond.
    """

    robot: str = field(repr=False)
    """A robot file's text."""
    effects: tuple[str, ...] = ()
    """Drawn for each episode (`fastrod.generation.draws`)."""
    steps: int = 200
    """Number of steps of an episode."""
    dt: float = 0.02
    """[s]."""
    bend: float = 0.9
    """Radius of the disc of a segment's bend [rad]."""
    speed: float = 1.0
    """Largest rate of a bend [rad/s]."""
    force: float = 0.0
    """Radius of the ball of tip forces [N]; the force stays for an episode."""
    dynamics: bool = False
    """The rod has inertia; every segment of the robot needs a line_density, or a damping_time to move
    without, or this raises `InputError`."""

    def __post_init__(self) -> None:
        check_number("steps", self.steps, Bound(least=1, most=10**6), whole=True)
        check_number("dt", self.dt, Bound(above=0.0, most=10.0, unit="s"))
        check_number("bend", self.bend, Bound(above=0.0, most=3.0, unit="rad"))
        check_number("speed", self.speed, Bound(above=0.0, most=1e3, unit="rad/s"))
        check_number("force", self.force, Bound(least=0.0, unit="N"))
        object.__setattr__(self, "effects", named(self.effects))
        SegmentActions(robot_of(self.robot))
        if not isinstance(self.dynamics, bool):
            raise InputError(f"dynamics is {shown(self.dynamics)}; it must be True or False.")
        if self.dynamics:
            self._simulator(robot_of(self.robot), 1)

    @property
    def index(self) -> str:
        """Episodes are counted."""
        return "episode"

    @property
    def usual(self) -> int:
        """Episodes of a shard."""
        return 32 if self.dynamics else 256

    def make(self, first: int, count: int, seed: Sequence[int]) -> list[Column]:
        """`steps` rows for each of `count` episodes, one after the other."""
        rng = np.random.default_rng(seed)
        plain = robot_of(self.robot)
        robots, drawn = zip(*(with_effects(plain, self.effects, rng) for _ in range(count)), strict=True)
        rotation = matrix_from_quaternion(np.array(plain.base_quaternion))
        force = self.force * in_ball(rng, count, 3)
        simulator = self._simulator(list(robots) if self.effects else plain, count)
        actions, n = SegmentActions(plain), plain.n_segments
        low, high = np.array([segment.extension for segment in plain.segments]).T
        bend, extension = np.zeros((count, n, 2)), np.zeros((count, n))
        aim_bend, aim_extension = bend.copy(), extension.copy()
        last = np.zeros((count, 3 * n))
        rows: list[tuple[Floats, ...]] = []
        ok: list[Flags] = []
        for step in range(self.steps):
            new = rng.random((count, n)) < (self.dt / _HOLD if step else 1.0)
            fresh = self.bend * in_ball(rng, count * n, 2).reshape(count, n, 2)
            aim_bend = np.where(new[:, :, None], fresh, aim_bend)
            aim_extension = np.where(new, low + (high - low) * rng.random((count, n)), aim_extension)
            displacement = aim_bend - bend
            far = np.linalg.norm(displacement, axis=-1, keepdims=True)
            bend = bend + displacement * np.minimum(1.0, self.speed * self.dt / np.maximum(far, 1e-12))
            most = self.speed * self.dt / self.bend * (high - low)
            extension = np.clip(extension + np.clip(aim_extension - extension, -most, most), low, high)
            action = np.concatenate([extension[..., None], bend * actions.offset[:, None]], axis=-1).reshape(
                count, -1
            )
            steps = self._steps if step else 1
            good = np.ones(count, bool)
            for k in range(1, steps + 1):  # the last one's inputs are the row's, to the last bit
                there = action if k == steps else last + (k / steps) * (action - last)
                given = actions.inputs(there)
                state = (simulator.step if step else simulator.settle)(**given, tip_force=force @ rotation.T)
                good &= state.ok
            last = action
            seen = simulator.measure()
            dl = given["tendon_length"] - plain.rest_tendon_length
            rows.append(
                (
                    dl,
                    extension.copy(),
                    seen.tip_position,
                    quaternion_from_matrix(seen.tip_rotation),
                    state.residual[:, None],
                    np.zeros((count, 0)) if state.velocity is None else state.velocity[:, -1] @ rotation,
                )
            )
            ok.append(good)
        dl, ext, tip, quaternion, residual, velocity = (
            np.stack(columns, 1).reshape(count * self.steps, -1) for columns in zip(*rows, strict=True)
        )
        good = np.stack(ok, 1).ravel()
        tip, quaternion, velocity = (np.where(good[:, None], a, np.nan) for a in (tip, quaternion, velocity))
        step_of = np.tile(np.arange(self.steps), count)
        columns = [
            Column(
                "episode",
                np.repeat(np.arange(first, first + count), self.steps),
                "",
                "counts over the whole data set",
            ),
            Column("step", step_of, "", "of the episode"),
            Column("t", step_of * self.dt, "s", "since the episode's start"),
        ]
        columns += numbered(
            "dl",
            dl,
            "m",
            "commanded change of a tendon's length against the straight rest robot; negative is pulled",
        )
        columns += numbered("ext", ext, "m", "commanded change of a segment's length")
        columns += several(
            ("tip_fx", "tip_fy", "tip_fz"),
            np.repeat(force, self.steps, 0),
            "N",
            "force on the tip, base frame",
        )
        columns += several(("tip_x", "tip_y", "tip_z"), tip, "m", "tip as measured, base frame")
        columns += several(
            ("tip_qw", "tip_qx", "tip_qy", "tip_qz"),
            quaternion.astype(np.float32),
            "",
            "base_from_tip as measured",
        )
        if self.dynamics:
            columns += several(
                ("tip_vx", "tip_vy", "tip_vz"), velocity, "m/s", "of the rod's tip itself, base frame"
            )
        for name in drawn[0]:
            values = np.repeat([one[name] for one in drawn], self.steps)
            columns.append(Column(name, values, "", "drawn for the episode, in its parameter's unit"))
        columns.append(
            Column(
                "residual",
                residual[:, 0].astype(np.float32),
                "m",
                "largest boundary residual"
                + (" of the moving rod" if self.dynamics else ": how far the observer is behind"),
            )
        )
        solver = "Newton's method ended in every step" if self.dynamics else "the observer did not diverge"
        columns.append(Column("ok", good, "", solver))
        return columns

    def failed(self, columns: Sequence[Column]) -> int:
        """Episodes in which a row is not ok."""
        values = {column.name: np.asarray(column.values) for column in columns}
        return len(np.unique(values["episode"][~values["ok"]]))

    @property
    def _steps(self) -> int:
        """Number of steps of the simulator from row to row."""
        return max(1, math.ceil(self.dt / _MOTION - 1e-9)) if self.dynamics else 1

    def _simulator(self, robot: Robot | list[Robot], count: int) -> Simulator:
        """Simulator of `count` robots. Raises `InputError` where they cannot move."""
        return Simulator(
            robot,
            count,
            self.dt / self._steps,
            _POINTS,
            outputs="full" if self.dynamics else "tip",  # the velocity is one of what stands along the rod
            threads=1,
            dynamics=self.dynamics,
        )
