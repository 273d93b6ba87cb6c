"""Buffers of the rod of modes, for as many chunks as run side by side."""

from __future__ import annotations

import numpy as np

from ..lanes import W
from .fields import BEYOND, COLUMN, HISTORY, HOST, INTERVAL, NEWTON, NODE, PIECE, S_ROW, ModalWork
from .modes import ModalBasis


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
