"""`MountedRod`: a rod on a host, step by step with the host's world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.errors import HostError, InputError
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.link import BulletLink
from fastrod.hosts.surroundings import Touched
from fastrod.robot import Robot
from fastrod.simulator import Simulator
from fastrod.state import State
from fastrod.types import Floats


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
        """`touch`: bodies, each its base alone, or (body, link); `friction` of the rod on them; `relaxation` [s] of the rod against a
        changing contact force (`Touched`). The time step is the world's. Raises `HostError`, `InputError`."""
        self.host, self.bullet, self.dt = host, host.bullet, host.bullet.dt
        if points_per_segment % capsules_per_segment:
            raise InputError(f"{capsules_per_segment} capsules for {points_per_segment} points of a segment; give a divisor of the points.")
        if not relaxation >= 0.0:
            raise InputError(f"relaxation is {relaxation!r} s; it must be zero or positive.")
        links = [(t, -1) if isinstance(t, int) else t for t in touch]
        self.touched = [Touched(self.bullet, body, link, dt=self.dt, relaxation=relaxation, friction=friction) for body, link in links]
        scene = None
        if self.touched:
            obstacles = [part.obstacle for touched in self.touched for part in touched.parts]
            scene = ContactScene(obstacles=obstacles, max_contacts=max_contacts)
        self.simulator = Simulator(robot, dt=self.dt, points_per_segment=points_per_segment, threads=1, contact=scene)
        self._stride = points_per_segment // capsules_per_segment
        n = robot.n_segments * capsules_per_segment
        radii = [segment.body_radius or 0.01 for segment in robot.segments for _ in range(capsules_per_segment)]
        self.bodies = RodBodies(self.bullet, robot.length, radii, n, color=color, head_color=head_color)
        for body in {host.body, *(body for body, _ in links)}:
            self.bodies.ignore(body)
        self.state: State | None = None
        """After the last step."""
        self.wrench: Floats = np.zeros(6)
        """Force [N] and moment about the base point [N m] that the host felt in the last step, world."""
        self._inputs: dict[str, Any] = {}

    def settle(self, **inputs: Any) -> State:
        """Bring the rod to rest where its host is now; inputs as for `Simulator.step`, without base_pose. The host feels nothing yet."""
        self._inputs = self._inputs | inputs
        poses, velocities = self._surroundings()
        state = self.simulator.settle(base_pose=self.host.motion().pose, **self._scene(poses, velocities), **self._inputs)
        self._keep(state)
        self.bodies.place(*self._nodes(state))
        return state

    def step(self, **inputs: Any) -> State:
        """One step of rod and world together; what is not given stays as it was commanded last."""
        state = self.begin(**inputs)
        self.bullet.stepSimulation()
        self.end()
        return state

    def begin(self, **inputs: Any) -> State:
        """Where the rod will be at the end of the next step; its wrench goes to the host, its pushes to what it touches.

        In a step that cannot be solved (`state.ok` is false, and `state.problems` says why) the rod stands where it came to, and the
        forces of the step before act once more. Raises `HostError` where the rod is lost, or the world's time step has changed.
        """
        if self.bullet.dt != self.dt:
            raise HostError(f"the world's time step is now {self.bullet.dt:g} s, and the rod was mounted for {self.dt:g} s; mount it anew.")
        self._inputs = self._inputs | inputs
        if self.state is None:
            self.settle()
        poses, velocities = self._surroundings()
        base = self.host.motion().after(self.dt)
        state = self.simulator.step(base_pose=base, **self._scene(poses, velocities), **self._inputs)
        self._keep(state)
        if state.ok[0]:
            self.wrench = state.base_wrench[0].copy()
            for touched in self.touched:
                more, point = touched.push(*_pushes(state, touched))
                self.wrench[:3] -= more[:3]
                self.wrench[3:] -= more[3:] + np.cross(point - base[:3], more[:3])
        else:
            for touched in self.touched:
                touched.push_again()
        self.host.exert(self.wrench)
        self.bodies.head_for(*self._nodes(state), self.dt)
        return state

    def end(self) -> None:
        """After the world's step: the capsules stand where the rod is."""
        if self.state is None:
            raise HostError("end() comes after begin() and the world's stepSimulation().")
        self.bodies.place(*self._nodes(self.state))

    def reset(self) -> None:
        """Forget the rod's state and its contacts; the next step settles where the host then is."""
        self.simulator.reset()
        self.state = None
        for touched in self.touched:
            touched.forget()

    def _keep(self, state: State) -> None:
        if not np.isfinite(state.tip_position).all() or not np.isfinite(state.base_wrench).all():
            raise HostError(f"the rod is lost: {state.problems.get(0, 'its shape is not finite')}")
        self.state = state

    def _surroundings(self) -> tuple[dict[str, Floats], dict[str, Floats]]:
        poses: dict[str, Floats] = {}
        velocities: dict[str, Floats] = {}
        for k, touched in enumerate(self.touched):
            p, v = touched.expected()
            for name in touched.names:
                self.simulator.set_free(name, *touched.give(), body=k)
            poses |= p
            velocities |= v
        return poses, velocities

    def _scene(self, poses: dict[str, Floats], velocities: dict[str, Floats]) -> dict[str, Any]:
        return {"obstacle_pose": poses, "obstacle_velocity": velocities} if self.touched else {}

    def _nodes(self, state: State) -> tuple[Floats, Floats]:
        return state.position[0, :: self._stride], state.rotation[0, :: self._stride]


def _pushes(state: State, touched: Touched) -> tuple[Floats, Floats]:
    """Points and forces of the rod (n, 3) in the contacts with a link."""
    contacts = state.contacts
    if contacts is None:
        return np.empty((0, 3)), np.empty((0, 3))
    mine = np.isin(contacts.obstacle[0], [contacts.names.index(name) for name in touched.names])
    return contacts.point[0][mine], -contacts.force[0][mine]
