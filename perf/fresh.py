"""Measurements in a fresh process, which is this module as a script: memory, and the time to start."""

from __future__ import annotations

import dataclasses
import json
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from report import Row, Section, goal, in_fresh_process, note_progress, table, thread_counts

MEMORY_TARGET = 2000.0  # bytes per five-segment robot beside its inputs


def memory_section(n_robots: int) -> Section:
    note_progress("memory")
    each = {key: value / n_robots for key, value in in_fresh_process(__file__, ["memory", n_robots]).items()}
    held, resident = each["memory"] + each["state"], each["resident"]
    rows: list[Row] = [
        {"what": "observer's memory", "bytes": each["memory"]},
        {"what": "state that a step returns", "bytes": each["state"]},
        {"what": "both, sum of nbytes", "bytes": held, **goal(held, MEMORY_TARGET)},
        {"what": "process after ten steps, beside the inputs", "bytes": resident}
        | goal(resident, MEMORY_TARGET),
        {"what": "its peak in a cold start", "bytes": each["peak"]},
        {"what": "the inputs themselves", "bytes": each["inputs"]},
    ]
    threads = thread_counts()[1]
    note = f"{n_robots} robots five_segment_reacher, outputs='tip', f64, {threads} threads, own process."
    return table("memory", "Memory", "what | bytes:,.0f bytes / robot | target:,.0f | met", rows, note)


def _resident(name: str) -> float:
    """VmRSS or VmHWM of this process [bytes]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next((1024.0 * float(line.split()[1]) for line in lines if line.startswith(name)), float("nan"))


def _memory(n_robots: int) -> dict[str, float]:
    import cases
    from fastrod import Simulator, load_robot

    robot = load_robot("five_segment_reacher")
    rng = np.random.default_rng(2)
    warm = Simulator(robot, 256, points_per_segment=6, outputs="tip")
    for _ in range(3):  # kernels and libraries come into memory
        warm.step(robot.rest_tendon_length, tip_force=0.01 * rng.random((256, 3)))
    del warm
    length = cases.arc_lengths(robot, rng.uniform(-0.2, 0.2, (n_robots, 5, 2)))
    force = cases.ball(rng, n_robots, 0.02)
    before = _resident("VmRSS")
    sim = Simulator(robot, n_robots, points_per_segment=6, outputs="tip")
    for i in range(10):
        length *= 1.0 + 1e-6 * i
        force *= 1.001
        state = sim.step(length, tip_force=force)
    after, peak = _resident("VmRSS"), _resident("VmHWM")
    fields = [getattr(state, field.name) for field in dataclasses.fields(state)]
    return {
        "memory": float(sum(a.nbytes for a in sim.snapshot().memory)),
        "state": float(sum(a.nbytes for a in fields if isinstance(a, np.ndarray))),
        "resident": after - before,
        "peak": peak - before,
        "inputs": float(length.nbytes + force.nbytes),
    }


def start_section(quick: bool) -> Section:
    """Times of a process from its first line to its first steps, with kernels compiled and without."""
    note_progress("start")
    many = thread_counts()[1]
    named = {
        "import": ("import fastrod", 1),
        "first": ("the first step of one robot, prototype", 1),
        "all": ("all from the first line to that step's end", 1),
        "parallel": (f"then the first step on {many} threads, 256 robots", many),
        "settle": ("then the first settle", many),
    }
    found = {}
    with tempfile.TemporaryDirectory() as folder:
        if not quick:
            note_progress("start with an empty cache")
            found["empty cache"] = in_fresh_process(__file__, ["start"], FASTROD_CACHE_DIR=folder)
        environment = {} if quick else {"FASTROD_CACHE_DIR": folder}
        again = [in_fresh_process(__file__, ["start"], **environment) for _ in range(1 if quick else 4)]
    found["cached"] = {key: min(run[key] for run in again) for key in named}
    rows = [
        {"cache": cache, "what": what, "seconds": times[key], "threads": str(threads)}
        for cache, times in found.items()
        for key, (what, threads) in named.items()
    ]
    note = "one run; the empty cache is left out." if quick else "cached: best of four."
    text = "cache kernels | what | seconds:.3f s | threads"
    return table("start", "Start", text, rows, f"Each in a fresh process, wall time; {note}")


def _start() -> dict[str, float]:
    marks = [time.perf_counter()]

    def mark() -> float:
        marks.append(time.perf_counter())
        return marks[-1] - marks[-2]

    import fastrod

    found = {"import": mark()}
    robot = fastrod.load_robot("prototype")
    sim: Any = fastrod.Simulator(robot, 1, threads=1)
    sim.step(robot.rest_tendon_length)
    found["first"] = mark()
    found["all"] = marks[-1] - marks[0]
    sim = fastrod.Simulator(robot, 256, threads=thread_counts()[1])
    sim.step(robot.rest_tendon_length)
    found["parallel"] = mark()
    sim.settle(robot.rest_tendon_length - [0.001, 0.0, -0.001, 0.0])
    found["settle"] = mark()
    return found


if __name__ == "__main__":
    name, *given = json.load(sys.stdin)
    print(json.dumps({"memory": _memory, "start": _start}[name](*given)))
