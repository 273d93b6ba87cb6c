"""`Tip`: a rod at rest as the spring that holds a rigid body of a PyBullet world."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from fastrod.hosts import Bullet
from fastrod.hosts.link import from_xyzw, to_xyzw
from fastrod.model.robot import Robot
from fastrod.rotation import displaced, displacement, matrix_from_quaternion, quaternion_from_matrix
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod.types import Floats

NOTHING: Floats = np.zeros(6)
"""Wrench of nothing."""
UNLOADED: dict[str, Any] = {"tip_force": NOTHING[:3], "tip_moment": NOTHING[3:]}
"""Inputs of a rod with nothing at its tip."""
_DAMPING = 0.05  # s, damping_time of rods that state none
_NEWS = 0.1  # of what else acts on the body, by its last step: more makes what is heavier than it swing
_AT_REST, _PASSES = 1e-5, 8  # m, residual of a rod that counts as at rest
_MOST = 2.0  # N that a rod is solved under: what is jammed against a floor exerts any force


def moving_mass(robot: Robot) -> float:
    """Return the part of a rod's mass that moves with its tip [kg]: 33/140, as of a cantilever that a force
    at its end bends (Rayleigh)."""
    return 33.0 / 140.0 * sum(segment.line_density * segment.length for segment in robot.segments)


@final
class Tip:
    """A body at the tip of a rod without inertia: what meets the body bends the rod at once.

    The body is a mass on a spring of six directions (static condensation, Guyan 1965). `Simulator` finds the
    rod at rest under a wrench W, its mean in the time before, and its compliance C (6, 6) there. In each step
    h of the world the wrench F of the rod on the body is that of implicit Euler,

        C (F + W) = r - (x + h v) + c (u - v),  v = v0 + h M^-1 (F + G),

    with r the body's pose where the rod under W has it, u how fast that moves, c the rod's damping_time, x
    and v0 pose and velocity of the body before, G its weight and what it met or held in the last tenths of a
    second. It is stable at any stiffness, and while what the body holds weighs no more than twice as much.
    """

    def __init__(
        self, simulator: Simulator, dt: float, bullet: Bullet, body: int, seat: Floats, load: Floats = NOTHING
    ) -> None:
        """Put a body at the tip of the robot of `simulator`, which is at rest under `load` (6,), the wrench
        of what the body will hold: at rest and turned by `seat` (3, 3) tip_from_body. Its base weighs
        nothing, for it stands for the rod's own mass, which weighs in the rod; its links weigh. `dt` of the
        world's steps [s]."""
        self.simulator, self.dt, self._bullet, self._body, self._seat = simulator, dt, bullet, body, seat
        self._damping = max(s.damping_time for s in simulator.robots[0].segments) or _DAMPING
        self.wrench: Floats = load
        """(6,) of the body on the rod, under which it was solved: force [N] and moment about the tip [N m],
        world."""
        self._felt: list[Any] = []
        self._load, self._pose, self._by, self._more = load, self._seated(), np.zeros(6), np.zeros(6)
        self._besides, self._expected = load.copy(), np.zeros(6)
        position, orientation = self._pose[:3].tolist(), to_xyzw(self._pose[3:]).tolist()
        bullet.resetBasePositionAndOrientation(body, position, orientation)
        bullet.resetBaseVelocity(body, [0.0] * 3, [0.0] * 3)
        world = bullet.getPhysicsEngineParameters()
        self._gravity = np.array([world[f"gravityAcceleration{axis}"] for axis in "XYZ"])
        links = range(bullet.getNumJoints(body))
        pieces = [(-1, bullet.getBasePositionAndOrientation(body))]
        pieces += [(k, bullet.getLinkState(body, k, computeForwardKinematics=1)[:2]) for k in links]
        back = bullet.invertTransform(position, orientation)
        self._inertia, self._lever = np.zeros((6, 6)), np.zeros(3)
        for link, place in pieces:
            mass, _, diagonal = bullet.getDynamicsInfo(body, link)[:3]
            at, turned = bullet.multiplyTransforms(*back, *place)
            axes, by = matrix_from_quaternion(from_xyzw(turned)), np.eye(3, 6)
            by[:, 3:] = np.cross(np.eye(3), at).T  # velocity of its middle by the body's
            self._inertia += mass * by.T @ by
            self._inertia[3:, 3:] += axes @ np.diag(diagonal) @ axes.T
            self._lever = self._lever + mass * np.array(at)
        self._lifted, self._compliance = bullet.getDynamicsInfo(body, -1)[0], self._symmetric()

    def solve(self, **inputs: Any) -> State:
        """Return the rod at rest under these inputs and what the body did since it was last solved."""
        if self._felt:
            self.wrench = np.mean(self._felt, axis=0)
            self.wrench *= _MOST / max(float(np.linalg.norm(self.wrench[:3])), _MOST)
            self._felt = []
        inputs |= {"tip_force": self.wrench[:3], "tip_moment": self.wrench[3:]}
        if self.simulator.robots[0].effects:  # for which each call is a step in time
            return self.simulator.settle(**inputs, tolerance=_AT_REST)
        for _ in range(_PASSES):
            state = self.simulator.step(**inputs)
            if state.ok[0] and state.residual[0] < _AT_REST:
                break
        return state

    def deflection(self) -> Floats:
        """(6,) displacement of the tip [m] and its rotation by what it was last solved under, to first
        order."""
        return np.asarray(self._compliance @ self.wrench)

    def follow(self, n_steps: int) -> None:
        """Be held by the rod as it is solved now, from so many steps of the world on; evenly more until
        then."""
        self._compliance = self._symmetric()
        self._by = displacement(self._pose, self._seated()) / n_steps
        self._more = (self.wrench - self._load) / n_steps

    def pull(self) -> None:
        """Do to the body what the rod does in the world's next step."""
        h, bullet = self.dt, self._bullet
        self._pose, self._load = displaced(self._pose, self._by), self._load + self._more
        position, orientation = bullet.getBasePositionAndOrientation(self._body)
        at = np.concatenate([position, from_xyzw(orientation)])
        velocity = np.concatenate(bullet.getBaseVelocity(self._body))
        axes = np.kron(np.eye(2), matrix_from_quaternion(at[3:]))
        inertia = axes @ self._inertia @ axes.T
        weight = np.cross(axes[:3, :3] @ self._lever, self._gravity)
        weight = np.concatenate([(self._inertia[0, 0] - self._lifted) * self._gravity, weight])
        mobility, ahead = np.linalg.inv(inertia), h + self._damping
        self._besides += _NEWS / h * inertia @ (velocity - self._expected)
        free = velocity + h * mobility @ (weight + self._besides)
        driven = (self._by - self._compliance @ self._more) / h
        off = displacement(self._pose, at) + ahead * free - self._damping * driven
        force = -np.linalg.solve(self._compliance + h * ahead * mobility, off + self._compliance @ self._load)
        self._felt.append(-force)
        self._expected, given = free + h * mobility @ force, force.copy()
        given[:3] -= self._lifted * self._gravity
        bullet.applyExternalForce(self._body, -1, given[:3].tolist(), position, bullet.WORLD_FRAME)
        bullet.applyExternalTorque(self._body, -1, given[3:].tolist(), bullet.WORLD_FRAME)

    def _symmetric(self) -> Floats:
        """(6, 6) compliance of the tip; what a moment skews is left out."""
        compliance = self.simulator.compliance(moments=True)[0]
        return np.asarray(0.5 * (compliance + compliance.T))

    def _seated(self) -> Floats:
        """(7,) pose of the body where the rod has it."""
        state = self.simulator.state
        rotation = quaternion_from_matrix(state.tip_rotation[0] @ self._seat)
        return np.concatenate([state.tip_position[0], rotation])
