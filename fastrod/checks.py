"""Bounds that the fields of a dataclass declare, and the one sentence for a value that breaks them.

>>> from dataclasses import dataclass
>>> @dataclass(frozen=True)
... class Lens:
...     angle: Annotated[float, Bound(above=0.0, below=180.0, unit="deg")] = 45.0
...     def __post_init__(self) -> None:
...         check(self)
>>> Lens(angle=200)
Traceback (most recent call last):
fastrod.errors.InputError: Lens.angle is 200 deg; it must be a number between 0 and 180 deg.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from math import inf
from sys import float_info
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, get_args, get_origin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.errors import FastrodError, InputError, nearest, refuse_masked, shown

_Class = TypeVar("_Class")
_Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Bound:
    """Range of a number: from `least` to `most`, or `above` and `below` what is out of it."""

    least: float = -inf
    most: float = inf
    above: float = -inf
    below: float = inf
    unit: str = ""
    infinite: bool = False
    """Whether it may be infinite."""
    hint: str = ""
    """Question to whoever gives more than `most`, such as whether it was in mm."""

    def holds(self, value: float) -> bool:
        """Whether a number is within it."""
        within = self.least <= value <= self.most and self.above < value
        return within and (self.infinite or (value < self.below and abs(value) <= float_info.max))

    def right(self, kind: str) -> str:
        """Return what would be right: "a number from 0 to 1", say."""
        low, high = max(self.least, self.above), min(self.most, self.below)
        if low > -inf and high < inf:
            joined = ("between", "and") if self.above > -inf or self.below < inf else ("from", "to")
            unit = f" {self.unit}" if self.unit else ""
            return f"{kind} {joined[0]} {_figure(low)} {joined[1]} {_figure(high)}{unit}"
        if low > -inf:
            zero = "positive" if self.above == 0.0 else "zero or positive"
            ends = (
                zero
                if low == 0.0
                else f"above {_figure(low)}"
                if self.above > -inf
                else f"at least {_figure(low)}"
            )
            return f"{kind}, {ends}{'' if kind.startswith('a whole') or self.infinite else ' and finite'}"
        return f"{kind}, finite" if high == inf else f"{kind}, at most {_figure(high)}"


def _figure(x: float) -> str:
    return str(x) if isinstance(x, int) else f"{x:g}"


POSITIVE = Bound(above=0.0)
NOT_NEGATIVE = Bound(least=0.0)
COUNT = Bound(least=1, infinite=True)  # however large: what is too many is said where it is known


_KINDS: dict[type, Any] = {int: (int, np.integer), float: (int, float, np.integer, np.floating)}


class Declared(NamedTuple):
    """Values that a field may have."""

    kind: type | None
    """float, int or bool; None: one of `choices`."""
    choices: tuple[Any, ...] = ()
    bound: Bound = Bound()
    optional: bool = False
    numbers: int = 0
    """Numbers of a tuple or a list; 0: one number, by itself."""

    def holds(self, value: Any) -> bool:
        """Whether a value is one of these."""
        kind, choices, bound, optional, count = self
        if type(value) is float and kind is float:
            return not count and bound.holds(value)
        if value is None and optional:
            return True
        if kind is None:
            return any(value is one or (isinstance(value, type(one)) and value == one) for one in choices)
        if kind is bool:
            return isinstance(value, (bool, np.bool_))
        if count and not (isinstance(value, (tuple, list, np.ndarray)) and len(value) == count):
            return False
        each = value if count else (value,)
        return all(
            isinstance(x, _KINDS[kind]) and type(x) is not bool and bound.holds(_plain(x)) for x in each
        )

    def sentence(self, name: str, value: Any) -> str:
        """Return what is wrong with a value that is none of these."""
        kind, choices, bound, optional, count = self
        none = ", or None" if optional else ""
        if kind is None:
            how = nearest(str(value), tuple(map(str, choices))) if isinstance(value, str) else ""
            right = how if how.startswith("did") else f"it must be {' or '.join(map(repr, choices))}{none}."
            return f"{name} is {shown(value)}; {right}"
        if kind is bool:
            return f"{name} is {shown(value)}; it must be True or False{none}."
        each: Any = value if count and isinstance(value, (tuple, list)) else (value,)
        most = min(bound.most, bound.below)
        large = any(isinstance(x, _KINDS[kind]) and not -most <= x <= most for x in each)
        hint = f" {bound.hint}" if bound.hint and large else ""
        unit = f" {bound.unit}" if bound.unit else ""
        one = "a whole number" if kind is int else "a number"
        right = bound.right(f"{count} numbers" if count else one)
        return f"{name} is {shown(value)}{unit}; it must be {right}{none}.{hint}"


def _plain(x: Any) -> Any:
    return x.item() if isinstance(x, np.generic) else x


_KNOWN: dict[type, Mapping[str, Declared]] = {}  # read once


def check(given: Any, prefix: str | None = None, error: type[FastrodError] = InputError) -> None:
    """Raise `error` for the first field of a dataclass that is not what it declares: a number of its `Bound`,
    so many of them, True or False, one of its `Literal`. `prefix` stands before the field's name in the
    sentence, by default the class and a dot."""
    before = f"{type(given).__name__}." if prefix is None else prefix
    for name, declared in declared_by(type(given)).items():
        if not declared.holds(value := getattr(given, name)):
            raise error(declared.sentence(f"{before}{name}", value))


def check_number(
    name: str,
    value: object,
    bound: Bound = POSITIVE,
    *,
    whole: bool = False,
    count: int = 0,
    error: type[FastrodError] = InputError,
) -> None:
    """Raise `error` unless this is a number within the bound, or so many of them."""
    declared = Declared(int if whole else float, (), bound, numbers=count)
    if not declared.holds(value):
        raise error(declared.sentence(name, value))


def checked_array(name: str, value: ArrayLike, shapes: Sequence[tuple[int, ...]], says: str) -> _Array:
    """A copy of an array of one of these shapes, of what it `says`, finite. Raises `InputError`."""
    refuse_masked(name, value)
    wanted = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
    try:
        found = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is not an array of numbers; give {wanted}, {says}.") from error
    if found.shape not in shapes:
        raise InputError(f"{name} has shape {found.shape}; it must be {wanted}, {says}.")
    if not np.isfinite(found).all():
        raise InputError(f"{name} holds a value that is not finite: {found.ravel()[:14].tolist()}.")
    return found


def checked_pose(name: str, value: ArrayLike, *rows: int, off: float = 1e-6) -> _Array:
    """(7,), or (n, 7) of one of these many `rows`: position [m] and quaternion w x y z, which is made unit;
    its norm is `off` 1 by no more. Raises `InputError`."""
    says = "position [m] and quaternion w x y z"
    pose = checked_array(name, value, [(7,), *((n, 7) for n in rows)], says)
    norm = np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    if (beyond := np.abs(norm - 1.0)).max() > off:
        worst = norm.ravel()[beyond.argmax()]
        raise InputError(f"{name} has a quaternion of norm {worst:.6g}; it must be 1, as w x y z.")
    return np.concatenate([pose[..., :3], pose[..., 3:] / norm], axis=-1)


def named_fields(error: type[FastrodError]) -> Callable[[type[_Class]], type[_Class]]:
    """Decorate a dataclass: a field that it lacks, or that is missing, raises `error` with the nearest
    name."""

    def named(cls: type[_Class]) -> type[_Class]:
        made, every = cls.__init__, fields(cls)  # type: ignore[arg-type]
        known = [f.name for f in every]
        needed = [f.name for f in every if f.default is MISSING and f.default_factory is MISSING]

        @functools.wraps(made)
        def checked(self: _Class, *args: Any, **given: Any) -> None:
            for name in given:
                if name not in known:
                    raise error(f"{cls.__name__} has no field {name!r}; {nearest(name, known)}")
            if missing := [name for name in needed if name not in given]:
                raise error(f"{cls.__name__} lacks {', '.join(missing)}.")
            made(self, *args, **given)

        # mypy takes no assignment to a method
        setattr(cls, "__init__", checked)  # noqa: B010
        return cls

    return named


def declared_by(cls: type) -> Mapping[str, Declared]:
    """Field -> what it declares, of those that declare anything."""
    if cls in _KNOWN:
        return _KNOWN[cls]
    found: dict[str, Declared] = {}
    for field in fields(cls):
        owner = next(one for one in cls.__mro__ if field.name in vars(one).get("__annotations__", ()))
        try:
            kind = eval(str(field.type), vars(sys.modules[owner.__module__]))
        except NameError:  # a name that only a type checker imports
            continue
        if (declared := _declared(kind)) is not None:
            found[field.name] = declared
    _KNOWN[cls] = found
    return found


def _declared(kind: Any) -> Declared | None:
    if get_origin(kind) is Annotated:
        inner, *more = get_args(kind)
        bound = next((one for one in more if isinstance(one, Bound)), None)
        if bound is not None and get_origin(inner) is tuple:
            return Declared(float, (), bound, numbers=len(get_args(inner)))
        declared = _declared(inner) or Declared(int if int in (inner, *get_args(inner)) else float)
        optional = NoneType in get_args(inner)
        return None if bound is None else declared._replace(bound=bound, optional=optional)
    if get_origin(kind) is Literal:
        return Declared(None, get_args(kind))
    if get_origin(kind) in (Union, UnionType) and all(get_origin(one) is Literal for one in get_args(kind)):
        return Declared(None, tuple(choice for one in get_args(kind) for choice in get_args(one)))
    if get_origin(kind) in (Union, UnionType) and NoneType in get_args(kind):
        others = [one for one in get_args(kind) if one is not NoneType]
        one = _declared(others[0]) if len(others) == 1 else None
        return None if one is None else one._replace(optional=True)
    return Declared(bool) if kind is bool else None
