"""The effects of a batch of robots, in the order of their seams: what a command becomes, and what a
measurement sees."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from fastrod.effects import executor
from fastrod.effects.base import canonical_name, effect_names, read_values
from fastrod.effects.executor import Link, SensedPoses
from fastrod.effects.ports import EffectPorts, close_ports, open_ports
from fastrod.effects.ports import driven as driven_by
from fastrod.errors import EffectError, RobotError, nearest
from fastrod.model.robot import Robot
from fastrod.model.routing import Routing, route
from fastrod.rotation import matrix_from_quaternion, segment_bends
from fastrod.types import Flags, Floats, Params, Ports


def named_effects(robot: Robot) -> dict[str, dict[str, Any]]:
    """Tables of a robot's effects by canonical name, in the order in which they act. Raises for a name that
    is not known."""
    tables: dict[str, dict[str, Any]] = {}
    for table in robot.effects:
        if "name" not in table:
            raise EffectError(
                f"robot {robot.name!r}: effect {dict(table)!r} has no name; {nearest('', effect_names())}"
            )
        name = canonical_name(str(table["name"]))
        if name in tables:
            raise EffectError(f"robot {robot.name!r} has effect {name!r} twice; each effect stands once.")
        tables[name] = {key: value for key, value in table.items() if key != "name"}
    if not tables:
        return {}
    return {name: tables[name] for name in effect_names() if name in tables}


def _alike(one: Routing, other: Routing) -> bool:
    """Whether tendons and segments are the same to a part in a million million."""
    return bool(
        np.allclose(one.arms, other.arms, rtol=1e-12, atol=0.0)
        and np.allclose(one.length, other.length, rtol=1e-12, atol=0.0)
    )


class EffectPipeline:
    """The effects that a batch of robots has, with their memories."""

    def __init__(self, robots: Sequence[Robot], n_robots: int) -> None:
        """Raises `EffectError`, `UnknownNameError` for effects that are not, `RobotError` where robots name
        different ones."""
        self.routing = route(robots[0])
        tables = [named_effects(robot) for robot in robots]
        for i, named in enumerate(tables):
            if list(named) != list(tables[0]):
                raise RobotError(
                    f"robot {i} of the batch has effects {', '.join(named) or 'none'}, robot 0 has "
                    f"{', '.join(tables[0]) or 'none'}; "
                    "name the same effects in each, with neutral values where one has none."
                )
            if named and robots[i] is not robots[0] and not _alike(route(robots[i]), self.routing):
                raise RobotError(
                    f"robot {i} of the batch has segments of other lengths or tendons at other places than "
                    "robot 0; "
                    "with effects these must agree: give robots that differ there a simulator each."
                )
        self.n_robots = n_robots
        self.rest_length = robots[0].rest_tendon_length
        self.gravity = np.array([robot.gravity for robot in robots])
        self._felt = self.gravity  # at the last step
        self._base = self._base_rotation = np.empty(0)
        self._pulled = np.array(
            [robots[0].segments[end].mode == "tendon_tension" for end in robots[0].tendon_segment], dtype=bool
        )
        self.links: list[Link] = []
        for name in tables[0]:
            rows = [
                read_values(name, named[name], self.routing, f"robot {r.name!r}")
                for named, r in zip(tables, robots, strict=True)
            ]
            values = np.broadcast_to(np.array(rows), (n_robots, len(rows[0]))).copy()
            self.links.append(executor.link(name, values, self.routing))
        self.time = np.full(n_robots, np.nan)
        """(n_robots,) since the first step [s]; nan before it."""
        self.pulls_tip = False
        """A force that depends on where the tip is has acted."""
        self._tip_links = [link for link in self.links if executor.feels_tip(link.effect)]
        self.feels_tip = bool(self._tip_links)
        """Whether an effect's force depends on where the tip is."""
        self._reads_tension = any(executor.reads_tension(link.effect) for link in self.links)
        self._tension = np.zeros((n_robots, self.routing.n_tendons))
        self._reads_bend = any(executor.reads_bend(link.effect) for link in self.links)
        self.follows = self.feels_tip or self._reads_tension or self._reads_bend
        """Whether an effect depends on what the rod does: on where its tip is, how it is bent, or its
        tendons' tension."""
        self._bend = np.zeros((n_robots, self.routing.n_segments, 2))
        self._fraction = np.ones(n_robots)
        self._off: Floats | None = None
        self._lengths: Floats | None = None
        self._turned = np.zeros(n_robots)
        self._before: list[Floats] = []
        self._cold = np.zeros(n_robots, bool)
        self.tip_step = np.zeros(n_robots)
        """(n_robots,) by how much the rod is not yet where effects that follow it have put it [m]."""
        # of the whole rod, tendons free: its tip gives by no more
        self._softest = np.array(
            [
                sum(s.length for s in robot.segments) ** 3
                / min(min(s.bending_stiffness) for s in robot.segments)
                for robot in robots
            ]
        )[:, None, None] * (np.eye(3) / 3.0)

    def reset(self, rows: Any) -> None:
        """Let these robots begin at rest again."""
        for link in self.links:
            link.memory[rows] = executor.at_rest(link.effect, self.n_robots, self.routing)[rows]
        self.time[rows] = np.nan

    def act(
        self,
        ports: Ports,
        params: Params,
        state: Any,
        dt: float,
        n_steps: int,
        skip: Flags,
        gravity: Floats | None = None,
        compliance: Floats | None = None,
        again: bool = False,
    ) -> tuple[Ports, Params, list[tuple[Floats, Floats]]]:
        """Return what the kernel reads at this step, and the point forces of effects (`close_ports`).
        Memories move on, but for the robots `skip`, whose inputs cannot be used.

        `gravity` (1 or n_robots, 3) [m/s^2] is that of the world at this step, the robots' own if left out.
        Effects that feel the tip read it from `state`, and `compliance` (n_robots, 3, 3) [m/N], world, says
        how it will give to them; `again` repeats the step for these, from where its memories began.
        """
        self._felt = self.gravity if gravity is None else gravity
        if again:
            for link, old in zip(self.links, self._before, strict=True):
                if not executor.feels_tip(link.effect):
                    link.memory[:] = old
        else:
            self._cold = np.isnan(self.time)
            self.time = np.where(skip, self.time, np.where(self._cold, 0.0, self.time + dt))
        before = [link.memory.copy() for link in self.links] if skip.any() or self.follows else []
        self._before = before
        opened = self._open(ports, params, n_steps)
        if self._reads_tension:
            cold = self._cold & (not again)
            if state is not None and len(state.tension) != len(opened):
                raise EffectError(
                    "an effect goes by the tension of the tendons, which outputs='tip' leaves out; give "
                    "Simulator(robot, outputs='full')."
                )
            if state is not None:
                self._tension = np.where(np.isfinite(state.tension), state.tension, self._tension)
            self._tension = np.where(cold[:, None], 0.0, self._tension)
            opened.solved_tension = self._tension
        if self._reads_bend:
            opened.solved_bend = self._follow_bend(state, self._cold & (not again), again)
        executor.act(self.links, opened, state, dt)
        self.tip_step = np.zeros(len(opened))
        if self._reads_tension:
            if again and self._lengths is not None:
                self.tip_step = np.abs(opened.tendon_length - self._lengths).max(1, initial=0.0)
            self._lengths = opened.tendon_length.copy()
        if self._reads_bend:
            # also where nothing that is held back has changed: it remembers the bend
            self.tip_step = self.tip_step + self._turned * float(self.routing.length.sum())
        if self._tip_links:
            self._feel(opened, state, compliance, self._cold if not again else np.zeros_like(skip))
        for link, old in zip(self.links, before, strict=bool(before)):
            # where the tip was is known to robots that miss a step, too
            only = slice(3) if executor.feels_tip(link.effect) else slice(None)
            link.memory[skip, only] = old[skip, only]
        return close_ports(opened, ports, params)

    def _follow_bend(self, state: Any, cold: Flags, again: bool) -> Floats:
        """(n_robots, n_segments, 2) of the last state; of robots that are `cold` 0. Where a step is repeated
        `again`, part of the way to it (`executor.approach`)."""
        if state is not None and not len(state.rotation):
            raise EffectError(
                "an effect goes by how the body is bent, which outputs='tip' leaves out; give "
                "Simulator(robot, outputs='full')."
            )
        if state is not None:
            found = segment_bends(state.rotation, self.routing.n_segments)
            found = np.where(np.isfinite(found), found, self._bend)
            self._off = self._off if again else None
            self._bend = self._nearer(found) if again else found
        self._bend = np.where(cold[:, None, None], 0.0, self._bend)
        return self._bend.copy()

    def _nearer(self, found: Floats) -> Floats:
        """The bends to go by next, on the way to those that were `found`; how far that is, in `_turned`."""
        off = (found - self._bend).reshape(len(found), -1)
        least = executor.approach(self.links, self.routing.n_segments)
        self._fraction = (
            least if self._off is None else executor.relaxed(self._fraction, off, self._off, least)
        )
        self._off = off
        matters = executor.goes_by_bend(self.links, self.routing.n_segments)
        self._turned = np.where(matters, np.abs(off).sum(1), 0.0)
        return np.asarray(self._bend + (self._fraction[:, None] * off).reshape(found.shape))

    def _feel(self, opened: EffectPorts, state: Any, compliance: Floats | None, cold: Flags) -> None:
        """Add the force of effects that feel the tip, a Newton step nearer to balance; the first of them
        keeps it. Of robots that are `cold` the tip is where the straight one has it."""
        base = matrix_from_quaternion(opened.base_pose[:, 3:])
        into = np.swapaxes(base, 1, 2)
        softest = np.broadcast_to(self._softest, (len(opened), 3, 3))
        by_force = softest if compliance is None else into @ compliance
        straight = np.zeros((len(opened), 3))
        straight[:, 2] = self.routing.length.sum()
        tip = straight if state is None else self._tip(opened, state)
        memory = self._tip_links[0].memory
        known = ~cold & np.isfinite(tip).all(1) & np.isfinite(by_force).all((1, 2))
        last = np.concatenate([tip, by_force.reshape(-1, 9)], axis=1)
        last = np.where(known[:, None], last, memory[:, 3:])
        begin = np.concatenate([straight, (into @ softest).reshape(-1, 9)], axis=1)
        last = np.where((cold | ~last[:, :3].any(1))[:, None], begin, last)
        memory[:, 3:] = last
        tip, by_force = last[:, :3], last[:, 3:].reshape(-1, 3, 3)
        target, slopes = executor.tip_feedback(self._tip_links, opened, tip)
        self.pulls_tip = self.pulls_tip or bool(target.any() or slopes.any())
        before = memory[:, :3].copy()
        force = executor.approached(before, target, slopes, by_force)
        self.tip_step += np.linalg.norm(by_force @ (force - before)[..., None], axis=(1, 2))
        memory[:, :3] = force
        opened.tip_force += force

    @staticmethod
    def _tip(opened: EffectPorts, state: Any) -> Floats:
        return executor.from_base(
            opened.base_pose, state.tip_position, state.tip_rotation, np.zeros((len(opened), 0, 3))
        ).tip_position

    def tip_feedback(self, ports: Ports, params: Params, state: Any, n_steps: int) -> tuple[Floats, Floats]:
        """Tip force (n_robots, 3) [N] of effects that feel the tip where it is in `state`, and its slopes by
        the tip (n_robots, 3, 3) [N/m], world. `ports` are those before the effects."""
        opened = self._open(ports, params, n_steps)
        force, slopes = executor.tip_feedback(self._tip_links, opened, self._tip(opened, state))
        return force, slopes @ np.swapaxes(matrix_from_quaternion(opened.base_pose[:, 3:]), 1, 2)

    def slopes(self, ports: Ports, params: Params, state: Any, dt: float, n_steps: int) -> Floats:
        """(n_robots, n, n) d(what the rod feels) / d(what is commanded), of tendon lengths [m], or tensions
        [N] where these are commanded, then extensions [m], where the robots stand; memories stay. `ports` are
        those before the effects."""

        def felt(driven: Floats, extension: Floats) -> Floats:
            links = [link._replace(memory=link.memory.copy()) for link in self.links]
            given = {"tendon_length": driven, "tension": driven, "extension": extension}
            opened = self._open(ports._replace(**given), params, n_steps)
            executor.act(links, opened, state, 0.0 * dt)
            length, tension = driven_by(opened, ports._replace(**given))
            driven = np.where(self._pulled, tension, length)
            return np.concatenate([driven, opened.extension], axis=1)

        n_tendons = self.routing.n_tendons
        step = 1e-7 * float(self.routing.length.sum())
        driven = np.where(self._pulled, ports.tension, ports.tendon_length)
        inputs = np.concatenate(
            [np.broadcast_to(a, (self.n_robots, a.shape[1])) for a in (driven, ports.extension)], axis=1
        )
        slopes = np.empty((self.n_robots, inputs.shape[1], inputs.shape[1]))
        for j in range(inputs.shape[1]):
            pulled = j < n_tendons and self._pulled[j]
            delta = 1e-4 * float(params.tension_scale.min()) if pulled else step
            ends, unchanged = [], True
            for sign in (1.0, -1.0):
                moved = inputs.copy()
                moved[:, j] += sign * delta
                ends.append(felt(moved[:, :n_tendons], moved[:, n_tendons:]))
                unchanged &= np.array_equal(ends[-1][:, j], moved[:, j], equal_nan=True)
            slopes[:, :, j] = (ends[0] - ends[1]) / (2.0 * delta)
            if pulled and unchanged:  # exactly, where no effect changes a tension
                slopes[:, j, j] = 1.0
        return slopes

    def sense(
        self, measurement: SensedPoses, ports: Ports, params: Params, dt: float, n_steps: int
    ) -> SensedPoses:
        """The measurement with the effects of sensing."""
        return executor.sense(self.links, self._open(ports, params, n_steps), measurement, dt)

    def _open(self, ports: Ports, params: Params, n_steps: int) -> EffectPorts:
        if self._base is not ports.base_pose:  # which no one changes in place
            self._base, self._base_rotation = ports.base_pose, matrix_from_quaternion(ports.base_pose[:, 3:])
        opened = open_ports(
            ports,
            params,
            self.routing,
            n=self.n_robots,
            rest_length=self.rest_length,
            gravity=self._felt,
            base_rotation=self._base_rotation,
            time=np.where(np.isnan(self.time), 0.0, self.time),
            n_steps=n_steps,
        )
        opened.solved_bend = self._bend.copy()
        if not self.routing.by_tension:  # these are not commanded: nothing to act on
            opened.tendon_length[:, self._pulled] = self.rest_length[self._pulled]
        for given in (
            opened.tendon_length,
            opened.tension,
            opened.base_pose,
            opened.extension,
            opened.tip_force,
            opened.tip_moment,
            opened.line_force,
        ):
            # a bad input: nan passes through an effect without a warning, inf does not
            given[np.isinf(given)] = np.nan
        return opened
