"""Before the search: is this a log of this robot, what is its noise, which base parameters does it show, how
do they fit."""

from __future__ import annotations

import numpy as np

from fastrod.errors import InputError, LogError
from fastrod.identification.log import advice
from fastrod.identification.log.forward import LogSamples, PredictedRod, predict
from fastrod.identification.log.noise import ENOUGH, Noise, at_rest, keep, read_noise
from fastrod.identification.log.questions import further_than_still
from fastrod.identification.log.unknowns import Model
from fastrod.identification.search.linearised import LinearisedModel, Target
from fastrod.identification.search.model_selection import ModelState
from fastrod.identification.search.search import N_BLOCKS, Search
from fastrod.identification.search.solve import Estimate
from fastrod.model.robot import Robot
from fastrod.types import Floats, Ints

LEAST_ROWS = 40
SEEN = 0.7
"""Of the prior's sd: a parameter whose data say less is not identifiable."""
_FOR_NOISE = 20000  # samples
_ANGLE = 0.01  # rad, noise of a measured orientation
_RESTLESS = 0.25  # of the motion: noise beyond it is no noise


class BaseFit:
    """The samples of the search, their noise and weights, and the base model; `rows` are all that may be
    fitted."""

    def __init__(
        self, samples: LogSamples, rows: Ints, model: Model, robot: Robot, threads: int | None
    ) -> None:
        self.rows = rows
        self.samples, self.model, self.robot = samples, model, robot
        self.rod = PredictedRod(samples, robot, points=samples.log.points is not None, threads=threads)
        self.target = Target(
            samples,
            np.full(3, 1e-3 * robot.length),
            rotation_sigma=_ANGLE,
            points=samples.log.points is not None,
        )
        n = len(samples.rows)
        self.block: Ints = np.minimum(np.arange(n) * N_BLOCKS // n, N_BLOCKS - 1)
        self.noise = Noise(np.full(3, 1e-3), 0.0, "")
        self.notes: list[str] = []
        self.weights: list[Floats] = []
        """Sigma of each stage."""

    def fit(self, search: Search) -> tuple[ModelState, dict[str, Estimate]]:
        """The base model with its own parameters fitted; those that this log cannot see stay nominal, with
        the reason."""
        model, target = self.model, self.target
        linearised = LinearisedModel(model, model.start, self.samples, self.rod, target)
        if not linearised.pose.ok.all():
            lost = int((~linearised.pose.ok).sum())
            self.notes.append(
                f"the model did not converge on {lost} of {len(linearised.pose.ok)} rows; they do not count"
            )
        raw = target.tip - linearised.pose.position
        self.noise = self._noise()
        given = self.robot.sensor.get("noise", 0.0)
        declared = float(max(given) if isinstance(given, tuple) else given)
        if declared > 0.0:
            self.noise = Noise(np.full(3, declared), self.noise.lag1, "the robot file's [sensor] noise")
        target.weight = (keep(self.samples, np.nan_to_num(raw), self.noise) & linearised.pose.ok).astype(
            float
        )
        out = int((target.weight == 0.0).sum())
        if out > 0.005 * len(raw):
            self.notes.append(f"{out} of {len(raw)} rows are outliers and do not count")
        self.weigh(self.noise.sigma)
        fixed = self._unseen(linearised)
        model = Model(
            model.robot, model.wiring, model.effects, tuple(u for u in model.unknowns if u.name not in fixed)
        )
        self.model = model
        self.weigh(self.noise.sigma * max(1.0, rms(target.residual(linearised.pose))))
        state = search.start(model, model.start)
        for _ in range(2):
            state = self.weighed(search, state)
        self.weights = self.weights[-1:]
        return state, fixed

    def _noise(self) -> Noise:
        """Noise from samples one after the other, whatever part of them the search looks at."""
        every = self.samples.on(self.rows[:_FOR_NOISE])
        tip = np.asarray(every.log.tip_position)[every.rows]
        if sum(len(rows) for rows in at_rest(every)) >= ENOUGH:
            return read_noise(every, tip, tip)
        pose = predict(
            self.model, self.model.start, every, PredictedRod(every, self.robot, threads=self.rod.threads)
        )
        return read_noise(every, tip, np.nan_to_num(tip - pose.position))

    def on(self, samples: LogSamples, state: ModelState) -> BaseFit:
        """The same robot, noise and weights at other samples; outliers by the residual of `state`."""
        made = BaseFit(samples, self.rows, self.model, self.robot, self.rod.threads)
        made.noise, made.notes, made.weights = self.noise, self.notes, self.weights
        made.weigh(self.target.sigma)
        pose = predict(state.model, state.theta, samples, made.rod)
        made.target.weight = (
            keep(samples, np.nan_to_num(made.target.tip - pose.position), self.noise) & pose.ok
        ).astype(float)
        return made

    def weigh(self, sigma: Floats) -> None:
        """Positions count by `sigma` (3,) [m], and orientations as much more or less than by their noise as
        positions do: weighed apart, what one of them cannot explain would leave the other to decide alone."""
        self.target.sigma = sigma.copy()
        self.target.rotation_sigma = _ANGLE * float((sigma / self.noise.sigma).max())

    def weighed(self, search: Search, state: ModelState) -> ModelState:
        """The state fitted again with weights of the size of its own residual, never below the noise: what a
        model does not explain yet must not push its parameters beyond their priors."""
        self.weigh(
            self.target.sigma
            * max(rms(state.fit.residual), float((self.noise.sigma / self.target.sigma).max()))
        )
        self.weights.append(self.target.sigma.copy())
        return search.refined(search.refined(state))

    def _unseen(self, linearised: LinearisedModel) -> dict[str, Estimate]:
        """Base parameters whose prior this log does not narrow: Fisher information at the noise, others free.
        And stiffnesses that nobody put into `[fit]`, where no load is known: what the wires' give would show
        of them, any gain of the drives shows as well."""
        model = self.model
        r = linearised.residual(model, model.start)
        J = linearised.slopes(model, model.start, r)
        flat = J.reshape(r.size, J.shape[-1])
        _, sd = model.prior
        H = flat.T @ flat + np.diag(1.0 / sd**2)
        fixed = {}
        posterior = np.sqrt(np.maximum(np.diag(np.linalg.pinv(H)), 0.0)) if len(sd) else sd
        for u, narrowed, prior in zip(model.unknowns, posterior, sd, strict=True):
            blind = (
                "stiffness" in u.name
                and u.name not in model.robot.fit
                and not advice.loaded(self.samples, model.robot)
            )
            if blind or narrowed > SEEN * prior:
                fixed[u.name] = Estimate(
                    value=u.start if u.place[0] == "robot" else u.mean,
                    stderr=float(prior),
                    unit=u.unit,
                    identifiable=False,
                    why=advice.why_unknown(u.name, self.samples, model.robot),
                    prior_sd=float(prior),
                )
        return fixed


def check_motion(base: BaseFit, state: ModelState, guess: str) -> None:
    """Refuse a log that the fitted model follows worse than a robot that stands still: it is of another
    robot, or in other units, as the sentence `guess` may say. Raises `LogError`."""
    good = (base.target.weight > 0.0) & state.linearised.pose.ok
    measured, predicted = (
        base.target.tip[good],
        state.linearised.seen(
            state.model, state.theta, state.linearised.solved(state.model, state.theta)
        ).position[good],
    )
    if 2 * state.linearised.pose.ok.sum() < state.linearised.pose.ok.size or not np.isfinite(predicted).all():
        raise LogError(further_than_still(base.samples, base.robot, np.nan, guess))
    measured, predicted = measured - measured.mean(0), predicted - predicted.mean(0)
    moves = float((measured**2).sum())
    name = base.samples.log.name
    if float(((measured - predicted) ** 2).sum()) > moves:
        scale = float((measured * predicted).sum() / max((predicted**2).sum(), 1e-30))
        raise LogError(further_than_still(base.samples, base.robot, scale, guess))
    if (
        base.noise.floor > _RESTLESS * np.sqrt(moves / max(len(measured), 1))
        and base.noise.floor > 0.01 * base.robot.length
    ):
        raise LogError(
            f"in log {name!r} the measured tip jumps by {1e3 * base.noise.floor:.3g} mm from sample to "
            "sample while the inputs rest, "
            f"{100 * base.noise.floor / np.sqrt(moves / len(measured)):.0f} % of its motion; are two robots "
            "or two markers mixed?"
        )


def check_log(samples: LogSamples, robot: Robot) -> None:
    """A log that cannot tell anything is refused in a sentence."""
    log = samples.log
    measured = int(log.measured.sum())
    if measured == 0:
        raise LogError(
            f"log {log.name!r} has no row in which every input and the tip are there; there is "
            "nothing to explain."
        )
    if measured < LEAST_ROWS:
        raise LogError(
            f"log {log.name!r} has {measured} measured rows; identification needs {LEAST_ROWS} "
            "at least, better two thousand."
        )
    inputs = [
        log.dl,
        *(
            a.reshape(len(log), -1)
            for a in (log.ext, log.tip_force, log.payload, log.base_quaternion)
            if a is not None
        ),
    ]
    moves = np.concatenate([np.ptp(a, axis=0) for a in inputs]) if inputs else np.zeros(0)
    if not (moves > 1e-9).any():
        raise LogError(
            f"in log {log.name!r} no input ever changes; nothing can be told from it. fastrod "
            "excite writes a run that does."
        )
    if float(np.ptp(np.asarray(log.tip_position)[log.measured], axis=0).max()) < 1e-7 * robot.length:
        raise LogError(f"in log {log.name!r} the measured tip never moves; is the camera's column filled?")
    for mode, number in ((s.mode, k) for k, s in enumerate(robot.segments, 1)):
        if mode == "tendon_tension":
            raise InputError(
                f"segment {number} of robot {robot.name!r} is in mode 'tendon_tension', but a "
                "run log gives tendon lengths."
            )


def rms(residual: Floats) -> float:
    """Root mean square of a residual (n, n_out), rows that do not count left out."""
    counted = residual[np.any(residual != 0.0, axis=1)]
    return float(np.sqrt(np.mean(counted**2))) if counted.size else 0.0
