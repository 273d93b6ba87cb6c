"""A bench to work at: the prototype on a real bus, or its emulator, with hands for what motors cannot do."""

from __future__ import annotations

import itertools
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from fastrod.checks import NOT_NEGATIVE, check_number
from fastrod_device.bench.boards import BoardEye, BoardMover, BoardPrompts, bent, moved
from fastrod_device.bench.experiment import BenchAssistant, BenchPrompts
from fastrod_device.can.clock import Clock, SteppedClock, WallClock
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.emulator.seal import seal
from fastrod_device.hardware import Hardware
from fastrod_device.journal import Journal
from fastrod_device.prototype import Prototype
from fastrod_device.vision.calibration import CharucoBoard
from fastrod_device.vision.camera import Camera, FrameSource, VideoCamera

_SCATTER = 0.08
"""Scatter of an emulated body's stiffnesses about the robot file's, as a fraction."""
_COUNT = itertools.count(1)


@dataclass(frozen=True, kw_only=True, eq=False)
class EmulatedBench:
    """A prototype and who helps it."""

    prototype: Prototype
    assistant: BenchAssistant
    emulator: Emulator | None
    """None where the prototype is real."""


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardBench:
    """A camera and who shows a board to it."""

    source: FrameSource
    assistant: BoardMover
    clock: Clock
    truth: Camera | None
    """True lens and pose of an emulated camera; None where it is real."""


@contextmanager
def emulated(
    hardware: Hardware,
    *,
    seed: int | None = None,
    effect: str | None = None,
    stepped: bool = True,
    bus: str | None = None,
    journal: str | Path | None = None,
    home: bool = True,
    eds: str | Path | None = None,
) -> Iterator[EmulatedBench]:
    """The emulator, started, with a sealed plant: `seed` draws what is hidden (None: nobody knows), `effect`
    names it for those who test.

    `stepped` runs as fast as the machine computes; otherwise in real time. `bus`: None is a virtual one of
    its own. Without `home` the tendons are taut from the start. `eds`: the file that lists the drives'
    objects, for both ends.
    """
    clock = SteppedClock() if stepped else WallClock()
    name = bus or f"virtual:fastrod-{next(_COUNT)}"
    hidden = seal(seed, effect, scatter=_SCATTER)
    emulator = Emulator(hardware, name, clock=clock, seal=hidden, seed=seed or 0, taut=not home, eds=eds)
    try:
        with Prototype(hardware, name, emulator, clock=clock, eds=eds, journal=Journal(journal)) as prototype:
            prototype.start(home=home)
            yield EmulatedBench(prototype=prototype, assistant=emulator, emulator=emulator)
    finally:
        emulator.close()


@contextmanager
def real(
    hardware: Hardware,
    bus: str,
    *,
    camera: int | str | None = 0,
    eds: str | Path | None = None,
    journal: str | Path | None = None,
    home: bool = True,
) -> Iterator[EmulatedBench]:
    """The prototype on `bus` ("socketcan:can0"), with the video device `camera` (None: without), started, a
    person's hands beside it.

    Raises `DeviceError`, one sentence, for what is not there or does not answer.
    """
    source: FrameSource | None = None if camera is None else VideoCamera(hardware.camera, camera)
    try:
        with Prototype(hardware, bus, source, eds=eds, journal=Journal(journal)) as prototype:
            prototype.start(home=home)
            yield EmulatedBench(prototype=prototype, assistant=BenchPrompts(), emulator=None)
    finally:
        if source is not None:
            source.close()


@contextmanager
def emulated_board(
    camera: Camera, board: CharucoBoard, *, lens: bool, seed: int | None = None, stepped: bool = True
) -> Iterator[BoardBench]:
    """A camera whose frames are drawn: with another lens than `camera` has, or, without `lens`, at another
    place; `seed` draws which (None:
    nobody knows). Raises `InputError` for a seed that is none."""
    clock: Clock = SteppedClock() if stepped else WallClock()
    drawn = secrets.randbits(63) if seed is None else seed
    check_number("seed", drawn, NOT_NEGATIVE, whole=True)
    truth = bent(camera, drawn) if lens else moved(camera, drawn)
    eye = BoardEye(truth, board, clock=clock, seed=drawn)
    yield BoardBench(source=eye, assistant=eye, clock=clock, truth=truth)


@contextmanager
def real_board(camera: Camera, device: int | str) -> Iterator[BoardBench]:
    """The video device as `camera`, and a person who holds the board. Raises `DeviceError` where it cannot be
    opened."""
    source = VideoCamera(camera, device)
    try:
        yield BoardBench(source=source, assistant=BoardPrompts(), clock=WallClock(), truth=None)
    finally:
        source.close()
