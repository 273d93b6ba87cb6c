"""A batch of rods of modes: what Python calls."""

from __future__ import annotations

import numpy as np

from fastrod.types import Floats

from .jit import LANES, entry
from .rod.modal.chunk import ModalRun, pass_of_modes
from .rod.modal.derivatives import ModalDerivatives, derivatives_of_modes
from .rod.modal.fields import ModalWork, modal_workspace
from .rod.modal.gather import ModalBatch
from .rod.modal.output import ModalOutput

__all__ = ["LANES", "derive_modes", "modal_workspace", "pass_modes"]


@entry
def pass_modes(run: ModalRun, batch: ModalBatch, output: ModalOutput, work: ModalWork) -> None:
    """The robots of `run` at rest or one time step further (`pass_of_modes`), in a workspace of one task. It
    holds no lock of Python, so that threads run it side by side: `prange` would compile it once more."""
    n = len(run.robots)
    lanes = np.empty(LANES, np.int64)
    for start in range(0, n, LANES):
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = run.robots[start + min(w, count - 1)]
        pass_of_modes(lanes, count, 0, run, batch, output, work)


@entry
def derive_modes(
    run: ModalRun, batch: ModalBatch, unknowns: Floats, work: ModalWork, out: ModalDerivatives
) -> None:
    """Derivatives of the robots of `run` at these unknowns (`derivatives_of_modes`)."""
    n = len(run.robots)
    lanes = np.empty(LANES, np.int64)
    for start in range(0, n, LANES):
        count = min(LANES, n - start)
        for w in range(LANES):
            lanes[w] = run.robots[start + min(w, count - 1)]
        derivatives_of_modes(lanes, count, run, batch, unknowns, work, out)
