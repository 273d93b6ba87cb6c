"""`Session`: a world that runs in real time, by its script or by hand, in a thread of its own."""

from __future__ import annotations

import contextlib
import math
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from fastrod.errors import FastrodError, InputError
from fastrod.logs.link import Measurement, RobotLink
from fastrod.logs.recording import Recorder
from fastrod.logs.runlog import RunLog
from fastrod_viewer.drive.linked import Linked
from fastrod_viewer.drive.teleop import Teleop
from fastrod_viewer.worlds.world import ManualCommand, World, measure

RATE = 30.0
"""Pictures a second."""
_BEHIND = 0.25  # s: a world that falls farther behind runs slower than real time
_BUSY = 0.8  # of a picture's time: what steps of rods in motion take at most, so that it moves evenly
_REST = 12  # steps after the last motion, in which an observer comes to rest
_SAID = 4.0  # s for which a problem stays on the page
_QUICKEST = 0.008  # s between two pictures, when commands come quickly
_SPREAD = 1.25  # of a step, over which a robot spreads it: the next one may come late
_RELEASED = 3.0  # s in which a robot must be ready after a release, or stays stopped
# s after a stop in which a real robot is not released: that was a click too many, or one meant for something
# else
_HASTY = 1.0


@dataclass(frozen=True, eq=False)
class ViewFrame:
    """Content of a picture."""

    world: World
    command: ManualCommand | None
    """The last command; None before the first, and where its script moves the world."""
    measured: Measurement | None
    """The measured robot, where it is not the world itself."""
    latency: float
    """Time from the oldest input that this picture answers to the end of its computation [s]; nan where there
    was none."""
    pace: float
    """Seconds of the world in a second, lately; 1 while nothing moves."""
    problem: str
    """One sentence, or empty."""


