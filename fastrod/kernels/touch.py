"""One contact iteration of one world (the robots that may touch each other): forces by the law, and contacts for the next pass.

The pass before has put every contact on a node of its own, and has written how the contact points move with their forces
and with the closing of the boundary (`Probes`). On that linear model the law gives new forces; with them the boundary is
closed. The search on the same shape says where the gap is violated next.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.kernels.bvh import STACK, Numbers
from fastrod.kernels.centreline import Curve, curve_of, interval_of, point_at, rotation_at
from fastrod.kernels.contact_law import contact_forces, law_size
from fastrod.kernels.gather import pick
from fastrod.kernels.jit import inline, kernel
from fastrod.kernels.search import CANDIDATE, Sweep, carried, crosses, search_obstacles
from fastrod.kernels.slots import (
    T_FORCE,
    T_GAP,
    T_N,
    T_OBSTACLE,
    T_RADIUS,
    T_S,
    T_TWIN,
    add_walls,
    arm_of,
    choose,
    merge,
    slot_force,
    slot_normal,
    violation,
    wall_at,
)
from fastrod.kernels.strands import search_rods, twin_of
from fastrod.kernels.vec import Vec, add, axpy, cross, dot, mul, scale, sub
from fastrod.types import Clearance, Flags, Floats, Ints, Memory, Probes, Rods, Shape, Surfaces, Touching

GOES_ON, AT_REST, LOST = 0, 1, 2
_MOST_FOUND = 64
_LONGEST_TURN = 0.5  # of EI/l in the base moment, about radians of bend: farther the linear model does not reach
_LONGEST_MOVE = 0.05  # of the rod's length, of a contact point


class Scenery(NamedTuple):
    """What contact reads at one pass."""

    rods: Rods
    surfaces: Surfaces
    frames: Floats
    """(1 or n_robots, n_obstacles, 12) rotation row by row, position: world_from_obstacle."""
    frames_before: Floats
    """(1 or n_robots, n_obstacles, 12) at the last step."""
    frames_slip: Floats
    """(1 or n_robots, n_obstacles, 12) where the obstacles' material was at the last step: what slip is counted from. Another
    than `frames_before` where a velocity was given (a belt moves, its frame does not)."""
    shape: Shape
    before: Shape
    """The shapes at the last step; of length 0 if there is none."""
    tracked: Flags
    """(n_robots,) `before` holds where the robot was."""
    slides: Flags
    """(n_robots,) slip is counted from there; where not, friction is left out."""
    tolerance: float
    """Motion, residual and violation below which a world is at rest [m]."""
    margin: float
    """Gap below which a contact is watched, as a part of the rod's length."""


def world_size(n_rows: int, n_slots: int, n_points: int) -> int:
    """Numbers of scratch that `iterate_world` needs."""
    m = n_rows * n_slots
    law = 9 * m * m + 21 * m + law_size(m) + 8 * STACK
    search = n_rows * (1 + _MOST_FOUND * CANDIDATE) + 3 * n_slots + 4 * n_points + 4 * STACK
    return max(law, search)


@inline
def _tangents(n: Vec) -> tuple[Vec, Vec]:
    """Two directions that make a right-handed frame with n."""
    helper = (1.0, 0.0, 0.0) if abs(n[0]) < 0.6 else (0.0, 1.0, 0.0)
    t = cross(n, helper)
    t = scale(1.0 / math.sqrt(dot(t, t)), t)
    return t, cross(n, t)


@kernel
def _material_before(i: int, node: int, slot: Numbers, scenery: Scenery) -> Vec:
    """Where the rod's material point of contact was at the last step, world."""
    shape, before = scenery.shape, curve_of(scenery.before, i)
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
def _node_point(shape: Shape, i: int, node: int) -> Vec:
    row = shape.position[i, node]
    return row[0], row[1], row[2]


