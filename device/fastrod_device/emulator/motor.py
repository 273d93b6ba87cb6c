"""An emulated drive with its motor: the states of CiA 402, and a shaft that follows what it is commanded."""

from __future__ import annotations

import math
from typing import final

from fastrod_device.can.dictionary import Key
from fastrod_device.can.faultcodes import (
    ENABLED,
    FAULT,
    QUICK_STOP,
    REACTION,
    READY,
    STATUS_BITS,
    SWITCH_ON_DISABLED,
    SWITCHED_ON,
)
from fastrod_device.emulator.objects import Objects
from fastrod_device.units import DriveSpec

PROFILE, HOMING, CYCLIC = 1, 6, 8
"""Modes of operation, object 0x6060."""
SUBSTEP = 1e-3
"""Step of the position controller [s]."""
_LAG = 3e-3  # s, of the position loop
_ACCELERATION = 5e6  # counts/s2 that the motor can
_COAST = 2e6  # counts/s2 by which friction of the gear stops a shaft without current
# bits of the error register by the code's first digit; 0x81.. is communication
_REGISTER = {0x2: 0x02, 0x3: 0x04, 0x4: 0x08}


@final
class Motor:
    """One axis. Positions in counts; growing counts pull the tendon where the spec's direction is +1.

    A shaft without current is held by the friction of its gear. The current is that of the tendon's tension;
    the motor's own inertia and friction are left out. Where the tendon pulls with what the greatest current
    (object 0x3001:02) gives or more, the shaft turns no further against it. A limit that its dictionary lacks
    limits nothing; any other absent object has the shipped dictionary's value.
    """

    def __init__(self, spec: DriveSpec, objects: Objects) -> None:
        """At rest at 0, switched off."""
        self.spec, self.objects = spec, objects
        self.x = 0.0
        """True angle of the shaft since power-on [counts]."""
        self.v = 0.0
        """[counts/s]."""
        self.offset = 0.0
        """Offset of the drive's counter from the true angle [counts]."""
        self.torque = 0.0
        """That holds the tendon, [thousandths of the rated torque]."""
        self.noise = 0.0
        """Noise of the commanded torque."""
        self.blocked = False
        self.lasting = 0
        """Code of a fault whose cause is not gone, or 0."""
        self.emergencies: list[tuple[int, int]] = []
        """Codes and registers that wait to be sent."""
        self.stopped_at = math.nan
        """When the shaft came to rest last [s]; kept by who advances it."""
        self.rested = 0.0
        """When it came to rest in the last `advance`, from its beginning [s]."""
        live = objects.live
        live[(0x6041, 0)], live[(0x6064, 0)] = self.statusword, self.position
        live[(0x606C, 0)], live[(0x6077, 0)] = self.velocity, self.reported_torque
        live[(0x60F4, 0)], live[(0x6061, 0)] = self.following_error, lambda: self.mode
        live[(0x1001, 0)], live[(0x603F, 0)] = lambda: self.register, lambda: self.code
        live[(0x30D1, 1)] = live[(0x30D1, 2)] = self.current
        live[(0x30D2, 1)] = self.reported_torque
        self.restart()

    def restart(self) -> None:
        """Power-on: switched off, no fault, no mode but the profile's; the counter stays."""
        self.state = SWITCH_ON_DISABLED
        self.code = self.register = self.mode_changes = 0
        self.mode = PROFILE
        self.homing = ""
        self.referenced = self.acknowledged = self.reached = self.limited = False
        self._word = 0
        self._hold()

    @property
    def measured(self) -> float:
        """Return what the encoder says [counts], not rounded."""
        return self.x + self.offset

    @property
    def powered(self) -> bool:
        """The motor carries current."""
        return self.state in (ENABLED, QUICK_STOP, REACTION)

    # what it says

    def statusword(self) -> int:
        """Object 0x6041."""
        word = STATUS_BITS[self.state] | 0x0210
        word |= 0x0400 if self.reached and self.mode != CYCLIC else 0
        word |= 0x0800 if self.limited else 0
        if self.mode == HOMING:
            word |= {"attained": 0x1000, "error": 0x2000}.get(self.homing, 0)
        else:
            follows = self.acknowledged if self.mode == PROFILE else self.state == ENABLED
            word |= (0x1000 if follows else 0) | (0x2000 if self.code == 0x8611 else 0)
        return word | (0x8000 if self.referenced else 0)

    def position(self) -> int:
        """Object 0x6064 [counts]."""
        return _int32(round(self.measured))

    def velocity(self) -> int:
        """Object 0x606C, in the unit of object 0x60A9."""
        return _int32(round(self.v / self._rate_unit()))

    def reported_torque(self) -> int:
        """Object 0x6077; 0 without current."""
        most = self._greatest_torque()
        carried = max(-most, min(most, self.torque))
        return max(-32768, min(32767, round(carried + self.noise))) if self.powered else 0

    def current(self) -> int:
        """Object 0x30D1 [mA]."""
        return round(self.reported_torque() / self._per_milliampere())

    def following_error(self) -> int:
        """Object 0x60F4 [counts]."""
        return _int32(round(self.command - self.measured)) if self.powered else 0

    # what it is commanded

    def written(self, key: Key, value: int) -> None:
        """An object is about to be written. Raises an SDO abort for what cannot be."""
        if key == (0x6060, 0):
            if value not in (PROFILE, HOMING, CYCLIC) or not self.objects.get(0x6502) >> (value - 1) & 1:
                raise self.objects.refuse()
            if value != self.mode:
                self.mode, self.homing, self.reached, self.acknowledged = value, "", False, False
                self._hold()
        elif key == (0x6040, 0):
            self.control(value)
        elif key == (0x60A9, 0):
            if value & 0xFFFFFF != 0xB44700 or not -6 <= _exponent(value) <= 0:
                raise self.objects.refuse()
        elif (key == (0x6098, 0) and value not in (-4, -3, 37)) or (
            key == (0x605A, 0) and value not in (2, 6)
        ):
            raise self.objects.refuse()
        elif key == (0x607A, 0):
            self.set_target(value)

    def control(self, word: int) -> None:
        """A controlword came: transitions of CiA 402."""
        rising = word & ~self._word
        self._word = word
        if self.state in (FAULT, REACTION):
            if rising & 0x80 and self.state == FAULT:
                self._reset()
            return
        if not word & 0x02:  # disable voltage
            self._to(SWITCH_ON_DISABLED)
        elif not word & 0x04:
            if self.state == ENABLED:
                self.quick_stop()
            elif self.state in (READY, SWITCHED_ON):
                self._to(SWITCH_ON_DISABLED)
        elif word & 0x0F == 0x06:
            if self.state != QUICK_STOP:
                self._to(READY)
        elif word & 0x0F == 0x07:
            if self.state in (READY, ENABLED):
                self._to(SWITCHED_ON)
        elif word & 0x0F == 0x0F:
            # EPOS4 goes on from "quick stop active" as well, where it holds there: transition 16
            if self.state in (READY, SWITCHED_ON) or (self.state == QUICK_STOP and self._holds()):
                self._to(ENABLED)
            if self.state == ENABLED:
                self._start(word, rising)

    def set_target(self, target: int) -> None:
        """A target position came [counts]."""
        low, high = self.objects.get(0x607D, 1), self.objects.get(0x607D, 2)
        clipped = max(low, min(high, target)) if low < high else target
        self.limited = clipped != target
        self._target = float(clipped)

    def setpoint(self) -> None:
        """A SYNC with a new set-point, in the cyclic mode: go there in one interpolation period."""
        if self.state == ENABLED and self.mode == CYCLIC:
            period = max(SUBSTEP, self.objects.get(0x60C2, 1) * 10.0 ** self.objects.get(0x60C2, 2))
            self.goal, self._left = self._target, period
            self.command_rate = (self.goal - self.command) / period

    def quick_stop(self) -> None:
        """Down the ramp, then hold, or switch off, as object 0x605A says."""
        if self.state == ENABLED:
            self._to(QUICK_STOP)

    def emergency(self, code: int) -> None:
        """Tell an error that is no fault."""
        self.code = code
        self.register |= 0x01 | (
            0x10 if code >> 8 in (0x81, 0x82) else _REGISTER.get(code >> 12, 0x20 if code >> 8 == 0x86 else 0)
        )
        self.emergencies.append((code, self.register))
        if (0x1003, 1) in self.objects.values:
            self.objects.values[(0x1003, 1)] = code

    def fault(self, code: int) -> None:
        """Tell an error, stop and switch off."""
        self.emergency(code)
        self._to(REACTION if self.powered and self.v != 0.0 else FAULT)

    def _reset(self) -> None:
        if self.lasting:
            self.emergency(self.lasting)
            return
        self.code = self.register = 0
        self.emergencies.append((0, 0))
        self._to(SWITCH_ON_DISABLED)

    def _start(self, word: int, rising: int) -> None:
        """Bit 4 of the controlword: a profile or homing begins."""
        if self.mode == PROFILE:
            if rising & 0x10:
                self.goal, self.acknowledged, self.reached = self._target, True, False
            elif not word & 0x10:
                self.acknowledged = False
        elif self.mode == HOMING:
            if rising & 0x10:
                self.homing, self.reached = "search", False
                if self.objects.get(0x6098) == 37:
                    self._referenced()
            elif not word & 0x10 and self.homing in ("search", "away"):
                self.homing = ""
                self._hold()

    def _to(self, state: str) -> None:
        if state == self.state:
            return
        before, self.state = self.state, state
        if state in (QUICK_STOP, REACTION):
            self.command, self.command_rate = self.measured + self.v * (_LAG - SUBSTEP), self.v
        elif state == ENABLED or before == ENABLED or not self.powered:
            self._hold()
        if state != ENABLED and self.homing in ("search", "away"):
            self.homing = ""
        self.acknowledged = self.acknowledged and state == ENABLED

    def _hold(self) -> None:
        self.command = self.goal = self._target = self.measured
        self.command_rate = self._left = self._exceeded = 0.0

    # how it moves

    def advance(self, dt: float) -> None:
        """Move for `dt` [s]."""
        if self._resting():
            return
        n = max(1, math.ceil(dt / SUBSTEP - 1e-6))
        h = dt / n
        fastest = self._fastest()
        for k in range(n):
            before = self.v
            if self.powered:
                self._command(h)
                self._follow(h, fastest)
            else:
                self.v -= math.copysign(min(abs(self.v), _COAST * h), self.v)
                self.x += self.v * h
                self.command = self.goal = self.measured
            if self.blocked:
                self.v = 0.0
            if self.v == 0.0 and before != 0.0:
                self.rested = (k + 1) * h
            self._settle(h)

    def _resting(self) -> bool:
        if self.v != 0.0 or self.state == REACTION:
            return False
        if not self.powered:
            self.command = self.goal = self.measured
            return True
        still = (
            self.command_rate == 0.0
            and self._left == 0.0
            and self.goal == self.command
            and abs(self.command - self.measured) < 0.5
        )
        if self.state == QUICK_STOP:
            return still and self._holds()
        return still and self.homing not in ("search", "away") and (self.reached or self.mode != PROFILE)

    def _command(self, h: float) -> None:
        """The command by the mode's generator."""
        get = self.objects.get
        if self.state != ENABLED:
            change = get(0x6085) * self._per_rpm() * h
            self.command_rate -= math.copysign(min(abs(self.command_rate), change), self.command_rate)
            self.command += self.command_rate * h
            self.goal = self.command
        elif self.mode == CYCLIC:
            step = min(h, self._left)
            self.command += self.command_rate * step
            self._left -= step
            if self._left <= 1e-9:
                self.command, self.command_rate, self._left = self.goal, 0.0, 0.0
        elif self.mode == PROFILE:
            unit = self._rate_unit()
            self._profile(h, get(0x6081) * unit, get(0x6083) * self._per_rpm(), get(0x6084) * self._per_rpm())
        elif self.homing in ("search", "away"):
            speed, rate = get(0x6099, 1) * self._rate_unit(), get(0x609A) * self._per_rpm()
            if self.homing == "away":
                self._profile(h, speed, rate, rate)
                if self.reached:
                    self.homing, self.referenced = "attained", True
                return
            wanted = math.copysign(speed, 1.0 if get(0x6098) == -3 else -1.0)
            self.command_rate += max(-rate * h, min(rate * h, wanted - self.command_rate))
            self.command += self.command_rate * h
            self.goal = self.command
            if abs(self.torque) >= get(0x30B2) * self._per_milliampere():
                self._referenced()

    def _referenced(self) -> None:
        """The counter takes its value of the home position; then away from there by the distance that was
        asked for."""
        home = self.objects.get(0x30B0)
        self.offset = home - self.objects.get(0x30B1) - self.x
        self._hold()
        self.v, self.homing, self.goal, self.reached = 0.0, "away", float(home), False

    def _profile(self, h: float, speed: float, up: float, down: float) -> None:
        left = self.goal - self.command
        wanted = math.copysign(min(speed, math.sqrt(2.0 * down * abs(left))), left)
        slower = abs(wanted) < abs(self.command_rate)
        change = (1.5 * down if slower else up) * h
        self.command_rate += max(-change, min(change, wanted - self.command_rate))
        if abs(left) <= abs(self.command_rate) * h + 0.5:
            self.command, self.command_rate = self.goal, 0.0
        else:
            self.command += self.command_rate * h
        self.reached = self.command == self.goal and abs(self.command - self.measured) < 2.0

    def _follow(self, h: float, fastest: float) -> None:
        error = self.command - self.measured
        wanted = min(abs(error) / _LAG, math.sqrt(2.0 * _ACCELERATION * abs(error)), fastest)
        change = _ACCELERATION * h
        self.v += max(-change, min(change, math.copysign(wanted, error) - self.v))
        if abs(error) < 0.5 and self.command_rate == 0.0 and abs(self.v) <= change:
            self.v = 0.0
        if self.v * self.torque > 0.0 and abs(self.torque) >= self._greatest_torque():
            self.v = 0.0
        if not self.blocked:
            self.x += self.v * h

    def _settle(self, h: float) -> None:
        """Update what follows from its position: following error, end of a ramp."""
        if self.state == ENABLED:
            window = self.objects.values.get((0x6065, 0), 0)
            if window not in (0, 0xFFFFFFFF) and abs(self.command - self.measured) > window:
                self._exceeded += h
                if self._exceeded * 1e3 >= self.objects.get(0x6066):
                    self.fault(0x8611)
            else:
                self._exceeded = 0.0
        elif self.state == REACTION and self.command_rate == 0.0 and (self.v == 0.0 or self.blocked):
            self._to(FAULT)
        elif self.state == QUICK_STOP and self.command_rate == 0.0 and self.v == 0.0 and not self._holds():
            self._to(SWITCH_ON_DISABLED)

    def _holds(self) -> bool:
        """After a quick stop, as object 0x605A says."""
        return self.objects.get(0x605A) == 6

    def _per_rpm(self) -> float:
        return self.spec.counts_per_turn / 60.0

    def _rate_unit(self) -> float:
        """Counts/s of one unit of velocity."""
        return float(self._per_rpm() * 10.0 ** _exponent(self.objects.get(0x60A9)))

    def _fastest(self) -> float:
        """Counts/s: object 0x6080 limits every mode, 0x607F those whose way the drive plans."""
        keys = [(0x6080, 0)] if self.mode == CYCLIC else [(0x6080, 0), (0x607F, 0)]
        limits = [self.objects.values[key] for key in keys if key in self.objects.values]
        return min(limits, default=math.inf) * self._rate_unit()

    def _per_milliampere(self) -> float:
        """Thousandths of the rated torque of one milliampere."""
        return self.spec.torque_constant / self.spec.rated_torque

    def _greatest_torque(self) -> float:
        """Thousandths of the rated torque."""
        return self.objects.values.get((0x3001, 2), math.inf) * self._per_milliampere()


def _exponent(unit: int) -> int:
    prefix = unit >> 24
    return prefix - 256 if prefix > 127 else prefix


def _int32(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31
