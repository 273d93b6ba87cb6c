"""One contact iteration of one world (the robots that may touch each other): new forces by the law, new
contacts by the search.

The pass before has put every contact on a node of its own, and has written how the contact points move with
their forces and with the closing of the boundary (`PointLoads`). With the forces that the law asks for on
that linear model the boundary is closed. The search on the same shape says where the gap is violated next.
"""

from __future__ import annotations

import math

from fastrod.types import Clearance, ContactSet, Floats, Ints, Memory, PointLoads

from ..jit import inline, kernel
from ..rod.gather import pick
from ..vec import dot
from .bvh import FAR, STACK, Numbers
from .centreline import Curve, curve_of, interval_of, point_at
from .contact_set import (
    T_FORCE,
    T_OBSTACLE,
    T_S,
    add_walls,
    choose,
    merge,
    pressed_only,
    segment_at,
    slot_force,
    stands,
    violation,
)
from .problem import SceneArrays, apply_law, forces_size
from .proximity import CANDIDATE, ProximityOptions, crosses, entered, search_obstacles
from .rod_proximity import search_rods

GOES_ON, AT_REST, LOST, BACK = 0, 1, 2, 3
"""Of a world after a pass; BACK: a damped iteration went through something, or found no forces, and is to go
less far."""
NOTHING, MOVES, UNSOLVED, INSIDE, THROUGH, DIVERGED = 0, 1, 2, 3, 4, 5
"""What keeps a robot from rest: it still moves, its forces do not obey the law, the rod is inside of
something, it went through something, its numbers are no numbers."""
TROUBLE = 5
"""Numbers of one: which of these, obstacle (from n_obstacles on: rods; -1: none), arclength, size [m], and
how far its world is from rest: the largest of motion, residual and violation [m]."""
_NO_FORCE = 1e-12  # of the largest: what rounding leaves of a force that is gone
_MOST_FOUND = 64
# of EI/l in the base moment, about radians of bend: farther the linear model does not reach
_LONGEST_TURN = 0.5
_LONGEST_MOVE = 0.05  # of the rod's length, of a contact point


def world_size(n_rows: int, n_slots: int, most_slots: int, n_points: int) -> int:
    """Numbers of scratch that `iterate_world` needs, with `n_slots` contacts in this pass and `most_slots` in
    the next."""
    search = n_rows * (1 + _MOST_FOUND * CANDIDATE) + 3 * most_slots + 4 * n_points + 4 * STACK
    return max(forces_size(n_rows, n_slots), search)


@kernel
def _stride(
    r: int, i: int, count: int, scenery: SceneArrays, probes: PointLoads, proposed: Floats, unknown: Numbers
) -> tuple[float, float]:
    """How far the proposed forces and the closing boundary move the row [m], and the part of it that may be
    taken; the change of the unknowns goes to `unknown`."""
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
    part = min(
        1.0,
        min(_LONGEST_TURN / max(turn, max(pull, 1e-300)), _LONGEST_MOVE * rods.reach[i] / max(move, 1e-300)),
    )
    return max(move, turn * rods.reach[i]), part


@kernel
def _press(
    r: int, i: int, scenery: SceneArrays, touching: ContactSet, probes: PointLoads, proposed: Floats
) -> float:
    """How much farther the proposed forces go into soft obstacles, or move free ones [m]; where a rod is
    pressed along its axis nothing else moves."""
    deepest = 0.0
    for q in range(touching.used[i]):
        k = int(touching.slot[i, q, T_OBSTACLE])
        own = k < len(scenery.surfaces.kind)
        soft = (
            scenery.surfaces.compliance[k] + scenery.surfaces.give[k, 0] if own else scenery.rods.compliance
        )
        for a in range(3):
            deepest = max(deepest, soft * abs(proposed[r, q, a] - probes.force[r, q, a]))
    return deepest


@inline
def sweep_of(i: int, scenery: SceneArrays, margin: float) -> ProximityOptions:
    """How robot i is searched; `margin` is a part of its length, and candidates nearer than a twentieth of an
    integration step are one."""
    rods = scenery.rods
    return ProximityOptions(
        rods.radius[i],
        rods.n_steps,
        rods.first[i],
        margin * rods.reach[i],
        0.05 * rods.spacing[i],
        margin > 1.0,
    )


