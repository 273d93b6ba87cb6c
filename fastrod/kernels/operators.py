"""Operators with memory on the lengths of the tendons: rows (robots or parameter sets) x steps x tendons.

Each changes `x` (n_rows, n_steps, n_tendons) in place from command to effect and carries `memory` (n_rows,
...) on; nan in the memory means that the tendon begins at rest at its first length. `dt` (n_steps,) is the
time before each step [s]. Parameters have the shape (n_rows, n_tendons), so that every tendon may have its
own.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .jit import entry

Floats = NDArray[np.float64]

SLIDERS = 5
"""Number of sliders of `elastoplastic`."""
BUFFER = 128
"""Past steps that `delay` keeps; a delay longer than they span is cut to it."""


@entry
def play(x: Floats, memory: Floats, half_width: Floats, rounding: Floats) -> None:
    """Backlash: the output p stays until the input has crossed the gap, |x - p| <= w; with a rounding c the
    mean of three plays of half widths w (1 - c), w, w (1 + c). memory (n_rows, 3 n_tendons): p."""
    n = x.shape[2]
    for r in range(x.shape[0]):
        for w in range(n):
            p = (memory[r, w], memory[r, n + w], memory[r, 2 * n + w])
            gap, c = half_width[r, w], rounding[r, w]
            if math.isnan(p[0]):
                p = (x[r, 0, w], x[r, 0, w], x[r, 0, w])
            for i in range(x.shape[1]):
                here = x[r, i, w]
                low, middle, high = gap * (1.0 - c), gap, gap * (1.0 + c)
                p = (
                    max(here - low, min(here + low, p[0])),
                    max(here - middle, min(here + middle, p[1])),
                    max(here - high, min(here + high, p[2])),
                )
                x[r, i, w] = p[1] + ((p[0] - p[1]) + (p[2] - p[1])) / 3.0
            memory[r, w], memory[r, n + w], memory[r, 2 * n + w] = p


@entry
def elastoplastic(
    x: Floats,
    memory: Floats,
    amplitude: Floats,
    presliding: Floats,
    spread: Floats,
    growth: Floats,
    angle: Floats,
) -> None:
    """Dry friction without rates: sliders in parallel, each sticking until it has been dragged by its own r_j
    (Iwan, Prandtl and Ishlinskii): z_j = min(1, max(-1, z_j + x' / r_j)), out x - a (1 + g angle) mean z_j.

    The radii are spread evenly in their logarithm over r exp(-s) to r exp(s). angle (n_rows, n_steps,
    n_tendons) wrapped by the tendon [rad]; memory (n_rows, (1 + SLIDERS) n_tendons): x, z_j.
    """
    n = x.shape[2]
    for r in range(x.shape[0]):
        for w in range(n):
            before = memory[r, w]
            a, g = amplitude[r, w], growth[r, w]
            if math.isnan(before):
                before = x[r, 0, w]
                for j in range(SLIDERS):
                    memory[r, (1 + j) * n + w] = 0.0
            step = math.exp(2.0 * spread[r, w] / (SLIDERS - 1))  # from one radius to the next
            least = presliding[r, w] * math.exp(-spread[r, w])
            for i in range(x.shape[1]):
                here = x[r, i, w]
                mean, radius = 0.0, least / step
                for j in range(SLIDERS):
                    radius *= step
                    z = min(1.0, max(-1.0, memory[r, (1 + j) * n + w] + (here - before) / radius))
                    memory[r, (1 + j) * n + w] = z
                    mean += z
                before = here
                x[r, i, w] = here - a * (1.0 + g * angle[r, i, w]) * mean / SLIDERS
            memory[r, w] = before


@entry
def relaxation(x: Floats, memory: Floats, fraction: Floats, time_constant: Floats, dt: Floats) -> None:
    """Standard linear solid: out x - c (x - y), tau y' = x - y, x linear in between; memory (n_rows, 2
    n_tendons): x, y."""
    n = x.shape[2]
    for r in range(x.shape[0]):
        for w in range(n):
            before, y = memory[r, w], memory[r, n + w]
            c, tau = fraction[r, w], time_constant[r, w]
            if math.isnan(before):
                before = x[r, 0, w]
                y = before
            for i in range(x.shape[1]):
                here, h = x[r, i, w], dt[i]
                if h > 0.0:
                    lag = tau * (here - before) / h
                    y = here - lag + (y - before + lag) * math.exp(-h / tau)
                before = here
                x[r, i, w] = here - c * (here - y)
            memory[r, w], memory[r, n + w] = before, y


@entry
def second_order(x: Floats, memory: Floats, period: Floats, damping: Floats, dt: Floats) -> None:
    """T^2 y'' + 2 z T y' + y = x, exact for x linear in between; T = 0 is y = x. memory (n_rows, 3
    n_tendons):
    x, y, y'."""
    n = x.shape[2]
    for r in range(x.shape[0]):
        for w in range(n):
            before, y, v = memory[r, w], memory[r, n + w], memory[r, 2 * n + w]
            T, z = period[r, w], damping[r, w]
            if math.isnan(before):
                before = x[r, 0, w]
                y, v = before, 0.0
            for i in range(x.shape[1]):
                here, h = x[r, i, w], dt[i]
                if T <= 0.0:
                    y = here
                elif h > 0.0:
                    slope, lag = (here - before) / h, 2.0 * z * T
                    rate = math.sqrt(1.0 - z * z) / T
                    y0, v0 = y - before + lag * slope, v - slope
                    decay, c, s = math.exp(-z * h / T), math.cos(rate * h), math.sin(rate * h)
                    side = (v0 + z / T * y0) / rate
                    y = here - lag * slope + decay * (y0 * c + side * s)
                    v = slope + decay * ((side * rate - z / T * y0) * c - (z / T * side + rate * y0) * s)
                before = here
                x[r, i, w] = y
            memory[r, w], memory[r, n + w], memory[r, 2 * n + w] = before, y, v


