"""The rod of the paper's Appendix J: a passive cantilever under a dead force across its tip, and its closed
form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fastrod import Robot, load_robot

Array = NDArray[np.float64]
FORCES: Array = np.linspace(0.05, 0.7, 14)
"""Load cases F_y [N]."""


def robot() -> Robot:
    """The prototype's rod without tendons: 0.07 m, K = diag(0.0022, 0.0022, 0.001) N m^2."""
    prototype = load_robot("prototype")
    return replace(prototype, segments=(replace(prototype.segments[0], tendons=(), mode="passive"),))


def length() -> float:
    """[m]"""
    return robot().length


def bending() -> float:
    """EI [N m^2]; the section is round."""
    return robot().segments[0].bending_stiffness[0]


def torsion() -> float:
    """GJ [N m^2]."""
    return robot().segments[0].torsional_stiffness


def tips(force: Array) -> Array:
    """(n, 2) tip across and along the straight rod [m] under forces (n,) > 0 [N].

    The elastica by elliptic integrals of parameter m = (1 + sin b)/2, b the tip's angle, sin^2 phi = 1/(2 m):
    sqrt(F l^2/EI) = K(m) - F(phi, m), and the tip follows from E. No step, no iteration but the bisection of
    b. Source: Bisshopp and Drucker, Large deflection of cantilever beams, Q. Appl. Math. 3(3), 1945.
    """
    from scipy.special import ellipe, ellipeinc, ellipk, ellipkinc

    root = np.sqrt(np.asarray(force, dtype=np.float64) * length() ** 2 / bending())
    low, high = np.zeros_like(root), np.full_like(root, 0.5 * np.pi - 1e-9)
    for _ in range(60):
        angle = 0.5 * (low + high)
        m = 0.5 * (1.0 + np.sin(angle))
        phi = np.arcsin(np.sqrt(0.5 / m))
        too_far = ellipk(m) - ellipkinc(phi, m) > root
        low, high = np.where(too_far, low, angle), np.where(too_far, angle, high)
    across = 1.0 - 2.0 / root * (ellipe(m) - ellipeinc(phi, m))
    along = np.sqrt(2.0 * np.sin(angle)) / root
    return length() * np.stack([across, along], axis=-1)
