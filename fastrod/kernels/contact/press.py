"""Contact of the rods of modes of one world, as a convex potential in their Newton's method.

Of every candidate the motion of its point is linear in the unknowns, u = (gap, slip since the step's start)
+ J dq. Its potential is R/2 |lambda|^2 with
  lambda = P_K(y),   y_n = -(u_n + mu s) / R,   y_t = t - u_t / R,
K the cone |lambda_t| <= mu lambda_n, P_K the nearest point in it, t the force along the surface with which
the last step ended (so that what sticks does not creep), s how far the point slips (the shift of De Saxce
and Feng 1998, by which a point that slips does not lift). Its derivatives by u are -lambda and D / R,
D = P_K'. With the rod's own g and H the step minimises dq.H.dq / 2 + g.dq + sum of potentials: a semi-smooth
Newton method whose steps end where the slope along them does (Castro and others 2022). To H belongs what the
forces turn with a curved surface, - lambda_n times the second derivative of the gap, where H with it is
still positive. Rods are coupled by their contacts alone (`pressed_world`).
"""

from __future__ import annotations

import math

from fastrod.types import ContactSet, Floats, Records

from ..jit import inline, kernel
from ..vec import Vec, dot, scale, sub
from .bvh import normal_of
from .pressed_world import PressedWorld, add_scaled, add_slides

_FEW, _ROUNDS, _HALVINGS = 6, 40, 40
_SOFTEST, _HARDENS = 1e6, 0.1  # of R, in so many times less each
_ROUGHLY = 1e-4  # of the unknowns, where contacts are softer than they are
_SMALL = 1e-13  # of the unknowns: a step below it is the last one
_SHALLOW = 0.1  # of the slope along a step at its start: where it is as small, the step is long enough
_PIVOT = 1e-12  # of a diagonal entry
_DAMPS, _STIFFENS, _MOST_DAMPED = 0.01, 4.0, 1e6
"""Part of its diagonal that is added to a Hessian with a negative pivot: first, times that, and at most."""
RENEWED = 5e-6  # m: friction times a slip that changes by less is kept for the next pass


@inline
def _moved(n: int, along: Floats, free: Floats, step: Floats) -> Vec:
    """u after a step."""
    u, v, w = free[0], free[1], free[2]
    for a in range(n):
        u += along[0, a] * step[a]
        v += along[1, a] * step[a]
        w += along[2, a] * step[a]
    return u, v, w


@inline
def _requested(law: Floats, u: Vec) -> Vec:
    """y"""
    return -(u[0] + law[0] * law[4]) / law[1], law[2] - u[1] / law[1], law[3] - u[2] / law[1]


@inline
def in_cone(mu: float, y: Vec) -> tuple[Vec, float]:
    """The nearest point of the cone, and how large y is along the surface."""
    size = math.sqrt(y[1] * y[1] + y[2] * y[2])
    if size <= mu * y[0]:
        return y, size
    normal = (y[0] + mu * size) / (1.0 + mu * mu)
    if normal <= 0.0:
        return (0.0, 0.0, 0.0), size
    scaled = mu * normal / size if size > 0.0 else 0.0
    return (normal, scaled * y[1], scaled * y[2]), size


@inline
def _slope(mu: float, y: Vec, r: int, c: int) -> float:
    """Entry (r, c) of D."""
    force, size = in_cone(mu, y)
    if size <= mu * y[0]:
        return 1.0 if r == c and (r == 0 or mu > 0.0) else 0.0
    if force[0] <= 0.0:
        return 0.0
    e = (0.0, y[1] / size, y[2] / size) if size > 0.0 else (0.0, 0.0, 0.0)
    one = 1.0 if r == 0 else mu * e[r]
    other = 1.0 if c == 0 else mu * e[c]
    value = one * other / (1.0 + mu * mu)
    if r > 0 and c > 0 and size > 0.0:
        value += mu * force[0] / size * ((1.0 if r == c else 0.0) - e[r] * e[c])
    return value


@kernel
def _slope_along(m: int, n: int, pressing: PressedWorld, at: Floats, step: Floats, stiff: Floats) -> float:
    """Slope of the potential along a `step`, of which the Hessian makes `stiff`, where the unknowns have
    changed by `at`."""
    total = 0.0
    for a in range(n):
        total += pressing.gradient[a] * step[a] + stiff[a] * at[a]
    for k in range(m):
        along, law = pressing.along[k], pressing.law[k]
        force, _ = in_cone(law[0], _requested(law, _moved(n, along, pressing.free[k], at)))
        for r in range(3):
            if force[r] != 0.0:
                moved = 0.0
                for a in range(n):
                    moved += along[r, a] * step[a]
                total -= force[r] * moved
    return total


@inline
def _piece(mu: float, y: Vec) -> int:
    """Which piece of the law y is in: 0 no force, 1 where force is linear in y, 2 slip with friction."""
    force, size = in_cone(mu, y)
    if force[0] <= 0.0:
        return 0
    return 1 if mu == 0.0 or size <= mu * y[0] else 2


