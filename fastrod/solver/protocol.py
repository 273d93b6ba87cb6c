"""`Solver`: what a simulator asks of its rods, whichever way they are solved."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple, Protocol

from numpy.typing import ArrayLike

from fastrod.errors import Problem, ProblemSentence
from fastrod.model.robot import Robot
from fastrod.solver.inputs import Inputs
from fastrod.solver.response import Relocate
from fastrod.solver.state import State
from fastrod.types import Flags, Floats, Ints, Params, Ports, RodShape


class Acting(NamedTuple):
    """All that acts on the robots in one call, and their numbers, effects included."""

    given: Inputs
    ports: Ports
    params: Params
    gravity: Floats | None
    """(n_robots or 1, 3) world [m/s^2]; None: the robots' own."""
    points: tuple[Floats, Floats]
    """Point forces: (n_robots, m) arclength [m] and (n_robots, m, 3) world [N]."""


class Last(NamedTuple):
    """The robots after the call before."""

    warm: Flags
    """(n_robots,) they have a shape to go on from."""
    ports: Ports | None
    state: State | None


class How(NamedTuple):
    """Options of one step."""

    dt: float
    passes: int = 1
    """Newton steps of rods of modes, at least."""
    estimate_error: bool = False
    inverse_inertia: ArrayLike | None = None
    derive: bool = False
    """Whether the Jacobian by inputs is wanted with the step."""
    relocate: Relocate | None = None


class Solved(NamedTuple):
    """The robots after a call."""

    shape: RodShape
    ok: Flags
    passes: Ints
    ports: Ports
    """Inputs that the shape belongs to: bases where free bodies have come to, say."""
    reason: str
    """Beginning of the sentence on a robot that is not ok."""
    kind: Problem
    problems: Mapping[int, ProblemSentence] = {}
    """Robots of which more is known."""
    lost: Ints | None = None
    """Robots whose shape is none of theirs; None: all that are not ok."""
    held: Flags | None = None
    """(n_robots,) not ok, but they go on from where they came to."""
    moving: Mapping[str, Any] = {}
    """Fields of `State` beside the shape."""
    jacobian: Floats | None = None
    """By the inputs, where it came with the step."""


class LinearResponse(Protocol):
    """Linear response of the last shape."""

    def jacobian(self, relocate: Relocate | None = None, turning: bool = False) -> Floats:
        """(n_robots, 6, n_inputs) of the tip, as `Simulator.jacobian`."""
        ...

    def by_load(self) -> Floats:
        """(n_robots, 6, 6) of the tip, by force and moment on it."""
        ...


class Solver(Protocol):
    """Rods of one layout, and what they remember from one call to the next."""

    threads: int

    def accept(self, given: Inputs, how: How | None) -> None:
        """Take how the next step is to be (without `how`: `settle`). Raises `InputError` for what these rods
        do not take."""
        ...

    def new_shape(self, outputs: Literal["full", "tip"], holes: bool) -> RodShape:
        """Return room for a shape; `holes`: nan where nothing will be written."""
        ...

    def remember(self, ports: Ports, pulled: bool, last: Last) -> None:
        """Make room for what a call on these inputs must know; `pulled`: an effect pulls at the tip."""
        ...

    def step(self, rows: Ints, acting: Acting, last: Last, how: How) -> Solved:
        """Take one step of these robots."""
        ...

    def settle(self, rows: Ints, acting: Acting, last: Last, tolerance: float) -> Solved:
        """Bring these robots to rest, to `tolerance` [m]."""
        ...

    def response(self, acting: Acting, warm: Flags) -> LinearResponse:
        """Return the linear response of the last shape of these robots."""
        ...

    def tip_compliance(self, acting: Acting, warm: Flags, *, in_step: bool) -> Floats:
        """(n_robots, 3, 3) by how much the tip gives to a force at rest, or within a step [m/N]."""
        ...

    def unstable(self, acting: Acting, shape: RodShape, rows: Ints) -> Ints:
        """Those of `rows` whose shape balances its loads, but would not stay."""
        ...

    def replace(self, robots: Sequence[Robot]) -> None:
        """Take other robots of the same layout, one for all or one each."""
        ...

    def snapshot(self) -> Any:
        """Return a copy of what is remembered."""
        ...

    def check(self, kept: Any) -> None:
        """Raise `InputError` where this is no snapshot of such rods."""
        ...

    def restore(self, kept: Any, rows: Flags | None, acting: Acting | None, then: Last) -> None:
        """Go back to a snapshot of the call `then`, or in `rows` alone; `acting` is what all feel after
        it."""
        ...
