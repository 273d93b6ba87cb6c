"""`BulletArm`: a serial arm in a PyBullet world: its kinematics at any joint position, and its motors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import numpy as np
from numpy.typing import ArrayLike

from fastrod.checks import checked_array, checked_pose
from fastrod.errors import HostError, InputError, nearest
from fastrod.hosts.bullet import Bullet
from fastrod.hosts.link import to_xyzw
from fastrod.types import Flags, Floats, Ints

_GAIN = 1.0  # of position and of velocity: one step ends at the target; the tests measure how well
_STARTS = 8


@final
class BulletArm:
    """The joints from a body's base to its tip link, one after the other, each revolute or prismatic.

    The joints of one arm are numbered in the order of `names`; joint positions q are (n_joints,) [rad], or
    [m] where a joint slides. Frames are URDF frames, not those of the centres of mass. The kinematics are
    computed outside of PyBullet, from its data of the body: they hold at any q and move nothing. Joints on
    the chain to the tip that are not the arm's own are taken where they stand.
    """

    def __init__(self, bullet: Any, body: int, tip: int | str, joints: Sequence[str] | None = None) -> None:
        """`tip`: number or name of a link; `joints`: names, those between base and tip that move if left out.
        Raises `HostError`."""
        self.bullet = b = Bullet(bullet)
        self.body = body
        self.tip = b.link_named(body, tip) if isinstance(tip, str) else int(tip)
        """Number of the tip link."""
        b.check(body, self.tip)
        self._chain = _chain(b, body, self.tip)
        known = {b.getJointInfo(body, j)[1].decode(): k for k, j in enumerate(self._chain.joint)}
        self.names: tuple[str, ...] = tuple(known) if joints is None else tuple(joints)
        """Names of the joints."""
        if not self.names or len(set(self.names)) < len(self.names):
            raise HostError(
                f"the arm's joints are {list(self.names)!r}; name at least one between base and "
                f"tip of body {body}, each once."
            )
        for name in self.names:
            if name not in known:
                raise HostError(
                    f"body {body} has no moving joint {name!r} between its base and the tip; "
                    f"{nearest(name, known)}"
                )
        self._own: Ints = np.array([known[name] for name in self.names])
        self._joint = [self._chain.joint[k] for k in self._own]
        self._axes = [
            (k, bool(self._chain.slides[k]), self._chain.axis[k].tolist()) for k in self._own.tolist()
        ]
        self._other = [k for k in range(len(known)) if k not in self._own]
        self.n_joints = len(self.names)
        info = [b.getJointInfo(body, j) for j in self._joint]
        free = np.array([i[8] > i[9] for i in info])  # so PyBullet marks a continuous joint
        self.lower: Floats = np.where(free, -np.inf, [i[8] for i in info])
        """(n_joints,) limits [rad or m]; -inf where there is none."""
        self.upper: Floats = np.where(free, np.inf, [i[9] for i in info])
        """(n_joints,) limits [rad or m]; inf where there is none."""
        self.velocity_limit: Floats = np.array([i[11] or np.inf for i in info])
        """(n_joints,) [rad/s or m/s]; inf where the URDF has none."""
        self.effort: Floats = np.array([i[10] or np.inf for i in info])
        """(n_joints,) the motors' largest torque or force [N m or N]; inf where the URDF has none."""
        self._stands: Any = None  # PyBullet's pose of the base that `_base` is the matrix of: most bases stay
        self._base = np.eye(4)
        self._motor = np.transpose([self.effort, self.velocity_limit]).tolist()

    @classmethod
    def load(
        cls,
        bullet: Any,
        path: str,
        *,
        tip: int | str,
        joints: Sequence[str] | None = None,
        position: ArrayLike = (0.0, 0.0, 0.0),
        quaternion: ArrayLike = (1.0, 0.0, 0.0, 0.0),
    ) -> BulletArm:
        """Load a URDF, with the inertia that it states, and fix its base frame at `position` (3,) [m] and
        `quaternion` (4,) w x y z, world. Raises `HostError` for a file that PyBullet cannot load,
        `InputError` for a pose that is none."""
        b = Bullet(bullet)
        place = checked_array("position", position, [(3,)], "of the arm's base, world [m]")
        orientation = checked_array("quaternion", quaternion, [(4,)], "of the arm's base, w x y z")
        pose = checked_pose("the arm's base", np.concatenate([place, orientation]))
        flags = b.URDF_USE_INERTIA_FROM_FILE
        try:
            body = b.loadURDF(
                str(path), pose[:3].tolist(), to_xyzw(pose[3:]).tolist(), useFixedBase=True, flags=flags
            )
        except HostError as error:
            raise HostError(f"PyBullet cannot load {str(path)!r}; is it the path of a URDF file?") from error
        try:
            return cls(b, body, tip, joints)
        except Exception:
            b.removeBody(body)
            raise

    def position(self) -> Floats:
        """(n_joints,) measured [rad or m]."""
        return np.array([state[0] for state in self.bullet.getJointStates(self.body, self._joint)])

    def velocity(self) -> Floats:
        """(n_joints,) measured [rad/s or m/s]."""
        return np.array([state[1] for state in self.bullet.getJointStates(self.body, self._joint)])

    def place(self, q: ArrayLike, q_dot: ArrayLike = 0.0) -> None:
        """Be at q with velocity `q_dot`, (n_joints,) or one for all, at once; hold q from then on. Raises
        `InputError`."""
        to = self._inside(q, "q")
        rate = self._checked(np.full(self.n_joints, q_dot) if np.ndim(q_dot) == 0 else q_dot, "q_dot")
        for joint, p, v in zip(self._joint, to.tolist(), rate.tolist(), strict=True):
            self.bullet.resetJointState(self.body, joint, p, v)
        self.drive(to)

    def drive(self, q: ArrayLike, q_dot: ArrayLike | None = None) -> None:
        """Let the motors move the joints during the next steps, no stronger than `effort`, no faster than
        `velocity_limit`.

        Without `q_dot` the next step ends at q where limits and effort allow, and later ones stay there. With
        it, q is where the joints should be now and `q_dot` how fast they go: the next step ends at q + dt
        q_dot; give both anew before each step. Raises `InputError`.
        """
        to = self._inside(q, "q").tolist()
        rate = [0.0] * self.n_joints if q_dot is None else self._checked(q_dot, "q_dot").tolist()
        command, mode = self.bullet.setJointMotorControl2, self.bullet.POSITION_CONTROL
        for joint, p, v, (effort, fastest) in zip(self._joint, to, rate, self._motor, strict=True):
            # position, velocity, force, the gains of both, largest velocity
            command(self.body, joint, mode, p, v, effort, _GAIN, _GAIN, fastest)

    def freeze(self) -> None:
        """Hold all joints where they are."""
        self.drive(np.clip(self.position(), self.lower, self.upper))

    def frame(self, q: ArrayLike) -> Floats:
        """(7,) pose of the tip link at q: position [m] and quaternion w x y z, w not negative, world. Raises
        `InputError`."""
        return _pose(self._frames(self._checked(q, "q"))[1])

    def jacobian(self, q: ArrayLike) -> Floats:
        """(6, n_joints) velocity of the tip frame's origin, then angular velocity, world, per joint velocity
        at q. Raises `InputError`."""
        return self._jacobian(*self._frames(self._checked(q, "q")))

    def solve(self, target: ArrayLike, q0: ArrayLike) -> Floats:
        """(n_joints,) within the limits, near q0, where the tip has the `target` pose (7,), or is at the
        `target` position (3,), world.

        Damped least squares (Levenberg and Marquardt) to 1e-9 m and rad from q0, then from a few starts
        around it; the same q every time. Raises `InputError` for what is no pose, `HostError` where no q is
        found.
        """
        to = checked_array("target", target, [(3,), (7,)], "a position [m] or a pose, world")
        rows = 6 if len(to) == 7 else 3
        to = checked_pose("target", to) if rows == 6 else to
        goal = _matrix(to[:3].tolist(), to_xyzw(to[3:]).tolist() if rows == 6 else (0.0, 0.0, 0.0, 1.0))
        start = self._inside(q0, "q0")
        rng = np.random.default_rng(0)
        best, off = start, np.full(6, np.inf)
        for k in range(_STARTS):
            nearby = np.clip(start + 0.15 * k * rng.standard_normal(self.n_joints), self.lower, self.upper)
            q, e = self._descend(goal, rows, nearby)
            if np.linalg.norm(e) < np.linalg.norm(off):
                best, off = q, e
            if _reached(off):
                return best
        orientation = f" and {np.linalg.norm(off[3:]):.3g} rad" if rows == 6 else ""
        raise HostError(
            "no joint positions within the limits were found near q0 for the target "
            f"{np.round(to, 4).tolist()}; the best is {np.linalg.norm(off[:3]):.3g} m{orientation} off."
        )

    def _descend(self, goal: Floats, rows: int, q: Floats) -> tuple[Floats, Floats]:
        """(q, error) where the error is zero, or does not get smaller any more."""
        damping = 1e-3
        origins, tip = self._frames(q)
        e = _error(goal, tip, rows)
        for _ in range(200):
            if _reached(e) or damping > 1e6:
                break
            J = self._jacobian(origins, tip)[:rows]
            step = self._step(J, e, q, damping)
            step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-300))
            trial = np.clip(q + step, self.lower, self.upper)
            frames = self._frames(trial)
            new = _error(goal, frames[1], rows)
            if np.linalg.norm(new) < np.linalg.norm(e):
                q, e, damping, (origins, tip) = trial, new, max(0.1 * damping, 1e-12), frames
            else:
                damping *= 10.0
        return q, e

    def _step(self, J: Floats, e: Floats, q: Floats, damping: float) -> Floats:
        """Damped step; joints that it would push beyond a limit go there, and the others make up for it."""
        step = np.zeros(self.n_joints)
        free: Flags = np.ones(self.n_joints, bool)
        while free.any():
            A, rest = J[:, free], e - J[:, ~free] @ step[~free]
            step[free] = A.T @ np.linalg.solve(A @ A.T + damping * np.eye(len(A)), rest)
            beyond = free & ((q + step < self.lower) | (q + step > self.upper))
            if not beyond.any():
                break
            step[beyond] = np.clip(q + step, self.lower, self.upper)[beyond] - q[beyond]
            free &= ~beyond
        return step

    def _frames(self, q: Floats) -> tuple[Floats, Floats]:
        """(n, 4, 4) frames after each moving joint of the chain, and (4, 4) of the tip, world."""
        c = self._chain
        every = np.empty(len(c.joint))
        every[self._own] = q
        for k in self._other:
            every[k] = self.bullet.getJointState(self.body, c.joint[k])[0]
        s = np.where(c.slides, every, np.sin(every))[:, None, None]
        moves = c.constant + s * c.sine + np.cos(every)[:, None, None] * c.cosine
        frames = np.empty_like(moves)
        pose = self.bullet.getBasePositionAndOrientation(self.body)
        if pose != self._stands:
            self._stands, self._base = pose, _matrix(*pose) @ c.base
        before = self._base
        for k in range(len(moves)):
            before = np.matmul(before, moves[k], out=frames[k])
        return frames, before @ c.tip

    def _jacobian(self, frames: Floats, tip: Floats) -> Floats:
        columns = []
        p, q, r = tip[:3, 3].tolist()
        every = frames.tolist()
        for k, slides, (a, b, c) in self._axes:  # plain floats: four times as fast as arrays of this size
            (xx, xy, xz, u), (yx, yy, yz, v), (zx, zy, zz, w), _ = every[k]
            x, y, z = xx * a + xy * b + xz * c, yx * a + yy * b + yz * c, zx * a + zy * b + zz * c
            u, v, w = p - u, q - v, r - w
            columns.append(
                (x, y, z, 0.0, 0.0, 0.0) if slides else (y * w - z * v, z * u - x * w, x * v - y * u, x, y, z)
            )
        return np.array(columns).T

    def _checked(self, values: ArrayLike, name: str) -> Floats:
        says = f"a number for each of {', '.join(self.names)}"
        return checked_array(name, values, [(self.n_joints,)], says)

    def _inside(self, values: ArrayLike, name: str) -> Floats:
        q = self._checked(values, name)
        beyond = (q < self.lower - 1e-9) | (q > self.upper + 1e-9)
        if beyond.any():
            k = int(beyond.argmax())
            raise InputError(
                f"{name} of {self.names[k]} is {q[k]:.6g}; its limits are {self.lower[k]:.6g} "
                f"and {self.upper[k]:.6g}."
            )
        return q


