"""Some robots of a batch put back, or made anew, while the others go on: arrays of now and then, merged row
by row."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from fastrod.contact.engine import ContactSnapshot, Engine
from fastrod.solver.state import State
from fastrod.types import Flags, RodShape

Arrays = TypeVar("Arrays", bound=tuple[Any, ...])


def taken(now: Any, then: Any, rows: Flags) -> Any:
    """`now`, with `rows` (n_robots,) as in `then`; either may have a robot axis of 1 for all. A new array, or
    `now` where nothing changes; what `now` has no robots for stays."""
    if len(now) == 0 or len(then) == 0 or now.shape[1:] != then.shape[1:]:
        return now
    if len(now) == 1 and len(then) == 1 and np.array_equal(now, then, equal_nan=now.dtype.kind == "f"):
        return now
    # kernels are compiled anew for any other order
    merged = np.array(np.broadcast_to(now, (len(rows), *now.shape[1:])), order="C")
    merged[rows] = np.broadcast_to(then, merged.shape)[rows]
    return merged


def taken_each(now: Arrays, then: Arrays, rows: Flags) -> Arrays:
    """`taken` for every array of a NamedTuple."""
    return type(now)(*(taken(a, b, rows) for a, b in zip(now, then, strict=True)))


def taken_shape(now: RodShape, then: State, rows: Flags) -> RodShape:
    """A shape with the rows of a state."""
    return RodShape(*(taken(a, getattr(then, name), rows) for name, a in now._asdict().items()))


def restore_contact(engine: Engine, then: ContactSnapshot, rows: Flags) -> None:
    """Put the robots `rows` of an engine back: their contacts, where they were, and the obstacles around
    them."""
    engine.contact_set = taken_each(engine.contact_set, then.contact_set, rows)
    engine.clearance = taken_each(engine.clearance, then.clearance, rows)
    if engine.before is not None and then.before is not None:
        engine.before = taken_each(engine.before, then.before, rows)
    engine.tracked = np.where(rows, then.tracked, engine.tracked)
    engine.poses = taken(engine.poses, then.poses, rows)
    engine.poses_before = taken(engine.poses_before, then.poses_before, rows)
    engine.at_last_step = (engine.before, engine.poses_before)
