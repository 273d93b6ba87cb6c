"""Options of a `Simulator`, checked: what was given, and what would be right."""

from __future__ import annotations

from collections.abc import Sequence
from sys import float_info
from typing import Any, Literal, ParamSpec, TypeVar

import numba
import numpy as np

from fastrod.contact.scene import ContactScene
from fastrod.errors import InputError, RobotError, shown
from fastrod.kernels.rod.modal.modes import N_INTERVALS
from fastrod.model.robot import Robot
from fastrod.solver.inputs import check_positive
from fastrod.solver.modal import Modes, scheme_of
from fastrod.solver.motion import refuse_with_modes, solver_of
from fastrod.solver.state import Observer

_config: Any = numba.config
_P = ParamSpec("_P")
_R = TypeVar("_R")
_USUAL = "generalized_alpha", 0.5  # scheme and rho of a simulator that is given none
_MOST_PIECES = 16


def checked_robots(robot: object, n_robots: object) -> tuple[tuple[Robot, ...], int]:
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
    if not isinstance(n, (int, np.integer)) or n < 1:
        raise InputError(f"n_robots is {n!r}; it must be a whole number, at least 1.")
    if len(robots) not in (1, n):
        raise InputError(f"{len(robots)} robots for n_robots {n}; give one for all, or a list of n_robots.")
    return robots, int(n)


def check_options(points_per_segment: object, dt: object, outputs: object, kept: object) -> None:
    """Raise `InputError` for an option of `Simulator` that cannot be; `kept` is its
    `kept_jacobian_tolerance`."""
    if not isinstance(points_per_segment, (int, np.integer)) or points_per_segment < 2:
        raise InputError(
            f"points_per_segment is {points_per_segment!r}; it must be a whole number, at least 2."
        )
    check_positive("dt", dt, "s")
    if outputs not in ("full", "tip"):
        raise InputError(f"outputs is {outputs!r}; it must be 'full' or 'tip'.")
    if not isinstance(kept, (int, float, np.floating)) or not 0.0 <= kept <= float_info.max:
        raise InputError(f"kept_jacobian_tolerance is {kept!r} m; it must be a number, zero or positive.")


def checked_threads(threads: object) -> int:
    """The number of threads; None is numba's. Raises `InputError`."""
    most = int(_config.NUMBA_NUM_THREADS)
    if threads is None:
        return int(numba.get_num_threads())
    if not isinstance(threads, int) or not 1 <= threads <= most:
        raise InputError(f"threads is {threads!r}; it must be a whole number from 1 to {most} here.")
    return threads


def check_solver(
    robots: Sequence[Robot],
    solver: Literal["observer", "modal"] | None,
    dynamics: bool,
    scheme: str,
    rho: float,
    modes: Modes | None,
) -> Literal["observer", "modal"]:
    """The solver of these robots. Raises `InputError` for one that there is not or that cannot do what is
    asked, and for options that it does not read."""
    if not isinstance(dynamics, bool):
        raise InputError(f"dynamics is {dynamics!r}; it must be True or False.")
    found = solver_of(robots, solver, dynamics)
    scheme_of(scheme, rho)
    if modes is not None:
        _check_modes(modes)
        if found == "observer":
            raise InputError("modes was given to the observer, which has none; give solver='modal'.")
    if not dynamics and (scheme, rho) != _USUAL:
        what = f"scheme is {scheme!r}" if scheme != _USUAL[0] else f"rho is {rho!r}"
        raise InputError(f"{what} without dynamics, and nothing moves in time; give dynamics=True.")
    return found


def _check_modes(modes: object) -> None:
    if not isinstance(modes, Modes):
        raise InputError(f"modes is {shown(modes)}; give fastrod.Modes(bending=4, torsion=2), or None.")
    for name, value in modes._asdict().items():
        most = _MOST_PIECES if name == "pieces" else N_INTERVALS
        if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or not 1 <= value <= most:
            raise InputError(f"modes has {name}={shown(value)}; give a whole number from 1 to {most}.")


def check_fellows(
    solver: str,
    observer: object,
    contact: object,
    feel_contact: bool,
    device: str,
    kept_jacobian_tolerance: float,
) -> None:
    """Raise `InputError` for an observer or a contact scene that is none, and for options that do not go
    together."""
    if observer is not None and not isinstance(observer, Observer):
        raise InputError(f"observer is {observer!r}; give fastrod.Observer(...) or None.")
    if contact is not None and not isinstance(contact, ContactScene):
        raise InputError(
            f"contact is {contact!r}; give fastrod.contact.ContactScene(obstacles=[...]) or None."
        )
    felt = contact is not None and feel_contact
    if solver == "modal":
        if felt:
            raise InputError(
                "contact was given with rods of modes, which feel none yet; take solver='observer', or "
                "feel_contact=False."
            )
        refuse_with_modes(
            observer=observer is not None,
            device=device == "cuda",
            kept_jacobian_tolerance=kept_jacobian_tolerance > 0.0,
        )
    if device == "cuda" and felt:
        raise InputError(
            "contact was given with device 'cuda', where rods feel none; take "
            "device='cpu', or feel_contact=False."
        )
