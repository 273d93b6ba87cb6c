"""Repeat the observer's pass on frozen inputs until every boundary residual is small: damped Newton, then
load continuation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np

from fastrod.kernels.rod.cold import begin
from fastrod.solver.boundary import BoundarySolver
from fastrod.types import Flags, Floats, Ints, Layout, Memory, Params, Ports, RodShape

_LOADS = ("tension", "tip_force", "tip_moment", "follower_force", "follower_line", "line_force", "node_force")


def cold_start(rows: Ints, layout: Layout, params: Params, ports: Ports, memory: Memory) -> None:
    """Fill x and the curvature guess of the robots `rows` from their inputs alone, and forget what was
    learned before."""
    if len(rows):  # a step asks every time, and hardly ever for anyone
        begin(rows, layout, params, ports, memory)


def unloaded(ports: Ports, layout: Layout, params: Params) -> Ports:
    """The straight robot on the same base, without loads."""
    ends = np.cumsum(params.length + ports.extension, axis=1)[:, layout.tendon_segment]
    zeros: dict[str, Any] = {name: 0.0 * getattr(ports, name) for name in _LOADS}
    return ports._replace(tendon_length=np.ascontiguousarray(ends), **zeros)


Pass: TypeAlias = Callable[[Ints, Ports], Floats]
"""(robots, ports) -> residual of these robots at the x before the update [m]."""

LOST = 0.1
"""Fraction of the robot's length: a residual beyond it is no shape of this robot."""
_MAX_ITERATIONS = 40
_FREE_ITERATIONS = (
    20  # robots with tendons that can go slack: semi-smooth Newton first, monotone only after that
)
_STEEP = 6.0
# passes within tolerance after which tensions that still wander are let go: nothing determines them
_PATIENCE = 4
# in EI/l, about radians of bend: a longer Newton step lands on another equilibrium, if on any
_LONGEST_STEP = 1.5
_SMALLEST_STEP = 1.0 / 64.0
_SMALLEST_LOAD_STEP = 1.0 / 256.0


def settle(
    rows: Ints, warm: Flags, boundary: BoundarySolver, ports: Ports, tolerance: float, run: Pass
) -> Ints:
    """Bring the robots `rows` to rest on `ports`; the passes that each took, and -1 where none of three
    tries converged.

    Warm robots start from their last x, moved to first order to the new inputs; others, and warm ones that
    fail, from a cold guess; what still fails by continuation of its loads, from none to all.
    """
    layout, params = boundary.layout, boundary.params
    passes = np.zeros(boundary.n_robots, np.int64)
    left = rows[warm[rows]]
    if len(left):
        boundary.move_to_inputs(left, ports)
        left = _newton(left, boundary, ports, tolerance, run, passes)
    left = np.sort(np.concatenate([left, rows[~warm[rows]]]))
    steep = left[load_parameter(left, params, ports) > _STEEP]
    left = np.setdiff1d(left, steep)
    if len(left):
        cold_start(left, layout, params, ports, boundary.memory)
        left = _newton(left, boundary, ports, tolerance, run, passes)
    left = np.sort(np.concatenate([left, steep]))
    # hundreds of times what bends a rod by a radian: steps without end; a pull may be solved at once all the
    # same
    heavy = left[_longest_load_step(left, params, ports) < _SMALLEST_LOAD_STEP]
    if len(heavy):
        cold_start(heavy, layout, params, ports, boundary.memory)
        stuck = _newton(heavy, boundary, ports, tolerance, run, passes)
        left = np.setdiff1d(left, np.setdiff1d(heavy, stuck))
        heavy = stuck
    if len(left):
        lost = _continuation(np.setdiff1d(left, heavy), boundary, ports, tolerance, run, passes)
        if len(heavy):
            cold_start(heavy, layout, params, _loaded(ports, np.zeros(boundary.n_robots)), boundary.memory)
        left = np.sort(np.concatenate([lost, heavy]))
        if len(left):
            x = boundary.x[left]
            run(left, ports)  # once: the residual of a robot that is lost is that of all of its loads
            boundary.x[left] = x
    passes[left] = -1
    return passes


