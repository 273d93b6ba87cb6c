"""A tendon rod pressed against obstacles without friction, as a constrained minimum of energy: numpy and
scipy only.

The rod is a row of exact arcs of constant curvature u_j. At rest, over all u that keep the rod off the
obstacle by rho,
    V(u) = sum_j h/2 (u_j - u*)^T K (u_j - u*)  +  sum_i (l_i - L_i + c_i T0_i)^2 / (2 c_i)  -  sum_k F_k .
    r_k
is least, subject to  phi(r(s_k)) - rho >= 0  at the nodes, and wherever between two of them phi has its
minimum along the rod. The multiplier lambda_k [N] is the force there, along the outward normal grad phi.
Signorini's conditions (lambda >= 0, gap >= 0, lambda gap = 0) are then the optimality conditions. With nodes
alone a touching rod would hang on a node, its force not square to the rod, an error of the first order in h;
the places between move with the rod, and the error is of the second.

Sequential quadratic programming (Nocedal and Wright, Numerical Optimization, 2nd ed., ch. 18) with the exact
Hessian of the Lagrangian; each quadratic program by non-negative least squares on its dual (Lawson and
Hanson, Solving Least Squares Problems, ch. 23). Least energy has more than one bottom around an obstacle:
lengths and loads grow from the rod at rest in steps, and the answer is the bottom which that path leads to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from contact_chain import (
    Chain,
    Rod,
    chain_of,
    energy_of,
    hessian_of,
    jacobian_of,
    path_of,
    rotation_of,
    slope_of,
    stretch_of,
    turning_of,
)
from contact_shapes import Obstacle
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, null_space, solve_triangular
from scipy.optimize import brentq, nnls

Floats = NDArray[np.float64]
E3 = np.array([0.0, 0.0, 1.0])
# m/N of give in a contact, so that neighbours which share a force have one answer: 1e-12 m at 1 N
_SOFT = 1e-12
_LIFT = 1e4  # N/m, of the squares that lift the energy across a contact
_FLAT = 0.1  # 1/m of curvature of the gap along the rod, below which a touching point is not followed
_HANGS = 1e-10  # m
# N m of moment that may be out of balance at the end; lengths of 0.1 m over 1e-6 m/N round to 1e-11 N
_TIGHT = 1e-10
_CLOSE = 1e-9  # m that a node may be inside at the end


class Minimum(NamedTuple):
    """The rod at rest against its obstacles; world frame."""

    arclength: Floats
    """(n_nodes,) base first [m]: the ends of the elements, and where the rod touches between them."""
    positions: Floats
    """(n_nodes, 3) [m]."""
    tip_position: Floats
    """(3,) [m]."""
    tip_rotation: Floats
    """(3, 3) world_from_material."""
    gap: Floats
    """(n_nodes,) distance to the nearest obstacle less rho [m]; negative would be inside."""
    contact_force: Floats
    """(n_nodes, 3) of the obstacles on the rod [N]. Neighbours share one point force: sum them, or see
    `patches`."""
    total_force: Floats
    """(3,) sum of the contact forces [N]."""
    tension: Floats
    """(n,) [N]."""
    tendon_length: Floats
    """(n,) path length [m]."""
    base_force: Floats
    """(3,) of the base on the rod [N]: minus all other forces."""
    base_moment: Floats
    """(3,) of the base on the rod, about the base [N m], from the curvature there, not from the forces."""
    curvature: Floats
    """(n_nodes - 1, 3) between nodes, material frame [1/m]."""
    energy: float
    """V [J]."""
    violation: float
    """Deepest node [m]."""
    stationarity: float
    """Largest moment out of balance [N m]."""
    stability: float
    """Lowest curvature of V along the contacts, relative to the rod's bending: below zero it rests on a ridge
    (see `nudge`)."""
    converged: bool
    """Violation below 1e-9 m, stationarity below 1e-10 N m, and every force times its gap below 1e-9 N m."""


class Patch(NamedTuple):
    """A run of neighbouring nodes that carry force."""

    arclength: float
    """Mean arclength at which the force acts [m]."""
    first: float
    """Arclength of its first node [m]."""
    last: float
    """Arclength of its last node [m]."""
    force: Floats
    """(3,) on the rod, world [N]."""


class _State(NamedTuple):
    violation: float  # m
    stationarity: float  # N m
    stability: float  # 1
    converged: bool


class _Look(NamedTuple):
    """The rod with a node wherever it may touch, and its c constraints."""

    rod: Rod
    chain: Chain
    key: NDArray[np.intp]  # (c,) that keeps a constraint's name while nodes come and go
    node: NDArray[np.intp]  # (c,)
    gap: Floats  # (c,)
    normal: Floats  # (c, 3)
    curved: Floats  # (c, 3, 3) Hessian of phi
    between: NDArray[np.bool_]  # (c,) a minimum along the rod, not the end of an element


def minimise(
    length: ArrayLike,
    K: ArrayLike,
    offsets: ArrayLike | None = None,
    tendon_length: ArrayLike = (),
    compliance: ArrayLike = 1e-5,
    tip_force: ArrayLike = (0.0, 0.0, 0.0),
    line_force: ArrayLike = (0.0, 0.0, 0.0),
    precurvature: ArrayLike = 0.0,
    *,
    obstacle: Obstacle | Sequence[Obstacle] = (),
    rho: float = 0.0,
    pretension: ArrayLike = 0.0,
    unilateral: bool = False,
    base_position: ArrayLike = (0.0, 0.0, 0.0),
    base_rotation: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    elements: int = 80,
    load_steps: int = 8,
    nudge: ArrayLike = (0.0, 0.0, 0.0),
    planar: bool = False,
) -> Minimum:
    """Least energy of a chain of rods under dead loads, no node nearer than `rho` [m] to an obstacle.

    - `length` [m]: one number, or (n_segments,) for a chain. `K` (3,) or (n_segments, 3): EI_x, EI_y, GJ [N
      m^2].
    - `offsets` [m]: (n, 2), or (n_segments, n, 2) with nan where a tendon does not run; None for a passive
      rod.
    - `tendon_length` (n,) [m], base to end; `compliance` [m/N] > 0 and `pretension` [N]: one or (n,).
    - `tip_force` (3,) [N], `line_force` (3,) [N/m], world. `precurvature`: 0, (3,) or (n_segments, 3) [1/m].
    - `base_rotation` (3, 3) world_from_material at the base.
    - `elements` a segment, each of constant curvature.
    - Lengths and loads reach their values in `load_steps` steps from the rod at rest.
    - `nudge` (3,) [N] acts on the tip in all steps but the last: off a ridge of the energy, where symmetry
      could keep the rod.
    - `planar` keeps the curvature about d2 alone, that is the rod in its own x z plane, ridge or not.
    """
    lengths = np.atleast_1d(np.asarray(length, dtype=float))
    tendons = np.atleast_1d(np.asarray(tendon_length, dtype=float))
    n_segments, m = len(lengths), len(tendons)
    given = np.zeros((0, 2)) if offsets is None else np.asarray(offsets, dtype=float)
    places = np.broadcast_to(given, (n_segments, m, 2))
    compliances = np.broadcast_to(np.asarray(compliance, dtype=float), (m,))
    step = np.repeat(lengths / elements, elements)
    place = np.repeat(places, elements, axis=0)
    flat = np.concatenate([np.nan_to_num(place), np.zeros((*place.shape[:2], 1))], axis=2)
    obstacles = (obstacle,) if isinstance(obstacle, Obstacle) else tuple(obstacle)
    # half of a step's line force on each of its ends; the base's share does no work
    half = 0.5 * step[:, None] * np.asarray(line_force, dtype=float)
    node_force = half + np.concatenate([half[1:], np.asarray(tip_force, dtype=float)[None]])

    aside = np.zeros_like(node_force)
    aside[-1] = nudge

    def along(a: ArrayLike) -> Floats:
        return np.repeat(np.broadcast_to(np.asarray(a, dtype=float), (n_segments, 3)), elements, axis=0)

    def rod(share: float, rest: Floats) -> Rod:
        return Rod(
            step=step,
            stiffness=along(K),
            precurvature=along(precurvature),
            crossing=(~np.isnan(place[..., 0])).astype(float),
            offset=flat,
            free_length=rest + share * (tendons - compliances * np.asarray(pretension, dtype=float) - rest),
            compliance=compliances,
            unilateral=unilateral,
            node_force=share * node_force if share == 1.0 else share * node_force + aside,
            base_position=np.asarray(base_position, dtype=float),
            base_rotation=np.asarray(base_rotation, dtype=float),
            rho=rho,
            owner=np.arange(len(step)),
        )

    unloaded = rod(1.0, np.zeros(m))
    x = unloaded.precurvature.ravel().copy()
    rest = path_of(unloaded, unloaded.precurvature)[0]
    force = np.zeros(2 * len(obstacles) * len(step))
    for share in np.arange(1, load_steps + 1) / load_steps:
        # only the last step is an answer, the others are its start
        x, force, state = _bottom(rod(share, rest), obstacles, x, force, 1.0 if share == 1.0 else 1e3, planar)
    loaded = np.asarray(tip_force, dtype=float) + lengths.sum() * np.asarray(line_force, dtype=float)
    return _answer(rod(1.0, rest), obstacles, x, force, loaded, state)


def patches(found: Minimum, least: float = 1e-6) -> list[Patch]:
    """Contact forces above `least` [N], neighbours summed; one free node between two does not part them."""
    size = np.linalg.norm(found.contact_force, axis=1)
    on = np.flatnonzero(size > least)
    runs = np.split(on, np.flatnonzero(np.diff(on) > 2) + 1) if len(on) else []
    s = found.arclength
    made = []
    for run in runs:
        mean = float(np.average(s[run], weights=size[run]))
        made.append(Patch(mean, float(s[run[0]]), float(s[run[-1]]), found.contact_force[run].sum(axis=0)))
    return made


def _bottom(
    rod: Rod, obstacles: tuple[Obstacle, ...], x: Floats, force: Floats, slack: float, planar: bool
) -> tuple[Floats, Floats, _State]:
    """Curvatures (3 e,), multipliers by key and how good they are, at the nearest bottom."""
    reach = 0.05 * float(rod.step.sum())  # m that a node may move in one step: a wall is not to be jumped
    scale = (rod.step[:, None] * rod.stiffness).ravel()
    root = np.sqrt(scale)
    free = np.arange(1, len(x), 3) if planar else np.arange(len(x))
    for _ in range(200):
        look = _look(rod, obstacles, x)
        u = look.rod.fine(x)
        jacobian = jacobian_of(look.rod, look.chain)
        there = jacobian[look.node]
        rows = np.einsum("cx,cxd->cd", look.normal, there)
        slope = slope_of(look.rod, u, look.chain)
        now = force[look.key]
        violation = float(np.maximum(-look.gap, 0.0).max(initial=0.0))
        stationarity = float(np.abs((slope - now @ rows) / np.repeat(rod.step, 3)).max())
        idle = float(np.abs(now * look.gap).max(initial=0.0))  # N m of force where there is no contact
        converged = violation < slack * _CLOSE and stationarity < slack * _TIGHT and idle < slack * _CLOSE
        on_nodes = look.rod.node_force.copy()
        np.add.at(on_nodes, look.node, now[:, None] * look.normal)
        hessian = hessian_of(look.rod, u, look.chain, on_nodes)
        for c in np.flatnonzero(now > 0.0):
            hessian -= now[c] * there[c].T @ look.curved[c] @ there[c]
            if look.between[c]:
                hessian += now[c] * _sliding(look, u, c, there[c])
        if converged:
            break
        near = np.flatnonzero(look.gap < 2.0 * reach)
        move, square = np.zeros_like(x), hessian[np.ix_(free, free)]
        contacts = rows[np.ix_(near, free)], look.gap[near], now[near]
        move[free], wanted = _quadratic(square, slope[free], *contacts, scale[free])
        farthest = float(np.linalg.norm(jacobian @ move, axis=1).max())
        part = min(1.0, reach / farthest) if farthest > 0.0 else 1.0
        x, part = _search(rod, obstacles, x, move, part, 2.0 * max(float(wanted.max(initial=0.0)), 1e-3))
        new = np.zeros_like(force)
        new[look.key[near]] = wanted
        force = (1.0 - part) * force + part * new
    held = rows[now > 1e-6]
    along = null_space(held / root) if len(held) else np.eye(len(x))
    lowest = float(np.linalg.eigvalsh(along.T @ (hessian / np.outer(root, root)) @ along)[0])
    return x, force, _State(violation, stationarity, lowest, converged)


def _look(rod: Rod, obstacles: tuple[Obstacle, ...], x: Floats) -> _Look:
    """The rod at curvatures x (3 e,), with a node at each minimum of distance that may touch."""
    u, n = rod.fine(x), len(rod.step)
    chain = chain_of(rod, u)
    begins = np.concatenate([rod.base_position[None], chain.node[:-1]])
    last = np.concatenate([chain.start[1:, :, 2], chain.tip[None, :, 2]])
    cuts: list[tuple[int, float, int]] = []
    for k, solid in enumerate(obstacles):
        before, after = solid.distance(begins), solid.distance(chain.node)
        falls = np.einsum("nx,nx->n", before.normal, chain.start[:, :, 2]) < 0.0
        rises = np.einsum("nx,nx->n", after.normal, last) > 0.0
        # on a flat the nodes at both ends bear it: what hangs between them is less than _HANGS
        flat = np.maximum(np.abs(before.value - rod.rho), np.abs(after.value - rod.rho)) < _HANGS
        for j in np.flatnonzero(falls & rises & ~flat & (after.value - rod.rho < rod.step)):

            def along(s: float, j: int = int(j), solid: Obstacle = solid) -> float:
                turned = turning_of(s * u[j])[:, 2], rotation_of(s * u[j])[:, 2]
                here = begins[j] + s * chain.start[j] @ turned[0]
                return float(solid.distance(here[None]).normal[0] @ chain.start[j] @ turned[1])

            s = float(brentq(along, 0.0, rod.step[j], xtol=1e-16, rtol=1e-14))
            if 1e-12 < s < rod.step[j] - 1e-12:
                cuts.append((int(j), s, k))
    cuts.sort()
    at = np.array([j for j, _, _ in cuts], dtype=np.intp)
    fine = _cut(rod, at, np.array([s for _, s, _ in cuts]))
    if cuts:
        chain = chain_of(fine, fine.fine(x))
    # node numbers in the cut rod: the ends of elements, moved on by the cuts before them
    ends = np.arange(n) + np.searchsorted(at, np.arange(n), side="right")
    touch = at + np.arange(len(cuts))
    found = [o.distance(chain.node) for o in obstacles]
    m = len(obstacles)
    which = np.concatenate([np.repeat(np.arange(m), n), np.array([k for _, _, k in cuts], dtype=np.intp)])
    node = np.concatenate([np.tile(ends, m), touch])
    key = np.concatenate([np.arange(m * n), (m + which[m * n :]) * n + at])
    return _Look(
        rod=fine,
        chain=chain,
        key=key,
        node=node,
        gap=np.array([found[k].value[p] for k, p in zip(which, node, strict=True)]) - rod.rho,
        normal=np.array([found[k].normal[p] for k, p in zip(which, node, strict=True)]).reshape(-1, 3),
        curved=np.array([found[k].hessian[p] for k, p in zip(which, node, strict=True)]).reshape(-1, 3, 3),
        between=np.arange(len(node)) >= len(obstacles) * n,
    )


def _cut(rod: Rod, at: NDArray[np.intp], where: Floats) -> Rod:
    """The same rod with steps `at` divided, `where` [m] from their start: the same energy, and more nodes."""
    owner = np.repeat(np.arange(len(rod.step)), 1 + np.bincount(at, minlength=len(rod.step)))
    end = np.flatnonzero(np.diff(owner, append=len(rod.step)))
    step = np.zeros(len(owner))
    node_force = np.zeros((len(owner), 3))
    node_force[end] = rod.node_force
    for j in range(len(rod.step)):
        marks = np.concatenate([[0.0], where[at == j], [rod.step[j]]])
        step[end[j] - len(marks) + 2 : end[j] + 1] = np.diff(marks)
    return replace(
        rod,
        step=step,
        stiffness=rod.stiffness[owner],
        precurvature=rod.precurvature[owner],
        crossing=rod.crossing[owner],
        offset=rod.offset[owner],
        node_force=node_force,
        owner=owner,
    )


def _sliding(look: _Look, u: Floats, c: int, there: Floats) -> Floats:
    """(3 e, 3 e) what the contact's own motion along the rod takes off the gap's second derivative."""
    p, chain, rod = look.node[c], look.chain, look.rod
    frame = chain.start[p] @ rotation_of(rod.step[p] * u[p])
    tangent = frame[:, 2]
    spin = np.swapaxes(chain.spin * rod.step[:, None, None], 0, 1).copy()
    spin[:, p + 1 :] = 0.0
    across = np.cross(spin, tangent[:, None, None], axisa=0, axisb=0)
    turned = rod.coarse(np.swapaxes(across, 0, 2).swapaxes(1, 2))
    mixed = there.T @ (look.curved[c] @ tangent) + turned.T @ look.normal[c]
    rate = tangent @ look.curved[c] @ tangent + look.normal[c] @ frame @ np.cross(u[p], E3)
    return np.outer(mixed, mixed) / max(float(rate), _FLAT)


def _quadratic(
    hessian: Floats, slope: Floats, rows: Floats, gap: Floats, force: Floats, scale: Floats
) -> tuple[Floats, Floats]:
    """Least  d H d / 2 + slope d  with  rows d + gap >= 0: the move d and its multipliers."""
    pressed = force > 0.0
    held = rows[pressed]
    # squares of the pressed gaps, which vanish at the answer, lift what bends down across the constraint
    lift = _LIFT * held.T
    for weight, shift in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0)):
        if shift:
            root = np.sqrt(scale)
            lowest = float(np.linalg.eigvalsh((hessian + lift @ held) / np.outer(root, root))[0])
            shift = 0.01 - lowest
        try:
            factor = cho_factor(hessian + weight * lift @ held + shift * np.diag(scale))
        except np.linalg.LinAlgError:
            continue
        slope = slope + weight * lift @ (gap + _SOFT * force)[pressed]
        break
    else:
        raise ArithmeticError("the quadratic program has no bottom")
    if not len(gap):
        return -cho_solve(factor, slope), np.zeros(0)
    soft = cho_solve(factor, rows.T)
    matrix = rows @ soft + _SOFT * np.eye(len(gap))
    upper = cholesky(0.5 * (matrix + matrix.T))
    wanted, _ = nnls(upper, solve_triangular(upper, slope @ soft - gap, trans="T"), maxiter=50 * len(gap))
    return soft @ wanted - cho_solve(factor, slope), wanted


def _search(
    rod: Rod, obstacles: tuple[Obstacle, ...], x: Floats, move: Floats, part: float, price: float
) -> tuple[Floats, float]:
    """Halve the move until energy plus `price` [N] times the depth falls, or it is only rounding."""

    def merit(x: Floats) -> float:
        look = _look(rod, obstacles, x)
        depth = float(np.maximum(-look.gap, 0.0).sum())
        return energy_of(look.rod, look.rod.fine(x), look.chain) + price * depth

    here = merit(x)
    bending = float((rod.step[:, None] * rod.stiffness).max())
    for _ in range(12):
        if merit(x + part * move) <= here + 1e-12 * (abs(here) + bending / rod.step[0] ** 2 * 1e-3):
            break
        part *= 0.5
    return x + part * move, part


def _answer(
    rod: Rod, obstacles: tuple[Obstacle, ...], x: Floats, force: Floats, load: Floats, state: _State
) -> Minimum:
    look = _look(rod, obstacles, x)
    contact = np.zeros((len(look.rod.step) + 1, 3))
    np.add.at(contact, look.node + 1, force[look.key][:, None] * look.normal)
    positions = np.concatenate([rod.base_position[None], look.chain.node])
    gaps = [o.distance(positions).value - rod.rho for o in obstacles]
    gap = np.min(gaps, axis=0) if gaps else np.full(len(positions), np.inf)
    u = rod.fine(x)
    chain = chain_of(rod, u)
    stretch, direction = stretch_of(rod, u)
    tension = stretch / rod.compliance
    # moment of rod and tendons in the middle of the first three elements, world, carried on to the base
    pull = np.einsum("i,ji,jix->jx", tension, rod.crossing, np.cross(rod.offset, direction))
    moment = rod.stiffness * (u - rod.precurvature) + pull
    turned = np.einsum("jxy,jy->jx", chain.start @ rotation_of(0.5 * rod.step[:, None] * u), moment)
    return Minimum(
        arclength=np.concatenate([[0.0], np.cumsum(look.rod.step)]),
        positions=positions,
        tip_position=positions[-1],
        tip_rotation=chain.tip,
        gap=gap,
        contact_force=contact,
        total_force=contact.sum(axis=0),
        tension=tension,
        tendon_length=path_of(rod, u)[0],
        base_force=-load - contact.sum(axis=0),
        base_moment=-np.array([15.0, -10.0, 3.0]) / 8.0 @ turned[:3],
        curvature=look.rod.fine(x),
        energy=energy_of(rod, u, chain),
        **state._asdict(),
    )
