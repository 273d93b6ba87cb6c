"""`MujocoRod`: a rod on a body of a MuJoCo model; `add_capsules` puts its capsules into the model before it
is compiled."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import NOT_NEGATIVE, check_number, checked_array
from fastrod.contact import ContactScene
from fastrod.errors import HostError, InputError, nearest
from fastrod.hosts.carried import CarriedRod, check_bodies, check_gravity, rod_of
from fastrod.hosts.mujoco_body import MujocoBody, body_number, mujoco
from fastrod.hosts.mujoco_body_contact import MujocoBodyContact
from fastrod.hosts.rod import check_robot
from fastrod.model.robot import Robot
from fastrod.types import Floats, Ints


class Felt(NamedTuple):
    """MuJoCo's contacts of the capsules in the last step, one row each; world frame."""

    capsule: Ints
    """(n,) from the base."""
    arclength: Floats
    """(n,) of the straight rod [m]."""
    body: Ints
    """(n,) of what touches."""
    point: Floats
    """(n, 3) [m]."""
    force: Floats
    """(n, 3) on the rod, friction included [N]."""
    depth: Floats
    """(n,) [m]."""


def read(model: Any, data: Any, capsule_of: Mapping[int, int], width: Floats) -> Felt:
    """`capsule_of`: geom -> number of the capsule; `width` (n_capsules,) arclength of each [m]."""
    lib = mujoco()
    rows: list[tuple[int, float, int]] = []
    points, forces, depths, inside = [], [], [], np.zeros(6)
    starts = np.concatenate([[0.0], np.cumsum(width)])
    for i in range(data.ncon):
        contact = data.contact[i]
        for own, other, sign in (
            (int(contact.geom1), int(contact.geom2), -1.0),
            (int(contact.geom2), int(contact.geom1), 1.0),
        ):
            if own in capsule_of:
                k = capsule_of[own]
                lib.mj_contactForce(model, data, i, inside)
                along = float((contact.pos - data.geom_xpos[own]) @ data.geom_xmat[own].reshape(3, 3)[:, 2])
                s = starts[k] + float(np.clip(0.5 * width[k] + along, 0.0, width[k]))
                rows.append((k, s, int(model.geom_bodyid[other])))
                points.append(np.array(contact.pos))
                # on geom2: its normal points there
                forces.append(sign * (inside[:3] @ contact.frame.reshape(3, 3)))
                depths.append(max(-float(contact.dist), 0.0))
    return Felt(
        np.array([row[0] for row in rows], np.int64),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows], np.int64),
        np.array(points).reshape(-1, 3),
        np.array(forces).reshape(-1, 3),
        np.array(depths),
    )


__all__ = ["MujocoBody", "MujocoRod", "add_capsules"]


def add_capsules(
    spec: Any,
    robot: Robot,
    host: str,
    *,
    contact_bodies: Sequence[str] = (),
    name: str = "rod",
    capsules_per_segment: int = 10,
    friction: float = 0.5,
    color: Sequence[float] = (0.5, 0.0, 0.6, 1.0),
    head_color: Sequence[float] | None = None,
) -> tuple[str, ...]:
    """Add a rod's body to a `mujoco.MjSpec`: mocap bodies `name 0`, `name 1`, ... with a capsule each, base
    first; returns their names.

    They pass through the bodies of the host's kinematic tree, and through those named in `contact_bodies`,
    with which the rod itself will make contact: give both the same as to `MujocoRod`. `friction` against all
    others; colours RGBA. Bodies of the tree that have no name get one, since MuJoCo's exclusions go by name.
    Raises `HostError`, `InputError`.
    """
    lib = mujoco()
    if not isinstance(spec, lib.MjSpec):
        raise HostError(
            f"spec is a {type(spec).__name__}; give a mujoco.MjSpec, for example "
            "mujoco.MjSpec.from_file(path)."
        )
    check_robot(robot)
    check_bodies(contact_bodies)
    check_number("friction", friction, NOT_NEGATIVE)
    if (
        isinstance(capsules_per_segment, bool)
        or not isinstance(capsules_per_segment, (int, np.integer))
        or capsules_per_segment < 1
    ):
        raise InputError(f"{capsules_per_segment!r} capsules a segment; give at least one, a whole number.")
    color = _rgba("color", color)
    head_color = None if head_color is None else _rgba("head_color", head_color)
    passed = list(_tree(_spec_body(spec, host)))
    for other in contact_bodies:
        if (body := _spec_body(spec, other)).name not in [b.name for b in passed]:
            passed.append(body)
    for k, body in enumerate(passed):
        if not body.name:
            body.name = f"{name} passes {k}"
    names = tuple(f"{name} {k}" for k in range(robot.n_segments * capsules_per_segment))
    if any(b.name in names for b in spec.bodies):
        raise HostError(
            f"the model has a body {names[0]!r} already; give each rod a name of its own: "
            "add_capsules(..., name='left')."
        )
    radii, lengths = _sizes(robot, capsules_per_segment)
    middles = np.cumsum(lengths) - 0.5 * lengths
    for k, own in enumerate(names):
        body = spec.worldbody.add_body(name=own, mocap=True, pos=[0.0, 0.0, middles[k]])
        rgba = head_color if head_color is not None and k == len(names) - 1 else color
        body.add_geom(
            name=own,
            type=lib.mjtGeom.mjGEOM_CAPSULE,
            size=[radii[k], 0.5 * lengths[k], 0.0],
            rgba=list(rgba),
            friction=[friction, 0.005, 0.0001],
        )
        for other in passed:
            spec.add_exclude(bodyname1=own, bodyname2=other.name)
    return names


