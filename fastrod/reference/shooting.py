"""Shooting: integrate the rod from a guessed base, correct the guess until the tip fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError, nearest
from fastrod.model.robot import Robot
from fastrod.reference.arcs import first_guess
from fastrod.reference.inputs import PointForce, make_problem
from fastrod.reference.rod import (
    CURVATURE,
    PATH,
    ROTATION,
    Array,
    Problem,
    ReferenceShape,
    Span,
    base_state,
    curvature_of_moment,
    grid,
    internal_force,
    shape_of,
    slope,
    span_moment,
    tip_residual,
)

Method: TypeAlias = Literal["lm", "slsqp", "trust-constr"]
Residual: TypeAlias = Callable[[Array], Array]

_METHODS = ("lm", "slsqp", "trust-constr")
_INTEGRATORS = ("RK45", "RK23", "DOP853", "Radau", "BDF", "LSODA")
_LARGE = 6.0  # rad of bend by the loads; beyond it the first guess is too far away for a shot
_LOST = 100.0  # rad of bend; a trial that coils up further costs much time and yields nothing


def shoot(
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
    method: Method = "lm",
    integrator: str = "DOP853",
    rtol: float = 1e-9,
    atol: float = 1e-11,
    points_per_segment: int = 20,
    guess: ReferenceShape | None = None,
    tolerance: float = 1e-9,
) -> ReferenceShape:
    """Static shape of one robot by shooting: scipy integrates, scipy finds the boundary unknowns.

    Unknowns: total internal moment at the base, tension of every tendon of a `tendon_length` segment.
    Conditions: each such tendon's length, l_i = L_i + c_i (T_i - T0_i), and m(l) = R^T M_tip. A unilateral
    tendon whose tension would be negative is slack, T = 0, and its length condition is dropped. Total moment
    is continuous across a joint, so what jumps there is u. A robot in mode `paper`: T = 0 in the balance,
    unknowns u_x and u_y at each segment's base with u_z = 0 there, and the tendon lengths met in the
    least-squares sense.

    - `tendon_length` (n_tendons,) [m], absolute, base to where the tendon ends; read in `tendon_length` and
      `paper` segments.
    - `tension` (n_tendons,) [N]; read in `tendon_tension` segments.
    - `extension` (n_segments,) change of backbone length [m].
    - `tip_force` [N], `tip_moment` [N m]: (3,), dead, world frame. `follower_tip_force` (3,) [N], material
      frame of the tip.
    - `line_force` [N/m], world: (3,), or (n_segments, points, 3) linear between evenly spaced points of each
      segment. A segment's line_density * gravity is added.
    - `point_force`: pairs of arclength along the backbone as it is, extension included [m], and force (3,),
      world [N].
    - `method`: `lm` least squares; `slsqp` and `trust-constr` with the conditions as equality constraints.
    - `integrator`, `rtol`, `atol`: of scipy.integrate.solve_ivp, over each stretch where no load jumps.
    - `guess`: an earlier shape of the same robot; by default arcs from the lengths and the loads' moment on
      them. When that fails, the loads are raised in steps.
    - `tolerance` [m]: a residual above it is no success; see `ReferenceShape.residual` for the scaling.

    Source: Rucker and Webster, IEEE T-RO 27(6), 2011, section III (tendon rod, here inextensible and
    unshearable); mode `paper`: Kasaei et al., CoRL 2024, eq. 1 to 3, with eq. 1c's integral taken from s to
    l. Raises `InputError` for inputs of the wrong shape or range. A search that fails returns success False.
    """
    if method not in _METHODS:
        raise InputError(f"no method {method!r}; {nearest(str(method), _METHODS)}")
    if integrator not in _INTEGRATORS:
        raise InputError(f"no integrator {integrator!r}; {nearest(str(integrator), _INTEGRATORS)}")
    if points_per_segment < 1:
        raise InputError(f"points_per_segment is {points_per_segment}; it must be 1 or more.")
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
    search = _Search(method, integrator, rtol, atol, tolerance)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        problem, x, missed, passes = _complementary(
            search, problem, None if guess is None else _from_shape(problem, guess)
        )
        s = grid(problem, points_per_segment)
        try:
            states = _march(search, problem, x, s)
        except (ArithmeticError, np.linalg.LinAlgError):
            states = np.full((len(s), 15 + robot.n_tendons), np.nan)
            missed = np.inf
    success = missed < tolerance or (problem.paper and np.isfinite(missed))
    return shape_of(
        s,
        states,
        tension=_unpack(problem, x)[1],
        residual=missed,
        evaluations=passes,
        success=bool(success),
        message=f"{'solved' if success else 'not solved'} with {method}: residual {missed:.3g} m after "
        f"{passes} forward passes",
    )


@dataclass(frozen=True)
class _Search:
    """Options of the search: the numerical arguments of `shoot`, and the passes they cost."""

    method: Method
    integrator: str
    rtol: float
    atol: float
    tolerance: float


def _scale(problem: Problem) -> tuple[float, float, float]:
    """Units that make every unknown about one: moment or curvature, tension, force."""
    offset = (
        max((float(np.abs(span.offset).max(initial=0.0)) for span in problem.spans), default=0.0)
        or problem.length
    )
    moment = problem.bending_stiffness / problem.length
    return (1.0 / problem.length if problem.paper else moment), moment / offset, moment / problem.length


def _pack(problem: Problem, base: Array, tension: Array, follower: Array) -> Array:
    first, second, third = _scale(problem)
    blocks = [base.ravel() / first, tension[problem.free] / second]
    return np.concatenate([*blocks, follower / third] if problem.follows else blocks)


def _unpack(problem: Problem, x: Array) -> tuple[Array, Array, Array]:
    """Base moment (3,), or in mode `paper` u_x, u_y per segment (n_segments, 2); tension (n_tendons,);
    follower force (3,), world."""
    first, second, third = _scale(problem)
    n_base = 2 * problem.robot.n_segments if problem.paper else 3
    n_free = int(problem.free.sum())
    tension = problem.tension.copy()
    tension[problem.free] = second * x[n_base : n_base + n_free]
    base = first * x[:n_base]
    follower = third * x[n_base + n_free :] if problem.follows else np.zeros(3)
    return (base.reshape(-1, 2) if problem.paper else base), tension, follower


def _guess(problem: Problem) -> Array:
    u, tension, moment, follower = first_guess(problem)
    return _pack(problem, u[:, :2] if problem.paper else moment, tension, follower)


def _from_shape(problem: Problem, shape: ReferenceShape) -> Array:
    """Unknowns of an earlier shape."""
    n = problem.robot.n_segments
    if shape.tension.shape != (problem.robot.n_tendons,) or (len(shape.arclength) - 1) % n:
        raise InputError("guess is the shape of another robot; it must have the same segments and tendons.")
    tension = np.nan_to_num(shape.tension)
    step = (len(shape.arclength) - 1) // n
    # one point into each segment, because the joint itself holds the value before it
    base = shape.curvature[[k * step + (k > 0) for k in range(n)], :2]
    if not problem.paper:
        base = span_moment(
            problem.spans[0], np.where(problem.free, tension, problem.tension), shape.curvature[0]
        )
    return _pack(problem, base, tension, shape.tip_rotation @ problem.follower)


def _march(search: _Search, problem: Problem, x: Array, points: Array | None = None) -> Array:
    """States (p, 15 + n_tendons) at `points`, base included, or the tip's alone (1, 15 + n_tendons).

    Raises ArithmeticError where a trial breaks off.
    """
    base, tension, follower = _unpack(problem, x)
    state = base_state(problem.robot)
    before: Span | None = None
    out: list[Array] = []
    for span in problem.spans:
        if before is None or before.segment != span.segment:
            state[CURVATURE] = _entry(problem, before, span, base, tension, state[CURVATURE])
        if before is None:
            out.append(state[None])
        inside = np.zeros(0) if points is None else points[(points > span.start) & (points <= span.end)]
        state, states = _along(search, problem, span, tension, follower, state, inside)
        out.append(states)
        before = span
    return state[None] if points is None else np.concatenate(out)


def _entry(problem: Problem, before: Span | None, span: Span, base: Array, tension: Array, u: Array) -> Array:
    """Curvature (3,) at the base of a segment, after `u` (3,) at the end of the one before."""
    if problem.paper:
        return np.array([*base[span.segment], 0.0])
    if before is None:
        return curvature_of_moment(span, tension, base, span.precurvature)
    return curvature_of_moment(span, tension, span_moment(before, tension, u), u)


def _along(
    search: _Search,
    problem: Problem,
    span: Span,
    tension: Array,
    follower: Array,
    state: Array,
    inside: Array,
) -> tuple[Array, Array]:
    """State at the end of a span, and states (p, 15 + n_tendons) at the arclengths `inside`."""
    from scipy.integrate import solve_ivp

    def fun(s: float, y: Array) -> Array:
        if np.abs(y[CURVATURE]).max() * problem.length > _LOST:
            raise ArithmeticError("the trial coils up")
        return np.asarray(slope(span, tension, follower, np.array([s]), y[None])[0])

    options: Any = {
        "method": search.integrator,
        "rtol": search.rtol,
        "atol": search.atol,
        "dense_output": bool(len(inside)),
    }
    found: Any = solve_ivp(fun, (span.start, span.end), state, **options)
    end = np.array(found.y[:, -1])
    if not found.success or not np.all(np.isfinite(end)):
        raise ArithmeticError(found.message)
    return end, np.asarray(found.sol(inside)).T if len(inside) else np.zeros((0, len(state)))


def _missed(search: _Search, problem: Problem, x: Array) -> Array:
    """All boundary residuals of a trial [m]."""
    _, tension, follower = _unpack(problem, x)
    try:
        tip = _march(search, problem, x)[0]
    except (ArithmeticError, np.linalg.LinAlgError):
        # a trial that breaks off is only far away: every method steps back from a large residual
        n = (problem.robot.n_tendons if problem.paper else 3 + int(problem.free.sum())) + 3 * problem.follows
        return np.full(n, 1e3)
    if not problem.paper:
        return tip_residual(problem, tension, follower, tip)
    length = np.asarray(tip[PATH] - problem.tendon_length)
    if not problem.follows:
        return length
    compliance = problem.length**3 / problem.bending_stiffness
    return np.concatenate([length, compliance * (tip[ROTATION].reshape(3, 3) @ problem.follower - follower)])


def _solve(search: _Search, problem: Problem, guess: Array) -> tuple[Array, float, int]:
    """Unknowns, largest residual [m] and forward passes of one search."""
    passes = 0

    def residual(x: Array) -> Array:
        nonlocal passes
        passes += 1
        return _missed(search, problem, x) / problem.length

    def jacobian(x: Array) -> Array:
        # a step at the square root of the integrator's error balances that error against the curvature of the
        # residual
        step = search.rtol**0.5
        here = residual(x)
        return np.stack([(residual(x + step * e) - here) / step for e in np.eye(len(x))], axis=1)

    n_conditions = len(residual(guess))
    if len(guess) > n_conditions:
        n_tendons = problem.robot.n_tendons
        raise InputError(
            f"{len(guess)} unknowns for {n_tendons} tendon lengths; mode 'paper' needs two "
            "tendons a segment or more."
        )
    square = len(guess) == n_conditions
    x = _FIND[search.method](residual, jacobian, guess, square, search.tolerance / problem.length)
    return x, float(np.abs(residual(x)).max(initial=0.0)) * problem.length, passes


def _least_squares(
    residual: Residual, jacobian: Residual, guess: Array, _square: bool, _tolerance: float
) -> Array:
    from scipy.optimize import least_squares

    found = least_squares(
        residual,
        guess,
        jac=jacobian,
        method="lm",
        x_scale="jac",
        xtol=1e-12,
        ftol=1e-14,
        gtol=1e-15,
        max_nfev=100,
    )
    return np.asarray(found.x)


def _slsqp(residual: Residual, jacobian: Residual, guess: Array, square: bool, tolerance: float) -> Array:
    from scipy.optimize import minimize

    if not square:
        squares, gradient = _half_squares(residual, jacobian)
        return np.asarray(
            minimize(squares, guess, jac=gradient, method="SLSQP", options={"ftol": 1e-20, "maxiter": 500}).x
        )
    # with nothing to minimise, SLSQP's step is Newton's on the conditions, safeguarded by its line search
    conditions: Any = {"type": "eq", "fun": residual, "jac": jacobian}
    options: Any = {"ftol": 0.1 * tolerance, "maxiter": 200}
    return np.asarray(
        minimize(_nothing, guess, jac=_no_slope, method="SLSQP", constraints=conditions, options=options).x
    )


def _trust_constr(
    residual: Residual, jacobian: Residual, guess: Array, square: bool, tolerance: float
) -> Array:
    from scipy.optimize import NonlinearConstraint, minimize

    def gauss_newton(x: Array) -> Array:
        j = jacobian(x)
        return np.asarray(j.T @ j)

    if not square:
        squares, gradient = _half_squares(residual, jacobian)
        options: Any = {"gtol": 1e-14, "xtol": 1e-13, "maxiter": 500}
        return np.asarray(
            minimize(
                squares, guess, jac=gradient, hess=gauss_newton, method="trust-constr", options=options
            ).x
        )
    conditions: Any = NonlinearConstraint(residual, 0.0, 0.0, jac=jacobian, hess=_no_curvature)
    limits: Any = {"gtol": 0.1 * tolerance, "xtol": 1e-13, "maxiter": 500}
    hess: Any = _no_curvature
    found = minimize(
        _nothing,
        guess,
        jac=_no_slope,
        hess=hess,
        method="trust-constr",
        constraints=conditions,
        options=limits,
    )
    return np.asarray(found.x)


def _nothing(_x: Array) -> float:
    return 0.0


def _no_slope(x: Array) -> Array:
    return np.zeros(len(x))


def _no_curvature(x: Array, *_: Any) -> Array:
    return np.zeros((len(x), len(x)))


def _half_squares(residual: Residual, jacobian: Residual) -> tuple[Callable[[Array], float], Residual]:
    return lambda x: 0.5 * float(np.sum(residual(x) ** 2)), lambda x: np.asarray(jacobian(x).T @ residual(x))


_FIND = {"lm": _least_squares, "slsqp": _slsqp, "trust-constr": _trust_constr}


def _continued(search: _Search, problem: Problem, guess: Array | None) -> tuple[Array, float, int]:
    """One search; where it fails, or the loads are large, the loads in steps, each from the shape before.

    Under large loads a cantilever has several equilibria: the one that grows out of the unloaded rod is
    meant.
    """
    bend = _load_bend(problem)
    passes = 0
    x, missed = _guess(problem) if guess is None else guess, np.inf
    if guess is not None or problem.paper or bend < _LARGE:
        x, missed, passes = _solve(search, problem, x)
        # least squares leave a residual in mode `paper`, so there it says nothing about failure
        if missed < search.tolerance or problem.paper:
            return x, missed, passes
    reached, step = 0.0, min(0.25, 0.5 * _LARGE / max(bend, 1e-300))
    smallest = step / 16.0
    last = _guess(problem.scaled(step))
    while reached < 1.0 and step > smallest:
        target = min(1.0, reached + step)
        trial, trial_missed, more = _solve(search, problem.scaled(target), last)
        passes += more
        if trial_missed < search.tolerance:
            reached, last = target, trial
        else:
            step *= 0.5
    if reached == 1.0:
        return last, trial_missed, passes
    if np.isfinite(missed):
        return x, missed, passes
    x, missed, more = _solve(search, problem, x)
    return x, missed, passes + more


def _load_bend(problem: Problem) -> float:
    """About how far the loads alone would bend the straight rod [rad]; a cantilever's P l^2 / EI."""
    force = max(
        float(np.linalg.norm(internal_force(span, np.array([span.start]), problem.follower)))
        for span in problem.spans
    )
    return (
        problem.length
        * (problem.length * force + float(np.linalg.norm(problem.tip_moment)))
        / problem.bending_stiffness
    )


def _complementary(
    search: _Search, problem: Problem, guess: Array | None
) -> tuple[Problem, Array, float, int]:
    """Search with the right tendons slack: T >= 0, path no longer than the tendon, and one of them tight."""
    unilateral = np.array([tendon.unilateral for tendon in problem.robot.tendons], dtype=bool) & problem.free
    tendon_path = problem.tendon_length - problem.compliance * problem.pretension
    passes = 0
    for _ in range(2 * problem.robot.n_tendons + 1):
        x, missed, more = _continued(search, problem, guess)
        passes += more
        base, tension, follower = _unpack(problem, x)
        if not unilateral.any() or not missed < search.tolerance:
            break
        path = _march(search, problem, x)[0, PATH]
        slack = unilateral & ~problem.free
        wrong = (unilateral & problem.free & (tension < 0.0)) | (
            slack & (path - tendon_path > search.tolerance)
        )
        if not wrong.any():
            break
        problem = replace(problem, free=problem.free ^ wrong)
        guess = _pack(problem, base, np.where(wrong, 0.0, tension), follower)
    return problem, x, missed, passes
