"""Contact with a mesh: a step in three states, the search against FCL, and free robots in growing batches."""

from __future__ import annotations

from typing import Any

import numpy as np

import contact_batch as c
from report import Row, Section, bench, goal, note_progress, table, thread_counts

FREE_TARGET, PRESSED_TARGET, FCL_TARGET = 20_000.0, 5_000.0, 50.0
"""Robot-steps a second on two threads, free or grazing and in contact; how many times as fast as FCL, capsule
by capsule."""
STATES = {"free": (c.FAR, FREE_TARGET), "grazing": (c.GRAZING, FREE_TARGET)}
STATES["in contact"] = c.PRESSED, PRESSED_TARGET
"""Gap [m] and target of each."""
ONE, MANY = thread_counts()


def timed_on_each(*given: Any) -> list[c.Timed]:
    """On one thread and on two; batch, obstacle, gap, budget."""
    return [c.run(*given[:3], threads, given[3]) for threads in (ONE, MANY)]


def step_row(state: str, runs: list[c.Timed], n: int) -> Row:
    one, many = runs
    row: Row = {
        "state": state,
        "faces": one.n_faces,
        "rate_one": n / one.step_s,
        "rate_many": n / many.step_s,
    }
    row |= {key: getattr(one, key) for key in ("touching", "contacts", "passes")} | {"gap_m": one.gap}
    return row | {"most_passes": max(one.most_passes, many.most_passes), "not_ok": one.not_ok + many.not_ok}


def query_row(state: str, runs: list[c.Timed], fcl_s: float, n: int) -> Row:
    """The search alone and the whole step against FCL."""
    one, many = runs
    (cold_one, warm_one), (cold_many, warm_many) = ([s / n for s in c.query(run, 3)] for run in runs)
    us = {"fcl_us": fcl_s, "cold_us": cold_one, "warm_us": warm_one}
    ratios = {"cold_ratio": cold_one, "warm_ratio": warm_one, "cold_ratio_many": cold_many}
    ratios |= {"warm_ratio_many": warm_many, "step_ratio": one.step_s / n, "step_ratio_many": many.step_s / n}
    row: Row = {"state": state, "faces": one.n_faces, **{key: 1e6 * s for key, s in us.items()}}
    row |= {key: fcl_s / s for key, s in ratios.items()}
    return row | goal(fcl_s / warm_one, FCL_TARGET, least=True)


def path_row(n: int, level: int) -> Row:
    """Robots in contact with a mesh; FCL measures its distances inside the step, or the compiled search."""
    batch, obstacle = c.make_batch(n), c.make_mesh(level)
    note_progress(f"{n} robots by FCL, {len(obstacle.faces)} faces")
    search, fcl = (c.run(batch, obstacle, c.PRESSED, ONE, 0.0, by) for by in ("bvh", "fcl"))
    force, shape = (
        float(np.abs(getattr(search.last, name) - getattr(fcl.last, name)).max())
        for name in ("base_wrench", "position")
    )
    row: Row = {"robots": n, "faces": search.n_faces, "force": force, "shape": shape}
    row |= {"bvh_us": 1e6 * search.step_s / n, "fcl_us": 1e6 * fcl.step_s / n}
    return row | {"ratio": fcl.step_s / search.step_s, "not_ok": search.not_ok + fcl.not_ok}


def growth_row(n: int, obstacle: Any, budget: float) -> Row:
    note_progress(f"{n} robots")
    batch = c.make_batch(n)
    timed, bare = c.run(batch, obstacle, c.FAR, MANY, budget), c.run(batch, None, 0.0, MANY, budget)
    rate, us = n / timed.step_s, {"us": 1e6 * timed.step_s / n, "bare_us": 1e6 * bare.step_s / n}
    row: Row = {"robots": n, "rate": rate, **us, "ratio": timed.step_s / bare.step_s}
    return row | {"not_ok": timed.not_ok + bare.not_ok} | goal(rate, FREE_TARGET, least=True)


