"""Options of a `Simulator`, checked: what was given, and what would be right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple, TypeAlias

import numba
import numpy as np

from fastrod.checks import COUNT, NOT_NEGATIVE, POSITIVE, Bound, check, check_number, named_fields
from fastrod.errors import InputError, RobotError, nearest, shown
from fastrod.model.robot import Robot
from fastrod.types import Floats

SchemeName: TypeAlias = Literal["bdf1", "bdf2", "generalized_alpha"]
SolverName: TypeAlias = Literal["observer", "modal"]

_config: Any = numba.config
_MOST_PIECES = 16
_MOST_MODES = 8  # `kernels.rod.modal.modes.N_INTERVALS`, of which an import takes the kernels along


class Modes(NamedTuple):
    """Resolution of the rod: modes of a piece, and pieces of a segment."""

    bending: int = 5
    """Number of modes of the curvature about d1, and about d2."""
    torsion: int = 3
    strain: int = 2
    """Number of modes of the stretch, and of each shear, where a segment has a stiffness for it."""
    pieces: int = 1


@named_fields(InputError)
@dataclass(frozen=True, kw_only=True)
class Observer:
    """Solver of rods at rest that takes one forward integration a step: gains of the boundary observer (the
    paper's Q and V, eqs. 5 and 12), on unknowns scaled to about one. Raises `InputError`.

    Without `process_noise` the gains are so high that a step is a Gauss-Newton step; the variance that is
    then left over is far below the process noise, and is not carried. More `measurement_noise` smooths the
    boundary over time.
    """

    process_noise: Annotated[float | None, POSITIVE] = None
    """Q, growth of the variance of the scaled unknowns (moment by EI/l, tension by EI/(d l)) [1/s]."""
    measurement_noise: Annotated[float, POSITIVE] = 1e-20
    """V^-1, variance of a boundary residual times time [m^2 s]; with a process noise."""
    kept_jacobian_tolerance: Annotated[float, NOT_NEGATIVE] = 0.0
    """Residual [m] below which a step corrects the boundary by the Jacobian that it has (chord Newton),
    without new sensitivities: a third of the time, and the observer lags by about so much."""

    def __post_init__(self) -> None:
        check(self)


@named_fields(InputError)
@dataclass(frozen=True, kw_only=True)
class Modal:
    """Solver of rods of curvature modes: for stretch and shear, and with `dynamics` in motion. Raises
    `InputError`."""

    dynamics: bool = False
    """Whether a step moves the rods on by `dt`; else it brings them to rest."""
    scheme: SchemeName = "generalized_alpha"
    """Scheme of a step in time: "generalized_alpha" (second order), "bdf2" or "bdf1"."""
    rho: Annotated[float, Bound(least=0.0, most=0.9, hint="Beyond it sudden loads grow.")] = 0.5
    """Spectral radius of generalized-alpha at infinite frequency: from 0, strongest damping, to 0.9."""
    jumps: bool = True
    """Whether an input that changes suddenly has jumped at the start of the step. Without, every input goes
    evenly through the step, as between two samples of a log."""
    modes: Modes | None = None
    """Resolution of the rod; None: `usual_modes`, at rest `Modes(6, 4)` and in motion `Modes(4, 2)`, of
    robots that are heavy for their stiffness more, except in a contact scene."""

    def __post_init__(self) -> None:
        check(self, "")
        for name in () if self.dynamics else ("scheme", "rho", "jumps"):
            if (given := getattr(self, name)) != getattr(Modal, name):
                raise InputError(
                    f"{name} is {given!r} without dynamics, and nothing moves in time; give dynamics=True."
                )
        if self.modes is not None:
            _check_modes(self.modes)


def _check_modes(modes: object) -> None:
    if not isinstance(modes, Modes):
        raise InputError(f"modes is {shown(modes)}; give fastrod.Modes(bending=4, torsion=2), or None.")
    for name, value in modes._asdict().items():
        most = _MOST_PIECES if name == "pieces" else _MOST_MODES
        check_number(f"modes.{name}", value, Bound(least=1, most=most), whole=True)


_HEAVY = 30.0
"""Weight in EI/L^2 of the softest segment from which robots are of modes: of rods that bear as much, one
forward integration finds a shape that would not stay now and then, of twice as much none for some, and of
eight times none for all."""


def _weights(robot: Robot) -> Floats:
    """(n_segments,) weight of each segment and what is beyond it [N]."""
    mass = [s.line_density * s.length + sum(lump.mass for lump in s.lumps) for s in robot.segments]
    return np.asarray(np.cumsum(mass[::-1])[::-1] * np.linalg.norm(robot.gravity))


def usual_modes(robots: Sequence[Robot], *, coarse: bool) -> Modes:
    """Modes with which the tip of most robots is within 1e-5 of the length at rest under their own weight,
    and within 1e-4 `coarse`; upright ones beyond some 250 EI/L^2 may be further off.

    A segment that bears W at its end bends within sqrt(EI/W) of it.
    """
    bends = max(
        segment.length * math.sqrt(weight / min(segment.bending_stiffness))
        for robot in robots
        for segment, weight in zip(robot.segments, _weights(robot), strict=True)
    )
    if coarse and bends <= 1.0:
        return Modes(4, 2)
    return Modes(6, 4, pieces=min(max(1, math.ceil(0.5 * bends)), _MOST_PIECES))


def checked_robots(robot: object, n_robots: Any) -> tuple[tuple[Robot, ...], int]:
    """The robots, one for all or one each, and their number. Raises `RobotError`, `InputError`."""
    robots = (
        (robot,) if isinstance(robot, Robot) else tuple(robot) if isinstance(robot, (list, tuple)) else ()
    )
    if not robots or not all(isinstance(r, Robot) for r in robots):
        raise RobotError(
            f"robot is {shown(robot)}; give a Robot, for example "
            "fastrod.load_robot('prototype'), or a list of them."
        )
    n = len(robots) if n_robots is None else n_robots
    check_number("n_robots", n, COUNT, whole=True)
    if len(robots) not in (1, n):
        raise InputError(f"{len(robots)} robots for n_robots {n}; give one for all, or a list of n_robots.")
    return robots, int(n)


def check_options(points_per_segment: object, dt: object, outputs: object) -> None:
    """Raise `InputError` for an option of `Simulator` that cannot be."""
    check_number("points_per_segment", points_per_segment, Bound(least=2), whole=True)
    check_number("dt", dt, Bound(above=0.0, unit="s"))
    if outputs not in ("full", "tip"):
        raise InputError(f"outputs is {outputs!r}; it must be 'full' or 'tip'.")


def checked_threads(threads: Any) -> int:
    """The number of threads; None is numba's. Raises `InputError`."""
    most = int(_config.NUMBA_NUM_THREADS)
    if threads is None:
        return int(numba.get_num_threads())
    check_number("threads", threads, Bound(least=1, most=most), whole=True)
    return int(threads)


def solver_of(
    robots: Sequence[Robot],
    solver: SolverName | Observer | Modal | None = None,
    dynamics: bool = False,
    scheme: SchemeName = Modal.scheme,
) -> Observer | Modal:
    """The solver of these robots: the observer, unless they need modes or, heavy as they are, rest better by
    them. Raises `InputError` for one that there is not, or that cannot do what is asked."""
    if isinstance(solver, (Observer, Modal)):
        if dynamics or scheme != Modal.scheme:
            what = "dynamics" if dynamics else "scheme"
            raise InputError(f"{what} was given beside a solver; give solver=fastrod.Modal({what}=...).")
    elif solver not in (None, "observer", "modal"):
        known = nearest(str(solver), ("observer", "modal"))
        raise InputError(f"solver is {shown(solver)}; {known} Or give a fastrod.Observer or fastrod.Modal.")
    soft = next(
        (
            name
            for robot in robots
            for segment in robot.segments
            for name in ("axial_stiffness", "shear_stiffness", "lumps")
            if (segment.lumps if name == "lumps" else np.isfinite(getattr(segment, name)))
        ),
        None,
    )
    if isinstance(solver, Modal):
        return solver
    own = solver if isinstance(solver, Observer) else None
    # a scheme is refused where nothing moves
    modal = Modal(dynamics=dynamics, scheme=scheme)
    if (solver == "observer" or own) and (dynamics or soft):
        what = "dynamics=True" if dynamics else f"a robot with {soft}"
        raise InputError(f"solver is 'observer' with {what}, which needs solver='modal'.")
    heavy = any(
        _weights(robot)[0] * robot.length**2 > _HEAVY * min(min(s.bending_stiffness) for s in robot.segments)
        for robot in robots
        if robot.segments[0].mode != "paper"
    )
    return modal if dynamics or soft or solver == "modal" or (heavy and not solver) else own or Observer()


def check_fellows(solver: Observer | Modal, contact: object, feel_contact: bool, device: str) -> None:
    """Raise `InputError` for a contact scene that is none, and for options that do not go together."""
    if contact is not None:
        from fastrod.contact.scene import ContactScene

        if not isinstance(contact, ContactScene):
            raise InputError(
                f"contact is {contact!r}; give fastrod.contact.ContactScene(obstacles=[...]) or None."
            )
    if isinstance(solver, Modal) and device == "cuda":
        raise InputError("device was given with rods of modes, which do not take it; leave it out.")
    if device == "cuda" and contact is not None and feel_contact:
        raise InputError(
            "contact was given with device 'cuda', where rods feel none; take "
            "device='cpu', or feel_contact=False."
        )
