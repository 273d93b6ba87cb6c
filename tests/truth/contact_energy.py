"""A tendon rod pressed against obstacles without friction, as a constrained minimum of energy: numpy and scipy only.

The rod is a row of exact arcs of constant curvature u_j. At rest, over all u that keep the rod off the obstacle by rho,
    V(u) = sum_j h/2 (u_j - u*)^T K (u_j - u*)  +  sum_i (l_i - L_i + c_i T0_i)^2 / (2 c_i)  -  sum_k F_k . r_k
is least, subject to  phi(r(s_k)) - rho >= 0  at the nodes, and wherever between two of them phi has its minimum along the
rod. The multiplier lambda_k [N] is the force there, along the outward normal grad phi. Signorini's conditions (lambda >= 0,
gap >= 0, lambda gap = 0) are then the optimality conditions. With nodes alone a touching rod would hang on a node, its force
not square to the rod, an error of the first order in h; the places between move with the rod, and the error is of the second.

Sequential quadratic programming (Nocedal and Wright, Numerical Optimization, 2nd ed., ch. 18) with the exact Hessian of the
Lagrangian; each quadratic program by non-negative least squares on its dual (Lawson and Hanson, Solving Least Squares
Problems, ch. 23). Least energy has more than one bottom around an obstacle: lengths and loads grow from the rod at rest
in steps, and the answer is the bottom which that path leads to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, null_space, solve_triangular
from scipy.optimize import brentq, nnls

Floats = NDArray[np.float64]
E3 = np.array([0.0, 0.0, 1.0])
_SOFT = 1e-12  # m/N of give in a contact, so that neighbours which share a force have one answer: 1e-12 m at 1 N
_LIFT = 1e4  # N/m, of the squares that lift the energy across a contact
_FLAT = 0.1  # 1/m of curvature of the gap along the rod, below which a touching point is not followed
_HANGS = 1e-10  # m
_TIGHT = 1e-10  # N m of moment that may be out of balance at the end; lengths of 0.1 m over 1e-6 m/N round to 1e-11 N
_CLOSE = 1e-9  # m that a node may be inside at the end


class Distance(NamedTuple):
    """Signed distance to a solid at points, positive outside; curvature for Newton's method."""

    value: Floats
    """(p,) [m]."""
    normal: Floats
    """(p, 3) gradient: unit, away from the solid."""
    hessian: Floats
    """(p, 3, 3) [1/m]."""


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
    """(n_nodes, 3) of the obstacles on the rod [N]. Neighbours share one point force: sum them, or see `patches`."""
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
    """Lowest curvature of V along the contacts, relative to the rod's bending: below zero it rests on a ridge (see `nudge`)."""
    converged: bool
    """Violation below 1e-9 m, stationarity below 1e-10 N m, and every force times its gap below 1e-9 N m."""


class Patch(NamedTuple):
    """A run of neighbouring nodes that carry force."""

    arclength: float
    """Where the force acts in the mean [m]."""
    first: float
    """Arclength of its first node [m]."""
    last: float
    """Arclength of its last node [m]."""
    force: Floats
    """(3,) on the rod, world [N]."""


@dataclass(frozen=True)
class HalfSpace:
    """All points with (p - point) . normal <= 0 are solid."""

    point: ArrayLike
    normal: ArrayLike

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        n = _unit(self.normal)
        return Distance((p - np.asarray(self.point)) @ n, np.broadcast_to(n, p.shape), np.zeros((*p.shape, 3)))


@dataclass(frozen=True)
class Sphere:
    """A ball of `radius` [m]."""

    centre: ArrayLike
    radius: float

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        d, n = _length_and_direction(p - np.asarray(self.centre))
        return Distance(d - self.radius, n, (np.eye(3) - _outer(n, n)) / d[:, None, None])