def frozen_noise(boundary: BoundarySolver) -> float:
    """Residual variance of a pass on frozen inputs [m^2]: none but rounding, more where the paper's residuals
    contradict each other."""
    return 1e-10 if boundary.layout.paper else 1e-20


def frozen_pass(boundary: BoundarySolver, shape: RodShape) -> Pass:
    """Passes on frozen inputs that write into `shape`, and return the residuals of their rows."""

    def run(rows: Ints, ports: Ports) -> Floats:
        boundary.run(rows, ports, shape, noise=frozen_noise(boundary))
        return boundary.collect(shape, "residual").residual[rows]

    return run


def load_parameter(rows: Ints, params: Params, ports: Ports) -> Floats:
    """F l^2/EI of all forces together: beyond about six a rod has equilibria that no growing load would lead
    to."""

    def of(a: Floats) -> Floats:
        return a if len(a) == 1 else a[rows]

    length = params.length + ports.extension
    force = np.linalg.norm(of(ports.tip_force), axis=1) + np.linalg.norm(of(ports.tip_moment), axis=1) / of(
        params.rod_length
    )
    force = force + (of(length) * np.linalg.norm(of(ports.line_force), axis=-1).max(-1)).sum(1)
    for extra in (ports.follower_force[:, None], ports.node_force):
        if len(extra):
            force = force + np.linalg.norm(of(extra), axis=-1).sum(1)
    return np.broadcast_to(force * of(params.rod_length) / of(params.moment_scale), len(rows))


def _newton(
    rows: Ints, boundary: BoundarySolver, ports: Ports, tolerance: float, run: Pass, passes: Ints
) -> Ints:
    """Newton with step halving; the robots that did not converge."""
    layout, params = boundary.layout, boundary.params
    failed: list[Ints] = []
    x_at = boundary.x[rows]
    step = np.zeros_like(x_at)
    best = np.full(len(rows), np.inf)
    damping = np.ones(len(rows))
    patience = np.full(len(rows), _PATIENCE)
    one_sided = np.broadcast_to(params.unilateral.any(1), boundary.n_robots)[rows]
    for count in range(_MAX_ITERATIONS):
        x_tried = boundary.x[rows]
        residual = run(rows, ports)
        passes[rows] += 1
        after = boundary.x[rows]
        # in paper mode the tendons may contradict each other: at the least-squares boundary the residual
        # stays
        better = residual <= 2.0 * best if layout.paper else residual < best
        if count < _FREE_ITERATIONS:
            # a tendon that goes slack or taut puts a corner into the residuals: over it they rise before they
            # fall
            better |= one_sided & np.isfinite(residual)
        shorter = _within_step_limit(after - x_tried, rows, layout, params)
        if better.all() and shorter is None:
            x_at, step, best = x_tried, after - x_tried, residual
            damping[:] = 1.0
        else:
            if shorter is not None:
                with np.errstate(invalid="ignore"):  # a robot that is lost has no step to shorten
                    after = np.where(
                        shorter[:, None] < 1.0, x_tried + shorter[:, None] * (after - x_tried), after
                    )
            x_at = np.where(better[:, None], x_tried, x_at)
            step = np.where(better[:, None], after - x_tried, step)
            best = np.where(better, residual, best)
            damping = np.where(better, 1.0, 0.5 * damping)
            # a robot's bits do not depend on whether another one is damped
            boundary.x[rows] = np.where(better[:, None], after, x_at + damping[:, None] * step)
        # only a pass that was accepted can end it: what it wrote is what the caller gets
        closed = better & (np.isfinite(residual) if layout.paper else residual <= tolerance)
        patience -= closed
        done = closed & (
            _still(step, rows, layout, params, tolerance + 1e-6 * residual)
            | ((patience <= 0) & (residual <= tolerance))
        )
        lost = ~done & ((damping < _SMALLEST_STEP) | ~np.isfinite(step).all(1))
        failed.append(rows[lost])
        keep = ~(done | lost)
        if not keep.any():
            rows = rows[:0]
            break
        if not keep.all():
            rows, x_at, step = rows[keep], x_at[keep], step[keep]
            best, damping, patience, one_sided = best[keep], damping[keep], patience[keep], one_sided[keep]
    return np.sort(np.concatenate([rows, *failed]))


