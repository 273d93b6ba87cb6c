"""Assembly of the contact problem: every contact measured on the present shape, the linear model of how all
contact points move, and the Delassus matrix between contacts.

The model m = d + C (F - F_applied) comes from the pass (`PointLoads`): robots are coupled by nothing but
their contacts.
"""

from __future__ import annotations

import math

from fastrod.types import ContactProblem, Floats, Ints

from ..jit import inline, kernel
from ..rod.gather import pick
from ..vec import Vec, add, cross, dot, mul, scale, sub
from .bvh import Numbers, Record, normal_of
from .centreline import curve_slip, interval_of, point_at, rotation_at
from .contact_set import arm_of, force_of, set_normal, wall_at
from .mobility import add_mobility, axis_of
from .problem import ContactWorld, node_position
from .tunnelling import carried


@inline
def tangents(n: Vec) -> tuple[Vec, Vec]:
    """Two directions that make a right-handed frame with n."""
    helper = (1.0, 0.0, 0.0) if abs(n[0]) < 0.6 else (0.0, 1.0, 0.0)
    t = cross(n, helper)
    t = scale(1.0 / math.sqrt(dot(t, t)), t)
    return t, cross(n, t)


@kernel
def _material_before(i: int, node: int, contact: Record, world: ContactWorld) -> Vec:
    """Position at the last step of the rod's material point of contact, world."""
    before = curve_slip(world.motion, i)
    rotation = world.motion.rotation[i, node]
    arm = arm_of(contact)
    local = (
        rotation[0, 0] * arm[0] + rotation[1, 0] * arm[1] + rotation[2, 0] * arm[2],
        rotation[0, 1] * arm[0] + rotation[1, 1] * arm[1] + rotation[2, 1] * arm[2],
        rotation[0, 2] * arm[0] + rotation[1, 2] * arm[1] + rotation[2, 2] * arm[2],
    )
    j, fraction = interval_of(before, contact.arclength, node)
    return add(point_at(before, j, fraction), mul(rotation_at(before, j, fraction), local))


@kernel
def _measure_obstacle(r: int, q: int, world: ContactWorld, stack: Numbers, problem: ContactProblem) -> Vec:
    """Gap and normal of a contact with an obstacle on the present shape, kept in it; the slip since the last
    step (world)."""
    i, motion = world.robot[r], world.motion
    contact, node = world.contacts.contact[i, q], world.loads.node[r, q]
    p, k = node_position(world, i, node), contact.obstacle
    frame, margin = motion.frames[pick(i, len(motion.frames)), k], motion.margin * world.rods.length[i]
    d, n = wall_at(k, frame, p, normal_of(contact), margin, world.surfaces, stack, problem.wall)
    contact.gap = d - contact.radius
    set_normal(contact, n)
    if not motion.slides[i]:
        return 0.0, 0.0, 0.0
    slip = motion.frames_slip[pick(i, len(motion.frames_slip)), k]
    ground = carried(frame, slip, add(p, arm_of(contact)))
    return sub(ground, _material_before(i, node, contact, world))


@kernel
def _measure_rods(r: int, q: int, other: int, q_other: int, world: ContactWorld) -> Vec:
    """Gap and normal of a contact between two rods, kept in both its sides; the slip (world)."""
    i, b = world.robot[r], world.robot[other]
    contact, partner = world.contacts.contact[i, q], world.contacts.contact[b, q_other]
    node, node_b = world.loads.node[r, q], world.loads.node[other, q_other]
    p, p_b, old = node_position(world, i, node), node_position(world, b, node_b), normal_of(contact)
    e = sub(p, p_b)
    along, thick = dot(e, old), contact.radius + partner.radius
    length = math.sqrt(dot(e, e))
    n, gap = (
        (scale(1.0 / length, e), length - thick)
        if along > 0.2 * length and length > 1e-12
        else (old, along - thick)
    )
    set_normal(contact, n)
    set_normal(partner, (-n[0], -n[1], -n[2]))
    contact.gap, partner.gap = gap, gap
    if not (world.motion.slides[i] and world.motion.slides[b]):
        return 0.0, 0.0, 0.0
    here = sub(add(p, arm_of(contact)), _material_before(i, node, contact, world))
    there = sub(add(p_b, arm_of(partner)), _material_before(b, node_b, partner, world))
    return sub(here, there)


