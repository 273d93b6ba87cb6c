"""fastrod beside its peers on the rod of Appendix J, error against time."""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import appendix_j
import peer_elastica
import peer_fastrod
import peer_mujoco
import peer_pybullet
import peer_scipy
import peer_soromox
from appendix_j import Array, Build, Peer, Rung
from report import Measurement, Row, Section, bench, note_progress, table

PEERS: Sequence[Peer] = (
    *(peer_fastrod.SETTLE, peer_fastrod.STEP, peer_scipy.SHOOT, peer_scipy.COLLOCATE),
    *(peer_soromox.PCS, peer_soromox.GVS, peer_mujoco.FLEX, peer_mujoco.BALLS, peer_mujoco.HINGES),
    *(peer_pybullet.EQUAL, peer_pybullet.HALVES, peer_elastica.PEER),
)
IN_ONE_CALL = ", all loads in one call"
GOAL = 100.0  # times as small an error at equal time, or times faster at equal error
BATCH = 4096
WITHIN = (1e-4, 1e-6)  # m, root mean square tip errors that the batch asks for
_SEED = 10
_ENOUGH = 0.3  # s: a solve is repeated for about so long, and its best time counts
_MOST = 20
_SAMPLE = 1.0  # s: about so long is one solve after the other measured, for the time of the batch
_CALL = 7.0  # s: a batch of all that would take longer, solved one by one, is measured with fewer
_FEWEST = 256  # but not with fewer than these


class Point(NamedTuple):
    """A peer at one setting."""

    peer: Peer
    rung: Rung
    error: float  # m, root mean square over the load cases of the distance from the true tip
    time: float  # s of CPU, all threads, mean over the load cases: on an idle core it is wall time
    ready: float  # s of wall time to build and to solve for the first time, compilation included


@contextmanager
def one_core() -> Iterator[None]:
    """This process on one core, so that no library has two threads' work done at once."""
    if sys.platform != "linux":
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def rms(tips: Array, truth: Array) -> float:
    """Root mean square distance of tips (n, 2) [m]."""
    return float(np.sqrt(np.mean(np.sum((tips - truth) ** 2, axis=1))))


def timed(peer: Peer, rung: Rung, force: Array, build: Build | None = None) -> Point:
    """Warm, best of the repeats that fit into the time."""
    start, used = time.perf_counter(), Measurement(time.process_time)
    with (build or rung.build)() as solve:
        solve(force if build else force[:1])
        ready = time.perf_counter() - start
        tips = used.take(partial(solve, force))
        for _ in range(min(_MOST, int(_ENOUGH / used.least))):
            used.take(partial(solve, force))
    return Point(peer, rung, rms(tips, appendix_j.tips(force)), used.least / len(force), ready)


def front(points: Sequence[Point]) -> list[tuple[float, float]]:
    """(time, error) of the points that no other beats in both, from fast to accurate."""
    kept: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda one: (one.time, one.error)):
        if not kept or point.error < kept[-1][1]:
            kept.append((point.time, point.error))
    return kept


def own_front(points: Sequence[Point]) -> list[tuple[float, float]]:
    """Return the Pareto front of `fastrod, settle`, the better of both calls."""
    return front([point for point in points if point.peer.name.startswith(peer_fastrod.SETTLE.name)])


def between(x: float, known: Sequence[float], value: Sequence[float]) -> float:
    """`value` at `x` on a log-log line through the measured points, `known` rising; nan outside of them."""
    inside = known[0] <= x <= known[-1]
    return float(np.exp(np.interp(math.log(x), np.log(known), np.log(value)))) if inside else math.nan


@dataclass(frozen=True)
class Ratio:
    """Ratio of fastrod's figure to another's; `least`: it is at least this, for the peer lies beyond
    fastrod's measured settings."""

    value: float
    least: bool = False

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "-"
        return f"{'>= ' * self.least}{self.value:,.{0 if self.value >= 10.0 else 2}f}"


def time_ratio(error: float, used: float, own: Sequence[tuple[float, float]]) -> Ratio:
    """Time over that of fastrod at the same error, never beyond fastrod's settings; nan where the peer is
    the more accurate."""
    if error >= own[0][1]:
        return Ratio(used / own[0][0], least=True)
    times, errors = zip(*reversed(own), strict=True)
    return Ratio(used / between(error, errors, times))


def error_ratio(error: float, used: float, own: Sequence[tuple[float, float]]) -> Ratio:
    """Error over that of fastrod in the same time; nan where fastrod needs longer even at its coarsest."""
    if used >= own[-1][0]:
        return Ratio(error / own[-1][1], least=True)
    times, errors = zip(*own, strict=True)
    return Ratio(error / between(used, times, errors))


