"""`Session`: a world that runs in real time, by its script or by hand, in a thread of its own."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from fastrod.errors import FastrodError
from fastrod.link import Measurement, RobotLink
from fastrod.recording import Recorder
from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats
from fastrod_viewer.pilot import Pilot
from fastrod_viewer.world import Hand, World

RATE = 30.0
"""Pictures a second."""
_BEHIND = 0.25  # s: a world that falls farther behind runs slower than real time
_REST = 12  # pictures after the last motion, in which an observer comes to rest
_SAID = 4.0  # s for which a problem stays on the page
_QUICKEST = 0.008  # s between two pictures, when hands are quick


@dataclass(frozen=True, eq=False)
class Frame:
    """What a picture shows."""

    world: World
    hand: Hand | None
    """What the world was told last; None before, and where its script moves it."""
    measured: Measurement | None
    """Of a robot that is not the world itself."""
    latency: float
    """From the oldest input that this picture answers to the end of its computation [s]; nan where there was none."""
    pace: float
    """Seconds of the world in a second, lately; 1 while nothing moves."""
    problem: str
    """One sentence, or empty."""


@final
class Session:
    """Advances a world and hands a `Frame` to `draw` when something has changed. Every method may be called from any thread.

    With a `link`, hands drive that robot, the world is its model and gets the same commands, and `Frame.measured` is what the robot
    says. A real robot stops when `nobody` watches.
    """

    def __init__(
        self, world: World, pilot: Pilot, *, draw: Callable[[Frame], None], link: RobotLink | None = None, script: bool = False
    ) -> None:
        self.world, self.pilot, self.link = world, pilot, link
        self.recorder: Recorder | None = None
        self._draw = draw
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._wake = threading.Event()
        self._closed = threading.Event()
        self._scripted = script and link is None and world.scripted
        self._paused = self._stopped = False
        self._steps = 0
        self._since: float | None = None
        self._asked = 0.0
        self._hand: Hand | None = None
        self._problem, self._said = "", 0.0
        self._recorded, self._restarts = -np.inf, 0
        self._pace = 1.0
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
        """The script moves the world, not hands."""
        return self._scripted

    @scripted.setter
    def scripted(self, on: bool) -> None:
        if on and self.link is None and self.world.scripted:
            self._scripted = True
        elif self._scripted and not on and self.world.by_hand:
            self._adopt()
            self._scripted = False
        self.touch()

    @property
    def paused(self) -> bool:
        """Nothing moves until `paused` is False again, or `step`."""
        return self._paused

    @paused.setter
    def paused(self, on: bool) -> None:
        self._paused = bool(on)
        self.touch()

    @property
    def stopped(self) -> bool:
        """`stop` was called, and `release` not yet."""
        return self._stopped

    def touch(self) -> None:
        """Hands have moved something: answer at once."""
        if self._since is None:
            self._since = time.perf_counter()
        self._asked = time.perf_counter()
        self._wake.set()

    def take_over(self) -> None:
        """Hands drive from here on, from where the script has left the robot."""
        self.scripted = False

    def ask(self, job: Callable[[], None]) -> None:
        """Do something between two steps, in the session's thread."""
        self._jobs.put(job)
        self.touch()

    def stop(self) -> None:
        """Everything stands still, at once; commands wait for `release`."""
        self._stopped = True
        if self.link is not None:
            self.link.stop()
        self.pilot.hold()
        self.touch()

    def release(self) -> None:
        """Take commands again, from where the robot stands."""
        self.pilot.hold()
        if self.link is not None:
            self._adopt()
            self.link.release()
        self._stopped = False
        self.touch()

    def nobody(self) -> None:
        """Nobody watches any more: what was on its way stops; a real robot is stopped as by `stop`."""
        if self.link is not None and self.link.real:
            self.stop()
        else:
            self.pilot.hold()

    def step(self) -> None:
        """One picture's worth of steps while paused."""
        self._paused = True
        self._steps += 1
        self.touch()

    def reset(self) -> None:
        """World and controls back to the beginning; a robot at the other end of a link goes there, straight, no faster than it may."""

        def job() -> None:
            if self.link is not None:
                self.pilot.all_zero()
                return
            self.pilot.reset()
            self.world.reset()
            self._adopt()
            self._hand, self._problem = None, ""

        self.ask(job)

    def _adopt(self) -> None:
        """The controls stand where the robot is: that at the other end of the link, where there is one."""
        now = measure(self.world, None) if self.link is None else self.link.read()
        if np.isfinite(now.dl).all():
            self.pilot.adopt(now.dl, np.nan_to_num(now.ext))

    def _run(self) -> None:
        due = time.perf_counter()
        try:
            while not self._closed.is_set():
                began = time.perf_counter()
                self._wake.clear()
                since, self._since = self._since, None
                did = self._do_jobs()
                moves = self._moves()
                due = self._advance(max(due, began - _BEHIND), began, at_once=since is not None) if moves else began
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
        if not moves or self._paused or self.world.t < t:
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
        if self._stopped or (self._paused and not self._steps):
            return self.link is not None and not self._paused
        if (
            self._steps
            or self._scripted
            or self.link is not None
            or self.world.host
            or self.world.robot.effects
            or self.recorder is not None
        ):
            return True
        return not self.pilot.arrived or time.perf_counter() - self._asked < _REST / RATE

    def _advance(self, due: float, began: float, *, at_once: bool) -> float:
        """Steps of the world up to now, one at least where hands wait for it; when the next one is due."""
        dt = self.world.dt
        steps = int((began - due) / dt + 1e-6)
        if self._steps:
            steps, self._steps = max(1, round(1.0 / RATE / dt)), self._steps - 1
            due = began - steps * dt
        elif at_once and steps == 0:
            steps, due = 1, began - dt
        for _ in range(steps):
            try:
                self._one(dt)
            except FastrodError as error:
                self._problem, self._said = str(error), time.perf_counter()
                if not self._scripted:
                    self.pilot.retreat()
                due = began
                break
            if time.perf_counter() - began > _BEHIND:
                return time.perf_counter()
            due += dt
        return due

    @property
    def waiting(self) -> float:
        """How long the step that is being computed has taken so far [s]; 0 between two steps."""
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
            self._hand = None
            self.world.play()
        else:
            self._hand = hand = self.pilot.step(dt) if not self._stopped or self._hand is None else self._hand
            if self.link is not None:
                self.link.command(hand.tendon_length - self.world.robot.rest_tendon_length, hand.extension)
            self.world.drive(hand)
        if time.perf_counter() - self._said > _SAID:
            self._problem = self.pilot.problem
        if self.recorder is None:
            self._recorded = -np.inf
        elif self.recorder.recording:
            self._record(self.recorder)

    def _record(self, recorder: Recorder) -> None:
        hand = self._hand
        measurement = self.link.read() if self.link is not None else measure(self.world, hand)
        if measurement.t < self._recorded:  # a reset, or a script that begins again
            self._restarts += 1
            recorder.start(measurement.t, f"again {self._restarts}")
        self._recorded = measurement.t
        if hand is None:
            recorder.add(measurement)
            return
        rotation = self.world.rods[0].state.rotation[0, 0]
        change = hand.tendon_length - self.world.robot.rest_tendon_length
        recorder.add(measurement, tip_force=rotation.T @ hand.tip_force, payload=hand.payload, commanded_dl=change)

    def _show(self, since: float | None) -> None:
        measured = None
        if self.link is not None:
            measured = self.link.read()
        problem = self._problem or (measured.problem if measured is not None else "")
        now = time.perf_counter()
        latency = float("nan") if since is None else now - since
        self._draw(Frame(self.world, self._hand, measured, latency, self._pace, problem))

    def _let_go(self) -> None:
        if self.recorder is not None and self.recorder.recording:
            self.recorder.stop()
        if self.link is not None:
            self.link.close()
        self.world.close()