@dataclass(frozen=True)
class Cylinder:
    """A bar of `radius` [m] about the line through `point` along `axis`; `half_length` [m] caps it on both sides of `point`."""

    point: ArrayLike
    axis: ArrayLike
    radius: float
    half_length: float = np.inf

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        a = _unit(self.axis)
        along = (p - np.asarray(self.point)) @ a
        d, n = _length_and_direction(p - np.asarray(self.point) - along[:, None] * a)
        round_ = (np.eye(3) - np.outer(a, a) - _outer(n, n)) / d[:, None, None]
        side, end = d - self.radius, np.abs(along) - self.half_length
        cap = np.sign(along)[:, None] * a
        corner, c = _length_and_direction(np.maximum(side, 0.0)[:, None] * n + np.maximum(end, 0.0)[:, None] * cap)
        on_side, on_end = (end <= 0.0) & (side >= end), (side <= 0.0) & (end > side)
        value = np.where(on_side, side, np.where(on_end, end, corner))
        normal = np.where(on_side[:, None], n, np.where(on_end[:, None], cap, c))
        rim = (_outer(n, n) + np.outer(a, a) - _outer(c, c) + np.maximum(side, 0.0)[:, None, None] * round_) / corner[:, None, None]
        hessian = np.where(on_side[:, None, None], round_, np.where(on_end[:, None, None], 0.0, rim))
        return Distance(value, normal, hessian)


@dataclass(frozen=True)
class Box:
    """A box with half edges `half` (3,) [m] about `centre`; columns of `axes` are its directions in the world."""

    centre: ArrayLike
    half: ArrayLike
    axes: ArrayLike = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        axes = np.asarray(self.axes, dtype=float)
        local = (p - np.asarray(self.centre)) @ axes
        over = np.abs(local) - np.asarray(self.half)
        out = np.maximum(over, 0.0)
        d, n = _length_and_direction(np.sign(local) * out)
        inside = over.max(axis=1) <= 0.0
        face = np.sign(local) * np.eye(3)[np.argmax(over, axis=1)]
        curved = ((out > 0.0)[:, :, None] * np.eye(3) - _outer(n, n)) / d[:, None, None]
        value = np.where(inside, over.max(axis=1), d)
        normal = np.where(inside[:, None], face, n)
        hessian = np.where(inside[:, None, None], 0.0, curved)
        return Distance(value, normal @ axes.T, axes @ hessian @ axes.T)


@dataclass(frozen=True)
class Tube:
    """All points further than `radius` [m] from the line through `point` along `axis` are solid: the rod is inside."""

    point: ArrayLike
    axis: ArrayLike
    radius: float

    def distance(self, p: Floats) -> Distance:
        """Signed distance of points (p, 3)."""
        bar = Cylinder(self.point, self.axis, self.radius).distance(p)
        return Distance(-bar.value, -bar.normal, -bar.hessian)


Obstacle = HalfSpace | Sphere | Cylinder | Box | Tube
_KINDS = {"half_space": HalfSpace, "sphere": Sphere, "cylinder": Cylinder, "box": Box, "tube": Tube}


@dataclass(frozen=True)
class _Rod:
    """Steps base first, n of them; e elements of one or more steps with one curvature; m tendons."""

    step: Floats  # (n,)
    stiffness: Floats  # (n, 3)
    precurvature: Floats  # (n, 3)
    crossing: Floats  # (n, m) 1 where the tendon runs through
    offset: Floats  # (n, m, 3)
    free_length: Floats  # (m,) of the wire without tension
    compliance: Floats  # (m,)
    unilateral: bool
    node_force: Floats  # (n, 3) dead load at the end of each step
    base_position: Floats  # (3,)
    base_rotation: Floats  # (3, 3)
    rho: float
    owner: NDArray[np.intp]  # (n,) the element of each step

    def fine(self, x: Floats) -> Floats:
        """(n, 3) curvatures of the steps from (3 e,) of the elements."""
        return x.reshape(-1, 3)[self.owner]

    def coarse(self, a: Floats) -> Floats:
        """Transpose of `fine` on the last axes (..., n, 3) -> (..., 3 e)."""
        summed = np.add.reduceat(a, self.first, axis=-2)
        return np.asarray(summed.reshape(*a.shape[:-2], 3 * len(self.first)))

    @property
    def first(self) -> NDArray[np.intp]:
        """(e,) first step of each element."""
        return np.flatnonzero(np.diff(self.owner, prepend=-1))


class _State(NamedTuple):
    violation: float  # m
    stationarity: float  # N m
    stability: float  # 1
    converged: bool


class _Look(NamedTuple):
    """The rod with a node wherever it may touch, and its c constraints."""

    rod: _Rod
    chain: _Chain
    slot: NDArray[np.intp]  # (c,) that keeps a constraint's name while nodes come and go
    node: NDArray[np.intp]  # (c,)
    gap: Floats  # (c,)
    normal: Floats  # (c, 3)
    curved: Floats  # (c, 3, 3) Hessian of phi
    between: NDArray[np.bool_]  # (c,) a minimum along the rod, not the end of an element