def both_ratios(point: Point, own: Sequence[tuple[float, float]]) -> tuple[Ratio, Ratio, float]:
    """Return the ratios of time and of error, and the larger one; nan counts as nothing."""
    ratios = time_ratio(*point[2:4], own), error_ratio(*point[2:4], own)
    return *ratios, max((ratio.value for ratio in ratios if not math.isnan(ratio.value)), default=0.0)


def curve_section(points: Sequence[Point], force: Array, left_out: Sequence[str]) -> Section:
    own, rows = own_front(points), []
    for point in points:
        row: Row = {"peer": point.peer.name, "setting": point.rung.label, "error_m": point.error}
        row |= {"us": 1e6 * point.time, "ready_s": point.ready}
        if point.peer.family != "fastrod":
            *ratios, better = both_ratios(point, own)
            for name, ratio in zip(("time", "error"), ratios, strict=True):
                row |= {f"{name}_ratio": ratio.value, f"{name}_ratio_is_least": ratio.least}
                row[f"{name}_text"] = str(ratio)
            row |= {"better": better, "met": better >= GOAL}
        rows.append(row)
    return table(
        "peers",
        "Appendix J: error against time",
        "peer | setting | error_m:.1e tip error~rms [m] | us:,.0f us / solve~1 core"
        "| ready_s:.1f build and~first [s] | time_text time / fastrod's~at equal error"
        f"| error_text error / fastrod's~in equal time | met one of them~>= {GOAL:.0f}",
        rows,
        f"Static tip of one passive rod under a dead force across it, {len(force)} cases from {force[0]:g} "
        f"to {force[-1]:g} N, true tips by elliptic integrals. Every solve begins at the straight rod "
        "(fastrod, step: where the case before ended). CPU time of all threads, the process on one core, "
        "warm, mean over the cases, best of several runs; building and compiling are apart, in wall time. A "
        "peer that has a call for many rods is measured both ways.",
        "Ratios to `fastrod, settle`, the better of both ways, by lines between its measured settings and "
        "never beyond: `>=` where fastrod's coarsest is the more accurate already, or its finest the faster; "
        "`-` where fastrod was not measured that accurate, or not that fast. Below 1 the peer is the better. "
        "A `settle` of one rod hardly gets faster towards coarse settings: most of it is Python around the "
        "kernels, which a batch divides among its robots.",
        *left_out,
    )


def kinds_section(points: Sequence[Point]) -> Section:
    """One row a peer: the least and the largest of its ratios, and what else there is to know of it."""
    own, rows, notes = own_front(points), [], []
    for peer in dict.fromkeys(point.peer for point in points):
        mine = [point for point in points if point.peer is peer]
        if peer in PEERS:
            notes.append(f"{peer.name} ({peer.versions()}): {peer.same} Besides: {peer.also}")
        if peer.family == "fastrod":
            continue
        faster, closer, better = zip(*(both_ratios(point, own) for point in mine), strict=True)
        row: Row = {"peer": peer.name, "settings": len(mine), "error_m": min(point.error for point in mine)}
        row |= {"faster": _range(faster), "closer": _range(closer), "least": min(better)}
        rows.append(row | {"met": sum(value >= GOAL for value in better), "all_met": min(better) >= GOAL})
    return table(
        "peers_summary",
        "Appendix J: the range over each peer's settings",
        "peer | settings:d | error_m:.1e least error~rms [m] | faster time / fastrod's~at equal error"
        f"| closer error / fastrod's~in equal time | met:d settings where~one is >= {GOAL:.0f}"
        "| all_met goal met at~every setting",
        rows,
        *notes,
    )


def _range(ratios: Sequence[Ratio]) -> str:
    known = sorted((ratio for ratio in ratios if not math.isnan(ratio.value)), key=lambda ratio: ratio.value)
    return " to ".join(dict.fromkeys(str(ratio) for ratio in (known[:1] + known[-1:]))) or "-"


