"""The files of `fastrod/kernels` under a second name, with the `jit` that stands here: one source for both
machines.

`fastrod.solver.gpu.kernels.rod.chunk` is `fastrod/kernels/rod/chunk.py`, whose `from ..jit import ...` finds
the `jit.py` of this folder. That has one lane: a thread of the GPU is a lane already.
"""

from pathlib import Path

__path__.append(str(Path(__file__).parents[3] / "kernels"))