class _Chain(NamedTuple):
    """Joints from base to tip as matrices: the frame after one is that before it times constant + sine sin q
    + cosine cos q, or constant + sine q for one that slides."""

    joint: list[int]
    slides: Flags
    axis: Floats
    """(n, 3) in the frame after the joint."""
    constant: Floats
    """(n, 4, 4), with the fixed joints before it."""
    sine: Floats
    cosine: Floats
    base: Floats
    """(4, 4) com_from_base, for bodies whose mass is off their base's origin."""
    tip: Floats
    """(4, 4) tip in the frame after the last joint."""


def _chain(b: Bullet, body: int, tip: int) -> _Chain:
    links = [tip] if tip >= 0 else []
    while links and (parent := b.getJointInfo(body, links[0])[16]) >= 0:
        links.insert(0, parent)
    inertial = [b.getDynamicsInfo(body, k)[3:5] for k in (-1, *links)]
    com = [_matrix(*pose) for pose in inertial]  # frame_from_com
    fixed = np.eye(4)
    joint: list[int] = []
    slides: list[bool] = []
    axes, constant, sine, cosine = (list[Floats]() for _ in range(4))
    for i, link in enumerate(links):
        info = b.getJointInfo(body, link)
        # PyBullet gives the joint's position in the parent's frame of mass, and the rotation from there
        # to the child's frame of mass inverted.
        orientation = _matrix((0.0, 0.0, 0.0), info[15]).T
        orientation[:3, :3] = orientation[:3, :3] @ com[i + 1][:3, :3].T
        orientation[:3, 3] = info[14]
        fixed = fixed @ com[i] @ orientation
        if info[2] == b.JOINT_FIXED:
            continue
        if info[2] not in (b.JOINT_REVOLUTE, b.JOINT_PRISMATIC):
            raise HostError(
                f"joint {info[1].decode()!r} of body {body} neither rotates about one axis nor "
                "slides; an arm's joints do."
            )
        axis = com[i + 1][:3, :3] @ np.array(info[13])
        still, s, c = np.eye(4), np.zeros((4, 4)), np.zeros((4, 4))
        if info[2] == b.JOINT_PRISMATIC:
            s[:3, 3] = axis
        else:
            still[:3, :3] = np.outer(axis, axis)
            s[:3, :3] = np.cross(axis, np.eye(3)).T
            c[:3, :3] = np.eye(3) - still[:3, :3]
        joint.append(link)
        slides.append(info[2] == b.JOINT_PRISMATIC)
        axes.append(axis)
        for matrices, term in ((constant, still), (sine, s), (cosine, c)):
            matrices.append(fixed @ term)
        fixed = np.eye(4)
    if not joint:
        raise HostError(
            f"body {body} has no joint that moves between its base and link {tip}; an arm needs one."
        )
    base = np.asarray(np.linalg.inv(com[0]), float)
    arrays = map(np.array, (slides, axes, constant, sine, cosine))
    return _Chain._make([joint, *arrays, base, fixed])


