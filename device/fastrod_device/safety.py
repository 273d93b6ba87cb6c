"""`Supervisor`: refuses commands beyond the limits, watches drives, camera and clocks, and stops the robot at
the first fault."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from enum import Enum
from types import MappingProxyType
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Floats
from fastrod_device.can.clock import Clock
from fastrod_device.errors import RefusedError
from fastrod_device.limits import Limits, limited
from fastrod_device.readings import Readings
from fastrod_device.safety_words import (
    KINDS,
    CameraWatch,
    Fault,
    Inspector,
    by_priority,
    in_hex,
    of_exception,
)

__all__ = ["KINDS", "TRANSITIONS", "CameraWatch", "Fault", "Limits", "SafetyState", "Supervisor", "limited"]

_REMEMBERED = 1000  # changes of state


class SafetyState(Enum):
    """State of the safety supervisor: what the robot may do."""

    OFF = "off"
    """No drive is enabled."""
    READY = "ready"
    """Drives are enabled and hold."""
    RUNNING = "running"
    """Drives follow commands."""
    STOPPED = "stopped"
    """A stop was sent; commands are refused until a person acknowledges it."""


TRANSITIONS = MappingProxyType(
    {
        (SafetyState.OFF, "enabled"): SafetyState.READY,
        (SafetyState.READY, "command"): SafetyState.RUNNING,
        (SafetyState.RUNNING, "command"): SafetyState.RUNNING,
        (SafetyState.OFF, "disabled"): SafetyState.OFF,
        (SafetyState.READY, "disabled"): SafetyState.OFF,
        (SafetyState.RUNNING, "disabled"): SafetyState.OFF,
        (SafetyState.STOPPED, "disabled"): SafetyState.STOPPED,
        (SafetyState.STOPPED, "acknowledged"): SafetyState.OFF,
        (SafetyState.OFF, "fault"): SafetyState.STOPPED,
        (SafetyState.READY, "fault"): SafetyState.STOPPED,
        (SafetyState.RUNNING, "fault"): SafetyState.STOPPED,
        (SafetyState.STOPPED, "fault"): SafetyState.STOPPED,
    }
)
"""(state, event) -> next state; what is not here is refused. Only a person's `acknowledge` leaves STOPPED,
and it leads to OFF."""


@final
class Supervisor:
    """Stands between whoever commands and the bus. It does no input or output and keeps no time: it is given
    both. For any thread.

    A stop is a value of its own, the list of faults: the robot is STOPPED for as long as it is not empty,
    whatever else was under way. In OFF no drive is enabled, so only `emergency_stop` and `exception` stop; in
    READY and RUNNING every kind of fault does.
    """

    def __init__(
        self,
        robot: Robot,
        limits: Limits,
        *,
        on_stop: Callable[[Fault], None] | None = None,
        nodes: Sequence[int] = (),
        words: Callable[[int], str] = in_hex,
    ) -> None:
        """`on_stop` sends the safe stop and must bear being called again; `nodes` are the drives' node ids,
        `words` tells emergency codes.

        Raises `InputError` for a robot without tendons or a wrong number of nodes.
        """
        if robot.n_tendons == 0:
            raise InputError(f"robot {robot.name!r} has no tendons; there is nothing to drive.")
        self.limits = limits
        self._routing = route(robot)
        self._inspector = Inspector(robot.n_tendons, limits, nodes, words)
        self._on_stop = on_stop
        self._lock = threading.RLock()  # a signal handler may press stop while this thread holds it
        self._mode = SafetyState.OFF
        self._faults: list[Fault] = []
        self._lasting: tuple[Fault, ...] = ()
        self._history: deque[tuple[float, SafetyState, str]] = deque(maxlen=_REMEMBERED)
        self._unsent, self._refusal = "", ""
        self._looked: float | None = None
        self._wall: float | None = None
        self._before: Readings | None = None
        self._meant = -math.inf

    @property
    def state(self) -> SafetyState:
        """Now."""
        return SafetyState.STOPPED if self._faults else self._mode

    @property
    def first(self) -> Fault | None:
        """Return what stopped the robot; None while it is not stopped."""
        return next(iter(self.faults), None)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Return what stopped the robot, and what came after, each kind once; empty after `acknowledge`."""
        return tuple(self._faults)

    @property
    def history(self) -> tuple[tuple[float, SafetyState, str], ...]:
        """(t [s], state, why) of the newest changes of state, oldest first."""
        with self._lock:
            return tuple(self._history)

    @property
    def status(self) -> str:
        """State and reason in one sentence."""
        with self._lock:
            faults, mode = self.faults, self._mode
            if not faults:
                words = {
                    SafetyState.OFF: "The drives are off.",
                    SafetyState.READY: "The drives are enabled and hold.",
                }
                return words.get(mode, "The robot follows commands.")
            clauses = [f"Stopped ({faults[0].kind}): {faults[0].sentence.rstrip('.')}"]
            if len(faults) > 1:
                clauses.append("then " + ", ".join(fault.kind for fault in faults[1:]))
            if self._unsent:
                clauses.append(f"THE STOP COULD NOT BE SENT ({self._unsent})")
            if self._refusal:
                clauses.append(f"not released, as {self._refusal.rstrip('.')}")
            return "; ".join(clauses) + "."

    def enabled(self, now: float) -> None:
        """The drives have been enabled: OFF becomes READY.

        Raises `RefusedError` from any other state; where a stop came while they were being enabled, it is
        sent again first.
        """
        if self.state is SafetyState.STOPPED:
            self._send(self.first)
        with self._lock:
            self._step("enabled", now, "the drives were enabled")
            self._looked, self._wall, self._before = now, None, None

    def disabled(self, now: float) -> None:
        """The drives have been switched off in order: OFF, unless the robot is stopped, which it stays."""
        with self._lock:
            self._step("disabled", now, "the drives were switched off")

    def check(self, dl: ArrayLike, now: float, *, stamp: float | None = None) -> Floats:
        """A command (n_tendons,) [m] as it was given, negative = pulled; READY becomes RUNNING. Nothing is
        clipped.

        `stamp` is when it was meant [s], by default now. Raises `RefusedError` where it has a wrong shape, is
        not finite, is beyond
        `displacement` or `curvature`, older than `command_age`, or where the robot is off or stopped.
        """
        with self._lock:
            if self.state is SafetyState.STOPPED:
                raise RefusedError(
                    f"the robot is stopped: {self._faults[0].sentence.rstrip('.')}; a person "
                    "must release it first."
                )
            if self.state is SafetyState.OFF:
                raise RefusedError("the drives are off; enable them first.")
            wanted = self.within(dl)
            meant = now if stamp is None else stamp
            if not (math.isfinite(now) and abs(now - meant) <= self.limits.command_age):
                age, limit = 1e3 * (now - meant), 1e3 * self.limits.command_age
                raise RefusedError(f"the command was meant {age:.4g} ms ago; the limit is {limit:.4g} ms.")
            self._step("command", now, "a command came")
            self._meant = min(meant, now)
            return wanted

    def limited(self, previous: Floats, wanted: Floats, dt: float) -> Floats:
        """The next set-point (n_tendons,) [m], `dt` [s] on the way from `previous` to `wanted`; see
        `limits.limited`."""
        return limited(previous, wanted, self.limits.rate, dt)

    def watch(
        self, now: float, wall: float | None, readings: Readings, camera: CameraWatch | None = None
    ) -> Fault | None:
        """Once each control cycle: the fault that stopped the robot in this call, already sent by `on_stop`;
        else None.

        `wall` is the wall clock [s], None where time is stepped; `camera` is None while no camera is in use.
        Of several faults the first of
        `KINDS` is it. Faults of a stopped robot are kept in `faults`; that it slows down, and how late cycles
        are then, is none. A stop that could not be sent is sent again. What is raised while looking stops the
        robot too, and is raised.
        """
        try:
            with self._lock:
                new = self._latch(by_priority(self._found(now, wall, readings, camera)))
                self._looked, self._wall, self._before = now, wall, readings
        except BaseException as error:
            self.exception(now, error)
            raise
        self._send(new)
        return new

    def emergency_stop(self, now: float, reason: str = "") -> Fault:
        """Stop at once, from any state and thread; sent again when it is pressed again. Never raises what
        `on_stop` raises."""
        why = f": {reason}".rstrip(".") if reason else ""
        fault = Fault(kind="emergency stop", sentence=f"the emergency stop was pressed{why}.", t=now)
        with self._lock:
            self._latch([fault])
        self._send(fault)
        return fault

    def stalled(self, now: float) -> Fault | None:
        """For another thread than the control loop's: the fault where drives are enabled and nobody has
        looked at them for `cycle`."""
        with self._lock:
            if (
                self._looked is None
                or self.state not in (SafetyState.READY, SafetyState.RUNNING)
                or now - self._looked <= self.limits.cycle
            ):
                return None
            new = self._latch([self._inspector.stalled(now, now - self._looked)])
        self._send(new)
        return new

    def client_lost(self, now: float) -> Fault | None:
        """Nobody watches any more: a stop where drives are enabled, which is returned where it is the first;
        else None."""
        with self._lock:
            if self.state not in (SafetyState.READY, SafetyState.RUNNING):
                return None
            sentence = f"no page is open, or none answers, while the robot is {self.state.value}."
            new = self._latch([Fault(kind="nobody watches", sentence=sentence, t=now)])
        self._send(new)
        return new

    def exception(self, now: float, error: BaseException) -> Fault:
        """The program that drives the robot failed with `error`: a stop, from any state."""
        fault = Fault(kind="exception", sentence=f"the program failed: {of_exception(error)}.", t=now)
        with self._lock:
            new = self._latch([fault])
        self._send(new)
        return fault

    @contextmanager
    def guard(self, clock: Clock) -> Iterator[None]:
        """Whatever leaves this block as an exception, Ctrl-C and exit too, stops the robot first and is
        raised then."""
        try:
            yield
        except BaseException as error:
            self.exception(clock.now(), error)
            raise

    def acknowledge(self, now: float) -> None:
        """A person has seen why the robot stopped, and releases it: STOPPED becomes OFF, and nothing moves by
        that.

        Raises `RefusedError` where it is not stopped, the stop could not be sent, nobody has looked at the
        drives lately, or a cause is still there. A drive's own fault is no such cause: a drive keeps it until
        it is reset, which is what follows. An encoder that has jumped stays one: only a new start, which
        homes, finds the tendon again.
        """
        with self._lock:
            if self.state is not SafetyState.STOPPED:
                raise RefusedError(
                    f"the robot is {self.state.value}, not stopped; there is nothing to release."
                )
            self._refusal = self._why_not(now)
            if self._refusal:
                raise RefusedError(f"the robot stays stopped: {self._refusal}")
            self._step("acknowledged", now, f"a person released it after: {self._faults[0].sentence}")
            self._faults = []

    def _why_not(self, now: float) -> str:
        if self._unsent:
            return f"the stop could not be sent: {self._unsent}."
        if self._looked is not None and not now - self._looked <= self.limits.command_age:
            return (
                f"the drives were last looked at {1e3 * (now - self._looked):.4g} ms ago, and may be in "
                "any state."
            )
        jumped = next((fault for fault in self._faults if fault.kind == "encoder jump"), None)
        if jumped is not None:
            return f"{jumped.sentence.rstrip('.')}; where its tendon is may be lost: start anew, and home it."
        return self._lasting[0].sentence if self._lasting else ""

    def _step(self, event: str, now: float, why: str) -> None:
        before = self.state
        after = TRANSITIONS.get((before, event))
        if after is None:
            raise RefusedError(f"{why}, but the robot is {before.value}; that is no time for it.")
        if after is not SafetyState.STOPPED:
            self._mode = after
        if after is not before:
            self._history.append((now, after, why))

    def _latch(self, found: Sequence[Fault]) -> Fault | None:
        """The first of `found` where it stops the robot; None where nothing was found or it was stopped
        before."""
        known, was = {fault.kind for fault in self._faults}, bool(self._faults)
        new = [fault for fault in found if fault.kind not in known]
        self._faults.extend(new)
        if was or not new:
            return None
        self._mode, self._refusal = SafetyState.OFF, ""
        self._history.append((new[0].t, SafetyState.STOPPED, new[0].sentence))
        return new[0]

    def _send(self, fault: Fault | None) -> None:
        """Outside the lock: a bus may be slow, and may have a lock of its own."""
        fault = self.first if fault is None and self._unsent else fault
        if fault is None or self._on_stop is None:
            return
        try:
            self._on_stop(fault)
        except BaseException as error:
            self._unsent = of_exception(error)
            with self._lock:
                self._latch(
                    [
                        Fault(
                            kind="exception",
                            sentence=f"the stop could not be sent: {self._unsent}.",
                            t=fault.t,
                        )
                    ]
                )
            if not isinstance(error, Exception):
                raise
        else:
            self._unsent = ""

    def _found(
        self, now: float, wall: float | None, readings: Readings, camera: CameraWatch | None
    ) -> Iterable[Fault]:
        inspector, state = self._inspector, self.state
        inspector.require(readings)
        self._lasting = tuple(by_priority(inspector.lasting(now, readings, camera)))
        if state is SafetyState.OFF:
            return ()
        found = [*inspector.drives(now, readings), *self._lasting]
        if state is not SafetyState.STOPPED:
            found += inspector.powered(now, readings, self._before)
            if self._looked is not None:
                found += inspector.times(now, wall, self._looked, self._wall)
        if state is SafetyState.RUNNING:
            found += inspector.command(now, readings, self._meant)
        return found

    def within(self, dl: ArrayLike) -> Floats:
        """(n_tendons,) the same, where it is a command within displacement and curvature. Raises
        `RefusedError` where it is not."""
        try:
            wanted = np.array(dl, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise RefusedError(
                f"the command is {dl!r}; it must be {self._routing.n_tendons} numbers [m]."
            ) from error
        if wanted.shape != (self._routing.n_tendons,):
            raise RefusedError(
                f"the command has shape {wanted.shape}; it must be "
                f"({self._routing.n_tendons},), one [m] for each tendon."
            )
        if not np.isfinite(wanted).all():
            k = int(np.argmin(np.isfinite(wanted)))
            raise RefusedError(f"tendon {k + 1} was commanded {wanted[k]} m; it must be a finite number.")
        k = int(np.argmax(np.abs(wanted)))
        if abs(wanted[k]) > self.limits.displacement:
            given, limit = 1e3 * float(wanted[k]), 1e3 * self.limits.displacement
            raise RefusedError(
                f"tendon {k + 1} was commanded {given:.6g} mm; this robot's limit is {limit:.6g} mm."
            )
        curvature = np.linalg.norm(self._routing.bend(wanted), axis=-1) / self._routing.length
        k = int(np.argmax(curvature))
        if curvature[k] > self.limits.curvature:
            needed, most = curvature[k], self.limits.curvature
            raise RefusedError(
                f"segment {k + 1} was commanded to bend with {needed:.6g} 1/m; this robot's limit "
                f"is {most:.6g} 1/m."
            )
        return wanted
