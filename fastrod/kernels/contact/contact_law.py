"""Contact forces of one world from the compliance of its contact points: Signorini's law with Coulomb
friction.

The motion of contact c in its own frame (normal, two tangents) is u = b + W lambda; W is the Delassus matrix,
the compliance between contacts (symmetric), b the motion without contact forces: the gap along the normal,
the slip since the last step along the tangents. Normal: 0 <= lambda_n, 0 <= u_n + compliance lambda_n, their
product 0. Friction: |lambda_t| <= mu lambda_n; where it slips, lambda_t = -mu lambda_n u_t / |u_t|.

First an active set: each contact is open, sticks or slips; the equations of these states are solved together,
the states corrected until they agree (a semi-smooth Newton method; Alart and Curnier 1991). Where they do not
come to rest, contact by contact (nonlinear Gauss-Seidel; Jean 1999), which converges for every symmetric W
that is positive.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fastrod.types import Floats, Ints

from ..jit import kernel
from .bvh import FAR

_ROUNDS = 40
"""Rounds of the active set: those that agree do so in a dozen, the others go to and fro."""
_SWEEPS = 400
_CHECK = 50
"""Rounds of Gauss-Seidel, and how often their rate of convergence is looked at."""
_AGREE = 1e-10
"""Motion to which states and sweeps agree [m]: a ten-thousandth of the tolerance at which a step rests."""
_HOLDS = 1e-9
"""Motion to which an answer must obey the law [m]: `_AGREE` and the rounding of a nearly singular system."""
OPEN, STICK, SLIP = 0, 1, 2


class ContactLaw(NamedTuple):
    """The law's numbers and its workspace, for m contacts or more."""

    W: Floats
    """(3 m, 3 m) [m/N]."""
    b: Floats
    """(3 m,) [m]."""
    friction: Floats
    """(m,) Coulomb coefficients."""
    compliance: Floats
    """(m,) [m/N]."""
    force: Floats
    """(3 m,) normal and two tangents of each contact: a start, and the answer [N]."""
    state: Ints
    """(m,) open, sticking or slipping."""
    along: Floats
    """(m, 2) direction of the friction where it slips."""
    start: Floats
    """(3 m,) the force at the start [N]."""
    system: Floats
    """(3 m, 3 m + 1) linear equations, the last column their right-hand side."""


@kernel
def solve_dense(a: Floats, n: int, width: int) -> bool:
    """Gauss elimination with partial pivoting of n equations, the rows of `a`, whose columns n to `width` are
    right-hand sides; the solutions replace those. False where the matrix is singular."""
    for c in range(n):
        pivot = c
        for r in range(c + 1, n):
            if abs(a[r, c]) > abs(a[pivot, c]):
                pivot = r
        if not abs(a[pivot, c]) > 0.0:
            return False
        if pivot != c:
            for i in range(c, width):
                a[c, i], a[pivot, i] = a[pivot, i], a[c, i]
        inverse = 1.0 / a[c, c]
        for r in range(c + 1, n):
            factor = a[r, c] * inverse
            if factor != 0.0:
                for i in range(c + 1, width):
                    a[r, i] -= factor * a[c, i]
    for c in range(n - 1, -1, -1):
        inverse = 1.0 / a[c, c]
        for i in range(n, width):
            value = a[c, i]
            for q in range(c + 1, n):
                value -= a[c, q] * a[q, i]
            a[c, i] = value * inverse
    return True


@kernel
def _motion(W: Floats, b: Floats, force: Floats, row: int, n: int) -> float:
    u = b[row]
    for i in range(n):
        u += W[row, i] * force[i]
    return float(u)


@kernel
def _sweep(m: int, law: ContactLaw) -> float:
    """One round of Gauss-Seidel over the contacts; the largest change of force times compliance."""
    W, b, friction, compliance, force = law.W, law.b, law.friction, law.compliance, law.force
    largest = 0.0
    for c in range(m):
        o = 3 * c
        stiff = W[o, o] + compliance[c]
        if not stiff > 0.0:
            continue
        un = _motion(W, b, force, o, 3 * m) + compliance[c] * force[o]
        new = max(0.0, force[o] - un / stiff)
        largest = max(largest, abs(new - force[o]) * stiff)
        force[o] = new
        if friction[c] <= 0.0:
            continue
        # the larger eigenvalue of the tangential block is below the sum
        step = 1.0 / max(W[o + 1, o + 1] + W[o + 2, o + 2], 1e-300)
        for _ in range(4):
            t1 = force[o + 1] - step * _motion(W, b, force, o + 1, 3 * m)
            t2 = force[o + 2] - step * _motion(W, b, force, o + 2, 3 * m)
            size, most = math.sqrt(t1 * t1 + t2 * t2), friction[c] * new
            keep = 1.0 if size <= most else most / size
            change = max(abs(keep * t1 - force[o + 1]), abs(keep * t2 - force[o + 2]))
            force[o + 1], force[o + 2] = keep * t1, keep * t2
            largest = max(largest, change / step)
            if change / step < _AGREE:
                break
    return largest


@kernel
def _write_system(m: int, law: ContactLaw) -> None:
    """Equations (normal, tangents) of every contact in its state, as rows of the linear system."""
    n, W, b, friction, compliance = 3 * m, law.W, law.b, law.friction, law.compliance
    for o in range(n):
        c, i = o // 3, o % 3
        row, kind = law.system[o], law.state[c]
        for q in range(n + 1):
            row[q] = 0.0
        if kind == OPEN or (i > 0 and friction[c] <= 0.0):
            row[o] = 1.0
        elif i == 0 or kind == STICK:
            for q in range(n):
                row[q] = W[o, q]
            row[o] += compliance[c] if i == 0 else 0.0
            row[o] *= 1.0 + 1e-12  # two contacts that say the same leave a singular system otherwise
            row[n] = -b[o]
        else:  # slip: lambda_t = mu lambda_n along
            row[o] = 1.0
            row[3 * c] = -friction[c] * law.along[c, i - 1]