def _matrix(position: Sequence[float], xyzw: Sequence[float]) -> Floats:
    """(4, 4) of PyBullet's pose."""
    (u, v, w), (x, y, z, s) = position, xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - s * z), 2 * (x * z + s * y), u],
            [2 * (x * y + s * z), 1 - 2 * (x * x + z * z), 2 * (y * z - s * x), v],
            [2 * (x * z - s * y), 2 * (y * z + s * x), 1 - 2 * (x * x + y * y), w],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _quaternion(rotation: Floats) -> tuple[float, float, float, float]:
    """w x y z, w not negative, of (3, 3): `fastrod.rotation.quaternion_from_matrix` for one, in a fraction of
    its time."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    sums = (1.0 + a + e + i, 1.0 + a - e - i, 1.0 - a + e - i, 1.0 - a - e + i)
    k = sums.index(max(sums))
    w, x, y, z = (
        (sums[0], h - f, c - g, d - b),
        (h - f, sums[1], b + d, c + g),
        (c - g, b + d, sums[2], f + h),
        (d - b, c + g, f + h, sums[3]),
    )[k]
    size = math.copysign(math.sqrt(w * w + x * x + y * y + z * z), w)
    return w / size, x / size, y / size, z / size


def _pose(matrix: Floats) -> Floats:
    """(7,) of (4, 4)."""
    return np.array([*matrix[:3, 3].tolist(), *_quaternion(matrix[:3, :3])])


def _error(goal: Floats, tip: Floats, rows: int) -> Floats:
    """Return the displacement [m] and, of 6 rows, the rotation vector [rad] (rows,) from the tip to the goal,
    both (4, 4), world."""
    displacement = goal[:3, 3] - tip[:3, 3]
    if rows == 3:
        return np.asarray(displacement)
    w, *orientation = _quaternion(goal[:3, :3] @ tip[:3, :3].T)
    size = math.hypot(*orientation)
    scale = 2.0 * math.atan2(size, w) / size if size > 1e-12 else 2.0
    return np.array([*displacement.tolist(), *(scale * t for t in orientation)])


def _reached(error: Floats) -> bool:
    return math.hypot(*error[:3].tolist()) < 1e-9 and math.hypot(*error[3:].tolist()) < 1e-9
