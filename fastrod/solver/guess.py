"""Start of a cold solve: arcs from the tendon lengths, and on them the moments and tensions that statics asks
for.

From here Newton's method takes four to six passes; from zero it diverges.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod.kernels.rod.cold import begin
from fastrod.types import Ints, Layout, Memory, Params, Ports

_LOADS = ("tension", "tip_force", "tip_moment", "follower_force", "follower_line", "line_force", "node_force")


def cold_start(rows: Ints, layout: Layout, params: Params, ports: Ports, memory: Memory) -> None:
    """Fill x and the curvature guess of the robots `rows` from their inputs alone, and forget what was
    learned before."""
    if len(rows):  # a step asks every time, and hardly ever for anyone
        begin(rows, layout, params, ports, memory)


def unloaded(ports: Ports, layout: Layout, params: Params) -> Ports:
    """The straight robot on the same base, without loads."""
    ends = np.cumsum(params.length + ports.extension, axis=1)[:, layout.tendon_segment]
    zeros: dict[str, Any] = {name: 0.0 * getattr(ports, name) for name in _LOADS}
    return ports._replace(tendon_length=np.ascontiguousarray(ends), **zeros)
