"""TubeInsert: feed a soft rod into a curved tube without pressing on its wall."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, ClassVar, final

import numpy as np

from fastrod.contact import ContactScene, mesh
from fastrod.errors import InputError
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.model.segment_actions import SegmentActions
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Flags, Floats, Ints
from fastrod_envs.options import EnvOptions
from fastrod_envs.randomisation import Randomisation
from fastrod_envs.task import Backdrop, Ball, Field, Outcome, Solid, Task, Tube, length, shortened

SEGMENT = 0.04
"""Length of each of the two segments [m]."""
BODY = 0.002
"""Radius of the rod [m]."""
STIFFNESS = 1e-3
"""EI [N m^2]."""
OFFSET = 0.0015
"""Offset of the tendons from the backbone [m]."""
STRAIGHT, BEND_RADIUS, ANGLE = 0.015, 0.07, math.radians(60.0)
"""The tube: length before the turn [m], radius of the turn of its middle [m], and by how much it turns
[rad]."""
LUMEN, WALL = 0.0055, 0.003
"""Radius inside, and thickness [m]."""
FLARE, MOUTH = 0.006, 0.012
"""The mouth is wider by so much, and over such a depth [m]."""
OUTSIDE = 0.003
"""Between tip and mouth when an episode begins [m]."""
FORCE = 0.3
"""Sum of the forces on the wall that does no harm [N]; twice as much ends the episode."""
SHALLOWEST, DEEPEST = 0.03, 0.07
"""Goals, along the middle from the mouth [m]."""
ASIDE = 0.0025
"""The rod's axis misses the mouth's middle by up to so much in x and in y [m]."""
LAG = 0.006
"""The baseline bends a segment as the tube does so far behind its end: one that is half in the turn bends
outside of it too [m]."""
GAIN = 20.0
"""Gain of the baseline: bend of the outer segment per distance of the tip from the tube's middle [rad/m]."""
NEAR = 0.05
"""Errors are observed up to this length [m]."""
PATIENCE = 5
"""Steps in a row without a solution after which a robot is lost."""
_ANEW = 2  # steps in a row without one after which it settles anew, where that leaves it in the tube
SUBSTEPS = 16
"""Steps of the simulator on the way to a displacement."""
_BENDS = (1, 2, 4, 5)
LIMIT = np.array([(-0.8 * OFFSET, 0.8 * OFFSET)] * 4 + [(0.0, OUTSIDE + 2.0 * SEGMENT)])
"""(5, 2) ranges of the displacements of the tendons, two a segment, and of the feed [m]."""
RATE = np.array([0.4 * OFFSET] * 4 + [0.02])
"""(5,) their largest rates [m/s]."""
_SECTORS, _RINGS, _FILLET = 24, 12, 8


def thin_robot() -> Robot:
    """Two weightless segments along z, three tendons each."""
    segments = tuple(
        Segment(
            length=SEGMENT,
            bending_stiffness=(STIFFNESS, STIFFNESS),
            torsional_stiffness=STIFFNESS,
            body_radius=BODY,
            tendons=tuple(
                Tendon(offset=OFFSET, angle=2.0 * math.pi * (j / 3 + k / 6), compliance=1e-5)
                for j in range(3)
            ),
        )
        for k in range(2)
    )
    return Robot(name="probe", segments=segments, base_position=(0.0, 0.0, -2.0 * SEGMENT - OUTSIDE))