@final
class Session:
    """Advances a world and hands a `ViewFrame` to `draw` when something has changed. Every method may be
    called from any thread.

    With a `link`, manual commands drive that robot, the world is its model and gets the same commands, and
    `ViewFrame.measured` is what the robot reports. A real robot stops when `nobody` watches. Where it has
    stopped, by whatever it was, the session is stopped too, and the model stands as the robot's encoders say,
    until `release`.
    """

    def __init__(
        self,
        world: World,
        teleop: Teleop,
        *,
        draw: Callable[[ViewFrame], None],
        link: RobotLink | None = None,
        script: bool = False,
    ) -> None:
        self.world, self.teleop, self.link = world, teleop, link
        self.far = None if link is None else Linked(link)
        """The link and its capabilities."""
        self.recorder: Recorder | None = None
        self._draw = draw
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._scripted = script and link is None and world.scripted
        self._paused = self._stopped = False
        self._gate = threading.Lock()
        self._released = self._halted = self._hasty = -np.inf
        self._fed = False
        self._moved = time.perf_counter()
        self._steps = 0
        self._since: float | None = None
        self._rested = _REST
        self._command: ManualCommand | None = None
        self._problem, self._said = "", 0.0
        self._recorded, self._restarts = -np.inf, 0
        self._pace = self._speed = 1.0
        self._last = time.perf_counter(), world.t
        self._since_step: float | None = None
        self._adopt()
        self._thread = threading.Thread(target=self._run, name=f"session {world.name}", daemon=True)

    def start(self) -> None:
        """Begin to run."""
        self._thread.start()

    def close(self) -> None:
        """Stop, save what is recorded, and let go of the world; returns when that is done."""
        self._closed.set()
        self._wake.set()
        if self._thread.is_alive() and threading.current_thread() is not self._thread:
            self._thread.join(timeout=10.0)

    @property
    def scripted(self) -> bool:
        """The script moves the world, not a person."""
        return self._scripted

    @scripted.setter
    def scripted(self, on: bool) -> None:
        if on and self.link is None and self.world.scripted:
            self._scripted = True
        elif self._scripted and not on and self.world.drivable:
            self._adopt()
            self._scripted = False
        self.wake()

    @property
    def paused(self) -> bool:
        """True while everything stands still, until it is set to False or `step` is called."""
        return self._paused

    @paused.setter
    def paused(self, on: bool) -> None:
        self._paused = bool(on)
        self.wake()

    @property
    def speed(self) -> float:
        """Seconds of the world in a second, where the machine can: 1 is real time, less slow motion. Raises
        `InputError` for what is not above 0 and at most 1, and for less than 1 with a link."""
        return self._speed

    @speed.setter
    def speed(self, speed: float) -> None:
        if not (isinstance(speed, (int, float)) and 0.0 < speed <= 1.0):
            raise InputError(f"speed is {speed!r}; give a number above 0 and at most 1, real time.")
        if speed < 1.0 and self.link is not None:
            raise InputError(f"speed is {speed!r}; a robot at the other end of a link moves in real time, 1.")
        self._speed = float(speed)
        self.wake()

    @property
    def stopped(self) -> bool:
        """`stop` was called, or the robot has stopped, and `release` not yet."""
        return self._stopped

    @property
    def releasing(self) -> bool:
        """A release was requested, and the robot at the other end of the link has not said yet that it is
        ready."""
        return self._stopped and time.perf_counter() - self._released < _RELEASED

    @property
    def hasty(self) -> bool:
        """The last release came so soon after a stop that it was ignored; True for some seconds, while it is
        stopped."""
        return self._stopped and not self.releasing and time.perf_counter() - self._hasty < _SAID

    def wake(self) -> None:
        """Answer at once: a control was moved."""
        if self._since is None:
            self._since = time.perf_counter()
        self._wake.set()

    def take_over(self) -> None:
        """Drive manually from here on, from where the script has left the robot."""
        self.scripted = False

    def submit(self, job: Callable[[], None]) -> None:
        """Do something between two steps, in the session's thread."""
        self._jobs.put(job)
        self.wake()

    def in_order(self, job: Callable[[Any], None]) -> Callable[[Any], Any]:
        """Return what viser calls with each event in its own loop, to do `job` in the order of the events:
        its threads would do them in any."""

        async def heard(event: Any) -> None:
            self.submit(lambda: job(event))

        return heard

    @property
    def idle(self) -> bool:
        """Nothing that was submitted waits."""
        return self._jobs.empty()

    def stop(self) -> None:
        """Stop everything at once; commands wait for `release`. While stopped it is a stop again, and ends a
        release in progress."""
        self._halt(nobody=False)

    def _halt(self, *, nobody: bool) -> None:
        with self._gate:
            self._stopped, self._released, self._halted = True, -np.inf, time.perf_counter()
        if self.far is not None:
            self.far.stop(nobody=nobody)
        self.teleop.hold()
        self.wake()

    def release(self) -> None:
        """Take commands again, from where the robot stands. A linked robot may take a while until it is
        ready, or refuse. Ignored while nothing is stopped or a release is in progress, and, where the robot
        is real, within a second of the last stop.
        """
        with self._gate:  # a stop that is pressed meanwhile comes after it
            now = time.perf_counter()
            if not self._stopped or self.releasing:
                return
            self.teleop.hold()
            if self.far is None:
                self._stopped = False
            elif self.far.link.real and now - self._halted < _HASTY:
                self._hasty = now
            else:
                self.far.link.release()
                self._released = now
        self.wake()

    def nobody(self) -> None:
        """Stop every motion because nobody watches any more; a real robot is stopped as by `stop`."""
        if self.link is not None and self.link.real:
            self._halt(nobody=True)
        else:
            self.teleop.hold()

    def step(self) -> None:
        """One picture's worth of steps while paused."""
        self._paused = True
        self._steps += 1
        self.wake()

    def reset(self) -> None:
        """World and controls back to the beginning; a robot at the other end of a link goes there, straight,
        no faster than it may."""

        def job() -> None:
            if self.link is not None:
                self.teleop.all_zero()
                return
            self.teleop.reset()
            self.world.reset()
            self._adopt()
            self._command, self._problem = None, ""

        self.submit(job)

    def _adopt(self) -> None:
        """The controls stand where the robot is: that at the other end of the link, where there is one."""
        if self.far is None:
            now = measure(self.world, None)
            dl, ext = now.dl, now.ext
        else:
            dl, ext = self.far.held()
        if np.isfinite(dl).all():
            self.teleop.adopt(dl, np.nan_to_num(ext))

    def _keep_stopped(self, far: Linked) -> None:
        """Follow the state of the robot at the other end of the link: it may have stopped by itself, or be
        ready again."""
        with self._gate:  # a stop that is pressed meanwhile must not be forgotten
            if far.stopped and not self._stopped:
                self._stopped, self._released, self._halted = True, -np.inf, time.perf_counter()
            if self.releasing and not far.stopped and far.ready:
                self._adopt()
                self._stopped, self._problem = False, ""
            if not self._stopped:
                return
        dl, ext = far.standing()
        if np.isfinite(dl).all():
            self.teleop.adopt(dl, np.nan_to_num(ext))

    def _run(self) -> None:
        due = time.perf_counter()
        try:
            while not self._closed.is_set():
                began = time.perf_counter()
                self._wake.clear()
                since, self._since = self._since, None
                did = self._do_jobs()
                if since is not None:
                    self._rested = 0
                moves = self._moves()
                due = (
                    self._advance(max(due, began - self._latest()), began, at_once=since is not None)
                    if moves
                    else began
                )
                if (moves or did or since is not None) and not self._closed.is_set():
                    self._show(since)
                left = 1.0 / RATE - (time.perf_counter() - began)
                if self._wake.wait(max(left, 0.001)):
                    self._closed.wait(max(_QUICKEST - (time.perf_counter() - began), 0.0))
                self._measure_pace(moves)
        finally:
            self._let_go()

    def _measure_pace(self, moves: bool) -> None:
        before, t = self._last
        now = time.perf_counter()
        if not moves or self._paused or self.far is not None or self.world.t < t:
            self._pace, self._last = 1.0, (now, self.world.t)
        elif now - before > 1.0:
            self._pace, self._last = (self.world.t - t) / (now - before), (now, self.world.t)

    def _do_jobs(self) -> bool:
        did = False
        while not self._jobs.empty():
            did = True
            try:
                self._jobs.get()()
            except FastrodError as error:
                self._problem = str(error)
        return did

    def _moves(self) -> bool:
        """Something is to be computed for the next picture."""
        if self.far is not None:  # it must be looked at, whatever is commanded
            return True
        if self._stopped or (self._paused and not self._steps):
            return False
        if (
            self._steps
            or self._scripted
            or self.world.host
            or self.world.robot.effects
            or self.recorder is not None
            or (self.world.ringing is not None and not self.world.ringing.rests)
        ):
            return True
        return not self.teleop.arrived or self._rested < _REST

    def _latest(self) -> float:
        """Return how late a step may be to be made up for [s]."""
        return max(_BEHIND, self.world.dt / self._speed)

    def _advance(self, due: float, began: float, *, at_once: bool) -> float:
        """Do the steps of the world up to now, one at least where a command waits for it and the world has no
        inertia; return when the next one is due."""
        if self.far is not None:
            # late, it is slower: nothing is made up for
            self._try(min(max(began - self._moved, _QUICKEST), 1.0 / RATE))
            self._moved, self._steps = began, 0
            return began
        dt, rings = self.world.dt, self.world.ringing is not None
        apart, most = dt / self._speed, _BUSY / RATE if rings else _BEHIND
        steps = int((began - due) / apart + 1e-6)
        if self._steps:
            steps, self._steps = max(1, round(1.0 / RATE / apart)), self._steps - 1
            due, most = began - steps * apart, math.inf  # what was asked for, however long it takes
        elif at_once and steps == 0 and not rings:  # a step for every command would hurry slow motion
            steps, due = 1, began - apart
        for _ in range(steps):
            if not self._try(dt):
                return began
            if time.perf_counter() - began > most:
                return time.perf_counter()
            due += apart
        return due

    def _try(self, dt: float) -> bool:
        """Do one step; return whether it could be done. Otherwise the problem is kept, and the goals are as
        before."""
        self._rested = self._rested + 1 if self.teleop.arrived else 0
        try:
            self._one(dt)
        except FastrodError as error:
            self._problem, self._said = str(error), time.perf_counter()
            self._rested = _REST
            if not self._scripted:
                self.teleop.retreat()
            return False
        return True

    @property
    def waiting(self) -> float:
        """Time that the step in progress has taken so far [s]; 0 between two steps."""
        since = self._since_step
        return 0.0 if since is None else time.perf_counter() - since

    def _one(self, dt: float) -> None:
        self._since_step = time.perf_counter()
        try:
            self._compute(dt)
        finally:
            self._since_step = None

    def _compute(self, dt: float) -> None:
        if self._scripted:
            self._command = None
            self.world.play()
        elif self.far is None:
            self._command = (
                self.teleop.step(dt) if not self._stopped or self._command is None else self._command
            )
            self.world.drive(self._command)
        else:
            self._keep_stopped(self.far)
            still = self._command if self._paused and not self._stopped else None
            command = self.teleop.step(dt) if still is None else still
            if not self._stopped:
                self.far.command(
                    command.tendon_length - self.world.robot.rest_tendon_length,
                    command.extension,
                    _SPREAD * dt,
                )
            self._command = command
            self.world.drive(command)
        if time.perf_counter() - self._said > _SAID:
            self._problem = self.teleop.problem
        if self.recorder is None:
            self._recorded = -np.inf
        elif self.recorder.recording and not self._fed:
            self._record(self.recorder)

    def record(self, path: Path) -> None:
        """Record to `path` from now on; in the session's thread. A link that can fills the log by itself,
        reading by reading. Raises `InputError`."""
        if self.far is not None:
            self.recorder, self._fed = self.far.recorder(path)
            return
        recorder = Recorder(self.world.robot, path)
        recorder.start(self.world.t, "by script" if self._scripted else "by hand")
        self.recorder, self._fed = recorder, False

    def end_recording(self) -> RunLog | None:
        """End it; the log, None where nothing is recorded; in the session's thread. Raises `InputError`."""
        recorder, self.recorder = self.recorder, None
        if self.far is not None and self._fed:
            self.far.end_recording()
        return recorder.stop() if recorder is not None and recorder.recording else None

    def _record(self, recorder: Recorder) -> None:
        command = self._command
        measurement = self.link.read() if self.link is not None else measure(self.world, command)
        if measurement.t < self._recorded:  # a reset, or a script that begins again
            self._restarts += 1
            recorder.start(measurement.t, f"again {self._restarts}")
        self._recorded = measurement.t
        if command is None:
            recorder.add(measurement)
            return
        rotation = self.world.rods[0].state.rotation[0, 0]
        change = command.tendon_length - self.world.robot.rest_tendon_length
        recorder.add(
            measurement,
            tip_force=rotation.T @ command.tip_force,
            payload=command.payload,
            commanded_dl=change,
        )

    def _show(self, since: float | None) -> None:
        measured = None if self.link is None else self.link.read()
        problem = self._problem or (measured.problem if measured is not None else "")
        now = time.perf_counter()
        latency = float("nan") if since is None else now - since
        self._draw(ViewFrame(self.world, self._command, measured, latency, self._pace, problem))

    def _let_go(self) -> None:
        if self.link is not None:
            self.link.stop()  # before a long log is written
        try:
            # no reading, or no room: nobody is left to hear of it, and rows are in PATH.part
            with contextlib.suppress(InputError):
                self.end_recording()
        finally:
            if self.link is not None:
                self.link.close()
            self.world.close()
