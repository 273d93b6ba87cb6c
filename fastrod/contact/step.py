"""One step of robots that may touch something: who is free, who is led, and who begins from nothing."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fastrod.contact.engine import Engine, Pass
from fastrod.types import Flags, Floats, Ints, Memory, Ports, RodShape

COLD_PASSES = 2000


class Ways(NamedTuple):
    """How a simulator moves robots without contact."""

    free: Callable[[Ints, Ports, RodShape], Flags]
    """A step, or `settle`, of these robots; (n_robots,) which are well."""
    settle: Callable[[Ints, Ports, RodShape], Flags]
    """From the cold guess until at rest."""
    run: Pass


def contact_step(
    engine: Engine,
    ways: Ways,
    rows: Ints,
    warm: Flags,
    start: Ports | None,
    end: Ports,
    rest: Ports,
    memory: Memory,
    shape: RodShape,
    tolerance: float,
    passes: Ints,
    most: int,
) -> tuple[Flags, Floats]:
    """Bring `rows` from the inputs `start` of the last step to `end`, in `shape`; (n_robots,) who is well,
    and how far each came.

    `rest` are the inputs of the straight, unloaded robots: a cold robot that would overlap something is led
    from there, if it is clear there; else it is pushed out of where it is. Without a last step there is no
    slip, and so no friction. `most` passes are spent on a warm robot, about: a step ends.
    """
    n = len(warm)
    cold = engine.whole_worlds(np.isin(np.arange(n), rows) & ~warm)
    engine.forget(cold)
    engine.place_at_once(cold)
    ok, done = np.zeros(n, bool), np.ones(n)
    pressed = engine.pressed()
    x = memory.x.copy()
    warm_free, cold_rows = rows[~cold[rows] & ~pressed[rows]], rows[cold[rows]]
    if len(warm_free):
        ok |= ways.free(warm_free, end, shape)
        done[warm_free[~ok[warm_free]]] = 0.0
    if len(cold_rows):
        ok |= ways.settle(cold_rows, end, shape)
    touched = engine.touches(rows[ok[rows]], shape)
    led = rows[(pressed[rows] | touched[rows]) & ~cold[rows]]
    if len(led):
        memory.x[led] = x[led]
        ok[led] = False
        arrived, came = engine.follow(led, start, end, memory, shape, ways.run, tolerance, passes, most)
        ok |= arrived
        done[led] = came[led]
    new = cold_rows[touched[cold_rows] | ~ok[cold_rows]]
    if len(new):
        ok[new] = False
        done[new] = _begin(engine, ways, new, end, rest, memory, shape, tolerance, passes)[new]
        ok[new] = done[new] >= 1.0
    engine.slides[:], engine.led[:] = True, False
    engine.led[led], engine.led[new] = True, True
    engine.accept(rows[ok[rows]], shape)
    engine.end_step(done)
    return ok, done


def _begin(
    engine: Engine,
    ways: Ways,
    rows: Ints,
    end: Ports,
    rest: Ports,
    memory: Memory,
    shape: RodShape,
    tolerance: float,
    passes: Ints,
) -> Floats:
    """Cold robots that would overlap something: led from their rest shape, or pushed out; how far each
    came."""
    x = memory.x.copy()
    free_shape = RodShape(*(a.copy() for a in shape))
    straight = ways.settle(rows, rest, shape)
    clear = straight & ~engine.touches(rows[straight[rows]], shape)
    engine.slides[rows] = False
    done = np.zeros(len(clear))
    if len(able := rows[clear[rows]]):
        engine.accept(able, shape, on_the_way=True)
        done = engine.follow(able, rest, end, memory, shape, ways.run, tolerance, passes, COLD_PASSES)[1]
    if len(stuck := rows[~clear[rows]]):
        memory.x[stuck] = x[stuck]
        for now, then in zip(shape, free_shape, strict=True):
            now[stuck] = then[stuck]
        done[stuck] = engine.follow(
            stuck, None, end, memory, shape, ways.run, tolerance, passes, COLD_PASSES
        )[1][stuck]
    return done
