"""The rod of modes, LANES robots side by side: its buffers by name.

A robot is a chain of pieces (a segment is one, or several where loads make kinks in its curvature). A buffer
of fields is one-dimensional (`lanes`); the offsets below name its fields.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...jit import inline
from ..lanes import LaneMatrix, Lanes, W
from .modes import ModalBasis

# node: rotation, position, tangent t = R v, force and moment that it must be given, force that its tangent
# carries into the positions beyond, moment t x N + C, change of C by a rotation (3, 3)
N_R, N_POS, N_T, N_F, N_C, N_N, N_MU, N_ROTARY, NODE = 0, 9, 12, 15, 18, 21, 24, 27, 36
# given at a node: what its inertia is counted from, position and directors (`motion`), the line force
# there, the masses of the directors that stand for its rotary inertia [kg m^2], the two parts of the line
# force: that of the world, and the one that follows the rod, material; and a moment
H_POS, H_D, H_LINE, H_J, H_DEAD, H_FOLLOW, H_MOMENT, HISTORY = 0, 3, 12, 15, 18, 21, 24, 27
# interval: u and v at its two Gauss points, rotation vector, W (rotation at its end, world, by each component
# of u there), the moment that it carries, its own second derivatives (6x6, lower triangle), W . Y of a
# column; given: u* at the Gauss points, how far K is there from that of the piece, and what the rate of
# u - u* is counted from
I_U, I_V, I_O, I_W, I_M, I_LOCAL, I_WORK, I_STAR, I_DK, I_HISTORY = 0, 6, 12, 15, 33, 36, 57, 63, 69, 75
INTERVAL = 81
# piece: length; EI_x, EI_y, GJ, then GA_x, GA_y, EA; damping time; mass per length; 1 where K changes along
# the segments of the batch, and 1 where a line force follows its robot
P_L, P_K, P_TAU, P_RHO, P_UNEVEN, P_FOLLOWED, PIECE = 0, 1, 7, 8, 9, 10, 11
# what is beyond a piece, about its end: force and moment; inertia's mass, first moment, and the moment by a
# rotation (3, 3)
B_F, B_M, B_MASS, B_FIRST, B_BACK, BEYOND = 0, 3, 6, 7, 10, 19
# column: rotation of a node and change of its tangent by one unknown
C_TH, C_V, COLUMN = 0, 3, 6
# station: a lump or a point force between the nodes. Mass, force that it must be given, what its inertia is
# counted from, force from outside; its row of the integration follows
S_MASS, S_F, S_HISTORY, S_GIVEN, S_POS, S_ROW = 0, 1, 4, 7, 10, 13
# Newton: energies of the trial and before it, damping, size [rad] of the step at work and of the robot's last
# one, fraction of it that is taken, flags, a diagonal entry of the Hessian, the tip's rotation before the
# step, how many steps the robot took, which tendons were slack before the step, and the largest moment on a
# mode, in what bends it by a radian
L_ENERGY, L_BEFORE, L_SIGMA, L_SIZE, L_CORRECTION, L_STEP, L_DONE, L_REPLACED = 0, 1, 2, 3, 4, 5, 6, 7
L_PIVOT, L_ROTATION, L_COUNT, L_SLACK, L_AGAIN, L_FORCE, NEWTON = 8, 9, 18, 19, 20, 21, 22

# host: 1 where a base gives way, 1 in the first lane where any does; displacement of the base and its Newton
# step; inertia of its body over kappa dt^2 (6, 6), its pose without the rod, kappa, the scheme, the trace
# of P^-1 K, K what the rod resists, what a mean wrench has beyond that at the end, and where the base was
G_ON, G_ANY, G_D, G_STEP, G_P = 0, 1, 2, 8, 14
G_FREE, G_KAPPA, G_SCHEME, G_LIGHT, G_PULL, G_START, HOST = 50, 62, 63, 66, 67, 73, 76


class ModalWork(NamedTuple):
    """The buffers of a chunk of robots."""

    node: Lanes
    """(n_pieces, N + 1, NODE)"""
    history: Lanes
    """(n_pieces, N + 1, HISTORY)"""
    interval: Lanes
    """(n_pieces, N, INTERVAL)"""
    column: Lanes
    """(n_pieces, n_modes, N + 1, COLUMN)"""
    end: Lanes
    """(n_pieces, n_modes, 6) motion of a piece's end by each of its modes: displacement, rotation."""
    station: Lanes
    """(n_pieces, n_stations, S_ROW + N + 1)"""
    piece: Lanes
    """(n_pieces, PIECE)"""
    beyond: Lanes
    """(2, BEYOND) beyond the piece at work, and beyond the one before it."""
    force: Lanes
    """(N + 1, 3) change of N_N by a column."""
    rigid: Lanes
    """(N + 1, COLUMN) a rotation of the whole piece."""
    coupling: Lanes
    """(n_modes, 6) work of a displacement and a rotation of the piece's start on each of its modes."""
    q: Lanes
    """(n_q,) unknowns, piece after piece."""
    q_history: Lanes
    """(n_q,) what their rates are counted from."""
    gradient: Lanes
    """(n_q,)"""
    hessian: Lanes
    """(n_q, n_q) lower triangle (`hessian`)."""
    offset: Lanes
    """(n_pieces, n_tendons, 2) position of the tendons in each piece [m]."""
    tension: Lanes
    """(n_tendons,)"""
    stiffness: Lanes
    """(n_tendons,) 1 / compliance; 0 where a tendon is slack, or its tension is commanded."""
    path_length: Lanes
    """(n_tendons,)"""
    path_change: Lanes
    """(n_tendons, n_q) its derivatives (`path_change`)."""
    scratch: Lanes
    """(21,) sums of one Gauss point."""
    outside: Lanes
    """(15,) force and moment on the tip, the gravity of lumps; the tip force that keeps its direction, and
    the one that follows the tip, material."""
    follow: Lanes
    """(3, n_q) answer of the unknowns to a force on the tip (`follower`)."""
    scheme: Lanes
    """(2,) alpha [1/s^2] and g [1/s] of the time scheme; 0 at rest."""
    newton: Lanes
    """(NEWTON,)"""
    base: Lanes
    """(12,) rotation and position of the base."""
    host: Lanes
    """(HOST,)"""
    host_matrix: Lanes
    """(6, 6) the bases' own system, the modes eliminated."""
    host_change: Lanes
    """(6, n_q) derivatives of the balance by displacement and rotation of the base."""