def measure(world: World, hand: Hand | None) -> Measurement:
    """What a perfect encoder and camera say of the world's first robot now; t is the world's, frames those of a run log."""
    state = world.rods[0].state
    base, rotation = state.position[0, 0], state.rotation[0, 0]
    tip = rotation.T @ state.tip_rotation[0]
    if hand is not None:
        change, extension = hand.tendon_length - world.robot.rest_tendon_length, hand.extension
    else:
        change = state.path_length[0] - _stretch(world) - world.robot.rest_tendon_length
        extension = np.diff(_ends(world), prepend=0.0) - [segment.length for segment in world.robot.segments]
    return Measurement(
        t=world.t, dl=change, ext=extension, tip_position=rotation.T @ (state.tip_position[0] - base),
        tip_quaternion=quaternion_from_matrix(tip[None])[0], tension=state.tension[0],
    )  # fmt: skip


def _stretch(world: World) -> Floats:
    """(n_tendons,) by which each wire is longer than it was told to be: compliance (T - pretension) [m]."""
    tendons = [tendon for segment in world.robot.segments for tendon in segment.tendons]
    compliance, pretension = (np.array([getattr(tendon, name) for tendon in tendons]) for name in ("compliance", "pretension"))
    return np.asarray(compliance * (world.rods[0].state.tension[0] - pretension), dtype=np.float64)


def _ends(world: World) -> Floats:
    """(n_segments,) arclength of each segment's end [m]."""
    arclength = world.rods[0].state.arclength[0]
    n = world.robot.n_segments
    return np.asarray(arclength[(len(arclength) - 1) // n :: (len(arclength) - 1) // n], dtype=np.float64)
