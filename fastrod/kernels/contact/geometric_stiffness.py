"""Geometric stiffness of contacts: a force on a curved surface turns as its point moves.

F = F_law + B m with m the motion of the points and B the force times the second derivative of the distance.
Solved for m, the linear model holds that as well. Without B the iteration diverges where a compliant tip
rests on a small ball.
"""

from __future__ import annotations

from fastrod.types import ContactMotion, ContactProblem

from ..jit import inline, kernel
from ..rod.gather import pick
from ..vec import Vec, axpy, dot, scale, sub
from .assemble import moved
from .bvh import Numbers, normal_of
from .contact_law import solve_dense
from .contact_set import force_of
from .problem import ContactWorld, node_position
from .surface import surface_curvature

_FORGETS, _FRACTION_KEPT = 0.5, 0.3
"""Decay of a stiffness that damping was based on: what is left of it after one pass, and what damps where
nothing is curved. (A contact that goes to and fro between an edge and a face comes to rest with these.)"""
_FLAT = 1e-3
"""Second derivative of the gap along a rod [1/m] below which its minimum is not followed, for it would run
away along the rod; of two rods the determinant, over the squared curvature."""


@inline
def _axis(a: int) -> Vec:
    return 1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0


@inline
def _tangent(motion: ContactMotion, i: int, node: int) -> Vec:
    rotation = motion.rotation[i, node]
    return rotation[0, 2], rotation[1, 2], rotation[2, 2]


@inline
def _centreline_curvature(motion: ContactMotion, i: int, node: int) -> Vec:
    """r'' = R (u x e3)."""
    rotation, u = motion.rotation[i, node], motion.curvature[i, node]
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
def geometric_stiffness(
    r: int,
    q: int,
    other: int,
    q_other: int,
    world: ContactWorld,
    stack: Numbers,
    problem: ContactProblem,
    m: int,
) -> float:
    """Change of the force of contact m as its point moves, force times curvature of the gap, into
    `problem.turned`; its largest size [N/m]. The contact as in `assemble.measure`.

    Along a rod the contact stays where the gap is least, and other material comes under it: what that takes
    away is the square of the mixed derivative over the second derivative of the gap along the rod.
    """
    motion, i, node = world.motion, world.robot[r], world.loads.node[r, q]
    contact, turned = world.contacts.contact[i, q], problem.turned[m]
    for a in range(3):
        for b in range(3):
            turned[a, b] = 0.0
    n, last = normal_of(contact), motion.arclength.shape[1] - 1
    force = dot(force_of(contact), n)
    if not force > 0.0:
        return 0.0
    t, v = _tangent(motion, i, node), (0.0, 0.0, 0.0)
    rate_t, rate_v, mixed = 0.0, 0.0, 0.0
    inside, inside_other = node < last, False
    if other < 0:
        if contact.gap + contact.radius <= 0.0:
            return 0.0
        k, p = contact.obstacle, node_position(world, i, node)
        frame = motion.frames[pick(i, len(motion.frames)), k]
        first, second, along = surface_curvature(k, frame, p, world.surfaces, stack)
    else:
        b, node_b = world.robot[other], world.loads.node[other, q_other]
        length = contact.gap + contact.radius + world.contacts.contact[b, q_other].radius
        if length < 1e-9:
            return 0.0
        first, second, along = 1.0 / length, 1.0 / length, _axis(0)
        v, inside_other = scale(-1.0, _tangent(motion, b, node_b)), node_b < last
        rate_v = dot(v, _across(first, second, along, n, v)) - dot(
            n, _centreline_curvature(motion, b, node_b)
        )
    if first == 0.0:
        return 0.0
    turned_t, turned_v = _across(first, second, along, n, t), _across(first, second, along, n, v)
    rate_t, mixed = dot(t, turned_t) + dot(n, _centreline_curvature(motion, i, node)), dot(t, turned_v)
    for a in range(3):
        row = _across(first, second, along, n, _axis(a))
        x, y = dot(turned_t, _axis(a)), dot(turned_v, _axis(a))
        det = rate_t * rate_v - mixed * mixed
        if inside and inside_other and det > _FLAT * first * first:
            row = axpy(
                -(rate_v * x - mixed * y) / det,
                turned_t,
                axpy(-(rate_t * y - mixed * x) / det, turned_v, row),
            )
        elif inside and rate_t > _FLAT:
            row = axpy(-x / rate_t, turned_t, row)
        elif inside_other and rate_v > _FLAT:
            row = axpy(-y / rate_v, turned_v, row)
        for b in range(3):
            turned[a, b] = force * dot(row, _axis(b))
    return float(force * first)


