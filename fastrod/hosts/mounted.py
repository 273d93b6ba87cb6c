"""`MountedRod`: a rod on a link of a PyBullet body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np

from fastrod.errors import HostError
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.carried import CarriedRod, check_bodies, check_contact, check_gravity, rod_of
from fastrod.hosts.link import BulletLink
from fastrod.hosts.rod import check_robot
from fastrod.hosts.surroundings import BulletBodyContact
from fastrod.model.robot import Robot
from fastrod.types import Floats


@final
class MountedRod(CarriedRod):
    """One rod on a link of a PyBullet body (`CarriedRod`). Bodies that are not named in `contact_bodies` meet
    the rod's capsules, which push them at their speed and feel nothing.
    """

    def __init__(
        self,
        robot: Robot,
        host: BulletLink,
        *,
        contact_bodies: Sequence[int | tuple[int, int]] = (),
        friction: float = 0.3,
        relaxation: float = 0.1,
        points_per_segment: int = 10,
        capsules_per_segment: int = 10,
        max_contacts: int = 16,
        dynamics: bool | None = None,
        color: Sequence[float] = (0.5, 0.0, 0.6, 1.0),
        head_color: Sequence[float] | None = None,
    ) -> None:
        """`contact_bodies`: numbers of bodies, each its base alone, or (body, link); `friction` of the rod on
        them; `relaxation` [s] of the rod against a changing contact force (`BodyContact`). `dynamics`: the
        rod moves with inertia; left out, where it can (`CarriedRod`). The time step is the world's. Raises
        `HostError`, `InputError`."""
        if not isinstance(host, BulletLink):
            raise HostError(
                f"host is {host!r}; give BulletLink(world, body, link), the link that carries the rod."
            )
        super().__init__(host, host.bullet.dt)
        self.host, self.bullet = host, host.bullet
        check_robot(robot)
        check_gravity(robot, self._gravity(), "setGravity() in the world")
        check_contact(relaxation, friction)
        check_bodies(contact_bodies)
        links = [_link_of(t) for t in contact_bodies]
        self.body_contacts = [
            BulletBodyContact(self.bullet, body, link, dt=self.dt, relaxation=relaxation, friction=friction)
            for body, link in links
        ]
        self.rod = rod_of(
            robot,
            self.body_contacts,
            dt=self.dt,
            max_contacts=max_contacts,
            points_per_segment=points_per_segment,
            capsules_per_segment=capsules_per_segment,
            dynamics=dynamics,
        )
        self._nodes_per_capsule = points_per_segment // capsules_per_segment
        radii = self.rod.radius.tolist()
        lengths = (
            np.repeat([segment.length for segment in robot.segments], capsules_per_segment)
            / capsules_per_segment
        )
        self.bodies = RodBodies(
            self.bullet, lengths.tolist(), radii, len(radii), color=color, head_color=head_color
        )
        for body in {host.body, *(body for body, _ in links)}:
            self.bodies.ignore(body)

    def remove(self) -> None:
        """Take the rod's capsules out of the world."""
        self.bodies.remove()

    def _look(self) -> None:
        if self.bullet.dt != self.dt:
            raise HostError(
                f"the world's time step is now {self.bullet.dt:g} s, and the rod was mounted for "
                f"{self.dt:g} s; "
                "remove() it and mount it anew."
            )

    def _gravity(self) -> Floats:
        return self.bullet.gravity

    def _shapes(self) -> Sequence[int]:
        return self.bodies.ids

    def _place(self) -> None:
        self.bodies.place(*self._nodes())

    def _head_for(self) -> None:
        self.bodies.head_for(*self._nodes(), self.dt)

    def _step_engine(self) -> None:
        self.bullet.stepSimulation()

    def _release(self) -> None:
        """PyBullet forgets its external forces by itself."""

    def _nodes(self) -> tuple[Floats, Floats]:
        state = self.rod.state
        return state.position[0, :: self._nodes_per_capsule], state.rotation[0, :: self._nodes_per_capsule]


def _link_of(body: object) -> tuple[int, int]:
    """Body and link."""
    pair = body if isinstance(body, (tuple, list)) else (body, -1)
    if len(pair) != 2 or not all(isinstance(i, (int, np.integer)) and not isinstance(i, bool) for i in pair):
        raise HostError(f"contact_bodies holds {body!r}; give the number of a body, or (body, link).")
    return int(pair[0]), int(pair[1])
