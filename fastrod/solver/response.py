"""Linear response of the observer's robots: how the tip answers inputs and forces."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal

import numpy as np

from fastrod.kernels.jit import LANES
from fastrod.solver.boundary import BoundarySolver, new_shape
from fastrod.types import Floats, Ints, Memory, Params, Ports, Response, RodShape

_ROWS = 1024  # of one pass: robots times copies of them
_HALF = 0.5e-4 * np.repeat(np.eye(3), 2, axis=0) * np.array([[1.0], [-1.0]] * 3)
ROTATIONS: Floats = np.array(
    [[[1.0, -x, -y, -z], [x, 1.0, -z, y], [y, z, 1.0, -x], [z, -y, x, 1.0]] for x, y, z in _HALF]
)[:, None]
"""(6, 1, 4, 4) what rotates a quaternion forward and back by 1e-4 rad about each axis of the world."""
Relocate = Callable[[Floats], Mapping[str, Floats]]
"""Extensions -> the ports that change with them."""


class Linear:
    """Passes that change nothing, at the present boundary of `rows`, with their linear response."""

    def __init__(self, passes: BoundarySolver, rows: Ints, ports: Ports) -> None:
        self.passes, self.rows, self.ports = passes, rows, ports

    def respond(self, columns: bool = True) -> tuple[Response, RodShape]:
        """Residuals, tip and their derivatives by the unknowns and, last, by a tip force; other rows
        are nan."""
        passes, ports = self.passes, self.ports
        n, n_e = passes.n_robots, passes.n_residuals(ports)
        n_col = passes.n_x + (0 if len(ports.follower_force) else 3) if columns else 0
        holes = len(self.rows) < n
        response = Response(np.empty((n, n_e, n_col)), np.empty((n, 6, n_col)), np.empty((n, n_e)))
        if holes:
            for a in response:
                a.fill(np.nan)
        shape = new_shape(passes.layout, passes.n_robots, "tip", holes)
        passes.run(self.rows, ports, shape, response=response, update=False, noise=1e-20, n_col=n_col)
        return response, passes.collect(shape)

    def jacobian(self, relocate: Relocate | None = None, turning: bool = False) -> Floats:
        """(n, 6, n_tendons + n_segments) change of the tip by tendons (length, or tension where that is the
        mode), then by extensions; with `turning` three columns more, by the rotation vector of the base,
        world.

        All but those of lengths come from central differences of the pass at fixed unknowns, as rows of one
        batch. `relocate` returns what an extension moves besides itself.
        """
        moved, delta, pulled = self._spread(turning)
        (m, n), n_rows = delta.shape, len(self.rows)

        def respond(copies: slice, columns: bool) -> tuple[Response, RodShape]:
            twin = self._copies({name: a[copies] for name, a in moved.items()}, relocate)
            k = len(moved["extension"][copies])
            response, shape = twin.respond(columns)
            return Response(*(_split(a, k) for a in response)), RodShape(*(_split(a, k) for a in shape))

        if n_rows * (1 + 2 * m) <= LANES:  # as fast as without the differences
            return self._combine(*respond(slice(None), True), delta, pulled)
        by_residual = self._close(self.respond()[0])
        by_input, error = np.empty((m, n, 6)), np.empty((m, n, by_residual.shape[2]))
        per = m if 2 * m * n_rows <= _ROWS else 1
        for j in range(0, m, per):
            response, shape = respond(slice(1 + 2 * j, 1 + 2 * (j + per)), False)
            some = slice(j, j + per)
            by_input[some], error[some] = _differences(
                response, shape.tip_position, shape.tip_rotation, delta[some]
            )
        return self._arrange(by_residual, by_input, error, pulled)

    def fits(self, turning: bool) -> bool:
        """`step` is one pass with all its differences."""
        layout = self.passes.layout
        m = (
            len(layout.tendon_segment)
            - len(layout.row_tendon)
            + len(layout.first_tendon)
            + (3 if turning else 0)
        )
        return 0 < len(self.rows) * (1 + 2 * m) <= LANES

    def step(
        self,
        relocate: Relocate | None,
        turning: bool,
        outputs: Literal["full", "tip"],
        process: float,
        noise: float,
    ) -> tuple[RodShape, Floats]:
        """An observer pass of all robots that updates them, and the Jacobian at the shape that it hands out,
        in one: the differences ride in the lanes that a few robots leave empty."""
        passes = self.passes
        moved, delta, pulled = self._spread(turning)
        k, n = 1 + 2 * len(delta), passes.n_robots
        twin = self._copies(moved, relocate)
        n_e, n_col = passes.n_residuals(self.ports), passes.n_columns(self.ports)
        response = Response(
            np.empty((k * n, n_e, n_col)), np.empty((k * n, 6, n_col)), np.empty((k * n, n_e))
        )
        shape = new_shape(twin.passes.layout, twin.passes.n_robots, outputs, False)
        twin.passes.run(
            twin.rows,
            twin.ports,
            shape,
            response=response,
            predict=True,
            propagate=passes.propagate,
            process=process,
            noise=noise,
        )
        twin.passes.collect(shape)
        own: Any
        a: Any
        for own, a in zip(passes.memory, twin.passes.memory, strict=True):
            own[:] = a[: len(own)]
        jacobian = self._combine(
            Response(*(_split(a, k) for a in response)),
            RodShape(*(_split(a, k) for a in shape)),
            delta,
            pulled,
        )
        return RodShape(*(a[: len(a) // k] for a in shape)), jacobian

    def _spread(self, turning: bool) -> tuple[dict[str, Floats], Floats, list[int]]:
        """Ports of 1 + 2 m copies, as they are and then forward and back by each input (1 + 2 m, n, ...), by
        how much (m, n), and the tendons whose input is a tension."""
        layout, params, ports, n = self.passes.layout, self.passes.params, self.ports, self.passes.n_robots
        n_tendons, n_segments = len(layout.tendon_segment), len(layout.first_tendon)
        held = layout.row_tendon.tolist()
        pulled = [] if len(held) == n_tendons else [t for t in range(n_tendons) if t not in held]
        n_inputs = len(pulled) + n_segments
        m = n_inputs + (3 if turning else 0)
        delta = np.full((m, n), 1e-4)
        delta[: len(pulled)] *= params.tension_scale
        delta[len(pulled) : n_inputs] *= params.rod_length
        moved = {
            name: np.empty((1 + 2 * m, n, getattr(ports, name).shape[1]))
            for name in ("tension", "extension", "base_pose")
        }
        for name, a in moved.items():
            a[:] = getattr(ports, name)
        for j in range(n_inputs):
            a, i = (moved["tension"], pulled[j]) if j < len(pulled) else (moved["extension"], j - len(pulled))
            a[1 + 2 * j, :, i] += delta[j]
            a[2 + 2 * j, :, i] -= delta[j]
        if turning:
            rotated = moved["base_pose"][1 + 2 * n_inputs :, :, 3:]
            rotated[:] = (ROTATIONS @ rotated[..., None])[..., 0] / math.sqrt(1.0 + 0.25e-8)
        return moved, delta, pulled

    def _combine(self, response: Response, shape: RodShape, delta: Floats, pulled: list[int]) -> Floats:
        """The Jacobian from the copies of `_spread`."""
        by_residual = self._close(Response(*(a[0] for a in response)))
        differences = _differences(
            Response(*(a[1:] for a in response)), shape.tip_position[1:], shape.tip_rotation[1:], delta
        )
        return self._arrange(by_residual, *differences, pulled)

    def _arrange(self, by_residual: Floats, by_input: Floats, error: Floats, pulled: list[int]) -> Floats:
        layout, (m, n) = self.passes.layout, by_input.shape[:2]
        n_tendons, n_held = len(layout.tendon_segment), len(layout.row_tendon)
        jacobian = np.empty((n, 6, n_tendons + m - len(pulled)))
        jacobian[:, :, layout.row_tendon] = by_residual[:, :, :n_held]
        closed = (by_input - np.matmul(by_residual, error[..., None])[..., 0]).transpose(1, 2, 0)
        jacobian[:, :, pulled] = closed[:, :, : len(pulled)]
        jacobian[:, :, n_tendons:] = closed[:, :, len(pulled) :]
        return jacobian

    def _close(self, response: Response) -> Floats:
        """(n, 6, n_e) change of the tip per residual closed: tendon lengths first."""
        n_x = self.passes.n_x
        return np.asarray(response.tip[:, :, :n_x] @ inverse(response.residual[:, :, :n_x]))

    def _copies(self, moved: dict[str, Floats], relocate: Relocate | None) -> Linear:
        """k copies as rows of one pass, each with its own ports `moved` (k, n, ...)."""
        passes, (k, n) = self.passes, moved["extension"].shape[:2]

        def copied(a: Any) -> Any:
            return np.concatenate([a] * k) if len(a) else a

        if relocate is not None:
            each = [relocate(one) for one in moved["extension"]]
            moved |= {
                name: np.stack([np.broadcast_to(one[name], (n, *one[name].shape[1:])) for one in each])
                for name in each[0]
            }
        moved = {name: a.reshape(k * n, *a.shape[2:]) for name, a in moved.items()}
        ports = Ports(
            *(
                moved[name] if name in moved else a if len(a) == 1 else copied(a)
                for name, a in zip(Ports._fields, self.ports, strict=True)
            )
        )
        params: tuple[Any, ...] = passes.params
        twin = passes.twin(
            k * n,
            Params(*(a if len(a) == 1 else copied(a) for a in params)),
            Memory(*map(copied, passes.peek())),
        )
        rows = (self.rows + n * np.arange(k)[:, None]).ravel()
        return Linear(twin, rows, ports)

    def by_load(self) -> Floats:
        """(n, 6, 6) change of the tip per tip force and moment."""
        response, shape = self.respond()
        n_x, layout, params = self.passes.n_x, self.passes.layout, self.passes.params
        by_unknown = response.tip[:, :, :n_x] @ inverse(response.residual[:, :, :n_x])
        load = np.zeros((*response.error.shape, 6))
        load[:, :, :3] = response.residual[:, :, -3:]
        to_length, row = (params.rod_length / params.moment_scale)[:, None, None], len(layout.row_tendon)
        if not layout.paper:  # there a tip's moment loads the base alone
            load[:, row : row + 3, 3:] = -to_length * np.swapaxes(shape.tip_rotation, 1, 2)
        if len(self.ports.follower_force):
            # the follower force is an unknown; a dead force enters as its column, but not its own row
            load[:, -3:, :3] -= params.rod_length[:, None, None] * to_length * np.eye(3)
        change = -by_unknown @ load
        change[:, :, :3] += response.tip[:, :, -3:]
        return np.asarray(change)


def _split(a: Any, k: int) -> Any:
    """(k, n, ...) of (k n, ...)."""
    return a.reshape(k, len(a) // k, *a.shape[1:])


def _differences(response: Response, p: Floats, r: Floats, delta: Floats) -> tuple[Floats, Floats]:
    """(m, n, 6) and (m, n, n_e): central differences of tip pose (2 m, n, ...) and residuals, forward and
    back by turns."""
    e, change = response.error, np.empty((*delta.shape, 6))
    change[..., :3] = p[::2] - p[1::2]
    change[..., 3:] = rotation_differences(r[::2], r[1::2])
    width = 2.0 * delta[..., None]
    return change / width, (e[::2] - e[1::2]) / width


def rotation_differences(ahead: Floats, behind: Floats) -> Floats:
    """(..., 3) rotation vectors from one rotation (..., 3, 3) to another that is near."""
    rotation = ahead @ np.swapaxes(behind, -1, -2)
    both = ((2, 1), (0, 2), (1, 0))
    return np.stack([0.5 * (rotation[..., i, j] - rotation[..., j, i]) for i, j in both], axis=-1)


def inverse(a: Floats) -> Floats:
    """(n, b, a) least-squares inverses of matrices (n, a, b); nan for those with a number that is not
    finite."""
    found = np.full((len(a), a.shape[2], a.shape[1]), np.nan)
    good = np.isfinite(a).all((1, 2))
    if a.shape[1] == a.shape[2]:
        try:
            found[good] = np.linalg.inv(a[good])
            return found
        except np.linalg.LinAlgError:
            pass
    found[good] = np.linalg.pinv(a[good])
    return found