@kernel
def _is_linear(m: int, n: int, pressing: PressedWorld, before: Floats, after: Floats) -> bool:
    """Whether the forces are linear between two changes of the unknowns: then a Newton step is exact."""
    for k in range(m):
        along, law, free = pressing.along[k], pressing.law[k], pressing.free[k]
        one = _piece(law[0], _requested(law, _moved(n, along, free, before)))
        if one == 2 or one != _piece(law[0], _requested(law, _moved(n, along, free, after))):
            return False
    return True


@kernel
def _subtract_four(to: Floats, scaled: tuple[float, float, float, float], x: Floats) -> None:
    """to -= scaled . four rows, which stand one after the other in x."""
    n, width = len(to), len(x) // 4
    one, two, three, four = x[:n], x[width : width + n], x[2 * width : 2 * width + n], x[3 * width :]
    for c in range(n):
        to[c] -= scaled[0] * one[c] + scaled[1] * two[c] + scaled[2] * three[c] + scaled[3] * four[c]


@kernel
def _factor(n: int, u: Floats) -> bool:
    """U of M = U^T U in place of the upper triangle, row by row, so that loops run along rows, with one over
    its diagonal. Whether all pivots were positive; the diagonal stands for one that is not."""
    good, rows, width = True, u.reshape(-1), u.shape[1]
    for j in range(n):
        to, whole, many = rows[j * width + j : j * width + n], abs(u[j, j]), j - j % 4
        for k in range(0, many, 4):
            scaled = u[k, j], u[k + 1, j], u[k + 2, j], u[k + 3, j]
            _subtract_four(to, scaled, rows[k * width + j : k * width + j + 4 * width])
        for k in range(many, j):
            add_scaled(-u[k, j], rows[k * width + j : k * width + n], to)
        pivot = to[0]
        if not pivot > _PIVOT * whole:
            pivot, good = whole + 1e-300, False
        to[0] = 1.0
        inverse = 1.0 / math.sqrt(pivot)
        for c in range(len(to)):
            to[c] *= inverse
    return good


@kernel
def _newton_step(m: int, n: int, pressing: PressedWorld, to: Floats) -> bool:
    """A Newton step from `pressing.step`, into `to`, and whether all pivots were positive."""
    u, step = pressing.matrix, pressing.step
    for a in range(n):
        to[a] = -pressing.gradient[a]
    for c in range(n):
        for a in range(n):
            u[c, a] = pressing.hessian[c, a]
        add_scaled(-step[c], u[c, :n], to[:n])
    for k in range(m):
        along, law = pressing.along[k], pressing.law[k]
        y = _requested(law, _moved(n, along, pressing.free[k], step))
        force, _ = in_cone(law[0], y)
        for r in range(3):
            if force[r] != 0.0:
                add_scaled(force[r], along[r, :n], to[:n])
            for s in range(3):
                d = _slope(law[0], y, r, s) / law[1]
                if d != 0.0:
                    for a in range(n):
                        if along[r, a] != 0.0:
                            add_scaled(d * along[r, a], along[s, a:n], u[a, a:n])
    good = _factor(n, u)
    for k in range(n):
        to[k] *= u[k, k]
        add_scaled(-to[k], u[k, k + 1 : n], to[k + 1 : n])
    for k in range(n - 1, -1, -1):
        left = to[k]
        for a in range(k + 1, n):
            left -= u[k, a] * to[a]
        to[k] = left * u[k, k]
    return good


@kernel
def _rotate_forces(m: int, n: int, contacts: ContactSet, pressing: PressedWorld, sign: float) -> bool:
    """Take from the Hessian what the forces turn with their surfaces (`sign` 1), or give it back; whether
    there is any."""
    some = False
    for k in range(m):
        axes, c, along = pressing.axes[k], pressing.curved[k], pressing.centre[k]
        force = contacts.contact[pressing.side[k, 0], pressing.side[k, 1]].force
        pressed = force[0] * axes[0, 0] + force[1] * axes[0, 1] + force[2] * axes[0, 2]
        if not pressed > 0.0 or c[1, 1] + c[2, 2] == 0.0:
            continue
        some = True
        for a in range(n):
            for r in range(1, 3):
                turned = sign * pressed * (c[r, 1] * along[1, a] + c[r, 2] * along[2, a])
                if turned != 0.0:
                    add_scaled(-turned, along[r, :n], pressing.hessian[a, :n])
    return some


@kernel
def _scale_softness(m: int, pressing: PressedWorld, by: float) -> None:
    for k in range(m):
        pressing.law[k, 1] *= by


