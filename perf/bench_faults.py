"""A prototype that runs, on drives that have an EPOS4's objects (or those of `--eds FILE`), and faults put
into one that moves.

The emulated prototype goes round in a circle by commands at 30 Hz that go on whatever happens, and records.
At a moment that a seed draws something fails. Detection is when the supervisor finds it (a killed process has
none: there it is when the drives miss its heartbeat), standstill when the last shaft comes to rest, as the
emulator knows it and no controller does.
"""

from __future__ import annotations

import math
import multiprocessing
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fastrod.logs.recording import recover
from fastrod.types import Floats
from fastrod_device.bench.workbench import emulated
from fastrod_device.can.bus import BusLine
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.can.dictionary import object_dictionary
from fastrod_device.can.faultcodes import ENABLED
from fastrod_device.can.pacer import urgent
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.emulator.seal import seal
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.hardware import load_hardware
from fastrod_device.journal import Journal
from fastrod_device.prototype import Prototype
from fastrod_device.safety import SafetyState
from fastrod_device.vision.camera import CameraFrame
from fastrod_device.vision.drawing import Eye
from report import Row, Section, bench, note_progress, table

RADIUS, PERIOD = 0.0025, 1.0  # m of tendon, s
COMMANDS = 30.0  # Hz
FOLLOWING = 2.5e-4  # m; with 1 mm a tendon that stalls is found by its tension before
SAFE = 0.05  # s from detection to standstill
AFTER = 1.0  # s in which nothing may start again
PATIENCE = 3.0  # s in which a fault must be found
UDP = "udp_multicast:239.74.163.5:43179"
LOOP = 200.0  # Hz
STORMS = (1, 2, 5, 10)  # SYNCs in a cycle; with four drives' answers a bus of 1 Mbit/s carries ten in 10 ms
KILLED = "killed process"


