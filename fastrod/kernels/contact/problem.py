"""The contact forces of one world: every contact measured on the present shape, the linear model of how all
of them move, and the law on it.

The model m = d + C (F - F_now) comes from the pass (`PointLoads`): robots are coupled by nothing but their
contacts. A force on a curved surface turns as its point moves; F = F_law + B m with B the force times the
second derivative of the distance. Solved for m, the model holds that as well. Without B the iteration
diverges where a compliant tip rests on a small ball.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import ContactRods, ContactSet, Flags, Floats, Ints, PointLoads, RodShape, Surfaces

from ..jit import inline, kernel
from ..rod.gather import pick
from ..vec import Vec, add, axpy, cross, dot, mul, scale, sub
from .bvh import STACK, Numbers
from .centreline import curve_of, interval_of, point_at, rotation_at
from .contact_law import contact_forces, law_size, solve_dense
from .contact_set import (
    T_GAP,
    T_HOLD,
    T_N,
    T_OBSTACLE,
    T_RADIUS,
    T_S,
    arm_of,
    slot_force,
    slot_normal,
    wall_at,
)
from .mobility import add_mobility, axis_of
from .proximity import carried
from .rod_proximity import twin_of
from .surface import surface_curvature

# of a hold: what is left after one pass, and what damps where nothing is curved
_FORGETS, _PART_KEPT = 0.5, 0.3


class SceneArrays(NamedTuple):
    """What contact reads at one pass."""

    rods: ContactRods
    surfaces: Surfaces
    frames: Floats
    """(1 or n_robots, n_obstacles, 12) rotation row by row, position: world_from_obstacle."""
    frames_before: Floats
    """(1 or n_robots, n_obstacles, 12) when the rods were in `before`."""
    frames_slip: Floats
    """(1 or n_robots, n_obstacles, 12) where the obstacles' material was at the last step: what slip is
    counted from. Another than `frames_before` where a velocity was given (a belt moves, its frame does
    not)."""
    shape: RodShape
    before: RodShape
    """Where the rods have come from, and through nothing since: the last step, or the last pass of a damped
    iteration; of length 0 if there is none."""
    before_slip: RodShape
    """The shapes at the last step: what slip is counted from."""
    tracked: Flags
    """(n_robots,) `before` holds where the robot was."""
    slides: Flags
    """(n_robots,) slip is counted from there; where not, friction is left out."""
    tolerance: float
    """Motion, residual and violation below which a world is at rest [m]."""
    margin: float
    """Gap below which a contact is watched, as a part of the rod's length."""
    damping: Floats
    """(n_robots,) 0, or how many times the largest turning of a force is held against the motion of its
    point: where the plain iteration finds no rest, this one goes down in energy, slowly."""


@inline
def _tangents(n: Vec) -> tuple[Vec, Vec]:
    """Two directions that make a right-handed frame with n."""
    helper = (1.0, 0.0, 0.0) if abs(n[0]) < 0.6 else (0.0, 1.0, 0.0)
    t = cross(n, helper)
    t = scale(1.0 / math.sqrt(dot(t, t)), t)
    return t, cross(n, t)


@kernel
def _material_before(i: int, node: int, slot: Numbers, scenery: SceneArrays) -> Vec:
    """Where the rod's material point of contact was at the last step, world."""
    shape, before = scenery.shape, curve_of(scenery.before_slip, i)
    rotation = shape.rotation[i, node]
    arm = arm_of(slot)
    local = (
        rotation[0, 0] * arm[0] + rotation[1, 0] * arm[1] + rotation[2, 0] * arm[2],
        rotation[0, 1] * arm[0] + rotation[1, 1] * arm[1] + rotation[2, 1] * arm[2],
        rotation[0, 2] * arm[0] + rotation[1, 2] * arm[1] + rotation[2, 2] * arm[2],
    )
    j, part = interval_of(before, slot[T_S], node)
    return add(point_at(before, j, part), mul(rotation_at(before, j, part), local))


@inline
def _node_point(shape: RodShape, i: int, node: int) -> Vec:
    row = shape.position[i, node]
    return row[0], row[1], row[2]


