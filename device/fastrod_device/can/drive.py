"""The drives of the prototype, from the controller's side: one bus, one SYNC, one word to and from each drive
in every cycle."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Literal, final

import numpy as np

from fastrod.checks import check_number
from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.types import Floats, Ints
from fastrod_device.can.bus import BusLine
from fastrod_device.can.clock import Clock
from fastrod_device.can.configuring import Configurator, DriveLimits
from fastrod_device.can.cycle import OFF, RESET, RUN, START, Cycle, whole
from fastrod_device.can.dictionary import object_dictionary
from fastrod_device.can.faultcodes import ENABLED, FAULT, QUICK_STOP, READY, SWITCHED_ON, state_in_words
from fastrod_device.errors import DeviceError
from fastrod_device.readings import DriveFeedback, Emergency
from fastrod_device.units import DriveSpec, Transmission

if TYPE_CHECKING:
    import can

Mode = Literal["csp", "ppm"]
_MODES = {"csp": 8, "ppm": 1}
_ENABLING, _RAMP = 2.0, 0.2  # s
_REACHED, _ACKNOWLEDGED, _ERROR = 0x0400, 0x1000, 0x2000  # bits of the statusword; homing: attained, error


@dataclass(frozen=True)
class Jitter:
    """Deviation of the periods of SYNC from their nominal length [s]."""

    n: int
    p50: float
    p99: float
    max: float


@final
class DriveBus:
    """All EPOS4 drives of a robot on one CAN bus, as `Drives`.

    `connect`, then `enable`, then `exchange` once a cycle; its caller keeps the time (`Pacer`). `exchange`
    and the calls that cycle by themselves (`enable`, `disable`, `reset_faults`, `profile_move`, `homing`)
    belong to one thread; `quick_stop` may come from any. SDO is used in calls that set up, never in
    `exchange`.

    A drive that left "operation enabled" by itself, or was not heard for 0.1 s, is commanded to stay stopped
    until `enable`. When the controller paused for so long that the drives stopped by themselves, all are
    commanded to stay stopped (`stop_reason`).
    """

    def __init__(
        self,
        specs: Sequence[DriveSpec],
        bus: str | can.BusABC,
        *,
        clock: Clock,
        rate: float = 200.0,
        bitrate: int = 1_000_000,
        eds: str | Path | None = None,
    ) -> None:
        """`rate` [1/s], of cycles; its period is a whole number of ms. `bitrate` [bit/s], of an adapter.
        `eds`: the drives' own dictionary.

        Raises `InputError`, also for the EDS file, or `DeviceError` for the bus.
        """
        period = (
            1e3 / rate if isinstance(rate, (int, float)) and math.isfinite(rate) and rate > 0.0 else math.nan
        )
        if not (1.0 <= period <= 40.0 and abs(period - round(period)) < 1e-6):
            raise InputError(
                f"DriveBus.rate is {rate!r} 1/s; its period must be a whole number of ms from 1 to 40."
            )
        self._specs = Transmission(specs).specs
        dictionary = object_dictionary(eds)
        self._line = BusLine(bus, bitrate)
        self._cycle = Cycle(self._line, self._specs, clock, float(rate))
        self._configurator = Configurator(self._line, dictionary, self._specs, self._cycle.beat)
        self._closed = False
        self._line.start()

    # what is known

    @property
    def n_drives(self) -> int:
        """Number of drives."""
        return len(self._specs)

    @property
    def newest(self) -> DriveFeedback:
        """Return the feedback of the last exchange."""
        return self._cycle.newest

    @property
    def missed(self) -> int:
        """Cycles in which not every drive answered in time, since `reset_statistics`."""
        return self._cycle.inbox.missed

    @property
    def sdo_requests(self) -> int:
        """SDO requests sent so far."""
        return self._configurator.requests

    @property
    def stop_reason(self) -> str:
        """Why the drives are commanded to stay stopped; empty while they are not."""
        return self._cycle.reason if self._cycle.stopping else ""

    @property
    def emergency_log(self) -> tuple[Emergency, ...]:
        """The last 1000 emergency messages, those of calls that cycled by themselves included."""
        return tuple(self._cycle.inbox.log)

    @property
    def jitter(self) -> Jitter:
        """Return the jitter of the SYNCs since `reset_statistics`."""
        off = np.abs(np.diff(np.array(self._cycle.syncs)) - 1.0 / self._cycle.rate)
        if not len(off):
            return Jitter(0, math.nan, math.nan, math.nan)
        return Jitter(len(off), float(np.quantile(off, 0.5)), float(np.quantile(off, 0.99)), float(off.max()))

    def reset_statistics(self) -> None:
        """`jitter` and `missed` count from now."""
        self._cycle.syncs.clear()
        self._cycle.inbox.missed = 0

    @property
    def notices(self) -> tuple[str, ...]:
        """Return what the drives do not limit for want of an object, a sentence each; known after
        `connect`."""
        return tuple(self._configurator.notices)

    # setting up

    def connect(
        self,
        *,
        position_limit: Ints | int = 2**31 - 1,
        velocity_limit: Ints | int = 500_000,
        following_error: Ints | int = 2000,
        deceleration: Ints | int = 2_000_000,
        torque_limit: Ints | int = 3000,
        hold: bool = True,
    ) -> None:
        """Find the drives, tell them their limits and process data, and make them operational; they stay
        switched off.

        What drives refuse by themselves, one number or (n_drives,): targets beyond +-`position_limit`
        [counts], speeds beyond
        `velocity_limit` [counts/s], a fault beyond `following_error` [counts]; their motors carry the current
        of `torque_limit` [thousandths of the rated torque] at most. A quick stop is by `deceleration`
        [counts/s2]; then the motors `hold` the tendons or are switched off. A limit whose object a drive
        lacks is left out, as `notices` says.
        Call it again after a drive has rebooted.
        Raises `InputError`, or `DeviceError`: the first drive that does not answer, is another device, or
        refuses.
        """
        setup, n = self._configurator, self.n_drives
        limits = DriveLimits(
            position_limit=position_limit,
            velocity_limit=velocity_limit,
            following_error=following_error,
            deceleration=deceleration,
            torque_limit=torque_limit,
            hold=hold,
        )
        for name in ("position_limit", "velocity_limit", "following_error", "deceleration", "torque_limit"):
            limits.of(name, n)
        self._cycle.words, self._cycle.enabled, self._cycle.configured = [OFF] * n, [False] * n, [False] * n
        setup.notices.clear()
        for i in range(n):
            setup.identify(i)
        for i in range(n):
            setup.write(i, 0x6040, 0, OFF)  # a drive may still be enabled by a controller that went away
            self._cycle.command(128, self._cycle.ids[i])
            setup.limit(i, limits, self._cycle.rate)
            setup.map(i)
            setup.watch(i, on=True)
        self._cycle.beat()
        for node in self._cycle.ids:
            self._cycle.command(1, node)
        self._cycle.configured = [True] * n
        self._cycle.until(
            1.0,
            lambda now: bool(np.all(now.nmt == 5) and np.all(now.age < 3.0 / self._cycle.rate)),
            "become operational",
        )

    def enable(self, mode: Mode = "csp") -> None:
        """Switch all drives on, each with the position that it has as its target.

        Raises `DeviceError`: a drive is in fault, does not switch on in time, was not connected or has
        rebooted; or the drives were stopped and nobody called `acknowledge`. `UnknownNameError` for the mode.
        """
        if mode not in _MODES:
            raise UnknownNameError(f"no mode {mode!r}; {nearest(str(mode), _MODES)}")
        self._cycle.require_connected()
        if self._cycle.stopping and not self._cycle.acknowledged:
            raise DeviceError(
                f"the drives were stopped ({self._cycle.reason}); acknowledge() before they "
                "are enabled again."
            )
        for i in range(self.n_drives):
            if not self._cycle.enabled[i]:
                self._cycle.words[i] = OFF
        fresh = self._cycle.until(
            1.0,
            lambda now: bool(np.all(now.age < 3.0 / self._cycle.rate)),
            "say where they are",
            stoppable=False,
        )
        self._cycle.refuse_faults(fresh)
        for i in range(self.n_drives):
            self._configurator.set_mode(i, _MODES[mode])
            if not self._cycle.enabled[i]:
                self._cycle.hold[i] = int(fresh.position[i])
        self._cycle.release()

        def step(now: DriveFeedback) -> bool:
            self._cycle.refuse_faults(now)
            for i, word in enumerate(now.statusword):
                state = state_in_words(int(word))
                if self._cycle.enabled[i]:
                    continue
                if state == ENABLED:
                    self._cycle.enabled[i] = True
                    continue
                self._cycle.hold[i] = int(now.position[i])
                self._cycle.words[i] = {READY: 0x0007, SWITCHED_ON: RUN, QUICK_STOP: OFF}.get(state, 0x0006)
            return all(self._cycle.enabled)

        try:
            self._cycle.until(_ENABLING, step, "be enabled")
        except DeviceError:
            self._cycle.words, self._cycle.enabled = [OFF] * self.n_drives, [False] * self.n_drives
            raise

    def acknowledge(self) -> None:
        """Somebody has seen that the drives were stopped; `enable` may switch them on again."""
        self._cycle.acknowledge()

    def disable(self) -> None:
        """Switch all drives off. Raises `DeviceError` where one stays on."""
        self._cycle.words, self._cycle.enabled = [OFF] * self.n_drives, [False] * self.n_drives

        def off(now: DriveFeedback) -> bool:
            return not any(state_in_words(int(word)) in (ENABLED, QUICK_STOP) for word in now.statusword)

        self._cycle.until(1.0, off, "be disabled", stoppable=False)

    def reset_faults(self) -> None:
        """Reset the drives that are in fault; they stay switched off. Raises `DeviceError`: one stays in
        fault, or does not answer."""
        self._cycle.require_connected()
        self._cycle.until(
            1.0,
            lambda now: bool(np.all(now.age < 3.0 / self._cycle.rate)),
            "say how they are",
            stoppable=False,
        )
        for _ in range(3):
            faulty = [
                i
                for i, word in enumerate(self._cycle.newest.statusword)
                if state_in_words(int(word)) == FAULT
            ]
            if not faulty:
                return
            for word in (OFF, RESET, OFF):  # the drive looks for the edge of bit 7
                for i in faulty:
                    self._cycle.words[i], self._cycle.enabled[i] = word, False
                for _ in range(2):
                    self._cycle.until(0.5, _once, "be reset", stoppable=False)
        self._cycle.refuse_faults(self._cycle.newest, "stays in fault")

    # the loop

    def exchange(self, target: Ints | None = None) -> DriveFeedback:
        """One cycle: `target` (n_drives,) [counts] to the drives, one SYNC, and what they say.

        None keeps the last target. Returns when all drives have answered, after 0.6 of a cycle at most. A bus
        that fails raises nothing:
        `DriveFeedback.lost` says why. Raises `InputError` for a target of another shape or kind.
        """
        return self._cycle.exchange(target)

    def quick_stop(self, reason: str = "quick stop was asked for") -> str:
        """Stop all drives at once, from any thread; they stay stopped until `acknowledge` and `enable`.
        Raises nothing: it says why a word could not be sent, or "". Drives that no longer hear of their
        controller stop by themselves."""
        return self._cycle.quick_stop(reason)

    # moves that cycle by themselves

    def profile_move(self, target: Ints, velocity: float, acceleration: float) -> DriveFeedback:
        """Go to `target` (n_drives,) [counts] along trapezoids, in the mode "ppm"; returns when all have
        arrived.

        `velocity` [counts/s] and `acceleration` [counts/s2], positive. Raises `DeviceError`: stopped, a
        fault, or not there in time.
        """
        goal = whole(self.n_drives, target, "target")
        check_number("velocity", velocity)
        check_number("acceleration", acceleration)
        self._cycle.require_enabled()
        far = max(abs(goal[i] - int(self._cycle.newest.position[i])) for i in range(self.n_drives))
        for i in range(self.n_drives):
            self._configurator.write(i, 0x6081, 0, self._configurator.speed(i, velocity))
            self._configurator.write(i, 0x6083, 0, self._configurator.acceleration(i, acceleration))
            self._configurator.write(i, 0x6084, 0, self._configurator.acceleration(i, acceleration))
        self._cycle.hold = goal
        limit = 2.0 + 1.5 * (far / velocity + 2.0 * velocity / acceleration)

        def taken(now: DriveFeedback) -> bool:
            return bool(np.all(now.statusword & _ACKNOWLEDGED))

        def arrived(now: DriveFeedback) -> bool:
            return bool(np.all(now.statusword & (_ACKNOWLEDGED | _REACHED) == _REACHED))

        for word, done, what in (
            (RUN, lambda now: not np.any(now.statusword & _ACKNOWLEDGED), "be ready for a move"),
            (START, taken, "take the move (are they in the mode 'ppm'?)"),
            (RUN, arrived, "arrive"),
        ):
            self._cycle.words = [word] * self.n_drives
            feedback = self._cycle.until(limit if what == "arrive" else 1.0, done, what, running=True)
        return feedback

    def homing(
        self,
        threshold: Ints,
        speed: Floats | Ints | float,
        *,
        acceleration: float = 20_000.0,
        offset: Ints | None = None,
        order: Sequence[int] | None = None,
        rounds: int = 2,
        time_limit: float = 30.0,
    ) -> DriveFeedback:
        """Pull the tendons in, one after another, until each is taut; the counts there become 0.

        `threshold` (n_drives,) [thousandths of the rated torque], at `speed` [counts/s], one number or
        (n_drives,), reached by
        `acceleration` [counts/s2]; then to `offset` (n_drives,) [counts]. `order` of the drives; `rounds`:
        what one tendon pulls the others feel, so all are done more than once; `time_limit` [s] for each. The
        drives end enabled in the mode "csp". Raises `InputError`, or `DeviceError`: stopped, a fault, or no
        end; the drives are then stopped.
        """
        n = self.n_drives
        torque, speeds = np.asarray(threshold, dtype=np.float64), np.asarray(speed, dtype=np.float64)
        if torque.shape != (n,) or not np.all((torque > 0.0) & (torque < 3e4)):
            raise InputError(
                f"threshold is {threshold!r}; it must be ({n},) positive thousandths of the rated torque."
            )
        if speeds.shape not in ((), (n,)) or not np.all((speeds > 0.0) & np.isfinite(speeds)):
            raise InputError(
                f"speed is {speed!r}; it must be a positive number of counts/s, or one for "
                f"each of {n} drives."
            )
        for name, value in (("acceleration", acceleration), ("time_limit", time_limit), ("rounds", rounds)):
            check_number(name, value)
        away = [0] * n if offset is None else whole(self.n_drives, offset, "offset")
        drives = list(range(n)) if order is None else [int(i) for i in order]
        if sorted(drives) != list(range(n)):
            raise InputError(f"order is {order!r}; it must name each drive from 0 to {n - 1} once.")
        self.enable("csp")
        for i in drives * int(rounds):
            try:
                current = self._configurator.current(i, float(torque[i]))
                self._home(
                    i, current, float(np.broadcast_to(speeds, (n,))[i]), acceleration, away[i], time_limit
                )
            except DeviceError:
                self.quick_stop("homing did not end")
                raise
        return self._cycle.newest

    def _home(self, i: int, current: int, speed: float, acceleration: float, away: int, limit: float) -> None:
        setup, spec = self._configurator, self._specs[i]
        setup.write(i, 0x6098, 0, -3 if spec.direction > 0 else -4)
        setup.write(i, 0x6099, 1, setup.speed(i, speed))
        setup.write(i, 0x609A, 0, setup.acceleration(i, acceleration))
        setup.write(i, 0x30B1, 0, away)
        setup.write(i, 0x30B0, 0, away)  # the count where the move ends: 0 is where the tendon was taut
        setup.write(i, 0x30B2, 0, current)  # mA
        setup.set_mode(i, 6)

        def attained(now: DriveFeedback) -> bool:
            if now.statusword[i] & _ERROR:
                raise DeviceError(
                    f"the drive at node {spec.node} reports a homing error; is its tendon on the drum?"
                )
            return bool(now.statusword[i] & _ACKNOWLEDGED and now.statusword[i] & _REACHED)

        self._cycle.until(0.5, _once, "be homed", running=True)
        self._cycle.words[i] = START
        self._cycle.until(limit, attained, f"find the tendon of node {spec.node} taut", running=True)
        self._cycle.words[i] = RUN
        self._cycle.hold[i] = int(self._cycle.newest.position[i])
        self._cycle.until(0.5, _once, "be homed", running=True)
        self._cycle.hold[i] = int(self._cycle.newest.position[i])
        setup.set_mode(i, 8)
        self._cycle.until(0.5, _once, "be homed", running=True)

    def close(self) -> None:
        """Stop the drives, switch them off, leave them pre-operational, and leave the bus. Raises nothing for
        drives that do not answer."""
        if self._closed:
            return
        self._closed = True
        with contextlib.suppress(DeviceError):
            if any(self._cycle.configured):
                if any(self._cycle.enabled):
                    self.quick_stop()
                with contextlib.suppress(DeviceError):  # down the ramp: without voltage a shaft would run on
                    self._cycle.until(
                        _RAMP, lambda now: not np.any(now.velocity), "come to rest", stoppable=False
                    )
                self.disable()
                for i in range(self.n_drives):
                    self._configurator.watch(i, on=False)
        for node in self._cycle.ids:
            with contextlib.suppress(DeviceError):
                self._cycle.command(128, node)
        self._line.close()

    def __enter__(self) -> DriveBus:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _once(now: DriveFeedback) -> bool:  # noqa: ARG001
    """One cycle is enough."""
    return True