class Trial(NamedTuple):
    """Consequence of one fault; times [s]."""

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

    def __init__(
        self, folder: Path, seed: int, *, stepped: bool = True, eds: Path | None = None, **limits: float
    ) -> None:
        self.clock = SteppedClock() if stepped else WallClock()
        self.jump, self.storm, self.radius = 0.0, 0, RADIUS
        hardware = load_hardware()
        self.bus = bus = f"virtual:faults-{time.monotonic_ns()}"
        limits = {"following_error": FOLLOWING} | limits
        hardware = replace(hardware, limits=replace(hardware.limits, **limits))
        both: Any = {"clock": self.clock, "eds": eds}
        self.emulator = Emulator(hardware, bus, seal=seal(seed, "none"), seed=seed, taut=True, **both)
        self.drives = self.emulator.drives
        self.journal = folder / f"{seed}-{time.monotonic_ns()}.journal.csv"
        self.log = self.journal.with_suffix(".log.csv")
        day = time.time() - self.clock.now()
        wall: Any = lambda: self.clock.now() + day + self.jump  # noqa: E731
        both |= {"journal": Journal(self.journal), "wall": wall}
        self.prototype = Prototype(hardware, bus, self.emulator, **both)
        self._other = BusLine(bus)
        self.prototype.start(home=False)
        self.recorder = record(self.prototype, self.log)
        self._began, self._over, self._threads = self.clock.now(), threading.Event(), list[Any]()
        self._repeat(1.0 / COMMANDS, self.command)

    def _repeat(self, period: float, what: Callable[[], None]) -> None:
        """Repeat an action from now on in real time; stepped time does it in `wait`."""

        def repeat() -> None:
            while not self._over.wait(period):
                what()

        if not self.clock.stepped:
            self._threads.append(threading.Thread(target=repeat, daemon=True))
            self._threads[-1].start()

    def command(self) -> None:
        """Send the circle's point of now."""
        with suppress(RefusedError):
            self.prototype.command(circle(self.clock.now() - self._began, self.radius))

    def sync(self) -> None:
        self._other.send(0x080, b"")

    def wait(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        """So much time passes, stopped or not, with commands, or less if `until` comes true."""
        end, due = self.clock.now() + seconds, -math.inf
        while self.clock.now() < end and not until():
            if not self.clock.stepped:
                time.sleep(1e-3)
                continue
            if self.clock.now() >= due:
                due = self.clock.now() + 1.0 / COMMANDS
                self.command()
            for _ in range(self.storm):
                self.sync()
            with suppress(DeviceError):
                self.prototype.wait(1.0 / self.prototype.hardware.rate)

    def stopped(self) -> bool:
        return self.prototype.supervisor.state is SafetyState.STOPPED

    def block(self) -> None:
        """The drive that pulls most: one that lets tendon out is found by its tension before, as the others
        pull against it."""
        readings = self.prototype.readings
        self.drives.block(0 if readings is None else int(np.argmin(readings.rate)))

    def storm_on(self, syncs: int) -> None:
        """Send so many SYNCs of another node in every 10 ms from now on."""
        self.storm = syncs
        self._repeat(1e-3 / syncs * max(STORMS), self.sync)

    def repair(self) -> None:
        self.drives.restore()
        self.emulator.frozen = self.emulator.hidden = False
        self.storm = 0

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join(2.0)
        self.repair()
        if self.recorder.recording:
            self.recorder.stop()
        self.prototype.close()
        self._other.close()
        self.emulator.close()


class Watch:
    """Whether any drive was enabled again after it had stopped, or never stopped."""

    def __init__(self, drives: Any) -> None:
        self.drives, self.again = drives, False
        self.on = np.ones(drives.n_drives, dtype=np.bool_)

    def __call__(self) -> bool:
        now = np.array([state == ENABLED for state in self.drives.states])
        self.again |= bool((now & ~self.on).any())
        self.on &= now
        return False


def record(prototype: Prototype, log: Path) -> Any:
    recorder = prototype.recorder_for(str(log))
    recorder.start(prototype.elapsed)
    prototype.record(recorder)
    return recorder


def circle(t: float, radius: float = RADIUS) -> Floats:
    """(4,) tendon lengths [m] at `t` [s]."""
    angle = 2.0 * math.pi * t / PERIOD
    bend = radius * min(1.0, t / 0.5) * np.array([math.cos(angle), math.sin(angle)])
    return np.concatenate([bend, -bend])


_CODES, _COUNTS, _JUMPS = (0x2310, 0x3210, 0x4310), (2000, -2000, 4000, -4000), (3600.0, -0.5, 0.3)
INJECTIONS: dict[str, tuple[Callable[[Rig, int], Any], str]] = {
    "heartbeat lost": (lambda rig, k: rig.drives.lose_heartbeat(k % 4), "sent its last heartbeat"),
    "emergency message": (
        lambda rig, k: rig.drives.emergency(k % 4, _CODES[k % 3], lasting=True),
        "sent an emergency: 0x",
    ),
    "following error": (lambda rig, _: rig.block(), "ollowing error"),
    "bus off": (lambda rig, _: rig.drives.bus_off(), "the bus carries nothing"),
    "node reboot": (lambda rig, k: rig.drives.reboot(k % 4), "NMT state is 0 (booting)"),
    "camera frozen": (lambda rig, _: setattr(rig.emulator, "frozen", True), "the camera repeats its frames"),
    "marker lost": (lambda rig, _: setattr(rig.emulator, "hidden", True), "the marker was last seen"),
    "clock jump": (lambda rig, k: setattr(rig, "jump", _JUMPS[k % 3]), "the wall clock jumped"),
    "encoder jump": (lambda rig, k: rig.drives.encoder_jump(k % 4, _COUNTS[k % 4]), "moved its tendon by"),
    "foreign SYNC": (lambda rig, k: rig.storm_on(STORMS[k % 4]), "another node sends SYNC"),
}
"""Injection of each fault into the k-th trial, and what its sentence must say."""


def run(seconds: float, *, stepped: bool, eds: Path | None) -> Row:
    """Connect, home, and go round for so long at 200 Hz."""
    hardware = replace(load_hardware(), rate=LOOP)
    with emulated(hardware, seed=1, effect="none", stepped=stepped, eds=eds) as bench:
        assert bench.emulator is not None
        prototype, nodes = bench.prototype, bench.emulator.drives
        bus, ready = prototype.drives, prototype.elapsed
        bus.reset_statistics()
        requests, missed, began = bus.sdo_requests, nodes.missed_setpoints, prototype.clock.now()
        with suppress(DeviceError):
            prototype.follow(circle, seconds)
        passed, fault = prototype.clock.now() - began, prototype.supervisor.first
        return {
            "objects": len(object_dictionary(eds)),
            "notices": len(bus.notices),
            "ready": ready,
            "seconds": passed,
            "rate": bus.jitter.n / passed,
            "missed": nodes.missed_setpoints - missed,
            "unanswered": bus.missed,
            "sdo": bus.sdo_requests - requests,
            "stopped": "nothing" if fault is None else fault.sentence,
        }


def fail(kind: str, k: int, folder: Path, **options: Any) -> Trial:
    rng = np.random.default_rng([k, list(INJECTIONS).index(kind)])
    inject, words = INJECTIONS[kind]
    with closing(Rig(folder, k, **options)) as bench:
        drives, journal = bench.drives, bench.prototype.journal
        bench.wait(0.7 + float(rng.uniform(0.0, 1.0)), bench.stopped)
        injected = bench.clock.now()
        inject(bench, k)
        bench.wait(PATIENCE, bench.stopped)
        fault = bench.prototype.supervisor.first
        if fault is None:
            none = (math.inf, math.inf, math.inf)
            return Trial(*none, False, len(bench.recorder), 0, 1, False, "nothing was found")
        watch = Watch(drives)
        bench.wait(AFTER, watch)
        at = float(np.nanmax(drives.stopped_at, initial=injected)) if not drives.moving.any() else math.inf
        again = watch.again or bool(watch.on.any()) or not bench.stopped()
        bench.prototype.record(None)
        rows, written = len(bench.recorder), bench.journal.read_text(encoding="utf-8").replace('""', '"')
        kept = bench.log.with_name(bench.log.name + ".part").read_text(encoding="utf-8").count("\n") - 2
        lines = sum(line[2] not in written for line in journal.lines) + (not journal.lines)
        times = fault.t - injected, max(at - fault.t, 0.0), at - injected
        return Trial(*times, words in fault.sentence, rows, rows - kept, lines, again, fault.sentence)


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


def be_killed(log: Path, ends: Any) -> None:
    """The process that is killed: it sends how many rows it has recorded, and its supervisor's state."""
    urgent()
    hardware = load_hardware()
    # its marker stands still, not where the model says it moves
    blind = replace(hardware, limits=replace(hardware.limits, sighting_age=None))
    with Prototype(blind, UDP, Still()) as prototype:
        prototype.start(home=False)
        recorder, began = record(prototype, log), time.monotonic()
        while True:
            prototype.command(circle(time.monotonic() - began))
            ends.send((len(recorder), prototype.supervisor.state.value))
            time.sleep(1.0 / COMMANDS)


def kill(k: int, folder: Path) -> Trial:
    """One trial with the controller in a process of its own."""
    rng, log = np.random.default_rng([k, 99]), folder / "killed.csv"
    spawn = multiprocessing.get_context("spawn")
    emulator = Emulator(load_hardware(), UDP, clock=WallClock(), seal=seal(k, "none"), seed=k, taut=True)
    here, there = spawn.Pipe(duplex=False)
    child, drives = spawn.Process(target=be_killed, args=(log, there)), emulator.drives
    try:
        child.start()
        there.close()
        rows, state, end = 0, "", math.inf
        while time.monotonic() < end:
            rows, state = here.recv()
            end = min(end, time.monotonic() + 1.0 + float(rng.uniform(0.0, 1.0))) if rows else end
        end = time.monotonic() + 0.2  # between two commands it may stand
        while not (moved := bool(drives.moving.any())) and time.monotonic() < end:
            time.sleep(1e-3)
        injected = time.monotonic()
        child.kill()
        with suppress(EOFError):
            while True:
                rows, state = here.recv()
        child.join()
        watch = Watch(drives)
        while time.monotonic() < injected + 0.3 + AFTER:
            watch()
            time.sleep(1e-3)
        at = float(np.nanmax(drives.stopped_at)) if moved and not drives.moving.any() else math.inf
        found = float(np.nanmax(drives.missed_at, initial=-math.inf))
        kept = len(recover(log).t)
        log.unlink()
        named = bool(np.isfinite(drives.missed_at).all())
        missed = "the controller's heartbeat is missed by every drive (emergency 0x8130)"
        sentence = missed if named else "a drive did not miss it"
        if not moved:
            sentence = f"nothing moved before it was killed; it was {state}"
        times = found - injected, max(at - found, 0.0), at - injected
        again = watch.again or bool(watch.on.any())
        return Trial(*times, named, rows, max(rows - kept, 0), 0, again, sentence)
    finally:
        child.kill()
        child.join()
        emulator.close()


def _row(kind: str, trials: Sequence[Trial]) -> Row:
    worst = {name: 1e3 * max(getattr(t, name) for t in trials) for name in ("found", "rest", "whole")}
    counts = ("named", "rows", "lost", "lines", "again")
    sums = {name: sum(getattr(t, name) for t in trials) for name in counts}
    sentence = next((t.sentence for t in trials if not t.named), trials[0].sentence)
    safe = sum(trial.rest <= SAFE for trial in trials)
    return {"kind": kind, "n": len(trials), "safe": safe, **worst, **sums, "sentence": sentence}


def measure(options: Any) -> list[Section]:
    times, found = 1 if options.quick else options.times, []
    urgent()  # before other programs, where that is granted
    how, time_is = {"stepped": options.stepped, "eds": options.eds}, ", stepped" if options.stepped else ""
    if options.only is None:
        note_progress("connect, home, move")
        found.append(
            table(
                "run",
                f"connect, home and move at {LOOP:g} Hz{time_is}",
                "objects:d objects~of a drive | notices:d not~limited | ready:.1f connected and~homed after "
                "[s]| seconds:.1f moved~for [s] | rate:.1f cycles~a second | missed:d set-points~missed"
                "| unanswered:d cycles not~answered | sdo:d SDO in~the loop | stopped stopped by",
                [run(2.0 if options.quick else options.seconds, **how)],
            )
        )
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in [options.only] if options.only else [*INJECTIONS, KILLED]:
            note_progress(kind)
            trials = [
                kill(k, folder) if kind == KILLED else fail(kind, k, folder, **how) for k in range(times)
            ]
            rows.append(_row(kind, trials))
    found.append(
        table(
            "faults",
            f"faults injected into a moving prototype{time_is}",
            "kind injected | n:d | safe:d stopped~within 50 ms | named:d | found:.0f injected to~found, "
            "worst [ms]| rest:.1f found to~rest, worst [ms] | whole:.0f injected to~rest, worst [ms] | rows:d"
            "| lost:d rows~lost | lines:d journal's~lines lost | again:d enabled~again",
            rows,
            "A sentence of each kind, of a trial that was not named as it should where there is one:",
            *(f"  {row['kind']}: {row['sentence']}" for row in rows),
            "'found to rest' is 0 where set-points that do not come any more had stopped the shafts before: "
            "bus off, killed process. A killed process: SIGKILL, drives in another process on udp_multicast, "
            "always in real time; rows are those that it had reported.",
        )
    )
    return found


main = bench(
    __doc__,
    measure,
    ("--times", 20, "of each kind"),
    ("--only", [*INJECTIONS, KILLED], "this kind alone"),
    ("--seconds", 60.0, "of the loop at 200 Hz"),
    ("--eds", Path, "of the drives (default: an EPOS4's)"),
    ("--stepped", False, "as fast as the machine computes, not in real time"),
)
