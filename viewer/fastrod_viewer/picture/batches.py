"""`Picture`: from states to poses, sizes and colours of instances."""

from __future__ import annotations

from typing import NamedTuple, final

import numpy as np

from fastrod.contact.contacts import Contacts
from fastrod.errors import InputError
from fastrod.model.compile import compile_robots
from fastrod.model.robot import Robot
from fastrod.rotation import matrix_from_quaternion
from fastrod.solver.state import State
from fastrod.types import Flags, Floats, Params
from fastrod_viewer.picture import palette
from fastrod_viewer.picture.arrows import arrows, frames
from fastrod_viewer.picture.curves import CurveSamples, Nodes, Sampler, along, nodes, pieces
from fastrod_viewer.picture.options import FINE, ViewOptions
from fastrod_viewer.picture.palette import Color, Colors, Range
from fastrod_viewer.picture.shapes import Instances, instances
from fastrod_viewer.worlds.world import DrawnRods

SLACK = 1e-3
"""A tendon that can go slack is drawn so at tensions below this fraction of EI/(d l); one that can push,
below minus that."""

_TENDON_RADIUS = 0.06  # of the smallest tendon offset
_PROBLEM = 0.65  # fraction of the warning in the colour of a robot that is not ok


def warned(color: Colors, bad: Flags) -> Colors:
    """(n_robots, ..., 3) colours, those of `bad` robots reddish."""
    if not bad.any():
        return color
    return np.where(
        bad.reshape(-1, *[1] * (color.ndim - 1)), palette.blend(color, palette.PROBLEM, _PROBLEM), color
    )


def smallest_offset(params: Params) -> float:
    """Smallest offset of all tendons from the backbone [m]; 0 without tendons."""
    distance = np.linalg.norm(params.offset, axis=-1)
    return float(distance[distance > 0.0].min(initial=np.inf)) if distance.any() else 0.0


@final
class Spacers:
    """Discs as wide as the body: one at the base, then about 1.6 body radii apart to the end of every
    segment, where one stands always."""

    def __init__(self, params: Params, radius: Floats, options: ViewOptions, n_steps: int) -> None:
        """`radius` (n_segments,) of the body [m]."""
        segment, fraction, width, thick, color = [0], [0.0], [1.15], [0.35], [palette.BASE]
        for k, (length, r) in enumerate(zip(params.length[0], radius, strict=True)):
            n = max(1, round(float(length / (1.6 * r))))
            segment += [k] * n
            fraction += [(i + 1) / n for i in range(n)]
            width += [1.0] * n
            thick += [0.14] * (n - 1) + [0.28]
            color += [palette.SPACER] * (n - 1)
            color.append(palette.segment_color(k) if options.color_by == "segment" else palette.SEGMENT_END)
        self._scale = np.stack([width, width, thick], axis=1) * radius[segment, None]
        self._color = np.array(color, np.uint8)
        self._sample = Sampler(n_steps, np.array(segment), np.array(fraction))

    def instances(self, rod: Nodes, bad: Flags) -> Instances:
        """(n_robots * n_discs) robot by robot, base first; of `bad` robots reddish."""
        at = self._sample(rod)
        shape = (*at.position.shape[:2], 3)
        color = warned(np.broadcast_to(self._color, shape), bad)
        return instances("disc", at.position, at.quaternion, np.broadcast_to(self._scale, shape), color)


