"""Random numbers of every environment, from a seed of its own: the same whatever the number of environments
beside it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Floats, Ints

_EPISODES = 64  # drawn at once: one call of a generator costs as much as many numbers


class Streams:
    """One generator for each of n environments; each episode takes `n_draws` numbers from 0 to 1."""

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
            if seed is not None and (
                isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0
            ):
                raise InputError(f"seed is {seed!r}; it must be a whole number, zero or positive.")
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