def batch_section(points: Sequence[Point], n: int, within: float) -> Section:
    """Each peer at its coarsest setting that is good enough; where none is, a sentence says so."""
    force = np.random.default_rng(_SEED).uniform(appendix_j.FORCES[0], appendix_j.FORCES[-1], n)
    rows: list[Row] = []
    failed: list[str] = []
    for peer in PEERS:
        mine = [point for point in points if point.peer is peer]
        if not mine or peer is peer_fastrod.STEP:
            continue
        note_progress(f"{n} robots, {peer.name}")
        tried = (_batch_row(point, force) for point in mine if point.error <= within)
        # other forces than those of the load cases may ask for a finer setting
        if row := next((row for row in tried if row["error_m"] <= within), None):
            own = rows[0]["us"] if rows and rows[0]["peer"] == peer_fastrod.SETTLE.name else None
            rows.append(row | ({"ratio": row["us"] / own} if own else {}))
        else:
            closest = min(mine, key=lambda point: point.error)
            failed.append(f"{peer.name} ({closest.error:.1e} m in {1e6 * closest.time:,.0f} us)")
    return table(
        f"peers_batch_{within:.0e}",
        f"A batch of {n} within {within:.0e} m",
        f"peer | setting | how how the {n} were timed | seconds:,.3f s for {n}~1 core | us:,.2f us / robot~1 "
        "core| error_m:.1e tip error~rms [m] | ratio:,.1f ratio to~fastrod",
        rows,
        f"{n} rods, each with a force of its own (uniform, seed {_SEED}), at rest, from the straight rod. "
        f"Each peer at its coarsest setting of the first table that is within {within:.0e} m rms, by its own "
        "batch (one call) or one by one, whichever is faster. `times`: so many were measured, extrapolated "
        "linearly to all.",
        *([f"Not that accurate at any measured setting: {', '.join(failed)}."] if failed else []),
    )


def _batch_row(point: Point, force: Array) -> Row:
    rung, n = point.rung, len(force)
    sample = min(n, max(2, int(_SAMPLE / point.time)))
    calls = [(timed(point.peer, rung, force[:sample]), sample, "one by one")]
    if rung.together:
        sample = min(n, max(_FEWEST, int(_CALL / point.time)))
        calls.append((timed(point.peer, rung, force[:sample], rung.together), sample, "one call"))
    least, sample, how = min(calls, key=lambda call: call[0].time)
    how = how if sample == n else f"{sample:,} {how}, times {n / sample:,.1f}"
    row: Row = {"peer": point.peer.name, "setting": rung.label, "how": how, "measured": sample}
    return row | {"seconds": least.time * n, "us": 1e6 * least.time, "error_m": least.error}


def plot(points: Sequence[Point], file: str) -> None:
    """Error against time of every peer, log-log."""
    import matplotlib as mpl
    from matplotlib.figure import Figure

    with mpl.rc_context({"font.size": 9}):
        figure = Figure(figsize=(9.5, 6.0), layout="constrained")
        axes = figure.subplots()
        drawn: dict[str, int] = {}
        for peer in dict.fromkeys(point.peer for point in points):
            mine = [(point.time * 1e6, point.error) for point in points if point.peer is peer]
            k = drawn[peer.family] = drawn.get(peer.family, -1) + 1
            looks = {"color": COLOURS[peer.family], "marker": "os^Dvp"[k], "label": peer.name}
            looks |= {"linewidth": 2.5, "zorder": 3} if peer.family == "fastrod" else {"linewidth": 1.3}
            axes.loglog(*zip(*mine, strict=True), linestyle=("-", "--", ":", "-.")[k % 4], **looks)
        axes.set_xlabel("time of one solve [µs], one core, warm")
        axes.set_ylabel("tip error, rms over the load cases [m]")
        title = "Passive rod of Appendix J under a tip force, at rest: further down and left is better"
        axes.set_title(title, fontsize=10)
        axes.grid(which="major", color="0.88")
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
        figure.savefig(file, dpi=150)


COLOURS = {"fastrod": "#000000", "scipy": "#0072b2", "soromox": "#cc79a7", "MuJoCo": "#d55e00"}
COLOURS |= {"PyBullet": "#009e73", "PyElastica": "#e69f00"}
"""Of Okabe and Ito: distinct for the colour-blind; markers and dashes distinguish the peers of a family."""


def measure(options: Any) -> list[Section]:
    """Measure every peer that is installed, and draw."""
    left_out = [sentence for peer in PEERS if (sentence := peer.missing())]
    force = appendix_j.FORCES[::6] if options.quick else appendix_j.FORCES
    points = []
    with one_core():
        for peer in (peer for peer in PEERS if not peer.missing()):
            if options.quick and peer.family == "soromox":
                left_out.append(f"{peer.name} is left out of a quick run: it takes half a minute to compile.")
                continue
            rungs = peer.rungs[: 2 if options.quick else None]
            for rung in rungs:
                note_progress(f"{peer.name}, {rung.label}")
                points.append(timed(peer, rung, force))
            many = replace(peer, name=peer.name + IN_ONE_CALL)
            points += [timed(many, rung, force, rung.together) for rung in rungs if rung.together]
        batches = [batch_section(points, 64 if options.quick else BATCH, within) for within in WITHIN]
    if options.plot:
        plot(points, options.plot)
    return [curve_section(points, force, left_out), kinds_section(points), *batches]


main = bench(__doc__, measure, ("--plot", str, "draw error against time into this .png"))
