"""The one executor of effects, at their seams in order: of a batch of robots at one step, or of the samples
of a log.

Where rows are robots, `act` moves memories on by one step. Where they are samples in the order of time, `act`
is for effects without memory, and `sweep` carries a memory over whole runs.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np

from fastrod.effects.base import BodyOperator, Effect, Operator, Seam, get_effect, trait
from fastrod.effects.ports import EffectPorts
from fastrod.model.routing import Routing
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Flags, Floats, Ints


class SensedPoses(NamedTuple):
    """Poses of the tip as a camera on the base sees it, effects of sensing included; base frame."""

    tip_position: Floats
    """(n_robots, 3) [m]."""
    tip_rotation: Floats
    """(n_robots, 3, 3) base_from_tip."""
    points: Floats
    """(n_robots, k, 3) at the robot's `log_points` [m]; k is 0 with outputs="tip"."""


class Link(NamedTuple):
    """One effect over the rows of the ports."""

    name: str
    effect: Effect
    values: Floats
    """(n, n_columns)."""
    memory: Floats
    """(n, m)."""

    def on(self, n: int) -> Link:
        """The same effect, which has no memory and one row of values, over `n` rows."""
        return self.over(np.zeros(n, np.int64))

    def over(self, which: Ints) -> Link:
        """The same effect, which has no memory, over rows (n,) that have these of its rows of values; the one
        row, where it has no more."""
        values = self.values[which if len(self.values) > 1 else np.zeros_like(which)]
        return self._replace(values=values, memory=np.empty((len(which), 0)))

    def alone(self, k: int) -> Link:
        """The same effect with one of its rows of values and its memory."""
        own = slice(k, k + 1) if len(self.values) > 1 else slice(None)
        return self._replace(values=self.values[own], memory=self.memory[own])


def at_rest(what: Effect, n: int, routing: Routing) -> Floats:
    """(n, m) memory of an effect at the start; m is 0 without one. Of an effect that feels the tip a
    simulator keeps the force that it had, where the tip was, and how it gave (n, 3 + 3 + 9)."""
    if feels_tip(what):
        return np.zeros((n, 15))
    memory = what.memory(n, 2 * routing.n_segments if reads_bend(what) else routing.n_tendons)
    return np.empty((n, 0)) if memory.size == 0 else memory


def link(name: str, values: Floats, routing: Routing) -> Link:
    """The effect of this name at rest, with `values` (n, n_columns)."""
    what = get_effect(name)
    return Link(name, what, values, at_rest(what, len(values), routing))


def feels_tip(what: Effect) -> bool:
    """Whether an effect's tip force depends on where the tip is."""
    return bool(trait(what, "feels_tip"))


def reads_tension(what: Effect) -> bool:
    """Whether an effect depends on the tension that tendons have."""
    return bool(trait(what, "reads_tension"))


def reads_bend(what: Effect) -> bool:
    """Whether an effect depends on how the rod is bent."""
    return bool(trait(what, "reads_bend"))


def tip_feedback(links: Sequence[Link], opened: EffectPorts, tip: Floats) -> tuple[Floats, Floats]:
    """Return what effects that feel the tip do where it is at `tip` (n, 3), base frame [m]: their tip
    force (n, 3) [N] and its slopes by the tip (n, 3, 3) [N/m], force in the world frame. `opened` stays as
    it is."""

    def force(at: Floats) -> Floats:
        opened.tip_position, opened.tip_force = at, np.zeros_like(given)
        for each in links:
            each.effect.apply(each.values, each.memory, opened, opened.state, 0.0)
        return opened.tip_force

    given, seen = opened.tip_force, opened.tip_position
    step = 1e-5 * float(opened.routing.length.sum())
    every = [force(tip + sign * step * axis) for axis in np.eye(3) for sign in (1.0, -1.0)]
    slopes = np.stack([(a - b) / (2.0 * step) for a, b in zip(every[::2], every[1::2], strict=True)], axis=-1)
    found = force(tip)
    opened.tip_force, opened.tip_position = given, seen
    return found, slopes


def approached(force: Floats, target: Floats, slopes: Floats, by_force: Floats) -> Floats:
    """Tip force (n, 3) [N] nearer to balance, by one Newton step: a `force` has put the tip where effects
    want `target`, with `slopes` (n, 3, 3) by the tip [N/m], and the tip gives by `by_force` (n, 3, 3)
    [m/N]."""
    matrix = np.eye(3) - slopes @ by_force
    return np.asarray(force + np.linalg.solve(matrix, (target - force)[..., None])[..., 0])


def acts_on_commands(what: Effect, routing: Routing) -> bool:
    """Whether an effect may change what drives the tendons: not one of lengths, where forces do."""
    return not (routing.by_tension and what.seam is Seam.ACTUATION and not bool(trait(what, "on_forces")))


