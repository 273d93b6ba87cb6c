"""The same command at another time: what differs between two visits is no function of the command.

At two visits of one command the mean of the residual is static, half its difference is not. What follows
from where the robot came from is memory: the product of the two residuals is s^2 + m^2 where it came by the
same way, and s^2 - m^2 where it came by the other, s the static part and m that of memory; the rest of their
square does not repeat. No model without memory leaves less than the visits' standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fastrod.identification.log.forward import effects_at, prepare_log
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import Model
from fastrod.types import Flags, Floats, Ints

_SAME = 0.05  # of the range of each input: commands that are as near to each other are the same
_LEFT = 3.0  # times that: a robot that was as far away has left
_ALIKE = 0.5  # cosine of the ways by which a robot came, from which on they are the same
_BENT = 0.25  # of the largest command: beyond it the robot is bent
_MOST = 2000  # visits
_ENOUGH = 30  # pairs
_STRETCHES, _SURE = 8, 2.5  # of the visits; standard errors over them


@dataclass(frozen=True, kw_only=True, eq=False)
class Revisits:
    """Pairs of visits of one command, and the residual at these."""

    n: int
    """Pairs."""
    elsewhere: float
    """Distance between the residuals of a pair, rms [m]."""
    bent: float
    """Half of it at bent poses, rms [m]; nan where there are none."""
    static: float
    memory: float
    """Shares of the residual's square at visits that are static, and that go by where the robot came from;
    nan where that is not sure."""

    @property
    def floor(self) -> float:
        """Return what models without memory leave at these commands at best, rms [m]."""
        return self.elsewhere / math.sqrt(2.0)

    def sentence(self) -> str:
        """Say it to a user."""
        said = (
            f"the same command comes back {1e3 * self.elsewhere:.2g} mm elsewhere, over {self.n} pairs of "
            f"visits: no model without memory leaves less than {1e3 * self.floor:.2g} mm there"
        )
        if np.isfinite(self.memory):
            said += (
                f"; of what is left there {100 * self.memory:.0f} % goes by where the robot came from, "
                f"{100 * self.static:.0f} % is static"
            )
        return said


@dataclass(frozen=True, eq=False)
class Visits:
    """Which samples are visits of one command at two times."""

    measured: Floats
    """(n_samples, 3) tip [m]."""
    rows: tuple[Ints, ...]
    """Samples of each visit."""
    pairs: Ints
    """(n, 2) visits of one command between which the robot was elsewhere."""
    alike: Floats
    """(n,) cosine of the ways by which it came."""
    bent: Flags
    """(n,)"""

    def compare(self, tip: Floats) -> Revisits | None:
        """Return what a predicted tip (n_samples, 3) [m] leaves at these visits; None where they are too
        few."""
        residual = self.measured - tip
        known, nowhere = np.asarray(np.isfinite(residual).all(1)), np.full(3, np.nan)
        seen = [residual[rows[known[rows]]] for rows in self.rows]
        mean = np.array([each.mean(0) if len(each) else nowhere for each in seen]).reshape(-1, 3)
        one, other = mean[self.pairs.T]
        known = np.isfinite(one).all(1) & np.isfinite(other).all(1)
        one, other, alike, bent = one[known], other[known], self.alike[known], self.bent[known]
        if len(one) < _ENOUGH:
            return None
        apart, total = ((one - other) ** 2).sum(1), 0.5 * (one**2 + other**2).sum(1).mean()
        product = (one * other).sum(1)
        each = alike > _ALIKE, alike < -_ALIKE
        same, opposite = (float(product[those].mean()) if those.any() else np.nan for those in each)
        sure = _apart(product, *each, self.pairs[known, 0])
        return Revisits(
            n=len(one),
            elsewhere=float(np.sqrt(apart.mean())),
            bent=0.5 * float(np.sqrt(apart[bent].mean())) if bent.sum() >= _ENOUGH else float("nan"),
            static=float(np.clip(0.5 * (same + opposite) / total, 0.0, 1.0)) if sure else float("nan"),
            memory=float(np.clip(0.5 * (same - opposite) / total, 0.0, 1.0)) if sure else float("nan"),
        )


def _apart(product: Floats, same: Flags, opposite: Flags, first: Ints) -> bool:
    """Whether it is sure that products differ by the way, over stretches of the `first` visits."""
    stretch = first * _STRETCHES // max(int(first.max(initial=0)) + 1, 1)
    every = [stretch == k for k in range(_STRETCHES)]
    off = [
        product[k & same].mean() - product[k & opposite].mean()
        for k in every
        if (k & same).any() and (k & opposite).any()
    ]
    return len(off) >= _STRETCHES // 2 and float(np.mean(off)) > _SURE * float(np.std(off, ddof=1)) / np.sqrt(
        len(off)
    )


def visits(samples: LogSamples, model: Model, theta: Floats) -> Visits:
    """The visits among all samples, by what the effects of `model` make of the commands: a delay, for one,
    is no revisit's matter."""
    every = samples.on(np.arange(len(samples.log)))
    links = effects_at(model, theta)
    length = prepare_log(every, model.robot_at(theta), model.wiring).drive(links).tendon_length
    log = samples.log
    further = (log.ext, log.tip_force, log.payload, log.base_quaternion, samples.session.astype(float))
    inputs = np.column_stack([length, *(np.reshape(a, (len(log), -1)) for a in further if a is not None)])
    size = np.maximum(np.ptp(inputs, axis=0), 1e-12)
    pulled = np.abs(length - model.robot.rest_tendon_length) / size[: length.shape[1]]
    inputs = inputs / size
    rows = _one_after_the_other(inputs, samples.runs)
    rows = rows[:: -(-len(rows) // _MOST)]
    place = np.array([inputs[r].mean(0) for r in rows]).reshape(len(rows), -1)
    off = np.stack([np.abs(place - one).max(axis=1, initial=0.0) for one in place])
    left, came = (_last(off > times * _SAME) for times in (_LEFT, 1.0))
    one, other = np.nonzero(np.triu(off <= _SAME, 1))
    again = (came[one] >= 0) & (left[other] >= one)
    one, other = one[again], other[again]
    direction = place - place[np.maximum(came, 0)]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    bent = np.array([pulled[each[0]].max(initial=0.0) > _BENT for each in rows])
    return Visits(
        np.asarray(log.tip_position),
        tuple(rows),
        np.stack([one, other], axis=1),
        (direction[one] * direction[other]).sum(1),
        bent[one],
    )


def _last(away: Flags) -> Ints:
    """(n,) last visit before each at which a robot was `away` (n, n) from it; -1 where it never was."""
    before = np.tril(away, -1)
    return np.where(before.any(1), len(away) - 1 - np.argmax(before[:, ::-1], axis=1), -1)


def _one_after_the_other(inputs: Floats, runs: tuple[slice, ...]) -> list[Ints]:
    """Samples that stay at one command, cut where they have gone half of what is the same."""
    found = []
    for span in runs:
        first = span.start
        for i in range(span.start + 1, span.stop + 1):
            if i == span.stop or np.abs(inputs[i] - inputs[first]).max(initial=0.0) > 0.5 * _SAME:
                found.append(np.arange(first, i))
                first = i
    return found
