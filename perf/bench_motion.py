"""fastrod beside its peers on a rod that is pulled aside and let go: tip error against time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

import peer_elastica
import peer_mujoco
import peer_soromox
import release
from appendix_j import Array, Build, Peer, Rung
from bench_peers import Point, Ratio, front, one_core, time_ratio
from report import Measurement, Row, Section, bench, note_progress, table

PEERS: Sequence[Peer] = (
    *(release.PEER, peer_elastica.RELEASED, peer_soromox.PCS_RELEASED, peer_soromox.GVS_RELEASED),
    *(peer_mujoco.FLEX_RELEASED, peer_mujoco.BALLS_RELEASED, peer_mujoco.HINGES_RELEASED),
)
GOALS = {"PyElastica": 100.0, "soromox": 10.0, "MuJoCo": 10.0}  # times faster at equal error
BATCH = 256
_DIFFERENT = 8  # forces of a batch: so many reference motions
_ENOUGH, _MOST = 1.0, 10  # a motion is repeated for about so long [s], and its best time counts
_ONE = np.array([release.FORCE])


def forces(n: int) -> Array:
    """(n,) most tip forces of a batch [N]: from half of the one to all of it, over and over."""
    return np.resize(release.FORCE * np.linspace(0.5, 1.0, _DIFFERENT), n)


def error(tips: Array, force: Array) -> float:
    """Root mean square distance from the reference over rods and times [m]."""
    distinct = tuple(dict.fromkeys(force.tolist()))
    truth = release.reference(distinct)[[distinct.index(f) for f in force.tolist()]]
    return float(np.sqrt(np.mean(np.sum((tips - truth) ** 2, axis=-1))))


def timed(peer: Peer, rung: Rung, force: Array, build: Build) -> Point:
    """Warm, best of the repeats that fit into the time; CPU time a rod."""
    start, used = time.perf_counter(), Measurement(time.process_time)
    with build() as solve:
        solve(force)
        ready = time.perf_counter() - start
        tips = used.take(partial(solve, force))
        for _ in range(min(_MOST, int(_ENOUGH / used.least))):
            used.take(partial(solve, force))
    return Point(peer, rung, error(tips, force), used.least / len(force), ready)


def _judged(point: Point, own: Sequence[Point]) -> Row:
    """The ratio of time at equal error, beside its goal."""
    if point.peer.family not in GOALS:
        return {}
    ratio, target = time_ratio(point.error, point.time, front(own)), GOALS[point.peer.family]
    row: Row = {"ratio": ratio.value, "ratio_is_least": ratio.least, "ratio_text": str(ratio)}
    return row | {"target": target, "met": ratio.value >= target}


_COLUMNS = (
    "peer | setting | how | error_m:.1e tip error~rms [m] | ms:,.2f ms / rod~1 core | ready_s:.1f build "
    "and~first [s]| ratio_text time / fastrod's~at equal error | target:,.0f target~at least | met"
)


def _section(key: str, title: str, points: Sequence[tuple[Point, str]], *notes: str) -> Section:
    own = [point for point, _ in points if point.peer is release.PEER]
    rows: list[Row] = []
    for point, how in points:
        row: Row = {"peer": point.peer.name, "setting": point.rung.label, "how": how, "error_m": point.error}
        row |= {"ms": 1e3 * point.time, "ready_s": point.ready}
        rows.append(row | _judged(point, own))
    return table(key, title, _COLUMNS, rows, *notes)


def singles(peers: Sequence[Peer], most: int | None) -> list[tuple[Point, str]]:
    found = []
    for peer in peers:
        for rung in peer.rungs[:most]:
            note_progress(f"{peer.name}, {rung.label}")
            found.append((timed(peer, rung, _ONE, rung.build), "one"))
    return found


def batched(points: Sequence[tuple[Point, str]], n: int) -> list[tuple[Point, str]]:
    """Every setting in one call of n rods, or of as many as some seconds allow; without such a call one after
    the other."""
    found = []
    for point, _ in points:
        peer, rung = point.peer, point.rung
        note_progress(f"{n} rods, {peer.name}, {rung.label}")
        # rods of modes run 16 to a chunk, so that fewer would say nothing of a batch
        fits = n if peer is release.PEER else max(1, min(n, int(8.0 / point.time)))
        if rung.together is None:
            fits = min(fits, 2)
        many = timed(peer, rung, forces(n)[-fits:], rung.together or rung.build)
        found.append((many, f"{fits} {'in one call' if rung.together else 'one by one'}"))
    return found


def _again(tips: Array) -> str:
    """Return how far the reference is from one of twice its steps."""
    (coarse,) = release.reference((release.FORCE,), 1e-4)
    return f"{float(np.sqrt(np.mean(np.sum((tips - coarse) ** 2, axis=-1)))):.0e}"


def measure(options: Any) -> list[Section]:
    """Measure every peer that is installed."""
    left_out = [sentence for peer in PEERS if (sentence := peer.missing())]
    peers = [peer for peer in PEERS if not peer.missing()]
    if options.quick:
        left_out += [f"{p.name} is left out of a quick run: it compiles long." for p in peers if _slow(p)]
        peers = [peer for peer in peers if not _slow(peer)]
    n = 16 if options.quick else BATCH
    with one_core():
        alone = singles(peers, 2 if options.quick else None)
        together = batched(alone, n)
    closest = min(
        (point for point, _ in alone if point.peer is not release.PEER), key=lambda p: p.error, default=None
    )
    agreed = f" Nearest to it of the peers: {closest.peer.name} ({closest.error:.0e} m)." if closest else ""
    deflection = float(release.reference((release.FORCE,))[0, :, 0].max())
    return [
        _section(
            "motion",
            "A rod pulled aside and let go, one at a time: error against time",
            alone,
            f"Clamped rod of {release.LENGTH:g} m, EI {release.BENDING:g} N m^2, {release.DENSITY:g} kg/m, "
            f"radius {release.RADIUS:g} m, inextensible, without damping and weight; tip force "
            f"{release.FORCE:g} N sin^2(pi t / {release.PULL:g} s), then none, until {release.END:g} s; the "
            f"tip goes {deflection:.3f} m to the side. Error: over the tips every {1e3 * release.EVERY:g} ms "
            "against fastrod's 7 modes with dt 0.05 and 0.1 ms, extrapolated; "
            f"{_again(release.reference((release.FORCE,))[0])} m from that of twice the steps.{agreed}",
            "CPU time of all threads for the whole motion, the process on one core, warm, best of several; "
            "building and compiling are apart, in wall time. Ratio: by lines between fastrod's settings and "
            "never beyond (`>=`: its coarsest is the more accurate already); `-`: fastrod was not measured "
            "that accurate. Below 1 the peer is the faster. fastrod computes 16 rods side by side, so that "
            "one alone costs nearly as much.",
            *left_out,
        ),
        _section(
            "motion_batch",
            f"A batch of {n}, each with a force of its own",
            together,
            f"Forces from {0.5 * release.FORCE:g} to {release.FORCE:g} N; each peer in its own call for many "
            "rods, where it has one; where all would take many seconds fewer are measured, as `how` says. "
            "Time a rod.",
        ),
        _kinds(alone, together),
    ]


def _slow(peer: Peer) -> bool:
    return peer.family == "soromox" or peer is peer_mujoco.FLEX_RELEASED


def _kinds(alone: Sequence[tuple[Point, str]], together: Sequence[tuple[Point, str]]) -> Section:
    """One row a peer: the range of its ratios, one at a time and in a batch."""
    rows: list[Row] = []
    notes = []
    for peer in dict.fromkeys(point.peer for point, _ in alone):
        notes.append(f"{peer.name} ({peer.versions()}): {peer.same} Besides: {peer.also}")
        if peer is release.PEER:
            continue
        row: Row = {"peer": peer.name, "target": GOALS[peer.family]}
        for name, points in (("one", alone), ("batch", together)):
            own = front([point for point, _ in points if point.peer is release.PEER])
            mine = [time_ratio(point.error, point.time, own) for point, _ in points if point.peer is peer]
            known = sorted((r for r in mine if r.value == r.value), key=lambda r: r.value)
            row[name] = " to ".join(dict.fromkeys(map(str, known[:1] + known[-1:]))) or str(Ratio(np.nan))
            row[f"{name}_met"] = bool(known) and known[0].value >= GOALS[peer.family]
        rows.append(row)
    return table(
        "motion_summary",
        "The range over each peer's settings",
        "peer | one time / fastrod's~one at a time | one_met met at~every setting | batch time / "
        "fastrod's~in a batch| batch_met met at~every setting | target:,.0f target~at least",
        rows,
        *notes,
    )


main = bench(__doc__, measure)