@final
class TubeInsert(Task):
    """Feed a rod of two bending segments into a curved tube until its tip is at a given depth, and do not
    press on the wall.

    The tube stands still: the middle of its mouth is the origin, it runs along z for 15 mm and then turns by
    60 degrees toward x on a radius of 70 mm. It is 11 mm wide inside, the rod 4 mm; nothing rubs. The base
    moves along z (feed, up to 0.02 m/s), and each of the two segments of 40 mm bends both ways (0.8 rad at
    most, 0.4 rad/s). Drawn for every episode: the goal's depth along the tube's middle, 30 to 70 mm; the roll
    of robot and base about z, any; and by how much the rod's axis misses the mouth's middle, up to 2.5 mm in
    x and in y. What is observed and done is in the robot's own axes, seen from the mouth's middle; of the
    contacts only the wrench at the base is felt. F is the sum of the sizes of all forces on the wall.

    Reward a step: exp(-d / 0.02 m), d the tip's distance from the goal [m]; -(F - 0.3 N) / 0.3 N, at most -1,
    where F is beyond
    0.3 N; -10 where it is beyond 0.6 N, which ends the episode, failed. Success: d below 5 mm, and F never
    beyond 0.3 N in the episode. An episode has 50 steps of 100 ms, and may end before by force, or when a
    robot's shape was not found 5 times in a row (it stays where it was; from the third time on it settles
    anew, if it is in the tube then). With difficulty 0 the goal is 30 mm deep, the rod is in the middle and
    not rolled.
    `action="displacement"` goes there in 16 equal parts, one after the other. Baseline: each segment bent as
    the tube is at its place, the outer one also against the tip's distance from the middle; constant feed
    that slows down over the last 10 mm.
    """

    name = "TubeInsert"
    n_steps: ClassVar[int] = 50
    n_draws: ClassVar[int] = 4
    accuracy: float = 0.005
    dt = 0.1

    def __init__(self, n_envs: int, options: EnvOptions) -> None:
        super().__init__(n_envs, options)
        self._random = Randomisation.of(options.randomise)
        self.base_robot = thin_robot() if self._random is None else self._random.base(thin_robot())
        if abs(self.base_robot.length - 2.0 * SEGMENT) > 1e-9:
            raise InputError(
                f"robot {self.base_robot.name!r} is {self.base_robot.length:g} m long; "
                f"TubeInsert's is {2.0 * SEGMENT:g} m."
            )
        self._varies = self._random is not None and self._random.n_draws > 0
        if self._varies and self._random is not None:
            self.total_draws = self.n_draws + self._random.n_draws
        by_bend = SegmentActions(self.base_robot).matrix[: self.base_robot.n_tendons]
        self._by_bend = by_bend[:, list(_BENDS)]
        self.simulator = Simulator(
            [self.base_robot] * n_envs if self._varies else self.base_robot,
            n_robots=n_envs,
            dt=self.dt,
            points_per_segment=10,
            threads=options.threads,
            contact=ContactScene(obstacles=[mesh(tube_mesh(), name="tube")], max_iterations=250),
        )
        self._set_fields()
        self.displacement: Floats = np.zeros((n_envs, 5))
        """(n_envs, 5) of the tendons, two a segment, and the feed [m]."""
        self.roll: Floats = np.zeros((n_envs, 2))
        """(n_envs, 2) cosine and sine of the robot's roll about z."""
        self.roll[:, 0] = 1.0
        self.aside: Floats = np.zeros((n_envs, 2))
        """(n_envs, 2) of the rod's axis from the mouth's middle, world [m]."""
        self.depth: Floats = np.zeros(n_envs)
        """(n_envs,) of the goal [m]."""
        self.tip: Floats = np.zeros((n_envs, 3))
        """(n_envs, 3) world [m]."""
        self.direction: Floats = np.zeros((n_envs, 3))
        """(n_envs, 3) of the tip's d3, world."""
        self.wrench: Floats = np.zeros((n_envs, 6))
        """(n_envs, 6) on the base, world [N, N m]."""
        self.force: Floats = np.zeros(n_envs)
        """(n_envs,) largest sum of the forces on the wall in the last step [N]."""
        self.largest: Floats = np.zeros(n_envs)
        """(n_envs,) the same of the whole episode [N]."""
        self.failed: Ints = np.zeros(n_envs, np.int64)
        """(n_envs,) steps of the episode without a solution."""
        self._in_a_row: Ints = np.zeros(n_envs, np.int64)
        self.simulator.settle(**self._inputs())
        self._home = self.simulator.snapshot()

    def _set_fields(self) -> None:
        rate = self.options.action == "rate"
        low, high = (-RATE, RATE) if rate else LIMIT.T
        unit, word = ("m/s", "rate of the ") if rate else ("m", "")
        self.actions = (
            Field(
                "displacement",
                unit,
                tuple(low[:4]),
                tuple(high[:4]),
                f"{word}displacements (1a, 1b, 2a, 2b: toward d1, d2)",
            ),
            Field("feed", unit, tuple(low[4:]), tuple(high[4:]), f"{word}base along z"),
        )
        one, two, three = (1.0,), (1.0,) * 2, (1.0,) * 3
        far = tuple(0.2 * v for v in three)
        self.goals = (
            Field(
                "depth",
                "m",
                (SHALLOWEST,),
                (DEEPEST,),
                "where the tip is to be, along the tube's middle from its mouth",
            ),
            Field("turn", "", tuple(-v for v in two), two, "where the tube turns to, toward d1 and d2"),
            Field(
                "aside",
                "m",
                (-2.0 * ASIDE,) * 2,
                (2.0 * ASIDE,) * 2,
                "of the rod's axis from the mouth's middle, along d1 and d2",
            ),
        )
        self.states = (
            *self.goals,
            Field(
                "tip",
                "m",
                tuple(-v for v in far),
                far,
                "where it is measured, from the mouth's middle, robot's axes",
            ),
            Field("direction", "", tuple(-v for v in three), three, "of the tip's tangent, robot's axes"),
            Field(
                "error",
                "m",
                (-NEAR,) * 3,
                (NEAR,) * 3,
                f"from tip to goal, at most {NEAR:g} m of it, robot's axes",
            ),
            Field("station", "m", (-0.2,), (0.2,), "depth of the tip along the tube's middle"),
            Field(
                "away",
                "m",
                (-NEAR,) * 2,
                (NEAR,) * 2,
                "of the tip from the tube's middle: in the plane of the turn, outward, and across",
            ),
            Field(
                "force",
                "N",
                (-2.0 * FORCE,) * 3,
                (2.0 * FORCE,) * 3,
                "on the base, robot's axes, at most so much",
            ),
            Field("moment", "N m", (-0.1,) * 3, (0.1,) * 3, "on the base, robot's axes, at most so much"),
            Field(
                "posture",
                "",
                (-1.0,) * 4 + tuple(-v for v in one),
                (1.0,) * 5,
                "displacements and feed, from their least to their largest",
            ),
        )

    def begin(self, rows: Ints, draws: Floats) -> None:
        ease = self.difficulty
        self.depth[rows] = SHALLOWEST + ease * draws[:, 0] * (DEEPEST - SHALLOWEST)
        angle = ease * math.pi * (2.0 * draws[:, 1] - 1.0)
        self.roll[rows] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        self.aside[rows] = ease * ASIDE * (2.0 * draws[:, 2:4] - 1.0)
        self.displacement[rows] = 0.0
        self.simulator.restore(self._home, rows)
        if self._varies and self._random is not None:
            self.simulator.replace(rows, self._random.draw(self.base_robot, draws[:, self.n_draws :]))
        # straight and weightless: no need to ask the simulator, whose next step comes from there
        self.tip[rows, :2], self.tip[rows, 2] = self.aside[rows], -OUTSIDE
        self.direction[rows] = (0.0, 0.0, 1.0)
        self.wrench[rows] = 0.0
        self.force[rows] = self.largest[rows] = 0.0
        self.failed[rows] = self._in_a_row[rows] = 0

    def act(self, action: Floats) -> None:
        low, high = LIMIT.T
        if self.options.action == "rate":
            poses = [np.clip(self.displacement + self.dt * RATE * action, low, high)]
        else:
            end = 0.5 * (low + high) + 0.5 * (high - low) * action
            start = self.displacement
            poses = [start + (substep / SUBSTEPS) * (end - start) for substep in range(1, SUBSTEPS + 1)]
        self.force = np.zeros(self.n_envs)
        for there in poses:
            self._go(there)

    def _go(self, there: Floats) -> None:
        """One step of the simulator; who does not come there stays."""
        before, self.displacement = self.displacement, there
        state = self.simulator.step(**self._inputs())
        if (stuck := ~state.ok & (state.passes != 0) & (self._in_a_row >= _ANEW)).any():
            state = self._settled_anew(stuck)
        with np.errstate(invalid="ignore"):
            ok = state.ok & (np.abs(state.tip_position) < 1.0).all(1)
        each = ok[:, None]
        self.displacement = np.where(each, there, before)
        self.tip = np.where(each, state.tip_position, self.tip)
        self.direction = np.where(each, state.tip_rotation[:, :, 2], self.direction)
        self.wrench = np.where(each, state.base_wrench, self.wrench)
        self.force = np.where(ok, np.maximum(self.force, pressed(state)), self.force)
        self.largest = np.maximum(self.largest, self.force)
        self.failed = self.failed + ~ok
        self._in_a_row = np.where(ok, 0, self._in_a_row + 1)

    def _settled_anew(self, stuck: Flags) -> State:
        """These robots at rest on their inputs, wherever they stood: a rod snaps over from one wall to the
        other. One that would not be in the tube then stays where it was, as all others do."""
        sim = self.simulator
        before = sim.snapshot()
        sim.reset(stuck)
        state = sim.settle(**self._inputs())
        station, out, across = (a.reshape(self.n_envs, -1) for a in place(state.position.reshape(-1, 3)))
        within = (station > 0.0) & (station < STRAIGHT + BEND_RADIUS * ANGLE)
        beside = within & ~(np.hypot(out, across) < LUMEN)
        sim.restore(before, ~(stuck & state.ok & ~beside.any(1)))
        return sim.state

    @property
    def lost(self) -> Flags:
        """(n_envs,) whose shape was not found too often in a row."""
        return np.asarray(self._in_a_row >= PATIENCE)

    def outcome(self) -> Outcome:
        desired = middle(self.depth)
        d = length(self.tip - desired)
        beyond = self.force > 2.0 * FORCE
        terms = {
            "reach": np.exp(-d / 0.02),
            "force": -np.clip(self.force / FORCE - 1.0, 0.0, 1.0),
            "fail": np.where(beyond, -10.0, 0.0),
        }
        return Outcome(
            terms=terms,
            distance=d,
            success=(d < self.accuracy) & (self.largest <= FORCE) & ~self.lost,
            position=self.tip.copy(),
            desired=desired,
            terminated=beyond,
            contact=self.force > FORCE,
            lost=self.lost,
            facts={
                "force": self.force.copy(),
                "largest_force": self.largest.copy(),
                "failed": self.failed.astype(float),
            },
        )

    def state(self) -> Floats:
        seen = self.measured()
        station, out, across = place(seen)
        error = shortened(middle(self.depth) - seen, NEAR)
        own = [self._own(v) for v in (seen, self.direction, error)]
        felt = [self._own(self.wrench[:, :3]), self._own(self.wrench[:, 3:])]
        return np.concatenate(
            [self.goal(), *own, np.stack([station, out, across], axis=1), *felt, self.posture()], axis=1
        )

    def goal(self) -> Floats:
        spin = self.roll * (1.0, -1.0)
        aside = self._own(np.column_stack([self.aside, np.zeros(self.n_envs)]))[:, :2]
        return np.column_stack([self.depth, spin, aside])

    def posture(self) -> Floats:
        """(n_envs, 5) displacements from -1, the least, to 1, the largest."""
        low, high = LIMIT.T
        return np.asarray((2.0 * self.displacement - low - high) / (high - low))

    def measured(self) -> Floats:
        """(n_envs, 3) the tip as a camera on the base sees it, effects of sensing included, world [m]."""
        if not self.base_robot.effects:
            return self.tip
        seen = self.simulator.measure().tip_position
        c, s = self.roll.T
        root = self._inputs()["base_pose"][:, :3]
        p = root + np.stack(
            [c * seen[:, 0] - s * seen[:, 1], s * seen[:, 0] + c * seen[:, 1], seen[:, 2]], axis=1
        )
        return np.where(np.isfinite(p), p, self.tip)

    def baseline(self) -> Floats:
        station, out, across = place(self.measured())
        advance = np.clip((self.depth - station) / 0.01, -1.0, 1.0)
        ahead = self.displacement[:, 4] - OUTSIDE + self.dt * RATE[4] * advance
        outer, inner = heading(ahead - LAG), heading(ahead - SEGMENT - LAG)
        inside = np.clip(station / 0.01, 0.0, 1.0)
        inward = outer - inner + inside * out * GAIN
        sideways = -inside * across * GAIN
        c, s = self.roll[:, 0], -self.roll[:, 1]
        bends = [c * inner, s * inner, c * inward - s * sideways, s * inward + c * sideways]
        there = np.column_stack(
            [OFFSET * np.stack(bends, axis=1), self.displacement[:, 4] + self.dt * RATE[4] * advance]
        )
        low, high = LIMIT.T
        if self.options.action == "rate":
            return np.asarray(np.clip((there - self.displacement) / (self.dt * RATE), -1.0, 1.0))
        return np.asarray(np.clip((2.0 * there - low - high) / (high - low), -1.0, 1.0))

    def backdrop(self, i: int) -> Backdrop:
        vertices, faces = tube_mesh()
        return Backdrop(
            tubes=(Tube(self.simulator.state.position[i], BODY, (0.9, 0.55, 0.15)),),
            balls=(Ball(middle(self.depth[i : i + 1])[0], 0.003, (0.85, 0.2, 0.15)),),
            solids=(Solid(vertices, faces, (0.6, 0.7, 0.8), 0.35),),
            eye=(0.05, -0.22, 0.02),
            target=(0.01, 0.0, 0.01),
        )

    def _inputs(self) -> dict[str, Any]:
        tendons = np.zeros((self.n_envs, len(self._by_bend)))
        for j in range(4):  # term by term: a BLAS would sum otherwise for other numbers of robots
            tendons += self.displacement[:, j, None] * self._by_bend[:, j]
        pose = np.zeros((self.n_envs, 7))
        pose[:, :2], pose[:, 2] = self.aside, self.base_robot.base_position[2] + self.displacement[:, 4]
        half = 0.5 * np.arctan2(self.roll[:, 1], self.roll[:, 0])
        pose[:, 3], pose[:, 6] = np.cos(half), np.sin(half)
        return {"tendon_length": self.base_robot.rest_tendon_length + tendons, "base_pose": pose}

    def _own(self, vectors: Floats) -> Floats:
        """World vectors (n_envs, 3) along the robot's axes."""
        c, s = self.roll.T
        return np.stack(
            [c * vectors[:, 0] + s * vectors[:, 1], c * vectors[:, 1] - s * vectors[:, 0], vectors[:, 2]],
            axis=1,
        )


