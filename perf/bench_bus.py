"""The drives' bus in real time: what a set-point costs, how even the SYNCs are, whether a drive ever lacks
one.

Both ends on this machine; another process plays the drives where the bus is udp_multicast.
"""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import numpy as np

from fastrod.types import Floats
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.can.drive import DriveBus
from fastrod_device.can.pacer import Pacer, ordinary, urgent
from fastrod_device.emulator.nodes import EmulatedDrives
from fastrod_device.units import DriveSpec
from report import Measurement, Row, Section, bench, note_progress, table

SPECS = [DriveSpec(node=k + 1, drum_radius=0.008, direction=(1, -1)[k % 2]) for k in range(4)]
AMPLITUDE, PERIOD = 1500.0, 2.0  # counts, s
UDP = "udp_multicast:239.74.163.2:43174"


class Springs:
    """Tendons that are springs: what a rod would cost is another benchmark's."""

    def move(self, t: float, pulled: Floats) -> Floats:  # noqa: ARG002
        return np.maximum(0.0, 1.0 + 500.0 * pulled)


def play_drives(bus: str, ends: Any) -> None:
    """The drives alone, until the other end speaks."""
    with EmulatedDrives(SPECS, bus, clock=WallClock(), tendons=Springs()) as drives:
        ends.send("ready")
        ends.recv()
        ends.send(drives.missed_setpoints)


@contextmanager
def elsewhere(bus: str) -> Iterator[list[int]]:
    """The drives in another process; the list has the set-points that they missed, once it has ended."""
    missed: list[int] = []
    spawn = multiprocessing.get_context("spawn")
    here, there = spawn.Pipe()
    process = spawn.Process(target=play_drives, args=(bus, there))
    process.start()
    here.recv()
    try:
        yield missed
    finally:
        here.send("end")
        missed.append(here.recv())
        process.join(10.0)


def loop(bus_name: str, rate: float, seconds: float, note: str = "") -> Row:
    """Connect, enable, sines for so long; `note`: collector on, first (before other programs), or stepped."""
    stepped, calm, note = note == "stepped", note != "collector on", f", {note}" if note else ""
    if note == ", first" and not urgent():
        note = ""
    clock, exchange = SteppedClock() if stepped else WallClock(), Measurement()
    with ExitStack() as stack:
        stack.callback(ordinary)
        if bus_name == UDP:
            drives, missed = None, stack.enter_context(elsewhere(bus_name))
        else:
            made = EmulatedDrives(SPECS, bus_name, clock=clock, tendons=Springs())
            drives, missed = stack.enter_context(made), list[int]()
        bus = stack.enter_context(DriveBus(SPECS, bus_name, clock=clock, rate=rate))
        bus.connect()
        bus.enable()
        n = round(seconds * rate)
        wave = np.rint(AMPLITUDE * np.sin(2.0 * np.pi * np.arange(n) / (rate * PERIOD)))
        targets = bus.newest.position + wave[:, None].astype(np.int64)
        requests, before = bus.sdo_requests, drives.missed_setpoints if drives else 0
        bus.reset_statistics()
        cpu, wall, pacer = time.process_time(), time.perf_counter(), Pacer(clock, rate)
        with pacer if calm else ExitStack():
            for target in targets:
                began = time.perf_counter()
                feedback = bus.exchange(target)
                exchange.times.append(time.perf_counter() - began)
                pacer.wait()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        jitter, unanswered, requests = bus.jitter, bus.missed, bus.sdo_requests - requests
        if feedback.lost:
            raise RuntimeError(feedback.lost)
        if drives:
            missed.append(drives.missed_setpoints - before)
    row: Row = {"bus": bus_name.split(":")[0] + note, "rate": n / wall if stepped else rate, "cycles": n}
    row |= {"missed": sum(missed), "unanswered": unanswered, "late": pacer.slipped, "sdo": requests}
    for name in ("p50", "p99", "max"):
        row[f"jitter_{name}"] = None if stepped else 1e6 * getattr(jitter, name)
    row |= {"exchange_p50": 1e6 * exchange.median, "exchange_p99": 1e6 * exchange.quantile(0.99)}
    return row | {"cpu": cpu / wall}


def measure(options: Any) -> list[Section]:
    seconds = 0.5 if options.quick else options.seconds
    short = min(seconds, 10.0)
    rows = []
    for bus, rate, length, note in (
        *(("virtual:bench", 200.0, seconds, ""), ("virtual:bench", 200.0, short, "collector on")),
        *(("virtual:bench", 200.0, short, "first"), (UDP, 200.0, short, "")),
        ("virtual:bench", 100.0, seconds, "stepped"),
    ):
        note_progress(f"{bus} {note}")
        rows.append(loop(bus, rate, length, note))
    return [
        table(
            "bus",
            "four drives on one bus",
            "bus | rate:.0f rate [Hz] | cycles:d | missed:d set-points~missed | unanswered:d cycles "
            "not~answered| late:d cycles~left out | jitter_p50:.0f SYNC off~p50 [us] | jitter_p99:.0f p99 "
            "[us]| jitter_max:.0f max [us] | exchange_p50:.0f exchange~p50 [us] | exchange_p99:.0f p99 [us]"
            "| sdo:d SDO in~the loop | cpu:.2f CPU~[cores]",
            rows,
            "A cycle is not answered where a drive's process data did not come within 0.6 of it. 'stepped': "
            "no waiting at all, the rate is what the machine computes. 'first': before other programs, where "
            "the machine grants that; 'collector on': garbage is collected in the loop.",
            f"Both ends use one interpreter on 'virtual', and {os.cpu_count()} cores; with udp_multicast the "
            "drives are another process.",
        )
    ]


main = bench(__doc__, measure, ("--seconds", 60.0, "of the loop at 200 Hz"))
