"""Collocation: the whole chain at once as a boundary value problem, every span mapped to [0, 1]."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.reference.arcs import arc_states, first_guess
from fastrod.reference.inputs import PointForce, make_problem
from fastrod.reference.rod import (
    CURVATURE,
    PATH,
    Array,
    Problem,
    ReferenceShape,
    base_state,
    grid,
    shape_of,
    slope,
    span_moment,
    tip_residual,
)


def solve_bvp(
    robot: Robot,
    tendon_length: ArrayLike | None = None,
    *,
    tension: ArrayLike | None = None,
    extension: ArrayLike | None = None,
    tip_force: ArrayLike | None = None,
    tip_moment: ArrayLike | None = None,
    line_force: ArrayLike | None = None,
    point_force: PointForce | None = None,
    follower_tip_force: ArrayLike | None = None,
    rtol: float = 1e-8,
    max_nodes: int = 3000,
    points_per_segment: int = 20,
    tolerance: float = 1e-8,
) -> ReferenceShape:
    """Static shape of one robot by collocation (scipy.integrate.solve_bvp), fourth order, adaptive mesh.

    The same equations, inputs, units and frames as `shoot`; states of all spans stacked on [0, 1], tensions
    as parameters. Not for mode `paper`, whose conditions are more than its unknowns, and not for a unilateral
    tendon that goes slack. `rtol` bounds the relative residual of the slopes on at most `max_nodes` nodes,
    `tolerance` [m] the boundary residual of a success.

    Source: Rucker and Webster, IEEE T-RO 27(6), 2011, section III.
    Raises `InputError` for inputs of the wrong shape or range, and for robots in mode `paper`.
    """
    from scipy.integrate import solve_bvp as collocate

    problem = make_problem(
        robot,
        tendon_length,
        tension,
        extension,
        tip_force,
        tip_moment,
        line_force,
        point_force,
        follower_tip_force,
    )
    if problem.paper:
        raise InputError(
            "solve_bvp cannot do mode 'paper': its tendon lengths are met by least squares only; use shoot."
        )
    n_spans, n_free, width = len(problem.spans), int(problem.free.sum()), 15 + robot.n_tendons
    calls = 0

    def unpack(p: Array) -> tuple[Array, Array]:
        """Tension (n_tendons,) and follower force (3,), world, of the parameters."""
        all_tension = problem.tension.copy()
        all_tension[problem.free] = p[:n_free]
        return all_tension, p[n_free:-1] if problem.follows else np.zeros(3)

    def fun(x: Array, y: Array, p: Array) -> Array:
        nonlocal calls
        calls += 1
        all_tension, follower = unpack(p)
        out = []
        for span, state in zip(problem.spans, y.reshape(n_spans, width, -1), strict=True):
            length = span.end - span.start
            out.append(length * slope(span, all_tension, follower, span.start + length * x, state.T).T)
        return np.concatenate(out)

    def conditions(first: Array, last: Array, p: Array) -> Array:
        missed = _conditions(problem, first.reshape(n_spans, width), last.reshape(n_spans, width), *unpack(p))
        return np.append(missed, p[-1])

    nodes = np.linspace(0.0, 1.0, 11)
    states, p = _guess(problem, nodes)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = collocate(
            fun, conditions, nodes, states, p=p, tol=rtol, bc_tol=0.1 * tolerance, max_nodes=max_nodes
        )
    p = p if found.p is None else found.p
    s = grid(problem, points_per_segment)
    missed = float(np.abs(conditions(found.y[:, 0], found.y[:, -1], p)).max())
    success = bool(found.success) and missed < tolerance
    return shape_of(
        s,
        _sample(problem, found.sol, s),
        tension=unpack(p)[0],
        residual=missed,
        evaluations=calls,
        success=success,
        message=f"{found.message} Boundary residual {missed:.3g} m on {len(found.x)} nodes.",
    )


def _sample(problem: Problem, solution: Callable[[Array], Array], s: Array) -> Array:
    """States (n_points, width) at arclengths `s`; a cut's point from the span before it."""
    ends = np.array([span.end for span in problem.spans])
    out = []
    for x in s:
        k = int(np.searchsorted(ends, x))
        span = problem.spans[k]
        out.append(solution((x - span.start) / (span.end - span.start)).reshape(len(ends), -1)[k])
    return np.array(out)


def _conditions(problem: Problem, first: Array, last: Array, tension: Array, follower: Array) -> Array:
    """Base pose, everything but u continuous at each cut, total moment continuous there, and the tip;
    `first`, `last` (n_spans, width)."""
    scale = problem.length**2 / problem.bending_stiffness
    still = np.r_[: CURVATURE.start, PATH.start : first.shape[1]]
    residuals = [(first[0] - base_state(problem.robot))[still]]
    for k in range(1, len(problem.spans)):
        residuals.append((first[k] - last[k - 1])[still])
        jump = span_moment(problem.spans[k], tension, first[k, CURVATURE])
        jump -= span_moment(problem.spans[k - 1], tension, last[k - 1, CURVATURE])
        residuals.append(scale * jump)
    return np.concatenate([*residuals, tip_residual(problem, tension, follower, last[-1])])


def _guess(problem: Problem, nodes: Array) -> tuple[Array, Array]:
    """Arcs under the first guess: stacked states (n_spans * width, n_nodes) and parameters.

    The last parameter is a spare, held at zero: scipy treats a problem without parameters as one of another
    kind.
    """
    u, tension, _, follower = first_guess(problem)
    backbone = np.diff(problem.segment_end, prepend=0.0)
    fine = 200
    states = arc_states(problem.robot, backbone, u, np.arange(1, fine + 1) / fine)
    s = grid(problem, fine)
    stacked = []
    for span in problem.spans:
        here = span.start + (span.end - span.start) * nodes
        block = np.array([np.interp(here, s, column) for column in states.T])
        block[CURVATURE] = u[span.segment][:, None]
        stacked.append(block)
    return np.concatenate(stacked), np.concatenate(
        [tension[problem.free], follower if problem.follows else [], [0.0]]
    )