class _Chain(NamedTuple):
    """Where the steps are in the world, and what follows from theta = h u of each, material frame (last index)."""

    start: Floats  # (n, 3, 3) frame at the start of each step
    node: Floats  # (n, 3) position at its end
    tip: Floats  # (3, 3)
    spin: Floats  # (n, 3, 3) world rotation of all that follows
    shift: Floats  # (n, 3, 3) world displacement of the step's own end


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

    - `length` [m]: one number, or (n_segments,) for a chain. `K` (3,) or (n_segments, 3): EI_x, EI_y, GJ [N m^2].
    - `offsets` [m]: (n, 2), or (n_segments, n, 2) with nan where a tendon does not run; None for a passive rod.
    - `tendon_length` (n,) [m], base to end; `compliance` [m/N] > 0 and `pretension` [N]: one or (n,).
    - `tip_force` (3,) [N], `line_force` (3,) [N/m], world. `precurvature`: 0, (3,) or (n_segments, 3) [1/m].
    - `base_rotation` (3, 3) world_from_material at the base.
    - `elements` a segment, each of constant curvature.
    - Lengths and loads reach their values in `load_steps` steps from the rod at rest.
    - `nudge` (3,) [N] acts on the tip in all steps but the last: off a ridge of the energy, where symmetry could keep the rod.
    - `planar` keeps the curvature about d2 alone, that is the rod in its own x z plane, ridge or not.
    """
    lengths = np.atleast_1d(np.asarray(length, dtype=float))
    wires = np.atleast_1d(np.asarray(tendon_length, dtype=float))
    n_segments, m = len(lengths), len(wires)
    places = np.broadcast_to(np.zeros((0, 2)) if offsets is None else np.asarray(offsets, dtype=float), (n_segments, m, 2))
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

    def rod(share: float, rest: Floats) -> _Rod:
        return _Rod(
            step=step,
            stiffness=np.repeat(np.broadcast_to(np.asarray(K, dtype=float), (n_segments, 3)), elements, axis=0),
            precurvature=np.repeat(np.broadcast_to(np.asarray(precurvature, dtype=float), (n_segments, 3)), elements, axis=0),
            crossing=(~np.isnan(place[..., 0])).astype(float),
            offset=flat,
            free_length=rest + share * (wires - compliances * np.asarray(pretension, dtype=float) - rest),
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
    rest = _path(unloaded, unloaded.precurvature)[0]
    force = np.zeros(2 * len(obstacles) * len(step))
    for share in np.arange(1, load_steps + 1) / load_steps:
        # only the last step is an answer, the others are its start
        x, force, state = _bottom(rod(share, rest), obstacles, x, force, 1.0 if share == 1.0 else 1e3, planar)
    loaded = np.asarray(tip_force, dtype=float) + lengths.sum() * np.asarray(line_force, dtype=float)
    return _answer(rod(1.0, rest), obstacles, x, force, loaded, state)


def obstacle(description: dict[str, Any]) -> Obstacle:
    """The obstacle of a plain dict: its `kind` and the fields of that class."""
    fields = dict(description)
    made: Obstacle = _KINDS[fields.pop("kind")](**fields)
    return made


def patches(found: Minimum, least: float = 1e-6) -> list[Patch]:
    """Contact forces above `least` [N], neighbours summed; one free node between two does not part them."""
    size = np.linalg.norm(found.contact_force, axis=1)
    on = np.flatnonzero(size > least)
    runs = np.split(on, np.flatnonzero(np.diff(on) > 2) + 1) if len(on) else []
    s = found.arclength
    return [
        Patch(float(np.average(s[run], weights=size[run])), float(s[run[0]]), float(s[run[-1]]), found.contact_force[run].sum(axis=0))
        for run in runs
    ]


_PROTOTYPE = {"length": [0.07], "K": [[0.0022, 0.0022, 0.001]], "compliance": 1e-5, "pretension": 0.0}
_UPRIGHT = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def ring(n: int, offset: float, first: float = 0.0) -> list[list[float]]:
    """n tendons at `offset` [m] around the rod, from the angle `first` [rad]."""
    angle = first + 2.0 * np.pi * np.arange(n) / n
    return (offset * np.stack([np.cos(angle), np.sin(angle)], axis=1)).tolist()


def bent(length: Sequence[float], offsets: list[list[list[float]]], kappa_x: Sequence[float], kappa_y: Sequence[float]) -> list[float]:
    """Tendon lengths [m] that bend segment k toward +x by kappa_x[k] and toward +y by kappa_y[k] [1/m] in the mean."""
    places = np.asarray(offsets, dtype=float)
    pulled = places[..., 0] * np.asarray(kappa_x)[:, None] + places[..., 1] * np.asarray(kappa_y)[:, None]
    return np.nansum(np.asarray(length)[:, None] * (1.0 - pulled), axis=0).tolist()


def cases() -> dict[str, dict[str, Any]]:
    """Rods in contact, by name, as plain numbers: the arguments of `minimise`, the obstacle as a dict with its kind."""
    four = [ring(4, 0.0075)]
    away = [[float("nan")] * 2] * 4
    pair = [ring(4, 0.0075) + ring(4, 0.0075, np.pi / 4.0), away + ring(4, 0.0075, np.pi / 4.0)]

    def one(kappa_x: float, kappa_y: float, tip_force: list[float], rho: float, obstacle: dict[str, Any]) -> dict[str, Any]:
        return {
            **_PROTOTYPE,
            "offsets": four,
            "tendon_length": bent([0.07], four, [kappa_x], [kappa_y]),
            "tip_force": tip_force,
            "line_force": [0.0, 0.0, 0.0],
            "base_rotation": _UPRIGHT,
            "obstacle": obstacle,
            "rho": rho,
        }

    wall = {"kind": "half_space", "point": [0.012, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    still = [0.0, 0.0, 0.0]
    return {
        "wall": one(12.0, 0.0, still, 0.0, wall),
        "wall_radius": one(8.0, 0.0, still, 0.005, wall),
        "bar": one(10.0, 1.0, still, 0.003, {"kind": "cylinder", "point": [0.0155, 0.0, 0.04], "axis": [0.0, 1.0, 0.0], "radius": 0.008}),
        "sphere": one(9.0, 4.0, [0.1, -0.15, -0.05], 0.003, {"kind": "sphere", "centre": [0.028, 0.006, 0.055], "radius": 0.015}),
        "box_edge": one(12.0, 1.0, still, 0.002, {"kind": "box", "centre": [0.0245, 0.0, 0.018], "half": [0.02, 0.03, 0.018]}),
        "heavy": {
            "length": [0.3],
            "K": [[0.02, 0.02, 0.015]],
            "compliance": 1e-5,
            "pretension": 0.0,
            "offsets": None,
            "tendon_length": [],
            "tip_force": still,
            "line_force": [0.0, 0.0, -3.0],
            "base_rotation": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
            "obstacle": {"kind": "cylinder", "point": [0.15, 0.0, -0.04], "axis": [0.0, 1.0, 0.0], "radius": 0.03},
            "rho": 0.004,
        },
        "two_segments": {
            "length": [0.07, 0.07],
            "K": [[0.0022, 0.0022, 0.001], [0.0022, 0.0022, 0.001]],
            "compliance": 1e-5,
            "pretension": 0.0,
            "offsets": pair,
            "tendon_length": bent([0.07, 0.07], pair, [4.0, 5.0], [3.0, -2.0]),
            "tip_force": still,
            "line_force": [0.0, 0.0, -0.3],
            "base_rotation": _UPRIGHT,
            "obstacle": {"kind": "half_space", "point": [0.03, 0.0, 0.12], "normal": [-1.0, 0.2, -0.2]},
            "rho": 0.003,
        },
        "tube": one(13.0, 1.0, still, 0.003, {"kind": "tube", "point": [0.006, 0.0, 0.0], "axis": [0.0, 0.0, 1.0], "radius": 0.01}),
    }


def solve(case: dict[str, Any], **options: Any) -> Minimum:
    """`minimise` of one of `cases`."""
    given = dict(case)
    return minimise(**{**given, "obstacle": obstacle(given.pop("obstacle"))}, **options)


def _bottom(
    rod: _Rod, obstacles: tuple[Obstacle, ...], x: Floats, force: Floats, slack: float, planar: bool
) -> tuple[Floats, Floats, _State]:
    """Curvatures (3 e,), multipliers by slot and how good they are, at the nearest bottom."""
    reach = 0.05 * float(rod.step.sum())  # m that a node may move in one step: a wall is not to be jumped
    scale = (rod.step[:, None] * rod.stiffness).ravel()
    root = np.sqrt(scale)
    free = np.arange(1, len(x), 3) if planar else np.arange(len(x))
    for _ in range(200):
        look = _look(rod, obstacles, x)
        u = look.rod.fine(x)
        jacobian = _jacobian(look.rod, look.chain)
        there = jacobian[look.node]
        rows = np.einsum("cx,cxd->cd", look.normal, there)
        slope = _slope(look.rod, u, look.chain)
        now = force[look.slot]
        violation = float(np.maximum(-look.gap, 0.0).max(initial=0.0))
        stationarity = float(np.abs((slope - now @ rows) / np.repeat(rod.step, 3)).max())
        idle = float(np.abs(now * look.gap).max(initial=0.0))  # N m of force where there is no contact
        converged = violation < slack * _CLOSE and stationarity < slack * _TIGHT and idle < slack * _CLOSE
        on_nodes = look.rod.node_force.copy()
        np.add.at(on_nodes, look.node, now[:, None] * look.normal)
        hessian = _hessian(look.rod, u, look.chain, on_nodes)
        for c in np.flatnonzero(now > 0.0):
            hessian -= now[c] * there[c].T @ look.curved[c] @ there[c]
            if look.between[c]:
                hessian += now[c] * _sliding(look, u, c, there[c])
        if converged:
            break
        near = np.flatnonzero(look.gap < 2.0 * reach)
        move = np.zeros_like(x)
        move[free], wanted = _quadratic(
            hessian[np.ix_(free, free)], slope[free], rows[np.ix_(near, free)], look.gap[near], now[near], scale[free]
        )
        farthest = float(np.linalg.norm(jacobian @ move, axis=1).max())
        part = min(1.0, reach / farthest) if farthest > 0.0 else 1.0
        x, part = _search(rod, obstacles, x, move, part, 2.0 * max(float(wanted.max(initial=0.0)), 1e-3))
        new = np.zeros_like(force)
        new[look.slot[near]] = wanted
        force = (1.0 - part) * force + part * new
    held = rows[now > 1e-6]
    along = null_space(held / root) if len(held) else np.eye(len(x))
    lowest = float(np.linalg.eigvalsh(along.T @ (hessian / np.outer(root, root)) @ along)[0])
    return x, force, _State(violation, stationarity, lowest, converged)


def _look(rod: _Rod, obstacles: tuple[Obstacle, ...], x: Floats) -> _Look:
    """The rod at curvatures x (3 e,), with a node at each minimum of an obstacle's distance within a step that may touch."""
    u, n = rod.fine(x), len(rod.step)
    chain = _chain(rod, u)
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
                turned = _turning(s * u[j])[:, 2], _rotation(s * u[j])[:, 2]
                here = begins[j] + s * chain.start[j] @ turned[0]
                return float(solid.distance(here[None]).normal[0] @ chain.start[j] @ turned[1])

            s = float(brentq(along, 0.0, rod.step[j], xtol=1e-16, rtol=1e-14))
            if 1e-12 < s < rod.step[j] - 1e-12:
                cuts.append((int(j), s, k))
    cuts.sort()
    at = np.array([j for j, _, _ in cuts], dtype=np.intp)
    fine = _cut(rod, at, np.array([s for _, s, _ in cuts]))
    if cuts:
        chain = _chain(fine, fine.fine(x))
    # node numbers in the cut rod: the ends of elements, each before it in the list moved on by the cuts up to it
    ends = np.arange(n) + np.searchsorted(at, np.arange(n), side="right")
    touch = at + np.arange(len(cuts))
    found = [o.distance(chain.node) for o in obstacles]
    which = np.concatenate([np.repeat(np.arange(len(obstacles)), n), np.array([k for _, _, k in cuts], dtype=np.intp)])
    node = np.concatenate([np.tile(ends, len(obstacles)), touch])
    slot = np.concatenate([np.arange(len(obstacles) * n), (len(obstacles) + which[len(obstacles) * n :]) * n + at])
    return _Look(
        rod=fine,
        chain=chain,
        slot=slot,
        node=node,
        gap=np.array([found[k].value[p] for k, p in zip(which, node, strict=True)]) - rod.rho,
        normal=np.array([found[k].normal[p] for k, p in zip(which, node, strict=True)]).reshape(-1, 3),
        curved=np.array([found[k].hessian[p] for k, p in zip(which, node, strict=True)]).reshape(-1, 3, 3),
        between=np.arange(len(node)) >= len(obstacles) * n,
    )


