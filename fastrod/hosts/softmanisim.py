"""`SoftManiSim`: the paper's class of this name, so that its users can switch; a tendon robot that moves
through a PyBullet world."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fastrod.checks import Bound, check_number
from fastrod.errors import HostError, InputError
from fastrod.hosts.bodies import RodBodies
from fastrod.hosts.bullet import Bullet, connect
from fastrod.hosts.camera import CameraView, HostCamera, Image
from fastrod.hosts.gripper import CONTACT_DISTANCE, Gripper
from fastrod.hosts.link import to_xyzw
from fastrod.hosts.paper import PaperShape, PaperShapes, between, numbers, orientation_of, paper_robot
from fastrod.model.robot import Robot
from fastrod.types import Floats

_log = logging.getLogger(__name__)
_DT = 0.005  # s, of a world of its own
_MOST_STEPS = 10_000  # of one motion
_HEAD = 0.0025  # m, head radius beyond the body's
_MARKER = 0.1  # m before the tip
_MARKER_RADIUS = 0.01  # m


@final
class SoftManiSim:
    """A tendon robot with a head and a gripper in a PyBullet world: it moves where its actions say, and
    pushes what it meets.

    An action is, for each segment, base segment first, the extension [m] and two tendon displacements [m]; a
    displacement d bends the segment by d / offset [rad]. In the robot's frame, which `base_orin` orients, the
    straight robot points along +y; the first displacement bends it toward +x, the second toward +z. (The
    paper's code maps its rod's x, y, z to x, z, y, which is a reflection; here fastrod's frame is rotated, d1
    to +x, d2 to -z, d3 to +y, and the second displacement changes its sign: the same directions in the world,
    with a frame that is right-handed, and orientations that are rotations.)

    The shape is the settled model without contact: objects do not bend the robot. Its bodies move at their
    true velocity, so an object is pushed at the robot's speed. Several robots may share a world, and several
    worlds a process.

    What differs for users of the paper's public code (SoftRobotBasicEnvironment): `gui` is False by default;
    the second value of `move_robot_ori` holds poses, as the first does; `calc_tip_pos` gives the tip's
    orientation; actions must be complete (there, zeros are put in front of a short one); in `add_a_cube` the
    orientation comes second, as in table 8 (the code has size there); suction releases; fingers hold; images
    are RGB with depth in metres.

    Source: Kasaei, Kasaei and Khadem, SoftManiSim, CoRL 2024, table 8.
    """

    def __init__(
        self,
        bullet: Any = None,
        body_color: Sequence[float] = (0.5, 0.0, 0.6, 1.0),
        head_color: Sequence[float] = (0.0, 0.0, 0.75, 1.0),
        body_sphere_radius: float = 0.02,
        number_of_sphere: int = 30,
        number_of_segment: int = 3,
        gui: bool = False,
        *,
        robot: Robot | None = None,
        max_grasp_width: float = 0.05,
        max_speed: float = 2.0,
    ) -> None:
        """Build the robot in the world `bullet`: the pybullet module, a BulletClient or a client's number,
        with its own time step; None opens a world with a step of 5 ms, gravity and a ground plane
        (`plane_id`).

        `body_sphere_radius` of the body [m]; `number_of_sphere` points along it, with a capsule between each
        two; colours RGBA.
        `robot` takes the place of the paper's one, of `number_of_segment` segments of 0.1 m that extend by
        -0.05 to 0.1 m, with four tendons each at 7.5 mm. `max_grasp_width` between the open fingers [m], 0
        for a head without fingers. `max_speed` of any point of the robot [m/s]: `move_robot_ori` spreads
        faster motions over several steps. Raises `HostError`, `InputError`.
        """
        check_number("number_of_sphere", number_of_sphere, Bound(least=2), whole=True)
        check_number("number_of_segment", number_of_segment, Bound(least=1), whole=True)
        check_number("body_sphere_radius", body_sphere_radius, Bound(above=0.0, unit="m"))
        check_number("max_speed", max_speed, Bound(above=0.0, unit="m/s"))
        if robot is not None and not isinstance(robot, Robot):
            raise InputError(
                f"robot is {robot!r}; give a Robot, for example fastrod.load_robot('prototype')."
            )
        self._robot = robot or paper_robot(int(number_of_segment), body_sphere_radius)
        self._shapes = PaperShapes(self._robot, int(number_of_sphere))
        self._own_world = bullet is None
        self.bullet = connect(gui=gui, dt=_DT) if bullet is None else Bullet(bullet)
        """The world: every function of the pybullet module."""
        self.plane_id: int | None = None
        """The ground of a world of its own."""
        if self._own_world:
            import pybullet_data

            self.bullet.setAdditionalSearchPath(pybullet_data.getDataPath())
            self.plane_id = self.bullet.loadURDF("plane.urdf")
        self.camera = HostCamera(near=0.05, far=5.0)
        """Camera of `capture_image`; set another to change it."""
        self.view = CameraView(eye=(0.65, 0.35, 0.45), target=(0.0, 0.15, 0.08))
        """Position and target of that camera, world; set another to change it."""
        self.in_hand_camera = HostCamera(near=0.005, far=3.0)
        """Camera of `in_hand_camera_capture_image`."""
        given = {"body_color": body_color, "head_color": head_color}
        self._colors = [numbers(name, color, 4).tolist() for name, color in given.items()]
        self._radius, self._max_width, self._max_speed = body_sphere_radius, max_grasp_width, max_speed
        self._bodies: RodBodies | None = None
        self._marker: int | None = None
        try:
            self.create_robot()
        except Exception:
            self.close()
            raise

    def create_robot(self) -> None:
        """Build the robot's bodies, straight from the origin along +y, fingers open; those that are there
        already are replaced.

        They touch nothing until the next `move_robot_ori`, which moves them to their pose at once.
        """
        self._remove()
        body_color, head_color = self._colors
        self._gripper = Gripper(self.bullet, self._radius + _HEAD, self._max_width, head_color)
        self._bodies = RodBodies(
            self.bullet, self._robot.length, self._radius, self._shapes.n_points - 1, color=body_color
        )
        self._bodies.ignore(self._gripper.body)
        self._collide(False)
        self._place(self._shapes.at(self._shapes.command(None, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))))
        self._standing = False

    def move_robot_ori(
        self,
        action: ArrayLike | None = None,
        base_pos: ArrayLike = (0.0, 0.0, 0.0),
        base_orin: ArrayLike = (0.0, 0.0, 0.0),
        camera_marker: bool = True,
    ) -> tuple[Floats, Floats]:
        """Move to the shape of `action` (3 number_of_segment,) [m], None for straight, on a base at
        `base_pos` (3,) world [m], rotated by `base_orin`: three Euler angles as for getQuaternionFromEuler
        [rad], or a quaternion x y z w.

        Returns the points (number_of_sphere, 7) evenly along the backbone, base first, tip last: position [m]
        and quaternion x y z w, world_from_material, whose z is the tangent; in the world, and in the robot's
        frame, so that the first is the base's pose times the second. The head's centre is at the tip.

        The world advances one step. Where a point would have to move farther than `body_sphere_radius` in it,
        or faster than `max_speed`, the robot goes there through the shapes between, in as many steps as that
        takes. The first motion after `create_robot` puts the robot at its pose at once, at rest.

        `camera_marker`: show a marker, which touches nothing, 0.1 m before the tip. Raises `InputError` on a
        wrong action or base, or a motion of more than 10000 steps.
        """
        goal = self._shapes.at(self._shapes.command(action, base_pos, base_orin))
        if self._standing:
            self._travel(goal)
        else:
            self._place(goal)
            self._collide(True)
            self._standing = True
            self._step()
        self._mark(camera_marker)
        return _xyzw(goal.world), _xyzw(goal.own)

    def calc_tip_pos(
        self,
        action: ArrayLike | None = None,
        base_pos: ArrayLike = (0.0, 0.0, 0.0),
        base_orin: ArrayLike = (0.0, 0.0, 0.0),
    ) -> tuple[Floats, Floats]:
        """Return where `move_robot_ori` would bring the tip: position (3,) [m] and quaternion (4,) x y z w,
        world. Nothing moves. Raises `InputError`."""
        tip = _xyzw(self._shapes.at(self._shapes.command(action, base_pos, base_orin)).world)[-1]
        return tip[:3], tip[3:]

    def wait(self, sec: float) -> None:
        """Advance the world by `sec` [s], at least one step, with the robot at rest. Raises `InputError`."""
        check_number("sec", sec, Bound(least=0.0, unit="s"))
        for _ in range(max(1, round(sec / self.bullet.dt))):
            self._step()

    def set_grasp_width(self, grasp_width_percent: float = 0.0) -> None:
        """Open or close the fingers to this fraction of the largest width, 0 closed, 1 (or more) open.

        They get there at 5 cm/s while the robot moves or waits. The fingers are bodies driven by motors of at
        most 10 N each: what they close on stops them and is held by friction, and falls when they open.
        Raises `InputError`; `HostError` without fingers.
        """
        if not grasp_width_percent >= 0.0:
            raise InputError(
                f"grasp_width_percent is {grasp_width_percent!r}; it must be a fraction from 0 "
                "(closed) to 1 (open)."
            )
        if not self._max_width:
            raise HostError("this robot has no fingers; build it with a max_grasp_width above 0.")
        self._gripper.open_to(min(1.0, grasp_width_percent))

    def suction_grasp(self, enable: bool = True) -> Any:
        """Attach the movable body that touches the head or a finger, the nearest if there are several, as it
        stands; or release it.

        Returns [its id], or -1 where nothing touches, which is logged; None on release. The body keeps its
        mass. While it is held it passes through the gripper and through those bodies of the robot that are
        near it.
        """
        if not enable:
            self._gripper.release()
            return None
        body = self._gripper.attach(self._capsules.ids)
        if body is None:
            _log.warning("suction_grasp: no movable body touches the head")
            return -1
        return [body]

    def is_robot_in_contact(self, obj_id: int) -> bool:
        """Return whether any body of the robot touches this body: surfaces nearer than 1 mm. Raises
        `HostError`."""
        return self.is_gripper_in_contact(obj_id) or any(
            self.bullet.getClosestPoints(own, obj_id, CONTACT_DISTANCE) for own in self._capsules.ids
        )

    def is_gripper_in_contact(self, obj_id: int) -> bool:
        """Return whether head or fingers touch this body. Raises `HostError`."""
        self.bullet.check(obj_id)
        return bool(self.bullet.getClosestPoints(self._gripper.body, obj_id, CONTACT_DISTANCE))

    def is_tip_in_contact(self, obj_id: int) -> bool:
        """Return whether the head touches this body. Raises `HostError`."""
        self.bullet.check(obj_id)
        return bool(self.bullet.getClosestPoints(self._gripper.body, obj_id, CONTACT_DISTANCE, linkIndexA=-1))

    def add_a_cube(
        self,
        pos: ArrayLike,
        ori: ArrayLike = (0.0, 0.0, 0.0, 1.0),
        size: ArrayLike = (0.1, 0.1, 0.1),
        mass: float = 0.1,
        color: Sequence[float] = (1.0, 1.0, 0.0, 1.0),
        textureUniqueId: int | None = None,
    ) -> int:
        """A box of `size` (3,) [m] and `mass` [kg], 0 for one that never moves, at `pos` (3,) world [m],
        rotated by `ori` (4,), a quaternion x y z w; returns the body's id. Moves without damping. Raises
        `InputError`."""
        b, half = self.bullet, 0.5 * numbers("size", size, 3)
        if not (half > 0.0).all():
            raise InputError(f"size is {size!r} m; three edge lengths must be positive.")
        check_number("mass", mass, Bound(least=0.0, unit="kg"))
        position = numbers("pos", pos, 3).tolist()
        if np.size(ori) == 3:
            raise InputError(
                f"ori is {ori!r}; it must be a quaternion x y z w. The size comes third: "
                "add_a_cube(pos, ori, size, mass)."
            )
        orientation = to_xyzw(orientation_of("ori", ori)).tolist()
        shape = b.createCollisionShape(b.GEOM_BOX, halfExtents=half.tolist())
        seen = b.createVisualShape(
            b.GEOM_BOX, halfExtents=half.tolist(), rgbaColor=numbers("color", color, 4).tolist()
        )
        body: int = b.createMultiBody(mass, shape, seen, position, orientation)
        b.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0)
        if textureUniqueId is not None:
            b.changeVisualShape(body, -1, textureUniqueId=textureUniqueId)
        return body

    def capture_image(self, removeBackground: bool = False) -> tuple[NDArray[np.uint8], Floats]:
        """Return the picture of the camera beside the robot (`camera`, `view`): RGB (height, width, 3), and
        the distance along the optical axis (height, width) [m], inf where there is nothing.

        `removeBackground`: what is neither robot nor object is white, and inf far: the ground planes and the
        marker too.
        """
        rgb, depth, body = self.camera.look(self.bullet, *self.view)
        if removeBackground:
            gone = (body < 0) | np.isin(
                body, [self._marker if self._marker is not None else -1, *self._grounds()]
            )
            rgb[gone], depth[gone] = 255, np.inf
        return rgb, depth

    def in_hand_camera_capture_image(self) -> tuple[NDArray[np.uint8], Floats]:
        """Return the picture of a camera on the front of the head along the tip's tangent; as
        `capture_image`. It rolls with the robot: up in the picture is +z of the straight robot's frame. The
        marker is left out."""
        position, rotation = self._now.world[-1, :3], self._now.rotation[-1]
        eye = position + (self._radius + _HEAD + 1e-3) * rotation[:, 2]
        if self._marker is None:
            return self._picture(eye, rotation)
        self.bullet.resetBasePositionAndOrientation(
            self._marker, (eye - 1e3 * rotation[:, 2]).tolist(), [0.0, 0.0, 0.0, 1.0]
        )
        picture = self._picture(eye, rotation)
        self._mark(True)
        return picture

    def close(self) -> None:
        """Take the robot out of the world, and end a world of its own."""
        if self.bullet.isConnected():
            self._remove()
            if self._own_world:
                self.bullet.disconnect()

    @property
    def _capsules(self) -> RodBodies:
        if self._bodies is None:
            raise HostError("this robot has been closed; create_robot() builds it anew.")
        return self._bodies

    def _picture(self, eye: Floats, rotation: Floats) -> tuple[NDArray[np.uint8], Floats]:
        image: Image = self.in_hand_camera.look(self.bullet, eye, eye + rotation[:, 2], -rotation[:, 1])
        return image.rgb, image.depth

    def _remove(self) -> None:
        if self._bodies is not None:
            self._gripper.remove()
            self._bodies.remove()
            self._bodies = None
            self._mark(False)

    def _travel(self, goal: PaperShape) -> None:
        """Go there, each step as far as the limits allow."""
        start, dt = self._now, self.bullet.dt
        most = min(self._radius, self._max_speed * dt)
        steps = math.ceil(self._largest_displacement(start, goal) / most)
        if steps > _MOST_STEPS:
            raise InputError(
                f"the robot would move for {steps} steps at {most / dt:g} m/s, more than {_MOST_STEPS}; "
                "create_robot() first puts it in its new place at once."
            )
        done, fraction = 0.0, 1.0 / max(1, steps)
        while done < 1.0:
            end = done + fraction
            to = goal if end > 1.0 - 1e-9 else self._shapes.at(between(start.command, goal.command, end))
            if (displacement := self._largest_displacement(self._now, to)) > most * (1.0 + 1e-6):
                fraction *= 0.95 * most / displacement
                continue
            nodes = to.world[:, :3], to.rotation
            self._capsules.head_for(*nodes, dt)
            self._gripper.head_for(to.world[-1, :3], to.world[-1, 3:], dt)
            self._step()
            self._place(to)
            done = 1.0 if to is goal else end
            fraction = min(fraction * min(2.0, 0.95 * most / max(displacement, 1e-12)), 1.0 - done)

    def _largest_displacement(self, a: PaperShape, b: PaperShape) -> float:
        """The farthest that any point of the robot moves between two shapes [m]."""
        right, up, long = 0.5 * self._max_width, 0.01, self._gripper.length
        corners = np.array([[x, y, long] for x in (-right, right) for y in (-up, up)])
        gripper = [shape.world[-1, :3] + corners @ shape.rotation[-1].T for shape in (a, b)]
        displacements = np.concatenate([b.world[:, :3] - a.world[:, :3], gripper[1] - gripper[0]])
        return float(np.linalg.norm(displacements, axis=1).max())

    def _place(self, shape: PaperShape) -> None:
        self._capsules.place(shape.world[:, :3], shape.rotation)
        self._gripper.place(shape.world[-1, :3], shape.world[-1, 3:])
        self._now = shape

    def _step(self) -> None:
        self._gripper.drive(self.bullet.dt)
        self.bullet.stepSimulation()

    def _collide(self, on: bool) -> None:
        """Let the world touch the robot, or not."""
        # PyBullet's groups and masks of bodies without and with mass
        fixed, moving = ((2, -3), (1, -1)) if on else ((0, 0), (0, 0))
        for own in (*self._capsules.ids, self._gripper.body):
            self.bullet.setCollisionFilterGroupMask(own, -1, *fixed)
        for finger in self._gripper.fingers:
            self.bullet.setCollisionFilterGroupMask(self._gripper.body, finger, *moving)

    def _mark(self, show: bool) -> None:
        """The marker before the tip."""
        b = self.bullet
        if not show:
            if self._marker is not None:
                b.removeBody(self._marker)
                self._marker = None
            return
        point = (self._now.world[-1, :3] + _MARKER * self._now.rotation[-1, :, 2]).tolist()
        if self._marker is None:
            seen = b.createVisualShape(b.GEOM_SPHERE, radius=_MARKER_RADIUS, rgbaColor=[1.0, 0.0, 0.0, 0.5])
            self._marker = b.createMultiBody(0.0, -1, seen, point)
        b.resetBasePositionAndOrientation(self._marker, point, [0.0, 0.0, 0.0, 1.0])

    def _grounds(self) -> list[int]:
        """Bodies that are ground: planes, and what calls itself one."""
        b = self.bullet
        bodies = [b.getBodyUniqueId(i) for i in range(b.getNumBodies())]
        return [
            i
            for i in bodies
            if i == self.plane_id
            or b.getBodyInfo(i)[1] == b"plane"
            or any(s[2] == b.GEOM_PLANE for s in b.getCollisionShapeData(i, -1))
        ]


def _xyzw(poses: Floats) -> Floats:
    """(n, 7) with quaternions in PyBullet's order."""
    return np.concatenate([poses[:, :3], to_xyzw(poses[:, 3:])], axis=1)
