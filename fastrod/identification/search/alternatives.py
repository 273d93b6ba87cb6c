"""Patterns that no effect of the library makes: patterns that a residual may have for reasons outside the
model.

Each alternative pattern is a few linear columns, some of them found by a scan. They compete with the effects
on the same terms; where one wins, the verdict is that the cause is not in the library, and of which kind it
is. They are never part of "after", but for those that an effect stands for: where such a pattern fits, the
effect is fitted from where the scan has found it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from fastrod.identification.search.linearised import LinearisedModel
from fastrod.types import Floats

_LONG = 20.0  # s, of a run in which something can happen
_TIMES = 48  # change points tried
_ROWS_AROUND = 400  # the best of them, where a time between two rows is sought
_FREQUENCIES = (0.08, 3.0)  # Hz, of a line
_PERIODS = 2.0  # that a log must hold of what is called periodic
_NARROW = 4.0  # lines tried per 1 / duration


@dataclass(frozen=True, eq=False)
class AlternativePattern:
    """A pattern, fitted by its columns."""

    name: str
    kind: str
    """static, memory, drift or exogenous."""
    what: str
    """A sentence on what it looks like."""
    columns: Floats
    """(n, n_out, k) over sigma."""
    n_hidden: int
    """Parameters that a scan has chosen, beside the k amplitudes."""
    start: Mapping[str, float] | None = None
    """Start of the fit of the effect of the same name; None where none stands for it in this log."""
    drive: int | None = None
    """The one drive that has the effect, from 0 on."""
    n_tried: int = 1
    """Patterns of which this one was chosen: the more there are, the better the best of them fits noise."""


def alternatives(linearised: LinearisedModel, tangent: Floats, residual: Floats) -> list[AlternativePattern]:
    """The best of each family for a residual (n, n_out) that `tangent` (n, n_out, p) can absorb part of."""
    solver = _Projected(tangent, residual)
    found = []
    families = [_ripple(linearised), _contact(linearised), _attraction(linearised), _patch(linearised)]
    # short runs have no history of their own
    if all(linearised.samples.time[span].max() > _LONG for span in linearised.samples.runs):
        families += [_bump(linearised), _slip(linearised, solver), _sway(linearised, residual)]
    for family in families:
        best: tuple[float, AlternativePattern] | None = None
        tried = 0
        for alternative in family:
            tried += alternative.n_tried
            loss = solver.loss(alternative.columns)
            if best is None or loss < best[0]:
                best = loss, alternative
        if best is not None:
            found.append(replace(best[1], n_tried=tried))
    return found


class _Projected:
    """Least-squares losses of many column sets beside one tangent space."""

    def __init__(self, tangent: Floats, residual: Floats) -> None:
        flat = tangent.reshape(residual.size, tangent.shape[-1])
        self._q = np.linalg.qr(flat)[0] if flat.shape[1] else np.zeros((residual.size, 0))
        r = residual.ravel()
        self._r = r - self._q @ (self._q.T @ r)
        self.start = float(self._r @ self._r)

    def loss(self, columns: Floats) -> float:
        C = columns.reshape(len(self._r), -1)
        C = C - self._q @ (self._q.T @ C)
        gram = C.T @ C
        b = C.T @ self._r
        ridge = 1e-9 * np.trace(gram) + 1e-12
        return self.start - float(b @ np.linalg.solve(gram + ridge * np.eye(len(gram)), b))


def _sensed(linearised: LinearisedModel, change: Floats) -> Floats:
    """(n, n_out, k) weighted columns of changes of the seen tip (n, 3, k) [m]."""
    return _weighted(
        linearised,
        np.concatenate(
            [change, np.zeros((len(change), 3 + 3 * linearised.pose.points.shape[1], change.shape[2]))],
            axis=1,
        ),
    )


def _weighted(linearised: LinearisedModel, change: Floats) -> Floats:
    """(n, n_out, k) weighted from changes of the pose (n, 6 + 3k', k)."""
    target = linearised.target
    blocks = [change[:, :3] / target.sigma[:, None]]
    if target.rotation is not None:
        blocks.append(change[:, 3:6] / target.rotation_sigma)
    if target.points.shape[1]:
        blocks.append(change[:, 6:] / np.tile(target.sigma, target.points.shape[1])[:, None])
    return np.asarray(np.concatenate(blocks, axis=1) * (target.weight > 0.0)[:, None, None])


def _log_time(linearised: LinearisedModel) -> Floats:
    """(n_rows,) time, runs one after the other [s]."""
    samples = linearised.samples
    return np.cumsum(samples.dt)[samples.rows]


def _when(linearised: LinearisedModel, at: float) -> str:
    """A moment of `_log_time` in the log's own time, with its run where there are several."""
    samples = linearised.samples
    row = int(samples.rows[int(np.argmax(_log_time(linearised) > at))])
    run = f" of run {str(samples.log.run[row])!r}" if len(samples.runs) > 1 else ""
    return f"{samples.log.t[row]:.1f} s{run}"


def _bump(linearised: LinearisedModel) -> Iterator[AlternativePattern]:
    t = _log_time(linearised)
    for at in np.quantile(t, np.linspace(0.03, 0.97, _TIMES)):
        step = (t > at).astype(float)
        columns = _sensed(linearised, step[:, None, None] * np.eye(3)[None])
        yield AlternativePattern(
            "bump",
            "drift",
            f"the measured tip jumps at {_when(linearised, at)} and stays: base or camera was moved",
            columns,
            1,
        )


def _slip(linearised: LinearisedModel, solver: _Projected) -> Iterator[AlternativePattern]:
    """The best drive and time: of some times, then of every row around the best."""
    wiring, t = linearised.model.wiring, _log_time(linearised)
    if not wiring.n_tendons:
        return
    pulls = [np.where(wiring.drive == drive, wiring.drive_sign, 0.0) for drive in range(wiring.n_drives)]
    responses = [_weighted(linearised, (linearised.by_length @ pull)[..., None]) for pull in pulls]

    def loss(at: float, drive: int) -> float:
        return solver.loss(responses[drive] * (t > at)[:, None, None])

    coarse = np.quantile(t, np.linspace(0.03, 0.97, _TIMES))
    _, k, drive = min((loss(at, d), k, d) for k, at in enumerate(coarse) for d in range(wiring.n_drives))
    low, high = coarse[max(k - 1, 0)], coarse[min(k + 1, _TIMES - 1)]
    between = 0.5 * (t[1:] + t[:-1])
    fine = between[(between > low) & (between < high)][:_ROWS_AROUND]
    at = float(min([coarse[k], *fine], key=lambda time: loss(time, drive)))
    one_run = len(linearised.samples.runs) == 1
    yield AlternativePattern(
        "slip",
        "drift",
        f"the zero of drive {drive + 1} jumps at {_when(linearised, at)}: its tendon slipped",
        responses[drive] * (t > at)[:, None, None],
        2,
        {"at": at} if one_run else None,  # a time of a run is of that run alone
        drive if one_run and wiring.n_drives > 1 else None,
        (_TIMES + len(fine)) * wiring.n_drives,
    )


def _sway(linearised: LinearisedModel, residual: Floats) -> Iterator[AlternativePattern]:
    t = _log_time(linearised)
    duration = float(np.ptp(t))
    if duration < 4.0 or len(t) < 32:
        return
    step = float(np.median(np.diff(t)))
    top = min(_FREQUENCIES[1], 0.45 / max(step, 1e-9))
    longest = max(float(np.ptp(linearised.samples.time[span])) for span in linearised.samples.runs)
    frequencies = np.arange(max(_FREQUENCIES[0], _PERIODS / longest), top, 1.0 / (_NARROW * duration))
    if not len(frequencies):
        return
    wave = np.exp(-2j * np.pi * frequencies[:, None] * t[None])
    power = (np.abs(wave @ residual[:, :3]) ** 2).sum(1)
    for f in frequencies[np.argsort(power)[::-1][:3]]:
        for fine in f + np.array([-0.5, 0.0, 0.5]) / (_NARROW * duration):
            angle = 2.0 * np.pi * fine * t
            both = np.stack([np.sin(angle), np.cos(angle)], axis=1)
            columns = _sensed(
                linearised, (both[:, None, :, None] * np.eye(3)[None, :, None, :]).reshape(len(t), 3, 6)
            )
            yield AlternativePattern(
                "sway",
                "exogenous",
                f"a line at {fine:.3f} Hz that no input has: the base or the camera sways",
                columns,
                1,
                n_tried=len(frequencies),
            )


def _ripple(linearised: LinearisedModel) -> Iterator[AlternativePattern]:
    wiring = linearised.model.wiring
    if not wiring.n_tendons or wiring.by_tension:
        return
    dl = linearised.prepared.dl[linearised.prepared.samples.rows]
    span = float(np.ptp(dl, axis=0).max())
    if span <= 0.0:
        return
    for wavelength in span / np.arange(0.75, 16.0, 0.25):
        blocks = []
        for drive in range(wiring.n_drives):
            pull = np.where(wiring.drive == drive, wiring.drive_sign, 0.0)
            angle = 2.0 * np.pi * dl[:, int(np.flatnonzero(wiring.drive == drive)[0])] / wavelength
            response = linearised.by_length @ pull
            blocks += [response * np.sin(angle)[:, None], response * np.cos(angle)[:, None]]
        periods = span / wavelength
        name = "ripple"
        what = f"periodic in the tendons with {1e3 * wavelength:.2f} mm: an eccentric drum or a gear"
        if periods < _PERIODS:  # as many other laws look
            name = "wave"
            what = f"a wave of which the log covers {periods:.2g} periods, too few to name a cause"
        yield AlternativePattern(name, "static", what, _weighted(linearised, np.stack(blocks, axis=-1)), 1)


def _contact(linearised: LinearisedModel) -> Iterator[AlternativePattern]:
    """One-sided push along n where the tip goes beyond a plane n . x = c."""
    tip = linearised.pose.position
    angle = np.arange(24) * np.pi / 12.0
    directions = [
        np.array([np.cos(a) * c, np.sin(a) * c, z]) for a, (c, z) in product(angle, ((1.0, 0.0), (0.8, -0.6)))
    ]
    for n in directions:
        along = tip @ n
        for fraction in (0.5, 0.65, 0.75, 0.85, 0.93):
            beyond = np.maximum(along - np.quantile(along, fraction), 0.0)
            if beyond.max() <= 0.0:
                continue
            columns = _sensed(linearised, (beyond[:, None] * n)[..., None])
            yield AlternativePattern(
                "contact",
                "static",
                f"one-sided, where the tip goes beyond a plane towards {np.round(n, 2).tolist()}: it "
                "touches something",
                columns,
                3,
            )


def _attraction(linearised: LinearisedModel) -> Iterator[AlternativePattern]:
    """A force towards a fixed point, as a magnet's."""
    tip = linearised.pose.position
    extent = float(np.quantile(np.linalg.norm(tip - tip.mean(0), axis=1), 0.98)) + 1e-9
    base = linearised.prepared.base_rotation
    for a, far, height in product(np.arange(12) * np.pi / 6.0, (1.2, 1.6, 2.2), (-0.4, 0.2)):
        place = tip.mean(0) + extent * np.array([far * np.cos(a), far * np.sin(a), height])
        offset = place - tip
        d2 = (offset**2).sum(1) + (0.3 * extent) ** 2
        force = offset / d2[:, None] ** 1.5 * extent**2
        world = np.einsum("nij,nj->ni", np.broadcast_to(base, (len(tip), 3, 3)), force)
        columns = _weighted(linearised, np.einsum("nij,nj->ni", linearised.by_force, world)[..., None])
        yield AlternativePattern(
            "attraction",
            "static",
            f"a pull towards a point near {np.round(1e3 * place).tolist()} mm: a magnet or a spring",
            columns,
            4,
        )


def _patch(linearised: LinearisedModel) -> Iterator[AlternativePattern]:
    """Something in one corner of the workspace only."""
    tip = linearised.pose.position[:, :2]
    extent = float(np.quantile(np.linalg.norm(tip - tip.mean(0), axis=1), 0.98)) + 1e-9
    for a, far, width in product(np.arange(12) * np.pi / 6.0, (0.5, 1.0), (0.35, 0.6)):
        place = tip.mean(0) + extent * far * np.array([np.cos(a), np.sin(a)])
        near = np.exp(-0.5 * ((tip - place) ** 2).sum(1) / (width * extent) ** 2)
        columns = _sensed(linearised, near[:, None, None] * np.eye(3)[None])
        yield AlternativePattern(
            "patch",
            "static",
            f"confined to the workspace around {np.round(1e3 * place).tolist()} mm",
            columns,
            3,
        )
