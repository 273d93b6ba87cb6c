"""A log through the model: commands, effects, rod, camera; for any vector of unknowns.

The operators on the tendons run causally over every sample of every run. The rod is static, so each sample is
one robot of a batch, and only those samples are solved that the loss looks at.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from fastrod.effects import executor
from fastrod.effects.base import BodyOperator, Seam, has_memory
from fastrod.effects.executor import Link
from fastrod.effects.ports import EffectPorts, close_ports, open_ports
from fastrod.errors import InputError
from fastrod.identification.log.inputs import inputs
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import Model
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.model.routing import Routing, route
from fastrod.rotation import matrix_from_quaternion, segment_bends
from fastrod.solver.inputs import Inputs, Reader
from fastrod.solver.options import Modal, solver_of, usual_modes
from fastrod.types import Flags, Floats, Ints, Params, Ports

TOLERANCE = 1e-8  # of the robot's length: far below any camera
_FINE = 2e-3  # of steps of slopes and of the tolerance, where tendons can go slack
# passes that a row takes which none of the ways to settle it solves (measured: 900 for a batch with some
# hundreds of them)
_LOST = 500
# passes of a segment that take as long: 50 samples on which effects act one, an evaluation without a rod 200
# beside these, a step of a batch in motion 60
_SAMPLES, _EVALUATION, _STEP = 50, 200, 60
_ROUGH = 1e-5, 1e-3  # of the length; rad
_BALANCE = 40  # rounds in which a rod and a force that goes by its tip come to rest
_FORCE = 2e-3  # of EI / l^2, step of the compliance of the tip
N_STEPS = 6  # steps of a segment: the tip to some micrometres


class PredictedPose(NamedTuple):
    """Pose of the rod at each row, base frame, before the camera."""

    position: Floats
    """(n, 3) tip [m]."""
    rotation: Floats
    """(n, 3, 3) base_from_tip."""
    points: Floats
    """(n, k, 3) further points [m]."""
    ok: Flags
    """(n,) the rod converged."""


class RodAnswer(NamedTuple):
    """Answer of a rod besides its pose, for the effects that depend on it."""

    tension: Floats
    """(n, n_tendons) 0 where no tendon stretches [N]."""
    bend: Floats
    """(n, n_segments, 2) [rad]"""


@dataclass
class Work:
    """Work done so far, counted: seconds go by the machine, and what is found must not."""

    batches: int = 0
    """Solved, or moved."""
    of_row: float = 0.0
    """Passes of a row at rest, on the average."""
    passes: float = 0.0
    """Passes of one segment, all rows together, and what takes as long; 4 to 9 us of CPU time each."""

    def rows(self, passes: Ints, n_segments: int) -> None:
        """Count a batch solved in so many `passes` (n_rows,) each."""
        self.batches, self.of_row = self.batches + 1, self.of_row + float(passes.mean())
        self.passes += float(passes.sum()) * n_segments

    def samples(self, n: int) -> None:
        """Count an evaluation without a rod whose effects act on `n` samples, all effects together."""
        self.passes += _EVALUATION + n / _SAMPLES

    def steps(self, n: int, n_segments: int) -> None:
        """Count `n` steps in motion of rods with `n_segments` together."""
        self.batches += 1
        self.passes += n * (_STEP + n_segments)


class PredictedRod:
    """The batch that solves the rows of `samples`; it stays warm from one parameter vector to the next."""

    def __init__(
        self, samples: LogSamples, robot: Robot, *, points: bool = False, threads: int | None = None
    ) -> None:
        from fastrod.simulator import Simulator

        self.threads = threads
        self.samples, self.points = samples, points and samples.log.points is not None
        bare = replace(robot, effects=())
        n, by_modes = len(samples.rows), isinstance(solver_of([bare]), Modal)
        self._sim = Simulator(
            bare,
            n_robots=n,
            points_per_segment=N_STEPS,
            outputs="full",
            solver=Modal(modes=usual_modes([bare], coarse=True)) if by_modes else None,
            threads=threads,
        )
        # a step of first order goes by the tendons that are slack before it, and is wrong where others are
        self._one_sided = any(tendon.unilateral for tendon in robot.tendons) and not robot.by_tension
        self.fine = _FINE if self._one_sided else 1.0
        """Steps relative to the usual ones of slopes: a tendon that goes slack or taut within one bends
        it."""
        self._tolerance = self.fine * TOLERANCE * robot.length
        self._log = samples.log.rows(samples.rows)
        self.answer = RodAnswer(np.zeros((n, robot.n_tendons)), np.zeros((n, robot.n_segments, 2)))
        self.work = Work()

    def solve(
        self, ports: Ports, params: Params, robot: Robot, rows: Flags | None = None, near: bool = False
    ) -> PredictedPose:
        """Pose at the rows, for these ports and this robot; only of the `rows` of a mask, where one is given.
        `near` ones differ so little from the last that a difference of first order is all that counts; where
        tendons can go slack they are solved, too."""
        first_order = near and self.of_modes and not self._one_sided
        state = self._sim.settle_ports(
            ports,
            params,
            math.inf if first_order else self._tolerance,
            None if rows is None or rows.all() else np.flatnonzero(rows),
            replace(robot, effects=()),
        )
        self.work.rows(np.where(state.passes < 0, _LOST, state.passes), len(robot.segments))
        bend = segment_bends(state.rotation, len(robot.segments))
        self.answer = RodAnswer(np.nan_to_num(state.tension), np.nan_to_num(bend))
        points, tip, tip_rotation = np.zeros((len(state.ok), 0, 3)), state.tip_position, state.tip_rotation
        if self.points or self._log.without_tip:
            found, rotation = self._sim.markers()
            if self._log.without_tip:
                found, tip, tip_rotation = found[:, :-1], found[:, -1], rotation[:, -1]
            if self.points:
                points = found - ports.base_pose[:, None, :3]
        return PredictedPose(*executor.from_base(ports.base_pose, tip, tip_rotation, points), state.ok)

    @property
    def of_modes(self) -> bool:
        """Whether the robot needs modes."""
        return self._sim.solver == "modal"

    def keep(self) -> object:
        """Return what `back` needs to return to the boundary of the last solve."""
        return self._sim.snapshot()

    def back(self, kept: object) -> None:
        """Start the next solve from where `keep` was called: differences are then taken about one point."""
        self._sim.restore(kept)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class PreparedLog:
    """The inputs of `samples` for one robot, before effects: what does not change while effects do."""

    robot: Robot
    wiring: Routing
    samples: LogSamples
    ports: Ports
    """Ports of the rows."""
    params: Params
    reader: Reader
    dl: Floats
    """(n, n_tendons) commanded, of every sample, negative = pulled: lengths [m], or forces [N]."""
    base_rotation: Floats
    """(n_rows, 3, 3) or (1, 3, 3)."""
    tension: Floats | None = None
    """(n, n_tendons) that tendons have at every sample, as far as it is known [N]."""
    beyond: Floats | None = None
    """(n, n_segments, 2) by which the rod is bent beyond what its tendons ask for at every sample [rad]."""

    def open(self) -> EffectPorts:
        """Ports of the rows, ready for effects."""
        return self._open(
            self.ports, len(self.samples.rows), self.samples.time[self.samples.rows], self.base_rotation
        )

    def under(
        self, answer: RodAnswer, requested: Floats, ok: Flags, fraction: Floats | None = None
    ) -> PreparedLog:
        """The same with the tension and the bends of a solution, of the rows that are `ok`, the bends a
        `fraction` (n_rows,) of the way; effects had gone by `requested` (n_rows, n_segments, 2)."""
        off = (answer.bend - requested).reshape(len(ok), -1)
        off = self._between(off if fraction is None else fraction[:, None] * off, ok).reshape(
            -1, *requested.shape[1:]
        )
        beyond = off if self.beyond is None else self.beyond + off
        return replace(self, tension=self._between(answer.tension, ok), beyond=beyond)

    def _between(self, at_rows: Floats, ok: Flags) -> Floats:
        """(n, k) at every sample, linear in time between the rows (n_rows, k) that are `ok`."""
        rows, found = self.samples.rows[ok], np.zeros((len(self.dl), at_rows.shape[1]))
        for span in self.samples.runs:
            inside = (rows >= span.start) & (rows < span.stop)
            for k in range(found.shape[1] if inside.any() else 0):
                known = self.samples.time[rows[inside]], at_rows[ok][inside, k]
                found[span, k] = np.interp(self.samples.time[span], *known)
        return found

    def _open(self, ports: Ports, n: int, time: Floats, base_rotation: Floats) -> EffectPorts:
        return open_ports(
            ports,
            self.params,
            self.wiring,
            n=n,
            rest_length=self.robot.rest_tendon_length,
            gravity=np.array(self.robot.gravity)[None],
            base_rotation=base_rotation,
            time=time,
            n_steps=N_STEPS,
            stateless=True,
        )

    def drive(self, links: Sequence[Link]) -> EffectPorts:
        """Ports of the rows after the effects of `links`, less sensing and those that feel the tip. Up to the
        last one with a memory they run over every sample, for the tendons' lengths."""
        opened, rest, dl = self.open(), self.robot.rest_tendon_length, self.dl
        at_rows = self.samples.session[self.samples.rows]
        swept = 1 + max((i for i, each in enumerate(links) if _of_tendons(each)), default=-1)
        if swept:
            alone = Ports(*(a[:1] for a in self.ports))
            every = self._open(alone, len(self.dl), self.samples.time, self.base_rotation[:1])
            every.tendon_length = self.dl + rest
            if self.tension is not None:
                every.solved_tension = self.tension
            for each in links[:swept]:
                if has_memory(each.effect):
                    for k in range(len(each.values)):
                        executor.sweep(each.alone(k), every, self._histories(each, k), self.samples.dt)
                else:
                    executor.act([each.over(self.samples.session)], every)
                    executor.act([each.over(at_rows)], opened)  # for what it changes beside lengths
            dl = every.dl
            opened.tendon_length = dl[self.samples.rows] + rest
        bend = self.wiring.bend(dl) if self.beyond is None else self.wiring.bend(dl) + self.beyond
        opened.solved_bend = bend[self.samples.rows]
        for each in links[swept:]:
            if isinstance(each.effect, BodyOperator):
                for k in range(len(each.values)):
                    held = executor.stay_back(each.alone(k), bend, self._histories(each, k))
                    opened.rest_bend += held[self.samples.rows]
            else:
                executor.act([each.over(at_rows)], opened)
        return opened

    def _histories(self, one: Link, k: int) -> Sequence[slice]:
        """Those over which the `k`-th row of an effect's values holds."""
        return self.samples.histories_of(k) if len(one.values) > 1 else self.samples.histories

    def solve(
        self, links: Sequence[Link], rod: PredictedRod, robot: Robot, rough: bool = False
    ) -> tuple[PreparedLog, EffectPorts, PredictedPose]:
        """`_solve` at the tension and the bends that it leads to, if effects read them, and this log at
        these. A `rough` one is for slopes and for comparing candidates, at a third of the time: bends may be
        off by 1e-3 rad."""
        tolerance, turned = _ROUGH if rough else (3.0 * TOLERANCE, 3.0 * TOLERANCE)
        place, (opened, pose, answer) = self, self._solve(links, rod, robot)
        off = np.full(len(pose.ok), np.inf)
        least, n = executor.approach(links, self.wiring.n_segments), len(pose.ok)
        fraction, gap = np.broadcast_to(least, (n,)), (answer.bend - opened.solved_bend).reshape(n, -1)
        bends = any(executor.reads_bend(each.effect) for each in links)
        for _ in range(
            _BALANCE if bends or any(executor.reads_tension(each.effect) for each in links) else 0
        ):
            before, place = pose, place.under(answer, opened.solved_bend, pose.ok, fraction)
            opened, pose, answer = place._solve(links, rod, robot)
            gap, last = (answer.bend - opened.solved_bend).reshape(n, -1), gap
            fraction = executor.relaxed(fraction, gap, last, least)
            off = np.linalg.norm(pose.position - before.position, axis=1)
            if bends:
                off = np.maximum(off, robot.length * np.abs(gap).max(1) * tolerance / turned)
            if not (off[pose.ok] > tolerance * robot.length).any():
                break
        if place is not self:
            pose = pose._replace(ok=pose.ok & (off <= 3e2 * tolerance * robot.length))
        return place.under(answer, opened.solved_bend, pose.ok), opened, pose

    def _solve(
        self, links: Sequence[Link], rod: PredictedRod, robot: Robot
    ) -> tuple[EffectPorts, PredictedPose, RodAnswer]:
        """Ports of the rows after the effects of `links`, those that feel the tip included, and the pose of
        `robot` at these, with what else the rod answers. A row at which such a force and the rod find no
        balance is not `ok`."""
        felt = [
            each.over(self.samples.session[self.samples.rows])
            for each in links
            if executor.feels_tip(each.effect)
        ]
        opened = self.drive(links)
        pose = rod.solve(*self.kernel(opened), robot)
        answer = rod.answer
        if not felt:
            return opened, pose, answer
        given, force = opened.tip_force, np.zeros_like(opened.tip_force)
        kept = rod.keep()
        step = _FORCE * min(min(s.bending_stiffness) for s in robot.segments) / robot.length**2
        columns = []
        for axis in np.eye(3):
            opened.tip_force = given + step * axis
            moved = rod.solve(*self.kernel(opened), robot, pose.ok)
            columns.append(np.where(pose.ok[:, None], (moved.position - pose.position) / step, 0.0))
            rod.back(kept)
        opened.tip_force, by_force = given, np.stack(columns, axis=-1)
        for _ in range(_BALANCE):
            target, slopes = executor.tip_feedback(felt, opened, pose.position)
            now = executor.approached(force, target, slopes, by_force)
            change = np.where(pose.ok[:, None], now - force, 0.0)
            expected = np.einsum("nij,nj->ni", by_force, change)
            off = np.linalg.norm(expected, axis=1)
            if not (off > TOLERANCE * robot.length).any():
                break
            force = force + change
            opened.tip_force = given + force
            before, pose = pose, rod.solve(*self.kernel(opened), robot, pose.ok)
            pose = pose._replace(ok=pose.ok & before.ok)  # a rod that is lost on the way is not tried again
            answer = rod.answer
            # what the rod did beyond its compliance corrects it along the change (Broyden 1965)
            beyond = np.where(pose.ok[:, None], pose.position - before.position - expected, 0.0)
            size = np.maximum((change**2).sum(1), 1e-30)
            by_force = by_force + beyond[:, :, None] * (change / size[:, None])[:, None]
        else:
            pose = pose._replace(ok=pose.ok & (off <= 1e3 * TOLERANCE * robot.length))
        return opened, pose, answer

    def kernel(self, opened: EffectPorts) -> tuple[Ports, Params]:
        """Return what the kernel reads."""
        ports, params, points = close_ports(opened, self.ports, self.params)
        return self.reader.with_point_forces(ports, Inputs(), points)[0] if points else ports, params

    def see(self, pose: PredictedPose, links: Sequence[Link]) -> PredictedPose:
        """The pose as the camera sees it, by the effects of sensing in `links`."""
        at_rows = self.samples.session[self.samples.rows]
        sensing = [each.over(at_rows) for each in links if each.effect.seam is Seam.SENSING]
        if not sensing:
            return pose
        return PredictedPose(*executor.sense(sensing, self.open(), executor.SensedPoses(*pose[:3])), pose.ok)


