"""`Episodes`: a task step by step, its episodes counted, its actions checked; what both kinds of environment
share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.checks import NOT_NEGATIVE, check_number
from fastrod.errors import InputError, refuse_masked
from fastrod.types import Flags, Floats, Ints
from fastrod_envs.task import Outcome, Task, bounds

Singles = NDArray[np.float32]
_EPISODES = 64  # drawn at once: one call of a generator costs as much as many numbers


class Moment(NamedTuple):
    """Arrays of one step, robot axis first."""

    outcome: Outcome
    reward: Floats
    """(n,) sum of the outcome's terms."""
    terminated: Flags
    """(n,) the episode ended before its time; those that are lost too."""
    truncated: Flags
    """(n,) its steps are over."""


class Streams:
    """One generator for each of n environments, with a seed of its own: the same numbers whatever n is. Each
    episode takes `n_draws` of them, from 0 to 1."""

    def __init__(self, n: int, n_draws: int) -> None:
        self._n, self._n_draws = n, n_draws
        self._block = np.empty((n, _EPISODES, n_draws))
        self._used = np.full(n, _EPISODES)
        self._generators = np.random.default_rng().spawn(n)

    def seed(self, seeds: Sequence[int | None]) -> None:
        """A seed for each environment; None leaves that one's stream as it is. Raises `InputError`."""
        if len(seeds) != self._n:
            raise InputError(
                f"{len(seeds)} seeds for {self._n} environments; give one number, or one for each."
            )
        for seed in seeds:
            check_number("seed", 0 if seed is None else seed, NOT_NEGATIVE, whole=True)
        for i, seed in enumerate(seeds):
            if seed is not None:
                self._generators[i] = np.random.default_rng(int(seed))
                self._used[i] = _EPISODES

    def draw(self, rows: Ints) -> Floats:
        """(len(rows), n_draws) for one episode of each."""
        for i in rows[self._used[rows] == _EPISODES]:
            self._block[i] = self._generators[i].random((_EPISODES, self._n_draws))
            self._used[i] = 0
        drawn = self._block[rows, self._used[rows]]
        self._used[rows] += 1
        return np.asarray(drawn)


class Episodes:
    """Runs a task; robots whose episode is over wait to `begin` another."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.n = task.n_envs
        self.n_steps = task.options.n_steps or task.n_steps
        self.elapsed: Ints = np.zeros(self.n, np.int64)
        """(n,) steps of the episode under way."""
        self.returned: Floats = np.zeros(self.n)
        """(n,) sum of its rewards."""
        self._streams = Streams(self.n, task.total_draws)
        self._drawn = np.zeros((self.n, task.total_draws))
        entries = task.goals if task.options.observation == "goal" else task.states
        low, high = bounds(entries)
        self.low: Singles = low.astype(np.float32)
        """(n_obs,) least observation."""
        self.high: Singles = high.astype(np.float32)
        """(n_obs,) largest observation."""
        self._running = np.zeros(self.n, bool)

    def seed(self, seeds: Sequence[int | None]) -> None:
        """A seed for each environment; None leaves its stream as it is. Raises `InputError`."""
        self._streams.seed(seeds)

    def begin(self, rows: Ints, *, again: bool = False) -> None:
        """New episodes for these robots, or `again` those that they began last."""
        if not again:
            self._drawn[rows] = self._streams.draw(rows)
        self.task.begin(rows, self._drawn[rows])
        self.elapsed[rows] = 0
        self.returned[rows] = 0.0
        self._running[rows] = True

    def checked(self, actions: ArrayLike) -> Floats:
        """(n, n_actions) clipped to -1 and 1. Raises `InputError` on a wrong shape and on what is not
        finite."""
        refuse_masked("action", actions)
        try:
            a = np.asarray(actions, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"actions are {actions!r}; give numbers from -1 to 1, ({self.n}, {self.task.n_actions})."
            ) from error
        if a.shape != (self.n, self.task.n_actions):
            raise InputError(
                f"actions have shape {a.shape}; they must be ({self.n}, "
                f"{self.task.n_actions}), each from -1 to 1."
            )
        if not np.isfinite(a).all():
            i = int(np.flatnonzero(~np.isfinite(a).all(1))[0])
            raise InputError(f"the action of environment {i} is not finite: {a[i]}; nothing was simulated.")
        return np.clip(a, -1.0, 1.0)

    def advance(self, actions: ArrayLike, waiting: Flags | None = None) -> Moment:
        """One step of all, which counts for those that are not `waiting` (n,). Raises `InputError` as
        `checked`, and where an episode has not begun."""
        checked = self.checked(actions)
        counts = np.ones(self.n, bool) if waiting is None else ~waiting
        checked[~counts] = 0.0
        if not self._running.all():
            raise InputError(
                f"environment {int(np.flatnonzero(~self._running)[0])} has no episode under "
                "way; call reset() first."
            )
        self.task.act(checked)
        outcome = self.task.outcome()
        reward = np.zeros(self.n)
        for term in outcome.terms.values():
            reward += term
        reward[~counts] = 0.0
        self.elapsed += counts
        self.returned += reward
        terminated = (outcome.terminated | outcome.lost) & counts
        truncated = (self.elapsed >= self.n_steps) & ~terminated
        self._running &= ~(terminated | truncated)
        return Moment(outcome, reward, terminated, truncated)

    def observation(self) -> Singles:
        """(n, n_obs) a new array, within its bounds."""
        seen = self.task.goal() if self.task.options.observation == "goal" else self.task.state()
        return np.clip(seen.astype(np.float32), self.low, self.high)

    def info(self, moment: Moment) -> dict[str, Any]:
        """Arrays (n, ...) of what happened: distance, success, contact, lost, position, desired, the terms of
        the reward, and facts."""
        o = moment.outcome
        reported: dict[str, Any] = {
            "distance": o.distance,
            "success": o.success,
            "contact": o.contact,
            "lost": o.lost,
            "position": o.position,
            "desired": o.desired,
            **o.facts,
        }
        return {name: a.copy() for name, a in reported.items()} | {
            "reward_terms": {name: a.copy() for name, a in o.terms.items()}
        }
