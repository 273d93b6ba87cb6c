"""Newton's method on the energy, LANES robots side by side, each with a step and a damping of its own.

A robot whose energy would rise, or whose Hessian has a negative pivot, is damped by sigma D with D the
elasticity: an implicit step of the gradient flow in the metric of the elasticity, which is pseudo-transient
continuation (Kelley and Keyes 1998) and ends at a stable equilibrium.
"""

from __future__ import annotations

from fastrod.types import Floats, Ints

from ...jit import inline, kernel
from ...vec import Vec, dot
from ..lanes import W, at, clear, get, get_mat, put_mat, read, write, write_at
from . import fields as fd
from .assembly import assemble
from .cholesky import backward, factor, forward
from .energy import energy_of_shape
from .fields import ModalWork, hessian
from .follower import correct_step, follow
from .host import ModalHost, base_step, hosted, move_base, place_base, put_base
from .modes import ModalBasis
from .motion import ModalMotion
from .sweep import sweep_piece
from .tendons import tendon_paths, tensions

SMALLEST_SIGMA, FIRST_SIGMA, LARGEST_SIGMA = 1e-4, 0.1, 1e8
NEUTRAL, LEAST_NEUTRAL = 1e-3, 5e-4
"""So little damping is none: where the Hessian is positive with it hardly anything holds the rod in some
direction, as about the vertical one that hangs over to a side. It falls by a tenth in each step: when it is
the least, what holds the rod has brought it to rest."""
LONGEST_STEP = 1.0
"""Change of a piece's bend, of one mode [rad], or of strain by a fifth of it."""
ROUNDING = 1e-12
"""Rounding error of the energies: below it a rise is none."""
NEARLY, STATIONARY, UNHELD = 1e-4, 1e-6, 1e-5
"""Largest moment, in what bends the robot by a radian: on one that may have a neutral direction; on one that
stands still; and on one at rest but for that direction."""
IMPERFECTION = 0.5
"""By how much a robot is bent, and twisted, that stands on a saddle [rad]."""
TINY = 1e-3
"""Smallest fraction of the tolerance: after so small a step it does not matter which tendons it slackened."""


@kernel
def sweep(b: ModalBasis, first_tendon: Ints, command: Floats, work: ModalWork, with_columns: bool) -> None:
    """Shape, paths and tensions of q. `command` (4, n_tendons * LANES): `tensions`."""
    if hosted(work):
        place_base(work)
    for p in range(work.piece.shape[0]):
        sweep_piece(p, b, work, with_columns)
    tendon_paths(b, first_tendon, work, with_columns)
    tensions(command[0], command[1], command[2], command[3], work)


@kernel
def add_damping(b: ModalBasis, work: ModalWork) -> None:
    """Add sigma D to the Hessian; and the largest of what bends the modes, in what bends them by a radian."""
    n_modes = b.component.shape[0]
    clear(work.newton[fd.L_FORCE * W : (fd.L_FORCE + 1) * W])
    for p in range(work.piece.shape[0]):
        for a in range(n_modes):
            row, gram = p * n_modes + a, 1.0 / (2.0 * b.degree[a] + 1.0)
            for w in range(W):
                k = gram * read(work.piece[p], fd.P_L, w) * read(work.piece[p], fd.P_K + b.component[a], w)
                force = abs(read(work.gradient, row, w)) * read(work.piece[p], fd.P_L, w) / k
                write(work.newton, fd.L_FORCE, w, max(force, read(work.newton, fd.L_FORCE, w)))
                k *= read(work.newton, fd.L_SIGMA, w)
                write_at(hessian(work), row, row, w, at(hessian(work), row, row, w) + k)


@inline
def undamped(sigma: float) -> bool:
    """Whether this damping is none."""
    return sigma == 0.0 or LEAST_NEUTRAL <= sigma <= NEUTRAL


@inline
def drifts(work: ModalWork, w: int) -> bool:
    """Whether the Newton step is one along what nothing holds."""
    free = read(work.newton, fd.L_FORCE, w) < UNHELD and read(work.host, fd.G_ON, w) == 0.0
    return free and read(work.newton, fd.L_SIGMA, w) == LEAST_NEUTRAL