@entry
def yielding(bend: Floats, memory: Floats, fraction: Floats, yield_at: Floats) -> None:
    """Plastic set of bends (n_rows, n_steps, n_segments, 2), in place: out b + c p, p dragged along once |b -
    p| exceeds y, in any direction; it begins at the straight rod. memory (n_rows, 2 n_segments): p; fraction
    and yield_at (n_rows, n_segments)."""
    for r in range(bend.shape[0]):
        for k in range(bend.shape[2]):
            px, py = memory[r, 2 * k], memory[r, 2 * k + 1]
            if math.isnan(px):
                px, py = 0.0, 0.0
            for i in range(bend.shape[1]):
                dx, dy = bend[r, i, k, 0] - px, bend[r, i, k, 1] - py
                size = math.sqrt(dx * dx + dy * dy)
                if size > yield_at[r, k]:
                    slip = 1.0 - yield_at[r, k] / size
                    px += slip * dx
                    py += slip * dy
                bend[r, i, k, 0] += fraction[r, k] * px
                bend[r, i, k, 1] += fraction[r, k] * py
            memory[r, 2 * k], memory[r, 2 * k + 1] = px, py


@entry
def delay(x: Floats, memory: Floats, lag: Floats, dt: Floats) -> None:
    """Out x(t - d), a monotone cubic through the four samples around it, linear where there are not four.

    lag (n_rows,) [s]. memory (n_rows, 1 + BUFFER (1 + n_tendons)): count, then clock and lengths of each past
    step. Before the first step the tendons are taken as at rest there.
    """
    n = x.shape[2]
    width = 1 + n
    for r in range(x.shape[0]):
        if math.isnan(memory[r, 0]):
            memory[r, 0] = 0.0
        count = int(memory[r, 0])
        clock = memory[r, 1 + ((count - 1) % BUFFER) * width] if count > 0 else 0.0
        for i in range(x.shape[1]):
            clock += dt[i] if count > 0 else 0.0
            record = 1 + (count % BUFFER) * width
            memory[r, record] = clock
            for w in range(n):
                memory[r, record + 1 + w] = x[r, i, w]
            count += 1
            if lag[r] <= 0.0:
                continue
            wanted = clock - lag[r]
            newest = newer = older = record
            steps = 0
            for back in range(1, min(count, BUFFER)):
                newest, newer = newer, older
                older = 1 + ((count - 1 - back) % BUFFER) * width
                steps = back
                if memory[r, older] <= wanted:
                    break
            oldest = 1 + ((count - 2 - steps) % BUFFER) * width
            span = memory[r, newer] - memory[r, older]
            fraction = (wanted - memory[r, older]) / span if span > 0.0 else 1.0
            fraction = min(max(fraction, 0.0), 1.0)
            before = memory[r, older] - memory[r, oldest]
            after = memory[r, newest] - memory[r, newer] if steps >= 2 else 0.0
            cubic = steps >= 1 and steps + 1 < min(count, BUFFER) and before > 0.0 and span > 0.0
            for w in range(n):
                old, new = memory[r, older + 1 + w], memory[r, newer + 1 + w]
                out = old + fraction * (new - old)
                if cubic:
                    here = (new - old) / span
                    earlier = (old - memory[r, oldest + 1 + w]) / before
                    # between the last two samples there is none beyond: the parabola's slope at its end
                    later = (memory[r, newest + 1 + w] - new) / after if after > 0.0 else 2.0 * here - earlier
                    # slopes at both ends; zero where the tendon reverses and at most three times either
                    # neighbour, so that nothing
                    # overshoots (Fritsch and Carlson 1980)
                    a = (earlier * span + here * before) / (span + before) if earlier * here > 0.0 else 0.0
                    ahead = after if after > 0.0 else before
                    b = (here * ahead + later * span) / (span + ahead) if here * later > 0.0 else 0.0
                    a = math.copysign(min(abs(a), 3.0 * abs(earlier), 3.0 * abs(here)), a)
                    b = math.copysign(min(abs(b), 3.0 * abs(here), 3.0 * abs(later)), b)
                    u = fraction * (1.0 - fraction) * span
                    out += u * ((1.0 - fraction) * (a - here) - fraction * (b - here))
                x[r, i, w] = out
        memory[r, 0] = float(count)
