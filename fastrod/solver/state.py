"""Inputs and outputs of a `Simulator`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fastrod.errors import InputError, Problem, ProblemSentence
from fastrod.model.robot import Robot
from fastrod.solver.inputs import Inputs
from fastrod.types import Flags, Floats, Ints, Params, Ports, RodShape

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from fastrod.contact.contacts import Contacts
    from fastrod.contact.engine import ContactSnapshot

MOVING = ("velocity", "strain", "kinetic_energy", "strain_energy")
"""Fields of a `State` that rods of modes have."""


@dataclass(frozen=True, repr=False)
class State:
    """The robots after a step: new arrays, robot axis first, world frame. With outputs="tip", those along the
    rod are empty.

    A node is shared by two segments at a joint; its curvature is that of the distal one. Read, do not write:
    `shape` goes by these arrays.
    """

    position: Floats
    """(n_robots, n_points, 3) backbone [m]."""
    rotation: Floats
    """(n_robots, n_points, 3, 3) world_from_material."""
    curvature: Floats
    """(n_robots, n_points, 3) material frame [1/m]."""
    arclength: Floats
    """(n_robots, n_points) [m]."""
    moment: Floats
    """(n_robots, n_points, 3) total internal moment of rod and tendons, material frame [N m]."""
    force: Floats
    """(n_robots, n_points, 3) total internal force: the loads beyond the node [N]."""
    tip_position: Floats
    """(n_robots, 3) [m]."""
    tip_rotation: Floats
    """(n_robots, 3, 3) world_from_material."""
    tension: Floats
    """(n_robots, n_tendons) positive pulls; in paper mode, which has no tensions, 0 [N]."""
    path_length: Floats
    """(n_robots, n_tendons) length of the tendon's path along the bent rod, without its stretch [m]."""
    base_wrench: Floats
    """(n_robots, 6) force [N], then moment about the base point [N m], that the robot exerts on its host."""
    residual: Floats
    """(n_robots,) largest boundary residual [m]: lengths as they are, moments times l^2/EI, forces times
    l^3/EI. Of a robot that is not ok it is that of what was tried."""
    ok: Flags
    """(n_robots,) after `settle`: it converged. After `step`: it did not diverge; `residual` says how far the
    observer is behind. A robot that is not ok has the last shape that was solved, nan where there is none or
    its input cannot be used."""
    passes: Ints
    """(n_robots,) forward passes that were spent: after `step` 1, or more where it settled a robot whose pass
    diverged; -1 where no shape was found, 0 where bad input left nothing to do."""
    problems: Mapping[int, str]
    """Robot index -> what is wrong with it, for the robots that are not ok: a sentence (`problem_kinds`)."""
    contacts: Contacts | None = None
    """Contacts of the rods and the obstacles; None without a contact scene."""
    velocity: Floats | None = None
    """(n_robots, n_points, 3) world [m/s]; None but for rods of modes, as the three that follow."""
    strain: Floats | None = None
    """(n_robots, n_points, 3) shear along d1 and d2, and stretch."""
    kinetic_energy: Floats | None = None
    """(n_robots,) [J]"""
    strain_energy: Floats | None = None
    """(n_robots,) of the backbone [J]."""
    mean_wrench: Floats | None = None
    """(n_robots, 6) as `base_wrench`, but its mean over the step, about where the base point was before it:
    with it rod and host exchange momentum and lose none. None but where the host's inertia was given."""
    step_error: Floats | None = None
    """(n_robots,) by how much the tip is off by the last step alone [m]; None but where it was asked for, nan
    of a robot that took none."""

    @property
    def problem_kinds(self) -> dict[int, Problem]:
        """Robot index -> the kind of its problem, for the robots that are not ok."""
        return {
            i: said.kind if isinstance(said, ProblemSentence) else Problem.DIVERGED
            for i, said in self.problems.items()
        }

    def as_shape(self) -> RodShape:
        """The arrays that a pass writes."""
        return RodShape(*(getattr(self, name) for name in RodShape._fields))

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the rods on 3D axes of matplotlib, in mm; on new ones where none are given."""
        return plot_rods(self.position, axes)

    def _repr_html_(self) -> str:
        return html_of(self.tip_position, self.tension, self.ok, self.problems)

    def __repr__(self) -> str:
        n = len(self.ok)
        along = f"n_points={self.position.shape[1]}" if len(self.position) else "tip only"
        residual = np.max(self.residual, where=self.ok, initial=0.0)
        text = f"State(n_robots={n}, {along}, ok={int(self.ok.sum())} of {n}, residual<={residual:.3g} m"
        if self.contacts is not None:
            text += f", contacts={int(self.contacts.count.sum())}"
        if self.problems:
            i = min(self.problems)
            text += f", robot {i}: {self.problems[i]!r}"
        return text + ")"


class Pose(NamedTuple):
    """Cross-sections at given arclengths."""

    position: Floats
    """(n_robots, n_queries, 3) world [m]."""
    rotation: Floats
    """(n_robots, n_queries, 3, 3) world_from_material."""
    curvature: Floats
    """(n_robots, n_queries, 3) material frame [1/m]."""


def check_on_robot(arclength: Floats, state: State) -> None:
    """Raise `InputError` where one of (n_robots, n_queries) [m] is not on its robot."""
    end = state.arclength[:, -1:]
    bad = ~((arclength >= 0.0) & (arclength <= end * (1.0 + 1e-9))) & state.ok[:, None]
    if bad.any():
        i, j = np.argwhere(bad)[0]
        raise InputError(f"arclength {arclength[i, j]:.6g} m; robot {i} runs from 0 to {end[i, 0]:.6g} m.")


class Snapshot(NamedTuple):
    """Everything that a later step depends on."""

    robots: tuple[Robot, ...]
    memory: Any
    """Memory of the solver."""
    warm: Flags
    """(n_robots,) there is a shape to go on from."""
    given: Inputs
    ports: Ports | None
    state: State | None
    params: Params
    bare: Ports | None
    effects: list[Floats]
    """The memory of each effect, in their order."""
    time: Floats
    """(n_robots,) as effects count it [s]; nan before the first step."""
    contact: ContactSnapshot | None


def check_snapshot(snapshot: Snapshot, effects: list[Floats], has_contact: bool) -> None:
    """Raise `InputError` where a snapshot is none of a simulator with these memories of effects, and perhaps
    a contact scene."""
    if [a.shape for a in snapshot.effects] != [a.shape for a in effects]:
        raise InputError("the snapshot is of another simulator; its effects differ.")
    if (snapshot.contact is None) == has_contact:
        raise InputError("the snapshot is of another simulator; only one of them has a contact scene.")


_MOST = 30  # robots that are drawn, the first ones
_LISTED = 8  # robots of the table


def plot_rods(position: Floats, axes: Axes | None = None) -> Axes:
    """Backbones (n_robots, n_points, 3) [m] of the first robots, in mm, on 3D axes; new ones where none are
    given."""
    from matplotlib import pyplot

    if position.size == 0:
        raise InputError("this state has tips only; make the simulator with outputs='full' to plot it.")
    if axes is None:
        axes = pyplot.figure(figsize=(5.0, 5.0)).add_subplot(projection="3d")
    rods = 1e3 * position[:_MOST]
    for rod in rods:
        axes.plot(*rod.T, lw=2.0)
        axes.plot(*rod[-1:].T, "o", color="black", ms=3.0)
    known = rods[np.isfinite(rods).all(axis=(1, 2))].reshape(-1, 3)
    if len(known):
        middle, half = 0.5 * (known.max(0) + known.min(0)), 0.55 * float(np.ptp(known, axis=0).max())
        for name, at in zip("xyz", middle, strict=True):
            getattr(axes, f"set_{name}lim")(at - half, at + half)
            getattr(axes, f"set_{name}label")(f"{name} [mm]")
        axes.set_box_aspect((1.0, 1.0, 1.0))  # type: ignore[arg-type]
    return axes


def html_of(tip_position: Floats, tensions: Floats, ok: Flags, problems: Mapping[int, str]) -> str:
    """Tips and tensions of the first robots as an HTML table."""
    rows = []
    for i in range(min(_LISTED, len(ok))):
        tip = ", ".join(f"{1e3 * x:.2f}" for x in np.round(tip_position[i], 5) + 0.0)
        tension = ", ".join(f"{x:.3g}" for x in np.round(tensions[i], 6) + 0.0)
        said = "ok" if ok[i] else problems.get(i, "not ok")
        rows.append(f"<tr><td>{i}</td><td>{tip}</td><td>{tension}</td><td>{said}</td></tr>")
    more = len(ok) - len(rows)
    head = "".join(f"<th>{name}</th>" for name in ("robot", "tip [mm]", "tension [N]", ""))
    rest = f"<tr><td colspan=4>and {more} more</td></tr>" if more else ""
    return f"<table><tr>{head}</tr>{''.join(rows)}{rest}</table>"