@inline
def rests(work: ModalWork, w: int, tolerance: float) -> bool:
    """Whether the step was undamped, and smaller than `tolerance` [rad] or along what nothing holds."""
    small = read(work.newton, fd.L_SIZE, w) * max(1.0, read(work.host, fd.G_LIGHT, w)) < tolerance
    return undamped(read(work.newton, fd.L_SIGMA, w)) and (small or drifts(work, w))


@kernel
def measure_step(b: ModalBasis, work: ModalWork, tolerance: float) -> bool:
    """Size [rad] of the Newton step in `work.gradient`, and the fraction of it that is taken: no longer than
    LONGEST_STEP, none where the Hessian had a negative pivot or the robot is done. Whether every robot
    `rests` after it: its energy need not be looked at."""
    n_modes, newton, every = b.component.shape[0], work.newton, True
    clear(newton[fd.L_SIZE * W : (fd.L_SIZE + 1) * W])
    for p in range(work.piece.shape[0]):
        for a in range(n_modes):
            row, strain = p * n_modes + a, b.component[a] >= 3
            for w in range(W):
                unit = 5.0 if strain else read(work.piece[p], fd.P_L, w)
                size, largest = unit * abs(read(work.gradient, row, w)), read(newton, fd.L_SIZE, w)
                write(newton, fd.L_SIZE, w, largest if size <= largest else size)  # NaN wins
    for k in range(6 if hosted(work) else 0):
        for w in range(W):
            unit = 1.0 / read(work.piece[0], fd.P_L, w) if k < 3 else 1.0
            size, largest = unit * abs(read(work.host, fd.G_STEP + k, w)), read(newton, fd.L_SIZE, w)
            write(newton, fd.L_SIZE, w, largest if size <= largest else size)
    for w in range(W):
        size, done = read(newton, fd.L_SIZE, w), read(newton, fd.L_DONE, w) > 0.0
        if not done:
            write(newton, fd.L_CORRECTION, w, read(newton, fd.L_FORCE, w) if drifts(work, w) else size)
            write(newton, fd.L_COUNT, w, read(newton, fd.L_COUNT, w) + 1.0)
        if not size < 1e300:  # also where it is no number
            write(newton, fd.L_REPLACED, w, 1.0)
        replaced = read(newton, fd.L_REPLACED, w) > 0.0
        write(newton, fd.L_STEP, w, 0.0 if done or replaced else min(1.0, LONGEST_STEP / max(size, 1e-300)))
        every = every and (done or (not replaced and rests(work, w, tolerance)))
    return every


