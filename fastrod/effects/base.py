"""Definition of an effect: a physical law that the rod lacks, applied at a seam of the model; and the
registry of effects.

An effect is a frozen class with `seam`, `parameters`, `memory` and `apply`, and a docstring that gives its
*Equation*,
*Source* and *Residual signature*. `@effect` checks that and registers it under the snake_case of its name:
the library's own in `fastrod.effects`, and a user's from the user's package, which then works wherever the
library's do.
"""

from __future__ import annotations

import math
import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from sys import float_info
from typing import Any, ClassVar, Literal, Protocol, TypeVar, get_args, runtime_checkable

import numpy as np

from fastrod.effects.ports import EffectPorts
from fastrod.errors import EffectError, UnknownNameError, nearest, shown
from fastrod.kernels.operators import yielding
from fastrod.model.routing import Routing
from fastrod.types import Floats

Per = Literal["robot", "segment", "drive"]
Of = Literal["", "offset", "length", "1/offset", "1/offset^2"]


class Seam(Enum):
    """Seam at which an effect enters, from motor to camera; effects act in this order."""

    ACTUATION = 1
    """Between the commanded tendons and those that the rod feels: `tendon_length`, `extension`, `offset`,
    `compliance`."""
    MATERIAL = 2
    """The rod itself: `stiffness`, `precurvature`."""
    LOAD = 3
    """Loads: `tip_force`, `tip_moment`, `line_force`."""
    SENSING = 4
    """Between the true tip and the measured one: `tip_position`, `tip_rotation`, `points`."""


class Signal(Enum):
    """Quantity against which an effect's residual is drawn in a report."""

    TIME = "time since the start of the run"
    MOTION = "speed of the tip"
    GRAVITY = "direction of gravity against the robot"
    FORCE = "direction of the effect's own force, its parameters x, y, z, against the robot"
    TIP = "place of the tip"
    LAG = "the bend less its mean over the effect's `time_constant`"
    LOOP = "commanded bend, as loops"
    BEND = "commanded bend"


@dataclass(frozen=True)
class Parameter:
    """One number of an effect, or one per segment or per drive.

    >>> Parameter("half_width", "m", bounds=(0.0, 2e-3), typical=2e-4).neutral
    0.0
    """

    name: str
    unit: str
    neutral: float = 0.0
    """Value at which the effect changes nothing, whatever the effect's other parameters are, or beside
    them."""
    bounds: tuple[float, float] = (-math.inf, math.inf)
    """Beyond them the value is not physical."""
    typical: float | None = None
    """Size seen on real robots; scale of the prior and of finite differences. A tenth of the bounds where not
    given."""
    starts: tuple[float, ...] = ()
    """Values that a fit starts from; `typical` where not given."""
    per: Per = "robot"
    """One value for the robot, for each segment, or for each drive (a tendon, or an antagonistic pair of
    tendons)."""
    of: Of = ""
    """Bounds, typical size and starts are multiples of this: the tendons' mean distance from the backbone,
    one over it or over its square, or the robot's length."""
    shape: bool = False
    """True: it shapes an effect whose size another parameter gives (a time constant, a width); no size of its
    own."""
    shared: bool = False
    """Whether a parameter that exists once per drive is fitted as one number. True: drives are alike
    unless one is worn, so a fit has one number for all, or one drive alone."""
    apart: bool = False
    """Whether a parameter that exists once per segment is fitted as one number each. True: segments
    differ, so a fit has a number for each."""

    def __post_init__(self) -> None:
        low, high = self.bounds
        if not low <= self.neutral <= high:
            raise EffectError(
                f"parameter {self.name!r} has neutral value {self.neutral}; it must lie in "
                f"its bounds {low} to {high}."
            )
        given: str = self.of  # a law of somebody's package may say anything
        if given not in get_args(Of):
            raise EffectError(
                f"parameter {self.name!r} is of {given!r}; it must be 'offset', 'length', '1/offset', "
                "'1/offset^2' or ''."
            )
        if self.typical is None:
            span = 0.1 * (high - low)
            object.__setattr__(self, "typical", span if math.isfinite(span) and span > 0.0 else 1.0)
        if not self.starts:
            assert self.typical is not None
            object.__setattr__(
                self, "starts", (self.neutral + self.typical,) if not self.shape else (self.typical,)
            )

    def on(self, routing: Routing) -> Parameter:
        """This parameter in its unit, for one robot."""
        if not self.of:
            return self
        size = (
            float(routing.length.sum())
            if self.of == "length" or not routing.n_tendons
            else float(routing.tendon_offset.mean())
        ) ** {"1/offset": -1, "1/offset^2": -2}.get(self.of, 1)
        assert self.typical is not None
        return Parameter(
            self.name,
            self.unit,
            self.neutral * size,
            (self.bounds[0] * size, self.bounds[1] * size),
            self.typical * size,
            tuple(start * size for start in self.starts),
            self.per,
            "",
            self.shape,
            self.shared,
            self.apart,
        )

    @property
    def scale(self) -> float:
        """`typical` as a float: the size that counts as one."""
        assert self.typical is not None
        return abs(self.typical)


