"""Second derivatives of one interval's rotation by its own two curvatures, times the moment that it carries.

With o the rotation vector of the interval, V the left Jacobian of exp and m the moment in the frame of its
start, the symmetric part of A^T d(V^T m) B for two changes A, B of o is A^T S B with
  S = b (o.m) I + sym(o (2 a' + b) m^T) + 2 b' (o.m) o o^T + 2 c' sym(o (m x o)^T),
a, b, c and their derivatives from `exp_series`; its antisymmetric part goes with the rotation that `W` has
there, which `column_moments` therefore takes at the middle of the interval. o itself has a second derivative
by u_1 and u_2: k (e_c x e_c') . V^T m.
"""

from __future__ import annotations

from ...jit import inline, kernel
from ...vec import Sym, Vec, axpy, cross, dot, mul_t, scale, sym_mul
from ..lanes import Lanes, W, add_two, at, get, get_mat, read, write, write_at
from .fields import I_DK, I_LOCAL, I_M, I_O, I_U, I_WORK, N_R, P_K, P_L, P_TAU, P_UNEVEN, ModalWork, hessian
from .modes import ModalBasis
from .sweep import MAGNUS, exp_series, rotation_vector_changes
from .tendons import entry


@inline
def second_derivative(o: Vec, m: Vec, series: Vec, slopes: Vec) -> Sym:
    """S."""
    om, mo = dot(o, m), cross(m, o)
    e = series[1] * om
    z = axpy(slopes[0] + 0.5 * series[1], m, axpy(slopes[1] * om, o, scale(slopes[2], mo)))
    return (
        e + 2.0 * o[0] * z[0],
        o[0] * z[1] + o[1] * z[0],
        o[0] * z[2] + o[2] * z[0],
        e + 2.0 * o[1] * z[1],
        o[1] * z[2] + o[2] * z[1],
        e + 2.0 * o[2] * z[2],
    )


@inline
def _square(here: Lanes, g: int, w: int, S: Sym, columns: tuple[Vec, Vec, Vec]) -> None:
    """Lower triangle of D^T S D at one Gauss point."""
    x, y, z = columns
    sx, sy, sz = sym_mul(S, x), sym_mul(S, y), sym_mul(S, z)
    f = 3 * g
    write(here, I_LOCAL + entry(f, f), w, dot(x, sx))
    write(here, I_LOCAL + entry(f + 1, f), w, dot(y, sx))
    write(here, I_LOCAL + entry(f + 1, f + 1), w, dot(y, sy))
    write(here, I_LOCAL + entry(f + 2, f), w, dot(z, sx))
    write(here, I_LOCAL + entry(f + 2, f + 1), w, dot(z, sy))
    write(here, I_LOCAL + entry(f + 2, f + 2), w, dot(z, sz))


@inline
def _cross_block(
    here: Lanes, w: int, S: Sym, first: tuple[Vec, Vec, Vec], second: tuple[Vec, Vec, Vec], t: Vec
) -> None:
    """Rows of u_2, columns of u_1; `t` is k V^T m."""
    for c in range(3):
        s = sym_mul(S, first[0] if c == 0 else (first[1] if c == 1 else first[2]))
        # (e_c x e_r) . t
        skew = (0.0, t[2], -t[1]) if c == 0 else ((-t[2], 0.0, t[0]) if c == 1 else (t[1], -t[0], 0.0))
        write(here, I_LOCAL + entry(3, c), w, dot(second[0], s) + skew[0])
        write(here, I_LOCAL + entry(4, c), w, dot(second[1], s) + skew[1])
        write(here, I_LOCAL + entry(5, c), w, dot(second[2], s) + skew[2])


@kernel
def local_of_piece(p: int, b: ModalBasis, work: ModalWork) -> None:
    """The intervals' own second derivatives, without their tendons: of the rotation, and of the stiffness
    beyond that of the piece."""
    for i in range(b.width.shape[0]):
        here, node, width = work.interval[p, i], work.node[p, i], b.width[i]
        for w in range(W):
            h = width * read(work.piece[p], P_L, w)
            half, k = 0.5 * h, MAGNUS * h * h
            o, u1, u2 = get(here, I_O, w), get(here, I_U, w), get(here, I_U + 3, w)
            series, slopes = exp_series(o)
            m = mul_t(get_mat(node, N_R, w), get(here, I_M, w))
            along, across = series[1] * dot(o, m), cross(o, m)
            pulled = axpy(series[0], m, axpy(along, o, scale(-series[2], across)))  # V^T m
            S = second_derivative(o, m, series, slopes)
            first = rotation_vector_changes(u2, half, k)
            second = rotation_vector_changes(u1, half, -k)
            _square(here, 0, w, S, first)
            _square(here, 1, w, S, second)
            _cross_block(here, w, S, first, second, scale(k, pulled))
        if work.piece[p, P_UNEVEN * W] > 0.0:
            for f in range(6):
                to = I_LOCAL + entry(f, f)
                for w in range(W):
                    k = 0.5 * width * read(work.piece[p], P_L, w) * read(here, I_DK + f, w)
                    k *= 1.0 + read(work.piece[p], P_TAU, w) * work.scheme[W + w]
                    write(here, to, w, read(here, to, w) + k)


@kernel
def add_local(p: int, a: int, b: ModalBasis, work: ModalWork) -> None:
    """Add to the work of a column, of a mode of curvature, what the intervals have by themselves."""
    c, m = b.component[a], b.degree[a]
    for i in range(b.width.shape[0]):
        here, b1, b2 = work.interval[p, i], b.at_gauss[i, 0, m], b.at_gauss[i, 1, m]
        for f in range(6):
            first, second = here[(I_LOCAL + entry(f, c)) * W :], here[(I_LOCAL + entry(f, 3 + c)) * W :]
            add_two(here, I_WORK + f, b1, first, b2, second)


@kernel
def add_elasticity(p: int, b: ModalBasis, work: ModalWork) -> None:
    """EI l / (2 m + 1) (1 + tau g) on the diagonal."""
    n_modes, piece = b.component.shape[0], work.piece[p]
    for a in range(n_modes):
        row, gram, c = p * n_modes + a, 1.0 / (2.0 * b.degree[a] + 1.0), b.component[a]
        for w in range(W):
            k = gram * read(piece, P_L, w) * read(piece, P_K + c, w)
            k *= 1.0 + read(piece, P_TAU, w) * work.scheme[W + w]
            write_at(hessian(work), row, row, w, at(hessian(work), row, row, w) + k)