def _cut(rod: _Rod, at: NDArray[np.intp], where: Floats) -> _Rod:
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
    """(3 e, 3 e) what the touching point's own motion along the rod takes off the second derivative of its gap."""
    p, chain, rod = look.node[c], look.chain, look.rod
    frame = chain.start[p] @ _rotation(rod.step[p] * u[p])
    tangent = frame[:, 2]
    spin = np.swapaxes(chain.spin * rod.step[:, None, None], 0, 1).copy()
    spin[:, p + 1 :] = 0.0
    turned = rod.coarse(np.swapaxes(np.cross(spin, tangent[:, None, None], axisa=0, axisb=0), 0, 2).swapaxes(1, 2))
    mixed = there.T @ (look.curved[c] @ tangent) + turned.T @ look.normal[c]
    rate = tangent @ look.curved[c] @ tangent + look.normal[c] @ frame @ np.cross(u[p], E3)
    return np.outer(mixed, mixed) / max(float(rate), _FLAT)


def _quadratic(hessian: Floats, slope: Floats, rows: Floats, gap: Floats, force: Floats, scale: Floats) -> tuple[Floats, Floats]:
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


def _search(rod: _Rod, obstacles: tuple[Obstacle, ...], x: Floats, move: Floats, part: float, price: float) -> tuple[Floats, float]:
    """Halve the move until energy plus `price` [N] times the depth of the nodes falls, or it is only rounding."""

    def merit(x: Floats) -> float:
        look = _look(rod, obstacles, x)
        return _energy(look.rod, look.rod.fine(x), look.chain) + price * float(np.maximum(-look.gap, 0.0).sum())

    here = merit(x)
    bending = float((rod.step[:, None] * rod.stiffness).max())
    for _ in range(12):
        if merit(x + part * move) <= here + 1e-12 * (abs(here) + bending / rod.step[0] ** 2 * 1e-3):
            break
        part *= 0.5
    return x + part * move, part


