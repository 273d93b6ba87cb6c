"""`Drives`: what the prototype asks of its motors, and the kinds that there are.

A driver is a class of this protocol, made as `DriveBus` is: `Kind(specs, bus, clock=..., rate=...,
bitrate=...)`. A package of yours registers one as an entry point of the group `fastrod.drives`; the hardware
file then says `[bus] kind = "..."`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from fastrod.errors import InputError, UnknownNameError, nearest, shown
from fastrod.types import Ints
from fastrod_device.can.clock import Clock
from fastrod_device.readings import DriveFeedback
from fastrod_device.units import DriveSpec

GROUP = "fastrod.drives"
_DRIVERS: Mapping[str, str] = {
    "epos4": "fastrod_device.can.drive:DriveBus",
    "dynamixel": "fastrod_device.dynamixel.drives:DynamixelBus",
}
_EMULATORS: Mapping[str, str] = {
    "epos4": "fastrod_device.emulator.nodes:EmulatedDrives",
    "dynamixel": "fastrod_device.emulator.dynamixel:EmulatedDynamixels",
}
_SLOWEST, _QUICKEST = 9600, 10_000_000  # bit/s


class Drives(Protocol):
    """All drives of a robot. The drive axis comes first and is in the order of the robot's tendons.

    `DriveFeedback` speaks CiA 402 and CiA 301, whatever the drives speak: a driver of others translates.
    Calls that set up belong to one thread; `quick_stop` and `acknowledge` may come from any."""

    @property
    def newest(self) -> DriveFeedback:
        """Return the feedback of the last exchange."""

    @property
    def notices(self) -> tuple[str, ...]:
        """Return what the drives do not limit by themselves, a sentence each; known after `connect`."""

    @property
    def stop_reason(self) -> str:
        """Why the drives are kept stopped; empty while they are not."""

    def connect(
        self,
        *,
        position_limit: Ints,
        velocity_limit: Ints,
        following_error: Ints,
        deceleration: Ints,
        torque_limit: Ints,
    ) -> None:
        """Find the drives and set what they refuse by themselves, each (n_drives,): targets beyond
        +-`position_limit` [counts], speeds beyond `velocity_limit` [counts/s], a fault beyond
        `following_error` [counts], `torque_limit` [thousandths of the rated torque]; a quick stop is by
        `deceleration` [counts/s2]. They stay switched off. Raises `DeviceError`: the first drive that does
        not answer or refuses."""

    def enable(self) -> None:
        """Switch all drives on, each to hold where it is. Raises `DeviceError`: a drive is in fault or does
        not switch on, or they were stopped and nobody called `acknowledge`."""

    def exchange(self, target: Ints | None = None) -> DriveFeedback:
        """One cycle: `target` (n_drives,) [counts] to the drives, None for the last one, and what they
        report. A bus that fails raises nothing: `DriveFeedback.lost` says why."""

    def quick_stop(self, reason: str = "quick stop was requested") -> str:
        """Stop all drives at once, from any thread; they stay stopped until `acknowledge` and `enable`.
        Raises nothing: it returns why the stop could not be sent, or ""."""

    def acknowledge(self) -> None:
        """Somebody has seen that the drives were stopped; `enable` may switch them on again."""

    def reset_faults(self) -> None:
        """Reset the drives that are in fault; they stay switched off. Raises `DeviceError`: one stays in
        fault."""

    def homing(self, threshold: Ints, speed: Ints) -> DriveFeedback:
        """Pull the tendons in, one after another, at `speed` (n_drives,) [counts/s], until each is taut at
        `threshold` (n_drives,) [thousandths of the rated torque]; the counts there become 0, and the drives
        stay enabled. Raises `DeviceError`, with the drives stopped."""

    def close(self) -> None:
        """Stop the drives, switch them off and leave the bus. Raises nothing for drives that do not
        answer."""


@dataclass(frozen=True, kw_only=True)
class BusSpec:
    """`[bus]` of a hardware file. Raises `InputError`, `UnknownNameError`."""

    kind: str = "epos4"
    """Kind of the drives."""
    bitrate: int = 1_000_000
    """[bit/s]."""

    def __post_init__(self) -> None:
        if self.kind not in (known := drive_kinds()):
            raise UnknownNameError(f"no kind of drives {self.kind!r}; {nearest(self.kind, known)}")
        if isinstance(self.bitrate, bool) or not _SLOWEST <= self.bitrate <= _QUICKEST:
            raise InputError(
                f"bitrate is {shown(self.bitrate)}; it must be from {_SLOWEST} to {_QUICKEST} bit/s."
            )


class DrivenRobot(Protocol):
    """The drives of a hardware file (`Hardware`)."""

    @property
    def drives(self) -> tuple[DriveSpec, ...]:
        """In the order of the robot's tendons."""

    @property
    def rate(self) -> float:
        """Rate of the control loop [Hz]."""

    @property
    def bus(self) -> BusSpec:
        """Kind of the drives, and bit rate."""


def drive_kinds() -> tuple[str, ...]:
    """Kinds of drives: the shipped ones, then those of installed packages."""
    return tuple(dict.fromkeys([*_DRIVERS, *(found.name for found in entry_points(group=GROUP))]))


def open_drives(hardware: DrivenRobot, bus: str, *, clock: Clock, eds: str | Path | None = None) -> Drives:
    """The drives of a hardware file at `bus`, whose name is the driver's matter ("socketcan:can0",
    "/dev/ttyUSB0"). `eds`: the file that lists an EPOS4's objects. Raises `DeviceError` where there is no
    such bus, `InputError`."""
    kind = hardware.bus.kind
    more: dict[str, Any] = {}
    if eds is not None:
        if kind != "epos4":
            raise InputError(f"an EDS file is given; drives of the kind {kind!r} have none.")
        more["eds"] = eds
    plug_in = next((found for found in entry_points(group=GROUP) if found.name == kind), None)
    driver: Any = _named(_DRIVERS[kind]) if plug_in is None or kind in _DRIVERS else plug_in.load()
    drives: Drives = driver(
        hardware.drives, bus, clock=clock, rate=hardware.rate, bitrate=hardware.bus.bitrate, **more
    )
    return drives


def emulated_drives(hardware: DrivenRobot, bus: Any, **given: Any) -> Any:
    """Emulated drives of a hardware file's kind, at `bus`. Raises `InputError` for a kind that has no
    emulator."""
    kind = hardware.bus.kind
    if kind not in _EMULATORS:
        raise InputError(
            f"drives of the kind {kind!r} have no emulator; those of {', '.join(_EMULATORS)} do."
        )
    return _named(_EMULATORS[kind])(hardware.drives, bus, **given)


def _named(place: str) -> Any:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)
