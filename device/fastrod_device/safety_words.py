"""Faults of a robot on the bench: the kinds, and how each is found and reported in one sentence."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from fastrod.errors import FastrodError, InputError, UnknownNameError, nearest
from fastrod.types import Floats, Ints
from fastrod_device.limits import Limits
from fastrod_device.readings import Readings

KINDS = (
    "emergency stop",
    "clock jump",
    "controller stalled",
    "foreign SYNC",
    "bus off",
    "node reboot",
    "encoder jump",
    "emergency message",
    "drive fault",
    "heartbeat lost",
    "feedback stale",
    "following error",
    "tension",
    "displacement",
    "slack tendon",
    "camera frozen",
    "marker lost",
    "command stale",
    "nobody watches",
    "exception",
)
"""In order of priority where one cycle shows several: a cause stands before what follows from it."""

FAULT = 0x0008
"""Statusword (CiA 402) bit 3: the drive is in fault."""
STATE_MASK = 0x006F
"""Bits of the statusword that tell the drive's state; without voltage and quick stop it is
`STATE_MASK_SHORT`."""
STATE_MASK_SHORT = 0x004F
"""Mask of the state bits, as above, for the states in which the quick-stop bit has no meaning."""
OPERATION_ENABLED = 0x0027
"""The statusword under `STATE_MASK` of a drive that follows its set-points."""
NMT_OPERATIONAL = 5
"""NMT state (CiA 301) in which process data flows."""
NMT_NONE = -1
"""No heartbeat yet."""
_SHORT = {
    0x00: "not ready",
    0x40: "switched off (switch on disabled)",
    0x0F: "reacting to a fault",
    0x08: "in fault",
}
_LONG = {
    0x21: "ready to switch on",
    0x23: "switched on, not enabled",
    0x27: "enabled",
    0x07: "in a quick stop",
}
_NMT = {-1: "none yet", 0: "booting", 4: "stopped", 5: "operational", 127: "pre-operational"}
_MOVES = 0.1  # of the largest rate: a tendon that is slower stands


@dataclass(frozen=True, kw_only=True)
class Fault:
    """Why a robot was stopped. Raises `UnknownNameError` for a kind that is none of `KINDS`."""

    kind: str
    """One of `KINDS`."""
    sentence: str
    """Sentence on what was found: drive, figure and limit."""
    t: float
    """When it was found [s]."""
    drive: int | None = None
    """Index of the drive, from 0; None where it is no drive's."""

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UnknownNameError(f"no kind of fault {self.kind!r}; {nearest(self.kind, KINDS)}")


@dataclass(frozen=True, kw_only=True)
class CameraWatch:
    """Report of the camera in one cycle."""

    age: float
    """Age of the newest good sighting [s]; inf before the first."""
    frozen: bool
    """The source repeats its frames."""
    flag: str = ""
    """Flag of the newest sighting, where it is not trusted."""


def in_hex(code: int) -> str:
    """An emergency code as a number, where no words for it are at hand.

    >>> in_hex(0x8611)
    '0x8611'
    """
    return f"0x{code:04X}"


def drive_state(statusword: int) -> str:
    """The CiA 402 state in words.

    >>> drive_state(0x0637)
    'enabled'
    """
    short = _SHORT.get(statusword & STATE_MASK_SHORT)
    return short or _LONG.get(statusword & STATE_MASK, "in no state that CiA 402 knows")


