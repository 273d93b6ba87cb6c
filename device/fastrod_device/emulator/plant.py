"""The emulated robot itself, which nobody can open: tendons -> transmission -> rod -> tip.

It shares no code with the simulator and its effects have other forms than the library's (gaps whose corners
are exponential, friction after Dahl, creep after Eyring, tendons whose strands settle), so what is found in
its motion was understood and not recognised.

    plant = Plant(seal())
    plant.advance(t, dl)                                # again and again
    position, rotation = plant.tip_seen(t)              # what a camera sees

The pairs p = (half the difference of two opposite tendons) carry the effects; what the two have in common
passes through.
"""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod.types import Floats
from fastrod_device.emulator.plant_rod import COMPLIANCE, OFFSET, PlantRest, PlantRod
from fastrod_device.emulator.seal import Seal

_G = 9.81  # m/s^2
_MEMORY = 0.5  # s of the past that a late camera may ask for
_HELD = 1.0 / 30.0  # s for which tensions are carried on from the last shape
_STEP, _CUTS = 0.02, 100  # s: longer moves are cut, into so many parts at most
_MOST = 0.05  # m of tendon
_NOTHING: Mapping[str, float] = {}


class _Load(NamedTuple):
    """On the tip and on the body."""

    mass: float
    """[kg]."""
    down: tuple[float, float, float]
    """Unit vector, base frame."""


class _Moment(NamedTuple):
    """Inputs that reached the rod at one time."""

    t: float
    tendons: tuple[float, float, float, float]
    """[m]."""
    load: _Load


class _Pair:
    """Two opposite tendons from the drums to the tip: what their half difference becomes [m]."""

    def __init__(self, inside: Mapping[str, Mapping[str, float]], index: int) -> None:
        gap = inside.get("backlash", _NOTHING)
        self._gap, self._sharp = gap.get("half_width", 0.0), gap.get("sharpness", 1.0)
        self._side = 0.0  # of the gap, -1 to 1
        rub = inside.get("friction", _NOTHING)
        self._loss, self._growth = OFFSET * rub.get("loss", 0.0), rub.get("growth", 0.0)
        self._travel = (OFFSET * rub.get("quick", 1.0), OFFSET * rub.get("late", 1.0))
        self._fraction = rub.get("share", 0.0)
        self._strain = (0.0, 0.0)
        lag = inside.get("creep", _NOTHING)
        self._fractions = (lag.get("share", 0.0), lag.get("slow_share", 0.0))
        self._tau = (lag.get("time_constant", 1.0), lag.get("slow_time_constant", 1.0))
        self._active = 0.5 * lag.get("activation", 1.0)
        self._behind = (0.0, 0.0)
        drum = inside.get("ripple", _NOTHING)
        self._once, self._often = drum.get("amplitude", 0.0), drum.get("tooth_amplitude", 0.0)
        self._radius, self._teeth = drum.get("drum_radius", 1.0), drum.get("teeth", 1.0)
        self._phase = (drum.get(f"phase_{2 * index}", 0.0), drum.get(f"phase_{2 * index + 1}", 0.0))
        self._drum = self._taut = 0.0
        self.bend = 0.0
        """Past the gap, and so what the tendons wrap [rad]."""

    def rotate(self, p: float) -> None:
        """The drums move to p [m]."""
        if self._once or self._often:
            angle = p / self._radius
            p += self._once * (math.sin(angle + self._phase[0]) - math.sin(self._phase[0]))
            p += self._often * (math.sin(self._teeth * angle + self._phase[1]) - math.sin(self._phase[1]))
        moved, self._drum = p - self._drum, p
        if self._gap:
            self._side = _across(self._side, moved / self._gap, self._sharp)
        before, self._taut = self._taut, p - self._gap * self._side
        if self._loss:
            moved = self._taut - before
            self._strain = (
                _rub(self._strain[0], moved / self._travel[0]),
                _rub(self._strain[1], moved / self._travel[1]),
            )
        self.bend = self._taut / OFFSET

    def arrive(self, wrapped: float, h: float) -> float:
        """[m] that reaches the tip after h [s], with the tendons wrapped by an angle [rad]."""
        first, second = self._strain
        p = self._taut
        if self._loss:
            p -= (
                self._loss
                * math.exp(self._growth * wrapped)
                * (self._fraction * first + (1.0 - self._fraction) * second)
            )
        if self._fractions[0]:
            self._behind = (
                self._relax(self._behind[0], p, h / self._tau[0]),
                self._relax(self._behind[1], p, h / self._tau[1]),
            )
            p -= self._fractions[0] * (p - self._behind[0]) + self._fractions[1] * (p - self._behind[1])
        return p

    def _relax(self, x: float, p: float, h: float) -> float:
        """tau x' = sinh(a (p - x)) / a with p held: tanh(a (p - x) / 2) decays."""
        return p - math.atanh(math.exp(-h) * math.tanh(self._active * (p - x))) / self._active