@runtime_checkable
class Effect(Protocol):
    """Interface that `@effect` requires of a class. Optional: the attributes of `Law`, and `sweep` (see
    `Operator`)."""

    seam: ClassVar[Seam]
    parameters: ClassVar[tuple[Parameter, ...]]

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        """Hidden state at the start, (n_robots, anything); of size 0 for an effect without memory, nan for
        one that begins at the first input."""
        ...

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        """Change `ports` (and `memory`) in place. `values` (n_robots, n_columns): the parameters in order,
        each as many columns as `per` says. `state` is the simulator's last `State`, or None; `dt` the time
        since then [s]."""
        ...


class Law:
    """Description of an effect for identification and its report; each attribute may be left out."""

    order: ClassVar[float] = 50.0
    """Place among the effects of the same seam, from the motor to the camera."""
    synonyms: ClassVar[tuple[str, ...]] = ()
    """Other names of it."""
    excited_by: ClassVar[str] = ""
    """Motion that shows it."""
    confounded_with: ClassVar[tuple[str, ...]] = ()
    """Effects that look alike in many logs."""
    separated_by: ClassVar[Mapping[str, str]] = {}
    """The run that separates it from another effect, by the other's name; either of two may say it."""
    signal: ClassVar[Signal | None] = None
    """Quantity against which its residual is drawn; None: what its seam suggests."""
    least_segments: ClassVar[int] = 1
    """A robot with fewer segments cannot show it."""
    frequent: ClassVar[bool] = False
    """Met on many robots: where nothing was found, its bound comes first."""
    last_resort: ClassVar[bool] = False
    """A form without a cause, wide enough to stand in for others: tried where no other effect is found."""
    feels_tip: ClassVar[bool] = False
    """Its tip force depends on where the tip is, `ports.tip_position`. A step of a simulator goes by the last
    state and the compliance of the rod there; `settle` and a log solve force and rod together."""
    by_pattern: ClassVar[bool] = False
    """A search tries it where the alternative pattern of its name fits: a scan finds where its fit begins."""
    reads_tension: ClassVar[bool] = False
    """It reads `ports.solved_tension`. In a step of a simulator that is of the last state; `settle` and a log
    solve it together with the rod."""
    on_forces: ClassVar[bool] = False
    """Whether an ACTUATION effect acts on the tendons' forces where these are the commands, as it does on
    lengths. Any other leaves such a robot's commands as they are."""
    reads_bend: ClassVar[bool] = False
    """It reads `ports.solved_bend`, what the rod makes of its tendons: with it the bend, not the command, has
    a memory. When it is of which state, as with `reads_tension`."""
    nests: ClassVar[Mapping[str, Mapping[str, str | float]]] = {}
    """Laws that this one contains, by name, and where: what each of these parameters is there, a number or
    another parameter. Which of the two it is is decided by where the estimate lies, for the richer one never
    fits worse."""
    refines: ClassVar[str] = ""
    """Another effect of the same cause: tried wherever that one is, and named only where the log tells the
    two laws apart."""


def trait(what: Effect, name: str) -> Any:
    """An optional attribute of an effect, one of `Law`."""
    return getattr(what, name, getattr(Law, name))


def signal_of(what: Effect) -> Signal:
    """Return what an effect's residual is drawn against."""
    given: Signal | None = trait(what, "signal")
    if given is not None:
        return given
    if what.seam in (Seam.LOAD, Seam.SENSING):
        return Signal.GRAVITY if what.seam is Seam.LOAD else Signal.TIP
    return Signal.LOOP if has_memory(what) else Signal.BEND


class Static(Law):
    """Base of the library's effects without memory."""

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        """None."""
        return np.empty((n_robots, 0))


