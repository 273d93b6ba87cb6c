"""ReachObstacle: Reach around a bar."""

from __future__ import annotations

from typing import ClassVar, final

import numpy as np

from fastrod.contact import ContactScene, box
from fastrod.types import Flags, Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.task import Backdrop, Ball, Field, Outcome, length, solid_box
from fastrod_envs.tasks.reach import ReachTask, drives, hanging_robot

BAR, SIZE = (0.0, 0.06, 0.35), (0.4, 0.02, 0.02)
"""Middle of the bar, world [m], and its edges [m]: the paper's, but 0.06 m beside the robot's axis; the
paper's robot begins in it."""
SEEN = 0.05
"""Clearance is observed up to here [m]."""


@final
class ReachObstacle(ReachTask):
    """Like Reach, with a bar in the way: one of 0.4 x 0.02 x 0.02 m along x at (0, 0.06, 0.35)
    m.

    Reward: that of Reach, but -1 alone in the step in which the robot touches the bar; that ends the episode,
    and fails. Contact is by geometry: the robot's surface, 12 mm around its backbone, at both ends of a step;
    where a robot may have gone right through the bar within the step, the way between is looked at. Success:
    d below 10 mm without contact. 40 steps of 50 ms. Baseline: resolved rates by the segments below the bar.
    """

    name = "ReachObstacle"
    outputs: ClassVar[str] = "full"

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        driven, limit, rate = drives()
        bar = box(SIZE, name="bar", position=BAR)
        scene = ContactScene(obstacles=[bar])
        super().__init__(
            n_envs,
            options,
            hanging_robot(),
            driven=driven,
            limit=limit,
            rate=rate,
            contact=scene,
            feel_contact=False,
        )
        self.prepare()
        self.states = (
            *self.states,
            Field("clearance", "m", (-SEEN,), (SEEN,), f"of the robot from the bar, at most {SEEN:g} m"),
        )
        self._clearance: Floats = np.full(n_envs, SEEN)
        self._touching_bar: Flags = np.zeros(n_envs, bool)

    def begin(self, rows: Ints, draws: Floats) -> None:
        super().begin(rows, draws)
        self._clearance[rows] = self.simulator.clearance()[rows]
        self._touching_bar[rows] = False

    def act(self, action: Floats) -> None:
        before = self.simulator.state.position
        super().act(action)
        gap = np.nan_to_num(self.simulator.clearance(), nan=SEEN, posinf=SEEN)
        self._touching_bar = gap < 0.0
        moved = np.sqrt(((self.simulator.state.position - before) ** 2).sum(2).max(1))
        # who may have gone through it within the step
        jumps = (moved > SIZE[1]) & (gap + self._clearance < moved) & ~self._touching_bar
        if jumps.any() and self.options.action == "rate":
            self._touching_bar |= jumps & (self.simulator.swept_clearance(0.002, jumps) < 0.0)
        self._clearance = gap

    def outcome(self) -> Outcome:
        distance = length(self.tip - self.desired)
        in_contact = self._touching_bar
        terms = {name: np.where(in_contact, 0.0, term) for name, term in self.rewards(distance).items()}
        return Outcome(
            terms={**terms, "contact": np.where(in_contact, -1.0, 0.0)},
            distance=distance,
            success=(distance < self.accuracy) & ~in_contact & ~self.lost,
            position=self.tip,
            desired=self.desired.copy(),
            terminated=in_contact.copy(),
            contact=in_contact.copy(),
            lost=self.lost,
            facts={"clearance": self._clearance.copy()},
        )

    def state(self) -> Floats:
        return np.concatenate([super().state(), np.clip(self._clearance, -SEEN, SEEN)[:, None]], axis=1)

    def baseline(self) -> Floats:
        weight = np.where(self.driven < 6, 0.1, 1.0)  # the first two segments are beside the bar
        return self.toward((self.desired - self.measured()) / (2.0 * self.dt), weight=weight)

    def backdrop(self, i: int) -> Backdrop:
        bar = solid_box(BAR, 0.5 * np.array(SIZE), (0.55, 0.57, 0.6))
        return Backdrop(
            tubes=(self.tube(i),), balls=(Ball(self.desired[i], 0.012, (0.85, 0.2, 0.15)),), solids=(bar,)
        )