@kernel
def keep_damping(m: int, world: ContactWorld, problem: ContactProblem) -> None:
    """Damp by a fraction of what was stiff some iterations ago where no contact is curved any more: a
    contact that goes to and fro between an edge and a face would not come to rest, as the face by itself
    is not damped. No contact that presses is damped less than by the bending stiffness of its rod, EI/l^3."""
    most, kept, least, stiffness = 0.0, 0.0, 0.0, problem.stiffness
    for c in range(m):
        most = max(most, stiffness[c])
    for r in range(world.first, world.last):
        i = world.robot[r]
        least = max(least, world.rods.moment_scale[i] / world.rods.length[i] ** 2)
        for q in range(world.contacts.used[i]):
            kept = max(kept, _FORGETS * world.contacts.contact[i, q].damped_stiffness)
    for c in range(m if most == 0.0 else 0):
        stiffness[c] = _FRACTION_KEPT * kept
    for r in range(world.first, world.last):
        i = world.robot[r]
        for q in range(world.contacts.used[i]):
            world.contacts.contact[i, q].damped_stiffness = max(most, kept)
    for c in range(m):
        if problem.force[3 * c] > 0.0:
            stiffness[c] = max(stiffness[c], least)


@kernel
def stiffen_model(n: int, m: int, damping: float, problem: ContactProblem) -> None:
    """The model of n contact points when the forces of m contacts turn with their surfaces: m = model(F + B
    m), solved for m; as it was where that has no answer."""
    size = 3 * n
    model, system = problem.model, problem.system
    for a in range(size):
        for c in range(size):
            system[a, c] = 1.0 if a == c else 0.0
            system[a, size + 1 + c] = model[a, 1 + c]
        system[a, size] = model[a, 0]
    for c in range(m):
        for end in range(2):
            g = problem.point[c, end]
            if g < 0:
                continue
            for other in range(2):
                h = problem.point[c, other]
                if h < 0:
                    continue
                sign = 1.0 if end == other else -1.0
                for a in range(size):
                    for b in range(3):
                        value = 0.0
                        for e in range(3):
                            held = damping * problem.stiffness[c] if e == b else 0.0
                            value += model[a, 1 + 3 * g + e] * sign * (problem.turned[c, e, b] - held)
                        system[a, 3 * h + b] -= value
    if not solve_dense(system, size, 2 * size + 1):
        return
    for a in range(size):
        for c in range(size + 1):
            model[a, c] = system[a, size + c]


@kernel
def add_turned_forces(n: int, m: int, damping: float, problem: ContactProblem) -> None:
    """Add to the change of forces what the motion under it turns; what is open carries nothing. Overwrites
    `problem.place`."""
    for c in range(m):
        g, h = problem.point[c, 0], problem.point[c, 1]
        v = moved(n, problem.model, g, problem.change)
        if h >= 0:
            v = sub(v, moved(n, problem.model, h, problem.change))
        for a in range(3):
            row = problem.turned[c, a]
            along = row[0] * v[0] + row[1] * v[1] + row[2] * v[2]
            change = along - damping * problem.stiffness[c] * v[a]
            problem.place[c, a] = change if problem.force[3 * c] > 0.0 else 0.0
    for c in range(m):
        for side in range(2):
            g = problem.point[c, side]
            for a in range(3 if g >= 0 else 0):
                problem.change[3 * g + a] += (1.0 if side == 0 else -1.0) * problem.place[c, a]
