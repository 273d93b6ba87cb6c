"""Some robots of a batch put back, or made anew, while the others go on: arrays of now and then, merged row
by row."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from fastrod.solver.state import State
from fastrod.types import Flags, Ints, Ports, RodShape

if TYPE_CHECKING:
    from fastrod.contact.engine import ContactSnapshot, Engine

Arrays = TypeVar("Arrays", bound=tuple[Any, ...])


def merge_rows(now: Any, then: Any, rows: Flags) -> Any:
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


def merge_arrays(now: Arrays, then: Arrays, rows: Flags) -> Arrays:
    """`merge_rows` of every array of a NamedTuple."""
    return type(now)(*(merge_rows(a, b, rows) for a, b in zip(now, then, strict=True)))


def merge_shape(now: RodShape, then: State, rows: Flags) -> RodShape:
    """A shape with the rows of a state."""
    return RodShape(*(merge_rows(a, getattr(then, name), rows) for name, a in now._asdict().items()))


def restore_contact(engine: Engine, then: ContactSnapshot, rows: Flags) -> None:
    """Put the robots `rows` of an engine back: their contacts, where they were, and the obstacles around
    them."""
    engine.contact_set = merge_arrays(engine.contact_set, then.contact_set, rows)
    engine.clearance = merge_arrays(engine.clearance, then.clearance, rows)
    if engine.before is not None and then.before is not None:
        engine.before = merge_arrays(engine.before, then.before, rows)
    engine.tracked = np.where(rows, then.tracked, engine.tracked)
    engine.poses = merge_rows(engine.poses, then.poses, rows)
    engine.poses_before = merge_rows(engine.poses_before, then.poses_before, rows)
    engine.at_last_step = (engine.before, engine.poses_before)


def merge_problems(now: Mapping[int, str], then: Mapping[int, str], rows: Flags) -> dict[int, str]:
    """Sentences, with those of `rows` as in `then`."""
    return {i: said for i, said in now.items() if not rows[i]} | {
        i: said for i, said in then.items() if rows[i]
    }


def replace_rows(now: Any, new: Any, which: Ints, n_robots: int) -> Any:
    """The array of n_robots, or 1 for all, with other numbers in the rows `which`."""
    full = np.array(np.broadcast_to(now, (n_robots, *now.shape[1:])), order="C")
    full[which] = new
    return full


def replace_arrays(now: Arrays, new: Arrays, which: Ints, n_robots: int) -> Arrays:
    """`replace_rows` of every array of a NamedTuple; `new` begins with a row that is not used."""
    return type(now)(*(replace_rows(a, b[1:], which, n_robots) for a, b in zip(now, new, strict=True)))


def keep_lost(
    shape: RodShape, ports: Ports, lost: Flags, solved: Flags, before: tuple[State, Ports] | None
) -> tuple[RodShape, Ports]:
    """`lost` robots as in the state before, nan where that holds no shape of theirs (`solved`); `residual` is
    of what was tried."""
    kept = RodShape(*(np.array(a) for a in shape))
    for a in kept:
        a[lost if len(a) else slice(0)] = np.nan
    if before is not None and (have := lost & solved).any():
        kept, ports = merge_shape(kept, before[0], have), merge_arrays(ports, before[1], have)
    return kept._replace(residual=shape.residual), ports