@kernel
def _measure(
    r: int, q: int, other: int, rows: Ints, scenery: Scenery, touching: Touching, probes: Probes, stack: Numbers, found: Numbers
) -> Vec:
    """Gap and normal of a contact on the present shape, kept in its slot; the slip since the last step (world)."""
    i = rows[r]
    slot, node = touching.slot[i, q], probes.node[r, q]
    p = _node_point(scenery.shape, i, node)
    slides = scenery.slides[i]
    old = slot_normal(slot)
    if other < 0:
        k = int(slot[T_OBSTACLE])
        frame = scenery.frames[pick(i, len(scenery.frames)), k]
        d, n = wall_at(k, frame, p, old, scenery.margin * scenery.rods.reach[i], scenery.surfaces, stack, found)
        slot[T_GAP] = d - slot[T_RADIUS]
        slot[T_N], slot[T_N + 1], slot[T_N + 2] = n
        if not slides:
            return 0.0, 0.0, 0.0
        ground = carried(frame, scenery.frames_slip[pick(i, len(scenery.frames_slip)), k], add(p, arm_of(slot)))
        return sub(ground, _material_before(i, node, slot, scenery))
    b, q_b = rows[other], twin_of(touching, len(scenery.surfaces.kind), i, q)
    twin = touching.slot[b, q_b]
    e = sub(p, _node_point(scenery.shape, b, probes.node[other, q_b]))
    along, thick = dot(e, old), slot[T_RADIUS] + twin[T_RADIUS]
    length = math.sqrt(dot(e, e))
    n, gap = (scale(1.0 / length, e), length - thick) if along > 0.2 * length and length > 1e-12 else (old, along - thick)
    for a in range(3):
        slot[T_N + a], twin[T_N + a] = n[a], -n[a]
    slot[T_GAP], twin[T_GAP] = gap, gap
    if not (slides and scenery.slides[b]):
        return 0.0, 0.0, 0.0
    here = sub(add(p, arm_of(slot)), _material_before(i, node, slot, scenery))
    there_p = _node_point(scenery.shape, b, probes.node[other, q_b])
    there = sub(add(there_p, arm_of(twin)), _material_before(b, probes.node[other, q_b], twin, scenery))
    return sub(here, there)


@kernel
def _block(r: int, q: int, p: int, probes: Probes, v: Vec) -> Vec:
    """Motion of contact point q of row r under the force v on point p."""
    m = probes.motion[r]
    o, c = 3 * q, 1 + 3 * p
    return (
        m[o, c] * v[0] + m[o, c + 1] * v[1] + m[o, c + 2] * v[2],
        m[o + 1, c] * v[0] + m[o + 1, c + 1] * v[1] + m[o + 1, c + 2] * v[2],
        m[o + 2, c] * v[0] + m[o + 2, c + 1] * v[1] + m[o + 2, c + 2] * v[2],
    )


@kernel
def _free_motion(r: int, q: int, count: int, probes: Probes) -> Vec:
    """Motion of contact point q of row r when the boundary closes and every contact force goes."""
    m = probes.motion[r]
    v = (m[3 * q, 0], m[3 * q + 1, 0], m[3 * q + 2, 0])
    for p in range(count):
        v = sub(v, _block(r, q, p, probes, (probes.force[r, p, 0], probes.force[r, p, 1], probes.force[r, p, 2])))
    return v


@inline
def _axis_of(frame: Numbers, a: int) -> Vec:
    return frame[3 * a], frame[3 * a + 1], frame[3 * a + 2]


@kernel
def _coupling(c: int, e: int, ends: Numbers, axes: Numbers, a: int, b: int, probes: Probes) -> float:
    """Motion of contact c along its axis a under a unit force of contact e along its axis b."""
    total = 0.0
    v = _axis_of(axes[9 * e :], b)
    for s in range(2):
        r, q = int(ends[4 * c + 2 * s]), int(ends[4 * c + 2 * s + 1])
        for t in range(2):
            if r >= 0 and int(ends[4 * e + 2 * t]) == r:
                moved = _block(r, q, int(ends[4 * e + 2 * t + 1]), probes, v)
                total += (1.0 if s == t else -1.0) * dot(_axis_of(axes[9 * c :], a), moved)
    return total


@kernel
def _row_of_robot(robot: int, rows: Ints, first: int, last: int) -> int:
    for r in range(first, last):
        if rows[r] == robot:
            return r
    return -1


