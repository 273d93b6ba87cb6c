"""The search in motion: the same candidates and the same evidence as at rest, beside rods that have inertia.

No slope by inputs holds for a rod that moves, so every model is moved in time, many side by side: of a
candidate first what it does at its starts; then those that promise most are fitted, with the slopes that are
known of what they stand beside.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import ClassVar, TypeVar, cast

import numpy as np

from fastrod.effects.base import effect_names, get_effect, trait
from fastrod.effects.executor import reads_bend, reads_tension
from fastrod.effects.pipeline import named_effects
from fastrod.errors import LogError, RobotError
from fastrod.identification.log import advice
from fastrod.identification.log.forward import PredictedPose, Work
from fastrod.identification.log.motion import LONGEST_STEP, MotionReplay
from fastrod.identification.log.noise import Noise, keep, read_noise
from fastrod.identification.log.samples import LogSamples
from fastrod.identification.log.unknowns import Model, Unknown
from fastrod.identification.search.base import SEEN, BaseFit
from fastrod.identification.search.linearised import ANGLE, LinearisedModel, Target, target_of
from fastrod.identification.search.model_selection import Candidate, ModelState, unfitted
from fastrod.identification.search.search import Search, blocks_of, distinct, grown, starts_of
from fastrod.identification.search.solve import Estimate, Fit, minimise, rms
from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats

_T = TypeVar("_T")
_STEP = 0.02
"""Step as a fraction of an unknown's typical size, for differences: a thousandth of the value for most.
Below it the tolerance of a step's Newton method would show, 1e-6 of the bend."""
HORIZONS = (0.06, 0.12, 0.25, 0.5, 1.0, 1.0)
"""Fractions of each run that are fitted one after the other: an oscillation that is off by half a period at
the end of a run pulls its frequency to a neighbour."""
INERTIA, DAMPING = "inertia", "damping"
"""Effects that a model at rest lacks where a robot rings."""
_FIRST = 0.56  # sqrt(EI / (m l^3)) of a rod that is clamped at one end: its first frequency [Hz]
_FADES = 0.1  # of a radian of its first oscillation: damping time where the file has none
_WIDE = 1.5  # relative sd of it
_GEOMETRY = ("length", "offset", "angle")
_MOST = 160  # robots of a batch
_KEPT = 20_000_000  # numbers of the orientations that are remembered, 160 MB: of 1,000 robots at 2,200 rows
_FITTED = 4  # candidates of a stage that are fitted
_NEAR = 3.0  # times what a state leaves: other numbers that promise to leave more are no way out
_PROMISING = 0.3  # of what the best promises: others are not fitted
_ITERATIONS, _TRIES, _REFINED = 6, 6, 3
_SHORTER = (0.15, 0.3, 0.5, 0.7)  # of the times at which a fit begins at rest
_LONGER = 1e-2, 5e-3, 2e-3  # s, steps of a fit where they tell the same motion
_SAME = 0.1  # of the noise, rms, by which they may differ
_QUICK = 2.0  # times the step of the fit, with which candidates are tried before the best are refined


class SideBySide:
    """Jobs that ask one thing for answers, one job at a time: each goes on until it has a question; when all
    have one, `answer` gets the questions of all, and they go on. A batch of rods takes little longer than one
    rod, and fits that do not depend on each other are moved in one batch so."""

    def __init__(self, answer: Callable[[dict[str, tuple[Robot, ...]]], None]) -> None:
        self._answer = answer
        self._questions: dict[str, tuple[Robot, ...]] = {}
        self._talk = threading.Condition()  # who holds it works; all others wait
        self._working, self._asking, self._round = 1, 0, 0
        self._failed: BaseException | None = None

    def each(self, jobs: Sequence[Callable[[], _T]]) -> list[_T]:
        """Return what each of the jobs does; a job may have jobs of its own. Raises what the first of them
        raised."""
        found, raised, left = dict[int, _T](), dict[int, BaseException](), len(jobs)

        def work(k: int) -> None:
            nonlocal left
            with self._talk:
                try:
                    found[k] = jobs[k]()
                except BaseException as error:
                    raised[k] = error
                left -= 1
                if left:
                    self._working -= 1
                    self._go_on()
                else:  # who waits for them works in place of the last one
                    self._talk.notify_all()

        with self._talk:
            self._working += left - bool(left)
            for k in range(len(jobs)):
                threading.Thread(target=work, args=(k,), daemon=True).start()
            try:
                self._talk.wait_for(lambda: not left)
            except BaseException:  # who runs this has stopped it
                self._answer = _stop
                raise
        if raised:
            raise raised[min(raised)]
        return [found[k] for k in range(len(jobs))]

    def ask(self, questions: dict[str, tuple[Robot, ...]]) -> None:
        """Return when they are answered. Raises what the answer raised."""
        with self._talk:
            self._questions |= questions
            self._working, self._asking, mine = self._working - 1, self._asking + 1, self._round
            self._go_on()
            self._talk.wait_for(lambda: self._round > mine)
            if self._failed is not None:
                raise self._failed

    def _go_on(self) -> None:
        """Answer, where nobody has more to ask."""
        if self._working or not self._asking:
            return
        try:
            self._failed = None
            self._answer(self._questions)
        except BaseException as error:
            self._failed = error
        self._working, self._asking, self._questions = self._asking, 0, {}
        self._round += 1
        self._talk.notify_all()