@kernel
def _minimise(
    m: int,
    n: int,
    own: int,
    contacts: ContactSet,
    pressing: PressedWorld,
    turned: bool,
    rounds: int,
    small: float,
) -> tuple[bool, bool]:
    """Newton's method from the present step until one changes it by less than `small` of itself: whether it
    has ended, and whether the forces still turn with their surfaces."""
    step, to, trial, damping = pressing.step, pressing.room[0], pressing.room[1], _DAMPS
    stiff = pressing.room[2]
    for _ in range(rounds):
        while not _newton_step(m, n, pressing, to) and damping < _MOST_DAMPED:
            # not what the forces turn with their surfaces, or else more of the rods' diagonal: bodies begin
            # every pass anew, and what held them would stay
            for a in range(0 if turned else own):
                pressing.hessian[a, a] += damping * abs(pressing.hessian[a, a])
            if turned:
                _rotate_forces(m, n, contacts, pressing, -1.0)
            damping, turned = damping if turned else _STIFFENS * damping, False
        stiff[:n] = 0.0
        for c in range(n):
            add_scaled(to[c], pressing.hessian[c, :n], stiff[:n])
        low, high, fraction = 0.0, 1.0, 1.0
        first = abs(_slope_along(m, n, pressing, step, to, stiff))
        for _ in range(_HALVINGS):
            for a in range(n):
                trial[a] = step[a] + fraction * to[a]
            slope = _slope_along(m, n, pressing, trial, to, stiff)
            if abs(slope) <= _SHALLOW * first or (fraction == 1.0 and slope < 0.0):
                break
            low, high = (fraction, high) if slope < 0.0 else (low, fraction)
            fraction = 0.5 * (low + high)
        exact = fraction == 1.0 and _is_linear(m, n, pressing, step, trial)
        size, largest = 0.0, 0.0
        for a in range(n):
            step[a] += fraction * to[a]
            size, largest = max(size, abs(fraction * to[a])), max(largest, abs(step[a]))
        if exact or not size > small * max(1.0, largest):
            return True, turned
    return False, turned


@kernel
def press(
    m: int, n: int, own: int, contacts: ContactSet, pressing: PressedWorld, renew: float, still: bool
) -> bool:
    """Step and forces of a world with m contacts and n unknowns, the rods' `own` first; whether a slip that
    the step uses has changed, by more than `renew` [m] times its friction. `still`: contacts stay where they
    are. Where Newton's method takes long (many contacts slip, in directions that they have yet to find),
    contacts are soft first."""
    pressing.step[:n] = 0.0
    if not still:
        add_slides(m, n, contacts, pressing)
    turned = _rotate_forces(m, n, contacts, pressing, 1.0)
    ended, turned = _minimise(m, n, own, contacts, pressing, turned, _FEW, _SMALL)
    if not ended:
        pressing.step[:n] = 0.0
        softer = _SOFTEST
        while softer > 1.0:
            _scale_softness(m, pressing, softer)
            _, turned = _minimise(m, n, own, contacts, pressing, turned, _ROUNDS, _ROUGHLY)
            _scale_softness(m, pressing, 1.0 / softer)
            softer *= _HARDENS
        _minimise(m, n, own, contacts, pressing, turned, _ROUNDS, _SMALL)
    return _report_forces(m, n, contacts, pressing, renew)


@kernel
def _report_forces(m: int, n: int, contacts: ContactSet, pressing: PressedWorld, renew: float) -> bool:
    """Forces and slips after the step, to both sides of a contact; whether a slip has changed."""
    changed = False
    for k in range(m):
        axes, law, side = pressing.axes[k], pressing.law[k], pressing.side[k]
        contact = contacts.contact[side[0], side[1]]
        y = _requested(law, _moved(n, pressing.along[k], pressing.free[k], pressing.step))
        force, _ = in_cone(law[0], y)
        slid = law[1] * math.sqrt((y[1] - force[1]) ** 2 + (y[2] - force[2]) ** 2) if law[0] > 0.0 else 0.0
        least = renew if contact.slid >= 0.0 else min(renew, RENEWED)
        if law[0] * abs(slid - law[4]) > least:
            law[4], changed = slid, True
        contact.slid = law[4]
        for a in range(3):
            contact.force[a] = force[0] * axes[0, a] + force[1] * axes[1, a] + force[2] * axes[2, a]
        if side[2] >= 0:
            partner = contacts.contact[side[2], side[3]]
            partner.slid = contact.slid
            for a in range(3):
                partner.force[a] = -contact.force[a]
    return changed


@kernel
def end_contacts(n: int, contacts: Records, step_ends: bool) -> int:
    """Keep the contacts that press, and where the step ends the force along the surface with which each does;
    returns how many there are."""
    left = 0
    for c in range(n):
        contact = contacts[c]
        force = (contact.force[0], contact.force[1], contact.force[2])
        if not dot(force, force) > 0.0:
            continue
        along = sub(force, scale(dot(force, normal_of(contact)), normal_of(contact)))
        if step_ends:
            contact.held[0], contact.held[1], contact.held[2] = along
        if left != c:
            contacts[left] = contact
        left += 1
    return left