@kernel
def _apply_law(first: int, last: int, rows: Ints, scenery: Scenery, touching: Touching, probes: Probes, proposed: Floats, work: Numbers) -> bool:
    """Forces that the law asks for on the linear model, into `proposed` (n_rows, n_slots, 3); whether it could be solved."""
    n_obstacles, n_slots = len(scenery.surfaces.kind), touching.slot.shape[1]
    most = (last - first) * n_slots
    o = 0
    ends, o = work[o : o + 4 * most], o + 4 * most  # row and slot of both sides of each contact; row -1 is an obstacle
    axes, o = work[o : o + 9 * most], o + 9 * most
    b, o = work[o : o + 3 * most], o + 3 * most
    friction, o = work[o : o + most], o + most
    compliance, o = work[o : o + most], o + most
    force, o = work[o : o + 3 * most], o + 3 * most
    matrix, o = work[o : o + 9 * most * most], o + 9 * most * most
    scratch, o = work[o : o + law_size(most)], o + law_size(most)
    found, stack = work[o : o + 2 * STACK], work[o + 2 * STACK :]
    m = 0
    for r in range(first, last):
        i = rows[r]
        for q in range(touching.count[i]):
            slot = touching.slot[i, q]
            k, other, twin = int(slot[T_OBSTACLE]), -1, -1
            if k >= n_obstacles:
                other, twin = _row_of_robot(k - n_obstacles, rows, first, last), twin_of(touching, n_obstacles, i, q)
                if other < r or (other == r and twin < q):
                    continue  # counted from its other side
            slip = _measure(r, q, other, rows, scenery, touching, probes, stack, found)
            n = slot_normal(slot)
            t1, t2 = _tangents(n)
            for a in range(3):
                axes[9 * m + a], axes[9 * m + 3 + a], axes[9 * m + 6 + a] = n[a], t1[a], t2[a]
            ends[4 * m], ends[4 * m + 1], ends[4 * m + 2], ends[4 * m + 3] = float(r), float(q), float(other), float(twin)
            moves = add(_free_motion(r, q, touching.count[i], probes), slip)
            if other >= 0:
                moves = sub(moves, _free_motion(other, twin, touching.count[rows[other]], probes))
            b[3 * m], b[3 * m + 1], b[3 * m + 2] = slot[T_GAP] + dot(sub(moves, slip), n), dot(moves, t1), dot(moves, t2)
            mu = scenery.surfaces.friction[k] if other < 0 else scenery.rods.friction
            friction[m] = mu if scenery.slides[i] and (other < 0 or scenery.slides[rows[other]]) else 0.0
            compliance[m] = scenery.surfaces.compliance[k] if other < 0 else scenery.rods.compliance
            start = slot_force(slot)
            force[3 * m], force[3 * m + 1], force[3 * m + 2] = dot(start, n), dot(start, t1), dot(start, t2)
            m += 1
    if m == 0:
        return True
    W = matrix[: 9 * m * m].reshape((3 * m, 3 * m))
    for c in range(m):
        for e in range(m):
            for a in range(3):
                for g in range(3):
                    W[3 * c + a, 3 * e + g] = _coupling(c, e, ends, axes, a, g, probes)
    solved = contact_forces(m, W, b, friction, compliance, force, scratch)
    for c in range(m):
        f = (0.0, 0.0, 0.0)
        for a in range(3):
            f = axpy(force[3 * c + a], _axis_of(axes[9 * c :], a), f)
        r, q, other, twin = int(ends[4 * c]), int(ends[4 * c + 1]), int(ends[4 * c + 2]), int(ends[4 * c + 3])
        for a in range(3):
            proposed[r, q, a] = f[a]
            if other >= 0:
                proposed[other, twin, a] = -f[a]
    return solved


@kernel
def _stride(r: int, i: int, count: int, scenery: Scenery, probes: Probes, proposed: Floats, unknown: Numbers) -> tuple[float, float]:
    """How far the proposed forces and the closing boundary move the row [m], and the part of it that may be taken; the
    change of the unknowns goes to `unknown`."""
    n_x = probes.unknown.shape[1]
    rods = scenery.rods
    turn, pull = 0.0, 0.0
    for a in range(n_x):
        value = probes.unknown[r, a, 0]
        for p in range(count):
            for g in range(3):
                value += probes.unknown[r, a, 1 + 3 * p + g] * (proposed[r, p, g] - probes.force[r, p, g])
        unknown[a] = value
        if a < 3:
            turn = max(turn, abs(value) / rods.moment_scale[i])
        elif a < 3 + rods.n_free:
            pull = max(pull, abs(value) / rods.tension_scale[i])
    move = 0.0
    for q in range(count):
        v = (probes.motion[r, 3 * q, 0], probes.motion[r, 3 * q + 1, 0], probes.motion[r, 3 * q + 2, 0])
        for p in range(count):
            change = (
                proposed[r, p, 0] - probes.force[r, p, 0], proposed[r, p, 1] - probes.force[r, p, 1], proposed[r, p, 2] - probes.force[r, p, 2],
            )  # fmt: skip
            v = add(v, _block(r, q, p, probes, change))
        move = max(move, math.sqrt(dot(v, v)))
    part = min(1.0, min(_LONGEST_TURN / max(turn, max(pull, 1e-300)), _LONGEST_MOVE * rods.reach[i] / max(move, 1e-300)))
    return max(move, turn * rods.reach[i]), part


@inline
def sweep_of(i: int, scenery: Scenery, margin: float) -> Sweep:
    rods = scenery.rods
    return Sweep(rods.radius[i], rods.n_steps, rods.first[i], margin * rods.reach[i], 0.05 * rods.spacing[i])


@kernel
def went_through(i: int, scenery: Scenery, clearance: Clearance, close: bool, work: Numbers) -> bool:
    """Robot i has gone through an obstacle since the last step; unless `close` asked only where some node has moved farther
    than it was away from all."""
    if not scenery.tracked[i]:
        return False
    shape = scenery.shape
    frames_before = scenery.frames_before[pick(i, len(scenery.frames_before))]
    frames = scenery.frames[pick(i, len(scenery.frames))]
    for j in range(shape.arclength.shape[1]):
        e = sub(_node_point(shape, i, j), (clearance.position[i, j, 0], clearance.position[i, j, 1], clearance.position[i, j, 2]))
        close = close or not clearance.distance[i, j] > math.sqrt(dot(e, e))
    if not close:
        return False
    sweep = sweep_of(i, scenery, scenery.margin)
    return bool(crosses(curve_of(scenery.before, i), curve_of(shape, i), frames_before, frames, sweep, scenery.surfaces, work))