def prepare_log(
    samples: LogSamples, robot: Robot, wiring: Routing, like: PreparedLog | None = None
) -> PreparedLog:
    """The inputs of the rows of `samples` for `robot`, its tendons grouped into drives as in `wiring`; with
    the tension and the bends that are known of a robot `like` it."""
    samples = samples.short
    log = samples.log.rows(samples.rows)
    layout, params, rest = compile_robots((replace(robot, effects=()),), N_STEPS)
    reader = Reader(layout, params, rest, len(log))
    ports = reader.ports(Inputs(**dict[str, Any](inputs(log, robot))))
    return PreparedLog(
        robot,
        # the arms of this robot: where offsets are fitted, a bend in an effect is by these, as it will be in
        # the robot file
        replace(route(robot), drive=wiring.drive, drive_sign=wiring.drive_sign),
        samples,
        ports,
        params,
        reader,
        samples.log.pulls,
        matrix_from_quaternion(ports.base_pose[:, 3:]),
        None if like is None else like.tension,
        None if like is None else like.beyond,
    )


def _of_tendons(one: Link) -> bool:
    """Whether an effect has a memory of what tendons did."""
    return one.effect.seam is Seam.ACTUATION and has_memory(one.effect)


def effects_at(model: Model, theta: Floats) -> list[Link]:
    """The effects of a model at `theta`, one row of values each, or one for each session, in the order in
    which they act.

    Raises `InputError` for a memory of other things than tendons and bends: only those are carried over a
    log.
    """
    links = [executor.link(name, values, model.wiring) for name, values in model.by_session(theta).items()]
    for each in links:
        if has_memory(each.effect) and not (_of_tendons(each) or executor.reads_bend(each.effect)):
            raise InputError(
                f"effect {each.name!r} has a memory at the seam {each.effect.seam.name}; over a log only "
                "those of ACTUATION and those that read the bend are carried."
            )
    return links


def predict(
    model: Model,
    theta: Floats,
    samples: LogSamples,
    rod: PredictedRod,
    like: PreparedLog | None = None,
    rough: bool = False,
) -> PredictedPose:
    """Return what the camera sees at the rows of `samples`, solved exactly, or `rough`
    (`PreparedLog.solve`); from a solution nearby where one is given."""
    robot = model.robot_at(theta)
    place = prepare_log(samples, robot, model.wiring, like)
    links = effects_at(model, theta)
    return place.see(place.solve(links, rod, robot, rough)[2], links)
