"""Energy whose gradient the balance is: at rest the potential energy of rod, tendons and loads; in motion
with that of inertia and damping over one time step (the incremental potential: Ortiz and Stainier 1999)."""

from __future__ import annotations

from fastrod.types import Floats

from ...jit import kernel
from ...vec import axpy, dot, sub
from ..lanes import Lanes, W, get, read
from . import fields as fd
from .fields import ModalWork
from .host import add_energy_of_base, hosted
from .modes import ModalBasis


@kernel
def energy_of_nodes(p: int, b: ModalBasis, work: ModalWork, energy: Lanes) -> None:
    """Add inertia, weight and line force of a piece's nodes."""
    piece, n = work.piece[p], b.width.shape[0]
    for j in range(n + 1):
        node, history, weight = work.node[p, j], work.history[p, j], b.integral[n, j]
        for w in range(W):
            extent, alpha = weight * read(piece, fd.P_L, w), 0.5 * work.scheme[w]
            rho, position = read(piece, fd.P_RHO, w), get(node, fd.N_POS, w)
            moved = sub(position, get(history, fd.H_POS, w))
            given = dot(get(history, fd.H_LINE, w), position)
            energy[w] += extent * (rho * alpha * dot(moved, moved) - given)
        for k in range(3):
            for w in range(W):
                d = (read(node, fd.N_R + k, w), read(node, fd.N_R + 3 + k, w), read(node, fd.N_R + 6 + k, w))
                turned = sub(d, get(history, fd.H_D + 3 * k, w))
                energy[w] += 0.5 * work.scheme[w] * read(history, fd.H_J + k, w) * dot(turned, turned)


@kernel
def energy_of_stations(p: int, b: ModalBasis, work: ModalWork, energy: Lanes) -> None:
    """Add the lumps and point forces of a piece."""
    start, length = work.node[p, 0], work.piece[p]
    for k in range(work.station.shape[1]):
        station = work.station[p, k]
        for w in range(W):
            position = get(start, fd.N_POS, w)
            for j in range(b.node.shape[0]):
                step = read(length, fd.P_L, w) * read(station, fd.S_ROW + j, w)
                position = axpy(step, get(work.node[p, j], fd.N_T, w), position)
            moved, mass = sub(position, get(station, fd.S_HISTORY, w)), read(station, fd.S_MASS, w)
            pulled = axpy(mass, get(work.outside, 6, w), get(station, fd.S_GIVEN, w))
            energy[w] += 0.5 * mass * work.scheme[w] * dot(moved, moved) - dot(pulled, position)


@kernel
def energy_of_modes(p: int, b: ModalBasis, work: ModalWork, energy: Lanes) -> None:
    """Add elasticity and damping of a piece."""
    n_modes, piece = b.component.shape[0], work.piece[p]
    for a in range(n_modes):
        row, c, gram = p * n_modes + a, b.component[a], 0.5 / (2.0 * b.degree[a] + 1.0)
        for w in range(W):
            q = read(work.q, row, w)
            moved = q - read(work.q_history, row, w)
            k = gram * read(piece, fd.P_L, w) * read(piece, fd.P_K + c, w)
            energy[w] += k * (q * q + read(piece, fd.P_TAU, w) * work.scheme[W + w] * moved * moved)


@kernel
def energy_of_uneven(p: int, b: ModalBasis, work: ModalWork, energy: Lanes) -> None:
    """Add what the stiffness at the Gauss points has beyond that of the piece."""
    piece = work.piece[p]
    for i in range(b.width.shape[0]):
        here = work.interval[p, i]
        for f in range(6):
            for w in range(W):
                strain = read(here, fd.I_U + f, w) - read(here, fd.I_STAR + f, w)
                moved = strain - read(here, fd.I_HISTORY + f, w)
                damped = read(piece, fd.P_TAU, w) * work.scheme[W + w] * moved * moved
                k = 0.25 * b.width[i] * read(piece, fd.P_L, w) * read(here, fd.I_DK + f, w)
                energy[w] += k * (strain * strain + damped)


@kernel
def energy_of_tendons(command: Floats, work: ModalWork, energy: Lanes) -> None:
    """Add T0 (path - L) + (path - L)^2 / 2 c of every tendon, or what is left of it where it is slack; of a
    tension that is commanded T path."""
    length, compliance, pretension = command[0], command[1], command[2]
    for t in range(len(work.tension) // W):
        for w in range(W):
            i = t * W + w
            c, longer = compliance[i], work.path_length[i] - length[i]
            if c <= 0.0:
                energy[w] += pretension[i] * work.path_length[i]
            elif work.stiffness[i] > 0.0:
                energy[w] += longer * (pretension[i] + 0.5 * longer / c)
            else:  # where it went slack: T0 + longer / c = 0
                energy[w] -= 0.5 * c * pretension[i] * pretension[i]


@kernel
def energy_of_shape(b: ModalBasis, command: Floats, work: ModalWork, energy: Lanes) -> None:
    """(1,) energy of the last shape [J]; `command` as for `tensions`."""
    for w in range(W):
        energy[w] = 0.0
    for p in range(work.piece.shape[0]):
        energy_of_nodes(p, b, work, energy)
        energy_of_stations(p, b, work, energy)
        energy_of_modes(p, b, work, energy)
        if work.piece[p, fd.P_UNEVEN * W] > 0.0:
            energy_of_uneven(p, b, work, energy)
    energy_of_tendons(command, work, energy)
    last = work.node[work.piece.shape[0] - 1, b.width.shape[0]]
    for w in range(W):
        energy[w] -= dot(get(work.outside, 0, w), get(last, fd.N_POS, w))
    if hosted(work):
        add_energy_of_base(work, energy)