def _across(side: float, moved: float, sharp: float) -> float:
    """Return where in the gap one is after a move, in half widths: the flank takes over with the share
    exp(-k (1 - side)) of it."""
    if moved == 0.0:
        return side
    direction = 1.0 if moved > 0.0 else -1.0
    y = 1.0 + math.expm1(sharp * (1.0 - direction * side)) * math.exp(-sharp * abs(moved))
    return direction * (1.0 - math.log(y) / sharp)


def _rub(strain: float, moved: float) -> float:
    """Dahl: dz = (sign - z) |dx| / r."""
    direction = 1.0 if moved > 0.0 else -1.0
    return direction - (direction - strain) * math.exp(-abs(moved))


@final
class Plant:
    """One robot of one segment and four tendons, with what the seal hides. Calls may come from several
    threads."""

    def __init__(self, seal: Seal) -> None:
        """Straight and at rest, its base upright: gravity along -z of the base, nothing on the tip.

        Raises `InputError` where `seal` is not a `Seal`.
        """
        if not isinstance(seal, Seal):
            raise InputError(
                f"the plant was given a {type(seal).__name__}; it needs a Seal, as seal() makes it."
            )
        inside = seal.open()
        stretch, body = inside.get("tendon_stretch", _NOTHING), inside.get("gravity", _NOTHING)
        self._rod = PlantRod(
            compliance=COMPLIANCE + stretch.get("compliance", 0.0),
            settling=stretch.get("settling", 0.0),
            knee=stretch.get("knee", 1.0),
            weight=body.get("weight", 0.0),
            slope=body.get("slope", 0.0),
            bulge=body.get("bulge", 0.0),
            bending=seal.stiffness()[0],
            torsion=seal.stiffness()[1],
        )
        self._pairs = (_Pair(inside, 0), _Pair(inside, 1))
        late, bump = inside.get("latency", _NOTHING), inside.get("bump", _NOTHING)
        self._late = tuple(
            late.get(name, neutral)
            for name, neutral in (("delay", 0.0), ("wander", 0.0), ("period", 1.0), ("phase", 0.0))
        )
        self._shift = np.array([bump.get(name, 0.0) for name in "xyz"])
        self._tilt = _rotation(*(bump.get(f"about_{name}", 0.0) for name in "xyz"))
        self._bumped = bump.get("at", math.inf)
        self._lock = threading.RLock()
        self._commanded: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
        self._load = _Load(0.0, (0.0, 0.0, -1.0))
        self._past: deque[_Moment] = deque()
        self._began = math.nan
        self._now = _Moment(-math.inf, (0.0, 0.0, 0.0, 0.0), self._load)
        self._true: tuple[_Moment, PlantRest] | None = None
        self._seen: tuple[_Moment, PlantRest] | None = None

    def __repr__(self) -> str:
        return "Plant(sealed)"

    def advance(self, t: float, dl: Sequence[float] | Floats) -> None:
        """The tendons have gone straight to `dl` (4,) [m], negative = pulled, by the time `t` [s]; before the
        first call they were at 0.

        Raises `InputError` for anything but four finite lengths of at most 0.05 m, and where `t` is before
        the last one.
        """
        try:
            a, b, c, d = dl.tolist() if isinstance(dl, np.ndarray) else map(float, dl)
            most = max(abs(a), abs(b), abs(c), abs(d))
        except (TypeError, ValueError) as error:
            raise InputError(f"dl is {dl!r}; it must be four lengths of tendon (4,) [m].") from error
        if not (most <= _MOST and math.isfinite(a + b + c + d)):
            raise InputError(
                f"dl is {[a, b, c, d]} m; tendons change by at most {_MOST} m. Was it given in mm?"
            )
        with self._lock:
            if not (math.isfinite(t) and t >= self._now.t):
                raise InputError(
                    f"t is {t!r} s; the plant is at {self._now.t} s, and time is finite and "
                    "does not run back."
                )
            if math.isnan(self._began):
                self._began, h = t, 0.0
            else:
                h = t - self._now.t
            commanded = (a, b, c, d)
            if commanded == self._commanded:  # creep at rest is exact over any time
                tendons = self._move(commanded, h)
            else:
                cuts = min(max(1, math.ceil(h / _STEP)), _CUTS)
                tendons, before, here = self._now.tendons, self._commanded, self._commanded
                for k in range(1, cuts + 1):
                    # half of the time before the move and half after: second order
                    self._move(here, 0.5 * h / cuts)
                    x = k / cuts
                    here = (
                        commanded
                        if k == cuts
                        else tuple(old + x * (new - old) for old, new in zip(before, commanded, strict=True))
                    )
                    tendons = self._move(here, 0.5 * h / cuts)
                self._commanded = commanded
            self._now = _Moment(float(t), tendons, self._load)
            self._past.append(self._now)
            while len(self._past) > 2 and self._past[1].t < t - _MEMORY:
                self._past.popleft()

    def _move(self, commanded: tuple[float, ...], h: float) -> tuple[float, float, float, float]:
        """Lengths that reach the rod [m] when the drums are at `commanded`, after h [s]."""
        p, q = 0.5 * (commanded[0] - commanded[2]), 0.5 * (commanded[1] - commanded[3])
        first, second = self._pairs
        first.rotate(p)
        second.rotate(q)
        wrapped = math.hypot(first.bend, second.bend)
        x, y = first.arrive(wrapped, h), second.arrive(wrapped, h)
        return commanded[0] - p + x, commanded[1] - q + y, commanded[2] + p - x, commanded[3] + q - y

    def hang(self, mass: float) -> None:
        """A known mass on the tip [kg], from now on. Raises `InputError` unless it is from 0 to 1 kg."""
        if not (isinstance(mass, (int, float)) and 0.0 <= mass <= 1.0):
            raise InputError(f"mass is {mass!r} kg; it must be from 0 to 1 kg. Was it given in g?")
        with self._lock:
            self._load = self._load._replace(mass=float(mass))
            self._now = self._now._replace(load=self._load)

    def rotate(self, quaternion: ArrayLike) -> None:
        """The base stands so in the world, from now on: world_from_base (4,), w x y z; gravity is along -z of
        the world.

        Raises `InputError` unless it is a rotation.
        """
        q = np.asarray(quaternion, dtype=np.float64)
        norm = float(np.sqrt(np.sum(q * q)))
        if q.shape != (4,) or not abs(norm - 1.0) < 1e-3:
            raise InputError(
                f"quaternion is {np.asarray(quaternion).tolist()}; it must be a unit quaternion (4,) w x y z."
            )
        w, x, y, z = (q / norm).tolist()
        with self._lock:
            # the last row of the rotation, turned over
            down = (2.0 * (w * y - x * z), -2.0 * (w * x + y * z), -(w * w - x * x - y * y + z * z))
            self._load = self._load._replace(down=down)
            self._now = self._now._replace(load=self._load)

    def tip(self, t: float | None = None) -> tuple[Floats, Floats]:
        """Return where the tip truly is at `t` [s], within the last half second, or now: position (3,) [m]
        and base_from_tip (3, 3), base frame.

        After the last `advance` nothing moves. Raises `DeviceError` where the load makes the robot snap.
        """
        with self._lock:
            return self._pose(self._at(t))

    def tip_seen(self, t: float | None = None) -> tuple[Floats, Floats]:
        """Return what a camera reports of the tip at `t` [s], or now; shapes, frames and errors as in
        `tip`."""
        with self._lock:
            t = self._now.t if t is None else t
            delay, wander, period, phase = self._late
            if delay == 0.0:
                position, rotation = self._pose(self._at(t))
            else:
                late = t - delay * (1.0 + wander * math.sin(2.0 * math.pi * t / period + phase))
                self._seen = self._solve(self._at(late), self._seen or self._true)
                position, rotation = self._seen[1].position.copy(), self._seen[1].rotation.copy()
            if t - self._began > self._bumped:
                return self._tilt @ position + self._shift, self._tilt @ rotation
            return position, rotation

    def tension(self) -> Floats:
        """(4,) of the tendons now [N], pushing where negative; for up to a thirtieth of a second they go on
        linearly from the last shape."""
        with self._lock:
            if (
                self._true is None
                or self._true[0].load != self._load
                or self._now.t - self._true[0].t >= _HELD
            ):
                self._true = self._solve(self._now, self._true)
            rest = self._true[1]
            return np.asarray(rest.tension + rest.slope @ (np.array(self._now.tendons) - rest.dl))

    def _at(self, t: float | None) -> _Moment:
        """The moment t [s]: between two of them the tendons went straight."""
        if t is None or t >= self._now.t or not self._past:
            return self._now
        if not math.isfinite(t):
            raise InputError(f"t is {t!r} s; it must be finite.")
        after = self._now
        for moment in reversed(self._past):
            if moment.t <= t:
                x = (t - moment.t) / (after.t - moment.t)
                a, b, c, d = (
                    old + x * (new - old) for old, new in zip(moment.tendons, after.tendons, strict=True)
                )
                return _Moment(t, (a, b, c, d), moment.load)
            after = moment
        return after

    def _pose(self, moment: _Moment) -> tuple[Floats, Floats]:
        self._true = self._solve(moment, self._true)
        rest = self._true[1]
        return rest.position.copy(), rest.rotation.copy()

    def _solve(self, moment: _Moment, last: tuple[_Moment, PlantRest] | None) -> tuple[_Moment, PlantRest]:
        if last is not None and last[0].tendons == moment.tendons and last[0].load == moment.load:
            return moment, last[1]
        down = np.array(moment.load.down)
        return moment, self._rod.rest(
            np.array(moment.tendons), moment.load.mass * _G * down, down, None if last is None else last[1]
        )


def _rotation(x: float, y: float, z: float) -> Floats:
    """(3, 3) of a rotation vector [rad]."""
    angle = math.sqrt(x * x + y * y + z * z)
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(
        np.eye(3) + np.sinc(angle / np.pi) * hat + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * hat @ hat
    )