def _within_step_limit(step: Floats, rows: Ints, layout: Layout, params: Params) -> Floats | None:
    """Factors that keep the base moment from changing by more than `_LONGEST_STEP` EI/l in a pass; None where
    all do."""
    n_base = 2 * len(layout.first_tendon) if layout.paper else 3
    moment = params.moment_scale if len(params.moment_scale) == 1 else params.moment_scale[rows]
    angle = np.abs(step[:, :n_base]).max(1) / moment
    if not (angle > _LONGEST_STEP).any():
        return None
    return np.asarray(np.minimum(1.0, _LONGEST_STEP / np.maximum(angle, 1e-300)))


def _still(step: Floats, rows: Ints, layout: Layout, params: Params, small: Floats) -> Flags:
    """The unknowns no longer move.

    A small residual says little about tensions where tendons hardly stretch, and in paper mode the tendons
    may disagree: then the least-squares boundary is the answer, and the residual says by how much they do.
    """

    def of(a: Floats) -> Floats:
        return a if len(a) == 1 else a[rows]

    if layout.paper:
        bend = np.abs(step).max(1) / of(params.moment_scale)
        return np.asarray(bend * of(params.rod_length) <= small)
    n_free = len(layout.free_tendon)
    if not n_free:
        return np.ones(len(step), bool)
    return np.asarray(np.abs(step[:, 3 : 3 + n_free]).max(1) <= 1e-6 * of(params.tension_scale))


def _continuation(
    rows: Ints, boundary: BoundarySolver, ports: Ports, tolerance: float, run: Pass, passes: Ints
) -> Ints:
    """Continue from the unloaded robot to the loaded one, in load steps that grow with success; the robots
    that did not arrive."""
    layout, params = boundary.layout, boundary.params
    fraction = np.zeros(boundary.n_robots)
    longest = np.full(boundary.n_robots, 0.25)
    longest[rows] = _longest_load_step(rows, params, ports)
    load_step = longest.copy()
    unloaded = _loaded(ports, fraction)
    cold_start(rows, layout, params, unloaded, boundary.memory)
    lost = _newton(rows, boundary, unloaded, tolerance, run, passes)
    rows = np.setdiff1d(rows, lost)
    held = boundary.x.copy()
    while len(rows):
        aim = np.minimum(fraction + load_step, 1.0)
        missed = _newton(rows, boundary, _loaded(ports, aim), tolerance, run, passes)
        arrived = np.setdiff1d(rows, missed)
        fraction[arrived] = aim[arrived]
        held[arrived] = boundary.x[arrived]
        load_step[arrived] = np.minimum(2.0 * load_step[arrived], longest[arrived])
        boundary.x[missed] = held[missed]
        load_step[missed] *= 0.5
        lost = np.concatenate([lost, missed[load_step[missed] < _SMALLEST_LOAD_STEP]])
        rows = np.setdiff1d(rows[fraction[rows] < 1.0], lost)
    return np.sort(lost)


def _longest_load_step(rows: Ints, params: Params, ports: Ports) -> Floats:
    """Fraction of the loads that one step of the continuation may bring: more than a load parameter of three
    could land on another equilibrium."""
    return np.asarray(np.minimum(0.25, 0.5 * _STEEP / np.maximum(load_parameter(rows, params, ports), 1e-9)))


def _loaded(ports: Ports, fraction: Floats) -> Ports:
    """The ports with each robot's loads scaled."""

    def scaled(a: Floats) -> Floats:
        return a if not len(a) else np.ascontiguousarray(fraction.reshape(-1, *[1] * (a.ndim - 1)) * a)

    return ports._replace(
        tip_force=scaled(ports.tip_force),
        tip_moment=scaled(ports.tip_moment),
        line_force=scaled(ports.line_force),
        node_force=scaled(ports.node_force),
        follower_force=scaled(ports.follower_force),
        follower_line=scaled(ports.follower_line),
    )
