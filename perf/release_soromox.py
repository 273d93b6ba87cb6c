"""soromox on the rod that is pulled aside and let go: piecewise constant and geometric variable strain in
JAX, bending alone free."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from appendix_j import Array, Peer, Rung, Solve
from release import BENDING, DENSITY, END, LENGTH, PULL, RADIUS, TIMES

Made = tuple[Any, int, Callable[[Any], Any]]
"""Robot, degrees of freedom, and (along, across) of the tip from them."""


def _link(segments: int, straight: Sequence[float]) -> Any:
    from soromox.systems.components import LinkSpec

    area = math.pi * RADIUS**2
    young = BENDING / (0.25 * area * RADIUS**2)
    size = {"length": LENGTH / segments, "radius": RADIUS, "density": DENSITY / area}
    stiffness = {"young_modulus": young, "shear_modulus": young / 3.0}
    return LinkSpec.circular(**size, **stiffness, reference_strain=list(straight))


def _pcs(segments: int) -> Made:
    import jax.numpy as jnp
    from soromox.systems.pcs import PlanarPCS, PlanarPCSStructure

    selector = jnp.array([True, False, False] * segments)
    bending_only = PlanarPCSStructure(num_gauss_points=5, strain_selector=selector)
    links = [_link(segments, (0.0, 1.0, 0.0)) for _ in range(segments)]
    robot = PlanarPCS.from_links(links, structure=bending_only, gravity=jnp.zeros(2), base_pose=jnp.zeros(3))
    return robot, segments, lambda q: robot.forward_kinematics_tips(q)[-1][1:]


def _gvs(order: int, points: int) -> Made:
    import jax.numpy as jnp
    from soromox.systems.components import JointSpec
    from soromox.systems.gvs import GVS, GVSSegment, StrainBasisSpec

    basis = StrainBasisSpec(type="legendre", strain_selector=("kappa_z",), basis_order=order)
    link = _link(1, (0.0, 0.0, 0.0, 1.0, 0.0, 0.0))
    segment = GVSSegment(link=link, joint=JointSpec(type="fixed"), basis=basis, num_gauss_points=points)
    base = jnp.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    robot = GVS.from_segments([segment], gravity=jnp.zeros(3), base_pose=base)
    return robot, order + 1, lambda q: robot.forward_kinematics_tips(q)[-1][:2, 3]


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
                pull = jnp.where(state.t < PULL, jnp.sin(jnp.pi * state.t / PULL) ** 2, 0.0)
                _, back = jax.vjp(tip, state.y[:n])
                return back(jnp.array([0.0, 1.0]) * force * pull)[0], None

            moved = robot.rollout_to(
                SystemState(t=jnp.array(0.0), y=jnp.zeros(2 * n)),
                environment_model=environment,
                t1=END,
                solver_dt=1e-4,
                save_ts=jnp.array(TIMES),
                stepsize_controller=PIDController(rtol=rtol, atol=rtol / LENGTH),
                max_steps=1_000_000,
            )
            return jax.vmap(tip)(moved.y[:, :n])[:, ::-1]

        compiled = jax.jit(jax.vmap(one) if together else one)

        def solve(force: Array) -> Array:
            return np.asarray(compiled(force) if together else [compiled(across) for across in force])

        yield solve


def _peer(name: str, same: str, *settings: tuple[str, Callable[[], Made], float]) -> Peer:
    rungs = [
        Rung(f"{label}, rtol {to:.0e}", partial(_swing, make, to, False), partial(_swing, make, to, True))
        for label, make, to in settings
    ]
    return Peer(
        name=f"soromox {name}",
        modules=("soromox", "jax", "diffrax"),
        same=same + " Tsit5 of Diffrax, its default, with steps by their error instead of constant ones.",
        also="shear and stretch by choice of strains, derivatives of everything by JAX, GPU, controllers.",
        rungs=rungs,
    )


PCS = _peer(
    "PCS",
    "constant curvature a segment, plane, shear and stretch left out by its own choice of strains.",
    *((f"{n} segments", partial(_pcs, n), to) for n, to in ((3, 1e-3), (5, 1e-3), (8, 1e-3))),
)
GVS = _peer(
    "GVS",
    "one segment in space, its curvature in the plane a Legendre series, every other strain left out.",
    *(
        (f"order {n}, {m} points", partial(_gvs, n, m), to)
        for n, m, to in ((1, 6, 1e-3), (2, 8, 1e-3), (3, 8, 1e-4))
    ),
)
