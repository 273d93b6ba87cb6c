"""A prototype that runs, and faults put into one that moves: `python perf/bench_faults.py`; or `--quick`.

First the whole way: connect to drives that have an EPOS4's objects (or those of `--eds FILE`) and no others,
home, and move for a minute at 200 Hz.

The emulated prototype goes round in a circle by commands at 30 Hz that go on whatever happens, and records.
At a moment that a seed draws something fails. Detection is when the supervisor finds it (a killed process has
none: there it is when the drives miss its heartbeat), standstill when the last shaft comes to rest, as the
emulator knows it and no controller does.
"""

from __future__ import annotations

import argparse
import math
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from fastrod.errors import FastrodError
from fastrod.logs.recording import Recorder, recover
from fastrod.types import Floats
from fastrod_device.bus import BusLine
from fastrod_device.camera import CameraFrame
from fastrod_device.clock import SteppedClock, WallClock
from fastrod_device.dictionary import object_dictionary
from fastrod_device.drawing import Eye
from fastrod_device.emulator import Emulator
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.faultcodes import ENABLED
from fastrod_device.hardware import load_hardware
from fastrod_device.journal import Journal
from fastrod_device.pacer import urgent
from fastrod_device.prototype import Prototype
from fastrod_device.safety import SafetyState
from fastrod_device.seal import seal
from fastrod_device.workbench import emulated
from report import Column, Row, Section, command, note_progress

RADIUS, TURN = 0.0025, 1.0  # m of wire, s
COMMANDS = 30.0  # Hz
FOLLOWING = 2.5e-4  # m; with 1 mm a wire that stalls is found by its tension before
SAFE = 0.05  # s from detection to standstill
AFTER = 1.0  # s in which nothing may start again
PATIENCE = 3.0  # s in which a fault must be found
UDP = "udp_multicast:239.74.163.5:43179"
LOOP = 200.0  # Hz
STORMS = (1, 2, 5, 10)  # SYNCs in a cycle; with four drives' answers a bus of 1 Mbit/s carries ten in 10 ms
RUN = (
    Column("objects", "objects\nof a drive", "d"),
    Column("notices", "not\nlimited", "d"),
    Column("ready", "connected and\nhomed after [s]", ".1f"),
    Column("seconds", "moved\nfor [s]", ".1f"),
    Column("rate", "cycles\na second", ".1f"),
    Column("missed", "set-points\nmissed", "d"),
    Column("unanswered", "cycles not\nanswered", "d"),
    Column("sdo", "SDO in\nthe loop", "d"),
    Column("stopped", "stopped by"),
)
COLUMNS = (
    Column("kind", "injected"),
    Column("n", "n", "d"),
    Column("safe", "stopped\nwithin 50 ms", "d"),
    Column("named", "named", "d"),
    Column("found", "injected to\nfound, worst [ms]", ".0f"),
    Column("rest", "found to\nrest, worst [ms]", ".1f"),
    Column("all", "injected to\nrest, worst [ms]", ".0f"),
    Column("rows", "rows", "d"),
    Column("lost", "rows\nlost", "d"),
    Column("lines", "journal's\nlines lost", "d"),
    Column("again", "enabled\nagain", "d"),
)


@dataclass
class Trial:
    """What one fault led to; times [s]."""

    found: float
    rest: float
    whole: float
    named: bool
    rows: int
    lost: int
    lines: int
    again: bool
    sentence: str


