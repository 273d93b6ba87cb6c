"""fastrod beside its peers on the rod of Appendix J, error against time: `fastrod bench peers`, or this file
as a script."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

import appendix_j
import peer_elastica
import peer_fastrod
import peer_mujoco
import peer_pybullet
import peer_scipy
import peer_soromox
from appendix_j import Array
from peer import Build, Peer, Rung
from report import Column, Row, Section, command, note_progress, seconds

PEERS: Sequence[Peer] = (
    peer_fastrod.SETTLE,
    peer_fastrod.STEP,
    peer_scipy.SHOOT,
    peer_scipy.COLLOCATE,
    peer_soromox.PCS,
    peer_soromox.GVS,
    peer_mujoco.FLEX,
    peer_mujoco.BALLS,
    peer_mujoco.HINGES,
    peer_pybullet.EQUAL,
    peer_pybullet.HALVES,
    peer_elastica.PEER,
)
IN_ONE_CALL = ", all loads in one call"
GOAL = 100.0
"""Smaller error at equal time, or times faster at equal error."""
BATCH = 4096
WITHIN = (1e-4, 1e-6)
"""Root mean square tip errors that the batch asks for [m]."""
_SEED = 10
_ENOUGH = 0.3  # s: a solve is repeated for about so long, and its best time counts
_MOST = 20
_SAMPLE = 1.0  # s: about so long is one solve after the other measured, for the time of the batch
_CALL = 7.0  # s: a batch of all that would take longer, solved one by one, is measured with fewer
_FEWEST = 256  # but not with fewer than these


@dataclass(frozen=True)
class Point:
    """A peer at one setting."""

    peer: Peer
    rung: Rung
    error: float
    """Root mean square over the load cases of the distance from the true tip [m]."""
    time: float
    """CPU time of one solve, all threads, the mean over the load cases [s]: on an idle core it is wall
    time."""
    ready: float
    """Wall time of building and of the first solve, compilation included [s]."""


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


def measure(peer: Peer, rung: Rung, force: Array, build: Build | None = None) -> Point:
    """Warm, best of the repeats that fit into the time."""
    start = time.perf_counter()
    with (build or rung.build)() as solve:
        solve(force if build else force[:1])
        ready = time.perf_counter() - start
        least, tips = seconds(lambda: solve(force), time.process_time)
        for _ in range(min(_MOST, int(_ENOUGH / least))):
            least = min(least, seconds(lambda: solve(force), time.process_time)[0])
    return Point(peer, rung, rms(tips, appendix_j.tips(force)), least / len(force), ready)


def front(points: Sequence[Point]) -> list[tuple[float, float]]:
    """(time, error) of the points that no other beats in both, from fast to accurate."""
    kept: list[tuple[float, float]] = []
    for point in sorted(points, key=lambda one: (one.time, one.error)):
        if not kept or point.error < kept[-1][1]:
            kept.append((point.time, point.error))
    return kept


def between(x: float, known: Sequence[float], value: Sequence[float]) -> float:
    """`value` at `x` on a log-log line through the measured points, `known` rising; nan outside of them."""
    if not known[0] <= x <= known[-1]:
        return math.nan
    return float(np.exp(np.interp(math.log(x), np.log(known), np.log(value))))


@dataclass(frozen=True)
class Ratio:
    """How many times better fastrod is; `least`: it is at least this, for the peer lies beyond fastrod's
    measured settings."""

    value: float
    least: bool = False

    def __str__(self) -> str:
        if math.isnan(self.value):
            return "-"
        return f"{'>= ' * self.least}{self.value:,.{0 if self.value >= 10.0 else 2}f}"


def time_ratio(error: float, used: float, own: Sequence[tuple[float, float]]) -> Ratio:
    """Time over that of fastrod at the same error, never beyond fastrod's settings; nan where the peer is the
    more accurate."""
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


def curve_section(points: Sequence[Point], force: Array, left_out: Sequence[str]) -> Section:
    own = front([point for point in points if point.peer.name.startswith(peer_fastrod.SETTLE.name)])
    rows: list[Row] = []
    for point in points:
        row: Row = {
            "peer": point.peer.name,
            "setting": point.rung.label,
            "error_m": point.error,
            "us": 1e6 * point.time,
            "ready_s": point.ready,
        }
        if point.peer.family != "fastrod":
            faster, closer = (
                time_ratio(point.error, point.time, own),
                error_ratio(point.error, point.time, own),
            )
            row |= {
                "time_ratio": faster.value,
                "time_ratio_is_least": faster.least,
                "time_text": str(faster),
                "error_ratio": closer.value,
                "error_ratio_is_least": closer.least,
                "error_text": str(closer),
                "better": best_of(faster, closer),
                "met": best_of(faster, closer) >= GOAL,
            }
        rows.append(row)
    columns = [
        Column("peer", "peer"),
        Column("setting", "setting"),
        Column("error_m", "tip error\nrms [m]", ".1e"),
        Column("us", "us / solve\n1 core", ",.0f"),
        Column("ready_s", "build and\nfirst [s]", ".1f"),
        Column("time_text", "time / fastrod's\nat equal error"),
        Column("error_text", "error / fastrod's\nin equal time"),
        Column("met", f"one of them\n>= {GOAL:.0f}"),
    ]
    notes = [
        f"Static tip of one passive rod under a dead force across it, {len(force)} cases from {force[0]:g} "
        f"to {force[-1]:g} N, "
        "true tips by elliptic integrals. Every solve begins at the straight rod (fastrod, step: where the "
        "case before ended). CPU "
        "time of all threads, the process on one core, warm, mean over the cases, best of several runs; "
        "building and compiling are apart, "
        "in wall time.",
        "Who has a call for many rods is measured both ways, load by load and all of them in one call.",
        "Ratios to `fastrod, settle`, the better of both ways, by lines between its measured settings and "
        "never beyond: `>=` where "
        "fastrod's coarsest is the more accurate already, or its finest the faster; `-` where fastrod was "
        "not measured that accurate, or "
        "not that fast. Below 1 the peer is the better.",
        "A `settle` of one rod hardly gets faster towards coarse settings: most of it is Python around the "
        "kernels, which a batch shares.",
        *left_out,
    ]
    return Section("peers", "Appendix J: error against time", columns, rows, notes)


def best_of(*ratios: Ratio) -> float:
    """The larger one; nan counts as nothing."""
    return max((ratio.value for ratio in ratios if not math.isnan(ratio.value)), default=0.0)


def kinds_section(points: Sequence[Point]) -> Section:
    """One row a peer: the least and the largest of its ratios, and what else there is to know of it."""
    own = front([point for point in points if point.peer.name.startswith(peer_fastrod.SETTLE.name)])
    rows: list[Row] = []
    notes: list[str] = []
    for peer in dict.fromkeys(point.peer for point in points):
        if peer in PEERS:
            notes.append(f"{peer.name} ({peer.versions()}): {peer.same} Besides: {peer.also}")
        mine = [point for point in points if point.peer is peer]
        if peer.family == "fastrod":
            continue
        faster = [time_ratio(point.error, point.time, own) for point in mine]
        closer = [error_ratio(point.error, point.time, own) for point in mine]
        reached = [best_of(*pair) for pair in zip(faster, closer, strict=True)]
        rows.append(
            {
                "peer": peer.name,
                "settings": len(mine),
                "error_m": min(point.error for point in mine),
                "faster": _range(faster),
                "closer": _range(closer),
                "met": sum(value >= GOAL for value in reached),
                "least": min(reached),
                "all_met": min(reached) >= GOAL,
            }
        )
    columns = [
        Column("peer", "peer"),
        Column("settings", "settings", "d"),
        Column("error_m", "least error\nrms [m]", ".1e"),
        Column("faster", "time / fastrod's\nat equal error"),
        Column("closer", "error / fastrod's\nin equal time"),
        Column("met", f"settings where\none is >= {GOAL:.0f}", "d"),
        Column("all_met", "goal met at\nevery setting"),
    ]
    return Section("peers_summary", "Appendix J: the range over each peer's settings", columns, rows, notes)


def _range(ratios: Sequence[Ratio]) -> str:
    known = sorted((ratio for ratio in ratios if not math.isnan(ratio.value)), key=lambda ratio: ratio.value)
    if not known:
        return "-"
    return str(known[0]) if len(known) == 1 else f"{known[0]} to {known[-1]}"


def batch_section(points: Sequence[Point], n: int, within: float) -> Section:
    """Each peer at its coarsest setting that is good enough; those that have none are left out by a
    sentence."""
    force = np.random.default_rng(_SEED).uniform(appendix_j.FORCES[0], appendix_j.FORCES[-1], n)
    rows: list[Row] = []
    failed: list[str] = []
    for peer in dict.fromkeys(
        point.peer for point in points if point.peer in PEERS and point.peer is not peer_fastrod.STEP
    ):
        note_progress(f"{n} robots, {peer.name}")
        mine = [point for point in points if point.peer is peer]
        for point in mine:
            if point.error <= within and _good(row := _batch_row(point, force), within):
                rows.append(row)
                break
        else:
            closest = min(mine, key=lambda point: point.error)
            failed.append(f"{peer.name} ({closest.error:.1e} m in {1e6 * closest.time:,.0f} us)")
    own = next((row["us"] for row in rows if row["peer"] == peer_fastrod.SETTLE.name), None)
    for row in rows:
        if (
            isinstance(own, float)
            and isinstance(row["us"], float)
            and row["peer"] != peer_fastrod.SETTLE.name
        ):
            row["ratio"] = row["us"] / own
    columns = [
        Column("peer", "peer"),
        Column("setting", "setting"),
        Column("how", f"how the {n} were timed"),
        Column("seconds", f"s for {n}\n1 core", ",.3f"),
        Column("us", "us / robot\n1 core", ",.2f"),
        Column("error_m", "tip error\nrms [m]", ".1e"),
        Column("ratio", "ratio to\nfastrod", ",.1f"),
    ]
    notes = [
        f"{n} rods, each with a force of its own (uniform, seed {_SEED}), at rest, from the straight rod. "
        "Each peer at its coarsest "
        f"setting of the first table that is within {within:.0e} m rms, by its own batch (one call) or one "
        "by one, whichever is faster. "
        "`times`: so many were measured, and the time for all is that, extrapolated linearly."
    ]
    if failed:
        notes.append(f"Not that accurate at any measured setting: {', '.join(failed)}.")
    return Section(f"peers_batch_{within:.0e}", f"A batch of {n} within {within:.0e} m", columns, rows, notes)


def _good(row: Row, within: float) -> bool:
    """Other forces than those of the load cases may ask for a finer setting."""
    return isinstance(row["error_m"], float) and row["error_m"] <= within


def _batch_row(point: Point, force: Array) -> Row:
    rung, n = point.rung, len(force)
    sample = min(n, max(2, int(_SAMPLE / point.time)))
    ways = [(measure(point.peer, rung, force[:sample]), sample, "one by one")]
    if rung.together:
        sample = min(n, max(_FEWEST, int(_CALL / point.time)))
        ways.append((measure(point.peer, rung, force[:sample], rung.together), sample, "one call"))
    least, sample, how = min(ways, key=lambda way: way[0].time)
    return {
        "peer": point.peer.name,
        "setting": rung.label,
        "how": how if sample == n else f"{sample:,} {how}, times {n / sample:,.1f}",
        "measured": sample,
        "seconds": least.time * n,
        "us": 1e6 * least.time,
        "error_m": least.error,
    }


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
            turn = drawn[peer.family] = drawn.get(peer.family, -1) + 1
            own = peer.family == "fastrod"
            axes.loglog(
                *zip(*mine, strict=True),
                label=peer.name,
                color=COLOURS[peer.family],
                marker="os^Dvp"[turn],
                linestyle=("-", "--", ":", "-.")[turn % 4],
                linewidth=2.5 if own else 1.3,
                markersize=6 if own else 5,
                zorder=3 if own else 2,
            )
        axes.set_xlabel("time of one solve [µs], one core, warm")
        axes.set_ylabel("tip error, rms over the load cases [m]")
        axes.set_title(
            "Passive rod of Appendix J under a tip force, at rest: further down and left is better",
            fontsize=10,
        )
        axes.grid(which="major", color="0.88")
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False)
        figure.savefig(file, dpi=150)


COLOURS: Mapping[str, str] = {
    "fastrod": "#000000",
    "scipy": "#0072b2",
    "soromox": "#cc79a7",
    "MuJoCo": "#d55e00",
    "PyBullet": "#009e73",
    "PyElastica": "#e69f00",
}
"""Of Okabe and Ito: told apart by the colour-blind; markers and dashes tell the peers of a family apart."""


def sections(options: argparse.Namespace) -> list[Section]:
    """Measure every peer that is installed, and draw."""
    left_out = [sentence for peer in PEERS if (sentence := peer.missing())]
    force = appendix_j.FORCES[::6] if options.quick else appendix_j.FORCES
    points = []
    with one_core():
        for peer in PEERS:
            if peer.missing():
                continue
            if options.quick and peer.family == "soromox":
                left_out.append(
                    f"{peer.name} is left out of a quick run: it takes half a minute to build and to compile."
                )
                continue
            for rung in _measured(peer, options.quick):
                note_progress(f"{peer.name}, {rung.label}")
                points.append(measure(peer, rung, force))
            many = replace(peer, name=peer.name + IN_ONE_CALL)
            points += [
                measure(many, rung, force, rung.together)
                for rung in _measured(peer, options.quick)
                if rung.together
            ]
        batches = [batch_section(points, 64 if options.quick else BATCH, within) for within in WITHIN]
    if options.plot:
        plot(points, options.plot)
    return [curve_section(points, force, left_out), kinds_section(points), *batches]


def _measured(peer: Peer, quick: bool) -> Sequence[Rung]:
    return peer.rungs()[: 2 if quick else None]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_peers", description=__doc__)
    parser.add_argument("--plot", metavar="FILE.png", help="draw error against time")
    return command(parser, argv, sections)


if __name__ == "__main__":
    sys.exit(main())