@kernel
def _measure(
    r: int,
    q: int,
    other: int,
    rows: Ints,
    scenery: SceneArrays,
    touching: ContactSet,
    probes: PointLoads,
    stack: Numbers,
    found: Numbers,
) -> Vec:
    """Gap and normal of a contact on the present shape, kept in its slot; the slip since the last step
    (world)."""
    i = rows[r]
    slot, node = touching.slot[i, q], probes.node[r, q]
    p = _node_point(scenery.shape, i, node)
    slides = scenery.slides[i]
    old = slot_normal(slot)
    if other < 0:
        k = int(slot[T_OBSTACLE])
        frame = scenery.frames[pick(i, len(scenery.frames)), k]
        d, n = wall_at(
            k, frame, p, old, scenery.margin * scenery.rods.reach[i], scenery.surfaces, stack, found
        )
        slot[T_GAP] = d - slot[T_RADIUS]
        slot[T_N], slot[T_N + 1], slot[T_N + 2] = n
        if not slides:
            return 0.0, 0.0, 0.0
        ground = carried(
            frame, scenery.frames_slip[pick(i, len(scenery.frames_slip)), k], add(p, arm_of(slot))
        )
        return sub(ground, _material_before(i, node, slot, scenery))
    b, q_b = rows[other], twin_of(touching, len(scenery.surfaces.kind), i, q)
    twin = touching.slot[b, q_b]
    e = sub(p, _node_point(scenery.shape, b, probes.node[other, q_b]))
    along, thick = dot(e, old), slot[T_RADIUS] + twin[T_RADIUS]
    length = math.sqrt(dot(e, e))
    n, gap = (
        (scale(1.0 / length, e), length - thick)
        if along > 0.2 * length and length > 1e-12
        else (old, along - thick)
    )
    for a in range(3):
        slot[T_N + a], twin[T_N + a] = n[a], -n[a]
    slot[T_GAP], twin[T_GAP] = gap, gap
    if not (slides and scenery.slides[b]):
        return 0.0, 0.0, 0.0
    here = sub(add(p, arm_of(slot)), _material_before(i, node, slot, scenery))
    there_p = _node_point(scenery.shape, b, probes.node[other, q_b])
    there = sub(add(there_p, arm_of(twin)), _material_before(b, probes.node[other, q_b], twin, scenery))
    return sub(here, there)


@inline
def _axis(a: int) -> Vec:
    return 1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0


@inline
def _tangent(shape: RodShape, i: int, node: int) -> Vec:
    rotation = shape.rotation[i, node]
    return rotation[0, 2], rotation[1, 2], rotation[2, 2]


@inline
def _bow(shape: RodShape, i: int, node: int) -> Vec:
    """r'' = R (u x e3)."""
    rotation, u = shape.rotation[i, node], shape.curvature[i, node]
    return (
        rotation[0, 0] * u[1] - rotation[0, 1] * u[0],
        rotation[1, 0] * u[1] - rotation[1, 1] * u[0],
        rotation[2, 0] * u[1] - rotation[2, 1] * u[0],
    )


@inline
def _across(first: float, second: float, along: Vec, n: Vec, v: Vec) -> Vec:
    """Second derivative of the distance times v (`surface_curvature`)."""
    return axpy((second - first) * dot(along, v), along, scale(first, axpy(-dot(n, v), n, v)))