def _energy(rod: _Rod, u: Floats, chain: _Chain) -> float:
    """V [J] less its value with all nodes at the origin."""
    strain = u - rod.precurvature
    stretch = _stretch(rod, u)[0]
    elastic = 0.5 * np.sum(rod.step[:, None] * rod.stiffness * strain**2)
    return float(elastic + 0.5 * np.sum(stretch**2 / rod.compliance) - np.sum(rod.node_force * chain.node))


def _slope(rod: _Rod, u: Floats, chain: _Chain) -> Floats:
    """dV/dx (3 e,)."""
    stretch, direction = _stretch(rod, u)
    h = rod.step[:, None]
    out = h * rod.stiffness * (u - rod.precurvature)
    # d|q|/du = d x t
    out = out + h * np.einsum("i,ji,jix->jx", stretch / rod.compliance, rod.crossing, np.cross(rod.offset, direction))
    beyond, lever = _carried(chain, rod.node_force)
    turning = np.stack([lever[:, 1, 2] - lever[:, 2, 1], lever[:, 2, 0] - lever[:, 0, 2], lever[:, 0, 1] - lever[:, 1, 0]], axis=1)
    work = np.einsum("jxa,jx->ja", chain.spin, turning) + np.einsum("jxa,jx->ja", chain.shift, beyond)
    return rod.coarse(out - h * work)


