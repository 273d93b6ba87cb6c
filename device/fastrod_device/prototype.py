"""`Prototype`: four drives and a camera as a `RobotLink`; what teleop drives, what an experiment records,
what a policy commands."""

from __future__ import annotations

import gc
import queue
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.errors import FastrodError, InputError
from fastrod.logs.link import Measurement
from fastrod.logs.recording import Recorder
from fastrod.model.robot import Robot
from fastrod.types import Floats
from fastrod_device.can.clock import Clock, WallClock
from fastrod_device.can.faultcodes import in_words
from fastrod_device.can.pacer import Pacer, urgent, urgently
from fastrod_device.drives import Drives, open_drives
from fastrod_device.errors import DeviceError, RefusedError
from fastrod_device.hardware import Hardware
from fastrod_device.homing import home
from fastrod_device.journal import Journal
from fastrod_device.readings import Readings, Trace
from fastrod_device.safety import CameraWatch, Fault, SafetyState, Supervisor, limited
from fastrod_device.safety_words import of_exception
from fastrod_device.units import Transmission
from fastrod_device.vision.camera import CameraFrame, FrameSource
from fastrod_device.vision.gates import FROZEN, REPEATED, Expectation, Workspace
from fastrod_device.vision.tracker import FLAGS, MarkerSighting, MarkerTracker, outlined

EXTRA = ("marker_error", "marker_size", "marker_flag", "seen_x", "seen_y", "seen_z")
"""Columns of a recording that only a prototype has: reprojection error [px], size of the marker in the
picture [px], place of the sighting's flag in `vision.tracker.FLAGS` (0: trusted), and where the tip was seen,
trusted or not [m]; then current_1 ... [A]."""
Plan = Callable[[float], Floats]
"""Seconds since it began -> (n_tendons,) changes of tendon length [m], negative = pulled."""

_COVERED = 20.0  # s that the marker may stay covered after hands are done
_SLOWEST = 1e-6  # m/s of a glide
_REMEMBERED = 3.0  # s of tendon lengths, for frames that come late
_FROZEN = 3  # frames alike: a camera at 15 Hz never draws the same noise twice
_MARGIN = 1.5  # of our limits: where the drives refuse by themselves
_STOPS = 0.015  # s from the fastest to rest
_POLL = 0.002  # s between two looks for a frame
_WATCHED = 0.005  # s between two looks at the thread that drives


