"""The drives' bus in real time: `python perf/bench_bus.py`; `--json` for programs, `--quick` for a smoke run.

Both ends on this machine: the controller's loop, four emulated drives, and the bus between them. What a
set-point costs, how even the SYNCs are, and whether a drive ever lacks a set-point. Another process plays the
drives where the bus is udp_multicast.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager

import numpy as np

from fastrod.types import Floats
from fastrod_device.clock import SteppedClock, WallClock
from fastrod_device.drive import DriveBus
from fastrod_device.nodes import EmulatedDrives
from fastrod_device.pacer import Pacer, ordinary, urgent
from fastrod_device.units import DriveSpec
from report import Column, Row, Section, command, note_progress

SPECS = [DriveSpec(node=k + 1, drum_radius=0.008, direction=(1, -1)[k % 2]) for k in range(4)]
AMPLITUDE, TURN = 1500.0, 2.0  # counts, s
UDP = "udp_multicast:239.74.163.2:43174"
COLUMNS = (
    Column("bus", "bus"),
    Column("rate", "rate [Hz]", ".0f"),
    Column("cycles", "cycles", "d"),
    Column("missed", "set-points\nmissed", "d"),
    Column("unanswered", "cycles not\nanswered", "d"),
    Column("late", "cycles\nleft out", "d"),
    Column("jitter_p50", "SYNC off\np50 [us]", ".0f"),
    Column("jitter_p99", "p99 [us]", ".0f"),
    Column("jitter_max", "max [us]", ".0f"),
    Column("exchange_p50", "exchange\np50 [us]", ".0f"),
    Column("exchange_p99", "p99 [us]", ".0f"),
    Column("sdo", "SDO in\nthe loop", "d"),
    Column("cpu", "CPU\n[cores]", ".2f"),
)


class Springs:
    """Wires that are springs: what a rod would cost is another benchmark's."""

    def move(self, t: float, pulled: Floats) -> Floats:  # noqa: ARG002
        return np.maximum(0.0, 1.0 + 500.0 * pulled)


@contextmanager
def elsewhere(bus: str) -> Iterator[list[int]]:
    """The drives in another process; the list has the set-points that they missed, once it has ended."""
    missed: list[int] = []
    process = subprocess.Popen(
        [sys.executable, __file__, "--drives", bus], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert process.stdout is not None
        process.stdout.readline()  # they are there
        yield missed
    finally:
        told, _ = process.communicate(timeout=10.0)
        missed.extend(int(line) for line in told.split())


def play_drives(bus: str) -> int:
    """The drives alone, until standard input ends."""
    with EmulatedDrives(SPECS, bus, clock=WallClock(), wires=Springs()) as drives:
        print("ready", flush=True)
        sys.stdin.read()
        print(drives.missed_setpoints, flush=True)
    return 0


def loop(
    bus_name: str,
    rate: float,
    seconds: float,
    *,
    calm: bool = True,
    stepped: bool = False,
    first: bool = False,
) -> Row:
    """One loop: connect, enable, sines for so long. `calm`: without the collector of garbage; `first`: before
    other programs."""
    granted = first and urgent()
    try:
        return _loop(bus_name, rate, seconds, calm=calm, stepped=stepped, note=", first" if granted else "")
    finally:
        ordinary()


def _loop(bus_name: str, rate: float, seconds: float, *, calm: bool, stepped: bool, note: str) -> Row:
    clock = SteppedClock() if stepped else WallClock()
    local = bus_name.startswith("virtual")
    with ExitStack() as stack:
        drives = (
            stack.enter_context(EmulatedDrives(SPECS, bus_name, clock=clock, wires=Springs()))
            if local
            else None
        )
        told = [] if local else stack.enter_context(elsewhere(bus_name))
        bus = stack.enter_context(DriveBus(SPECS, bus_name, clock=clock, rate=rate))
        bus.connect()
        bus.enable()
        n = round(seconds * rate)
        start = bus.newest.position
        targets = start + np.rint(AMPLITUDE * np.sin(2.0 * np.pi * np.arange(n) / (rate * TURN)))[
            :, None
        ].astype(np.int64)
        spent, asked = np.empty(n), bus.sdo_requests
        missed = drives.missed_setpoints if drives is not None else 0
        bus.reset_statistics()
        cpu, wall = time.process_time(), time.perf_counter()
        pacer = Pacer(clock, rate)
        with pacer if calm else ExitStack():
            for k in range(n):
                began = time.perf_counter()
                feedback = bus.exchange(targets[k])
                spent[k] = time.perf_counter() - began
                pacer.wait()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        jitter, unanswered, asked = bus.jitter, bus.missed, bus.sdo_requests - asked
        if feedback.lost:
            raise RuntimeError(feedback.lost)
        missed = 0 if drives is None else drives.missed_setpoints - missed
    missed += sum(told)
    micro = 1e6 * np.array([jitter.p50, jitter.p99, jitter.max, *np.quantile(spent, (0.5, 0.99))])
    name = bus_name.split(":")[0] + (", stepped" if stepped else note if calm else ", collector on")
    return {
        "bus": name,
        "rate": rate if not stepped else n / wall,
        "cycles": n,
        "missed": missed,
        "unanswered": unanswered,
        "late": pacer.slipped,
        "jitter_p50": None if stepped else float(micro[0]),
        "jitter_p99": None if stepped else float(micro[1]),
        "jitter_max": None if stepped else float(micro[2]),
        "exchange_p50": float(micro[3]),
        "exchange_p99": float(micro[4]),
        "sdo": asked,
        "cpu": cpu / wall,
    }


def measure(options: argparse.Namespace) -> Sequence[Section]:
    """All loops."""
    seconds = 0.5 if options.quick else options.seconds
    short = min(seconds, 10.0)
    plan = [
        ("virtual, 200 Hz", lambda: loop("virtual:bench", 200.0, seconds)),
        ("virtual, collector on", lambda: loop("virtual:bench", 200.0, short, calm=False)),
        ("virtual, first", lambda: loop("virtual:bench", 200.0, short, first=True)),
        ("udp_multicast", lambda: loop(UDP, 200.0, short)),
        ("virtual, stepped", lambda: loop("virtual:bench", 100.0, seconds, stepped=True)),
    ]
    rows = []
    for name, run in plan:
        note_progress(name)
        rows.append(run())
    notes = [
        "A set-point is missed where a drive, operation enabled, got a SYNC and no new target; a cycle is "
        "not answered where a drive's",
        "process data did not come within 0.6 of it. 'stepped': no waiting at all, the rate is what the "
        "machine computes.",
        "'first': before other programs, where the machine grants that; 'collector on': garbage is "
        "collected in the loop.",
        f"Both ends share the interpreter on 'virtual', and {os.cpu_count()} cores; with udp_multicast the "
        "drives are another process.",
    ]
    return [Section("bus", "four drives on one bus", COLUMNS, rows, notes)]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    if given[:1] == ["--drives"]:
        return play_drives(given[1])
    parser = argparse.ArgumentParser(
        prog="bench_bus", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="of the loop at 200 Hz (default: 60)")
    return command(parser, given, measure)


if __name__ == "__main__":
    sys.exit(main())
