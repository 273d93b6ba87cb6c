"""What only a fresh process shows: memory, and the time to start.

Run as a script this module is that process: `memory N` or `start`; it prints one JSON object.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from report import Column, Row, Section, note_progress, thread_counts

MEMORY_TARGET = 2000.0
"""Bytes per five-segment robot beside its inputs."""


def _run(*words: str, **environment: str) -> dict[str, float]:
    """What this module prints as a script."""
    done = subprocess.run(
        [sys.executable, __file__, *words],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    found: dict[str, float] = json.loads(done.stdout)
    return found


def memory_section(n_robots: int) -> Section:
    note_progress("memory")
    found = _run("memory", str(n_robots))
    _, many = thread_counts()
    rows: list[Row] = [
        _memory_row("observer's memory", found["memory"] / n_robots),
        _memory_row("state that a step returns", found["state"] / n_robots),
        _memory_row("both, sum of nbytes", (found["memory"] + found["state"]) / n_robots, MEMORY_TARGET),
        _memory_row(
            "process after ten steps, beside the inputs", found["resident"] / n_robots, MEMORY_TARGET
        ),
        _memory_row("its peak in a cold start", found["peak"] / n_robots),
        _memory_row("the inputs themselves", found["inputs"] / n_robots),
    ]
    columns = [
        Column("what", "what"),
        Column("bytes", "bytes / robot", ",.0f"),
        Column("target", "target", ",.0f"),
        Column("met", "met"),
    ]
    notes = [
        f"{n_robots} robots five_segment_reacher, outputs='tip', f64, {many} threads, in a process of "
        "its own."
    ]
    return Section("memory", "Memory", columns, rows, notes)


def _memory_row(what: str, size: float, target: float | None = None) -> Row:
    return {"what": what, "bytes": size, "target": target, "met": None if target is None else size <= target}


def _resident(name: str) -> float:
    """VmRSS or VmHWM of this process [bytes]."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return 1024.0 * float(line.split()[1])
    return float("nan")


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
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        if not quick:
            note_progress("start with an empty cache")
            rows += _start_rows("empty cache", _run("start", FASTROD_CACHE_DIR=folder))
        environment = {} if quick else {"FASTROD_CACHE_DIR": folder}
        again = [_run("start", **environment) for _ in range(1 if quick else 4)]
    rows += _start_rows("cached", {key: min(run[key] for run in again) for key in again[0]})
    columns = [
        Column("cache", "kernels"),
        Column("what", "what"),
        Column("seconds", "s", ".3f"),
        Column("threads", "threads"),
    ]
    notes = [
        "Each in a fresh process, wall time"
        + (", one run; the empty cache is left out." if quick else "; cached: best of four.")
        + " Target: none."
    ]
    return Section("start", "Start", columns, rows, notes)


def _start_rows(cache: str, found: dict[str, float]) -> list[Row]:
    _, many = thread_counts()
    named = [
        ("import", "import fastrod", "1"),
        ("first", "the first step of one robot, prototype", "1"),
        ("all", "all from the first line to that step's end", "1"),
        ("parallel", f"then the first step on {many} threads, 256 robots", str(many)),
        ("settle", "then the first settle", str(many)),
    ]
    return [
        {"cache": cache, "what": what, "seconds": found[key], "threads": threads}
        for key, what, threads in named
    ]


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
    print(json.dumps(_memory(int(sys.argv[2])) if sys.argv[1] == "memory" else _start()))
