"""`Control`: one number that a person sets, in the unit in which people think of it; and those of a robot,
group by group."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fastrod.model.robot import Robot
from fastrod_viewer.drive.teleop import LARGEST_BEND, LARGEST_TENSION, Teleop
from fastrod_viewer.worlds.world import World

_ALL = 60.0  # deg, of each segment
_NICE = (1.0, 2.0, 5.0, 10.0)
_MM, _GRAM, _DEGREE = 1e-3, 1e-3, math.pi / 180.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Control:
    """A slider without its page."""

    label: str
    """Its name, with its unit in brackets."""
    low: float
    high: float
    step: float
    get: Callable[[], float]
    """Returns its value, in that unit."""
    put: Callable[[float], None]
    hint: str

    @property
    def value(self) -> float:
        """Its value, rounded to a tenth of a step, and to 0 within half a step of it, within its ends."""
        digits = max(0, 1 - math.floor(math.log10(self.step)))
        value = self.get()
        return min(max(round(value, digits) if abs(value) >= 0.5 * self.step else 0.0, self.low), self.high)


@dataclass(frozen=True, eq=False)
class Group:
    """Controls that belong together."""

    title: str
    """Empty for those that stand first, without a heading."""
    controls: tuple[Control, ...]
    open: bool = True
    """At first."""


def nice(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten that is not below a positive value.

    >>> nice(0.43), nice(2.0)
    (0.5, 2.0)
    """
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{next(n for n in _NICE if n * power >= value * (1.0 - 1e-9)) * power:.6g}")


def largest_force(robot: Robot) -> float:
    """Return the tip force [N] that bends the robot by a good fraction of its length: twice EI / l^2, rounded
    up."""
    return nice(2.0 * min(min(s.bending_stiffness) for s in robot.segments) / robot.length**2)


def drive_controls(world: World, teleop: Teleop) -> list[Group]:
    """Return groups for bends and extensions, tendons, and base: those that the robot has."""
    robot, groups = world.robot, []
    n = robot.n_segments
    if len(teleop.driven) > 1:
        some = ([k for k in teleop.driven if teleop.bends(k, axis)] for axis in (0, 1))
        groups.append(
            Group("", tuple(_all_bend(teleop, bent, axis) for axis, bent in enumerate(some) if bent))
        )
    if teleop.actions is not None:
        own = ((k, _segment(robot, teleop, k)) for k in range(n))
        groups += [Group(f"Segment {k + 1}", controls, n <= 2) for k, controls in own if controls]
    if robot.n_tendons:
        groups.append(
            Group(
                "Tendons",
                tuple(_tendon(robot, teleop, i) for i in range(robot.n_tendons)),
                teleop.actions is None,
            )
        )
    if world.base_moves and not teleop.linked:
        title = "Flange of the host" if world.host else "Base"
        groups.append(Group(title, tuple(_base(robot, teleop, axis) for axis in range(6)), open=False))
    return groups


def load_controls(robot: Robot, teleop: Teleop, *, rings: bool = False) -> Group:
    """Tip force, payload, gravity; of a robot that `rings` it says that the payload is a weight alone."""
    most = largest_force(robot)
    heaviest = nice(most / 9.81 / _GRAM)
    payload = Control(
        label="Payload [g]",
        low=0.0,
        high=heaviest,
        step=heaviest / 100.0,
        hint="Weight of this mass at the tip, without its inertia." if rings else "Mass at the tip.",
        get=lambda: teleop.loads[1] / _GRAM,
        put=lambda v: teleop.load(payload=v * _GRAM),
    )
    gravity = Control(
        label="Gravity [× g]",
        low=0.0,
        high=3.0,
        step=0.05,
        hint="On robot and payload.",
        get=lambda: teleop.loads[2],
        put=lambda v: teleop.load(gravity=v),
    )
    return Group("", (*(_force(teleop, axis, most) for axis in range(3)), payload, gravity))


def _all_bend(teleop: Teleop, bent: Sequence[int], axis: int) -> Control:
    def get() -> float:
        return float(np.mean([teleop.bent(k)[axis] for k in bent])) / _DEGREE

    def put(degrees: float) -> None:
        for k in bent:
            _bend(teleop, k, axis, degrees)

    name = "xy"[axis]
    hint = f"Bends every segment by so many degrees toward {name}."
    return Control(label=f"All bend {name} [°]", low=-_ALL, high=_ALL, step=1.0, get=get, put=put, hint=hint)


