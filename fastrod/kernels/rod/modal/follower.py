"""Forces that follow the rod, on the tip and along it: no energy has them as its gradient.

In every iteration of Newton's method they act as the forces in the world that they are at the shape before;
their rotation is a term of the Hessian that is not symmetric, J^T [F]x Theta with displacement J and rotation
Theta by the unknowns. That of the tip has rank 3: the symmetric rest is solved, and the step corrected
(Woodbury: Golub and Van Loan 2013, 2.1.4). That of a line force is left out, so its steps are shorter by a
factor each, the load over that at which the rod would flutter, and not squared.
"""

from __future__ import annotations

from ...jit import inline, kernel
from ...vec import Vec, add, cross, dot, mul, scale, sub
from ..lanes import W, get, get_mat, put, read, write
from .cholesky import solve
from .fields import H_DEAD, H_FOLLOW, H_LINE, N_POS, N_R, P_FOLLOWED, ModalWork, hessian


@kernel
def follow(work: ModalWork) -> bool:
    """The forces that follow the rod at the present shape; whether one of them is on a tip."""
    tip, some = work.node[-1, work.node.shape[1] - 1], False
    for w in range(W):
        force = get(work.outside, 12, w)
        some = some or dot(force, force) > 0.0
        put(work.outside, 0, w, add(get(work.outside, 9, w), mul(get_mat(tip, N_R, w), force)))
    if work.piece[0, P_FOLLOWED * W] > 0.0:
        follow_line(work)
    return some


@kernel
def follow_line(work: ModalWork) -> None:
    """The line force at every node, in the world."""
    for p in range(work.node.shape[0]):
        for j in range(work.node.shape[1]):
            node, history = work.node[p, j], work.history[p, j]
            for w in range(W):
                turned = mul(get_mat(node, N_R, w), get(history, H_FOLLOW, w))
                put(history, H_LINE, w, add(get(history, H_DEAD, w), turned))


@inline
def tip_motion(p: int, c: int, w: int, work: ModalWork) -> tuple[Vec, Vec]:
    """Displacement and rotation of the tip by mode c of piece p."""
    n = work.node.shape[1] - 1
    th = get(work.end[p, c], 3, w)
    arm = sub(get(work.node[-1, n], N_POS, w), get(work.node[p, n], N_POS, w))
    return add(get(work.end[p, c], 0, w), cross(th, arm)), th


@inline
def solved(a: Vec, b: Vec, c: Vec, y: Vec) -> Vec:
    """x of a 3x3 matrix with columns a, b, c; 0 where it is singular."""
    size = dot(a, cross(b, c))
    inverse = 1.0 / size if abs(size) > 1e-12 else 0.0
    return inverse * dot(y, cross(b, c)), inverse * dot(a, cross(y, c)), inverse * dot(a, cross(b, y))


@kernel
def correct_step(work: ModalWork) -> None:
    """The Newton step in `work.gradient` with the rotation of the force on the tip, `hessian` factored and
    the shape that it was made for still in the buffers."""
    n_q, n_modes = len(work.q) // W, work.end.shape[1]
    for e in range(3):
        for a in range(n_q):
            for w in range(W):
                moved, _ = tip_motion(a // n_modes, a % n_modes, w, work)
                write(work.follow, e * n_q + a, w, moved[e])
        solve(hessian(work), work.follow[e * n_q * W : (e + 1) * n_q * W])
    for w in range(W):
        force = mul(get_mat(work.node[-1, work.node.shape[1] - 1], N_R, w), get(work.outside, 12, w))
        turned = (0.0, 0.0, 0.0)
        x, y, z = turned, turned, turned
        for a in range(n_q):
            _, th = tip_motion(a // n_modes, a % n_modes, w, work)
            turned = add(turned, scale(read(work.gradient, a, w), th))
            x = add(x, scale(read(work.follow, a, w), th))
            y = add(y, scale(read(work.follow, n_q + a, w), th))
            z = add(z, scale(read(work.follow, 2 * n_q + a, w), th))
        x, y, z = cross(force, x), cross(force, y), cross(force, z)
        x, y, z = (1.0 + x[0], x[1], x[2]), (y[0], 1.0 + y[1], y[2]), (z[0], z[1], 1.0 + z[2])
        s = solved(x, y, z, cross(force, turned))
        for a in range(n_q):
            less = s[0] * read(work.follow, a, w) + s[1] * read(work.follow, n_q + a, w)
            less += s[2] * read(work.follow, 2 * n_q + a, w)
            write(work.gradient, a, w, read(work.gradient, a, w) - less)