def act(links: Iterable[Link], opened: EffectPorts, state: Any = None, dt: float = 0.0) -> None:
    """Let the effects before the camera change `opened`, but for those that feel the tip (`tip_feedback`);
    memories move on by `dt` [s]. `state`: the last one of a simulator."""
    opened.state = state
    for each in links:
        if each.effect.seam is not Seam.SENSING and not feels_tip(each.effect):
            commands, takes = opened.tendon_length, acts_on_commands(each.effect, opened.routing)
            if not takes:
                opened.tendon_length = np.broadcast_to(opened.rest_length, commands.shape).copy()
            each.effect.apply(each.values, each.memory, opened, state, dt)
            if not takes:
                opened.tendon_length = commands


def sweep(one: Link, opened: EffectPorts, runs: Sequence[slice], dt: Floats) -> None:
    """Let an effect with a memory change the tendon lengths of `opened`, whose rows are the samples of
    `runs`, each from rest; `dt` (n,) is the time before each sample [s]."""
    if not acts_on_commands(one.effect, opened.routing):
        return
    rest, dl = opened.rest_length, opened.dl
    out = dl.copy()
    for span in runs:
        memory = one.memory.copy()
        if hasattr(one.effect, "sweep"):
            out[span] = one.effect.sweep(one.values, memory, dl[None, span], dt[span], opened.routing)[0]
            continue
        for i in range(span.start, span.stop):  # one sample after the other, slowly
            row = opened.rows(slice(i, i + 1))
            row.tendon_length = dl[i : i + 1] + rest
            one.effect.apply(one.values, memory, row, None, float(dt[i]))
            out[i] = row.dl[0]
    change = out - dl
    if isinstance(one.effect, Operator):
        change = one.effect.change(
            np.broadcast_to(one.values, (len(dl), one.values.shape[1])), change, opened
        )
    opened.shift_tendons(change)


def goes_by_bend(links: Iterable[Link], n_segments: int) -> Flags:
    """(n,) or (1,) whether an effect that reads the bend does anything: one whose sizes are neutral need not
    know it."""
    found = np.zeros(1, bool)
    for each in links:
        if isinstance(each.effect, BodyOperator):
            found = found | (each.effect.stiffening(each.values, n_segments) > 0.0)
        elif reads_bend(each.effect):
            found = found | each.values.any(1)
    return found


def approach(links: Iterable[Link], n_segments: int) -> Floats:
    """(n,) or (1,) part of the way to the bend that a rod has answered, after which what effects hold back
    and the bend come to rest together: a body that is r times stiffer where nothing slides answers with r
    times what it is held back by too little, at most."""
    stiffer = np.zeros(1)
    for each in links:
        if isinstance(each.effect, BodyOperator):
            stiffer = stiffer + each.effect.stiffening(each.values, n_segments)
    return 1.0 / (1.0 + stiffer)


def relaxed(fraction: Floats, off: Floats, before: Floats, least: Floats) -> Floats:
    """(n,) fraction of the way to go next, from that of the last time and how far bends (n, k) were off then
    and are now [rad] (Aitken's rule for vectors, Irons and Tuck 1969)."""
    gone = off - before
    found = -fraction * (before * gone).sum(1) / np.maximum((gone**2).sum(1), 1e-30)
    return np.asarray(np.clip(found, least, 1.0))


def stay_back(one: Link, bend: Floats, runs: Sequence[slice]) -> Floats:
    """(n, n_segments, 2) the bend that an effect with a memory of the body holds back [rad], at samples of
    `runs`, each from rest, whose solved bend (n, n_segments, 2) is known; 0 at others."""
    assert isinstance(one.effect, BodyOperator)
    out = np.zeros_like(bend)
    for span in runs:
        out[span] = one.effect.sweep(one.values, one.memory.copy(), bend[None, span])[0]
    return out


def sense(links: Iterable[Link], opened: EffectPorts, seen: SensedPoses, dt: float = 0.0) -> SensedPoses:
    """`seen` as the camera has it, with the effects of sensing."""
    opened.tip_position, opened.tip_rotation, opened.points = (a.copy() for a in seen)
    for each in links:
        if each.effect.seam is Seam.SENSING:
            each.effect.apply(each.values, each.memory, opened, None, dt)
    return SensedPoses(opened.tip_position, opened.tip_rotation, opened.points)


def from_base(base_pose: Floats, position: Floats, rotation: Floats, points: Floats) -> SensedPoses:
    """World poses in the base frame: tip (n, 3) [m] and (n, 3, 3), and `points` (n, k, 3) less the base's
    position [m]. `base_pose` has n rows or one."""
    pose = np.broadcast_to(base_pose, (len(position), 7))
    base = matrix_from_quaternion(pose[:, 3:])
    return SensedPoses(
        np.einsum("nji,nj->ni", base, position - pose[:, :3]),
        np.swapaxes(base, 1, 2) @ rotation,
        np.einsum("nji,nkj->nki", base, points),
    )