def _segment(robot: Robot, teleop: Teleop, k: int) -> tuple[Control, ...]:
    step = _arm(teleop, k) * _DEGREE
    most = min(LARGEST_BEND / _DEGREE, _whole(teleop.limits.displacement, step)) if step else 0.0
    bends = tuple(
        Control(
            label=f"Bend {name} [°]",
            low=-most,
            high=most,
            step=1.0,
            hint=f"Bends the segment toward {name} of its base.",
            get=lambda axis=axis: teleop.bent(k)[axis] / _DEGREE,  # type: ignore[misc]
            put=lambda v, axis=axis: _bend(teleop, k, axis, v),  # type: ignore[misc]
        )
        for axis, name in enumerate("xy")
        if teleop.bends(k, axis)
    )
    low, high = (v / _MM for v in robot.segments[k].extension)
    if high <= low:
        return bends
    extend = Control(
        label="Extend [mm]",
        low=low,
        high=high,
        step=0.1,
        hint="Lengthens the segment.",
        get=lambda: float(teleop.goals.action[3 * k]) / _MM,
        put=lambda v: teleop.extend(k, v * _MM),
    )
    return (*bends, extend)


def _arm(teleop: Teleop, k: int) -> float:
    """Return the lever arm of a segment's bend on its tendons [m]."""
    return math.inf if teleop.actions is None else float(teleop.actions.offset[k])


def _whole(most: float, step: float) -> float:
    """The largest whole number of steps within `most`."""
    return float(math.floor(most / step)) if math.isfinite(most) else most


def _bend(teleop: Teleop, k: int, axis: int, degrees: float) -> None:
    bends = list(teleop.bent(k))
    bends[axis] = degrees * _DEGREE
    teleop.bend(k, *bends)


def _tendon(robot: Robot, teleop: Teleop, i: int) -> Control:
    k = int(robot.tendon_segment[i])
    segment = robot.segments[k]
    name = f"Tendon {i + 1}" + (f", segment {k + 1}" if robot.n_segments > 1 else "")
    if segment.mode == "tendon_tension":
        return Control(
            label=f"{name} [N]",
            low=0.0,
            high=LARGEST_TENSION,
            step=0.05,
            hint="Tension of the tendon.",
            get=lambda: float(teleop.goals.tension[i]),
            put=lambda v: teleop.pull_with(i, v),
        )
    most = min(
        nice(LARGEST_BEND * sum(math.hypot(*place) for place in robot.tendons[i].position(k + 1)) / _MM),
        0.05 * _whole(teleop.limits.displacement / _MM - 1e-3, 0.05),
    )
    return Control(
        label=f"{name} [mm]",
        low=-most,
        high=most,
        step=0.05,
        hint="Positive pulls the tendon, negative lets it out.",
        get=lambda: -float(teleop.change[i]) / _MM,
        put=lambda v: teleop.change_tendon(i, -v * _MM),
    )


def _base(robot: Robot, teleop: Teleop, axis: int) -> Control:
    straight = axis < 3
    unit, word, factor = ("mm", "", _MM) if straight else ("°", "Rotate ", _DEGREE)
    most = nice(0.5 * robot.length / _MM) if straight else 90.0

    def put(value: float) -> None:
        base = teleop.goals.base.copy()
        base[axis] = value * factor
        teleop.move_base(base)

    return Control(
        label=f"{word}{'xyz'[axis % 3]} [{unit}]",
        low=-most,
        high=most,
        step=1.0,
        hint="From where it began, world axes.",
        get=lambda: float(teleop.goals.base[axis]) / factor,
        put=put,
    )


def _force(teleop: Teleop, axis: int, most: float) -> Control:
    def put(value: float) -> None:
        force = teleop.loads[0].copy()
        force[axis] = value
        teleop.load(tip_force=force)

    return Control(
        label=f"Tip force {'xyz'[axis]} [N]",
        low=-most,
        high=most,
        step=most / 100.0,
        hint="Force on the tip, world axes.",
        get=lambda: float(teleop.loads[0][axis]),
        put=put,
    )
