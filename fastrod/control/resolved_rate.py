"""Resolved-rate control: rates of the coordinates that move a tip toward its goal, within the limits of
both; of one robot (`ResolvedRate`), and of a batch that is only scaled at its limits (`scaled_rates`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, cast, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import Bound, check, check_number
from fastrod.errors import InputError
from fastrod.types import Flags, Floats

_RANK = 1e-9  # of the largest singular value: below it, no coordinate moves the task in that direction
_STILL = 1e-9  # of a rate, or 1/s: between limits as near as this, nothing moves
_ROOM = 1e-12  # of a rate: nearer to its limit is at it


@final
@dataclass(frozen=True, kw_only=True, eq=False)
class ResolvedRate:
    """q_dot = J# (v + gain error) + (1 - J# J) posture_gain (posture - q), held within limits (`rates`).

    J# is the pseudo-inverse of least sum of weight q_dot^2. Near a singularity, where the smallest singular
    value s of the weighted Jacobian is below `threshold`, it is damped by l^2 = (1 - (s / threshold)^2)
    damping^2: s / (s^2 + l^2) in the place of 1 / s.
    Source: Whitney 1969 (resolved rates); Wampler 1986, Nakamura and Hanafusa 1986 (damped least squares);
    Maciejewski and Klein 1988 (damping near a singularity alone); Flacco, De Luca and Khatib 2012 (saturation
    in the null space).

    >>> ResolvedRate(gain=2.0).rates([0.0, 0.0], [[1.0, 0.0]], [0.1], [0.0], 0.01).tolist()
    [0.2, 0.0]
    """

    gain: Annotated[float, Bound(least=0.0, unit="1/s")] = 1.0
    """Gain of the error [1/s]."""
    damping: Annotated[float, Bound(least=0.0)] = 1e-2
    """Largest damping l, at a singular Jacobian; the unit of the weighted Jacobian. 0: none."""
    threshold: Annotated[float | None, Bound(above=0.0, infinite=True)] = None
    """Singular value below which damping sets in; by default `damping`. Infinite: the same damping
    everywhere."""
    lower: ArrayLike | None = None
    """(n_q,) least q; None: no limit."""
    upper: ArrayLike | None = None
    """(n_q,) largest q; None: no limit."""
    rate: ArrayLike | None = None
    """(n_q,) or one number, largest |q_dot| [1/s]; None: no limit."""
    weight: ArrayLike | None = None
    """(n_q,) cost of each coordinate's rate squared, positive; None: 1 each. A coordinate of ten times the
    unit wants a hundredth."""
    error_limit: Annotated[float | None, Bound(above=0.0, unit="m", infinite=True)] = None
    """[m] a longer error is shortened to this before the gain; None: no limit."""
    posture: ArrayLike | None = None
    """(n_q,) where q goes as far as the task leaves it free; None: nowhere."""
    posture_gain: Annotated[float, Bound(least=0.0, unit="1/s")] = 1.0
    """Gain of `posture - q` [1/s]."""
    nearest: bool = False
    """Nearest rates: of all within the limits, those of least |J q_dot - task|^2 + damping^2 sum of weight
    q_dot^2: what is beyond the limits is followed partly, in any direction. False: the direction is kept."""
    _n_q: int | None = field(init=False, repr=False, default=None)
    _most: Floats = field(init=False, repr=False)
    """(n_q,) or one number: `rate`, infinite where there is none."""
    _root: Floats | None = field(init=False, repr=False, default=None)
    """(n_q,) weight^(-1/2)."""

    def __post_init__(self) -> None:
        check(self)
        if self.nearest and self.posture is not None:
            raise InputError("ResolvedRate has a posture, for which nearest leaves no room; give one.")
        sizes: dict[str, int] = {}
        for name in ("lower", "upper", "rate", "weight", "posture"):
            value = getattr(self, name)
            if value is None:
                continue
            try:
                a = np.array(value, dtype=np.float64)
            except (TypeError, ValueError) as error:
                raise InputError(f"ResolvedRate.{name} is {value!r}; give (n_q,) numbers.") from error
            if a.ndim > 1 or (a.ndim == 0 and name != "rate") or np.isnan(a).any():
                raise InputError(f"ResolvedRate.{name} is {value!r}; give (n_q,) numbers, none of them nan.")
            if name in ("rate", "weight") and not (a > 0.0).all():
                raise InputError(f"ResolvedRate.{name} is {value!r}; every number of it must be positive.")
            if name in ("weight", "posture") and not np.isfinite(a).all():
                raise InputError(f"ResolvedRate.{name} is {value!r}; every number of it must be finite.")
            a.flags.writeable = False
            object.__setattr__(self, name, a)
            if a.ndim:
                sizes[name] = len(a)
        if len(set(sizes.values())) > 1:
            raise InputError(
                f"ResolvedRate has {', '.join(f'{name} of {n}' for name, n in sizes.items())}; they must "
                "have one length, n_q."
            )
        object.__setattr__(self, "_n_q", next(iter(sizes.values()), None))
        most = np.asarray(np.inf if self.rate is None else self.rate, dtype=np.float64)
        object.__setattr__(
            self, "_most", most if self._n_q is None else np.broadcast_to(most, (self._n_q,)).copy()
        )
        if self.weight is not None:
            object.__setattr__(self, "_root", 1.0 / np.sqrt(np.asarray(self.weight)))
        if (
            self.lower is not None
            and self.upper is not None
            and (np.asarray(self.lower) > np.asarray(self.upper)).any()
        ):
            i = int(np.flatnonzero(np.asarray(self.lower) > np.asarray(self.upper))[0])
            least, most = np.asarray(self.lower)[i], np.asarray(self.upper)[i]
            raise InputError(f"ResolvedRate.lower[{i}] is {least:g}, above upper[{i}] {most:g}.")

    def rates(
        self, q: ArrayLike, jacobian: ArrayLike, error: ArrayLike, feedforward: ArrayLike, dt: float
    ) -> Floats:
        """(n_q,) rates q_dot [1/s] for the next `dt` [s].

        `q` (n_q,); `jacobian` (m, n_q) of the task by q; `error` (m,) goal minus task [m]; `feedforward` (m,)
        velocity of the goal [m/s]. |q_dot| stays within `rate`, and q + dt q_dot within `lower` and `upper`;
        a q that is outside comes back, as fast as its rate allows. A coordinate that would leave its limits
        is held at them and the others compensate; where they cannot, the task is scaled: its direction is
        kept, where any motion in it is left. The posture is given up first. Raises `InputError` on wrong
        shapes and on what is not finite.
        """
        q, J, error, feedforward = (
            np.asarray(a, dtype=np.float64) for a in (q, jacobian, error, feedforward)
        )
        if not (
            q.ndim == 1
            and J.ndim == 2
            and J.shape[1] == len(q)
            and error.shape == feedforward.shape == J.shape[:1]
            and len(q)
        ):
            raise InputError(
                f"q {q.shape}, jacobian {J.shape}, error {error.shape} and feedforward {feedforward.shape} "
                "do not fit together; "
                "they must be (n_q,), (m, n_q), (m,) and (m,)."
            )
        if self._n_q is not None and len(q) != self._n_q:
            raise InputError(f"q has {len(q)} coordinates; this ResolvedRate is made for {self._n_q}.")
        check_number("dt", dt, Bound(above=0.0, unit="s"))
        if not math.isfinite(q.sum() + J.sum() + error.sum() + feedforward.sum()):
            for name, a in (("q", q), ("jacobian", J), ("error", error), ("feedforward", feedforward)):
                if not np.isfinite(a).all():
                    raise InputError(f"{name} holds a value that is not finite: {a.ravel()[:9]}.")
        if self.error_limit is not None and (size := math.sqrt(error @ error)) > self.error_limit:
            error = error * (self.error_limit / size)
        task = feedforward + self.gain * error
        wish = None if self.posture is None else self.posture_gain * (cast(Floats, self.posture) - q)
        low, high = self._range(q, dt)
        if self.nearest:
            return self._nearest(J, task, low, high)
        inverse, free = self._inverse(J, None, wish is not None)
        by_task = inverse @ task
        rates = by_task if free is None or wish is None else by_task + free @ wish
        if ((rates >= low) & (rates <= high)).all():
            return np.asarray(rates)
        # what damping leaves of the task: without limits, exactly `by_task` solves it
        return self._saturated(J, J @ by_task, wish, low, high)

    def _range(self, q: Floats, dt: float) -> tuple[Floats, Floats]:
        """(n_q,) least and largest rates."""
        most = np.broadcast_to(self._most, q.shape)
        lower = -math.inf if self.lower is None else cast(Floats, self.lower)
        upper = math.inf if self.upper is None else cast(Floats, self.upper)
        return np.clip((lower - q) / dt, -most, most), np.clip((upper - q) / dt, -most, most)

    def _nearest(self, J: Floats, task: Floats, low: Floats, high: Floats) -> Floats:
        from scipy.optimize import lsq_linear

        moves = high - low > _STILL * np.minimum(self._most, 1.0)
        rates, n = np.zeros(len(low)), int(moves.sum())
        root = np.ones(n) if self._root is None else self._root[moves]  # unknowns of one size
        rows = np.concatenate([J[:, moves] * root, self.damping * np.eye(n)])
        goal, ends = np.concatenate([task, np.zeros(n)]), (low[moves] / root, high[moves] / root)
        rates[moves] = root * lsq_linear(rows, goal, ends, method="bvls").x
        return rates

    def _inverse(self, J: Floats, active: Flags | None, projector: bool) -> tuple[Floats, Floats | None]:
        """(n_q, m) weighted pseudo-inverse, damped, or undamped by the coordinates `active`; where requested,
        (n_q, n_q) projector on the null space."""
        root = self._root if active is None else active * (1.0 if self._root is None else self._root)
        u, s, vt = np.linalg.svd(J if root is None else J * root, full_matrices=False)
        start, square = self.damping if self.threshold is None else self.threshold, 0.0
        if active is None and s[-1] < start:
            square = (1.0 - (s[-1] / start) ** 2) * self.damping**2
        if s[-1] > _RANK * s[0]:
            by = s / (s * s + square)
        else:  # what no coordinate moves has no inverse
            moved = s > _RANK * s[0]
            by = np.where(moved, s / np.where(moved, s * s + square, 1.0), 0.0)
            vt = vt[moved]
        inverse = (vt.T * by[: len(vt)]) @ u[:, : len(vt)].T
        if root is not None:
            inverse *= root[:, None]
        if not projector:
            return inverse, None
        free = np.eye(J.shape[1]) - vt.T @ vt
        if root is None:
            return inverse, free
        if active is not None:
            free *= active
        back = np.divide(1.0, root, out=np.zeros_like(root), where=root > 0.0)
        return inverse, root[:, None] * free * back

    def _saturated(self, J: Floats, task: Floats, wish: Floats | None, low: Floats, high: Floats) -> Floats:
        """Saturate the coordinate that limits the task most and let the others compensate, until all are
        within their limits; failing that, keep the set that can do the largest fraction of the task (Flacco
        2012, algorithm 1). Then do the same for the posture."""
        active, fixed = np.ones(len(low), dtype=bool), np.zeros(len(low))
        best_scale, best, best_active = -1.0, np.clip(0.0, low, high), ~active
        goal = np.linalg.norm(task)
        while active.any():
            inverse, _ = self._inverse(J, active, False)
            by_task, rest = inverse @ task, fixed - inverse @ (J @ fixed)
            if np.linalg.norm(J @ by_task - task) > 1e-6 * goal or np.linalg.norm(
                J @ rest
            ) > 1e-6 * np.linalg.norm(J @ fixed):
                break  # those that are left cannot
            scale, worst = _step_fraction(by_task, rest, low, high, active)
            if scale > best_scale:
                best_scale, best, best_active = scale, scale * by_task + rest, active.copy()
            if scale >= 1.0 or worst < 0:
                break
            fixed[worst], active[worst] = np.clip((by_task + rest)[worst], low[worst], high[worst]), False
        rates, active = np.clip(best, low, high), best_active
        while wish is not None and active.any():
            step = cast(Floats, self._inverse(J, active, True)[1]) @ (wish - rates)
            fraction, worst = _step_fraction(step, rates, low, high, active)
            rates = rates + max(fraction, 0.0) * step
            if fraction >= 1.0 or worst < 0:
                break
            active[worst] = False
        return np.asarray(np.clip(rates, low, high))


def _step_fraction(step: Floats, rest: Floats, low: Floats, high: Floats, active: Flags) -> tuple[float, int]:
    """Return the largest fraction of the step, at most 1, with which rest + fraction step is within the
    limits, or -1, and the active coordinate that limits it most, or -1."""
    slack = _ROOM * np.maximum(1.0, np.abs(rest))
    still = np.abs(step) <= slack
    inside = (rest >= low - slack) & (rest <= high + slack)
    by = np.where(still, 1.0, step)
    ends = (high - rest) / by, (low - rest) / by
    most = np.where(still, np.where(inside, np.inf, -np.inf), np.where(step > 0.0, *ends))
    least = np.where(still, -np.inf, np.where(step > 0.0, *ends[::-1]))
    key = np.where(active, np.where(least > 1.0, -np.inf, most), np.inf)
    worst = int(np.argmin(key))
    fraction = min(1.0, float(most.min()))
    if fraction < max(0.0, float(least.max())) - _ROOM:
        fraction = -1.0
    return fraction, worst if key[worst] < 1.0 else -1


def scaled_rates(jacobian: Floats, velocity: Floats, wish: Floats) -> Floats:
    """(n, n_q) rates of a batch that give the velocities (n, m), a row scaled where one is beyond -1 or 1:
    damped pseudo-inverse of `jacobian` (n, m, n_q), and in its null space slowly toward `wish` (n, n_q)."""
    transposed = np.swapaxes(jacobian, 1, 2)
    square = jacobian @ transposed
    damping = 1e-3 * np.trace(square, axis1=1, axis2=2) + 1e-12
    inverse = transposed @ np.linalg.inv(square + damping[:, None, None] * np.eye(jacobian.shape[1]))
    free = 0.2 * (wish - (inverse @ (jacobian @ wish[:, :, None]))[:, :, 0])
    rates = (inverse @ velocity[:, :, None])[:, :, 0] + free
    return np.asarray(rates / np.maximum(np.abs(rates).max(1, keepdims=True), 1.0))
