"""`Linked`: a robot at the other end of a link, with what some links offer beyond driving and reading.

Each offer is a protocol of its own. A link that lacks one is driven all the same; the page then shows less of
it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Annotated, Protocol, final, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.checks import Bound, check
from fastrod.logs.link import Measurement, RobotLink
from fastrod.logs.recording import Recorder
from fastrod.types import Floats

_MAY_MOVE = ("ready", "running")


@dataclass(frozen=True, kw_only=True)
class TendonLimits:
    """Limits of the tendons of a linked robot; a simulated one has none. Raises `InputError`."""

    displacement: Annotated[float, Bound(above=0.0, unit="m", infinite=True)] = math.inf
    """Largest change of a tendon's length, in either direction [m]."""
    rate: Annotated[float, Bound(above=0.0, unit="m/s", infinite=True)] = math.inf
    """Largest rate of a tendon [m/s]."""

    def __post_init__(self) -> None:
        check(self)


class Bounds(Protocol):
    """Limits of a robot's tendons."""

    @property
    def displacement(self) -> float:
        """[m], in either direction."""

    @property
    def rate(self) -> float:
        """[m/s]"""


class Guard(Protocol):
    """Supervisor of a robot, which stops it."""

    limits: Bounds

    @property
    def state(self) -> Enum:
        """Its value is "ready" or "running" while the robot may move."""

    @property
    def status(self) -> str:
        """State and reason in one sentence."""

    @property
    def first(self) -> object | None:
        """Cause of the stop; None while it is not stopped."""

    def client_lost(self, now: float) -> object | None:
        """Report that nobody watches any more."""


class Ticking(Protocol):
    """A clock."""

    def now(self) -> float:
        """[s]"""


class LinkedSighting(Protocol):
    """Report of a camera's frame about the tip."""

    t: float
    flag: str


class Encoders(Protocol):
    """Report of the drives."""

    dl: Floats
    """(n_tendons,) as `Measurement.dl` [m]."""
    tension: Floats
    """(n_tendons,) [N]."""


@runtime_checkable
class Guarded(Protocol):
    """A link that is watched: it stops by itself, and says why."""

    supervisor: Guard
    clock: Ticking


@runtime_checkable
class Driven(Protocol):
    """A link that reports its set-points and encoders apart from its camera, which is slower."""

    @property
    def commanded(self) -> Floats:
        """(n_tendons,) the set-point now [m]."""

    @property
    def readings(self) -> Encoders | None:
        """The newest; None before the first."""


@runtime_checkable
class Gliding(Protocol):
    """A link that moves evenly to a set-point, rather than at once and as fast as it may."""

    def glide(self, dl: ArrayLike, seconds: float) -> None:
        """Command set-points like `RobotLink.command`, spread evenly over so long [s]."""


@runtime_checkable
class Sighted(Protocol):
    """A link with a camera that follows the tip."""

    clock: Ticking
    source: object | None
    """The camera; None where there is none."""

    @property
    def sighting(self) -> LinkedSighting | None:
        """The newest; None before the first."""


@runtime_checkable
class Seeing(Protocol):
    """A link that shows what its camera sees."""

    def picture(self) -> NDArray[np.uint8] | None:
        """(h, w, 3) red, green, blue: the newest frame; None before the first."""


@runtime_checkable
class Recording(Protocol):
    """A link that records its own readings, each once, by its own clock."""

    @property
    def elapsed(self) -> float:
        """Time as its readings count it [s]."""

    def recorder_for(self, path: str) -> Recorder:
        """A recorder with the columns that it fills."""

    def record(self, recorder: Recorder | None) -> None:
        """Every reading from now on is a row of `recorder`, which has begun; None: none is."""