@final
class MujocoRod(CarriedRod):
    """One rod on a body of a MuJoCo model (`CarriedRod`).

    The rod's capsules are mocap bodies (`add_capsules`). MuJoCo puts them where it is commanded, but its
    contacts take them to be at rest: a body that they meet is pushed by how deep they have come, follows them
    at their speed some hundredths of a second behind, and is held by friction as if by a thing that stands
    still. What the rod feels, and pushes at the right speed, are bodies in `contact_bodies`.

    Bodies that are not in `contact_bodies` meet the capsules, and `felt` reports the forces; they do not bend
    the rod.
    """

    def __init__(
        self,
        robot: Robot,
        model: Any,
        data: Any,
        body: int | str,
        *,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
        contact_bodies: Sequence[int | str] = (),
        friction: float = 0.3,
        name: str = "rod",
        points_per_segment: int = 10,
        max_contacts: int = 16,
        dynamics: bool = True,
    ) -> None:
        """`body`: name or number of what carries the rod, with the mount `position` (3,) [m] and `quaternion`
        (4,) w x y z, body_from_base. `contact_bodies`: names or numbers of bodies; `friction` of the rod on
        them; `dynamics` as `CarriedRod` has it. `name` as given to `add_capsules`. The time step is the
        model's. Raises `HostError`, `InputError`, `RobotError`."""
        check_robot(robot)
        host = MujocoBody(model, data, body, position=position, quaternion=quaternion)
        super().__init__(host, float(model.opt.timestep), id(data))
        self.host, self.model, self.data = host, model, data
        check_gravity(robot, self._gravity(), "set model.opt.gravity")
        check_number("friction", friction, NOT_NEGATIVE)
        check_bodies(contact_bodies)
        others = [body_number(model, other) for other in contact_bodies]
        self.capsule_bodies: list[int] = _capsule_bodies(model, name, robot)
        """Number of each capsule's body, base first."""
        self._mocap = model.body_mocapid[self.capsule_bodies]
        self._geoms: list[int] = model.body_geomadr[self.capsule_bodies].tolist()
        _check_fit(model.geom_size[self._geoms], robot, name)
        for other in others:
            self._check_excluded(other, name)
        self._bodies = [MujocoBodyContact(model, data, b, dt=self.dt, friction=friction) for b in others]
        self.body_contacts = self._bodies
        per_segment = len(self._geoms) // robot.n_segments
        self.rod = rod_of(
            robot,
            self.body_contacts,
            dt=self.dt,
            max_contacts=max_contacts,
            points_per_segment=points_per_segment,
            capsules_per_segment=per_segment,
            dynamics=dynamics,
        )
        self._capsule_of = {geom: k for k, geom in enumerate(self._geoms)}
        self._width = _sizes(robot, per_segment)[1]

    @property
    def felt(self) -> Felt:
        """MuJoCo's contacts of the capsules in the last step."""
        return read(self.model, self.data, self._capsule_of, self._width)

    @property
    def contact_force(self) -> Floats:
        """(n_capsules, 3) MuJoCo's contact force on each capsule in the last step, world [N]."""
        felt, force = self.felt, np.zeros((len(self._geoms), 3))
        np.add.at(force, felt.capsule, felt.force)
        return force

    def remove(self) -> None:
        """Take the rod out: its capsules are seen and touched by nothing any more, and its forces are
        gone."""
        self._leave()
        self._release()
        self.model.geom_contype[self._geoms] = self.model.geom_conaffinity[self._geoms] = 0
        self.model.geom_rgba[self._geoms, 3] = 0.0

    def _look(self) -> None:
        if float(self.model.opt.timestep) != self.dt:
            raise HostError(
                f"the model's time step is now {self.model.opt.timestep:g} s, and the rod was mounted for "
                f"{self.dt:g} s; mount it anew."
            )

    def _gravity(self) -> Floats:
        off = self.model.opt.disableflags & int(mujoco().mjtDisableBit.mjDSBL_GRAVITY)
        return np.zeros(3) if off else np.array(self.model.opt.gravity)

    def _place(self) -> None:
        capsules = self.rod.capsules
        self.data.mocap_pos[self._mocap] = capsules.center
        self.data.mocap_quat[self._mocap] = capsules.quaternion

    def _head_for(self) -> None:
        self._place()  # contact is looked for at once, where the rod will be

    def _step_engine(self) -> None:
        mujoco().mj_step(self.model, self.data)

    def _release(self) -> None:
        self.host.release()
        for contact in self._bodies:
            contact.release()

    def _check_excluded(self, body: int, name: str) -> None:
        """Two contacts of one pair, the rod's and MuJoCo's, would push twice."""
        if self.model.body_weldid[body] == 0 or not len(self._geoms):
            return
        own = self.capsule_bodies[0]
        if (min(own, body) << 16) + max(own, body) not in self.model.exclude_signature:
            raise HostError(
                f"the capsules of {name!r} collide with {self.model.body(body).name!r}, which the rod is to "
                "touch itself; name it in add_capsules(..., contact_bodies=[...]) too."
            )