@kernel
def _turning(
    r: int,
    q: int,
    other: int,
    twin: int,
    rows: Ints,
    scenery: SceneArrays,
    touching: ContactSet,
    probes: PointLoads,
    stack: Numbers,
    bend: Floats,
) -> float:
    """How the force on a contact turns as its point moves: force times curvature of the gap, (9,) into
    `bend`; its largest size.

    Along a rod the contact stays where the gap is least, and other material comes under it: what that takes
    away is the square of the mixed derivative over the second derivative of the gap along the rod.
    """
    i, slot, node = rows[r], touching.slot[rows[r], q], probes.node[r, q]
    for a in range(9):
        bend[a] = 0.0
    n, last = slot_normal(slot), scenery.shape.arclength.shape[1] - 1
    force = dot(slot_force(slot), n)
    if not force > 0.0:
        return 0.0
    p = _node_point(scenery.shape, i, node)
    t, v = _tangent(scenery.shape, i, node), (0.0, 0.0, 0.0)
    rate_t, rate_v, mixed = 0.0, 0.0, 0.0
    inside, inside_other = node < last, False
    if other < 0:
        if slot[T_GAP] + slot[T_RADIUS] <= 0.0:
            return 0.0
        k = int(slot[T_OBSTACLE])
        first, second, along = surface_curvature(
            k, scenery.frames[pick(i, len(scenery.frames)), k], p, scenery.surfaces, stack
        )
    else:
        node_b = probes.node[other, twin]
        length = slot[T_GAP] + slot[T_RADIUS] + touching.slot[rows[other], twin][T_RADIUS]
        if length < 1e-9:
            return 0.0
        first, second, along = 1.0 / length, 1.0 / length, _axis(0)
        v, inside_other = scale(-1.0, _tangent(scenery.shape, rows[other], node_b)), node_b < last
        rate_v = dot(v, _across(first, second, along, n, v)) - dot(
            n, _bow(scenery.shape, rows[other], node_b)
        )
    if first == 0.0:
        return 0.0
    turned_t, turned_v = _across(first, second, along, n, t), _across(first, second, along, n, v)
    rate_t, mixed = dot(t, turned_t) + dot(n, _bow(scenery.shape, i, node)), dot(t, turned_v)
    for a in range(3):
        row = _across(first, second, along, n, _axis(a))
        x, y = dot(turned_t, _axis(a)), dot(turned_v, _axis(a))
        det = rate_t * rate_v - mixed * mixed
        if inside and inside_other and det > 1e-3 * first * first:
            row = axpy(
                -(rate_v * x - mixed * y) / det,
                turned_t,
                axpy(-(rate_t * y - mixed * x) / det, turned_v, row),
            )
        elif inside and rate_t > 1e-3:
            row = axpy(-x / rate_t, turned_t, row)
        elif inside_other and rate_v > 1e-3:
            row = axpy(-y / rate_v, turned_v, row)
        for b in range(3):
            bend[3 * a + b] = force * dot(row, _axis(b))
    return float(force * first)


@kernel
def _assemble(
    first: int, last: int, rows: Ints, touching: ContactSet, probes: PointLoads, start: Numbers, model: Floats
) -> int:
    """The linear models of all rows side by side; `start` gets the first contact point of each. How many
    points there are."""
    n = 0
    for r in range(first, last):
        start[r - first] = float(n)
        n += touching.used[rows[r]]
    for a in range(3 * n):
        for c in range(3 * n + 1):
            model[a, c] = 0.0
    for r in range(first, last):
        o, m = 3 * int(start[r - first]), probes.motion[r]
        for a in range(3 * touching.used[rows[r]]):
            model[o + a, 0] = m[a, 0]
            for c in range(3 * touching.used[rows[r]]):
                model[o + a, 1 + o + c] = m[a, 1 + c]
    return n


@kernel
def _bend_model(
    n: int,
    m: int,
    points: Numbers,
    bends: Floats,
    stiff: Numbers,
    damping: float,
    model: Floats,
    work: Numbers,
) -> None:
    """The model when the forces turn with their surfaces: m = model(F + B m), solved for m; as it was where
    that has no answer."""
    size = 3 * n
    stride = 2 * size + 1
    for a in range(size):
        for c in range(size):
            work[a * stride + c] = 1.0 if a == c else 0.0
            work[a * stride + size + 1 + c] = model[a, 1 + c]
        work[a * stride + size] = model[a, 0]
    for c in range(m):
        for end in range(2):
            g = int(points[2 * c + end])
            if g < 0:
                continue
            for other in range(2):
                h = int(points[2 * c + other])
                if h < 0:
                    continue
                sign = 1.0 if end == other else -1.0
                for a in range(size):
                    for b in range(3):
                        value = 0.0
                        for e in range(3):
                            hold = damping * stiff[c] if e == b else 0.0
                            value += model[a, 1 + 3 * g + e] * sign * (bends[c, 3 * e + b] - hold)
                        work[a * stride + 3 * h + b] -= value
    if not solve_dense(work, size, stride):
        return
    for a in range(size):
        for c in range(size + 1):
            model[a, c] = work[a * stride + size + c]


@kernel
def _keep_hold(
    first: int,
    last: int,
    rows: Ints,
    m: int,
    rods: ContactRods,
    touching: ContactSet,
    force: Numbers,
    stiff: Numbers,
) -> None:
    """Where no contact is curved any more, damp by a part of what was stiff some passes ago: a contact that
    goes to and fro between an edge and a face would not come to rest, as the face by itself is not damped. No
    contact that presses is damped less than by the bending stiffness of its rod, EI/l^3."""
    most, kept, least = 0.0, 0.0, 0.0
    for c in range(m):
        most = max(most, stiff[c])
    for r in range(first, last):
        least = max(least, rods.moment_scale[rows[r]] / rods.reach[rows[r]] ** 2)
        for q in range(touching.used[rows[r]]):
            kept = max(kept, _FORGETS * touching.slot[rows[r], q, T_HOLD])
    for c in range(m if most == 0.0 else 0):
        stiff[c] = _PART_KEPT * kept
    for r in range(first, last):
        for q in range(touching.used[rows[r]]):
            touching.slot[rows[r], q, T_HOLD] = max(most, kept)
    for c in range(m):
        if force[3 * c] > 0.0:
            stiff[c] = max(stiff[c], least)