@kernel
def _correct_states(m: int, law: ContactLaw) -> float:
    """States that these forces ask for; how far they are from agreement, as a motion [m]."""
    W, b, friction, compliance, force = law.W, law.b, law.friction, law.compliance, law.force
    state, along = law.state, law.along
    wrong = 0.0
    for c in range(m):
        o = 3 * c
        stiff = max(W[o, o] + compliance[c], 1e-300)
        un = _motion(W, b, force, o, 3 * m) + compliance[c] * force[o]
        if force[o] * stiff - un <= 0.0:
            if state[c] != OPEN:
                wrong = max(wrong, abs(force[o]) * stiff + max(-un, 0.0))
            state[c] = OPEN
            continue
        if state[c] == OPEN:
            wrong = max(wrong, max(-un, 0.0) + abs(force[o]) * stiff)
        if friction[c] <= 0.0:
            state[c] = STICK
            continue
        soft = max(W[o + 1, o + 1], W[o + 2, o + 2], 1e-300)
        t1 = force[o + 1] - _motion(W, b, force, o + 1, 3 * m) / soft
        t2 = force[o + 2] - _motion(W, b, force, o + 2, 3 * m) / soft
        size = math.sqrt(t1 * t1 + t2 * t2)
        if size <= friction[c] * force[o] * (1.0 + 1e-9) or size == 0.0:
            if state[c] != STICK:
                wrong = max(
                    wrong, soft * abs(size - friction[c] * force[o]) + _AGREE * 2.0 * (state[c] == OPEN)
                )
            state[c] = STICK
        else:
            rotation = abs(along[c, 0] - t1 / size) + abs(along[c, 1] - t2 / size)
            if state[c] != SLIP:
                wrong = max(wrong, soft * (size - friction[c] * force[o]))
            wrong = max(wrong, soft * friction[c] * force[o] * rotation)
            state[c], along[c, 0], along[c, 1] = SLIP, t1 / size, t2 / size
    return wrong


@kernel
def _obeys(m: int, law: ContactLaw) -> bool:
    """The forces obey the law to 1e-9 m: a singular system can have a solution that does not."""
    W, b, force = law.W, law.b, law.force
    for c in range(m):
        o = 3 * c
        un = _motion(W, b, force, o, 3 * m) + law.compliance[c] * force[o]
        closed = abs(un) <= _HOLDS or force[o] == 0.0
        if not (force[o] >= 0.0 and un >= -_HOLDS and closed):
            return False
        u1, u2 = _motion(W, b, force, o + 1, 3 * m), _motion(W, b, force, o + 2, 3 * m)
        most, size = law.friction[c] * force[o], math.sqrt(force[o + 1] ** 2 + force[o + 2] ** 2)
        slip = math.sqrt(u1 * u1 + u2 * u2)
        if not size <= most * (1.0 + 1e-6) + 1e-12:
            return False
        # what slips does so against a force at the edge of the cone
        if (
            most > 0.0
            and slip > 10.0 * _HOLDS
            and not -(u1 * force[o + 1] + u2 * force[o + 2]) >= 0.999 * slip * most
        ):
            return False
    return True


@kernel
def _first_states(m: int, law: ContactLaw) -> None:
    """States of the forces at the start."""
    force, friction = law.force, law.friction
    for c in range(m):
        kind = OPEN if force[3 * c] <= 0.0 else STICK
        size = math.sqrt(force[3 * c + 1] ** 2 + force[3 * c + 2] ** 2)
        slips = (
            friction[c] > 0.0
            and kind == STICK
            and size >= friction[c] * force[3 * c] * (1.0 - 1e-6)
            and size > 0.0
        )
        law.along[c, 0], law.along[c, 1] = (
            (force[3 * c + 1] / size, force[3 * c + 2] / size) if slips else (0.0, 0.0)
        )
        law.state[c] = SLIP if slips else kind


@kernel
def _active_set(m: int, law: ContactLaw) -> bool:
    """Forces by Newton's method on the states; whether the states agree."""
    n = 3 * m
    for count in range(_ROUNDS):
        wrong = _correct_states(m, law)
        if wrong <= _AGREE and count > 0:
            return True
        _write_system(m, law)
        if not solve_dense(law.system, n, n + 1):
            return False
        for i in range(n):
            law.force[i] = law.system[i, n]
    return False


@kernel
def contact_forces(m: int, law: ContactLaw) -> bool:
    """Replace the forces of m contacts by those that the law asks for; whether they obey it."""
    n = 3 * m
    for i in range(n):
        law.start[i] = law.force[i]
    _first_states(m, law)
    if _active_set(m, law) and _obeys(m, law):
        return True
    for i in range(n):
        law.force[i] = law.start[i] if law.start[i] == law.start[i] else 0.0
    left, last = 1.0, FAR
    for count in range(_SWEEPS):
        left = _sweep(m, law)
        if left < _AGREE:
            break
        if count % _CHECK == _CHECK - 1:  # at this rate the rounds that are left would not do
            if not left * (left / last) ** ((_SWEEPS - count) // _CHECK) < _AGREE:
                break
            last = left
    return left < _AGREE and _obeys(m, law)