@final
class TendonLines:
    """Lines of tendons at their offsets from the backbone, one for each segment that a tendon crosses."""

    def __init__(
        self, robot: Robot, params: Params, surface: Floats | None, n_steps: int, n_pieces: int
    ) -> None:
        """`surface` (n_segments,) [m]: so far from the backbone, as on the skin of the body; None: where they
        are. `n_pieces` a segment."""
        pairs = [(t, k) for t, end in enumerate(robot.tendon_segment) for k in range(int(end) + 1)]
        self.tendon, self.segment = np.array(pairs, np.int64).reshape(-1, 2).T
        """(n_crossings,) tendon, and segment that it crosses, of each chain."""
        self.n_pieces = n_pieces
        offset = params.offset[:, self.segment, self.tendon]
        if surface is not None:
            offset = offset * (surface[self.segment] / np.linalg.norm(offset, axis=-1))[..., None]
        self._offset: Floats = np.ascontiguousarray(offset)  # (1 or n_robots, n_crossings, 2)
        self._radius = _TENDON_RADIUS * smallest_offset(params)
        self._small = SLACK * params.tension_scale[:, None]
        # the reduced model of the paper has no tensions: it knows of no slack
        self._unilateral = params.unilateral & (robot.segments[0].mode != "paper")
        ends = np.linspace(0.0, 1.0, n_pieces + 1)
        n = robot.n_segments
        self._sample = Sampler(n_steps, np.repeat(np.arange(n), len(ends)), np.tile(ends, n))
        self._n_segments = n

    def instances(self, rod: Nodes, tension: Floats, ok: Flags, colors: Range | None) -> Instances:
        """(n_robots * n_crossings * n_pieces) of `tension` (n_robots, n_tendons) [N], coloured by it within a
        range, which grows with the tensions of robots that are `ok`, or None: by taut, slack and pushing.
        What is not known, nan, is taut."""
        line = pieces(self._sample(rod), self._n_segments, self.segment, self._offset)
        # the arc over the chord, so that a chain is as long as its tendon
        length = line.length * (1.0 + line.bend**2 / 24.0)
        slack = self._unilateral & (tension <= self._small)
        thick = np.where(slack, 0.6 * self._radius, self._radius)[:, self.tendon, None]
        thick = np.broadcast_to(thick, length.shape)
        if colors is None:
            kind = np.where(slack, 1, np.where(~self._unilateral & (tension < -self._small), 2, 0))
            color = np.array([palette.TAUT, palette.SLACK, palette.PUSHING], np.uint8)[kind]
        else:
            known = np.where(np.isfinite(tension), tension, 0.0)
            color = palette.diverging(known, colors.see(known[ok]))
        color = np.broadcast_to(color[:, self.tendon, None], (*length.shape, 3))
        return instances(
            "thin_tube", line.centre, line.quaternion, np.stack([thick, thick, length], axis=-1), color
        )


_SLENDER = 0.45  # of the smallest tendon offset
_ARROW = 0.3  # of the robot's length
_FAR = 1e6  # m, 1/m; beyond it a pose is as good as none


class _Pose(NamedTuple):
    position: Floats
    """(n_robots, n_points, 3) [m]."""
    rotation: Floats
    """(n_robots, n_points, 3, 3)"""
    arclength: Floats
    """(n_robots, n_points) [m]."""
    curvature: Floats
    """(n_robots, n_points, 3) [1/m]."""


