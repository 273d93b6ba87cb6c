"""Continuous collision check: what a rod passed through between the last step and this one, and by which side
its centreline came into an obstacle."""

from __future__ import annotations

import math

from fastrod.types import ContactMotion, ContactRods, Floats, Records, Surfaces

from ..jit import inline, kernel
from ..rod.gather import pick
from ..vec import Vec, add, axpy, dot, mul, sub
from .bvh import FAR, Numbers
from .centreline import curve_before, curve_of, interval_of, point_at
from .contact_set import segment_at
from .surface import ray_hit, rotation_of, signed_distance, to_obstacle


@inline
def carried(before: Floats, after: Floats, p: Vec) -> Vec:
    """The world point p after it has moved with a frame, from `before` to `after` (12,) each."""
    return add(mul(rotation_of(after), to_obstacle(before, p)), (after[9], after[10], after[11]))


@kernel
def _passes_through(
    k: int, frame: Floats, p: Vec, q: Vec, deep: float, surfaces: Surfaces, stack: Numbers
) -> bool:
    """Whether the straight displacement from p to q, both outside of obstacle k, goes through it: the
    surfaces at both ends face different ways or the line runs deeper than `deep`; sliding along a convex
    surface is neither."""
    displacement = sub(q, p)
    length = math.sqrt(dot(displacement, displacement))
    if length < 1e-9:
        return False
    d, n_p, near = signed_distance(k, frame, p, length, surfaces, stack)
    if not near or d >= length or d < 0.0:
        return False
    direction = (displacement[0] / length, displacement[1] / length, displacement[2] / length)
    t, _ = ray_hit(k, frame, p, direction, length, surfaces, stack)
    if t >= length:
        return False
    end, n_q, _ = signed_distance(k, frame, q, FAR, surfaces, stack)
    if end < 0.0:
        return False
    if dot(n_p, n_q) < 0.2:
        return True
    middle = signed_distance(k, frame, axpy(0.5 * (t + length), direction, p), FAR, surfaces, stack)[0]
    return bool(middle < -deep)


@kernel
def tunnelled(
    i: int, motion: ContactMotion, first: float, surfaces: Surfaces, stack: Numbers
) -> tuple[int, float]:
    """The obstacle that a node of robot i went through since the last step, beyond the arclength `first`,
    seen from the obstacle, and the node's arclength; -1 where there is none."""
    before, after = curve_before(motion, i), curve_of(motion, i)
    frames_before = motion.frames_before[pick(i, len(motion.frames_before))]
    frames = motion.frames[pick(i, len(motion.frames))]
    n, j = len(after.arclength), 0
    deep = 0.02 * after.arclength[n - 1]  # along a convex surface a step slides shallower than that
    for node in range(n):
        s = after.arclength[node]
        if s <= first:
            continue
        q = point_at(after, min(node, n - 2), 1.0 if node == n - 1 else 0.0)
        j, fraction = interval_of(before, s, j)
        old = point_at(before, j, fraction)
        for k in range(len(frames)):
            p = carried(frames_before[k], frames[k], old)
            if _passes_through(k, frames[k], p, q, deep, surfaces, stack):
                return k, s
    return -1, 0.0


@kernel
def moved_far(i: int, motion: ContactMotion, first: float) -> bool:
    """Some node of robot i beyond the arclength `first` has moved farther than it was away from all
    obstacles."""
    for j in range(motion.arclength.shape[1]):
        if motion.arclength[i, j] <= first:  # not measured: it belongs to the mounting
            continue
        p, q = motion.position[i, j], motion.measured_at[i, j]
        if not motion.distance[i, j] > math.sqrt(
            (p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2
        ):
            return True
    return False


@kernel
def _entered(
    i: int, k: int, s: float, motion: ContactMotion, surfaces: Surfaces, stack: Numbers
) -> tuple[float, Vec]:
    """Signed distance of robot i's centreline at s to the side of obstacle k by which it came in since the
    last step, and that side's normal; FAR where it came in by none. The nearest side of a thin plate may be
    the other one."""
    before, after = curve_before(motion, i), curve_of(motion, i)
    frame_before = motion.frames_before[pick(i, len(motion.frames_before)), k]
    frame = motion.frames[pick(i, len(motion.frames)), k]
    j_before, fraction_before = interval_of(before, s, 0)
    j, fraction = interval_of(after, s, 0)
    p = carried(frame_before, frame, point_at(before, j_before, fraction_before))
    q = point_at(after, j, fraction)
    displacement = sub(q, p)
    length = math.sqrt(dot(displacement, displacement))
    nothing = (0.0, 0.0, 0.0)
    if length < 1e-9 or signed_distance(k, frame, q, FAR, surfaces, stack)[0] >= 0.0:
        return FAR, nothing
    if signed_distance(k, frame, p, FAR, surfaces, stack)[0] <= 0.0:
        return FAR, nothing
    direction = (displacement[0] / length, displacement[1] / length, displacement[2] / length)
    t, n = ray_hit(k, frame, p, direction, length, surfaces, stack)
    if t >= length or dot(displacement, n) >= 0.0:
        return FAR, nothing
    return dot(displacement, n) * (1.0 - t / length), n


@kernel
def face_entered_sides(
    i: int,
    n_found: int,
    found: Records,
    motion: ContactMotion,
    rods: ContactRods,
    surfaces: Surfaces,
    stack: Numbers,
) -> None:
    """Turn candidates of robot i whose centreline is inside an obstacle to the side by which it came in."""
    if not motion.tracked[i]:
        return
    arclength, radius = motion.arclength[i], rods.radius[i]
    seen = False
    for f in range(n_found):
        s, k = found[f].arclength, found[f].obstacle
        if found[f].gap + radius[segment_at(arclength, rods.n_steps, s)] >= 0.0:
            continue
        d, n = _entered(i, k, s, motion, surfaces, stack)
        # across a thin plate the nearest side says nothing: the deepest node does
        for j in range(0 if seen else len(arclength)):
            if arclength[j] > rods.first[i]:
                d_j, n_j = _entered(i, k, arclength[j], motion, surfaces, stack)
                if d_j < FAR and (d_j < d or d == FAR):
                    d, n, s = d_j, n_j, arclength[j]
        seen = True
        if d < FAR:
            found[f].arclength = s
            found[f].gap = d - radius[segment_at(arclength, rods.n_steps, s)]
            found[f].normal[0], found[f].normal[1], found[f].normal[2] = n
