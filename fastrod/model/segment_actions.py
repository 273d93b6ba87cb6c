"""Segments as one drives them: extension and two bends each, and the tendon lengths that belong to them."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import InputError, RobotError, refuse_masked, shown
from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Flags, Floats

_ONE_PLANE = 0.01  # rad: by so little tendons are off one plane whose angles a file has in a few digits


class TendonInputs(TypedDict):
    """Keyword arguments of `Simulator.step`."""

    tendon_length: Floats
    """(..., n_tendons) absolute [m]."""
    extension: Floats
    """(..., n_segments) [m]."""


class SegmentActions:
    """A robot driven by one action a segment, base segment first: extension, then two tendon displacements
    [m] (the paper's action).

    A displacement `d` bends the segment by d / offset [rad]: the first toward +d1 of its base, the second
    toward +d2. The tendons of distal segments follow the bends and extensions of the segments that they
    cross, so every segment has its own action. Without load and with tendons that do not stretch, the
    segments are arcs of these bends. A segment whose tendons lie in one plane bends in it, by the
    displacement that is nearer to it; the other does nothing. Those of a passive segment among driven ones do
    nothing, and it takes a share of the bend of the tendons that cross it.

    >>> import fastrod
    >>> actions = SegmentActions(fastrod.load_robot("prototype"))
    >>> actions.inputs([0.0, 0.003, 0.0])["tendon_length"].round(4)
    array([0.067, 0.07 , 0.073, 0.07 ])
    """

    def __init__(self, robot: Robot, offset: float | None = None) -> None:
        """`offset`: displacement per bend [m/rad]; by default the distance of each segment's first tendon
        from the backbone. Raises `RobotError` where a segment that is not passive, or all of them, are
        not driven by the lengths of tendons."""
        routing = route(robot)
        n = robot.n_segments
        offsets, some_driven = np.zeros(n), any(segment.tendons for segment in robot.segments)
        bends = np.zeros((n, 2, 3 * n))  # about d1 and d2, by the action
        for k, segment in enumerate(robot.segments):
            if segment.mode == "passive" and some_driven:
                continue
            if segment.mode not in ("tendon_length", "paper"):
                raise RobotError(
                    f"segment {k + 1} of robot {robot.name!r} is {segment.mode}; an action "
                    "needs tendons driven by length."
                )
            arms = np.array([tendon.position(k + 1)[k] for tendon in segment.tendons])
            arm = np.hypot(*arms[0])
            offsets[k] = offset or arm
            toward = np.eye(2)  # of the displacements, in the base's d1 and d2
            if np.linalg.matrix_rank(arms, tol=_ONE_PLANE * arm) < 2:
                nearer, along = int(np.argmax(np.abs(arms[0]))), arms[0] / arm
                toward = np.zeros((2, 2))
                toward[nearer] = along * np.sign(along[nearer])
            own = toward.T / offsets[k]
            bends[k, 1, 3 * k + 1 : 3 * k + 3], bends[k, 0, 3 * k + 1 : 3 * k + 3] = own[0], -own[1]
        self.robot = robot
        self.offset: Floats = offsets
        """(n_segments,) displacement per bend, 0 of a passive segment [m/rad]."""
        self.bends: Flags = np.abs(bends).max((0, 1)) > 0.0
        """(3 n_segments,) which numbers of an action bend a segment."""
        self.by_extension: Floats = np.zeros((n, 3 * n))
        """(n_segments, 3 n_segments) d(extension)/d(action)."""
        self.by_extension[np.arange(n), 3 * np.arange(n)] = 1.0
        longer = np.cumsum(self.by_extension, axis=0)[robot.tendon_segment]
        by_length = longer + np.moveaxis(routing.tendon_change(np.moveaxis(bends, 2, 0)), 0, 1)
        self.matrix: Floats = np.concatenate([by_length, self.by_extension])
        """(n_tendons + n_segments, 3 n_segments) d(tendon length, extension)/d(action): `Simulator.jacobian()
        @ matrix` is the tip's Jacobian by actions."""

    @property
    def n_actions(self) -> int:
        """Numbers of an action: three a segment."""
        return 3 * self.robot.n_segments

    def inputs(self, action: ArrayLike) -> TendonInputs:
        """Tendon lengths and extensions of an action (..., 3 n_segments) [m]. Raises `InputError` where it is
        not one."""
        refuse_masked("action", action)
        try:
            a = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(f"action is {shown(action)}; give {self.n_actions} numbers [m].") from error
        if a.ndim == 0 or a.shape[-1] != self.n_actions:
            raise InputError(
                f"action has shape {a.shape}; it must be (..., {self.n_actions}): extension and two "
                "displacements for each of "
                f"{self.robot.n_segments} segments, base first [m]."
            )
        if not np.isfinite(a).all():
            raise InputError(
                "action holds a value that is not finite: "
                f"{np.array2string(a.ravel()[:9], max_line_width=1000)}."
            )
        change = a @ self.matrix.T
        return TendonInputs(
            tendon_length=self.robot.rest_tendon_length + change[..., : self.robot.n_tendons],
            extension=change[..., self.robot.n_tendons :],
        )