@final
class Inspector:
    """Finds what is wrong in one cycle. It keeps nothing and decides nothing; what is not a number is beyond
    every limit."""

    def __init__(
        self, n_drives: int, limits: Limits, nodes: Sequence[int], words: Callable[[int], str]
    ) -> None:
        """Raises `InputError` where `nodes` is neither empty nor one node id for each drive."""
        if nodes and len(nodes) != n_drives:
            raise InputError(
                f"nodes has {len(nodes)} node ids and the robot {n_drives} tendons; give one for "
                "each tendon, or none."
            )
        self._n, self._limits, self._nodes, self._words = n_drives, limits, tuple(nodes), words

    def name(self, drive: int) -> str:
        """See `drive 2 (node 5)`, counted from 1; without the node where none is known."""
        return (
            f"drive {drive + 1} (node {self._nodes[drive]})"
            if self._nodes and 0 <= drive < self._n
            else f"drive {drive + 1}"
        )

    def require(self, readings: Readings) -> None:
        """Raises `InputError` where the readings are not one of each for every drive."""
        for name in ("dl", "rate", "tension", "following_error", "statusword", "age", "heartbeat_age", "nmt"):
            if (shape := np.shape(getattr(readings, name))) != (self._n,):
                raise InputError(f"readings.{name} has shape {shape}; the robot has {self._n} drives.")

    def lasting(self, now: float, readings: Readings, camera: CameraWatch | None) -> Iterator[Fault]:
        """Return what is wrong for as long as it is: only its end makes the robot fit to move again."""
        # readings may be looked at twice: they have aged since
        limits, old = self._limits, max(now - readings.t, 0.0)
        if readings.foreign_syncs:
            text = f"another node sends SYNC ({readings.foreign_syncs} since the last cycle)"
            yield Fault(kind="foreign SYNC", sentence=f"{text}; the controller alone may.", t=now)
        if readings.lost:
            yield Fault(
                kind="bus off", sentence=f"the bus carries nothing: {readings.lost.rstrip('.')}.", t=now
            )
        else:
            yield from self._silent(now, readings.age + old)
        away = (readings.nmt != NMT_OPERATIONAL) & (readings.nmt != NMT_NONE)
        for k in _first(away):
            state = int(readings.nmt[k])
            text = (
                f"its NMT state is {state} ({_NMT.get(state, 'unknown')}), not 5 (operational); where "
                "its tendon is may be lost"
            )
            yield self._of("node reboot", k, f"was started anew or left operation: {text}", now)
        heart = np.where(readings.nmt == NMT_NONE, np.inf, readings.heartbeat_age + old)
        yield from self._beyond(
            "heartbeat lost", heart, limits.heartbeat_age, "sent its last heartbeat {} ago", "ms", now
        )
        yield from self._beyond(
            "feedback stale",
            readings.age + old,
            limits.feedback_age,
            "sent its last process data {} ago",
            "ms",
            now,
        )
        yield from self._beyond(
            "tension", readings.tension, limits.tension, "pulls its tendon with {}", "N", now
        )
        furthest = limits.displacement + limits.following_error
        where = "has its tendon at {}, further than a command and its following error can lead"
        yield from self._beyond("displacement", readings.dl, furthest, where, "mm", now)
        if camera is None or limits.sighting_age is None:
            return
        if camera.frozen:
            yield Fault(
                kind="camera frozen",
                sentence=f"the camera repeats its frames; the newest sighting is {_ms(camera.age)} old.",
                t=now,
            )
        if not -limits.cycle <= camera.age <= limits.sighting_age:  # one of the future says nothing about now
            limit = f"the limit is {_ms(limits.sighting_age)}"
            why = f"; the newest picture is flagged {camera.flag!r}" if camera.flag else ""
            sentence = f"the marker was last seen {_ms(camera.age)} ago; {limit}{why}."
            yield Fault(kind="marker lost", sentence=sentence, t=now)

    def drives(self, now: float, readings: Readings) -> Iterator[Fault]:
        """Return what drives say of themselves: emergency messages and faults. A drive keeps its fault
        until it is reset."""
        for message in readings.emergencies:
            if message.code & 0xFF00 == 0:
                continue  # 00xx reports that an error is gone
            words, code = self._words(message.code), in_hex(message.code)
            text = code if words == code else f"{code}, {words.rstrip('.')}"
            yield self._of(
                "emergency message",
                message.drive,
                f"sent an emergency: {text} (error register 0x{message.register:02X})",
                now,
            )
            break
        yield from self._state((readings.statusword & FAULT) != 0, readings.statusword, now)

    def powered(self, now: float, readings: Readings, before: Readings | None) -> Iterator[Fault]:
        """Return what is wrong only while drives are enabled; `before` is the cycle before, None for the
        first."""
        limits = self._limits
        yield from self._state(
            (readings.statusword & STATE_MASK) != OPERATION_ENABLED, readings.statusword, now
        )
        if before is not None:
            yield from self._jump(now, readings, before)
        error = "is {} from where it was commanded to be"
        yield from self._beyond(
            "following error", readings.following_error, limits.following_error, error, "mm", now
        )
        if limits.slack is not None:
            for k in _first(~(readings.tension >= limits.slack)):
                text = (
                    f"pulls its tendon with {readings.tension[k]:.3g} N; a tendon is slack below "
                    f"{limits.slack:g} N"
                )
                yield self._of("slack tendon", k, text, now)

    def times(self, now: float, wall: float | None, last: float, last_wall: float | None) -> Iterator[Fault]:
        """Clocks that jump and a control loop that stood still, between the cycle `last` [s] and `now`."""
        gap = now - last
        if gap < 0.0:
            yield Fault(
                kind="clock jump",
                sentence=f"the monotonic clock ran back by {_ms(-gap)}; it must never.",
                t=now,
            )
        elif (
            wall is not None
            and last_wall is not None
            and not abs(wall - last_wall - gap) <= self._limits.clock_jump
        ):
            limit = f"the limit is {_ms(self._limits.clock_jump)}"
            sentence = (
                f"the wall clock jumped by {_ms(wall - last_wall - gap)} against the monotonic one; {limit}."
            )
            yield Fault(kind="clock jump", sentence=sentence, t=now)
        if not gap <= self._limits.cycle:
            yield self.stalled(now, gap)

    def stalled(self, now: float, gap: float) -> Fault:
        """A control loop that has not looked for `gap` [s]."""
        sentence = f"the controller stood still for {_ms(gap)}; the limit is {_ms(self._limits.cycle)}."
        return Fault(kind="controller stalled", sentence=sentence, t=now)

    def command(self, now: float, readings: Readings, meant: float) -> Iterator[Fault]:
        """A robot that moves on a command from `meant` [s] that nobody renews."""
        fastest = float(np.max(np.abs(readings.rate)))
        if not now - meant <= self._limits.command_age and not fastest <= _MOVES * self._limits.rate:
            limit = f"it must be renewed every {_ms(self._limits.command_age)}"
            sentence = (
                f"the robot moves at {1e3 * fastest:.3g} mm/s on a command that is "
                f"{_ms(now - meant)} old; {limit}."
            )
            yield Fault(kind="command stale", sentence=sentence, t=now)

    def _silent(self, now: float, age: Floats) -> Iterator[Fault]:
        """All drives at once: that is the bus, and no drive."""
        limit = self._limits.feedback_age
        if self._n > 1 and not (age <= limit).any():
            sentence = (
                "the bus carries nothing: no drive has sent process data for "
                f"{_ms(float(np.min(age)))}; the limit is {_ms(limit)}."
            )
            yield Fault(kind="bus off", sentence=sentence, t=now)

    def _state(
        self, bad: np.ndarray[tuple[int, ...], np.dtype[np.bool_]], statusword: Ints, now: float
    ) -> Iterator[Fault]:
        for k in _first(bad):
            word = int(statusword[k])
            yield self._of(
                "drive fault",
                k,
                f"is {drive_state(word)}, not enabled (statusword 0x{word & 0xFFFF:04X})",
                now,
            )

    def _jump(self, now: float, readings: Readings, before: Readings) -> Iterator[Fault]:
        """Over the time between two samples of a drive, not two cycles: a late sample has gone further."""
        known = np.isfinite(readings.age) & np.isfinite(before.age)
        later = np.where(known, before.age, 0.0) - np.where(known, readings.age, 0.0)
        dt = np.maximum(readings.t - before.t + later, 0.0)
        change = readings.dl - before.dl
        allowed = self._limits.rate * dt + self._limits.encoder_jump
        for k in _first(known & ~(np.abs(change) <= allowed)):
            text = (
                f"moved its tendon by {1e3 * change[k]:.3g} mm in {_ms(float(dt[k]))}; the limit is "
                f"{1e3 * allowed[k]:.3g} mm"
            )
            yield self._of("encoder jump", k, text, now)

    def _beyond(
        self, kind: str, values: Floats, limit: float, text: str, unit: str, now: float
    ) -> Iterator[Fault]:
        """The drive that is furthest beyond a limit, either way."""
        size = np.where(np.isnan(values), np.inf, np.abs(values))
        k = int(np.argmax(size))
        if size[k] > limit:
            scale = 1.0 if unit == "N" else 1e3
            figure, most = f"{scale * values[k]:.4g} {unit}", f"{scale * limit:.4g} {unit}"
            yield self._of(kind, k, f"{text.format(figure)}; the limit is {most}", now)

    def _of(self, kind: str, drive: int, text: str, now: float) -> Fault:
        return Fault(kind=kind, sentence=f"{self.name(drive)} {text}.", t=now, drive=drive)


def by_priority(faults: Iterable[Fault]) -> list[Fault]:
    """Sorted as `KINDS` are, each kind once."""
    kinds: dict[str, Fault] = {}
    for fault in faults:
        kinds.setdefault(fault.kind, fault)
    return sorted(kinds.values(), key=lambda fault: KINDS.index(fault.kind))


def of_exception(error: BaseException) -> str:
    """An exception in one line; never raises."""
    try:
        text = " ".join(str(error).split())
    except Exception:
        text = ""
    if isinstance(error, FastrodError) and text:
        return text.rstrip(".")  # a sentence that tells all
    return f"{type(error).__name__}: {text.rstrip('.')}" if text else type(error).__name__


def _first(bad: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[int]:
    return [int(k) for k in np.flatnonzero(bad)[:1]]


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.4g} ms" if math.isfinite(seconds) else f"{seconds} s"