@kernel
def take_step(work: ModalWork) -> None:
    """q -= the fraction of the step."""
    for a in range(len(work.q) // W):
        for w in range(W):
            fraction = read(work.newton, fd.L_STEP, w)
            step = fraction * read(work.gradient, a, w) if fraction > 0.0 else 0.0
            write(work.gradient, a, w, step)
            write(work.q, a, w, read(work.q, a, w) - step)
    if hosted(work):
        move_base(work, work.newton[fd.L_STEP * W : (fd.L_STEP + 1) * W])


@inline
def slack_tendons(work: ModalWork, w: int) -> float:
    """Which tendons hold nothing by their length, as binary digits."""
    digits = 0.0
    for t in range(len(work.stiffness) // W):
        digits = 2.0 * digits + (1.0 if read(work.stiffness, t, w) == 0.0 else 0.0)
    return digits


@kernel
def note_slack(work: ModalWork) -> None:
    """Remember which tendons are slack before a step."""
    for w in range(W):
        write(work.newton, fd.L_SLACK, w, slack_tendons(work, w))


@kernel
def went_slack(work: ModalWork, tolerance: float) -> bool:
    """Whether a tendon of any robot went slack or taut by the step: its Hessian was that of the other branch,
    and the error is no longer the square of the step. Looked at again, unless the step was tiny."""
    newton, some = work.newton, False
    for w in range(W):
        switched = slack_tendons(work, w) != read(newton, fd.L_SLACK, w)
        again = (
            switched and read(newton, fd.L_DONE, w) == 0.0 and read(newton, fd.L_SIZE, w) > TINY * tolerance
        )
        write(newton, fd.L_AGAIN, w, 1.0 if again else 0.0)
        some = some or again
    return some


@kernel
def disturb(b: ModalBasis, work: ModalWork, w: int) -> None:
    """Bend a robot that rests on a saddle of the energy, as a straight rod under more than it bears: it falls
    to a side, which symmetry would keep it from."""
    n_pieces, n_modes = work.piece.shape[0], b.component.shape[0]
    for p in range(n_pieces):
        for a in range(n_modes):
            if b.component[a] < 3 and b.degree[a] == 0:
                bend = IMPERFECTION / (n_pieces * read(work.piece[p], fd.P_L, w) * (1.0 + b.component[a]))
                write(work.q, p * n_modes + a, w, read(work.q, p * n_modes + a, w) + bend)
    write(work.newton, fd.L_BEFORE, w, 1e300)


@inline
def rotation_between(after: tuple[float, ...], before: tuple[float, ...]) -> Vec:
    """Rotation vector from one rotation to another that is near, world."""
    a, b = after, before
    x = a[6] * b[3] + a[7] * b[4] + a[8] * b[5] - a[3] * b[6] - a[4] * b[7] - a[5] * b[8]
    y = a[0] * b[6] + a[1] * b[7] + a[2] * b[8] - a[6] * b[0] - a[7] * b[1] - a[8] * b[2]
    z = a[3] * b[0] + a[4] * b[1] + a[5] * b[2] - a[0] * b[3] - a[1] * b[4] - a[2] * b[5]
    return 0.5 * x, 0.5 * y, 0.5 * z


@kernel
def accept_step(b: ModalBasis, work: ModalWork, tip: int, tolerance: float, enough: bool) -> int:
    """Keep or undo the step of every robot, and change its damping; how many are not done. A moment on the
    tip has no energy: its work along the step counts in its place.

    A robot is done where an undamped step changed no bend by more than `tolerance` [rad] and there were
    `enough`; the energy of such a step is not asked for, as it is not where the robots at its side take none
    that is larger."""
    newton, left = work.newton, 0
    for w in range(W):
        energy, before = read(newton, fd.L_ENERGY, w), read(newton, fd.L_BEFORE, w)
        turned = rotation_between(get_mat(work.node[-1, tip], fd.N_R, w), get_mat(newton, fd.L_ROTATION, w))
        energy -= dot(get(work.outside, 3, w), turned)
        sigma, size = read(newton, fd.L_SIGMA, w), read(newton, fd.L_SIZE, w)
        follower = get(work.outside, 12, w)
        # the energy of a force that follows the rod is not the same after the step
        small = size * read(newton, fd.L_STEP, w) < 1e-6 or (undamped(sigma) and size < tolerance)
        followed = dot(follower, follower) > 0.0 or read(work.piece[0], fd.P_FOLLOWED, w) > 0.0
        small = small or (size < LONGEST_STEP and (followed or read(work.host, fd.G_ON, w) > 0.0))
        lower = energy <= before + ROUNDING * (abs(before) + abs(energy)) or small
        if read(newton, fd.L_DONE, w) > 0.0:
            continue
        replaced = read(newton, fd.L_REPLACED, w) > 0.0
        if replaced or not lower:
            force, more = read(newton, fd.L_FORCE, w), min(max(8.0 * sigma, FIRST_SIGMA), LARGEST_SIGMA)
            write(newton, fd.L_SIGMA, w, NEUTRAL if sigma < LEAST_NEUTRAL and force < NEARLY else more)
            for a in range(len(work.q) // W):
                write(work.q, a, w, read(work.q, a, w) + read(work.gradient, a, w))
            for k in range(6 if hosted(work) else 0):
                write(
                    work.host,
                    fd.G_D + k,
                    w,
                    read(work.host, fd.G_D + k, w) + read(work.host, fd.G_STEP + k, w),
                )
            if replaced and sigma >= LEAST_NEUTRAL and force < STATIONARY:
                disturb(b, work, w)
            left += 1
            continue
        close = rests(work, w, tolerance)
        write(newton, fd.L_BEFORE, w, read(newton, fd.L_ENERGY, w))
        put_mat(newton, fd.L_ROTATION, w, get_mat(work.node[-1, tip], fd.N_R, w))
        less = 0.125 * sigma if sigma > SMALLEST_SIGMA else 0.0
        neutral = undamped(sigma) and sigma > 0.0
        write(newton, fd.L_SIGMA, w, max(0.9 * sigma, LEAST_NEUTRAL) if neutral else less)
        if enough and close and read(newton, fd.L_AGAIN, w) == 0.0:
            write(newton, fd.L_DONE, w, 1.0)
        else:
            left += 1
    return left


@kernel
def minimise(
    b: ModalBasis,
    first_tendon: Ints,
    command: Floats,
    work: ModalWork,
    tolerance: float,
    least: int,
    most: int,
    robots: Ints,
    host: ModalHost,
    motion: ModalMotion,
) -> None:
    """Iterate until every robot's last step was smaller than `tolerance` [rad], at least `least` and at most
    `most` times. Ends with the shape at q; what a robot did does not depend on its neighbours."""
    newton, tip, known = work.newton, b.width.shape[0], False
    for w in range(W):
        write(newton, fd.L_SIGMA, w, 0.0)
        write(newton, fd.L_DONE, w, 0.0)
        write(newton, fd.L_COUNT, w, 0.0)
    for i in range(most):
        sweep(b, first_tendon, command, work, True)
        note_slack(work)
        on_tip = follow(work)
        follows = on_tip or work.piece[0, fd.P_FOLLOWED * W] > 0.0
        assemble(b, first_tendon, work)
        add_damping(b, work)
        factor(hessian(work), newton[fd.L_REPLACED * W : (fd.L_REPLACED + 2) * W])
        forward(hessian(work), work.gradient)
        if hosted(work):
            base_step(robots, host, b, motion, work)
        backward(hessian(work), work.gradient)
        if on_tip:
            correct_step(work)
        small = measure_step(b, work, tolerance)
        if not small and (follows or not known or hosted(work)):
            energy_of_shape(b, command, work, newton[fd.L_BEFORE * W : (fd.L_BEFORE + 1) * W])
            for w in range(W):
                put_mat(newton, fd.L_ROTATION, w, get_mat(work.node[-1, tip], fd.N_R, w))
        take_step(work)
        sweep(b, first_tendon, command, work, False)
        known, enough = not small, i + 1 >= least
        again = went_slack(work, tolerance)
        if small and enough and not again:
            for w in range(W):
                write(newton, fd.L_DONE, w, 1.0)
            return
        if not small:
            energy_of_shape(b, command, work, newton[fd.L_ENERGY * W : (fd.L_ENERGY + 1) * W])
            if accept_step(b, work, tip, tolerance, enough) == 0:
                return
        elif enough:
            for w in range(W):
                write(newton, fd.L_DONE, w, 1.0 - read(newton, fd.L_AGAIN, w))
    sweep(b, first_tendon, command, work, False)  # a last step may have been undone


@kernel
def hold(
    robots: Ints,
    given: Floats,
    b: ModalBasis,
    first_tendon: Ints,
    command: Floats,
    work: ModalWork,
    with_forces: bool,
) -> None:
    """The shape at the unknowns `given` (n_robots, n_q, six more of bases that give way), and `with_forces`
    what its modes work against there."""
    for w in range(W):
        for a in range(len(work.q) // W):
            write(work.q, a, w, given[robots[w], a])
        write(work.newton, fd.L_DONE, w, 1.0)
        write(work.newton, fd.L_COUNT, w, 1.0)
        write(work.newton, fd.L_CORRECTION, w, 0.0)
    if hosted(work):
        put_base(robots, given, work)
    sweep(b, first_tendon, command, work, with_forces)
    if with_forces:
        follow(work)
        assemble(b, first_tendon, work)
