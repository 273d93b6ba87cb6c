"""`RodTask`: a task of rods alone, all of them robots of one simulator."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike

from fastrod.contact import ContactScene
from fastrod.control import scaled_rates
from fastrod.model.robot import Robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.rotation import matrix_from_quaternion
from fastrod.simulator import Simulator
from fastrod.solver.options import Observer, solver_of
from fastrod.types import Flags, Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.randomisation import Randomisation
from fastrod_envs.task import Field, Task, Tube

_FAR = 2.0  # of the robot's length: no tip is farther from its base


class RodTask(Task):
    """Robots driven by the displacements of their segments (`SegmentActions`): all at home when an episode
    begins.

    `action="rate"`: an action is the displacements' rate, as a part of the largest; one observer pass a step.
    `"displacement"`: it is where they go, at once, from the least to the largest, and the rod settles there.
    """

    points_per_segment: int
    outputs: ClassVar[Any] = "tip"
    kept_jacobian_tolerance: float = 5e-5
    """`Observer(kept_jacobian_tolerance=...)` [m]."""
    loaded: ClassVar[bool] = False
    """An episode brings loads of its own: robots settle under them when it begins."""
    on_gpu: ClassVar[bool] = True

    def __init__(
        self,
        n_envs: int,
        options: EnvOptions,
        robot: Robot,
        *,
        driven: ArrayLike,
        limit: ArrayLike,
        rate: ArrayLike,
        home: ArrayLike | None = None,
        contact: ContactScene | None = None,
        feel_contact: bool = True,
    ) -> None:
        """`driven` are the driven numbers among the robot's 3 n_segments, `limit` (n_driven, 2) their range
        [m], `rate` (n_driven,) [m/s] their largest rate, `home` (n_driven,) where they begin [m]. `contact`
        and `feel_contact` as in `Simulator`."""
        super().__init__(n_envs, options)
        self._random = Randomisation.of(options.randomise)
        self.base_robot = robot if self._random is None else self._random.base(robot)
        self._varies = self._random is not None and self._random.n_draws > 0
        if self._varies and self._random is not None:
            self.total_draws = self.n_draws + self._random.n_draws
        self._actions = SegmentActions(self.base_robot)
        self.driven = np.asarray(driven, np.int64)
        self._low, self._high = np.asarray(limit, float).T
        self._rate = np.asarray(rate, float)
        self.home: Floats = np.zeros(len(self.driven)) if home is None else np.asarray(home, float)
        """(n_driven,) displacements at the start of an episode [m]."""
        rate_mode = options.action == "rate"
        unit, span = ("m/s", (-self._rate, self._rate)) if rate_mode else ("m", (self._low, self._high))
        about = "rate of the displacements" if rate_mode else "displacements"
        names = ", ".join(f"{k // 3 + 1}{'eab'[k % 3]}" for k in self.driven)
        self.actions = (
            Field(
                "displacement",
                unit,
                tuple(span[0]),
                tuple(span[1]),
                f"{about} ({names}: segment, and e extension, a, b toward d1, d2)",
            ),
        )
        robots = [self.base_robot] * n_envs if self._varies else [self.base_robot]
        self.simulator = Simulator(
            robots if self._varies else self.base_robot,
            n_robots=n_envs,
            dt=self.dt,
            points_per_segment=self.points_per_segment,
            outputs=self.outputs,
            threads=options.threads,
            contact=contact,
            solver=Observer(kept_jacobian_tolerance=self.kept_jacobian_tolerance)
            if isinstance(solver_of([self.base_robot]), Observer)
            else None,
            feel_contact=feel_contact,
            device=options.device,
        )
        self._base_rotation = matrix_from_quaternion(np.array([self.base_robot.base_quaternion]))[0]
        self._base_position = np.array(self.base_robot.base_position)
        self.displacement: Floats = np.tile(self.home, (n_envs, 1))
        """(n_envs, n_driven) [m]."""
        self.tip: Floats = np.zeros((n_envs, 3))
        """(n_envs, 3) world [m]."""
        self.direction: Floats = np.zeros((n_envs, 3))
        """(n_envs, 3) of the tip's d3, world."""
        self.lost: Flags = np.zeros(n_envs, bool)
        """(n_envs,) the simulator did not find the robot's shape."""
        self._drawn: Simulator | None = None
        self._model: Simulator | None = None
        state = self.simulator.settle(**self._inputs())
        self._home = self.simulator.snapshot()
        self._keep(state.tip_position, state.tip_rotation[:, :, 2], state.ok)
        self._home_tip, self._home_direction = self.tip[0].copy(), self.direction[0].copy()

    def loads(self) -> dict[str, Any]:
        """Return what the simulator is given besides tendons: loads, obstacles."""
        return {}

    def start(self, rows: Ints, draws: Floats) -> None:
        """Put these robots at home, made anew where they are randomised; `draws` as in `begin`."""
        self.displacement[rows] = self.home
        # of one that is lost from the start
        self.tip[rows], self.direction[rows] = self._home_tip, self._home_direction
        if self._varies and self._random is not None:
            self.simulator.replace(rows, self._random.draw(self.base_robot, draws[:, self.n_draws :]))
            state = self.simulator.settle(**self._inputs(), rows=rows)
        else:
            self.simulator.restore(self._home, rows)
            state = (
                self.simulator.settle(**self._inputs(), rows=rows) if self.loaded else self.simulator.state
            )
        self._keep(state.tip_position, state.tip_rotation[:, :, 2], state.ok, rows)

    def act(self, action: Floats) -> None:
        """Rates move the displacements within their range, in one step; displacements are settled to 1e-7 m.
        Then comes `moved`."""
        if self.options.action == "rate":
            self.displacement = np.clip(
                self.displacement + self.dt * self._rate * action, self._low, self._high
            )
            state = self.simulator.step(**self._inputs())
        else:
            self.displacement = 0.5 * (self._low + self._high) + 0.5 * (self._high - self._low) * action
            state = self.simulator.settle(**self._inputs(), tolerance=1e-7)
        self._keep(state.tip_position, state.tip_rotation[:, :, 2], state.ok)
        self.moved()

    def moved(self) -> None:
        """Hook after the robots have moved in a step: nothing."""

    def posture(self) -> Floats:
        """(n_envs, n_driven) displacements from -1, the least, to 1, the largest."""
        return np.asarray((2.0 * self.displacement - self._low - self._high) / (self._high - self._low))

    def measured(self) -> Floats:
        """(n_envs, 3) the tip as a camera sees it, effects of sensing included, world [m]."""
        if not self.base_robot.effects:
            return self.tip
        seen = self.simulator.measure().tip_position
        p = self._base_position + (
            seen[:, :1] * self._base_rotation[:, 0]
            + seen[:, 1:2] * self._base_rotation[:, 1]
            + seen[:, 2:] * self._base_rotation[:, 2]
        )
        return np.where(np.isfinite(p), p, self.tip)

    def jacobian(self) -> Floats:
        """(n_envs, 6, n_driven) d(tip position, rotation vector)/d(driven), world, by the `model`: rows 0 to
        2 per metre [m/m], 3 to 5 [rad/m]."""
        return self.by_driven(self.model().jacobian())

    def by_driven(self, jacobian: Floats) -> Floats:
        """(n_envs, m, n_driven) of derivatives (n_envs, m, n_tendons + n_segments) by tendon lengths and
        extensions, as `Simulator.jacobian` gives them."""
        return np.asarray(jacobian @ self._actions.matrix[:, self.driven])

    def toward(self, velocity: Floats, jacobian: Floats | None = None, weight: ArrayLike = 1.0) -> Floats:
        """(n_envs, n_actions) the action that moves the tips with these velocities (n_envs, m): damped
        resolved rates by `jacobian` (n_envs, m, n_driven), the rows of `RodTask.jacobian` that the velocities
        belong to; without one, m is 3 and they are those of the tips [m/s]. Numbers with a smaller `weight`
        (n_driven,) move less."""
        if jacobian is None:
            jacobian = self.by_driven(self.model().jacobian()[:, :3])
        scale = self._rate * np.asarray(weight)
        q = scale * scaled_rates(np.nan_to_num(jacobian) * scale, velocity, -self.posture())
        if self.options.action == "rate":
            return np.asarray(q / self._rate)
        there = self.displacement + self.dt * q
        return np.asarray((2.0 * there - self._low - self._high) / (self._high - self._low))

    def model(self) -> Simulator:
        """The simulator, or where effects act a model without them, at rest on the same commands: within a
        backlash nothing answers, and a Jacobian that says so would stay there."""
        if not self.base_robot.effects:
            return self.simulator
        if self._model is None:
            plain = replace(self.base_robot, effects=())
            self._model = Simulator(
                plain,
                n_robots=self.n_envs,
                points_per_segment=self.points_per_segment,
                outputs="tip",
                device=self.options.device,
            )
        self._model.settle(**self._inputs(), tolerance=1e-6)
        return self._model

    def tube(self, i: int) -> Tube:
        """Robot i, for pictures: its backbone is found again, where only tips are kept."""
        robot = self.simulator.robots[min(i, len(self.simulator.robots) - 1)]
        radius = robot.segments[0].body_radius or 0.01
        if self.outputs == "full":
            return Tube(self.simulator.state.position[i], radius, (0.9, 0.55, 0.15))
        if self._drawn is None:
            self._drawn = Simulator(self.base_robot, dt=self.dt, points_per_segment=8, threads=1)
        given = {
            name: a[i] if np.ndim(a) == 2 and len(a) == self.n_envs else a
            for name, a in self._inputs().items()
        }
        return Tube(self._drawn.settle(**given).position[0], radius, (0.9, 0.55, 0.15))

    def _inputs(self) -> dict[str, Any]:
        n_tendons = self.base_robot.n_tendons
        change, term = np.zeros((2, len(self._actions.matrix), self.n_envs))
        for k, q in zip(
            self.driven, self.displacement.T, strict=True
        ):  # term by term: a BLAS would sum otherwise for other numbers of robots
            np.multiply(self._actions.matrix[:, k, None], q, out=term)
            change += term
        return {
            "tendon_length": (self.base_robot.rest_tendon_length[:, None] + change[:n_tendons]).T,
            "extension": change[n_tendons:].T,
            **self.loads(),
        }

    def _keep(self, tip: Floats, direction: Floats, ok: Flags, rows: Ints | None = None) -> None:
        """Note where the tips of these robots are; those that are lost stay where they were last seen."""
        some = np.ones(self.n_envs, bool) if rows is None else np.isin(np.arange(self.n_envs), rows)
        with np.errstate(invalid="ignore"):
            sane = (np.abs(tip - self._base_position) < _FAR * self.base_robot.length).all(1) & np.isfinite(
                direction
            ).all(1)
        good = some & ok & sane
        self.tip = np.where(good[:, None], tip, self.tip)
        self.direction = np.where(good[:, None], direction, self.direction)
        self.lost = np.where(some, ~(ok & sane), self.lost)
