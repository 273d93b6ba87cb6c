"""The model near one parameter vector: tendons, loads and camera exactly, the rod by its slopes.

A candidate effect changes the rod's inputs by little. So the rod is solved once at a reference, and once for
each direction that its inputs can take; after that a candidate costs no rod at all. What is accepted is
solved exactly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from fastrod.effects.base import Seam, get_effect, has_memory
from fastrod.effects.executor import Link, act, approached, feels_tip, tip_feedback
from fastrod.effects.ports import CHANGEABLE
from fastrod.errors import RobotError
from fastrod.identification.log.forward import (
    PredictedPose,
    PredictedRod,
    PreparedLog,
    effects_at,
    prepare_log,
)
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import Model, Unknown, effect_unknowns
from fastrod.identification.search.solve import Fit, minimise
from fastrod.rotation import matrix_from_quaternion
from fastrod.types import Floats

ANGLE = 0.01
"""rad, noise of a measured orientation."""
_BEND = 2e-3  # rad, step of the slopes by bend
_BALANCE = 3  # Newton steps; a force that is linear in the tip takes one
_FORCE = 2e-3  # of EI / l^2, step of the slopes by tip force
_STEP = 0.05  # of an unknown's scale, of slopes at the reference: by a whole one they were 26 % off


@dataclass(frozen=True, kw_only=True, eq=False)
class Target:
    """Measurement at the rows, and how much each number counts."""

    tip: Floats
    """(n, 3) [m]."""
    rotation: Floats | None
    """(n, 3, 3)."""
    points: Floats
    """(n, k, 3) [m]; nan where one was hidden."""
    sigma: Floats
    """(3,) of positions [m]."""
    rotation_sigma: float
    """[rad]."""
    weight: Floats
    """(n,) 0 for outliers."""

    def weighed(self, sigma: Floats, noise: Floats) -> Target:
        """Positions count by `sigma` (3,) [m], and orientations as much more or less than by their noise as
        positions do by theirs, `noise` (3,) [m]: weighed apart, what one of them cannot explain would leave
        the other to decide alone."""
        return replace(self, sigma=sigma.copy(), rotation_sigma=ANGLE * float((sigma / noise).max()))

    def residual(self, pose: PredictedPose) -> Floats:
        """(n, n_out) measured - predicted over sigma: tip, rotation vector, points; 0 for rows that do not
        count."""
        blocks = [(self.tip - pose.position) / self.sigma]
        if self.rotation is not None:
            rotation = self.rotation @ np.swapaxes(pose.rotation, 1, 2)
            blocks.append(_vector(rotation) / self.rotation_sigma)
        if self.points.shape[1]:
            blocks.append(
                (np.where(np.isfinite(self.points), self.points - pose.points, 0.0) / self.sigma).reshape(
                    len(self.tip), -1
                )
            )
        every = np.concatenate(blocks, axis=1)
        return np.asarray(np.where((self.weight > 0.0)[:, None] & pose.ok[:, None], every, 0.0))


def target_of(samples: LogSamples, sigma: Floats, *, rotation_sigma: float, points: bool) -> Target:
    """The measured rows of `samples`, all of which count; with `points` those along the robot too."""
    log = samples.log.rows(samples.rows)
    quaternion = log.tip_quaternion
    return Target(
        tip=np.asarray(log.tip_position),
        rotation=None
        if quaternion is None or not np.isfinite(quaternion).all()
        else matrix_from_quaternion(quaternion),
        points=log.points if points and log.points is not None else np.zeros((len(log), 0, 3)),
        sigma=sigma,
        rotation_sigma=rotation_sigma,
        weight=np.ones(len(log)),
    )


def _vector(rotation: Floats) -> Floats:
    """(n, 3) rotation vector of rotations that are small (exact to third order)."""
    skew = 0.5 * np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(skew, axis=1, keepdims=True)
    angle = np.arctan2(sine, 0.5 * (np.trace(rotation, axis1=1, axis2=2)[:, None] - 1.0))
    return np.asarray(skew * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 1.0))


def _turned(rotation: Floats, vector: Floats) -> Floats:
    half = 0.5 * np.linalg.norm(vector, axis=1)
    quaternion = np.column_stack([np.cos(half), 0.5 * np.sinc(half / np.pi)[:, None] * vector])
    return matrix_from_quaternion(quaternion) @ rotation


class LinearisedModel:
    """The model `model` at `theta`, and all models near it."""

    def __init__(
        self,
        model: Model,
        theta: Floats,
        samples: LogSamples,
        rod: PredictedRod,
        target: Target,
        like: LinearisedModel | None = None,
    ) -> None:
        """`like`: a model nearby, from whose tension and bends it is solved."""
        self.model = model
        self.theta = theta.copy()
        self.samples = samples
        self.rod = rod
        self.target = target
        self.robot = model.robot_at(theta)
        near = None if like is None or like.samples is not samples else like.prepared
        self.prepared: PreparedLog = prepare_log(samples, self.robot, model.wiring, near)
        self.effects = effects_at(model, theta)
        self.prepared, self.opened, self.pose = self.prepared.solve(self.effects, rod, self.robot, rough=True)
        self._feedback = self._tip_feedback(self.effects, self.pose.position)[0]
        self._kept = rod.keep()
        self._columns: dict[tuple[str, ...], Floats] = {}
        at = self.prepared.drive([each for each in self.effects if self.is_light(each.name)])
        self._length, self._force = at.tendon_length.copy(), at.tip_force.copy()
        self._rest = at.rest_bend.copy()

    def under(self, target: Target) -> LinearisedModel:
        """The same slopes, weighed otherwise."""
        made = copy(self)
        made.target = target
        return made

    def borrowing(self, other: LinearisedModel) -> LinearisedModel:
        """This model with the slopes of `other`, at a place nearby of the same samples: as many rods as it
        has unknowns are not solved."""
        self._columns = dict(other._columns)
        for name in ("by_length", "by_force", "by_rest"):
            if name in vars(other):
                vars(self)[name] = vars(other)[name]
        return self

    def _difference(self, pose: PredictedPose) -> Floats:
        """(n, 6 + 3k) from the reference: tip, rotation vector, points."""
        rotation = pose.rotation @ np.swapaxes(self.pose.rotation, 1, 2)
        points = (pose.points - self.pose.points).reshape(len(rotation), -1)
        return np.concatenate([pose.position - self.pose.position, _vector(rotation), points], axis=1)

    def _solved(self, **moved: Any) -> Floats:
        self.rod.back(self._kept)
        ports = self.prepared.kernel(replace(self.opened, **moved))
        pose = self.rod.solve(*ports, self.robot, self.pose.ok, near=True)
        return np.where(self.pose.ok[:, None], self._difference(pose), 0.0)

    @cached_property
    def by_length(self) -> Floats:
        """(n, 6 + 3k, n_tendons) per m of tendon length, or N. A body that can shorten answers to each tendon
        by itself, any other only to the bend that the lengths ask for."""
        wiring, n = self.model.wiring, self.model.wiring.n_tendons
        if not n:
            return np.zeros((len(self.samples.rows), 6 + 3 * self.pose.points.shape[1], 0))
        if any(math.isfinite(s.axial_stiffness) for s in self.robot.segments):
            changes, steps, back = np.eye(n), self.rod.fine * _BEND * wiring.tendon_offset, np.eye(n)
            if wiring.by_tension:
                steps = self.rod.fine * _BEND / np.abs(wiring.bend_from_tendons).max(0)
        else:
            bends = np.eye(2 * wiring.n_segments).reshape(-1, wiring.n_segments, 2)
            changes, back = wiring.tendon_change(bends), wiring.bend_from_tendons
            steps = np.full(len(changes), self.rod.fine * _BEND)
        every = [
            self._solved(tendon_length=self.opened.tendon_length + step * change) / step
            for change, step in zip(changes, steps, strict=True)
        ]
        return np.asarray(np.stack(every, axis=-1) @ back)

    @cached_property
    def by_force(self) -> Floats:
        """(n, 6 + 3k, 3) per N, world."""
        size = min(min(s.bending_stiffness) for s in self.robot.segments) / self.robot.length**2
        step = self.rod.fine * _FORCE * size
        return np.stack(
            [self._solved(tip_force=self.opened.tip_force + step * np.eye(3)[j]) / step for j in range(3)],
            axis=-1,
        )

    @cached_property
    def by_rest(self) -> Floats:
        """(n, 6 + 3k, 2 n_segments) per rad of the bend that a segment has without moments."""
        step, shape = self.rod.fine * _BEND, self.opened.rest_bend.shape[1:]
        turned = np.eye(math.prod(shape)).reshape(-1, *shape)
        return np.stack(
            [self._solved(rest_bend=self.opened.rest_bend + step * one) / step for one in turned], axis=-1
        )

    def is_light(self, name: str) -> bool:
        """Whether an effect changes only tendon lengths, the tip force or the camera: then no rod need be
        solved for it."""
        what = get_effect(name)
        if has_memory(what) or what.seam is Seam.SENSING or feels_tip(what):
            return True
        key = ("light", name)
        if key not in self._columns_kind:
            self._columns_kind[key] = self._probe(name)
        return self._columns_kind[key]

    _columns_kind: ClassVar[dict[tuple[str, str], bool]] = {}

    def _probe(self, name: str) -> bool:
        opened, unknowns = self.prepared.open(), effect_unknowns(name, self.model.wiring)
        alone = Model(self.model.robot, self.model.wiring, (name,), unknowns)
        (one,) = effects_at(alone, alone.start)
        opened.solved_bend = np.ones_like(opened.rest_bend)
        before = {
            key: getattr(opened, key).copy()
            for key in CHANGEABLE
            if key not in ("tendon_length", "tip_force", "rest_bend")
        }
        act([one.on(len(opened))], opened)
        same = all(np.array_equal(getattr(opened, key), old) for key, old in before.items())
        return same and not opened.point_forces

    def _is_light(self, unknown: Unknown) -> bool:
        return unknown.place[0] == "effect" and self.is_light(unknown.place[1])

    def column(self, unknown: Unknown) -> Floats:
        """(n, 6 + 3k) change of the true pose per unit of an unknown that needs the rod, one-sided difference
        at the reference: for an effect that the model has not, over a size that is typical of it."""
        if unknown.place not in self._columns:
            step = min(self.rod.fine, _STEP) * unknown.scale
            model, theta = self.model, self.theta
            if unknown.place[0] == "effect" and unknown.place[1] not in model.effects:
                model = model.with_effect(unknown.place[1])
                step = self.rod.fine * unknown.scale
                model = Model(model.robot, model.wiring, model.effects, (*self.model.unknowns, unknown))
                theta = np.append(theta, unknown.mean)
            names = [u.place for u in model.unknowns]
            j = names.index(unknown.place)
            moved = theta.copy()
            here = unknown.inside(float(theta[j]))
            if here + step > unknown.bounds[1]:
                step = -step
            moved[j] = unknown.outside(here + step)
            robot = model.robot_at(moved)
            place = (
                self.prepared
                if unknown.place[0] == "effect"
                else prepare_log(self.samples, robot, model.wiring, self.prepared)
            )
            self.rod.back(self._kept)
            opened = place.drive(effects_at(model, moved))
            opened.tip_force += self._feedback  # held, as with the slopes: `closed` has what it answers
            pose = self.rod.solve(*place.kernel(opened), robot, self.pose.ok, near=True)
            self._columns[unknown.place] = np.where(pose.ok[:, None], self._difference(pose) / step, 0.0)
        return self._columns[unknown.place]

    def driven(self, model: Model, theta: Floats) -> Floats:
        """(n, 6 + 3k) change of the true pose by tendons and tip forces, but for forces that go by the
        tip."""
        light = [each for each in effects_at(model, theta) if self.is_light(each.name)]
        opened = self.prepared.drive(light)
        self.rod.work.samples(len(self.prepared.dl) * (1 + sum(has_memory(each.effect) for each in light)))
        change = np.zeros((len(opened), 6 + 3 * self.pose.points.shape[1]))
        moved = opened.tendon_length - self._length
        if moved.any():
            change += np.einsum("nij,nj->ni", self.by_length, moved)
        force = opened.tip_force - self._force
        if force.any():
            change += np.einsum("nij,nj->ni", self.by_force, force)
        rest = opened.rest_bend - self._rest
        if rest.any():
            change += np.einsum("nij,nj->ni", self.by_rest, rest.reshape(len(rest), -1))
        return change

    def solved(self, model: Model, theta: Floats) -> Floats:
        """(n, 6 + 3k) change of the true pose by what needs the rod."""
        at = {u.place: u.inside(float(v)) for u, v in zip(self.model.unknowns, self.theta, strict=True)}
        change = np.zeros((len(self.samples.rows), 6 + 3 * self.pose.points.shape[1]))
        for unknown, number in zip(model.unknowns, theta, strict=True):
            moved = unknown.inside(float(number)) - at.get(unknown.place, unknown.mean)
            if moved != 0.0 and not self._is_light(unknown):  # at the reference no slope is needed
                change += self.column(unknown) * moved
        return change

    def _tip_feedback(self, effects: Sequence[Link], tip: Floats) -> tuple[Floats, Floats]:
        """Tip force of the effects that feel the tip where it is at `tip`, and its slopes (`tip_feedback`);
        zero without such effects."""
        at_rows = self.samples.session[self.samples.rows]
        felt = [each.over(at_rows) for each in effects if feels_tip(each.effect)]
        if not felt:
            return np.zeros((len(tip), 3)), np.zeros((len(tip), 3, 3))
        return tip_feedback(felt, self.opened, np.where(self.pose.ok[:, None], tip, 0.0))

    def closed(self, model: Model, theta: Floats, change: Floats) -> Floats:
        """(n, 6 + 3k) change of the true pose with what the forces of effects that feel the tip make of a
        `change` at which they were held: their balance with the rod, by its slopes."""
        effects = [each for each in effects_at(model, theta) if feels_tip(each.effect)]
        if not effects and not self._feedback.any():
            return change
        force, by_force = self._feedback, self.by_force
        for _ in range(_BALANCE if effects else 0):
            tip = self.pose.position + change[:, :3]
            tip = tip + np.einsum("nij,nj->ni", by_force[:, :3], force - self._feedback)
            target, slopes = self._tip_feedback(effects, tip)
            force = approached(force, target, slopes, by_force[:, :3])
        force = force if effects else np.zeros_like(force)
        return np.asarray(change + np.einsum("nij,nj->ni", by_force, force - self._feedback))

    def seen(self, model: Model, theta: Floats, change: Floats) -> PredictedPose:
        """Return what the camera sees after a change (n, 6 + 3k) of the true pose: tip [m], rotation
        vector [rad], points [m], base frame."""
        rotation = self.pose.rotation
        sensing = [each for each in effects_at(model, theta) if each.effect.seam is Seam.SENSING]
        if sensing or self.target.rotation is not None:
            rotation = _turned(rotation, change[:, 3:6])
        points = self.pose.points + change[:, 6:].reshape(self.pose.points.shape)
        return self.prepared.see(
            PredictedPose(self.pose.position + change[:, :3], rotation, points, self.pose.ok), sensing
        )

    def residual(self, model: Model, theta: Floats) -> Floats:
        """(n, n_out) weighted; infinite where no robot has these numbers."""
        try:
            model.robot_at(theta)
        except RobotError:
            return np.full_like(self.target.residual(self.pose), np.inf)
        return self.target.residual(
            self.seen(
                model, theta, self.closed(model, theta, self.driven(model, theta) + self.solved(model, theta))
            )
        )

    def slopes(self, model: Model, theta: Floats, residual: Floats, known: Floats | None = None) -> Floats:
        """(n, n_out, p) of the prediction, by differences that run only what an unknown moves; those by the
        first unknowns may be `known` (n, n_out, < p)."""
        driven, solved = self.driven(model, theta), self.solved(model, theta)
        J = np.empty((*residual.shape, len(theta)))
        _, high = model.limits
        n_known = 0 if known is None else known.shape[-1]
        J[..., :n_known] = 0.0 if known is None else known
        for j, unknown in enumerate(model.unknowns[n_known:], n_known):
            step = 1e-4 if unknown.log else 1e-3 * unknown.scale
            if unknown.shape or (unknown.place[0] == "effect" and has_memory(get_effect(unknown.place[1]))):
                step *= 20.0  # operators have corners: look over them
            if theta[j] + step > high[j]:
                step = -step
            moved = theta.copy()
            moved[j] += step
            change = driven + solved
            if not self._is_light(unknown):
                change = change + self.column(unknown) * (
                    unknown.inside(float(moved[j])) - unknown.inside(float(theta[j]))
                )
            elif get_effect(unknown.place[1]).seam is not Seam.SENSING:
                change = self.driven(model, moved) + solved
            seen = self.seen(model, moved, self.closed(model, moved, change))
            J[..., j] = (residual - self.target.residual(seen)) / step
        return J

    def fit(self, model: Model, start: Floats, iterations: int, known: Floats | None = None) -> Fit:
        """The best parameters near here, from `start` (p,) on, within the model's limits and under its
        priors; slopes by the first unknowns may be `known`."""
        mean, sd = model.prior
        return minimise(
            lambda theta: self.residual(model, theta),
            lambda theta, r: self.slopes(model, theta, r, known),
            start,
            mean,
            sd,
            model.limits,
            iterations,
        )
