"""`Rods`: the modal solver by itself, for tests of its physics."""

from __future__ import annotations

from typing import Any

import numpy as np

from fastrod import Modes, Robot
from fastrod.kernels.rod.modal.motion import GENERALIZED_ALPHA
from fastrod.model.compile import compile_robots
from fastrod.solver.inputs import Inputs, Reader
from fastrod.solver.modal import ModalSolver, Step
from fastrod.types import Floats, RodShape


class Rods:
    """Robots of modes and their last shape."""

    def __init__(
        self, robot: Robot, n_robots: int = 1, modes: Modes | None = None, n_steps: int = 4, threads: int = 1
    ) -> None:
        layout, params, rest = compile_robots((robot,), n_steps)
        self.reader = Reader(layout, params, rest, n_robots)
        self.solver = ModalSolver((robot,), layout, params, n_robots, threads, modes or Modes())
        self.rows, n, m = np.arange(n_robots), n_robots, self.solver.n_points
        axes: tuple[tuple[int, ...], ...] = ((m, 3), (m, 3, 3), (m, 3), (m,), (m, 3), (m, 3), (3,), (3, 3))
        axes += (robot.n_tendons,), (robot.n_tendons,), (6,), ()
        self.shape = RodShape(*(np.full((n, *a), np.nan) for a in axes))
        self.motion = self.solver.new_motion_shape("full")

    def settle(self, tolerance: float = 1e-10, scheme: int = GENERALIZED_ALPHA, **inputs: Any) -> Floats:
        """(n_robots, 3) tips at rest; every robot must come to it."""
        ports = self.reader.ports(Inputs(**inputs))
        ok = self.solver.settle(self.rows, ports, self.shape, self.motion, tolerance, scheme)
        assert ok.all(), self.solver.iterations
        return self.shape.tip_position.copy()

    def step(self, how: Step, jump: bool = False, **inputs: Any) -> Floats:
        """(n_robots, 3) tips after one time step."""
        ports = self.reader.ports(Inputs(**inputs))
        jumps = np.full(len(self.rows), float(jump))
        ok = self.solver.step(self.rows, ports, self.shape, self.motion, how, jumps)
        assert ok.all(), self.solver.iterations
        return self.shape.tip_position.copy()