def _spec_body(spec: Any, name: object) -> Any:
    body = spec.body(name) if isinstance(name, str) else None
    if body is None:
        raise HostError(
            f"the spec has no body {name!r}; {nearest(str(name), [b.name for b in spec.bodies if b.name])}"
        )
    return body


def _tree(body: Any) -> Iterator[Any]:
    """All bodies of its kinematic tree; none of the world's own."""
    if body.name == "world":
        return
    while body.parent.name != "world":
        body = body.parent
    waiting = [body]
    while waiting:
        yield (one := waiting.pop())
        waiting.extend(one.bodies)


def _rgba(name: str, value: Sequence[float]) -> list[float]:
    found: list[float] = checked_array(name, value, [(4,)], "red, green, blue, opacity, from 0 to 1").tolist()
    return found


def _sizes(robot: Robot, per_segment: int) -> tuple[Floats, Floats]:
    """Radius and length (n_capsules,) of a robot's capsules [m]."""
    lengths: Floats = np.repeat([segment.length for segment in robot.segments], per_segment) / per_segment
    return np.repeat(ContactScene().radius_of(robot), per_segment), lengths


def _check_fit(size: Floats, robot: Robot, name: str) -> None:
    """`HostError` where capsules of this `size` (n, 3), MuJoCo's, are not this robot's."""
    radii, lengths = _sizes(robot, len(size) // robot.n_segments)
    for k, (is_, be) in enumerate(zip(size[:, :2], np.stack([radii, 0.5 * lengths], axis=1), strict=True)):
        if not np.allclose(is_, be, rtol=1e-6, atol=0.0):
            raise HostError(
                f"capsule {k} of {name!r} has radius {is_[0]:.4g} m and half length {is_[1]:.4g} m, where "
                f"this robot has {be[0]:.4g} m and {be[1]:.4g} m; they were added for another robot."
            )


def _capsule_bodies(model: Any, name: str, robot: Robot) -> list[int]:
    numbers = {model.body(i).name: i for i in range(model.nbody)}
    found: list[int] = []
    while (own := f"{name} {len(found)}") in numbers:
        found.append(numbers[own])
    if not found or any(model.body_mocapid[i] < 0 for i in found):
        raise HostError(
            f"the model has no capsules of a rod {name!r}; call add_capsules(..., "
            f"name={name!r}) on its spec before compile()."
        )
    if len(found) % robot.n_segments:
        raise HostError(
            f"the {len(found)} capsules of {name!r} do not fit {robot.n_segments} segments; "
            "they were added for another robot."
        )
    return found
