"""Start of a cold solve: arcs from the tendon lengths, and on them the moments and tensions that statics asks
for.

From here Newton's method takes four to six passes; from zero it diverges.
"""

from __future__ import annotations

from fastrod.kernels.rod.cold import begin
from fastrod.types import Ints, Layout, Memory, Params, Ports


def cold_start(rows: Ints, layout: Layout, params: Params, ports: Ports, memory: Memory) -> None:
    """Fill x and the curvature guess of the robots `rows` from their inputs alone, and forget what was
    learned before."""
    if len(rows):  # a step asks every time, and hardly ever for anyone
        begin(rows, layout, params, ports, memory)