def _stop(_: object) -> None:
    raise KeyboardInterrupt


@dataclass(eq=False)
class MotionRod:
    """Rods in motion at the rows of `samples`, each robot once."""

    samples: LogSamples
    points: bool = False
    threads: int | None = None
    longest_step: float = LONGEST_STEP
    work: Work = field(default_factory=Work)
    of_modes: ClassVar[bool] = False
    _known: dict[str, PredictedPose] = field(default_factory=dict)
    _elsewhere: MotionRod | None = None

    def __post_init__(self) -> None:
        self.side_by_side = SideBySide(self._move)

    def at(self, samples: LogSamples, longest_step: float | None = None) -> MotionRod:
        """The same at other samples, or in other steps: the last such, where it was of these."""
        step = longest_step or self.longest_step
        for one in (self, self._elsewhere):
            same = one and one.longest_step == step and one.samples.log is samples.log
            if one and same and np.array_equal(one.samples.rows, samples.rows):
                return one
        self._elsewhere = MotionRod(samples, self.points, self.threads, step, self.work)
        return self._elsewhere

    def poses(self, robots: Sequence[tuple[Robot, ...]]) -> list[PredictedPose]:
        """Return what the camera sees of each of these robots, as it is in every session."""
        keys = [repr(each) for each in robots]
        while new := {key: each for key, each in zip(keys, robots, strict=True) if key not in self._known}:
            self.side_by_side.ask(new)
        found = [self._known[key] for key in keys]
        most = max(len(keys), 4 * _MOST, _KEPT // found[0].rotation.size) if found else 0
        for key in list(self._known)[: max(len(self._known) - most, 0)]:
            del self._known[key]  # the first that were moved
        return found

    def _move(self, robots: dict[str, tuple[Robot, ...]]) -> None:
        replay = MotionReplay(self.samples, self.points, self.longest_step, self.threads, self.work)
        for keys, batch in _batches(robots):
            self._known |= zip(keys, replay.poses(batch), strict=True)


def _batches(robots: dict[str, tuple[Robot, ...]]) -> Iterator[tuple[list[str], list[tuple[Robot, ...]]]]:
    """Robots that may move side by side: with the same effects, neutral where one has none, and the same
    geometry, which effects need; those whose effects go by what the rod does, which takes longer, apart."""
    some = any(every[0].effects for every in robots.values())
    alike: dict[object, list[str]] = {}
    for key, (robot, *_) in robots.items():
        slow = tuple(name for name in named_effects(robot) if _follows(name))
        alike.setdefault((slow, _geometry(robot) if some else None), []).append(key)
    for keys in alike.values():
        names = {name for key in keys for name in named_effects(robots[key][0])}
        order = [name for name in effect_names() if name in names]
        for first in range(0, len(keys), _MOST):
            batch = keys[first : first + _MOST]
            yield batch, [tuple(_with_effects(robot, order) for robot in robots[key]) for key in batch]


def _follows(name: str) -> bool:
    what = get_effect(name)
    return reads_bend(what) or reads_tension(what)


def _geometry(robot: Robot) -> tuple[object, ...]:
    """Return how tendons bend the robot; forces do by its stiffness, too."""
    return tuple(
        (s.length, robot.by_tension and s.bending_stiffness, *((t.offset, t.angle) for t in s.tendons))
        for s in robot.segments
    )


def _moves_geometry(model: Model) -> bool:
    names = {*_GEOMETRY, "bending_stiffness"} if model.robot.by_tension else _GEOMETRY
    return any(u.place[0] == "robot" and u.place[1] in names for u in model.unknowns)


def _with_effects(robot: Robot, names: Sequence[str]) -> Robot:
    tables = named_effects(robot)
    return replace(robot, effects=tuple({"name": name, **tables.get(name, {})} for name in names))


class RodInertia:
    """The rod has inertia: it rings after its inputs have changed, or after it was let go.

    Equation: rho A r_tt = n_s + f, d(rho I w)/dt = m_s + r_s x n, with the masses of lumps and payload
    Symbols: rho A line_density, r position, n and m force and moment in the rod, f loads, w rate of rotation
    Source: Till, Aloi and Rucker 2019, Real-time dynamics of soft and continuum robots
    Residual signature: an oscillation that begins where inputs change or the tip is let go, and dies
    """


class KelvinVoigtDamping:
    """The material resists the rate of its strain (Kelvin-Voigt), and so an oscillation dies.

    Equation: m = EI (kappa + tau kappa_t), likewise torsion, stretch and shear
    Symbols: tau damping_time, EI stiffness, kappa curvature
    Source: Linn, Lang and Tuganov 2013, Geometrically exact Cosserat rods with Kelvin-Voigt type viscous
    damping
    Residual signature: without it the oscillation would go on
    """


class MotionModel:
    """The model `model` at `theta` in motion, and all models near it; as `LinearisedModel` is at rest, but
    exact everywhere."""

    def __init__(
        self, model: Model, theta: Floats, samples: LogSamples, rod: MotionRod, target: Target
    ) -> None:
        self.model = model
        self.theta = theta.copy()
        self.samples = samples
        self.rod = rod
        self.target = target

    @cached_property
    def pose(self) -> PredictedPose:
        """Return what the camera sees."""
        return self.rod.poses([self.model.in_sessions(self.theta)])[0]

    def under(self, target: Target) -> MotionModel:
        """The same, weighed otherwise."""
        made = copy(self)
        made.target = target
        return made

    def is_light(self, _: str) -> bool:
        """Whether an effect needs no rod to be solved: here every one does, and the fit has done it."""
        return True

    def residual(self, model: Model, theta: Floats) -> Floats:
        """(n, n_out) weighted; infinite where no robot has these numbers, or it is lost on the way."""
        shape = (len(self.samples.rows), 3 + 3 * (self.target.rotation is not None))
        try:
            (pose,) = self.rod.poses([model.in_sessions(theta)])
        except RobotError:
            return np.full((shape[0], shape[1] + 3 * self.target.points.shape[1]), np.inf)
        found = self.target.residual(pose)
        return found if pose.ok[self.target.weight > 0.0].all() else np.full_like(found, np.inf)

    def slopes(self, model: Model, theta: Floats, residual: Floats, known: Floats | None = None) -> Floats:
        """(n, n_out, p) of the prediction, by differences; those by the first unknowns may be `known`, and
        are taken from there where robots of different geometry would not move side by side."""
        known = known if _moves_geometry(model) else None
        n_known = 0 if known is None else known.shape[-1]
        steps = _steps(model, theta)
        moved = (theta + np.diag(steps))[n_known:]
        self.rod.poses([model.in_sessions(each) for each in moved])
        every = [
            np.nan_to_num((residual - self.residual(model, each)) / step, posinf=0.0, neginf=0.0)
            for each, step in zip(moved, steps[n_known:], strict=True)
        ]
        own = np.stack(every, axis=-1) if every else np.zeros((*residual.shape, 0))
        return own if known is None else np.concatenate([known, own], axis=-1)

    def fit(self, model: Model, start: Floats, iterations: int, known: Floats | None = None) -> Fit:
        """The best parameters from `start` (p,) on, within limits and under priors; slopes by the first
        unknowns may be `known`. Tries and the slopes there are one batch."""
        first = known.shape[-1] if known is not None and _moves_geometry(model) else 0

        def move(thetas: Sequence[Floats]) -> None:
            robots = list[tuple[Robot, ...]]()
            for theta in thetas:
                with suppress(RobotError):  # a trial that is no robot is a worse one
                    moved = (theta + np.diag(_steps(model, theta)))[first:]
                    robots += [model.in_sessions(each) for each in (theta, *moved)]
            self.rod.poses(robots)

        def slopes(theta: Floats, r: Floats) -> Floats:
            return self.slopes(model, theta, r, known)

        residual = partial(self.residual, model)
        move([start])
        return minimise(residual, slopes, start, *model.prior, model.limits, iterations, _TRIES, move)


@dataclass(frozen=True, eq=False)
class MotionSearch(Search):
    """The search beside rods in motion. Alternative patterns are not asked for: they take slopes by the rod's
    inputs."""

    rod: MotionRod  # type: ignore[assignment]
    in_motion: ClassVar[bool] = True
    drawn: ClassVar[float] = 2.0  # here a fit goes all the way, and few candidates are fitted

    def predict(self, model: Model, theta: Floats, samples: LogSamples) -> PredictedPose:
        """Return what the camera sees at the rows of `samples`."""
        return self.rod.at(samples).poses([model.in_sessions(theta)])[0]

    def at(self, samples: LogSamples, _: Robot) -> Search:
        """The same at other samples of the robot, weighed as here; its target stays that of these."""
        return replace(self, samples=samples, rod=self.rod.at(samples), block=blocks_of(len(samples.rows)))

    def weighed(self, state: ModelState, noise: Floats) -> tuple[Search, ModelState]:
        """The state fitted again with weights of the size of its own residual, never below the `noise` (3,)
        [m], and the search with these."""
        before = self.target.sigma
        size = max(rms(state.fit.residual), float((noise / before).max()))
        search = replace(self, target=self.target.weighed(before * size, noise))
        linearised = state.linearised.under(search.target)
        fit = linearised.fit(state.model, state.theta, _ITERATIONS, state.fit.slopes / size)
        return search, search._state(state.model, linearised, fit, ())

    def refined(self, state: ModelState, iterations: int = _REFINED, *, borrow: bool = False) -> ModelState:
        """The state at the step of the fit, where it is not there yet; its slopes are good enough (`borrow`
        or not)."""
        if (borrow and not iterations) or cast(MotionModel, state.linearised).rod is self.rod:
            return state
        linearised = self._near(state.model, state.theta)
        fit = linearised.fit(state.model, state.theta, iterations, state.fit.slopes)
        return self._state(state.model, linearised, fit, ())

    def _near(self, model: Model, theta: Floats) -> LinearisedModel:
        return cast(LinearisedModel, MotionModel(model, theta, self.samples, self.rod, self.target))

    def names(self, state: ModelState) -> list[str]:
        """Effects that may be tried; none that goes by where the tip is, whose balance a step does not
        solve."""
        return [name for name in super().names(state) if not trait(get_effect(name), "feels_tip")]

    def _tried(self, state: ModelState, names: Sequence[str]) -> list[Candidate]:
        """The candidates that promise most, fitted; of the others, that they promise too little. Where a fit
        has drawn a number of the robot far from its file, those that promise most from there, too."""
        models = {name: state.model.with_effect(name) for name in names}
        here, worth = self._promising(state, models)
        jobs = [(name, partial(self.candidate, here, name)) for name in worth]
        if (nominal := self._nominal(here)) is not None:
            given = self._state(state.model, nominal, nominal.fit(state.model, nominal.theta, 0), ())
            there, worth = self._promising(given, models, _NEAR * state.fit.loss)
            jobs += [(name, partial(self._anew, here, there.linearised, name)) for name in worth]
        found = dict[str, Candidate]()
        for (name, _), one in zip(jobs, self._each(here, [job for _, job in jobs]), strict=True):
            if name not in found or (one.passes and distinct(one, found[name])):
                found[name] = one
        n, few = len(state.model.unknowns), "it promises too little"
        return [found.get(name) or unfitted(name, few, len(models[name].unknowns) - n) for name in names]

    def _promising(
        self, state: ModelState, models: Mapping[str, Model], most: float | None = None
    ) -> tuple[ModelState, list[str]]:
        """The state with rods that have been at every start of these models, and those that promise most.
        Where `most` is given the state is at no minimum, and they must promise to leave no more loss."""
        self.report("what each does")
        starts = {name: _starts(state, model, name) for name, model in models.items()}
        trials = list[tuple[Model, Floats]]()
        for name, model in models.items():
            sizes, thetas = grown(state, model)
            for start in starts[name]:
                without = (np.where(np.arange(len(start)) == j, model.unknowns[j].mean, start) for j in sizes)
                thetas += [start, *without]
            trials += [(model, theta) for theta in thetas]
        state = replace(state, linearised=self._ahead(state, trials))
        loss, size, n = state.fit.loss, state.fit.residual.size, len(state.model.unknowns)
        promise = {
            name: max(self._promise(state, models[name], start, most is None) for start in every)
            for name, every in starts.items()
        }
        first = sorted(promise, key=lambda name: -promise[name])[:_FITTED]
        # of the loss: what the evidence asks of each number that a candidate adds
        price = {name: (len(models[name].unknowns) - n) * np.log(size) / size * loss for name in first}
        least = max(_PROMISING * max(promise.values(), default=0.0), loss - (most or np.inf))
        return state, [name for name in first if promise[name] > max(least, price[name])]

    def _ahead(self, state: ModelState, trials: Sequence[tuple[Model, Floats]]) -> LinearisedModel:
        """All of them moved in one batch, in longer steps."""
        quick = self.rod.at(self.samples, _QUICK * self.rod.longest_step)
        quick.poses([model.in_sessions(theta) for model, theta in trials])
        near = MotionModel(state.model, state.theta, self.samples, quick, self.target)
        return cast(LinearisedModel, near)

    def _each(self, state: ModelState, jobs: Sequence[Callable[[], _T]]) -> list[_T]:
        return cast(MotionModel, state.linearised).rod.side_by_side.each(jobs)

    def _promise(self, state: ModelState, model: Model, theta: Floats, settled: bool = True) -> float:
        with np.errstate(invalid="ignore"):
            found = super()._promise(state, model, theta, settled)
        return found if np.isfinite(found) else 0.0


def _starts(state: ModelState, model: Model, name: str) -> list[Floats]:
    """Return where fits begin: as at rest, and at shorter times, for a rod that rings has minima half a
    period apart."""
    every, n = starts_of(state, model, name), len(state.model.unknowns)
    timed = [j for j, u in enumerate(model.unknowns) if j >= n and u.unit == "s"]
    for start in every[:] if timed else []:
        for fraction in _SHORTER:
            shorter = start.copy()
            for j in timed:
                u = model.unknowns[j]
                shorter[j] = np.clip(u.outside(fraction * u.inside(float(start[j]))), *u.limits)
            every.append(shorter)
    return every


def fit_motion(
    samples: LogSamples,
    model: Model,
    robot: Robot,
    excluded: frozenset[str] = frozenset(),
    *,
    threads: int | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> BaseFit:
    """The unknowns of `model` fitted at the rows of `samples`, in motion; those that this log cannot see stay
    nominal, with the reason. Raises `LogError` where the robot as given is lost on the way."""
    points = samples.log.points is not None and bool(robot.log_points)
    report("motion as given")
    whole = MotionRod(samples, points, threads)
    (pose,) = whole.poses([model.in_sessions(model.start)])
    if not pose.ok.all():
        k = int(samples.rows[np.flatnonzero(~pose.ok)[0]])
        run = str(samples.log.run[k]) or samples.log.name
        raise LogError(
            f"the robot as given is lost in motion in run {run!r}, {samples.time[k]:.3g} s after its start; "
            "is a mass, a stiffness or a damping_time far off?"
        )
    target = target_of(samples, np.full(3, 1e-3 * robot.length), rotation_sigma=ANGLE, points=points)
    left = target.tip - pose.position
    noise = _noise(samples, robot, left)
    # steps as long as the robot of the file allows
    for step in sorted({min(step, samples.step) for step in _LONGER if samples.step > LONGEST_STEP})[::-1]:
        longer = whole.at(samples, step)
        (other,) = longer.poses([model.in_sessions(model.start)])
        if other.ok.all() and rms((other.position - pose.position) / noise.sigma) < _SAME:
            whole = longer
            break
    theta, fixed, every = model.start, dict[str, Estimate](), model
    for k, horizon in enumerate(HORIZONS):
        report(f"fit in motion, {100 * horizon:.0f} % of each run")
        within = samples.on(samples.rows[_begun(samples, horizon)])
        good = keep(samples, left, noise)
        mine = np.isin(samples.rows, within.rows)
        own = target_of(within, target.sigma, rotation_sigma=ANGLE, points=points)
        own = replace(own, weight=good[mine].astype(float))
        rod = whole if horizon == 1.0 else whole.at(within)
        if k == len(HORIZONS) - 2:  # what the whole log shows
            at = MotionModel(every, theta, within, rod, own.weighed(noise.sigma, noise.sigma))
            fixed = _unseen(at, every, theta)
            seen = [u.name not in fixed for u in every.unknowns]
            model, theta = replace(every, unknowns=_those(every.unknowns, seen)), theta[seen]
        own = _weighed(own, noise, left[mine][good[mine]])
        fit = MotionModel(model, theta, within, rod, own).fit(model, theta, 10)
        theta = fit.theta
        (pose,) = whole.poses([model.in_sessions(theta)])
        left = np.where(pose.ok[:, None], target.tip - pose.position, left)
        noise = _noise(samples, robot, left)
    out = int((own.weight == 0.0).sum())
    notes = (f"{out} of {len(samples.rows)} rows are outliers and do not count",) if out else ()
    moved = MotionSearch(samples, whole, own, blocks_of(len(samples.rows)), excluded, noise.sigma)
    search, state = moved.weighed(moved._state(model, moved._near(model, theta), fit, ()), noise.sigma)
    return BaseFit(robot=robot, search=search, noise=noise, start=state, fixed=fixed, notes=notes)


def damped(robot: Robot) -> Robot:
    """A robot whose damping is to be fitted, from what is usual where its file has none."""
    mass = sum(s.line_density * s.length for s in robot.segments)
    soft = min(min(s.bending_stiffness) for s in robot.segments)
    usual = _FADES / (2.0 * np.pi * _FIRST * np.sqrt(soft / (mass * robot.length**3)))
    segments = tuple(replace(s, damping_time=s.damping_time or float(usual)) for s in robot.segments)
    target = "segment.*.damping_time"
    middle = float(np.mean([s.damping_time for s in segments]))
    return replace(
        robot, segments=segments, fit={target: {"sd": _WIDE * middle, "shared": True}, **robot.fit}
    )


def undamped(state: ModelState) -> ModelState:
    """The same without damping, nothing fitted again."""
    segments = tuple(replace(s, damping_time=0.0) for s in state.model.robot.segments)
    kept = [u.place[1] != "damping_time" for u in state.model.unknowns]
    model = replace(
        state.model,
        robot=replace(state.model.robot, segments=segments),
        unknowns=_those(state.model.unknowns, kept),
    )
    theta = state.theta[np.array(kept, dtype=bool)]
    return replace(state, model=model, fit=replace(state.fit, theta=theta))


def _steps(model: Model, theta: Floats) -> Floats:
    high = model.limits[1]
    steps = np.array([1e-3 if u.log else _STEP * u.scale for u in model.unknowns])
    return np.where(theta + steps > high, -steps, steps)


def _weighed(target: Target, noise: Noise, left: Floats) -> Target:
    """Weights of the size of what is left (n, 3) [m], never below the noise."""
    size = max(1.0, rms(left / noise.sigma))
    return target.weighed(noise.sigma * size, noise.sigma)


def _noise(samples: LogSamples, robot: Robot, left: Floats) -> Noise:
    """Noise of the fast part of a residual (n, 3) [m]: inputs that rest are no rest of a rod that rings."""
    found = read_noise(samples, left, left)
    given = robot.sensor.get("noise", 0.0)
    declared = float(max(given) if isinstance(given, tuple) else given)
    if declared > 0.0:
        return Noise(np.full(3, declared), found.lag1, "the robot file's [sensor] noise")
    return found


def _begun(samples: LogSamples, fraction: float) -> Flags:
    """(n_rows,) rows in the first `fraction` of what is looked at of their run."""
    rows, inside = samples.rows, np.zeros(len(samples.rows), bool)
    for span in samples.runs:
        mine = (rows >= span.start) & (rows < span.stop)
        end = fraction * samples.time[rows[mine]].max(initial=0.0)
        inside |= mine & (samples.time[rows] <= end)
    return inside


def _those(unknowns: tuple[Unknown, ...], which: list[bool]) -> tuple[Unknown, ...]:
    return tuple(u for u, keep_it in zip(unknowns, which, strict=True) if keep_it)


def _unseen(at: MotionModel, model: Model, theta: Floats) -> dict[str, Estimate]:
    """Unknowns whose prior this log does not narrow, at the noise."""
    if not model.unknowns:
        return {}
    J = at.slopes(model, theta, at.residual(model, theta))
    flat, (_, sd) = J.reshape(-1, J.shape[-1]), model.prior
    spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(flat.T @ flat + np.diag(1.0 / sd**2))), 0.0))
    return {
        u.name: Estimate(
            value=u.start if u.place[0] == "robot" else u.mean,
            stderr=float(prior),
            unit=u.unit,
            identifiable=False,
            why=advice.why_unknown(u.name, at.samples, model.robot),
            prior_sd=float(prior),
        )
        for u, narrowed, prior in zip(model.unknowns, spread, sd, strict=True)
        if narrowed > SEEN * prior
    }
