"""soromox: piecewise constant and geometric variable strain in JAX, bending alone free, on the rod of
Appendix J and on the rod that is pulled aside and let go.

It has dynamics, forces and Jacobians, but no solver for rest: that is Newton's method on its stiffness
matrix and its forward kinematics, differentiated and compiled by JAX as one would write it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

import appendix_j
import release
from appendix_j import Peer, Rung, Solve

_SMALL = 1e-9  # of the last step, in curvature times length
_MOST = 30

Made = tuple[Any, int, Callable[[Any], Any]]
"""Robot, degrees of freedom, and (along, across) of the tip from them."""


@dataclass(frozen=True, kw_only=True)
class _Rod:
    """A round, straight rod without weight."""

    length: float  # m
    bending: float  # EI [N m^2]
    radius: float  # m
    line_density: float  # kg/m

    def _link(self, segments: int, straight: Sequence[float]) -> Any:
        from soromox.systems.components import LinkSpec

        area = math.pi * self.radius**2
        young = self.bending / (0.25 * area * self.radius**2)
        size = {"length": self.length / segments, "radius": self.radius, "density": self.line_density / area}
        stiffness = {"young_modulus": young, "shear_modulus": young / 3.0}
        return LinkSpec.circular(**size, **stiffness, reference_strain=list(straight))

    def pcs(self, segments: int) -> Made:
        """Constant curvature in each segment, in the plane."""
        import jax.numpy as jnp
        from soromox.systems.pcs import PlanarPCS, PlanarPCSStructure

        selector = jnp.array([True, False, False] * segments)
        bending_only = PlanarPCSStructure(num_gauss_points=5, strain_selector=selector)
        links = [self._link(segments, (0.0, 1.0, 0.0)) for _ in range(segments)]
        still = {"gravity": jnp.zeros(2), "base_pose": jnp.zeros(3)}
        robot = PlanarPCS.from_links(links, structure=bending_only, **still)
        return robot, segments, lambda q: robot.forward_kinematics_tips(q)[-1][1:]

    def gvs(self, order: int, points: int) -> Made:
        """One segment, its curvature in the plane a Legendre series of this order, over so many Gauss
        points."""
        import jax.numpy as jnp
        from soromox.systems.components import JointSpec
        from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec

        basis = StrainBasisSpec(type="legendre", strain_selector=("kappa_z",), basis_order=order)
        link = self._link(1, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
        segment = GVSSegment(link=link, joint=JointSpec(type="fixed"), basis=basis, num_gauss_points=points)
        base = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        robot = GVS.from_segments([segment], gravity=jnp.zeros(3), base_pose=base)
        return robot, order + 1, lambda q: robot.forward_kinematics_tips(q)[-1][:2, 3]


def _compiled(one: Callable[[Any], Any], together: bool) -> Solve:
    """Return what solves one force, compiled: for all forces in one call, or one after the other."""
    import jax

    fast = jax.jit(jax.vmap(one) if together else one)
    return lambda force: np.asarray(fast(force) if together else [fast(across) for across in force])


@contextmanager
def _newton(make: Callable[[], Made], together: bool) -> Iterator[Solve]:
    import jax

    with jax.enable_x64(True):
        import jax.numpy as jnp

        robot, n, tip = make()
        stiffness = robot.stiffness_matrix()
        slope = jax.jacfwd(tip)

        def residual(q: Any, force: Any) -> Any:
            return stiffness @ q - force * slope(q)[1]

        def one(force: Any) -> Any:
            def body(state: Any) -> Any:
                q, _, i = state
                change = jnp.linalg.solve(jax.jacfwd(residual)(q, force), residual(q, force))
                return q - change, jnp.abs(change).max() * appendix_j.LENGTH, i + 1

            start = (jnp.zeros(n), jnp.inf, 0)
            q, _, _ = jax.lax.while_loop(lambda state: (state[1] > _SMALL) & (state[2] < _MOST), body, start)
            return tip(q)[::-1]

        yield _compiled(one, together)


@contextmanager
def _swing(make: Callable[[], Made], rtol: float, together: bool) -> Iterator[Solve]:
    """Its own `rollout_to` with the force as its environment; Tsit5, steps by their error."""
    import jax

    with jax.enable_x64(True):
        import jax.numpy as jnp
        from diffrax import PIDController
        from soromox.systems.system_state import SystemState

        robot, n, tip = make()

        def one(force: Any) -> Any:
            def environment(state: Any) -> Any:
                pull = jnp.where(state.t < release.PULL, jnp.sin(jnp.pi * state.t / release.PULL) ** 2, 0.0)
                _, back = jax.vjp(tip, state.y[:n])
                return back(jnp.array([0.0, 1.0]) * force * pull)[0], None

            moved = robot.rollout_to(
                SystemState(t=jnp.array(0.0), y=jnp.zeros(2 * n)),
                environment_model=environment,
                t1=release.END,
                solver_dt=1e-4,
                save_ts=jnp.array(release.TIMES),
                stepsize_controller=PIDController(rtol=rtol, atol=rtol / release.LENGTH),
                max_steps=1_000_000,
            )
            return jax.vmap(tip)(moved.y[:, :n])[:, ::-1]

        yield _compiled(one, together)


def _both(label: str, solve: Callable[..., Any], *given: Any) -> Rung:
    """One after the other, and all in one call."""
    return Rung(label, partial(solve, *given, False), partial(solve, *given, True))


_PLANE = "constant curvature a segment, plane, shear and stretch left out by its own choice of strains."
_SERIES = "one segment in space, its curvature in the plane a Legendre series, every other strain left out."
_TIME = " Tsit5 of Diffrax, its default, with steps by their error instead of constant ones."
_ALSO = "shear and stretch by choice of strains, derivatives of everything by JAX, GPU, controllers."


def _peer(name: str, same: str, *rungs: Rung) -> Peer:
    return Peer(f"soromox {name}", ("soromox", "jax"), same, f"dynamics, {_ALSO}", rungs)


def _released(name: str, same: str, *rungs: Rung) -> Peer:
    return Peer(f"soromox {name}", ("soromox", "jax", "diffrax"), same + _TIME, _ALSO, rungs)


# radius and density are without influence at rest
_STILL = _Rod(length=appendix_j.LENGTH, bending=appendix_j.BENDING, radius=4e-3, line_density=0.05)
_MOVING = _Rod(
    length=release.LENGTH, bending=release.BENDING, radius=release.RADIUS, line_density=release.DENSITY
)
PCS = _peer(
    "PCS",
    _PLANE,
    *(_both(f"{n} segment{'s' * (n > 1)}", _newton, partial(_STILL.pcs, n)) for n in (1, 4, 16)),
)
# 5 points are its least; each setting takes long to build and to compile
GVS = _peer(
    "GVS",
    _SERIES,
    *(
        _both(f"order {n}, {m} points", _newton, partial(_STILL.gvs, n, m))
        for n, m in ((0, 5), (1, 6), (3, 12))
    ),
)
PCS_RELEASED = _released(
    "PCS",
    _PLANE,
    *(
        _both(f"{n} segments, rtol {to:.0e}", _swing, partial(_MOVING.pcs, n), to)
        for n, to in ((3, 1e-3), (5, 1e-3), (8, 1e-3))
    ),
)
GVS_RELEASED = _released(
    "GVS",
    _SERIES,
    *(
        _both(f"order {n}, {m} points, rtol {to:.0e}", _swing, partial(_MOVING.gvs, n, m), to)
        for n, m, to in ((1, 6, 1e-3), (2, 8, 1e-3), (3, 8, 1e-4))
    ),
)