def pressed(state: State) -> Floats:
    """(n,) sum of the sizes of the forces on the wall [N]."""
    total = np.zeros(len(state.ok))
    if state.contacts is not None:
        # one after the other: the same bits, however many the others have
        for k in range(state.contacts.force.shape[1]):
            total += np.nan_to_num(length(state.contacts.force[:, k]))
    return total


def heading(depth: Floats) -> Floats:
    """(n,) angle between z and the tube's middle at these depths [rad]."""
    return np.clip((depth - STRAIGHT) / BEND_RADIUS, 0.0, ANGLE)


def middle(depth: Floats) -> Floats:
    """(n, 3) points of the tube's middle at these depths [m], straight on before and beyond."""
    angle, beyond = heading(depth), np.maximum(depth - STRAIGHT - BEND_RADIUS * ANGLE, 0.0)
    along = np.minimum(depth, STRAIGHT) + BEND_RADIUS * np.sin(angle) + beyond * math.cos(ANGLE)
    return np.stack(
        [BEND_RADIUS * (1.0 - np.cos(angle)) + beyond * math.sin(ANGLE), np.zeros(len(angle)), along], axis=1
    )


def place(points: Floats) -> tuple[Floats, Floats, Floats]:
    """Depth along the tube's middle of points (n, 3), and how far they are from it: in the plane of the turn,
    away from the turn's centre, and across, along y; each (n,) [m]."""
    x, z = points[:, 0] - BEND_RADIUS, points[:, 2] - STRAIGHT
    heading_angle = np.clip(np.arctan2(np.maximum(z, 0.0), -x), 0.0, ANGLE)
    c, s = np.cos(heading_angle), np.sin(heading_angle)
    return (
        STRAIGHT + BEND_RADIUS * heading_angle + (x * s + z * c),
        -(x * c) + z * s - BEND_RADIUS,
        points[:, 1],
    )