@kernel
def went_through(
    i: int, scenery: SceneArrays, clearance: Clearance, close: bool, work: Numbers
) -> tuple[int, float]:
    """The obstacle that robot i has gone through since the last step, and where on the rod; -1 where there is
    none. Unless `close` asked only where some node has moved farther than it was away from all."""
    if not scenery.tracked[i]:
        return -1, 0.0
    shape = scenery.shape
    frames_before = scenery.frames_before[pick(i, len(scenery.frames_before))]
    frames = scenery.frames[pick(i, len(scenery.frames))]
    for j in range(shape.arclength.shape[1]):
        p, q = shape.position[i, j], clearance.position[i, j]
        close = close or not clearance.distance[i, j] > math.sqrt(
            (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
        )
    if not close:
        return -1, 0.0
    sweep = sweep_of(i, scenery, scenery.margin)
    return crosses(
        curve_of(scenery.before, i), curve_of(shape, i), frames_before, frames, sweep, scenery.surfaces, work
    )


@kernel
def look_at(
    i: int, scenery: SceneArrays, clearance: Clearance, found: Floats, work: Numbers
) -> tuple[int, float]:
    """Number of candidates of robot i and its smallest gap; -1 where it has gone through an obstacle since
    the last step."""
    if went_through(i, scenery, clearance, False, work)[0] >= 0:
        return -1, 0.0
    return search_obstacles(
        curve_of(scenery.shape, i),
        sweep_of(i, scenery, scenery.margin),
        scenery.surfaces,
        scenery.frames[pick(i, len(scenery.frames))],
        clearance.distance[i],
        clearance.position[i],
        work,
        found,
    )


@kernel
def iterate_world(
    first: int,
    last: int,
    rows: Ints,
    scenery: SceneArrays,
    touching: ContactSet,
    clearance: Clearance,
    probes: PointLoads,
    memory: Memory,
    proposed: Floats,
    unknown: Floats,
    gap: Floats,
    trouble: Floats,
    status: Ints,
    work: Numbers,
) -> None:
    """Rows `first` to `last` of one pass. Writes the smallest gap of each row, its status and what keeps it
    from rest (`trouble` (n_robots, TROUBLE)); a world that is not at rest gets its next forces, unknowns and
    contacts."""
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
                _say(trouble[rows[lost]], DIVERGED, -1, 0.0, 0.0)
            return
        move = max(move, _press(r, i, scenery, touching, probes, proposed))
        farthest, part = max(farthest, max(move, residual)), min(part, most)
        _name_hardest(
            trouble[i], MOVES if solved else UNSOLVED, max(move, residual), touching.used[i], touching.slot[i]
        )
    o, size, worst = 0, _MOST_FOUND * CANDIDATE, 0.0
    n_found, o = work[o : o + last - first], o + last - first
    points, o = work[o : o + 3 * n_slots].reshape((n_slots, 3)), o + 3 * n_slots
    all_found, o = work[o : o + (last - first) * size], o + (last - first) * size
    scratch = work[o:]
    for r in range(first, last):
        i = rows[r]
        found = all_found[(r - first) * size : (r - first + 1) * size].reshape((_MOST_FOUND, CANDIDATE))
        count, gap[i] = search_obstacles(
            curve_of(scenery.shape, i),
            sweep_of(i, scenery, scenery.margin),
            scenery.surfaces,
            scenery.frames[pick(i, len(scenery.frames))],
            clearance.distance[i],
            clearance.position[i],
            scratch,
            found,
        )
        n_found[r - first] = float(count)
        deep, where = violation(
            count, found, touching.used[i], touching.slot[i], scenery.rods.spacing[i], scenery.surfaces
        )
        worst = max(worst, deep)
        if deep > scenery.tolerance:
            _say(trouble[i], INSIDE, int(found[where, 0]), found[where, 1], deep)
    worst = max(
        worst,
        search_rods(
            first, last, rows, scenery.shape, scenery.rods, touching, n_obstacles, scenery.margin, gap, False
        ),
    )
    if not solved and farthest <= scenery.tolerance:
        solved = True
        for r in range(first, last):
            solved = solved and stands(touching.used[rows[r]], touching.slot[rows[r]], scenery.tolerance)
    rest = solved and farthest <= scenery.tolerance and worst <= scenery.tolerance
    through = False
    for r in range(first, last):
        trouble[rows[r], 4] = max(farthest, worst)
    damped = scenery.damping[rows[first]] > 0.0
    for r in range(first, last if rest or damped else first):
        crossed, where_s = went_through(rows[r], scenery, clearance, True, scratch)
        through = through or crossed >= 0
        if crossed >= 0:
            _say(trouble[rows[r]], THROUGH, crossed, where_s, 0.0)
        elif rest:
            _say(trouble[rows[r]], NOTHING, -1, 0.0, 0.0)
    back = damped and (through or not solved)
    for r in range(first, last):
        status[r] = BACK if back else LOST if through else AT_REST if rest else GOES_ON
    if rest or back:
        for r in range(first, last if rest else first):
            touching.used[rows[r]] = pressed_only(touching.used[rows[r]], touching.slot[rows[r]])
        return
    for r in range(first, last):
        i = rows[r]
        slot, most = touching.slot[i], 0.0
        for q in range(touching.used[i]):
            for a in range(3):
                slot[q, T_FORCE + a] = probes.force[r, q, a] + part * (
                    proposed[r, q, a] - probes.force[r, q, a]
                )
                most = max(most, abs(slot[q, T_FORCE + a]))
        for q in range(touching.used[i]):
            for a in range(3):
                if abs(slot[q, T_FORCE + a]) <= _NO_FORCE * most:
                    slot[q, T_FORCE + a] = 0.0
        for a in range(n_x):
            memory.x[i, a] += part * unknown[r, a]
    for r in range(first, last):
        i = rows[r]
        found = all_found[(r - first) * size : (r - first + 1) * size].reshape((_MOST_FOUND, CANDIDATE))
        _renew(
            i, int(n_found[r - first]), found, points, curve_of(scenery.shape, i), scenery, touching, scratch
        )
    search_rods(
        first, last, rows, scenery.shape, scenery.rods, touching, n_obstacles, scenery.margin, gap, True
    )


@inline
def _say(trouble: Numbers, what: int, obstacle: int, s: float, size: float) -> None:
    """Write what keeps a robot from rest."""
    trouble[0], trouble[1], trouble[2], trouble[3] = float(what), float(obstacle), s, size


@kernel
def _name_hardest(trouble: Numbers, what: int, size: float, count: int, slot: Floats) -> None:
    """Write trouble of this size at the contact that presses hardest."""
    hardest, at = 0.0, -1
    for c in range(count):
        f = slot_force(slot[c])
        if dot(f, f) >= hardest:
            hardest, at = dot(f, f), c
    _say(trouble, what, int(slot[at, T_OBSTACLE]) if at >= 0 else -1, slot[at, T_S] if at >= 0 else 0.0, size)


@kernel
def _face(i: int, n_found: int, found: Floats, scenery: SceneArrays, stack: Numbers) -> None:
    """Candidates whose centreline is inside an obstacle face the side by which it came in."""
    if not scenery.tracked[i]:
        return
    before, curve, rods = curve_of(scenery.before, i), curve_of(scenery.shape, i), scenery.rods
    frames_before, frames = (
        scenery.frames_before[pick(i, len(scenery.frames_before))],
        scenery.frames[pick(i, len(scenery.frames))],
    )
    seen = False
    for f in range(n_found):
        s, k = found[f, 1], int(found[f, 0])
        radius = rods.radius[i, segment_at(curve.arclength, rods.n_steps, s)]
        if found[f, 2] + radius >= 0.0:
            continue
        d, n = entered(k, before, curve, s, frames_before[k], frames[k], scenery.surfaces, stack)
        # across a thin plate the nearest side says nothing: the deepest node does
        for j in range(0 if seen else len(curve.arclength)):
            if curve.arclength[j] > rods.first[i]:
                d_j, n_j = entered(
                    k, before, curve, curve.arclength[j], frames_before[k], frames[k], scenery.surfaces, stack
                )
                if d_j < FAR and (d_j < d or d == FAR):
                    d, n, s = d_j, n_j, curve.arclength[j]
        seen = True
        if d < FAR:
            radius = rods.radius[i, segment_at(curve.arclength, rods.n_steps, s)]
            found[f, 1], found[f, 2], found[f, 3], found[f, 4], found[f, 5] = s, d - radius, n[0], n[1], n[2]


@kernel
def _renew(
    i: int,
    n_found: int,
    found: Floats,
    points: Floats,
    curve: Curve,
    scenery: SceneArrays,
    touching: ContactSet,
    scratch: Numbers,
) -> None:
    """The contacts of robot i for its next pass."""
    slot, rods, frames = touching.slot[i], scenery.rods, scenery.frames[pick(i, len(scenery.frames))]
    spacing = rods.spacing[i]
    margin = scenery.margin * rods.reach[i]
    _face(i, n_found, found, scenery, scratch)
    count = choose(
        n_found,
        found,
        touching.used[i],
        slot,
        len(frames),
        rods.radius[i],
        scenery.surfaces,
        rods.n_steps,
        curve.arclength,
        spacing,
        scenery.tolerance,
        0.2 * margin,
    )
    count = merge(count, slot, spacing)
    for c in range(count):
        j, part = interval_of(curve, slot[c, T_S], 0)
        points[c, 0], points[c, 1], points[c, 2] = point_at(curve, j, part)
    touching.used[i] = add_walls(
        count, slot, points, frames, margin, scenery.surfaces, scratch[2 * STACK :], scratch
    )