def _hessian(rod: _Rod, u: Floats, chain: _Chain, node_force: Floats) -> Floats:
    """(3 e, 3 e) second derivative of V with these forces on the nodes, dead."""
    n, h = len(u), rod.step
    beyond, lever = _carried(chain, node_force)
    # what a distal step moves is carried round by the spin w of a proximal one: (w x dr) . G = w . (dr x G), summed
    trace = np.trace(lever, axis1=1, axis2=2)[:, None, None]
    torque = np.cross(chain.shift, beyond[:, :, None], axis=1) + lever @ chain.spin - trace * chain.spin
    pairs = -np.einsum("ixa,jxb->iajb", chain.spin * h[:, None, None], torque * h[:, None, None], optimize=True)
    later = np.arange(n)[:, None] < np.arange(n)
    pairs *= later[:, None, :, None]
    pairs = pairs + pairs.transpose(2, 3, 0, 1)
    own = -(h**2)[:, None, None] * _own(rod, u, chain, beyond, lever)
    stretch, direction = _stretch(rod, u)
    q = E3 + np.cross(u[:, None], rod.offset)
    speed = np.linalg.norm(q, axis=-1)
    arm = _hat(rod.offset)  # dq/du = -[d]x
    flat = np.eye(3) - direction[..., :, None] * direction[..., None, :]
    weight = (stretch / rod.compliance) * rod.crossing * h[:, None] / speed
    own = own + np.einsum("ji,jiyx,jiyz,jizw->jxw", weight, arm, flat, arm, optimize=True)
    own[:, range(3), range(3)] += h[:, None] * rod.stiffness
    pairs[np.arange(n), :, np.arange(n), :] += own
    total = np.add.reduceat(np.add.reduceat(pairs, rod.first, axis=0), rod.first, axis=2)
    total = total.reshape(3 * len(rod.first), -1)
    lengthening = rod.coarse(np.einsum("j,ji,jix->ijx", h, rod.crossing, np.cross(rod.offset, direction)))
    taut = (stretch != 0.0) / rod.compliance
    total = total + lengthening.T @ (taut[:, None] * lengthening)
    return 0.5 * (total + total.T)