@inline
def hessian(work: ModalWork) -> LaneMatrix:
    """By rows and columns."""
    return LaneMatrix(work.hessian, len(work.q) // W)


@inline
def path_change(work: ModalWork) -> LaneMatrix:
    """By tendons and unknowns."""
    return LaneMatrix(work.path_change, len(work.q) // W)


@inline
def one_task(work: ModalWork, i: int) -> ModalWork:
    """The buffers of task i; `work` has one axis more at first."""
    return ModalWork(
        work.node[i],
        work.history[i],
        work.interval[i],
        work.column[i],
        work.end[i],
        work.station[i],
        work.piece[i],
        work.beyond[i],
        work.force[i],
        work.rigid[i],
        work.coupling[i],
        work.q[i],
        work.q_history[i],
        work.gradient[i],
        work.hessian[i],
        work.offset[i],
        work.tension[i],
        work.stiffness[i],
        work.path_length[i],
        work.path_change[i],
        work.scratch[i],
        work.outside[i],
        work.follow[i],
        work.scheme[i],
        work.newton[i],
        work.base[i],
        work.host[i],
        work.host_matrix[i],
        work.host_change[i],
    )


def modal_workspace(n_tasks: int, n_pieces: int, n_tendons: int, n_stations: int, b: ModalBasis) -> ModalWork:
    """Zeros for so many chunks at once, the task axis first."""
    n, n_modes = len(b.width), len(b.component)
    n_q = n_pieces * n_modes

    def room(*axes: int) -> np.ndarray:
        return np.zeros((n_tasks, *axes[:-1], axes[-1] * W))

    return ModalWork(
        node=room(n_pieces, n + 1, NODE),
        history=room(n_pieces, n + 1, HISTORY),
        interval=room(n_pieces, n, INTERVAL),
        column=room(n_pieces, n_modes, n + 1, COLUMN),
        end=room(n_pieces, n_modes, 6),
        station=room(n_pieces, n_stations, S_ROW + n + 1),
        piece=room(n_pieces, PIECE),
        beyond=room(2, BEYOND),
        force=room(n + 1, 3),
        rigid=room(n + 1, COLUMN),
        coupling=room(n_modes, 6),
        q=room(n_q),
        q_history=room(n_q),
        gradient=room(n_q),
        hessian=room(n_q * n_q),
        offset=room(n_pieces, 2 * n_tendons),
        tension=room(n_tendons),
        stiffness=room(n_tendons),
        path_length=room(n_tendons),
        path_change=room(n_tendons * n_q),
        scratch=room(24),
        outside=room(15),
        follow=room(3 * n_q),
        scheme=room(2),
        newton=room(NEWTON),
        base=room(12),
        host=room(HOST),
        host_matrix=room(36),
        host_change=room(6 * n_q),
    )
