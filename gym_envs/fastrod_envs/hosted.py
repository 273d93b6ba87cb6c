"""`HostedTask`: a task with rigid bodies; each environment is a `Cell`, a PyBullet world of its own."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fastrod.errors import HostError
from fastrod.model.robot import Robot
from fastrod.types import Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.painter import paint
from fastrod_envs.randomisation import Randomisation
from fastrod_envs.task import Backdrop, Field, Outcome, Task


class HostedResult(NamedTuple):
    """Result of a step of one environment; as `Outcome`, without the robot axis."""

    terms: dict[str, float]
    distance: float
    success: bool
    position: Floats
    """(3,) world [m]."""
    desired: Floats
    """(3,) world [m]."""
    terminated: bool = False
    contact: bool = False
    facts: Mapping[str, float] = MappingProxyType({})


class Cell(ABC):
    """One environment in a PyBullet world of its own."""

    @abstractmethod
    def begin(self, draws: Floats, difficulty: float, robot: Robot | None) -> None:
        """Start an episode from the same state as any other, but for its draws (n_draws,) and the soft robot,
        where it is another."""

    @abstractmethod
    def act(self, action: Floats, duration: float) -> None:
        """Simulate this long [s] with this action (n_actions,), from -1 to 1. Raises `HostError` where the
        soft robot is lost."""

    @abstractmethod
    def result(self) -> HostedResult:
        """Return how the last step went."""

    @abstractmethod
    def state(self) -> Floats:
        """(size of the task's `states`,)"""

    @abstractmethod
    def goal(self) -> Floats:
        """(size of the task's `goals`,)"""

    @abstractmethod
    def baseline(self) -> Floats:
        """(n_actions,) of the scripted baseline."""

    @abstractmethod
    def backdrop(self) -> Backdrop:
        """Return what it looks like, for the page."""

    def picture(self, width: int, height: int) -> np.ndarray:
        """(height, width, 3) uint8: the backdrop, unless a cell has a world with more to see."""
        return paint(self.backdrop(), width, height)

    @abstractmethod
    def close(self) -> None:
        """Disconnect the world."""


class HostedTask(Task):
    """Cells side by side. An episode lasts `duration`, whatever the number of its steps."""

    hosted: ClassVar[bool] = True
    duration: ClassVar[float]
    """Duration of an episode [s]."""

    def __init__(
        self,
        n_envs: int,
        options: EnvOptions,
        robot: Robot,
        actions: tuple[Field, ...],
        states: tuple[Field, ...],
        goals: tuple[Field, ...],
    ) -> None:
        """`robot` is the soft robot, before anything of it is randomised."""
        super().__init__(n_envs, options)
        self.actions, self.states, self.goals = actions, states, goals
        self.dt = self.duration / (options.n_steps or self.n_steps)
        self._random = Randomisation.of(options.randomise)
        self.base_robot = robot if self._random is None else self._random.base(robot)
        if self._random is not None:
            self.total_draws = self.n_draws + self._random.n_draws
        self.cells: list[Cell] = []
        for _ in range(n_envs):
            self.cells.append(self.cell())
        self._lost = np.zeros(n_envs, bool)
        self._sane: list[HostedResult | None] = [None] * n_envs
        self._seen: Floats = np.zeros((n_envs, sum(len(entry.low) for entry in states)))

    @abstractmethod
    def cell(self) -> Cell:
        """A new environment."""

    def begin(self, rows: Ints, draws: Floats) -> None:
        """See `Task.begin`, cell by cell. A cell that raises `HostError` is closed and made anew; if it
        raises again, so does this."""
        for i, row in zip(rows, draws, strict=True):
            robot = None
            if self._random is not None and self._random.n_draws:
                robot = self._random.draw(self.base_robot, row[None, self.n_draws :])[0]
            try:
                self.cells[i].begin(row[: self.n_draws], self.difficulty, robot)
            except HostError:  # a world in which the rod is lost is not repaired: another takes its place
                self.cells[i].close()
                self.cells[i] = self.cell()
                self.cells[i].begin(row[: self.n_draws], self.difficulty, robot)
            self._lost[i] = False
            self._seen[i] = self.cells[i].state()
            self._sane[i] = self.cells[i].result()

    def act(self, action: Floats) -> None:
        """See `Task.act`. A cell that raises `HostError`, or whose state is not finite, is lost until its
        next episode, and shows its last good step."""
        for i, cell in enumerate(self.cells):
            try:
                cell.act(action[i], self.dt)
                seen = cell.state()
                if not np.isfinite(seen).all():
                    raise HostError("the world holds a body that is not anywhere.")
                self._seen[i], self._sane[i] = seen, cell.result()
            except HostError:
                self._lost[i] = True

    def outcome(self) -> Outcome:
        """Outcomes of the cells' last good steps; one that is lost has not succeeded."""
        results = [result for result in self._sane if result is not None]

        def each(values: list[Any]) -> Any:
            return np.array(values)

        return Outcome(
            terms={name: each([r.terms[name] for r in results]) for name in results[0].terms},
            distance=each([r.distance for r in results]),
            success=each([r.success for r in results]) & ~self._lost,
            position=each([r.position for r in results]),
            desired=each([r.desired for r in results]),
            terminated=each([r.terminated for r in results]),
            contact=each([r.contact for r in results]),
            lost=self._lost.copy(),
            facts={name: each([r.facts[name] for r in results]) for name in results[0].facts},
        )

    def state(self) -> Floats:
        """(n_envs, size of `states`) after each cell's last good step; a copy."""
        return self._seen.copy()

    def goal(self) -> Floats:
        """(n_envs, size of `goals`), as the cells have them now."""
        return np.array([cell.goal() for cell in self.cells])

    def baseline(self) -> Floats:
        """(n_envs, n_actions) of the cells' own baselines, clipped to -1 and 1."""
        return np.asarray(np.clip(np.array([cell.baseline() for cell in self.cells]), -1.0, 1.0))

    def backdrop(self, i: int) -> Backdrop:
        """Return the backdrop that cell i gives."""
        return self.cells[i].backdrop()

    def picture(self, i: int, width: int, height: int) -> np.ndarray | None:
        """(height, width, 3) uint8 as cell i gives it; never None."""
        return self.cells[i].picture(width, height)

    def close(self) -> None:
        """Disconnect the worlds of all cells; the task cannot be used afterwards."""
        for cell in self.cells:
            cell.close()
        self.cells = []
