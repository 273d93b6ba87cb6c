"""Trajectories of a simulated robot: random commands of limited rate, effects drawn anew for each episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import final

import numpy as np

from fastrod.generation.columns import Column, numbered, several, within
from fastrod.generation.draws import in_ball, named, robot_of, with_effects
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.types import Flags, Floats

_HOLD = 1.0  # s between targets, on average
_POINTS = 8  # steps of a segment


@final
@dataclass(frozen=True, kw_only=True)
class Trajectories:
    """Each segment goes at a limited rate toward a target in its disc of bends and its range of extension;
    targets change at random.

    The first step is settled, the others are steps of the simulator. What is measured has the drawn effects
    in it.
    """

    robot: str = field(repr=False)
    """A robot file's text."""
    effects: tuple[str, ...] = ()
    """Drawn for each episode (`fastrod.generation.draws`)."""
    steps: int = 200
    """Of an episode."""
    dt: float = 0.02
    """[s]."""
    bend: float = 0.9
    """Radius of the disc of a segment's bend [rad]."""
    speed: float = 1.0
    """Largest rate of a bend [rad/s]."""
    force: float = 0.0
    """Radius of the ball of tip forces [N]; the force stays for an episode."""

    def __post_init__(self) -> None:
        within("steps", self.steps, 1, 10**6, whole=True)
        within("dt", self.dt, 0.0, 10.0, "s", open_low=True)
        within("bend", self.bend, 0.0, 3.0, "rad", open_low=True)
        within("speed", self.speed, 0.0, 1e3, "rad/s", open_low=True)
        within("force", self.force, 0.0, math.inf, "N")
        object.__setattr__(self, "effects", named(self.effects))
        SegmentActions(robot_of(self.robot))

    @property
    def index(self) -> str:
        """Episodes are counted."""
        return "episode"

    @property
    def usual(self) -> int:
        """Episodes of a shard."""
        return 256

    def make(self, first: int, count: int, seed: Sequence[int]) -> list[Column]:
        """`steps` rows for each of `count` episodes, one after the other."""
        rng = np.random.default_rng(seed)
        plain = robot_of(self.robot)
        robots, drawn = zip(*(with_effects(plain, self.effects, rng) for _ in range(count)), strict=True)
        rotation = matrix_from_quaternion(np.array(plain.base_quaternion))
        force = self.force * in_ball(rng, count, 3)
        simulator = Simulator(
            list(robots) if self.effects else plain, count, self.dt, _POINTS, outputs="tip", threads=1
        )
        actions, n = SegmentActions(plain), plain.n_segments
        low, high = np.array([segment.extension for segment in plain.segments]).T
        bend, extension = np.zeros((count, n, 2)), np.zeros((count, n))
        aim_bend, aim_extension = bend.copy(), extension.copy()
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
            given = actions.inputs(action)
            state = (simulator.step if step else simulator.settle)(**given, tip_force=force @ rotation.T)
            seen = simulator.measure()
            dl = given["tendon_length"] - plain.rest_tendon_length
            rows.append(
                (
                    dl,
                    extension.copy(),
                    seen.tip_position,
                    quaternion_from_matrix(seen.tip_rotation),
                    state.residual[:, None],
                )
            )
            ok.append(state.ok)
        dl, ext, tip, quaternion, residual = (
            np.stack(columns, 1).reshape(count * self.steps, -1) for columns in zip(*rows, strict=True)
        )
        good = np.stack(ok, 1).ravel()
        tip, quaternion = (np.where(good[:, None], a, np.nan) for a in (tip, quaternion))
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
        for name in drawn[0]:
            values = np.repeat([one[name] for one in drawn], self.steps)
            columns.append(Column(name, values, "", "drawn for the episode, in its parameter's unit"))
        columns.append(
            Column(
                "residual",
                residual[:, 0].astype(np.float32),
                "m",
                "largest boundary residual: how far the observer is behind",
            )
        )
        columns.append(Column("ok", good, "", "the observer did not diverge"))
        return columns

    def failed(self, columns: Sequence[Column]) -> int:
        """Episodes in which the observer diverged."""
        values = {column.name: np.asarray(column.values) for column in columns}
        return len(np.unique(values["episode"][~values["ok"]]))
