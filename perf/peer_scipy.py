"""scipy on the rod of Appendix J: shooting with the lean slope of `scipy_rod`, and collocation."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

import scipy_rod
from appendix_j import BENDING, LENGTH, TORSION, Array, Peer, Rung, Solve, one_by_one

_NO_TENDON = ((0.0, 0.0, 0.0),)  # one without tension: the compiled slope cannot go over none


@contextmanager
def _shoot(method: str, rtol: float) -> Iterator[Solve]:
    """Three unknown curvatures at the base, three moments at the tip that must vanish; the rod in space."""
    from scipy.integrate import solve_ivp
    from scipy.optimize import root

    rod, slope = (LENGTH, BENDING, BENDING, TORSION), scipy_rod.compiled_slope()
    size = 15 + len(_NO_TENDON)
    tolerance = 0.1 * rtol * LENGTH / LENGTH ** np.repeat([0, 1, 2, 0], [3, 9, 3, 1])

    def march(x: Array, load: tuple[float, ...]) -> Array:
        """State at the tip for curvatures x/l at the base."""
        state = np.zeros(size)
        state[[3, 7, 11]] = 1.0
        state[12:15] = x / LENGTH

        def fun(s: float, y: Array) -> Any:
            return slope(s, y, load, rod, _NO_TENDON, np.empty(size))

        found: Any = solve_ivp(fun, (0.0, LENGTH), state, method=method, rtol=rtol, atol=tolerance)
        return np.asarray(found.y[:, -1])

    def rest(across: float) -> Array:
        load = (0.0, across, 0.0, 0.0, 0.0, 0.0)
        found = root(lambda x: LENGTH * march(x, load)[12:15], np.zeros(3), tol=0.1 * rtol)
        return march(found.x, load)[1:3]

    yield one_by_one(rest)


@contextmanager
def _collocate(tol: float) -> Iterator[Solve]:
    """The plane problem: angle, curvature, across, along over s/l, four states."""
    from scipy.integrate import solve_bvp

    mesh = np.linspace(0.0, 1.0, 5)
    straight = np.array([np.zeros(5), np.zeros(5), np.zeros(5), mesh])

    def ends(a: Array, b: Array) -> Array:
        return np.array([a[0], b[1], a[2], a[3]])

    def rest(across: float) -> Array:
        load = across * LENGTH**2 / BENDING

        def fun(_: Array, y: Array) -> Array:
            cos = np.cos(y[0])
            return np.array([y[1], -load * cos, np.sin(y[0]), cos])

        found: Any = solve_bvp(fun, ends, mesh, straight, tol=tol)
        return np.asarray(LENGTH * found.y[2:, -1])

    yield one_by_one(rest)


_METHODS = (("RK23", 1e-2), ("RK45", 1e-3), ("RK45", 1e-5), ("DOP853", 1e-6), ("DOP853", 1e-9))
SHOOT = Peer(
    name="scipy shooting",
    modules=("scipy",),
    same="the rod in space by solve_ivp and root, its slope compiled by numba, so that the time is scipy's "
    "own.",
    also="any equations: it is a solver, not a simulator.",
    rungs=[Rung(f"{method}, rtol {rtol:.0e}", partial(_shoot, method, rtol)) for method, rtol in _METHODS],
)
COLLOCATE = Peer(
    name="scipy solve_bvp",
    modules=("scipy",),
    same="the rod in its plane, four states of numpy expressions; the plane is given to it, which fastrod "
    "finds by itself.",
    also="any equations, and a mesh that refines itself.",
    rungs=[Rung(f"tol {tol:.0e}", partial(_collocate, tol)) for tol in (1e-1, 1e-2, 1e-3, 1e-5, 1e-7)],
)
