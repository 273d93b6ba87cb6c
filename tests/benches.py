"""Benches of the device's tests: tendons as springs, both ends of a virtual bus, a started prototype."""

import itertools
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from fastrod.errors import InputError
from fastrod_device.can.clock import SteppedClock
from fastrod_device.can.drive import DriveBus
from fastrod_device.can.pacer import Pacer
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.emulator.nodes import EmulatedDrives
from fastrod_device.emulator.seal import seal
from fastrod_device.prototype import Prototype

BENT = np.array([-0.002, 0.001, 0.002, -0.001])
"""m of tendon, that bend the prototype."""
_numbers = itertools.count()


def own_bus():
    """Name a virtual bus that no other bench has."""
    return f"virtual:test-{next(_numbers)}"


class Springs:
    """Tendons that are springs [N/m] once their slack [m] is pulled in; without stiffness they are loose."""

    def __init__(self, stiffness=0.0, slack=0.0):
        self.stiffness, self.slack = stiffness, slack

    def move(self, t, pulled):
        return np.maximum(0.0, self.stiffness * (pulled - self.slack))


class BusBench:
    """Emulated EPOS4 drives and the controller's end, on a bus of their own at 100 Hz.

    `own` and `emulated` are the EDS files of the two ends, `expected` what the controller takes the drives
    for."""

    def __init__(self, specs, tendons, clock=None, *, expected=None, own=None, emulated=None):
        self.name, self.clock = own_bus(), clock or SteppedClock()
        self.nodes = EmulatedDrives(specs, self.name, clock=self.clock, tendons=tendons, eds=emulated)
        self.bus = DriveBus(expected or specs, self.name, clock=self.clock, rate=100.0, eds=own)

    def run(self, cycles=1, target=None):
        """Measure so many exchanges at the bus's rate."""
        pacer, seen = Pacer(self.clock, 100.0), []
        for _ in range(cycles):
            seen.append(self.bus.exchange(target))
            pacer.wait()
        return seen

    def held(self, index, sub=0):
        """Values of an object in all drives."""
        return [node.objects.values[(index, sub)] for node in self.nodes._nodes]

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.bus.close()
        self.nodes.close()


class Changed:
    """The emulator's camera, with something done to each of its frames."""

    def __init__(self, emulator, change):
        self.emulator, self.change = emulator, change

    def read(self):
        frame = self.emulator.read()
        return None if frame is None else self.change(frame)

    def close(self):
        pass


@contextmanager
def started(hardware, clock=None, *, camera=True, home=False, change=None, journal=None):
    """A started prototype on its emulator; unless it homes, its tendons have their pretension at power-on.
    `change` is made to each frame."""
    clock, bus = clock or SteppedClock(), own_bus()
    with pytest.MonkeyPatch.context() as patch:
        if not clock.stepped:  # drives that bear a busy machine, too
            patch.setattr("fastrod_device.can.configuring.PATIENCE", 8.0)
            patch.setattr("fastrod_device.can.cycle._PAUSE", 7.0)
        emulator = Emulator(hardware, bus, clock=clock, seal=seal(5, "none"), seed=5, taut=not home)
        try:
            source = None if not camera else emulator if change is None else Changed(emulator, change)
            with Prototype(hardware, bus, source, clock=clock, journal=journal) as prototype:
                try:
                    prototype.start(home=home)
                    yield prototype, emulator
                finally:
                    if prototype.recorder is not None and prototype.recorder.recording:
                        with suppress(InputError):
                            prototype.recorder.stop()
        finally:
            emulator.close()