@final
class Prototype:
    """Commands become set-points of the drives, one a cycle, within limits; frames become tip poses; a
    supervisor watches both.

    With a `WallClock` threads do it, one for the drives, one for the camera and one that watches the first;
    with a `SteppedClock` `wait` does. `start` it, or use it as a context. It is `real`: it stops when nobody
    watches, and after any stop moves again only after
    `release`, a person's act.
    """

    real = True

    def __init__(
        self,
        hardware: Hardware,
        bus: str,
        source: FrameSource | None,
        *,
        clock: Clock | None = None,
        eds: str | Path | None = None,
        journal: Journal | None = None,
        wall: Callable[[], float] | None = None,
    ) -> None:
        """Drives on `bus` ("socketcan:can0", or what drives of the hardware's kind take), pictures from
        `source` (None: no camera). `wall` tells the time of day [s], by default the machine's, and nothing
        where time is stepped; it must run as the clock does. Raises `DeviceError` where there is no such
        bus."""
        self.hardware, self.source = hardware, source
        self._robot = hardware.robot
        self.clock: Clock = WallClock() if clock is None else clock
        self.journal = Journal(None) if journal is None else journal
        self.transmission = Transmission(hardware.drives)
        self._wall = time.time if wall is None and not self.clock.stepped else wall
        with urgently(not self.clock.stepped):  # for the bus's thread
            self.drives: Drives = open_drives(hardware, bus, clock=self.clock, eds=eds)
        nodes = [spec.node for spec in hardware.drives]
        self.supervisor = Supervisor(
            hardware.robot, hardware.limits, on_stop=self._on_stop, nodes=nodes, words=in_words
        )
        workspace = Workspace.of(hardware.robot, hardware.limits.curvature)
        self.tracker = MarkerTracker(hardware.camera, hardware.marker, workspace=workspace)
        self.recorder: Recorder | None = None
        self.payload = 0.0
        """Known mass on the tip [kg]; whoever hangs it says so."""
        self.base_quaternion: Floats | None = None
        """world_from_base; None: as in the robot's file."""
        self._expectation = Expectation(hardware.robot)
        self._lock = threading.RLock()
        self._looking = threading.Lock()
        self._jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._closed = threading.Event()
        self._threads: list[threading.Thread] = []
        self._plan: tuple[Plan, float] | None = None
        n = hardware.robot.n_tendons
        self._wanted: Floats = np.zeros(n)
        self._set: Floats = np.zeros(n)
        self._past = Trace(n, int(_REMEMBERED * hardware.rate))
        self.readings: Readings | None = None
        """Readings of the newest cycle."""
        self.sighting: MarkerSighting | None = None
        """The newest, trusted or not."""
        self._frame: CameraFrame | None = None
        self._pace = hardware.limits.rate
        self._trusted, self._alike = self.clock.now(), 0
        self._zero = self.clock.now()
        self._stops = 0
        self._resting = False
        self._pacer: Pacer | None = None
        self.broken: Exception | None = None
        """Error in one of our own threads, if there was any."""

    @property
    def robot(self) -> Robot:
        """Return what is driven: the hardware's model with the pretension that its tendons had when they
        were homed."""
        return self._robot

    @property
    def elapsed(self) -> float:
        """Time as readings count it [s]."""
        return self.clock.now() - self._zero

    @property
    def commanded(self) -> Floats:
        """(n_tendons,) the set-point now [m]."""
        with self._lock:
            return self._set.copy()

    def __enter__(self) -> Prototype:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def start(self, *, home: bool = True) -> None:
        """Find the drives, wind the tendons until each has its pretension (`home`; where they are then is
        zero), and enable them.

        Raises `DeviceError`, one sentence, for what does not answer or will not move; nothing is enabled
        then.
        """
        hw, limits = self.hardware, self.hardware.limits
        try:
            for _ in range(2):  # its first rest and its next step: compiled now, as that takes seconds
                self._expectation.pose(np.zeros(self.robot.n_tendons), 0.0, None)
            if not self.clock.stepped:
                gc.collect()
                # what is there now is looked through no more, which would take longer than a cycle
                gc.freeze()
            # counts in a metre
            per = 1.0 / np.abs(self.transmission.wound(np.ones(len(hw.drives), dtype=np.int64)))
            self.drives.connect(
                position_limit=np.rint(_MARGIN * limits.displacement * per).astype(np.int64),
                velocity_limit=np.rint(_MARGIN * limits.rate * per).astype(np.int64),
                following_error=np.rint(limits.following_error * per).astype(np.int64),
                deceleration=np.rint(limits.rate / _STOPS * per).astype(np.int64),
                torque_limit=np.clip(
                    np.abs(self.transmission.torque(np.full(len(per), _MARGIN * limits.tension))), 1, 3000
                ),
            )
            for sentence in self.drives.notices:
                self.journal.write(self.clock.now(), "not limited", sentence)
            if home:
                self._home()
            self._enable()
            self._pacer = Pacer(self.clock, hw.rate)
            jobs = {
                "drives": self._drive_forever,
                "camera": self._look_forever,
                "watchdog": self._watch_forever,
            }
            for name, job in () if self.clock.stepped else jobs.items():
                self._threads.append(threading.Thread(target=job, name=name, daemon=True))
                self._threads[-1].start()
        except BaseException:
            self.close()
            raise

    def _home(self) -> None:
        self.transmission, self._robot = home(
            self.drives, self.hardware, self.clock, None if self.source is None else self._see
        )

    def _see(self) -> MarkerSighting | None:
        frame = None if self.source is None else self.source.read()
        return None if frame is None else self.tracker.look(frame, now=self.clock.now())

    def command(self, dl: ArrayLike, ext: ArrayLike | None = None, *, stamp: float | None = None) -> None:
        """See `RobotLink.command`; `stamp` is when it was meant, by our clock [s]: one that is too old is
        refused.

        Raises `RefusedError` for what is beyond a limit, not finite, too late, or has an extension; ignored
        while stopped.
        """
        if ext is not None and np.any(np.asarray(ext, dtype=np.float64) != 0.0):
            raise RefusedError("ext is not zero; the prototype has no segment that can extend.")
        with self._lock:  # checked and taken in one: nothing is left to move by after a stop and a release
            if self.supervisor.state is SafetyState.STOPPED:
                return
            self._wanted, self._plan = self.supervisor.check(dl, self.clock.now(), stamp=stamp), None
            self._pace = self.hardware.limits.rate

    def glide(self, dl: ArrayLike, seconds: float) -> None:
        """See `command`, spread evenly over so long [s]: commands that come ten times slower than cycles
        then make no jerks."""
        longest = self.hardware.limits.command_age
        if not 0.0 < seconds <= longest:
            raise RefusedError(
                f"seconds is {seconds!r}; a glide takes a positive time of {longest:g} s at "
                "most: a longer one is renewed."
            )
        with self._lock:
            self.command(dl)
            self._pace = max(float(np.abs(self._wanted - self._set).max()) / seconds, _SLOWEST)

    def picture(self) -> NDArray[np.uint8] | None:
        """(h, w, 3) red, green, blue: the newest frame with the marker outlined, green where it is trusted;
        None before the first."""
        frame, sighting = self._frame, self.sighting
        return None if frame is None or sighting is None else outlined(frame.image, sighting)

    def follow(self, plan: Plan, seconds: float) -> None:
        """Set-points from `plan`, one a cycle, for so long; returns when they are done.

        Raises `RefusedError` where the plan leads beyond a limit (the drives are stopped then), `DeviceError`
        where anything stopped the robot on the way, each with its sentence.
        """
        before = self.broken
        with self._lock:
            self._plan = plan, self.clock.now()
        try:
            self.wait(seconds)
        except DeviceError:
            if isinstance(self.broken, RefusedError) and self.broken is not before:
                raise self.broken from None
            raise
        finally:
            with self._lock:
                self._plan, self._wanted = None, self._set

    def wait(self, seconds: float) -> None:
        """So much time passes; with a `SteppedClock` this is what drives the robot. Raises `DeviceError`
        where it was stopped."""
        end = self.clock.now() + seconds
        while self.clock.now() < end - 1e-9:
            if not self.clock.stepped:
                self.clock.sleep_until(min(end, self.clock.now() + 0.02))
            elif self._pacer is None:
                raise DeviceError("the prototype is not started; call start first.")
            else:
                self._pacer.wait()
                with self.supervisor.guard(self.clock):
                    self._cycle()
                    self.look()
            if self.supervisor.state is SafetyState.STOPPED:
                raise DeviceError(self.supervisor.status)

    @contextmanager
    def resting(self) -> Iterator[None]:
        """The robot holds while hands work at it and may cover the marker: the camera's faults do not count
        until they are done. On leaving it waits for the marker. Raises `DeviceError` where that is not seen,
        or anything else stopped the robot."""
        with self._lock:
            self._plan, self._wanted = None, self._set
        self._resting = True
        try:
            yield
            done = self.clock.now()
            while self.source is not None and self._trusted <= done:
                if self.clock.now() > done + _COVERED:
                    raise DeviceError(
                        f"the marker was not seen for {_COVERED:g} s after hands had worked "
                        "at the robot; is it free?"
                    )
                self.wait(0.05)
        finally:
            self._resting = False

    def read(self) -> Measurement:
        """The newest sighting with the tendons as they were then; without a camera the tendons alone."""
        with self._lock:
            sighting, readings = self.sighting, self.readings
        problem = self.supervisor.status if self.supervisor.state is SafetyState.STOPPED else ""
        if sighting is not None and self.source is not None:
            return self._measured(sighting, problem)
        n = self.robot.n_tendons
        dl, tension = (np.full(n, np.nan),) * 2 if readings is None else (readings.dl, readings.tension)
        return Measurement(
            t=self.elapsed,
            dl=dl,
            ext=np.zeros(self.robot.n_segments),
            tip_position=np.full(3, np.nan),
            tip_quaternion=np.full(4, np.nan),
            tension=tension,
            problem=problem,
        )

    def stop(self) -> None:
        """Emergency stop: the drives ramp down at once and stay off until `release`."""
        self.supervisor.emergency_stop(self.clock.now())

    def release(self) -> None:
        """A person says that it may move again: faults are reset, the drives enabled where they stand. Where
        the cause is still there it stays stopped, and `read().problem` says why."""
        stops = self._stops
        self._jobs.put(lambda: self._release(stops))
        if self.clock.stepped:
            with self.supervisor.guard(self.clock):
                self._do_jobs()

    def record(self, recorder: Recorder | None) -> None:
        """Every sighting from now on is a row of `recorder`, which has begun; None: none is."""
        with self._looking:
            self.recorder = recorder

    def recorder_for(self, path: str | Path, *, overwrite: bool = False) -> Recorder:
        """A recorder with the columns of a prototype: currents and how well the marker was seen.

        Where its rows have to move, the journal has a line of kind "recording".
        """
        extra = (*EXTRA, *(f"current_{k}" for k in range(1, self.robot.n_tendons + 1)))

        def moved(sentence: str) -> None:
            self.journal.write(self.clock.now(), "recording", sentence)

        return Recorder(self.robot, path, overwrite=overwrite, extra=extra, on_move=moved)

    def close(self) -> None:
        """Stop, disable, let go of bus and camera. A recording goes on existing: whoever began it ends it.

        Never raises: what an adapter raises is in the journal, and in `broken`.
        """
        if not self._closed.is_set() and not self.clock.stepped:
            gc.unfreeze()
        self._closed.set()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(timeout=2.0)
        self._threads = []
        ends: list[Callable[[], object]] = [self.drives.quick_stop, self.drives.close]
        for end in ends if self.source is None else [*ends, self.source.close]:
            try:
                end()
            except Exception as error:  # adapters raise what they like; the others are closed all the same
                self.broken = error
                self.journal.write(self.clock.now(), "exception", f"closing failed: {of_exception(error)}.")
        self.journal.close()

    def _enable(self) -> None:
        self.drives.enable()
        newest = self.drives.newest
        with self._lock:
            self._set = self._wanted = self.transmission.dl(newest.position)
            self._plan = None
            self._past.clear()
        with self._looking:
            self._trusted, self._alike = self.clock.now(), 0
            self.tracker.reset()
        self.supervisor.enabled(self.clock.now())

    def _release(self, stops: int) -> None:
        if stops != self._stops:
            return  # somebody has stopped it since: that counts for more
        # a stop from here on latches them again, whatever the supervisor takes back
        self.drives.acknowledge()
        try:
            self.supervisor.acknowledge(self.clock.now())
        except RefusedError:
            return  # the status says why
        self.journal.write(self.clock.now(), "release", "a person released the robot.")
        try:
            self.drives.reset_faults()
            self._enable()
        except FastrodError as error:
            self.supervisor.exception(self.clock.now(), error)

    def _do_jobs(self) -> None:
        while not self._jobs.empty():  # one thread alone takes from it
            self._jobs.get()()

    def _cycle(self) -> None:
        """One set-point to every drive, what they answer, and whether all is well."""
        self._do_jobs()
        now, dt = self.clock.now(), 1.0 / self.hardware.rate
        planned = self._plan if self.supervisor.state in (SafetyState.READY, SafetyState.RUNNING) else None
        # unlocked: nobody knows how long it takes
        planned_length = None if planned is None else planned[0](now - planned[1])
        with self._lock:
            moving = self.supervisor.state in (
                SafetyState.READY,
                SafetyState.RUNNING,
            )  # a stop may have come meanwhile
            if moving and planned_length is not None and self._plan is planned:
                self._wanted = self.supervisor.check(planned_length, now)
            before, wanted = self._set, self._wanted
            pace = self._pace if self._plan is None else self.hardware.limits.rate
        target = limited(before, wanted, min(pace, self.hardware.limits.rate), dt) if moving else None
        feedback = self.drives.exchange(None if target is None else self.transmission.counts(target))
        readings = self.transmission.readings(feedback)
        with self._lock:
            if target is not None:
                self._set = target
            self.readings = readings
            self._past.add(readings.t, readings.dl, self._set)
        now, known = self.clock.now(), len(self.supervisor.faults)
        camera = None if self.source is None or self._resting else self._camera_watch(now)
        self.supervisor.watch(now, None if self._wall is None else self._wall(), readings, camera)
        for fault in self.supervisor.faults[max(known, 1) :]:
            self.journal.write(fault.t, fault.kind, fault.sentence)

    def _camera_watch(self, now: float) -> CameraWatch:
        flag = "" if self.sighting is None else self.sighting.flag
        return CameraWatch(age=now - self._trusted, frozen=self._alike >= _FROZEN, flag=flag)

    def _on_stop(self, fault: Fault) -> None:
        self._stops += 1
        unsent = self.drives.quick_stop()
        self.journal.write(fault.t, fault.kind, fault.sentence)
        if unsent:  # the supervisor says so, and sends it again
            raise DeviceError(f"{unsent}; drives that hear nothing stop by themselves.")

    def look(self) -> None:
        """Take in the newest frame, if there is one."""
        with self._looking:
            frame = None if self.source is None else self.source.read()
            if frame is None:
                return
            now, dl = self.clock.now(), self._lengths_at(frame.t)[0]
            expected = self._expectation.pose(dl, self.payload, self.base_quaternion)
            sighting = self.tracker.look(frame, expected, now=now)
            self._alike = self._alike + 1 if sighting.flag in (FROZEN, REPEATED) else 0
            if sighting.ok:
                self._trusted = max(self._trusted, min(sighting.t, now))
            with self._lock:
                self._frame, self.sighting = frame, sighting
            recorder = self.recorder
            if recorder is None or not recorder.recording:
                return
            row, extra = self._measured(sighting, ""), _extra(sighting, self.readings)
            commanded = self._lengths_at(sighting.t)[1]
            try:
                recorder.add(
                    row,
                    payload=self.payload,
                    commanded_dl=commanded,
                    extra=extra,
                    base_quaternion=self.base_quaternion,
                )
            except InputError:
                if recorder.recording:  # otherwise somebody has just ended it
                    raise

    def _measured(self, sighting: MarkerSighting, problem: str) -> Measurement:
        readings = self.readings
        trusted = sighting.ok
        return Measurement(
            t=sighting.t - self._zero,
            dl=self._lengths_at(sighting.t)[0],
            ext=np.zeros(self.robot.n_segments),
            tip_position=sighting.position if trusted else np.full(3, np.nan),
            tip_quaternion=sighting.quaternion if trusted else np.full(4, np.nan),
            tension=np.full(self.robot.n_tendons, np.nan) if readings is None else readings.tension,
            problem=problem,
        )

    def _lengths_at(self, t: float) -> tuple[Floats, Floats]:
        """(n_tendons,) what the encoders said at `t`, between two cycles by a straight line, and the
        set-points then [m]."""
        with self._lock:
            return self._past.at(t)

    def _drive_forever(self) -> None:
        assert self._pacer is not None
        urgent()
        while not self._closed.is_set():
            self._pacer.wait()
            try:
                with self.supervisor.guard(self.clock):
                    self._cycle()
            # whatever it is, the drives are stopped and stay so; the page says what it was
            except Exception as error:
                self.broken = error

    def _look_forever(self) -> None:
        urgent(1)  # a thread that waits for its turn holds up all of this interpreter's
        while not self._closed.wait(_POLL):
            try:
                self.look()
            except Exception as error:
                self.broken = error
                self.supervisor.exception(self.clock.now(), error)

    def _watch_forever(self) -> None:
        """The drives' thread may hang, in a plan, say: it is this one that stops them then."""
        urgent()
        while not self._closed.wait(_WATCHED):
            self.supervisor.stalled(self.clock.now())


def _extra(sighting: MarkerSighting, readings: Readings | None) -> dict[str, float]:
    """The columns of a row that only a prototype has; currents are left out where none are known."""
    seen = (sighting.error, sighting.size_px, float(FLAGS.index(sighting.flag)), *sighting.position.tolist())
    currents = [] if readings is None else readings.current.tolist()
    return dict(zip(EXTRA, seen, strict=True)) | {f"current_{k}": x for k, x in enumerate(currents, 1)}