@kernel
def iterate_world(
    first: int,
    last: int,
    rows: Ints,
    scenery: Scenery,
    touching: Touching,
    clearance: Clearance,
    probes: Probes,
    memory: Memory,
    proposed: Floats,
    unknown: Floats,
    gap: Floats,
    status: Ints,
    work: Numbers,
) -> None:
    """Rows `first` to `last` of one pass. Writes the smallest gap of each row and its status; a world that is not at rest
    gets its next forces, unknowns and contacts."""
    n_slots, n_obstacles, n_x = touching.slot.shape[1], len(scenery.surfaces.kind), probes.unknown.shape[1]
    solved = _apply_law(first, last, rows, scenery, touching, probes, proposed, work)
    farthest, part = 0.0, 1.0
    for r in range(first, last):
        i = rows[r]
        move, most = _stride(r, i, touching.count[i], scenery, probes, proposed, unknown[r])
        residual = scenery.shape.residual[i]
        if not (math.isfinite(move) and math.isfinite(residual)):
            for lost in range(first, last):
                status[lost] = LOST
            return
        farthest, part = max(farthest, max(move, residual)), min(part, most)
    o, size, worst = 0, _MOST_FOUND * CANDIDATE, 0.0
    n_found, o = work[o : o + last - first], o + last - first
    points, o = work[o : o + 3 * n_slots].reshape((n_slots, 3)), o + 3 * n_slots
    all_found, o = work[o : o + (last - first) * size], o + (last - first) * size
    scratch = work[o:]
    for r in range(first, last):
        i = rows[r]
        found = all_found[(r - first) * size : (r - first + 1) * size].reshape((_MOST_FOUND, CANDIDATE))
        count, gap[i] = search_obstacles(
            curve_of(scenery.shape, i), sweep_of(i, scenery, scenery.margin), scenery.surfaces, scenery.frames[pick(i, len(scenery.frames))],
            clearance.distance[i], clearance.position[i], scratch, found,
        )  # fmt: skip
        n_found[r - first] = float(count)
        worst = max(worst, violation(count, found, touching.count[i], touching.slot[i], scenery.rods.spacing[i]))
    worst = max(worst, search_rods(first, last, rows, scenery.shape, scenery.rods, touching, n_obstacles, scenery.margin, gap, False))
    rest = solved and farthest <= scenery.tolerance and worst <= scenery.tolerance
    through = False
    for r in range(first, last if rest else first):
        through = through or went_through(rows[r], scenery, clearance, True, scratch)
    for r in range(first, last):
        status[r] = LOST if through else AT_REST if rest else GOES_ON
    if rest:
        return
    for r in range(first, last):
        i = rows[r]
        slot = touching.slot[i]
        for q in range(touching.count[i]):
            for a in range(3):
                slot[q, T_FORCE + a] = probes.force[r, q, a] + part * (proposed[r, q, a] - probes.force[r, q, a])
        for a in range(n_x):
            memory.x[i, a] += part * unknown[r, a]
    for r in range(first, last):
        i = rows[r]
        found = all_found[(r - first) * size : (r - first + 1) * size].reshape((_MOST_FOUND, CANDIDATE))
        _renew(i, int(n_found[r - first]), found, points, curve_of(scenery.shape, i), scenery, touching, scratch)
    search_rods(first, last, rows, scenery.shape, scenery.rods, touching, n_obstacles, scenery.margin, gap, True)


@kernel
def _renew(
    i: int,
    n_found: int,
    found: Floats,
    points: Floats,
    curve: Curve,
    scenery: Scenery,
    touching: Touching,
    scratch: Numbers,
) -> None:
    """The contacts of robot i for its next pass."""
    slot, rods, frames = touching.slot[i], scenery.rods, scenery.frames[pick(i, len(scenery.frames))]
    spacing = rods.spacing[i]
    count = choose(
        n_found, found, touching.count[i], slot, len(frames), rods.radius[i], rods.n_steps, curve.arclength, spacing, scenery.tolerance
    )
    count = merge(count, slot, spacing)
    for c in range(count):
        j, part = interval_of(curve, slot[c, T_S], 0)
        points[c, 0], points[c, 1], points[c, 2] = point_at(curve, j, part)
    margin = scenery.margin * rods.reach[i]
    touching.count[i] = add_walls(count, slot, points, frames, margin, scenery.surfaces, scratch[2 * STACK :], scratch)