class Rig:
    """An emulated prototype in motion."""

    def __init__(self, folder: Path, seed: int, *, stepped: bool, eds: Path | None) -> None:
        self.clock = SteppedClock() if stepped else WallClock()
        self.jump, self.storm = 0.0, 0
        hardware, bus = load_hardware(), f"virtual:faults-{time.monotonic_ns()}"
        hardware = replace(hardware, limits=replace(hardware.limits, following_error=FOLLOWING))
        hidden = seal(seed, "none")
        self.emulator = Emulator(hardware, bus, clock=self.clock, seal=hidden, seed=seed, taut=True, eds=eds)
        self.journal = folder / f"{seed}-{time.monotonic_ns()}.journal.csv"
        self.part = self.journal.with_suffix(".log.csv")
        day = time.time() - self.clock.now()
        wall: Callable[[], float] = lambda: self.clock.now() + day + self.jump  # noqa: E731
        journal = Journal(self.journal)
        self.prototype = Prototype(
            hardware, bus, self.emulator, clock=self.clock, eds=eds, journal=journal, wall=wall
        )
        self._other = BusLine(bus)
        self.prototype.start(home=False)
        self.recorder: Recorder = self.prototype.recorder_for(str(self.part))
        self.recorder.start(self.prototype.elapsed)
        self.prototype.record(self.recorder)
        self._began, self._over = self.clock.now(), threading.Event()
        self._thread = threading.Thread(target=self._command_on, daemon=True)
        if not stepped:
            self._thread.start()

    def command(self) -> None:
        """Where the circle is now."""
        with suppress(RefusedError):
            self.prototype.command(circle(self.clock.now() - self._began))

    def _command_on(self) -> None:
        while not self._over.wait(1.0 / COMMANDS):
            self.command()

    def sync(self) -> None:
        """Another node's SYNC."""
        self._other.send(0x080, b"")

    def _sync_on(self) -> None:
        while not self._over.wait(1e-3 / self.storm * max(STORMS)):
            self.sync()

    def storm_on(self, syncs: int) -> None:
        """From now on so many SYNCs of another node in every 10 ms."""
        self.storm = syncs
        if not self.clock.stepped:
            threading.Thread(target=self._sync_on, daemon=True).start()

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> bool:
        """So much time passes, stopped or not, with commands; whether `until` came true."""
        end, due = self.clock.now() + seconds, -math.inf
        while self.clock.now() < end:
            if not self.clock.stepped:
                time.sleep(1e-3)
            else:
                if self.clock.now() >= due:
                    due = self.clock.now() + 1.0 / COMMANDS
                    self.command()
                for _ in range(self.storm):
                    self.sync()
                with suppress(DeviceError):
                    self.prototype.wait(1.0 / self.prototype.hardware.rate)
            if until():
                return True
        return False

    def close(self) -> None:
        """Switch all off."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join(2.0)
        self.emulator.drives.restore()
        self.prototype.close()
        self._other.close()
        self.emulator.close()


@contextmanager
def rig(folder: Path, seed: int, *, stepped: bool, eds: Path | None) -> Iterator[Rig]:
    """One, closed at the end."""
    made = Rig(folder, seed, stepped=stepped, eds=eds)
    try:
        yield made
    finally:
        made.close()


def circle(t: float) -> Floats:
    """(4,) wire lengths [m] at `t` [s]."""
    angle = 2.0 * math.pi * t / TURN
    bend = RADIUS * min(1.0, t / 0.5) * np.array([math.cos(angle), math.sin(angle)])
    return np.concatenate([bend, -bend])


def _freeze(rig: Rig, _: int) -> None:
    rig.emulator.frozen = True


def _hide(rig: Rig, _: int) -> None:
    rig.emulator.hidden = True


def _block(rig: Rig, _: int) -> None:
    """The drive that pulls most: one that lets wire out is found by its tension before, as the others pull
    against it."""
    readings = rig.prototype.readings
    rig.emulator.drives.block(0 if readings is None else int(np.argmin(readings.rate)))


def _jump(rig: Rig, k: int) -> None:
    rig.jump += (3600.0, -0.5, 0.3)[k % 3]


INJECTIONS: dict[str, tuple[Callable[[Rig, int], None], str]] = {
    "heartbeat lost": (lambda rig, k: rig.emulator.drives.lose_heartbeat(k % 4), "sent its last heartbeat"),
    "emergency message": (
        lambda rig, k: rig.emulator.drives.emergency(k % 4, (0x2310, 0x3210, 0x4310)[k % 3]),
        "sent an emergency: 0x",
    ),
    "following error": (_block, "ollowing error"),
    "bus off": (lambda rig, _: rig.emulator.drives.bus_off(), "the bus carries nothing"),
    "node reboot": (lambda rig, k: rig.emulator.drives.reboot(k % 4), "NMT state is 0 (booting)"),
    "camera frozen": (_freeze, "the camera repeats its frames"),
    "marker lost": (_hide, "the marker was last seen"),
    "clock jump": (_jump, "the wall clock jumped"),
    "encoder jump": (
        lambda rig, k: rig.emulator.drives.encoder_jump(k % 4, (2000, -2000, 4000, -4000)[k % 4]),
        "moved its wire by",
    ),
    "SYNC storm": (lambda rig, k: rig.storm_on(STORMS[k % 4]), "another node sends SYNC"),
}
"""How each is done to the k-th trial, and what its sentence must say."""


def run(seconds: float, *, stepped: bool, eds: Path | None) -> Row:
    """Connect, home, and go round for so long at 200 Hz."""
    hardware = replace(load_hardware(), rate=LOOP)
    with emulated(hardware, seed=1, effect="none", stepped=stepped, eds=eds) as bench:
        assert bench.emulator is not None
        prototype, nodes = bench.prototype, bench.emulator.drives
        bus, ready = prototype.drives, prototype.elapsed
        bus.reset_statistics()
        asked, missed, began = bus.sdo_requests, nodes.missed_setpoints, prototype.clock.now()
        with suppress(DeviceError):
            prototype.follow(circle, seconds)
        passed, cycles, fault = prototype.clock.now() - began, bus.jitter.n, prototype.supervisor.first
        return {
            "objects": len(object_dictionary(eds)),
            "notices": len(bus.notices),
            "ready": ready,
            "seconds": passed,
            "rate": cycles / passed,
            "missed": nodes.missed_setpoints - missed,
            "unanswered": bus.missed,
            "sdo": bus.sdo_requests - asked,
            "stopped": "nothing" if fault is None else fault.sentence,
        }


def fail(kind: str, k: int, folder: Path, *, stepped: bool, eds: Path | None) -> Trial:
    """One trial."""
    rng = np.random.default_rng([k, list(INJECTIONS).index(kind)])
    inject, words = INJECTIONS[kind]
    with rig(folder, k, stepped=stepped, eds=eds) as bench:
        supervisor, drives = bench.prototype.supervisor, bench.emulator.drives
        bench.wait(0.7 + float(rng.uniform(0.0, 1.0)), lambda: supervisor.state is SafetyState.STOPPED)
        injected = bench.clock.now()
        inject(bench, k)
        bench.wait(PATIENCE, lambda: supervisor.state is SafetyState.STOPPED)
        fault = supervisor.first
        if fault is None:
            return Trial(
                math.inf, math.inf, math.inf, False, len(bench.recorder), 0, 1, False, "nothing was found"
            )
        on = np.ones(drives.n_drives, dtype=np.bool_)
        again = False

        def look() -> bool:
            nonlocal on, again
            now = np.array([state == ENABLED for state in drives.states])
            again |= bool((now & ~on).any())
            on &= now
            return False

        bench.wait(AFTER, look)
        at = float(np.nanmax(drives.stopped_at, initial=injected)) if not drives.moving.any() else math.inf
        again |= bool(on.any()) or supervisor.state is not SafetyState.STOPPED
        bench.prototype.record(None)
        rows = len(bench.recorder)
        kept = bench.part.with_name(bench.part.name + ".part").read_text(encoding="utf-8").count("\n") - 2
        lost = sum(
            line[2] not in bench.journal.read_text(encoding="utf-8").replace('""', '"')
            for line in bench.prototype.journal.lines
        )
        lines = lost + (not bench.prototype.journal.lines)
        rest = max(at - fault.t, 0.0)
        return Trial(
            fault.t - injected,
            rest,
            at - injected,
            words in fault.sentence,
            rows,
            rows - kept,
            lines,
            again,
            fault.sentence,
        )


class Still:
    """A camera that sees a marker where nothing moves it, for a process that has no plant."""

    def __init__(self) -> None:
        self._camera = load_hardware().camera
        self._eye = Eye(self._camera, load_hardware().marker, seed=1)
        self._number, self._due = 0, 0.0

    def read(self) -> CameraFrame | None:
        """One at the camera's rate."""
        now = time.monotonic()
        if now < self._due:
            return None
        self._due, self._number = now + 1.0 / self._camera.rate, self._number + 1
        image = self._eye.draw(np.array([0.0, 0.0, 0.07]), np.array([1.0, 0.0, 0.0, 0.0]))
        return CameraFrame(image=image, t=now - self._camera.latency, number=self._number)

    def close(self) -> None:
        """Nothing to give back."""