@final
class Picture:
    """Robots of one simulator as batches of instances, as many from frame to frame.

    >>> import fastrod
    >>> robot = fastrod.load_robot("prototype")
    >>> state = fastrod.Simulator(robot).settle(robot.rest_tendon_length)
    >>> rods = DrawnRods((robot,), state, np.zeros((1, 3)), (0.012,))
    >>> batches = Picture(rods).frame(rods)
    >>> len(batches["body"].position), batches["tip"].position.round(3) + 0.0
    (40, array([[0.  , 0.  , 0.07]], dtype=float32))
    """

    def __init__(self, rods: DrawnRods, options: ViewOptions | None = None) -> None:
        """Robots, their number and nodes, and whether there is contact, are those of `rods`. Raises
        `InputError` on a state without the rod (`outputs="tip"`)."""
        self.options = options = options or ViewOptions()
        robot, state = rods.robots[0], rods.state
        if not state.position.size:
            raise InputError("the state holds the tip only; a picture needs Simulator(..., outputs='full').")
        self.n_robots, self.n_segments = len(state.ok), robot.n_segments
        n_steps = (state.position.shape[1] - 1) // self.n_segments
        _, params, _ = compile_robots(rods.robots, n_steps)
        radius = np.array(rods.radius, float)
        self.body_radius: Floats = np.where(radius > 0.0, radius, 0.02 * params.length.min(0))
        """(n_segments,) [m]; where none is known, a fiftieth of the length."""
        crossed = params.offset.any((0, 2, 3))
        slender = np.where(
            crossed, np.minimum(_SLENDER * smallest_offset(params), self.body_radius), self.body_radius
        )
        skin = options.body == "skin"
        self.tube_radius: Floats = self.body_radius if skin else slender
        """(n_segments,) of the body as drawn [m]."""
        self.pieces = options.pieces_of(self.n_robots)
        """A segment."""
        ends, k = np.linspace(0.0, 1.0, self.pieces + 1), np.arange(self.n_segments)
        self._sample = Sampler(n_steps, np.repeat(k, len(ends)), np.tile(ends, len(k)))
        few = bool(crossed.any()) and self.n_robots <= FINE
        by_tension = options.color_by == "tension"
        self._spacers = (
            Spacers(params, self.body_radius, options, n_steps)
            if few and options.spacers and not skin
            else None
        )
        self._tendons: TendonLines | None = None
        if few and options.tendons and (by_tension or not skin):
            self._tendons = TendonLines(
                robot, params, self.body_radius if skin else None, n_steps, max(8, self.pieces // 4)
            )
        # intervals that end where another segment begins
        self._joints = n_steps * np.arange(1, self.n_segments) - 1
        plain = [palette.BODY if by_tension else palette.segment_color(i) for i in range(self.n_segments)]
        shape = (self.n_robots, self.n_segments, self.pieces, 3)
        self._plain: Colors = np.broadcast_to(np.array(plain, np.uint8)[:, None], shape)
        bend = 1.0 / float(params.rod_length.min())
        least = {
            "curvature": bend,
            "strain": 100.0 * bend * float(self.body_radius.max()),
            "tension": 0.05 * float(params.tension_scale.max()),
        }
        self.range: Range | None = Range(least[options.color_by]) if options.color_by in least else None
        """Range of colours that stand for numbers [1/m, % or N]; it grows with what is seen."""
        self._contacts = (
            (32 if self.n_robots <= 4 else 8) if options.contacts and state.contacts is not None else 0
        )
        self._half_force = params.moment_scale / params.rod_length  # (1 or n_robots,)
        self._length = params.rod_length
        self._last = _at_rest(rods, params.length, n_steps)
        self._tension: Floats = np.zeros(state.tension.shape)
        self._hidden: dict[tuple[int, Color], tuple[Instances, Instances]] = {}

    @property
    def tendons_drawn(self) -> bool:
        """Frames have `tendons`."""
        return self._tendons is not None

    def frame(self, rods: DrawnRods, *, tip_force: Floats | None = None) -> dict[str, Instances]:
        """Return what is seen now: `body`, `tip`, and where options, robots and scene have them `spacers`,
        `tendons`, `contact_shafts`, `contact_heads`, `load_shafts`, `load_heads`, `frames`; the same keys and
        counts in every frame. World frame, each robot at its place.

        Arrows begin where the force acts. Those of contacts show the force on the rod, from the obstacle into
        the rod; the largest 32 a robot, or 8 of more than 4 robots. Those of loads show `tip_force` (3,) or
        (n_robots, 3), world [N]. An arrow is
        0.3 L F / (F + EI / L^2) long, with L the robot's length and EI its smallest bending stiffness. Robots
        that are not ok are reddish; where a state is not finite, the last finite one is shown.
        """
        state, place = rods.state, np.asarray(rods.place, float)
        pose, lost = self._finite(state)
        bad = lost | ~state.ok
        rod = nodes(pose.position + place[:, None, :], pose.rotation, pose.arclength)
        found = self._body(rod, pose.curvature, bad)
        if self._spacers is not None:
            found["spacers"] = self._spacers.instances(rod, bad)
        if self._tendons is not None:
            by_number = self.range if self.options.color_by == "tension" else None
            self._tension = np.where(lost[:, None], self._tension, state.tension)
            found["tendons"] = self._tendons.instances(rod, self._tension, ~bad, by_number)
        tip = rod.position[:, -1]
        if self._contacts:
            point, force = self._contact_arrows(state.contacts)
            found["contact_shafts"], found["contact_heads"] = self._arrows(
                point + place[:, None, :], force, palette.CONTACT
            )
        if self.options.loads:
            load = (
                np.zeros((self.n_robots, 3))
                if tip_force is None
                else np.broadcast_to(tip_force, (self.n_robots, 3))
            )
            found["load_shafts"], found["load_heads"] = self._arrows(
                tip[:, None], load[:, None], palette.LOAD
            )
        if self.options.frames:
            size = max(3.0 * float(self.body_radius[-1]), 0.06 * float(self._length.max()))
            found["frames"] = frames(tip, rod.quaternion[:, -1], size)
        return found

    def _body(self, rod: Nodes, curvature: Floats, bad: Flags) -> dict[str, Instances]:
        at = self._sample(rod)
        shape = (self.n_robots, self.n_segments, self.pieces + 1)
        piece = pieces(at, self.n_segments, np.arange(self.n_segments), np.zeros((1, self.n_segments, 2)))
        thick = np.broadcast_to(self.tube_radius[:, None], piece.length.shape)
        # as much longer as the outside of the bend is: no wedge opens between neighbours
        length = piece.length + thick * piece.bend
        color = self._plain
        if self.range is not None and self.options.color_by != "tension":
            value = self._bending(curvature, at).reshape(shape)
            value = 0.5 * (value[..., 1:] + value[..., :-1])
            color = palette.sequential(value, self.range.see(value[~bad]))
        color = warned(color, bad)
        end = np.full((self.n_robots, 3), self.tube_radius[-1])
        return {
            "body": instances(
                "tube", piece.centre, piece.quaternion, np.stack([thick, thick, length], axis=-1), color
            ),
            "tip": instances("cap", at.position[:, -1], at.quaternion[:, -1], end, color[:, -1, -1]),
        }

    def _bending(self, curvature: Floats, at: CurveSamples) -> Floats:
        """(n_robots, m) the number that colours stand for."""
        size = np.hypot(curvature[..., 0], curvature[..., 1])
        end = size[:, 1:].copy()
        # a node between segments has the distal one's curvature; the proximal one's is extrapolated
        end[:, self._joints] = np.maximum(2.0 * size[:, self._joints] - size[:, self._joints - 1], 0.0)
        found = along((size[:, :-1], end), at)
        return (
            found
            if self.options.color_by == "curvature"
            else 100.0 * self.body_radius[self._sample.segment] * found
        )

    def _contact_arrows(self, contacts: Contacts | None) -> tuple[Floats, Floats]:
        """Points and forces (n_robots, n_arrows, 3) of the largest contact forces, then zeros."""
        point, force = np.zeros((2, self.n_robots, self._contacts, 3))
        if contacts is not None:
            there = np.isfinite(contacts.force + contacts.point).all(2, keepdims=True)
            all_force, all_point = (np.where(there, a, 0.0) for a in (contacts.force, contacts.point))
            if all_force.shape[1] > self._contacts:
                order = np.argsort(-np.linalg.norm(all_force, axis=2), axis=1)[:, : self._contacts, None]
                all_force, all_point = (np.take_along_axis(a, order, axis=1) for a in (all_force, all_point))
            n = all_force.shape[1]
            point[:, :n], force[:, :n] = all_point, all_force
        return point, force

    def _arrows(self, start: Floats, force: Floats, color: Color) -> tuple[Instances, Instances]:
        """Shafts and heads from `start` (n_robots, n, 3) of `force` (n_robots, n, 3) [N]; none where it is
        zero or not finite."""
        if not force.any():
            return self._no_arrows(start.size // 3, color)
        force = np.where(np.isfinite(force).all(-1, keepdims=True), force, 0.0)
        size = np.linalg.norm(force, axis=-1)
        length = _ARROW * self._length[:, None] * size / (size + self._half_force[:, None])
        direction = force / np.maximum(size, 1e-30)[..., None]
        return arrows(
            start.reshape(-1, 3),
            direction.reshape(-1, 3),
            length.ravel(),
            0.15 * float(self.body_radius.max()),
            color,
        )

    def _no_arrows(self, n: int, color: Color) -> tuple[Instances, Instances]:
        """n of them that are not there, the same each time: nothing is sent again."""
        if (n, color) not in self._hidden:
            up = np.broadcast_to([0.0, 0.0, 1.0], (n, 3))
            self._hidden[n, color] = arrows(np.zeros((n, 3)), up, np.zeros(n), 0.0, color)
        return self._hidden[n, color]

    def _finite(self, state: State) -> tuple[_Pose, Flags]:
        """The last finite pose of each robot, and whose is not that of `state`."""
        now = _Pose(state.position, state.rotation, state.arclength, state.curvature)
        with np.errstate(invalid="ignore"):
            good = np.asarray(
                np.stack([(np.abs(a) < _FAR).reshape(self.n_robots, -1).all(axis=1) for a in now]).all(axis=0)
            )
        if not good.all():
            now = _Pose(
                *(
                    np.where(good.reshape(-1, *[1] * (a.ndim - 1)), a, b)
                    for a, b in zip(now, self._last, strict=True)
                )
            )
        self._last = now
        return now, ~good


def _at_rest(rods: DrawnRods, length: Floats, n_steps: int) -> _Pose:
    """Straight robots: shown until there is a finite pose. `length` (1 or n_robots, n_segments) [m]."""
    base = np.array([[*robot.base_position, *robot.base_quaternion] for robot in rods.robots])
    joints = np.concatenate([np.zeros((len(base), 1)), np.cumsum(length, axis=1)], axis=1)
    at = np.arange(length.shape[1] * n_steps + 1) / n_steps
    s = np.stack([np.interp(at, np.arange(joints.shape[1]), row) for row in joints])
    orientation = matrix_from_quaternion(base[:, 3:])
    n, p = len(rods.state.ok), len(at)
    return _Pose(
        np.broadcast_to(base[:, None, :3] + s[..., None] * orientation[:, None, :, 2], (n, p, 3)),
        np.broadcast_to(orientation[:, None], (n, p, 3, 3)),
        np.broadcast_to(s, (n, p)),
        np.zeros((n, p, 3)),
    )
