"""`Task`: what a robot is to do, for n robots at once; pure arrays, robot axis first, no Gymnasium."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod.types import Flags, Floats, Ints
from fastrod_envs.options import EnvOptions, checked_difficulty

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_FACES = np.vstack(
    [
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]],
        [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]],
    ]
)
_UPRIGHT = np.eye(3)


class Field(NamedTuple):
    """A named part of an observation or an action."""

    name: str
    unit: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    about: str


class Ball(NamedTuple):
    """A ball to draw: a goal, a marker."""

    position: Floats
    """(3,) world [m]."""
    radius: float
    color: tuple[float, float, float]


class Solid(NamedTuple):
    """A box, cylinder or mesh to draw."""

    vertices: Floats
    """(n, 3) world [m]."""
    faces: Ints
    """(m, 3)"""
    color: tuple[float, float, float]
    opacity: float = 1.0


class DrawnLine(NamedTuple):
    """A path to draw."""

    points: Floats
    """(n, 3) world [m]."""
    color: tuple[float, float, float]


class Tube(NamedTuple):
    """A rod to draw."""

    points: Floats
    """(n, 3) along its backbone, world [m]."""
    radius: float
    color: tuple[float, float, float]


@dataclass(frozen=True)
class Backdrop:
    """One environment as it looks now, world frame."""

    tubes: tuple[Tube, ...] = ()
    balls: tuple[Ball, ...] = ()
    solids: tuple[Solid, ...] = ()
    lines: tuple[DrawnLine, ...] = ()
    eye: tuple[float, float, float] = (0.9, 0.9, 0.6)
    """Position of the eye [m]."""
    target: tuple[float, float, float] = (0.0, 0.0, 0.25)
    """Middle of the picture [m]."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a step, robot axis first."""

    terms: dict[str, Floats]
    """The terms of the reward, each (n,); their sum is the reward."""
    distance: Floats
    """(n,) by which the task is judged [m]."""
    success: Flags
    """(n,) the task's criterion holds now."""
    position: Floats
    """(n, 3) of what is to be somewhere, world [m]."""
    desired: Floats
    """(n, 3) where it is to be, world [m]."""
    terminated: Flags
    """(n,) the episode ends here, before its time: it succeeded for good, or failed."""
    contact: Flags
    """(n,) something was touched that should not be."""
    lost: Flags
    """(n,) the simulation did not find this robot's shape; the episode ends, and counts as failed."""
    facts: dict[str, Floats] = field(default_factory=dict)
    """Further facts for a user, each (n, ...); goes into info."""


class Task(ABC):
    """A task for `n_envs` robots.

    Class docstrings of tasks are their documentation: what is to be done, the reward's formula, the success
    criterion, the baseline.
    """

    name: ClassVar[str]
    """Name in the id fastrod/<name>-v0."""
    n_steps: ClassVar[int]
    """Number of steps of an episode, unless the options say otherwise."""
    n_draws: ClassVar[int]
    """Numbers from 0 to 1 that an episode draws for its goal and scene, randomisation apart."""
    accuracy: float
    """Distance below which the task is done [m]; a number of the class, which a robot of another size may
    change."""
    solved: ClassVar[float | None] = None
    """Mean return from which the task counts as solved, for Gymnasium; None: nobody has said."""
    options_class: ClassVar[type[EnvOptions]] = EnvOptions
    """Its options."""
    hosted: ClassVar[bool] = False
    """Needs PyBullet (`pip install fastrod[hosts]`)."""
    on_gpu: ClassVar[bool] = False
    """Its simulator can work on a GPU (`device="cuda"`)."""

    dt: float
    """Time of a step [s]."""
    actions: tuple[Field, ...]
    """Parts of an action; every number goes from -1 to 1, and low and high say what -1 and 1 mean, in the
    unit."""
    states: tuple[Field, ...]
    """Parts of an observation of the state, in the order of `state()`."""
    goals: tuple[Field, ...]
    """Parts of an observation of the goal, in the order of `goal()`."""

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        if options.device != "cpu" and not self.on_gpu:
            raise InputError(
                f"device is {options.device!r}; {self.name} has contact or a host's bodies, "
                "which need device 'cpu'."
            )
        self.n_envs, self.options = n_envs, options
        self.difficulty = options.difficulty
        self.total_draws = self.n_draws
        """Numbers that an episode draws, randomisation included."""

    def set_difficulty(self, level: float) -> None:
        """Set the difficulty from the next episode on: 0 is the easiest, 1 the whole task. Raises
        `InputError`."""
        self.difficulty = checked_difficulty(level)

    @abstractmethod
    def begin(self, rows: Ints, draws: Floats) -> None:
        """Start an episode for these robots; `draws` (len(rows), total_draws) are even from 0 to 1. What a
        robot then is depends on nothing but its draws."""

    @abstractmethod
    def act(self, action: Floats) -> None:
        """One step of all robots; `action` (n_envs, n_actions) from -1 to 1, finite."""

    @abstractmethod
    def outcome(self) -> Outcome:
        """Return how the last step went."""

    @abstractmethod
    def state(self) -> Floats:
        """(n_envs, size of `states`)."""

    @abstractmethod
    def goal(self) -> Floats:
        """(n_envs, size of `goals`)."""

    @abstractmethod
    def baseline(self) -> Floats:
        """(n_envs, n_actions) what the scripted baseline does now, from -1 to 1; it may use what the
        simulator knows."""

    @abstractmethod
    def backdrop(self, i: int) -> Backdrop:
        """Return what environment i looks like now."""

    def picture(self, i: int, width: int, height: int) -> np.ndarray | None:  # noqa: ARG002
        """(height, width, 3) uint8 of environment i where a host draws it; None leaves it to the drawing of
        `backdrop`."""
        return None

    def close(self) -> None:  # noqa: B027
        """Give back what the task holds."""

    @property
    def n_actions(self) -> int:
        """Numbers of an action."""
        return size(self.actions)


def size(entries: tuple[Field, ...]) -> int:
    """Numbers in these parts."""
    return sum(len(entry.low) for entry in entries)


def bounds(entries: tuple[Field, ...]) -> tuple[Floats, Floats]:
    """(n,) least and (n,) largest value of every number of these parts, each in its unit."""
    return np.concatenate([np.array(p.low, float) for p in entries]), np.concatenate(
        [np.array(p.high, float) for p in entries]
    )


def length(vectors: Floats) -> Floats:
    """(n,) of vectors (n, 3): the same bits whatever n is, which a BLAS does not promise."""
    return np.asarray(np.sqrt(vectors[:, 0] ** 2 + vectors[:, 1] ** 2 + vectors[:, 2] ** 2))


def shortened(vectors: Floats, longest: float) -> Floats:
    """Vectors (n, 3) of at most this length, their direction kept."""
    return np.asarray(vectors * (longest / np.maximum(length(vectors), longest))[:, None])


def solid_box(
    middle: ArrayLike,
    half: ArrayLike,
    color: tuple[float, float, float],
    rotation: Floats = _UPRIGHT,
    opacity: float = 1.0,
) -> Solid:
    """A box to draw: its `middle` (3,) world [m], `half` of its edges (3,) [m], `rotation` (3, 3)
    world_from_box."""
    return Solid(
        np.asarray(middle, float) + (_CORNERS * np.asarray(half, float)) @ rotation.T, _FACES, color, opacity
    )
