"""One contact iteration of one world (the robots that may touch each other): new forces by the law, new contacts by the search.

The pass before has put every contact on a node of its own, and has written how the contact points move with their forces
and with the closing of the boundary (`Probes`). With the forces that the law asks for on that linear model the boundary is
closed. The search on the same shape says where the gap is violated next.
"""

from __future__ import annotations

import math

from fastrod.types import Clearance, Floats, Ints, Memory, Probes, Touching

from .bvh import STACK, Numbers
from .centreline import Curve, curve_of, interval_of, point_at
from .forces import Scenery, apply_law, forces_size
from .gather import pick
from .jit import inline, kernel
from .search import CANDIDATE, Sweep, crosses, search_obstacles
from .slots import T_FORCE, T_OBSTACLE, T_S, add_walls, choose, merge, pressed_only, violation
from .strands import search_rods

GOES_ON, AT_REST, LOST = 0, 1, 2
_MOST_FOUND = 64
_LONGEST_TURN = 0.5  # of EI/l in the base moment, about radians of bend: farther the linear model does not reach
_LONGEST_MOVE = 0.05  # of the rod's length, of a contact point


def world_size(n_rows: int, n_slots: int, most_slots: int, n_points: int) -> int:
    """Numbers of scratch that `iterate_world` needs, with `n_slots` contacts in this pass and `most_slots` in the next."""
    search = n_rows * (1 + _MOST_FOUND * CANDIDATE) + 3 * most_slots + 4 * n_points + 4 * STACK
    return max(forces_size(n_rows, n_slots), search)


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
    move, m = 0.0, probes.motion[r]
    for q in range(count):
        square = 0.0
        for a in range(3):
            v = m[3 * q + a, 0]
            for p in range(count):
                for g in range(3):
                    v += m[3 * q + a, 1 + 3 * p + g] * (proposed[r, p, g] - probes.force[r, p, g])
            square += v * v
        move = max(move, math.sqrt(square))
    part = min(1.0, min(_LONGEST_TURN / max(turn, max(pull, 1e-300)), _LONGEST_MOVE * rods.reach[i] / max(move, 1e-300)))
    return max(move, turn * rods.reach[i]), part


@kernel
def _press(r: int, i: int, scenery: Scenery, touching: Touching, probes: Probes, proposed: Floats) -> float:
    """How much farther the proposed forces go into soft obstacles, or move free ones [m]; where a rod is pressed along its axis
    nothing else moves."""
    deepest = 0.0
    for q in range(touching.used[i]):
        k = int(touching.slot[i, q, T_OBSTACLE])
        own = k < len(scenery.surfaces.kind)
        soft = scenery.surfaces.compliance[k] + scenery.surfaces.give[k, 0] if own else scenery.rods.compliance
        for a in range(3):
            deepest = max(deepest, soft * abs(proposed[r, q, a] - probes.force[r, q, a]))
    return deepest


@inline
def sweep_of(i: int, scenery: Scenery, margin: float) -> Sweep:
    """How robot i is searched; `margin` is a part of its length, and candidates nearer than a twentieth of an integration step are one."""
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
        p, q = shape.position[i, j], clearance.position[i, j]
        close = close or not clearance.distance[i, j] > math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)
    if not close:
        return False
    sweep = sweep_of(i, scenery, scenery.margin)
    return bool(crosses(curve_of(scenery.before, i), curve_of(shape, i), frames_before, frames, sweep, scenery.surfaces, work))


@kernel
def look_at(i: int, scenery: Scenery, clearance: Clearance, found: Floats, work: Numbers) -> tuple[int, float]:
    """Number of candidates of robot i and its smallest gap; -1 where it has gone through an obstacle since the last step."""
    if went_through(i, scenery, clearance, False, work):
        return -1, 0.0
    return search_obstacles(
        curve_of(scenery.shape, i), sweep_of(i, scenery, scenery.margin), scenery.surfaces, scenery.frames[pick(i, len(scenery.frames))],
        clearance.distance[i], clearance.position[i], work, found,
    )  # fmt: skip


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
    solved = apply_law(first, last, rows, scenery, touching, probes, proposed, work)
    farthest, part = 0.0, 1.0
    for r in range(first, last):
        i = rows[r]
        move, most = _stride(r, i, touching.used[i], scenery, probes, proposed, unknown[r])
        residual = scenery.shape.residual[i]
        if not (math.isfinite(move) and math.isfinite(residual)):
            for lost in range(first, last):
                status[lost] = LOST
            return
        move = max(move, _press(r, i, scenery, touching, probes, proposed))
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
            curve_of(scenery.shape, i), sweep_of(i, scenery, scenery.margin), scenery.surfaces,
            scenery.frames[pick(i, len(scenery.frames))],
            clearance.distance[i], clearance.position[i], scratch, found,
        )  # fmt: skip
        n_found[r - first] = float(count)
        worst = max(worst, violation(count, found, touching.used[i], touching.slot[i], scenery.rods.spacing[i]))
    worst = max(worst, search_rods(first, last, rows, scenery.shape, scenery.rods, touching, n_obstacles, scenery.margin, gap, False))
    rest = solved and farthest <= scenery.tolerance and worst <= scenery.tolerance
    through = False
    for r in range(first, last if rest else first):
        through = through or went_through(rows[r], scenery, clearance, True, scratch)
    for r in range(first, last):
        status[r] = LOST if through else AT_REST if rest else GOES_ON
    if rest:
        for r in range(first, last):
            touching.used[rows[r]] = pressed_only(touching.used[rows[r]], touching.slot[rows[r]])
        return
    for r in range(first, last):
        i = rows[r]
        slot = touching.slot[i]
        for q in range(touching.used[i]):
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
    margin = scenery.margin * rods.reach[i]
    count = choose(
        n_found, found, touching.used[i], slot, len(frames), rods.radius[i], scenery.surfaces.friction, rods.n_steps,
        curve.arclength, spacing, scenery.tolerance, 0.2 * margin,
    )  # fmt: skip
    count = merge(count, slot, spacing)
    for c in range(count):
        j, part = interval_of(curve, slot[c, T_S], 0)
        points[c, 0], points[c, 1], points[c, 2] = point_at(curve, j, part)
    touching.used[i] = add_walls(count, slot, points, frames, margin, scenery.surfaces, scratch[2 * STACK :], scratch)
