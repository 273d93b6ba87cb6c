"""Nodes on given arclengths: the grid of a segment bends so that point loads act on nodes, where they cost no
truncation error."""

from __future__ import annotations

from fastrod.types import Floats, Ints

from ..jit import kernel

_END = 1e-9  # of a segment: a load nearer to its end than this is on it


@kernel
def place_nodes(s: Floats, starts: Floats, n_steps: int, grid: Floats, node: Ints, work: Floats) -> bool:
    """Move the nodes nearest to the arclengths s (m,) onto them: writes `grid` (n_segments, n_steps + 1),
    fractions of each segment, and the `node` of each s; -1 where s is nan. False where a segment has more of
    them than nodes.

    `starts` (n_segments + 1,) are the arclengths of the joints; `work` holds m numbers.
    """
    fits = True
    n_segments = len(grid)
    for q in range(len(s)):
        node[q] = -1
    for k in range(n_segments):
        low, length = starts[k], starts[k + 1] - starts[k]
        n = 0
        for q in range(len(s)):
            f = (s[q] - low) / length
            ours = (f >= 0.0 or k == 0) and (f < 1.0 or k == n_segments - 1)
            if not ours or f != f:
                continue
            if f < _END or f > 1.0 - _END:
                node[q] = k * n_steps + (0 if f < 0.5 else n_steps)
                continue
            at = n  # keep `work` sorted, without doubles
            while at > 0 and work[at - 1] >= f:
                at -= 1
            if at < n and work[at] == f:
                continue
            for i in range(n, at, -1):
                work[i] = work[i - 1]
            work[at] = f
            n += 1
        fits = fits and n <= n_steps - 1
        n = min(n, n_steps - 1)
        last, last_f = 0, 0.0
        for i in range(n + 1):
            f = work[i] if i < n else 1.0
            there = min(max(int(f * n_steps + 0.5), last + 1), n_steps - n + i) if i < n else n_steps
            for j in range(last, there + 1):
                grid[k, j] = last_f + (f - last_f) * (j - last) / (there - last)
            grid[k, there] = f
            for q in range(len(s)):
                if i < n and (s[q] - low) / length == f:
                    node[q] = k * n_steps + there
            last, last_f = there, f
    return fits
