"""The files of `fastrod/kernels` under a second name, with the `jit` that stands here: four lanes.

`fastrod.solver.narrow.modal_batch` is `fastrod/kernels/modal_batch.py`, whose `from .jit import ...` finds
the `jit.py` of this folder, as do those of all that it imports (`fastrod/solver/gpu/kernels` does the same).
"""

from pathlib import Path

__path__.append(str(Path(__file__).parents[2] / "kernels"))
