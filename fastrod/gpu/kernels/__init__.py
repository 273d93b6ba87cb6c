"""The files of `fastrod/kernels` under a second name, with the `jit` that stands here: one source for both machines.

`fastrod.gpu.kernels.chunk` is `fastrod/kernels/chunk.py`, whose `from .jit import ...` finds the `jit.py` of this folder. That has
one lane: a thread of the GPU is a lane already.
"""

from pathlib import Path

__path__.append(str(Path(__file__).parents[2] / "kernels"))