@lru_cache(maxsize=1)
def tube_mesh() -> tuple[Floats, Ints]:
    """(n_vertices, 3) [m] and (n_faces, 3) of the tube's wall, watertight, counter-clockwise seen from
    outside; do not write to them."""
    end = STRAIGHT + BEND_RADIUS * ANGLE
    round_ = np.linspace(0.0, 0.5 * np.pi, _FILLET)  # the mouth is rounded, for no edge to stand into the way
    depth = np.concatenate([MOUTH * (1.0 - np.cos(round_)), np.linspace(STRAIGHT, end, _RINGS)])
    inner = np.concatenate([LUMEN + FLARE * (1.0 - np.sin(round_)), np.full(_RINGS, LUMEN)])
    outer = np.full(len(depth), LUMEN + FLARE + WALL)
    # once around the wall's section: along the inside, and back along the outside
    rings = [*range(len(depth)), *range(len(depth) - 1, -1, -1)]
    radius = np.concatenate([inner, outer[::-1]])
    angle = 2.0 * np.pi * np.arange(_SECTORS) / _SECTORS
    heading_angle, centre = heading(depth)[rings], middle(depth)[rings]
    normal = np.stack([np.cos(heading_angle), np.zeros(len(rings)), -np.sin(heading_angle)], axis=1)
    across = np.array([0.0, 1.0, 0.0])
    vertices = centre[:, None] + radius[:, None, None] * (
        np.cos(angle)[None, :, None] * normal[:, None] + np.sin(angle)[None, :, None] * across
    )
    n = len(rings)
    corner = np.arange(n * _SECTORS).reshape(n, _SECTORS)
    a, b = corner, np.roll(corner, -1, axis=1)
    c, d = np.roll(a, -1, axis=0), np.roll(b, -1, axis=0)
    faces = np.concatenate([np.stack([a, c, b], -1).reshape(-1, 3), np.stack([b, c, d], -1).reshape(-1, 3)])
    vertices = vertices.reshape(-1, 3)
    vertices.flags.writeable = faces.flags.writeable = False
    return vertices, faces
