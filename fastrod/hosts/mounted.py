"""`MountedRod`: a rod on a host, step by step with the host's world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.errors import HostError, InputError, nearest
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.link import BulletLink
from fastrod.hosts.surroundings import Touched
from fastrod.robot import Robot
from fastrod.simulator import Simulator
from fastrod.state import State
from fastrod.types import Floats

_INPUTS = ("tendon_length", "tension", "extension", "tip_force", "tip_moment", "line_force", "point_force", "follower_tip_force")
_PATIENCE = 2  # steps that fail before the rod settles anew
_MOST_FAILED = 25


@final
class MountedRod:
    """One rod on a link of a PyBullet body, both ways: the link's motion moves the base, the link feels the base's wrench.

    Bodies named in `touch` are obstacles of the rod: contact bends the rod, its host feels the force, and the body is pushed with it.
    Any other body meets the rod's capsules, which push it at their speed and feel nothing.

    A step is `rod.step(...)`, or for several rods in one world `begin` each, one stepSimulation, `end` each.
    """

    def __init__(
        self, robot: Robot, host: BulletLink, *,
        touch: Sequence[int | tuple[int, int]] = (), friction: float = 0.3, relaxation: float = 0.1,
        points_per_segment: int = 10, capsules_per_segment: int = 10, max_contacts: int = 16,
        color: Sequence[float] = (0.5, 0.0, 0.6, 1.0), head_color: Sequence[float] | None = None,
    ) -> None:  # fmt: skip
        """`touch`: numbers of bodies, each its base alone, or (body, link); `friction` of the rod on them; `relaxation` [s] of
        the rod against a changing contact force (`Touched`). The time step is the world's. Raises `HostError`, `InputError`."""
        if not isinstance(host, BulletLink):
            raise HostError(f"host is {host!r}; give BulletLink(world, body, link), the link that carries the rod.")
        self.host, self.bullet, self.dt = host, host.bullet, host.bullet.dt
        if capsules_per_segment < 1 or points_per_segment % capsules_per_segment:
            raise InputError(f"{capsules_per_segment} capsules for {points_per_segment} points of a segment; give a divisor of the points.")
        for name, value, unit in (("relaxation", relaxation, " s"), ("friction", friction, "")):
            if not isinstance(value, (int, float, np.floating)) or not 0.0 <= value < np.inf:
                raise InputError(f"{name} is {value!r}{unit}; it must be a number, zero or positive.")
        links = [_link_of(t) for t in touch]
        self.touched = [Touched(self.bullet, body, link, dt=self.dt, relaxation=relaxation, friction=friction) for body, link in links]
        scene = None
        if self.touched:
            obstacles = [part.obstacle for touched in self.touched for part in touched.parts]
            scene = ContactScene(obstacles=obstacles, max_contacts=max_contacts)
        self.simulator = Simulator(robot, dt=self.dt, points_per_segment=points_per_segment, threads=1, contact=scene)
        self._stride = points_per_segment // capsules_per_segment
        n = robot.n_segments * capsules_per_segment
        radii = np.repeat(ContactScene().radius_of(robot), capsules_per_segment).tolist()  # as contact has them
        self.bodies = RodBodies(self.bullet, robot.length, radii, n, color=color, head_color=head_color)
        for body in {host.body, *(body for body, _ in links)}:
            self.bodies.ignore(body)
        self.state: State | None = None
        """After the last step."""
        self.wrench: Floats = np.zeros(6)
        """Force [N] and moment about the base point [N m] that the host felt in the last step, world."""
        wires = any(segment.mode in ("tendon_length", "paper") for segment in robot.segments)
        self._inputs: dict[str, Any] = {"tendon_length": robot.rest_tendon_length} if wires else {}
        self._failed = 0

    def settle(self, **inputs: Any) -> State:
        """Bring the rod to rest where its host is now; inputs as for `step`. The host feels nothing yet."""
        inputs = self._merged(inputs)
        state = self.simulator.settle(base_pose=self.host.motion().pose, **self._scene(), **inputs)
        self._keep(state, inputs)
        self.bodies.place(*self._nodes(state))
        return state

    def step(self, **inputs: Any) -> State:
        """One step of rod and world together.

        Inputs as for `Simulator.step`, but base and obstacles, which the world gives; what is not given stays as it was commanded last,
        and the wires are those of the straight robot until then.
        """
        state = self.begin(**inputs)
        self.bullet.stepSimulation()
        self.end()
        return state

    def begin(self, **inputs: Any) -> State:
        """Where the rod will be at the end of the next step; its wrench goes to the host, its pushes to what it touches.

        A step that cannot be solved (`state.ok` is false, and `state.problems` says why) leaves the rod where it came to, with half the
        forces of the step before; after a few in a row, without contact at once, the rod settles anew. Raises `InputError` as
        `Simulator.step`, `HostError` where the rod is lost, where 25 steps in a row cannot be solved, or where the world's time step has
        changed.
        """
        if self.bullet.dt != self.dt:
            raise HostError(
                f"the world's time step is now {self.bullet.dt:g} s, and the rod was mounted for {self.dt:g} s; "
                "remove() it and mount it anew."
            )
        inputs = self._merged(inputs)
        if self.state is None:
            self.settle(**inputs)
        scene, base = self._scene(), self.host.motion().after(self.dt)
        state = self.simulator.step(base_pose=base, **scene, **inputs)
        if not state.ok[0] and (not self.touched or self._failed >= _PATIENCE):
            self.simulator.reset()
            state = self.simulator.settle(base_pose=base, **scene, **inputs)
        self._keep(state, inputs)
        self._failed = 0 if state.ok[0] else self._failed + 1
        if self._failed > _MOST_FAILED:
            raise HostError(
                f"{self._failed} steps in a row could not be solved, the last: {state.problems.get(0)} "
                "Move host, bodies and inputs by less in a step, or after a jump call reset()."
            )
        if state.ok[0]:
            self.wrench = state.base_wrench[0].copy()
            for touched in self.touched:
                more, point = touched.push(*_pushes(state, touched))
                self.wrench[:3] -= more[:3]
                self.wrench[3:] -= more[3:] + np.cross(point - base[:3], more[:3])
        else:
            self.wrench = 0.5 * self.wrench
            for touched in self.touched:
                touched.push_half()
        self.host.exert(self.wrench)
        self.bodies.head_for(*self._nodes(state), self.dt)
        return state

    def end(self) -> None:
        """After the world's step: the capsules stand where the rod is."""
        if self.state is None:
            raise HostError("end() comes after begin() and the world's stepSimulation().")
        self.bodies.place(*self._nodes(self.state))

    def reset(self) -> None:
        """Forget the rod's shape and its contacts, but not its inputs: after the host or a body was put somewhere else. The next step
        settles where the host then is."""
        self.simulator.reset()
        self.state, self._failed = None, 0
        for touched in self.touched:
            touched.forget()

    def remove(self) -> None:
        """Take the rod's capsules out of the world."""
        self.bodies.remove()

    def _merged(self, inputs: dict[str, Any]) -> dict[str, Any]:
        for name in inputs:
            if name not in _INPUTS:
                why = "the host gives it" if name == "base_pose" else nearest(name, _INPUTS)
                raise InputError(f"a mounted rod has no input {name!r}; {why}")
        return self._inputs | inputs

    def _keep(self, state: State, inputs: dict[str, Any]) -> None:
        if not np.isfinite(state.tip_position).all() or not np.isfinite(state.base_wrench).all():
            raise HostError(f"the rod is lost: {state.problems.get(0, 'its shape is not finite')}")
        self.state, self._inputs = state, inputs

    def _scene(self) -> dict[str, Any]:
        """What the simulator is told of the bodies around."""
        if not self.touched:
            return {}
        poses: dict[str, Floats] = {}
        velocities: dict[str, Floats] = {}
        for k, touched in enumerate(self.touched):
            p, v = touched.expected(self.bodies.ids)
            for name in touched.names:
                self.simulator.set_free(name, *touched.give(), body=k)
            poses |= p
            velocities |= v
        return {"obstacle_pose": poses, "obstacle_velocity": velocities}

    def _nodes(self, state: State) -> tuple[Floats, Floats]:
        return state.position[0, :: self._stride], state.rotation[0, :: self._stride]


def _link_of(touch: object) -> tuple[int, int]:
    """Body and link."""
    pair = touch if isinstance(touch, (tuple, list)) else (touch, -1)
    if len(pair) != 2 or not all(isinstance(i, (int, np.integer)) and not isinstance(i, bool) for i in pair):
        raise HostError(f"touch holds {touch!r}; give the number of a body, or (body, link).")
    return int(pair[0]), int(pair[1])


def _pushes(state: State, touched: Touched) -> tuple[Floats, Floats]:
    """Points and forces of the rod (n, 3) in the contacts with a link."""
    contacts = state.contacts
    if contacts is None:
        return np.empty((0, 3)), np.empty((0, 3))
    mine = np.isin(contacts.obstacle[0], [contacts.names.index(name) for name in touched.names])
    return contacts.point[0][mine], -contacts.force[0][mine]
