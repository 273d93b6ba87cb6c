"""The words of a robot: `Tendon`, `Segment`, `Robot`; frozen and validated once."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal, TypeAlias, TypeVar, get_args

import numpy as np
from numpy.typing import NDArray

from fastrod.checks import Bound, check, check_number, named_fields
from fastrod.errors import RobotError, shown
from fastrod.model.logformat import LogFormat

Mode: TypeAlias = Literal["tendon_length", "tendon_tension", "passive", "paper"]
"""Boundary mode of a segment: what is prescribed at its end (Rucker and Webster 2011; `paper`: SoftManiSim,
eqs. 2b and 3b)."""

MODES: tuple[str, ...] = get_args(Mode)
_LONGEST = 10.0  # m; a longer segment was given in mm


_Class = TypeVar("_Class")
_SHORTEST = 1e-6  # m
_GRAVITY = (0.0, 0.0, -9.81)  # m/s^2
# of any other number, in its unit: beyond it products of a few numbers leave what a float can hold
_MOST = 1e9
_MM = "Was it given in mm?"
_SIZE = Bound(least=_SHORTEST, most=_LONGEST, unit="m", hint=_MM)
_ANGLE = Bound(least=-6.2832, most=6.2832, unit="rad", hint="Was it given in degrees?")
_ANY = Bound(least=-_MOST, most=_MOST)
_PLACE = Bound(least=-_MOST, most=_MOST, unit="m")
_STIFF = Bound(least=1e-20, most=1e15, unit="N m^2")
_CURVATURE = Bound(least=-_MOST, most=_MOST, unit="1/m")
_INERTIA = Bound(least=0.0, most=_MOST, unit="kg m^2")
_RADIUS = Bound(least=0.0, most=_LONGEST, unit="m", hint=_MM)


def _per_segment(value: float | tuple[float, ...], n_crossed: int, where: str) -> tuple[float, ...]:
    if not isinstance(value, tuple):
        return (float(value),) * n_crossed
    if len(value) != n_crossed:
        raise RobotError(
            f"{where} has {len(value)} values; give one, or {n_crossed}: one for each segment that the "
            "tendon crosses, base first."
        )
    return value


def _mean_power(ends: tuple[float, ...], power: int) -> float:
    """Mean of radius^power along a cone between the radii `ends`."""
    a, b = ends[0], ends[-1]
    if math.isclose(a, b, rel_tol=1e-6):
        return float((0.5 * (a + b)) ** power)
    return float((b ** (power + 1) - a ** (power + 1)) / ((power + 1) * (b - a)))


@named_fields(RobotError)
@dataclass(frozen=True, kw_only=True)
class Tendon:
    """A tendon along the backbone, fixed at the end of its segment (the paper's pull wire).

    A tendon of a distal segment crosses the proximal ones; `offset` and `angle` are then one number for all
    segments or a tuple with one for each segment crossed, base first.

    >>> Tendon(offset=0.01, angle=0.0).position(1)
    ((0.01, 0.0),)
    """

    offset: float | tuple[float, ...]
    """Distance from the backbone [m]."""
    angle: float | tuple[float, ...]
    """Position around it, from d1 toward d2 [rad]."""
    compliance: Annotated[float, Bound(least=0.0, most=_MOST, unit="m/N")] = 1e-5
    """Stretch per tension, l(l) = L + compliance (T - pretension) [m/N]. Below 1e-9 counts as 1e-9: three or
    more tendons that do not stretch at all lock the twist with tensions beyond bound."""
    pretension: Annotated[float, Bound(least=-_MOST, most=_MOST, unit="N")] = 0.0
    """Tension at which the tendon has its commanded length [N]."""
    unilateral: bool = False
    """True: a cable that goes slack at T = 0; False: a push-pull rod that carries T < 0 too."""

    def __post_init__(self) -> None:
        for name in ("offset", "angle"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))
        for name, value, bound in (("offset", self.offset, _SIZE), ("angle", self.angle, _ANGLE)):
            for one in value if isinstance(value, tuple) else (value,):
                check_number(f"Tendon.{name}", one, bound, error=RobotError)
        check(self, error=RobotError)
        if self.unilateral and self.pretension < 0.0:
            raise RobotError(
                f"Tendon.pretension is {self.pretension!r} N; of one that can go slack it must be zero or "
                "positive."
            )

    def position(self, n_crossed: int) -> tuple[tuple[float, float], ...]:
        """Position d_i in the material frame [m] in each of the `n_crossed` segments, base first."""
        offset = _per_segment(self.offset, n_crossed, "Tendon.offset")
        angle = _per_segment(self.angle, n_crossed, "Tendon.angle")
        return tuple((d * math.cos(b), d * math.sin(b)) for d, b in zip(offset, angle, strict=True))


@named_fields(RobotError)
@dataclass(frozen=True, kw_only=True)
class Lump:
    """A rigid mass on the backbone: a disk, a marker, a payload."""

    at: Annotated[float, Bound(least=0.0, most=_LONGEST, unit="m")]
    """Arclength in its segment, without extension [m]."""
    mass: Annotated[float, Bound(least=0.0, most=_MOST, unit="kg")]
    """[kg]"""
    inertia: Annotated[tuple[float, float, float], _INERTIA] = (0.0, 0.0, 0.0)
    """Moments of inertia about d1, d2, d3 through its centre, on the backbone [kg m^2]."""

    def __post_init__(self) -> None:
        check(self, error=RobotError)
        a, b, c = sorted(self.inertia)
        if c > (a + b) * (1.0 + 1e-9):
            raise RobotError(
                f"Lump.inertia is {list(self.inertia)!r} kg m^2; no body has it: none may be larger than the "
                "other two together."
            )


@named_fields(RobotError)
@dataclass(frozen=True, kw_only=True)
class Segment:
    """A length of backbone with one stiffness, and the tendons that end at its end."""

    length: Annotated[float, _SIZE]
    """Backbone length without extension [m]."""
    bending_stiffness: Annotated[tuple[float, float], _STIFF]
    """EI about d1 and about d2 [N m^2]."""
    torsional_stiffness: Annotated[float, _STIFF]
    """GJ [N m^2]."""
    extension: Annotated[tuple[float, float], Bound(least=-_LONGEST, most=_LONGEST, unit="m")] = (0.0, 0.0)
    """Allowed change of length, smallest and largest [m]."""
    precurvature: Annotated[tuple[float, float, float], _CURVATURE] = (0.0, 0.0, 0.0)
    """u*, curvature without moment, material frame [1/m]."""
    body_radius: Annotated[float, _RADIUS] = 0.0
    """Radius of the body, for contact and drawing [m]; 0 stands for just beyond the outermost tendon."""
    gyration_radius: Annotated[float, _RADIUS] = 0.0
    """Radius of gyration of the cross-section about its diameters, for the inertia of its turns in motion
    [m]; 0 stands for half of `body_radius`, that of a solid round one."""
    line_density: Annotated[float, Bound(least=0.0, most=_MOST, unit="kg/m")] = 0.0
    """Mass per length [kg/m]; 0 is weightless."""
    damping_time: Annotated[float, Bound(least=0.0, most=_MOST, unit="s")] = 0.0
    """Kelvin-Voigt damping [s]: the moment is EI (kappa + damping_time dkappa/dt), likewise torsion, shear
    and stretch. Felt in motion only."""
    axial_stiffness: Annotated[float, Bound(above=0.0, unit="N", infinite=True)] = math.inf
    """EA [N]; inf: the backbone does not stretch."""
    shear_stiffness: Annotated[float, Bound(above=0.0, unit="N", infinite=True)] = math.inf
    """GA times the shear coefficient [N]; inf: cross-sections stay normal to the backbone."""
    lumps: tuple[Lump, ...] = ()
    mode: Mode = "tendon_length"
    tendons: tuple[Tendon, ...] = ()

    @classmethod
    def from_material(
        cls,
        *,
        length: float,
        radius: float | tuple[float, float],
        youngs_modulus: float,
        density: float = 0.0,
        poisson: float = 0.3,
        **more: Any,
    ) -> Segment:
        """Round segment of one material: stiffness, mass and body from its radius [m], Young's modulus [Pa],
        density [kg/m^3] and Poisson's ratio.

        Two radii are those of the ends of a short piece that tapers: the segment is as soft and as heavy as
        that on the average. It stretches and shears (shear coefficient of a circle by Cowper 1966); `more`
        are other fields, such as tendons. Raises `RobotError` for numbers that no material has.

        >>> Segment.from_material(length=0.1, radius=1e-3, youngs_modulus=60e9, mode="passive").line_density
        0.0
        """
        ends = tuple(radius) if isinstance(radius, (tuple, list)) else (radius,)
        for name, value, bound in (
            *(("radius", r, _SIZE) for r in ends),
            ("youngs_modulus", youngs_modulus, Bound(least=1.0, most=1e15, unit="Pa")),
            ("density", density, Bound(least=0.0, most=_MOST, unit="kg/m^3")),
            ("poisson", poisson, Bound(above=-1.0, most=0.5)),
        ):
            check_number(name, value, bound, error=RobotError)
        # forces and moments are the same along a short piece: what is averaged is how it gives to them
        area, second_moment = math.pi / _mean_power(ends, -2), 0.25 * math.pi / _mean_power(ends, -4)
        shear_modulus = 0.5 * youngs_modulus / (1.0 + poisson)
        given: dict[str, Any] = {
            "length": length,
            "bending_stiffness": (youngs_modulus * second_moment,) * 2,
            "torsional_stiffness": 2.0 * shear_modulus * second_moment,
            "axial_stiffness": youngs_modulus * area,
            "shear_stiffness": shear_modulus * area * 6.0 * (1.0 + poisson) / (7.0 + 6.0 * poisson),
            "line_density": density * math.pi * _mean_power(ends, 2),
            "body_radius": max(
                [sum(ends) / len(ends), *(float(np.max(t.offset)) for t in more.get("tendons", ()))]
            ),
        }
        return cls(**(given | more))

    def __post_init__(self) -> None:
        check(self, error=RobotError)
        low, high = self.extension
        if not -self.length < low <= 0.0 <= high:
            raise RobotError(
                f"Segment.extension is {list(self.extension)!r} m; "
                f"give [smallest, largest] change of the {self.length:g} m length, around 0."
            )
        if not isinstance(self.lumps, (tuple, list)) or not all(isinstance(a, Lump) for a in self.lumps):
            raise RobotError(
                f"Segment.lumps is {self.lumps!r}; give a tuple of Lump(at=..., mass=...), in m and kg."
            )
        for lump in self.lumps:
            if lump.at > self.length * (1.0 + 1e-9):
                raise RobotError(
                    f"Lump.at is {lump.at:g} m, beyond the {self.length:g} m of its segment; give its "
                    "arclength in the segment."
                )
        if self.mode == "passive" and self.tendons:
            raise RobotError(f"A passive segment has no tendons; it was given {len(self.tendons)}.")
        if self.mode != "passive" and not self.tendons:
            raise RobotError(f"A segment in mode {self.mode!r} needs tendons; give some, or mode 'passive'.")


@named_fields(RobotError)
@dataclass(frozen=True, kw_only=True)
class Robot:
    """A chain of segments on a base, and the world it stands in.

    >>> tendon = Tendon(offset=0.0075, angle=0.0)
    >>> rod = Segment(length=0.07, bending_stiffness=(0.0022,) * 2, torsional_stiffness=1e-3,
    ...               tendons=(tendon,))
    >>> Robot(name="one", segments=(rod,)).rest_tendon_length
    array([0.07])
    """

    name: str
    segments: tuple[Segment, ...]
    base_position: Annotated[tuple[float, float, float], _PLACE] = (0.0, 0.0, 0.0)
    """World frame [m]."""
    base_quaternion: Annotated[tuple[float, float, float, float], _ANY] = (1.0, 0.0, 0.0, 0.0)
    """world_from_base, w x y z; d3 of the base is the rod's first tangent."""
    gravity: Annotated[tuple[float, float, float], Bound(least=-_MOST, most=_MOST, unit="m/s^2")] = _GRAVITY
    """World frame [m/s^2], of a robot that stands free. One that is mounted on a host feels the host's."""
    states_gravity: bool = False
    """The robot says itself which gravity it feels: a robot file with `[world] gravity`, or any other than
    the usual. A host in whose world it is another refuses it."""
    log_points: tuple[float, ...] = ()
    """Arclengths of the further measured points p1 ... pk of a run log [m]."""
    log_offsets: tuple[tuple[float, float], ...] = ()
    """Offsets of these markers from the backbone, along d1 and d2 of the cross-section there [m]; left
    out: on it."""
    log: LogFormat = field(default_factory=LogFormat)
    """Columns, units and signs of this robot's own log files (contracts: `[log]`)."""
    effects: tuple[Mapping[str, Any], ...] = ()
    """Effects that a robot file adds to the rod (contracts: `[[effect]]`): a name, and the effect's
    parameters."""
    fit: Mapping[str, Mapping[str, float | bool]] = field(default_factory=dict)
    """Parameters that are not known exactly, each with its prior (contracts: `[fit]`)."""
    sensor: Mapping[str, float | tuple[float, ...]] = field(default_factory=dict)
    """Priors of the measurement (contracts: `[sensor]`)."""

    def __post_init__(self) -> None:
        if isinstance(self.segments, list):
            object.__setattr__(self, "segments", tuple(self.segments))
        if not isinstance(self.segments, tuple) or not all(isinstance(s, Segment) for s in self.segments):
            raise RobotError(f"Robot.segments is {shown(self.segments)}; give a tuple of Segment(...).")
        if not self.segments:
            raise RobotError(f"Robot {self.name!r} has no segments; give at least one.")
        check(self, error=RobotError)
        if abs(math.hypot(*self.base_quaternion) - 1.0) > 1e-6:
            norm = math.hypot(*self.base_quaternion)
            raise RobotError(
                f"Robot.base_quaternion {list(self.base_quaternion)!r} has norm {norm:.6g}; it must be 1."
            )
        if tuple(self.gravity) != _GRAVITY:
            object.__setattr__(self, "states_gravity", True)
        self._check_sensor()
        paper = [segment.mode == "paper" for segment in self.segments]
        if any(paper) and not all(paper):
            raise RobotError(
                f"Robot {self.name!r} mixes mode 'paper' with other modes; the paper's reduced model drops "
                "the tendons "
                "from the balance, so it holds for a whole robot or not at all."
            )
        for k, segment in enumerate(self.segments):
            for tendon in segment.tendons:
                for crossed, (x, y) in zip(self.segments, tendon.position(k + 1), strict=False):
                    if math.hypot(x, y) > crossed.length:
                        raise RobotError(
                            f"Tendon offset {math.hypot(x, y):.6g} m of segment {k + 1} is larger than the "
                            f"length {crossed.length:g} m "
                            "of a segment that it crosses. Was it given in mm?"
                        )
                    if crossed.body_radius and math.hypot(x, y) > crossed.body_radius:
                        raise RobotError(
                            f"Tendon offset {math.hypot(x, y):.6g} m of segment {k + 1} lies beyond the "
                            "body radius "
                            f"{crossed.body_radius:g} m; it must run inside the body."
                        )
        total = sum(segment.length for segment in self.segments)
        if any(not 0.0 <= s <= total for s in self.log_points):
            raise RobotError(
                f"[log] points is {list(self.log_points)!r}; each must be an arclength between "
                f"0 and {total:g} m."
            )
        if self.log_offsets and len(self.log_offsets) != len(self.log_points):
            raise RobotError(
                f"[log] point_offsets lists {len(self.log_offsets)} pairs and points {len(self.log_points)} "
                "arclengths; give each point one pair [m]."
            )
        for pair in self.log_offsets:
            check_number("[log] point_offsets", pair, _PLACE, count=2, error=RobotError)

    def _check_sensor(self) -> None:
        for key, value in self.sensor.items():
            most = {"registration_sd": 2, "noise": 3}.get(key, 1)
            numbers = value if isinstance(value, (list, tuple)) else (value,)
            if not 1 <= len(numbers) <= most or (
                key == "registration_sd" and isinstance(value, (list, tuple)) and len(value) != 2
            ):
                raise RobotError(
                    f"[sensor] {key} has {len(numbers)} numbers; give "
                    f"one{', or two: m and rad' if most == 2 else ''}."
                )
            if most == 1 and isinstance(value, (list, tuple)):
                raise RobotError(f"[sensor] {key} is {list(value)!r}; give one number.")
            if not all(0.0 <= number <= _MOST for number in numbers):
                raise RobotError(f"[sensor] {key} is {value!r}; it must be zero or positive, and finite.")

    @property
    def n_segments(self) -> int:
        """Length of every (n_segments,) axis, base first."""
        return len(self.segments)

    @property
    def tendons(self) -> tuple[Tendon, ...]:
        """All tendons, segment after segment: the order of every (n_tendons,) axis."""
        return tuple(tendon for segment in self.segments for tendon in segment.tendons)

    @property
    def n_tendons(self) -> int:
        """Length of every (n_tendons,) axis: those of all segments."""
        return len(self.tendons)

    @property
    def tendon_segment(self) -> NDArray[np.int64]:
        """(n_tendons,) index of the segment at whose end the tendon is fixed."""
        return np.array(
            [k for k, segment in enumerate(self.segments) for _ in segment.tendons], dtype=np.int64
        )

    @property
    def by_tension(self) -> bool:
        """Whether all tendons are driven by force, those of segments in mode `tendon_tension`."""
        return self.n_tendons > 0 and all(s.mode == "tendon_tension" for s in self.segments if s.tendons)

    @property
    def length(self) -> float:
        """Backbone length of the whole chain without extension [m]."""
        return sum(segment.length for segment in self.segments)

    @property
    def rest_tendon_length(self) -> NDArray[np.float64]:
        """(n_tendons,) length of each tendon of the straight rest robot, base to where it ends [m]."""
        ends = np.cumsum([segment.length for segment in self.segments])
        return np.asarray(ends[self.tendon_segment], dtype=np.float64)