@final
class Linked:
    """A link and its capabilities. Every method may be called from any thread."""

    def __init__(self, link: RobotLink) -> None:
        self.link = link
        self._guarded = link if isinstance(link, Guarded) else None
        self._driven = link if isinstance(link, Driven) else None
        self._gliding = link if isinstance(link, Gliding) else None
        self._sighted = link if isinstance(link, Sighted) and link.source is not None else None
        self._seeing = link if isinstance(link, Seeing) else None
        self._own = (
            link
            if isinstance(link, Recording) and (self._sighted is not None or not isinstance(link, Sighted))
            else None
        )
        self._seen = -math.inf

    @property
    def limits(self) -> TendonLimits:
        """Limits of its tendons."""
        if self._guarded is None:
            return TendonLimits()
        limits = self._guarded.supervisor.limits
        return TendonLimits(displacement=limits.displacement, rate=limits.rate)

    @property
    def stopped(self) -> bool:
        """It has stopped by itself, or was stopped by anyone."""
        return self._guarded is not None and self._guarded.supervisor.first is not None

    @property
    def ready(self) -> bool:
        """It takes commands."""
        return self._guarded is None or self._guarded.supervisor.state.value in _MAY_MOVE

    @property
    def status(self) -> str:
        """State and reason in one sentence; empty where it reports none."""
        return "" if self._guarded is None else self._guarded.supervisor.status

    @property
    def sees(self) -> bool:
        """It shows what its camera sees."""
        return self._seeing is not None

    def picture(self) -> NDArray[np.uint8] | None:
        """(h, w, 3) what its camera sees."""
        return None if self._seeing is None else self._seeing.picture()

    def command(self, dl: Floats, ext: Floats, seconds: float) -> None:
        """Go there, evenly within so long [s] where it can. Raises `FastrodError` for what is beyond its
        limits."""
        if self._gliding is not None and not ext.any():
            self._gliding.glide(dl, seconds)
        else:
            self.link.command(dl, ext)

    def stop(self, *, nobody: bool = False) -> None:
        """Stand still at once; `nobody` is the reason: nobody watches any more."""
        if nobody and self._guarded is not None:
            self._guarded.supervisor.client_lost(self._guarded.clock.now())
        if not (nobody and self.stopped):
            self.link.stop()

    def standing(self) -> tuple[Floats, Floats]:
        """(n_tendons,), (n_segments,) changes of length where it is now, as its encoders say [m]."""
        if self._driven is not None and (encoders := self._driven.readings) is not None:
            return encoders.dl, np.zeros(self.link.robot.n_segments)
        now = self.link.read()
        return now.dl, now.ext

    def held(self) -> tuple[Floats, Floats]:
        """Return the changes of length (n_tendons,), (n_segments,) that it holds [m]: to command these moves
        nothing."""
        if self._driven is not None:
            return self._driven.commanded, np.zeros(self.link.robot.n_segments)
        now = self.link.read()
        return now.dl, now.ext

    def tension(self, measured: Measurement) -> Floats:
        """(n_tendons,) the newest [N]."""
        if self._driven is not None and (encoders := self._driven.readings) is not None:
            return encoders.tension
        return measured.tension

    def camera(self) -> str:
        """Return how well the tip is seen, in a few words; empty where nothing looks."""
        if self._sighted is None:
            return ""
        sighting, now = self._sighted.sighting, self._sighted.clock.now()
        if sighting is None:
            return "no picture yet"
        age = now - sighting.t
        if not sighting.flag:
            self._seen = max(self._seen, sighting.t)
            return f"marker seen {1e3 * age:.0f} ms ago" if age < 1.0 else f"no picture for {age:.1f} s"
        last = f", last trusted {now - self._seen:.1f} s ago" if math.isfinite(self._seen) else ""
        return f"{sighting.flag}{last}"

    def recorder(self, path: Path) -> tuple[Recorder, bool]:
        """A recorder, begun at the link's time, and whether the link itself fills it from now on. Raises
        `InputError`."""
        if self._own is None:
            recorder = Recorder(self.link.robot, path)
            recorder.start(self.link.read().t, "by hand")
            return recorder, False
        recorder = self._own.recorder_for(str(path))
        recorder.start(self._own.elapsed, "by hand")
        self._own.record(recorder)
        return recorder, True

    def end_recording(self) -> None:
        """No row comes from the link after this."""
        if self._own is not None:
            self._own.record(None)