def be_killed(folder: str) -> int:
    """The process that is killed: it tells how many rows it has recorded."""
    urgent()
    hardware = load_hardware()
    # its marker stands where the model says it moves
    blind = replace(hardware, limits=replace(hardware.limits, sighting_age=None))
    with Prototype(blind, UDP, Still()) as prototype:
        prototype.start(home=False)
        recorder = prototype.recorder_for(str(Path(folder) / "killed.csv"))
        recorder.start(prototype.elapsed)
        prototype.record(recorder)
        began = time.monotonic()
        while True:
            prototype.command(circle(time.monotonic() - began))
            print(len(recorder), prototype.supervisor.state.value, flush=True)
            time.sleep(1.0 / COMMANDS)


def kill(k: int, folder: Path) -> Trial:
    """One trial with the controller in a process of its own."""
    rng, log = np.random.default_rng([k, 99]), folder / "killed.csv"
    emulator = Emulator(load_hardware(), UDP, clock=WallClock(), seal=seal(k, "none"), seed=k, taut=True)
    child = subprocess.Popen(
        [sys.executable, __file__, "--be-killed", str(folder)], stdout=subprocess.PIPE, text=True
    )
    try:
        assert child.stdout is not None
        told, end = "", math.inf
        for line in child.stdout:
            told = line
            end = (
                min(end, time.monotonic() + 1.0 + float(rng.uniform(0.0, 1.0)))
                if int(line.split()[0])
                else end
            )
            if time.monotonic() > end:
                break
        end = time.monotonic() + 0.2  # between two commands it may stand
        while not (moved := bool(emulator.drives.moving.any())) and time.monotonic() < end:
            time.sleep(1e-3)
        injected = time.monotonic()
        child.send_signal(signal.SIGKILL)
        rows = int(
            (told + "".join(line for line in child.stdout if line.endswith("\n"))).split("\n")[-2].split()[0]
        )
        child.wait()
        on, again, after = np.ones(4, dtype=np.bool_), False, injected + 0.3 + AFTER
        while time.monotonic() < after:
            now = np.array([state == ENABLED for state in emulator.drives.states])
            again, on = again or bool((now & ~on).any()), on & now
            time.sleep(1e-3)
        again |= bool(on.any())
        still = not emulator.drives.moving.any() and moved
        at = float(np.nanmax(emulator.drives.stopped_at)) if still else math.inf
        found = float(np.nanmax(emulator.drives.missed_at, initial=-math.inf))
        kept = len(recover(log).t)
        log.unlink()
        named = bool(np.isfinite(emulator.drives.missed_at).all())
        sentence = (
            "the controller's heartbeat is missed by every drive (emergency 0x8130)"
            if named
            else "a drive did not miss it"
        )
        sentence = sentence if moved else f"nothing moved before it was killed; it was {told.split()[-1]}"
        return Trial(
            found - injected,
            max(at - found, 0.0),
            at - injected,
            named,
            rows,
            max(rows - kept, 0),
            0,
            again,
            sentence,
        )
    finally:
        child.kill()
        child.wait()
        emulator.close()