class Operator(Law, ABC):
    """Base of the library's effects with a memory: operators on the tendons' lengths over time.

    `sweep` is the law, over many steps at once: a simulator calls it with one step, identification with a
    whole log.
    """

    @abstractmethod
    def sweep(self, values: Floats, memory: Floats, dl: Floats, dt: Floats, routing: Routing) -> Floats:
        """(n_robots, n_steps, n_tendons) what the tendons end up at, from `dl` commanded [m] and `dt`
        (n_steps,) before each step [s].

        `memory` (n_robots, m) is changed in place; nan in it means that the tendons begin at rest at the
        first step."""
        ...

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        """One step of `sweep`."""
        dl = ports.dl
        swept = self.sweep(values, memory, dl[:, None], np.array([dt]), ports.routing)[:, 0] - dl
        ports.shift_tendons(self.change(values, swept, ports))

    def change(self, values: Floats, swept: Floats, ports: EffectPorts) -> Floats:
        """(n, n_tendons) by how much lengths change [m], from what `sweep` has changed: the same, unless it
        takes what the ports have besides lengths."""
        return swept


class BodyOperator(Law):
    """Base of effects with a memory of how the body was bent: elements of dry friction in parallel, in each
    segment and in its plane, that hold back what the solved bend has dragged along.

    The parameters are a size for each segment and a width [rad]; with several `elements` a spread, by which
    their widths lie apart (in the logarithm). A simulator calls `sweep` with one step, identification with a
    whole log.
    """

    seam = Seam.MATERIAL
    reads_bend = True
    elements: ClassVar[int] = 1

    def memory(self, n_robots: int, n_bends: int) -> Floats:
        """Return where each element has been dragged to [rad]; nan: it is at rest at the first bend."""
        return np.full((n_robots, self.elements * n_bends), np.nan)

    def sweep(self, values: Floats, memory: Floats, bend: Floats) -> Floats:
        """(n_robots, n_steps, n_segments, 2) the bend that stays back [rad], from that which the rod has,
        `bend` of the same shape; `memory` is changed in place."""
        size, width, spread = self._split(values, bend.shape[2])
        places, back = memory.reshape(len(bend), self.elements, -1), np.zeros_like(bend)
        at_rest, all_of_it = bend[:, 0].reshape(len(bend), -1), -np.ones(size.shape)
        for j, at in enumerate(np.linspace(-1.0, 1.0, self.elements) if self.elements > 1 else [0.0]):
            own = width * np.exp(at * spread)
            place = np.where(np.isnan(places[:, j]), at_rest, places[:, j])
            off = bend.copy()  # from what is dragged along
            yielding(off, place, all_of_it, own * np.ones(size.shape))
            places[:, j] = place
            back += off / own[:, None, :, None]
        return np.asarray(-size[:, None, :, None] * back / self.elements)

    def stiffening(self, values: Floats, n_segments: int) -> Floats:
        """(n_robots,) times the body's own stiffness by which it is stiffer where nothing slides."""
        size, width, spread = self._split(values, n_segments)
        return np.asarray((size * np.exp(spread) / width).max(1))

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        """One step of `sweep`."""
        ports.rest_bend += self.sweep(values, memory, ports.solved_bend[:, None])[:, 0]

    def _split(self, values: Floats, n_segments: int) -> tuple[Floats, Floats, Floats]:
        """Sizes (n_robots, n_segments), width and spread (n_robots, 1)."""
        size, width, spread = np.split(values, [n_segments, n_segments + 1], axis=1)
        return size, width, spread if self.elements > 1 else np.zeros_like(width)


_REGISTRY: dict[str, Effect] = {}
_SYNONYMS: dict[str, str] = {}
_RENAMED = dict.fromkeys(
    ("dynamics", "inertia", "oscillation"),
    "is called 'second_order_lag', for it filters the tendons and has no mass; a rod with inertia is "
    "Simulator(dynamics=True).",
)
_SECTIONS = ("Equation", "Source", "Residual signature")
_Class = TypeVar("_Class", bound=type)


def effect(cls: _Class) -> _Class:
    """Register an effect class under its name in snake_case; the class itself is handed back.

    Raises `EffectError` where a part is missing or the name is taken by another class.
    """
    name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()
    for section in _SECTIONS:
        if f"{section}:" not in (cls.__doc__ or ""):
            raise EffectError(
                f"effect {name!r} does not say its {section}; its docstring needs a line '{section}: ...'."
            )
    for member in ("seam", "parameters", "memory", "apply"):
        if not hasattr(cls, member):
            raise EffectError(
                f"effect {name!r} has no {member}; an effect has seam, parameters, memory(...) and "
                "apply(...)."
            )
    made: Any = cls()
    if not isinstance(made.seam, Seam):
        raise EffectError(f"effect {name!r} has seam {made.seam!r}; give one of {', '.join(map(str, Seam))}.")
    if not made.parameters or not all(isinstance(p, Parameter) for p in made.parameters):
        raise EffectError(
            f"effect {name!r} has parameters {made.parameters!r}; give a tuple of Parameter, at least one."
        )
    synonyms = tuple(trait(made, "synonyms"))
    for word in (name, *synonyms):
        taken = _REGISTRY.get(_SYNONYMS.get(word, word))
        if (
            taken is not None
            and type(taken).__qualname__ + type(taken).__module__ != cls.__qualname__ + cls.__module__
        ):
            raise EffectError(f"an effect named {word!r} is already registered by {type(taken).__module__}.")
    _REGISTRY[name] = made
    _SYNONYMS.update(dict.fromkeys(synonyms, name))
    return cls