def _own(rod: _Rod, u: Floats, chain: _Chain, beyond: Floats, lever: Floats) -> Floats:
    """(n, 3, 3) second derivative of the work of all forces beyond a step by its own theta: an imaginary step."""
    theta = rod.step[:, None] * u
    there = np.swapaxes(chain.start, 1, 2)
    # sum of r G^T about the step's end, in its start frame and before its own turn
    before = np.swapaxes(_rotation(theta), 1, 2) @ there @ lever @ chain.start
    pull = rod.step[:, None] * np.einsum("jxy,jx->jy", chain.start, beyond)
    tiny = 1e-30
    columns = []
    for b in range(3):
        side = theta + 1j * tiny * np.eye(3)[b]
        turned = _rotation(side) @ before
        moment = np.stack([turned[:, 1, 2] - turned[:, 2, 1], turned[:, 2, 0] - turned[:, 0, 2], turned[:, 0, 1] - turned[:, 1, 0]], axis=1)
        slope = np.einsum("jya,jy->ja", _turning(side), moment) + np.einsum("jya,jy->ja", _bending(side), pull)
        columns.append(slope.imag / tiny)
    return np.stack(columns, axis=-1)


def _carried(chain: _Chain, node_force: Floats) -> tuple[Floats, Floats]:
    """For the end of each step: force at and beyond it (n, 3), and sum of (r - r_end) G^T over those nodes (n, 3, 3)."""

    def to_tip(a: Floats) -> Floats:
        return np.flip(np.cumsum(np.flip(a, 0), axis=0), 0)

    beyond = to_tip(node_force)
    return beyond, to_tip(_outer(chain.node, node_force)) - _outer(chain.node, beyond)


def _chain(rod: _Rod, u: Floats) -> _Chain:
    theta = rod.step[:, None] * u
    turn, turning = _rotation(theta), _turning(theta)
    start = np.empty((len(u), 3, 3))
    frame = rod.base_rotation
    for j in range(len(u)):
        start[j] = frame
        frame = frame @ turn[j]
    # the chord of an arc is the same series as the derivative of its turn
    node = rod.base_position + np.cumsum(rod.step[:, None] * np.einsum("jxy,jy->jx", start, turning[:, :, 2]), axis=0)
    return _Chain(start, node, frame, start @ turning, rod.step[:, None, None] * (start @ _bending(theta)))


def _jacobian(rod: _Rod, chain: _Chain) -> Floats:
    """(n, 3, 3 e): how each node moves with the curvatures."""
    n = len(chain.node)
    arm = chain.node[:, None] - chain.node[None]
    moved = np.cross(chain.spin[None], arm[..., None], axis=2) + chain.shift[None]
    moved *= (rod.step * (np.arange(n)[:, None] >= np.arange(n)))[..., None, None]
    return rod.coarse(moved.transpose(0, 2, 1, 3))


def _path(rod: _Rod, u: Floats) -> tuple[Floats, Floats]:
    """Tendon paths (m,) and unit directions (n, m, 3)."""
    q = E3 + np.cross(u[:, None], rod.offset)
    speed = np.linalg.norm(q, axis=-1)
    return np.einsum("j,ji,ji->i", rod.step, rod.crossing, speed), q / speed[..., None]


def _stretch(rod: _Rod, u: Floats) -> tuple[Floats, Floats]:
    """Stretch of the wires (m,) [m], zero where slack, and their directions (n, m, 3)."""
    path, direction = _path(rod, u)
    stretch = path - rod.free_length
    return np.maximum(stretch, 0.0) if rod.unilateral else stretch, direction