@kernel
def measure(
    r: int,
    q: int,
    other: int,
    q_other: int,
    world: ContactWorld,
    stack: Numbers,
    problem: ContactProblem,
    m: int,
) -> None:
    """Measure contact q of row r (against contact `q_other` of row `other`, or an obstacle if that is -1) and
    write it as contact m of the problem."""
    i = world.robot[r]
    contact = world.contacts.contact[i, q]
    if other < 0:
        k, slides = contact.obstacle, world.motion.slides[i]
        slip = _measure_obstacle(r, q, world, stack, problem)
        friction, problem.compliance[m] = world.surfaces.friction[k], world.surfaces.compliance[k]
        problem.obstacle[m], problem.point[m, 1] = k, -1
    else:
        slides = world.motion.slides[i] and world.motion.slides[world.robot[other]]
        slip = _measure_rods(r, q, other, q_other, world)
        friction, problem.compliance[m] = world.rods.friction, world.rods.compliance
        problem.obstacle[m], problem.point[m, 1] = -1, problem.first_point[other - world.first] + q_other
    problem.point[m, 0] = problem.first_point[r - world.first] + q
    problem.friction[m] = friction if slides else 0.0
    normal = normal_of(contact)
    t1, t2 = tangents(normal)
    at, force = world.motion.position[i, world.loads.node[r, q]], force_of(contact)
    for a in range(3):
        problem.axes[m, 0, a], problem.axes[m, 1, a], problem.axes[m, 2, a] = normal[a], t1[a], t2[a]
        problem.place[m, a] = at[a] + world.loads.arm[r, q, a]
    problem.free[3 * m], problem.free[3 * m + 1] = contact.gap, dot(slip, t1)
    problem.free[3 * m + 2] = dot(slip, t2)
    problem.force[3 * m], problem.force[3 * m + 1] = dot(force, normal), dot(force, t1)
    problem.force[3 * m + 2] = dot(force, t2)


@kernel
def assemble_model(world: ContactWorld, problem: ContactProblem) -> int:
    """The linear models of all rows side by side, the forces that they belong to, and the change that takes
    these away. Returns how many contact points there are."""
    n, used, model = 0, world.contacts.used, problem.model
    for r in range(world.first, world.last):
        problem.first_point[r - world.first] = n
        n += used[world.robot[r]]
    for a in range(3 * n):
        for c in range(3 * n + 1):
            model[a, c] = 0.0
    for r in range(world.first, world.last):
        o, m = 3 * problem.first_point[r - world.first], world.loads.motion[r]
        for a in range(3 * used[world.robot[r]]):
            problem.applied[o + a] = world.loads.force[r, a // 3, a % 3]
            problem.change[o + a] = -problem.applied[o + a]
            model[o + a, 0] = m[a, 0]
            for c in range(3 * used[world.robot[r]]):
                model[o + a, 1 + o + c] = m[a, 1 + c]
    return n


@kernel
def moved(n: int, model: Floats, g: int, change: Numbers) -> Vec:
    """Motion of contact point g of n when the boundary closes and the forces change."""
    x, y, z = model[3 * g, 0], model[3 * g + 1, 0], model[3 * g + 2, 0]
    for c in range(3 * n):
        x += model[3 * g, 1 + c] * change[c]
        y += model[3 * g + 1, 1 + c] * change[c]
        z += model[3 * g + 2, 1 + c] * change[c]
    return x, y, z


@kernel
def _coupling(c: int, e: int, a: int, b: int, point: Ints, axes: Floats, model: Floats) -> float:
    """Motion of contact c along its axis a under a unit force of contact e along its axis b."""
    total = 0.0
    u, v = axis_of(axes[c], a), axis_of(axes[e], b)
    for s in range(2):
        g = point[c, s]
        for t in range(2):
            h = point[e, t]
            if g >= 0 and h >= 0:
                sign = 1.0 if s == t else -1.0
                for x in range(3):
                    row = model[3 * g + x]
                    o = 1 + 3 * h
                    total += sign * u[x] * (row[o] * v[0] + row[o + 1] * v[1] + row[o + 2] * v[2])
    return total


@kernel
def assemble_delassus(m: int, n: int, world: ContactWorld, problem: ContactProblem) -> None:
    """The Delassus matrix of m contacts, from the model of n contact points and the mobility of free bodies,
    and their motion without contact forces."""
    point, axes, model, delassus = problem.point, problem.axes, problem.model, problem.delassus
    for c in range(m):
        for side in range(2):
            g = point[c, side]
            if g >= 0:
                v = moved(n, model, g, problem.change)
                for a in range(3):
                    motion = dot(v, axis_of(axes[c], a))
                    problem.free[3 * c + a] += (1.0 if side == 0 else -1.0) * motion
        for e in range(m):
            for a in range(3):
                for d in range(3):
                    delassus[3 * c + a, 3 * e + d] = _coupling(c, e, a, d, point, axes, model)
    add_mobility(
        m,
        problem.obstacle,
        problem.place,
        problem.axes,
        world.surfaces.body,
        world.surfaces.mobility,
        problem.delassus,
    )