def unregister(name: str) -> None:
    """Take an effect out of the registry, for a library without it."""
    name = canonical_name(name)
    del _REGISTRY[name]
    for synonym in [synonym for synonym, meant in _SYNONYMS.items() if meant == name]:
        del _SYNONYMS[synonym]


def effect_names() -> list[str]:
    """Names of all registered effects, from the motor to the camera."""
    load_library()
    return sorted(
        _REGISTRY, key=lambda name: (_REGISTRY[name].seam.value, trait(_REGISTRY[name], "order"), name)
    )


def canonical_name(name: str) -> str:
    """The one name of an effect that goes by several. Raises `UnknownNameError` with the nearest."""
    load_library()
    name = _SYNONYMS.get(name, str(name))
    if name not in _REGISTRY:
        if name in _RENAMED:
            raise UnknownNameError(f"the effect {name!r} {_RENAMED[name]}")
        raise UnknownNameError(f"no effect {name!r}; {nearest(name, [*_REGISTRY, *_SYNONYMS])}")
    return name


def get_effect(name: str) -> Effect:
    """The registered effect of this name or synonym. Raises `UnknownNameError` with the nearest."""
    return _REGISTRY[canonical_name(name)]


def has_memory(what: Effect) -> bool:
    """Whether an effect carries a hidden state."""
    return what.memory(1, 1).size > 0


@cache
def load_library() -> None:
    """Register the library, and the modules that installed packages name as entry points of the group
    `fastrod.effects`."""
    import_module("fastrod.effects.laws")
    for plug_in in entry_points(group="fastrod.effects"):
        plug_in.load()


def columns(what: Effect, routing: Routing) -> list[str]:
    """Names of the value columns of an effect on this robot: half_width, or half_width_1, half_width_2 ..."""
    names = []
    for parameter in what.parameters:
        count = routing.count(parameter.per)
        names += [parameter.name] if count == 1 else [f"{parameter.name}_{k}" for k in range(1, count + 1)]
    return names


def read_values(name: str, given: Mapping[str, object], routing: Routing, where: str) -> Floats:
    """(n_columns,) values of an effect from its table in a robot file; a parameter that is not given is
    neutral.

    A number stands for all segments or drives, a list for each; a `shared` parameter of drives takes a list
    for each segment too, where drives and segments are not as many. Raises `EffectError` for what cannot be.
    """
    what = get_effect(name)
    known = [p.name for p in what.parameters]
    for key in given:
        if key not in known and key != "name":
            raise EffectError(
                f"{where}: effect {name!r} has no parameter {key!r}; {nearest(str(key), known)}"
            )
    values: list[float] = []
    for parameter in (p.on(routing) for p in what.parameters):
        value = given.get(parameter.name, parameter.neutral)
        count = routing.count(parameter.per)
        listed: Sequence[object] = value if isinstance(value, (list, tuple)) else (value,) * count
        if parameter.shared and len(listed) == routing.n_segments != count:
            ends = dict(zip(routing.drive.tolist(), routing.tendon_segment.tolist(), strict=True))
            listed = [listed[ends[drive]] for drive in range(count)]
        if len(listed) != count:
            raise EffectError(
                f"{where}: {parameter.name} of effect {name!r} has {len(listed)} values; give one, or "
                f"{count}, one per {parameter.per}."
            )
        for number in listed:
            low, high = parameter.bounds
            if (
                isinstance(number, bool)
                or not isinstance(number, (int, float))
                or not (low <= number <= high and abs(number) <= float_info.max)
            ):
                raise EffectError(
                    f"{where}: {parameter.name} of effect {name!r} is {shown(number)} {parameter.unit}; "
                    f"it must be a number from {low:g} to {high:g}."
                )
            values.append(float(number))
    return np.array(values)