@kernel
def _moved(n: int, model: Floats, a: int, change: Numbers) -> float:
    """Motion along axis a % 3 of point a // 3 when the boundary closes and the forces change."""
    value = model[a, 0]
    for c in range(3 * n):
        value += model[a, 1 + c] * change[c]
    return float(value)


@kernel
def _coupling(c: int, e: int, points: Numbers, axes: Numbers, a: int, b: int, model: Floats) -> float:
    """Motion of contact c along its axis a under a unit force of contact e along its axis b."""
    total = 0.0
    u, v = axis_of(axes[9 * c :], a), axis_of(axes[9 * e :], b)
    for s in range(2):
        g = int(points[2 * c + s])
        for t in range(2):
            h = int(points[2 * e + t])
            if g >= 0 and h >= 0:
                sign = 1.0 if s == t else -1.0
                for x in range(3):
                    row = model[3 * g + x]
                    o = 1 + 3 * h
                    total += sign * u[x] * (row[o] * v[0] + row[o + 1] * v[1] + row[o + 2] * v[2])
    return total


@kernel
def _row_of_robot(robot: int, rows: Ints, first: int, last: int) -> int:
    for r in range(first, last):
        if rows[r] == robot:
            return r
    return -1


def forces_size(n_rows: int, n_slots: int) -> int:
    """Numbers of scratch that `apply_law` needs."""
    m = n_rows * n_slots
    n = 3 * m
    return n_rows + 33 * m + 2 * n + n * n + n * (n + 1) + 4 * STACK + max(law_size(m), n * (2 * n + 1))