def _row(kind: str, trials: Sequence[Trial]) -> Row:
    """Of one kind."""
    return {
        "kind": kind,
        "n": len(trials),
        "safe": sum(trial.rest <= SAFE for trial in trials),
        "named": sum(trial.named for trial in trials),
        "found": 1e3 * max(trial.found for trial in trials),
        "rest": 1e3 * max(trial.rest for trial in trials),
        "all": 1e3 * max(trial.whole for trial in trials),
        "rows": sum(trial.rows for trial in trials),
        "lost": sum(trial.lost for trial in trials),
        "lines": sum(trial.lines for trial in trials),
        "again": sum(trial.again for trial in trials),
        "sentence": next((t.sentence for t in trials if not t.named), trials[0].sentence),
    }


def measure(options: argparse.Namespace) -> Sequence[Section]:
    """All kinds."""
    times = 1 if options.quick else options.times
    urgent()  # before other programs, where that is granted
    rows, whole = [], []
    if options.only is None:
        note_progress("connect, home, move")
        whole.append(run(2.0 if options.quick else options.seconds, stepped=options.stepped, eds=options.eds))
    with tempfile.TemporaryDirectory() as name:
        for kind in INJECTIONS:
            if options.only in (None, kind):
                note_progress(kind)
                how, folder = {"stepped": options.stepped, "eds": options.eds}, Path(name)
                rows.append(_row(kind, [fail(kind, k, folder, **how) for k in range(times)]))
        if options.only in (None, "killed process"):
            note_progress("killed process")
            rows.append(_row("killed process", [kill(k, Path(name)) for k in range(times)]))
    notes = [
        "A sentence of each kind, of a trial that was not named as it should where there is one:",
        *(f"  {row['kind']}: {row['sentence']}" for row in rows),
        "'found to rest' is 0 where set-points that do not come any more had stopped the shafts before: bus "
        "off, killed process.",
        "A killed process: SIGKILL, drives in another process on udp_multicast, always in real time; rows "
        "are those that it had reported.",
    ]
    time_is = ", stepped" if options.stepped else ""
    found = [Section("faults", f"faults injected into a moving prototype{time_is}", COLUMNS, rows, notes)]
    if whole:
        found.insert(0, Section("run", f"connect, home and move at {LOOP:g} Hz{time_is}", RUN, whole, []))
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    given = sys.argv[1:] if argv is None else list(argv)
    if given[:1] == ["--be-killed"]:
        return be_killed(given[1])
    parser = argparse.ArgumentParser(
        prog="bench_faults", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--times", type=int, default=20, help="of each kind (default: 20)")
    parser.add_argument("--only", choices=[*INJECTIONS, "killed process"], help="this kind alone")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the loop at 200 Hz (default: 60)")
    parser.add_argument("--eds", type=Path, metavar="FILE", help="of the drives (default: an EPOS4's)")
    parser.add_argument(
        "--stepped", action="store_true", help="as fast as the machine computes, not in real time"
    )
    try:
        return command(parser, given, measure)
    except FastrodError as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