def _answer(rod: _Rod, obstacles: tuple[Obstacle, ...], x: Floats, force: Floats, load: Floats, state: _State) -> Minimum:
    look = _look(rod, obstacles, x)
    contact = np.zeros((len(look.rod.step) + 1, 3))
    np.add.at(contact, look.node + 1, force[look.slot][:, None] * look.normal)
    positions = np.concatenate([rod.base_position[None], look.chain.node])
    gap = np.min([o.distance(positions).value - rod.rho for o in obstacles], axis=0) if obstacles else np.full(len(positions), np.inf)
    u = rod.fine(x)
    chain = _chain(rod, u)
    stretch, direction = _stretch(rod, u)
    tension = stretch / rod.compliance
    # moment of rod and wires in the middle of the first three elements, in the world, carried on to the base
    moment = rod.stiffness * (u - rod.precurvature) + np.einsum("i,ji,jix->jx", tension, rod.crossing, np.cross(rod.offset, direction))
    turned = np.einsum("jxy,jy->jx", chain.start @ _rotation(0.5 * rod.step[:, None] * u), moment)
    return Minimum(
        arclength=np.concatenate([[0.0], np.cumsum(look.rod.step)]),
        positions=positions,
        tip_position=positions[-1],
        tip_rotation=chain.tip,
        gap=gap,
        contact_force=contact,
        total_force=contact.sum(axis=0),
        tension=tension,
        tendon_length=_path(rod, u)[0],
        base_force=-load - contact.sum(axis=0),
        base_moment=-np.array([15.0, -10.0, 3.0]) / 8.0 @ turned[:3],
        curvature=look.rod.fine(x),
        energy=_energy(rod, u, chain),
        **state._asdict(),
    )


def _outer(a: Floats, b: Floats) -> Floats:
    return a[..., :, None] * b[..., None, :]


def _unit(a: ArrayLike) -> Floats:
    v = np.asarray(a, dtype=float)
    return v / np.linalg.norm(v)


def _length_and_direction(v: Floats) -> tuple[Floats, Floats]:
    """Of (p, 3); on the point itself, where there is no direction, a zero vector, and a length that can divide."""
    d = np.linalg.norm(v, axis=1)
    some = np.maximum(d, 1e-12)
    return some, v / some[:, None]


def _hat(w: NDArray[Any]) -> NDArray[Any]:
    x, y, z = w[..., 0], w[..., 1], w[..., 2]
    o = np.zeros_like(x)
    return np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*w.shape, 3)


def _series(square: NDArray[Any], first: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """sum_k (-square)^k / (first + 2 k)! and its derivative by `square`, analytic at zero: angles of a step are below one."""
    coefficient = 1.0 / float(np.prod(np.arange(1, first + 1)))
    total, slope, power = np.full_like(square, coefficient), np.zeros_like(square), np.ones_like(square)
    for k in range(1, 9):
        coefficient /= -float((first + 2 * k - 1) * (first + 2 * k))
        slope = slope + k * coefficient * power
        power = power * square
        total = total + coefficient * power
    return total, slope


def _square(w: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.sum(w * w, axis=-1)[..., None, None])


def _rotation(w: NDArray[Any]) -> NDArray[Any]:
    """exp [w]x."""
    k, square = _hat(w), _square(w)
    return np.asarray(np.eye(3) + _series(square, 1)[0] * k + _series(square, 2)[0] * (k @ k))


def _turning(w: NDArray[Any]) -> NDArray[Any]:
    """Left Jacobian of SO(3), the integral of exp [s w]x over s in (0, 1): how exp [w]x turns, in the frame it starts from."""
    k, square = _hat(w), _square(w)
    return np.asarray(np.eye(3) + _series(square, 2)[0] * k + _series(square, 3)[0] * (k @ k))


def _bending(w: NDArray[Any]) -> NDArray[Any]:
    """Derivative of the chord _turning(w) e3 by w, (..., 3, 3)."""
    b, b_slope = _series(_square(w), 2)
    c, c_slope = _series(_square(w), 3)
    k, once = _hat(w), np.cross(w, E3)
    twice = np.cross(w, once)
    side = np.broadcast_to(_hat(E3), k.shape)
    along = b_slope * once[..., :, None] + c_slope * twice[..., :, None]
    return np.asarray(-b * side - c * (_hat(once) + k @ side) + 2.0 * along * w[..., None, :])