@kernel
def apply_law(
    first: int,
    last: int,
    rows: Ints,
    scenery: SceneArrays,
    touching: ContactSet,
    probes: PointLoads,
    proposed: Floats,
    work: Numbers,
) -> bool:
    """Forces that the law asks for on the linear model, into `proposed` (n_rows, n_slots, 3); whether it
    could be solved."""
    n_obstacles, n_rows = len(scenery.surfaces.kind), last - first
    most = n_rows * probes.node.shape[1]
    size, o = 3 * most, 0
    start, o = work[o : o + n_rows], o + n_rows
    points, o = work[o : o + 2 * most], o + 2 * most  # both sides of each contact; -1 is an obstacle
    axes, o = work[o : o + 9 * most], o + 9 * most
    b, o = work[o : o + 3 * most], o + 3 * most
    friction, o = work[o : o + most], o + most
    compliance, o = work[o : o + most], o + most
    stiff, o = work[o : o + most], o + most
    force, o = work[o : o + 3 * most], o + 3 * most
    touched, o = work[o : o + most], o + most
    place, o = work[o : o + 3 * most], o + 3 * most
    bends, o = work[o : o + 9 * most].reshape((most, 9)), o + 9 * most
    now, o = work[o : o + size], o + size
    change, o = work[o : o + size], o + size
    matrix, o = work[o : o + size * size], o + size * size
    model, o = work[o : o + size * (size + 1)].reshape((size, size + 1)), o + size * (size + 1)
    found, o = work[o : o + 2 * STACK], o + 2 * STACK
    stack, o = work[o : o + 2 * STACK], o + 2 * STACK
    scratch = work[o:]
    n = _assemble(first, last, rows, touching, probes, start, model)
    damping = 0.0
    for r in range(first, last):
        damping = max(damping, scenery.damping[rows[r]])
    m, bent = 0, damping > 0.0
    for r in range(first, last):
        i, base = rows[r], int(start[r - first])
        for q in range(touching.used[i]):
            slot = touching.slot[i, q]
            for a in range(3):
                now[3 * (base + q) + a] = probes.force[r, q, a]
            k, other, twin = int(slot[T_OBSTACLE]), -1, -1
            if k >= n_obstacles:
                other, twin = (
                    _row_of_robot(k - n_obstacles, rows, first, last),
                    twin_of(touching, n_obstacles, i, q),
                )
                if other < r or (other == r and twin < q):
                    continue  # counted from its other side
            slip = _measure(r, q, other, rows, scenery, touching, probes, stack, found)
            normal = slot_normal(slot)
            t1, t2 = _tangents(normal)
            for a in range(3):
                axes[9 * m + a], axes[9 * m + 3 + a], axes[9 * m + 6 + a] = normal[a], t1[a], t2[a]
            points[2 * m], points[2 * m + 1] = (
                float(base + q),
                float(int(start[other - first]) + twin) if other >= 0 else -1.0,
            )
            b[3 * m], b[3 * m + 1], b[3 * m + 2] = slot[T_GAP], dot(slip, t1), dot(slip, t2)
            mu = scenery.surfaces.friction[k] if other < 0 else scenery.rods.friction
            friction[m] = mu if scenery.slides[i] and (other < 0 or scenery.slides[rows[other]]) else 0.0
            touched[m] = float(k) if other < 0 else -1.0
            at = scenery.shape.position[i, probes.node[r, q]]
            for a in range(3):
                place[3 * m + a] = at[a] + probes.arm[r, q, a]
            compliance[m] = scenery.surfaces.compliance[k] if other < 0 else scenery.rods.compliance
            stiff[m] = _turning(r, q, other, twin, rows, scenery, touching, probes, stack, bends[m])
            bent = bent or stiff[m] > 0.0
            here = slot_force(slot)
            force[3 * m], force[3 * m + 1], force[3 * m + 2] = dot(here, normal), dot(here, t1), dot(here, t2)
            m += 1
    if m == 0:
        return True
    if damping > 0.0:
        _keep_hold(first, last, rows, m, scenery.rods, touching, force, stiff)
    if bent:
        _bend_model(n, m, points, bends, stiff, damping, model, scratch)
    for g in range(3 * n):
        change[g] = -now[g]
    W = matrix[: 9 * m * m].reshape((3 * m, 3 * m))
    for c in range(m):
        for side in range(2):
            g = int(points[2 * c + side])
            if g >= 0:
                v = (
                    _moved(n, model, 3 * g, change),
                    _moved(n, model, 3 * g + 1, change),
                    _moved(n, model, 3 * g + 2, change),
                )
                for a in range(3):
                    b[3 * c + a] += (1.0 if side == 0 else -1.0) * dot(v, axis_of(axes[9 * c :], a))
        for e in range(m):
            for a in range(3):
                for d in range(3):
                    W[3 * c + a, 3 * e + d] = _coupling(c, e, points, axes, a, d, model)
    add_mobility(m, touched, place, axes, scenery.surfaces.body, scenery.surfaces.give, W)
    solved = contact_forces(m, W, b, friction, compliance, force, scratch)
    for c in range(m):
        f = (0.0, 0.0, 0.0)
        for a in range(3):
            f = axpy(force[3 * c + a], axis_of(axes[9 * c :], a), f)
        for side in range(2):
            g = int(points[2 * c + side])
            for a in range(3 if g >= 0 else 0):
                change[3 * g + a] += (1.0 if side == 0 else -1.0) * f[a]
    for c in range(m if bent else 0):  # and what the forces turn
        g, h = int(points[2 * c]), int(points[2 * c + 1])
        v = (
            _moved(n, model, 3 * g, change),
            _moved(n, model, 3 * g + 1, change),
            _moved(n, model, 3 * g + 2, change),
        )
        if h >= 0:
            v = sub(
                v,
                (
                    _moved(n, model, 3 * h, change),
                    _moved(n, model, 3 * h + 1, change),
                    _moved(n, model, 3 * h + 2, change),
                ),
            )
        for a in range(3):
            row = bends[c, 3 * a : 3 * a + 3]
            turn = row[0] * v[0] + row[1] * v[1] + row[2] * v[2] - damping * stiff[c] * v[a]
            place[3 * c + a] = turn if force[3 * c] > 0.0 else 0.0  # what is open carries nothing
    for c in range(m if bent else 0):
        for side in range(2):
            g = int(points[2 * c + side])
            for a in range(3 if g >= 0 else 0):
                change[3 * g + a] += (1.0 if side == 0 else -1.0) * place[3 * c + a]
    for r in range(first, last):
        base = int(start[r - first])
        for q in range(touching.used[rows[r]]):
            for a in range(3):
                proposed[r, q, a] = now[3 * (base + q) + a] + change[3 * (base + q) + a]
    return solved
