"""`DynamixelBus`: Dynamixel X servos with a current sensor (XM, XH, XC330, ...) as `Drives`, over protocol
2.0.

One sync write of targets and one sync read of everything a cycle. The servos run in current-based position
control over many turns; their bus watchdog stops them when the controller falls silent. Registers and units
are those of the public control tables (ROBOTIS e-Manual, XM430-W350)."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from typing import final

import numpy as np

from fastrod.errors import InputError, shown
from fastrod.types import Ints
from fastrod_device.can.clock import Clock
from fastrod_device.can.cycle import whole
from fastrod_device.can.faultcodes import (
    ENABLED,
    FAULT,
    QUICK_STOP,
    STATUS_BITS,
    SWITCH_ON_DISABLED,
    in_words,
)
from fastrod_device.can.pacer import Pacer
from fastrod_device.dynamixel.line import (
    BUS_WATCHDOG,
    CURRENT_LIMIT,
    CURRENT_POSITION_MODE,
    CURRENT_UNIT,
    GOAL_CURRENT,
    GOAL_POSITION,
    INDIRECT_ADDRESS,
    OPERATING_MODE,
    PRESENT_POSITION,
    PROFILE_ACCELERATION,
    PROFILE_VELOCITY,
    READ_BACK,
    REVOLUTION,
    TORQUE_ENABLE,
    VELOCITY_UNIT,
    WATCHDOG_TRIPPED,
    Register,
    ServoLine,
    ServoReport,
)
from fastrod_device.dynamixel.packets import PING, REBOOT, SerialPort, open_port
from fastrod_device.errors import DeviceError
from fastrod_device.readings import DriveFeedback, Emergency
from fastrod_device.units import DriveSpec, Transmission

_CODES = {0x01: 0x3210, 0x04: 0x4310, 0x08: 0x7320, 0x10: 0x5280, 0x20: 0x2310}
"""Bits of the hardware error as CiA 301's emergency codes: input voltage, temperature, encoder, electrical
shock, overload."""
_WATCHED = 5  # times 20 ms without a packet: as long as the EPOS4's silence
_CYCLE = 0.6  # of a cycle that is waited for answers
_SILENCE = 0.1  # s
_REBOOT, _PAUSE, _REST = 2.0, 0.05, 0.2  # s


@final
class DynamixelBus:
    """See `Drives`. A servo holds where it is on a quick stop; the zeros of homing are kept here, not in
    it."""

    def __init__(
        self,
        specs: Sequence[DriveSpec],
        bus: str | SerialPort,
        *,
        clock: Clock,
        rate: float = 100.0,
        bitrate: int = 1_000_000,
    ) -> None:
        """`bus` is a serial device's name, `virtual:NAME`, or a port that stays the caller's; `rate` [1/s].
        Raises `DeviceError` for the port, `InputError`."""
        if not (isinstance(rate, (int, float)) and math.isfinite(rate) and 1.0 <= rate <= 1000.0):
            raise InputError(f"DynamixelBus.rate is {shown(rate)} 1/s; it must be from 1 to 1000.")
        self._specs, self._clock, self._rate = Transmission(specs).specs, clock, rate
        self._ids = tuple(spec.node for spec in self._specs)
        n = len(self._ids)
        self._line = ServoLine(open_port(bus, bitrate) if isinstance(bus, str) else bus)
        self._own = isinstance(bus, str)
        # amperes in a thousandth of the rated torque
        self._amperes = np.array([1e-3 * s.rated_torque / s.torque_constant for s in self._specs])
        self._zero: Ints = np.zeros(n, np.int64)
        self._hold: Ints = np.zeros(n, np.int64)  # targets as the servos count
        self._setup: list[list[tuple[Register, int]]] = []
        self._enabled = [False] * n
        self._raw = [ServoReport()] * n
        self._heard = [-math.inf] * n
        self._known_errors = [0] * n
        self._deceleration = np.ones(n)  # counts/s2
        self._gate = threading.Lock()
        self._stopping = self._acknowledged = self._closed = False
        self._reason = ""
        self.notices: tuple[str, ...] = ()
        self.newest = self._gather("")

    @property
    def stop_reason(self) -> str:
        """See `Drives`."""
        return self._reason if self._stopping else ""

    def connect(
        self,
        *,
        position_limit: Ints,  # noqa: ARG002
        velocity_limit: Ints,
        following_error: Ints,  # noqa: ARG002
        deceleration: Ints,
        torque_limit: Ints,
    ) -> None:
        """See `Drives`; position and following error are limited by the supervisor alone, as `notices`
        says."""
        for node in self._ids:
            self._line.request(node, PING, b"", "be found")
        self._setup, self._deceleration = [], np.maximum(np.asarray(deceleration, np.float64), 1.0)
        for i, node in enumerate(self._ids):
            self._line.write(node, TORQUE_ENABLE, 0)
            most = self._line.read(node, CURRENT_LIMIT)
            current = round(float(torque_limit[i] * self._amperes[i]) / CURRENT_UNIT)
            listed = [address + k for address, size in READ_BACK for k in range(size)]
            self._setup.append(
                [
                    (BUS_WATCHDOG, 0),
                    (OPERATING_MODE, CURRENT_POSITION_MODE),
                    (GOAL_CURRENT, max(1, min(current, most))),
                    (PROFILE_ACCELERATION, 0),  # none: a target is one cycle away
                    # at least 1: 0 is no limit
                    (PROFILE_VELOCITY, max(1, min(round(float(velocity_limit[i]) / VELOCITY_UNIT), 32767))),
                    *((Register(INDIRECT_ADDRESS + 2 * k, 2), address) for k, address in enumerate(listed)),
                ]
            )
            self._set_up(i)
        self._enabled = [False] * len(self._ids)
        self.notices = tuple(
            f"the servo {node} limits neither position nor following error by itself; the supervisor does."
            for node in self._ids
        )
        self._require_heard(self.exchange(), "become operational")

    def enable(self) -> None:
        """See `Drives`."""
        if not self._setup:
            raise DeviceError("the servos are not connected; connect() first.")
        if self._stopping and not self._acknowledged:
            raise DeviceError(
                f"the servos were stopped ({self._reason}); acknowledge() before they are enabled again."
            )
        now = self.exchange()
        self._require_heard(now, "report where they are")
        self._refuse_faults("is in fault")
        for i, node in enumerate(self._ids):
            if self._enabled[i]:
                continue
            self._hold[i] = self._raw[i].position
            self._line.write(node, BUS_WATCHDOG, 0)  # one that has tripped refuses targets
            self._line.write(node, GOAL_POSITION, int(self._hold[i]))
            self._line.write(node, TORQUE_ENABLE, 1)
        with self._gate:
            if self._acknowledged or not self._stopping:
                self._stopping = self._acknowledged = False
        self._enabled = [True] * len(self._ids)
        for node in self._ids:  # last: all that came before took its time
            self._line.write(node, BUS_WATCHDOG, _WATCHED)
        self.exchange()

    def acknowledge(self) -> None:
        """See `Drives`."""
        with self._gate:
            self._acknowledged = self._stopping

    def reset_faults(self) -> None:
        """See `Drives`: a servo in fault is rebooted, and set up again."""
        now = self.exchange()
        self._require_heard(now, "report how they are")
        for i, node in enumerate(self._ids):
            if not self._raw[i].error:
                continue
            before = self._raw[i].position
            self._line.request(node, REBOOT, b"", "be rebooted")
            end = self._clock.now() + _REBOOT
            while True:
                try:
                    self._line.request(node, PING, b"", "come back from its reboot")
                    break
                except DeviceError:
                    if self._clock.now() >= end:
                        raise
                    self._clock.sleep_until(self._clock.now() + _PAUSE)
            self._enabled[i], self._known_errors[i] = False, 0
            self._set_up(i)
            # whole turns are forgotten; a shaft that is held by its gear has not gone half a turn meanwhile
            revolutions = round((before - self._line.read(node, PRESENT_POSITION)) / REVOLUTION)
            self._zero[i] -= revolutions * REVOLUTION
        self.exchange()
        self._refuse_faults("stays in fault")

    def exchange(self, target: Ints | None = None) -> DriveFeedback:
        """See `Drives`. Returns when all servos have answered, after 0.6 of a cycle at most. Raises
        `InputError` for a target of another shape or kind."""
        goal = None if target is None else np.array(whole(len(self._ids), target, "target")) + self._zero
        lost = ""
        try:  # first how far the last targets have come, then the new ones
            reports = self._line.reports(self._ids, _CYCLE / self._rate)
        except OSError as error:
            lost, reports = f"the serial port carries nothing: {error}", {}
        for i, node in enumerate(self._ids):
            if node in reports:
                self._raw[i], self._heard[i] = reports[node], self._clock.now()
        feedback = self._gather(lost)
        with self._gate:
            if goal is not None and not self._stopping:
                self._hold = goal
        try:
            if any(self._enabled):
                self._line.aim(self._targets())
        except OSError as error:
            feedback = replace(feedback, lost=f"the serial port carries nothing: {error}")
        self.newest = feedback
        return feedback

    def quick_stop(self, reason: str = "quick stop was requested") -> str:
        """See `Drives`: each servo is to hold where the deceleration of `connect` brings it to rest from
        where it was last heard to be."""
        with self._gate:
            if not self._stopping or self._acknowledged:
                self._reason = reason
            if not self._stopping or self._acknowledged:
                speed = np.array([raw.velocity for raw in self._raw]) * VELOCITY_UNIT
                ahead = np.rint(np.sign(speed) * speed**2 / (2.0 * self._deceleration)).astype(np.int64)
                self._hold = np.array([raw.position for raw in self._raw], dtype=np.int64) + ahead
            self._acknowledged, self._stopping = False, True
        try:
            if any(self._enabled):
                self._line.aim(self._targets(), wait=_CYCLE / self._rate)
        except Exception as error:  # adapters raise what they like
            return f"{type(error).__name__}: {error}"
        return ""

    def homing(
        self, threshold: Ints, speed: Ints, *, rounds: int = 2, time_limit: float = 30.0
    ) -> DriveFeedback:
        """See `Drives`; `rounds`: what one tendon pulls the others feel. `time_limit` [s] of each."""
        self.enable()
        at = self._hold.astype(np.float64)
        for i in list(range(len(self._ids))) * rounds:
            spec, end = self._specs[i], self._clock.now() + time_limit
            pacer = Pacer(self._clock, self._rate)
            while spec.direction * self.newest.torque[i] < threshold[i]:
                at[i] += spec.direction * float(speed[i]) / self._rate
                feedback = self.exchange(np.rint(at).astype(np.int64) - self._zero)
                try:
                    self._refuse_faults("is in fault")
                    self._require_heard(feedback, "be homed")
                    if self._stopping or self._clock.now() >= end:
                        why = self._reason if self._stopping else f"no tension within {time_limit:g} s"
                        raise DeviceError(f"the tendon of servo {spec.node} is not homed: {why}.")
                except DeviceError:
                    self.quick_stop("homing did not end")
                    raise
                pacer.wait()
            at[i] = self._raw[i].position
            self._zero[i] = self._raw[i].position
        return self.exchange(np.rint(at).astype(np.int64) - self._zero)

    def close(self) -> None:
        """See `Drives`."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(DeviceError, OSError):
            if any(self._enabled):
                self.quick_stop()
                pacer, end = Pacer(self._clock, self._rate), self._clock.now() + _REST
                while self.exchange().velocity.any() and self._clock.now() < end:
                    pacer.wait()
            for node in self._ids if self._setup else ():
                self._line.write(node, TORQUE_ENABLE, 0)
                self._line.write(node, BUS_WATCHDOG, 0)
        if self._own:
            with contextlib.suppress(OSError):
                self._line.port.close()

    def _set_up(self, i: int) -> None:
        for register, value in self._setup[i]:
            self._line.write(self._ids[i], register, value)

    def _targets(self) -> dict[int, int]:
        return dict(zip(self._ids, self._hold.tolist(), strict=True))

    def _gather(self, lost: str) -> DriveFeedback:
        """Return what is known now, in CiA 402's words; a servo that stopped by itself is enabled no more."""
        now = self._clock.now()
        columns = (np.array(column, np.int64) for column in zip(*self._raw, strict=True))
        on, errors, dog, current, velocity, position = columns
        age = now - np.array(self._heard)
        mail = []
        for i, bits in enumerate(errors.tolist()):
            fresh = bits & ~self._known_errors[i]
            mail += [Emergency(i, code, bits, now) for bit, code in _CODES.items() if fresh & bit]
            self._known_errors[i] = bits
            if bits or not on[i] or dog[i] == WATCHDOG_TRIPPED or age[i] > _SILENCE:
                self._enabled[i] = False
        states = [self._state(bool(on[i]), int(errors[i]), int(dog[i])) for i in range(len(self._ids))]
        if not lost and self._setup and age.min() > _SILENCE:
            lost = f"no servo has answered for {age.min():.2f} s; is the cable plugged in and the power on?"
        return DriveFeedback(
            t=now,
            position=position - self._zero,
            velocity=np.rint(velocity * VELOCITY_UNIT).astype(np.int64),
            torque=np.rint(current * CURRENT_UNIT / self._amperes).astype(np.int64),
            following_error=np.where(on == 1, self._hold - position, 0),
            statusword=np.array([STATUS_BITS[state] for state in states], np.int64),
            age=age,
            heartbeat_age=age,
            nmt=np.where(np.isfinite(age), 5, -1),
            emergencies=tuple(mail),
            lost=lost,
        )

    def _state(self, on: bool, errors: int, dog: int) -> str:
        if errors:
            return FAULT
        if not on:
            return SWITCH_ON_DISABLED
        return QUICK_STOP if self._stopping or dog == WATCHDOG_TRIPPED else ENABLED

    def _refuse_faults(self, what: str) -> None:
        """Raises `DeviceError` for the first servo in fault."""
        for node, raw in zip(self._ids, self._raw, strict=True):
            if raw.error:
                why = ", ".join(in_words(code) for bit, code in _CODES.items() if raw.error & bit) or hex(
                    raw.error
                )
                raise DeviceError(f"the servo {node} {what}: {why}.")

    def _require_heard(self, now: DriveFeedback, what: str) -> None:
        """Raises `DeviceError` where a servo has said nothing lately."""
        for node, age in zip(self._ids, now.age, strict=True):
            if not age <= _SILENCE:
                raise DeviceError(f"the servo {node} does not answer; it was to {what}. {now.lost}".rstrip())
