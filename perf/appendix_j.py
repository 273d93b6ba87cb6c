"""The rod of the paper's Appendix J, a passive cantilever under a dead tip force, and what a peer is."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from importlib.metadata import version
from typing import TypeAlias

import numpy as np

from cases import Array
from fastrod import Robot, load_robot

FORCES: Array = np.linspace(0.05, 0.7, 14)  # load cases F_y [N]
Solve: TypeAlias = Callable[[Array], Array]
"""Tips at rest (n, 2) across and along the straight rod [m] under tip forces (n,) across it [N]."""
Build: TypeAlias = Callable[[], AbstractContextManager[Solve]]
"""Makes everything that does not depend on the force; what it holds is given back at the end."""


def robot() -> Robot:
    """The prototype's rod without tendons: 0.07 m, K = diag(0.0022, 0.0022, 0.001) N m^2."""
    prototype = load_robot("prototype")
    return replace(prototype, segments=(replace(prototype.segments[0], tendons=(), mode="passive"),))


LENGTH = robot().length  # m
BENDING, TORSION = robot().segments[0].bending_stiffness[0], robot().segments[0].torsional_stiffness
"""EI of the round section, and GJ [N m^2]."""


def tips(force: Array) -> Array:
    """(n, 2) tip across and along the straight rod [m] under forces (n,) > 0 [N].

    The elastica by elliptic integrals of parameter m = (1 + sin b)/2, b the tip's angle, sin^2 phi = 1/(2 m):
    sqrt(F l^2/EI) = K(m) - F(phi, m), and the tip follows from E. No step, no iteration but the bisection of
    b. Source: Bisshopp and Drucker, Large deflection of cantilever beams, Q. Appl. Math. 3(3), 1945.
    """
    from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

    root = np.sqrt(np.asarray(force, dtype=np.float64) * LENGTH**2 / BENDING)
    low, high = np.zeros_like(root), np.full_like(root, 0.5 * np.pi - 1e-9)
    for _ in range(60):
        angle = 0.5 * (low + high)
        m = 0.5 * (1.0 + np.sin(angle))
        phi = np.arcsin(np.sqrt(0.5 / m))
        too_far = ellipk(m) - ellipkinc(phi, m) > root
        low, high = np.where(too_far, low, angle), np.where(too_far, angle, high)
    across = 1.0 - 2.0 / root * (ellipe(m) - ellipeinc(phi, m))
    along = np.sqrt(2.0 * np.sin(angle)) / root
    return LENGTH * np.stack([across, along], axis=-1)


def one_by_one(rest: Callable[[float], Sequence[float]]) -> Solve:
    """Solves load after load by what gives the tip (across, along) of one."""
    return lambda force: np.array([rest(across) for across in force.tolist()])


@dataclass(frozen=True)
class Rung:
    """One setting of a peer."""

    label: str
    build: Build  # solves one force after the other, from the straight rod unless the peer says otherwise
    together: Build | None = None  # solves all forces in one call, where the peer has such a thing of its own


@dataclass(frozen=True, eq=False)
class Peer:
    """One method to find the tip of the rod."""

    name: str  # begins with the family: peers of one family have one colour in the plot
    modules: Sequence[str]  # what must be importable
    same: str  # what was done so that it solves the same problem, and what could not be matched
    also: str  # what it does that fastrod does not
    rungs: Sequence[Rung]  # from coarse to fine

    @property
    def family(self) -> str:
        return self.name.replace(",", "").split()[0]

    def missing(self) -> str | None:
        """A sentence where the peer cannot run here."""
        absent = [name for name in self.modules if importlib.util.find_spec(name) is None]
        are = "is" if len(absent) == 1 else "are"
        words = f"is left out: {' and '.join(absent)} {are} not installed (pip install -e '.[peers]')."
        return f"{self.name} {words}" if absent else None

    def versions(self) -> str:
        packages = ["pyelastica" if name == "elastica" else name for name in self.modules]
        return ", ".join(f"{name} {version(name)}" for name in packages)