def measure(options: Any) -> list[Section]:
    """Every state with every mesh, the same robots without a scene, and batches of other sizes."""
    quick = options.quick
    n, budget, sample = options.robots or (8 if quick else 128), 0.0 if quick else 0.6, 2 if quick else 24
    batch, queries = c.make_batch(n), []
    bare = timed_on_each(batch, None, 0.0, budget)
    steps = [step_row("no scene", bare, n)]
    for state, (gap, target) in STATES.items():
        for level in (2, 3) if quick else (3, 5, 6):
            obstacle = c.make_mesh(level)
            note_progress(f"{state}, {len(obstacle.faces)} faces")
            runs = timed_on_each(batch, obstacle, gap, budget)
            added = [1e6 * (run.step_s - alone.step_s) / n for run, alone in zip(runs, bare, strict=True)]
            row = step_row(state, runs, n) | {"added_one": added[0], "added_many": added[1]}
            steps.append(row | goal(row["rate_many"], target, least=True))
            fcl_s, queried = c.fcl_seconds(runs[0], obstacle, c.places(batch, gap), sample)
            queries.append(query_row(state, runs, fcl_s, n))
    free = c.make_mesh(2 if quick else 5)
    return [
        table(
            "contact_steps",
            "One step with a mesh beside every robot",
            f"state | faces:,d | rate_one:,.0f steps/s~{ONE} thread | rate_many:,.0f steps/s~{MANY} threads"
            f"| added_one:.1f contact, us~{ONE} thread | added_many:.1f contact, us~{MANY} threads"
            "| touching:.0% in~contact | contacts:.2f contacts~/ step | passes:.2f passes~/ step"
            "| most_passes:d most~passes | gap_m:.1e gap [m]~median | not_ok:d not ok"
            f"| target:,.0f target,~{MANY} threads | met",
            steps,
            f"{n} five-segment robots of 30 intervals, each bent its own way, its mesh in a place of its "
            f"own; the free tip goes {1e3 * batch.travel:.2f} mm a step. Mean over the steps of a swing, "
            "each the best of its rounds where time allowed several.",
            "In contact: fraction of robot-steps; not ok: robot-steps of both runs, the approach included.",
        ),
        table(
            "contact_query",
            "The search against FCL, capsule by capsule",
            f"state | faces:,d | fcl_us:,.0f FCL~us / robot | cold_us:.1f cold, us~{ONE} thread"
            f"| warm_us:.1f warm, us~{ONE} thread | cold_ratio:.0f FCL/cold~{ONE} thread"
            f"| warm_ratio:.0f FCL/warm~{ONE} thread | cold_ratio_many:.0f FCL/cold~{MANY} threads"
            f"| warm_ratio_many:.0f FCL/warm~{MANY} threads | step_ratio:.1f FCL/step~{ONE} thread"
            f"| step_ratio_many:.1f FCL/step~{MANY} threads | target:.0f FCL/warm~target | met",
            queries,
            f"FCL: {queried} robots, capsules of radius 1e-6 m, on one thread: it holds the interpreter's "
            "lock. Capsules and poses are made beforehand; the calls alone are timed. A step with FCL would "
            "ask once a pass.",
            "Search: candidates and smallest gap of every robot, tessellation and minima along the curve "
            "included. Met: the warm search, one thread against one.",
        ),
        table(
            "contact_paths",
            'The same contact by `collision="bvh"` and by `collision="fcl"`',
            "robots:,d | faces:,d | bvh_us:,.0f bvh,~us / step | fcl_us:,.0f fcl,~us / step "
            "| ratio:.1f fcl/bvh | force:.1e force~apart [N] | shape:.1e shape~apart [m] | not_ok:d not ok",
            [path_row(count, level) for count in ((1, 2) if quick else (1, 16, 256)) for level in (3, 5)],
            f"Five segments pressed on a ball, {ONE} thread: FCL is asked under the interpreter's lock.",
        ),
        table(
            "contact_growth",
            f"Free robots beside {len(free.faces):,d} faces",
            f"robots:,d | rate:,.0f robot-steps/s~{MANY} threads | us:.1f us / step~{MANY} threads"
            "| bare_us:.1f without~scene | ratio:.2f | not_ok:d not ok | target:,.0f | met",
            [growth_row(count, free, budget) for count in ((4, n) if quick else (64, 1024, 8192))],
        ),
    ]


main = bench(__doc__, measure, ("--robots", int, "robots of a batch (default 128, with --quick 8)"))
