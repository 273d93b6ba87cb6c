"""soromox on the rod of Appendix J: piecewise constant and geometric variable strain in JAX, bending alone
free.

It has dynamics, forces and Jacobians, but no solver for rest: that is Newton's method on its stiffness
matrix and its forward kinematics, differentiated and compiled by JAX as one would write it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

from appendix_j import BENDING, LENGTH, Array, Peer, Rung, Solve

_RADIUS, _DENSITY = 4e-3, 1e3  # m, kg/m^3: without influence on the answer
_SMALL = 1e-9  # of the last step, in curvature times length
_MOST = 30


def _link(segments: int, straight: Sequence[float]) -> Any:
    from soromox.systems.components import LinkSpec

    young = BENDING / (0.25 * math.pi * _RADIUS**4)
    size = {"length": LENGTH / segments, "radius": _RADIUS, "density": _DENSITY}
    stiffness = {"young_modulus": young, "shear_modulus": young / 3.0}
    return LinkSpec.circular(**size, **stiffness, reference_strain=list(straight))


def _pcs(segments: int) -> tuple[Any, int, Callable[[Any], Any]]:
    """Robot, degrees of freedom, and (along, across) of the tip from them."""
    import jax.numpy as jnp
    from soromox.systems.pcs import PlanarPCS, PlanarPCSStructure

    selector = jnp.array([True, False, False] * segments)
    bending_only = PlanarPCSStructure(num_gauss_points=5, strain_selector=selector)
    links = [_link(segments, (0.0, 1.0, 0.0)) for _ in range(segments)]
    robot = PlanarPCS.from_links(links, structure=bending_only, gravity=jnp.zeros(2), base_pose=jnp.zeros(3))
    return robot, segments, lambda q: robot.forward_kinematics_tips(q)[-1][1:]


def _gvs(order: int, points: int) -> tuple[Any, int, Callable[[Any], Any]]:
    """One segment, its curvature in the plane a Legendre series of this order, over so many Gauss points."""
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
def _newton(make: Callable[[], tuple[Any, int, Callable[[Any], Any]]], together: bool) -> Iterator[Solve]:
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
                return q - change, jnp.abs(change).max() * LENGTH, i + 1

            start = (jnp.zeros(n), jnp.inf, 0)
            q, _, _ = jax.lax.while_loop(lambda state: (state[1] > _SMALL) & (state[2] < _MOST), body, start)
            return tip(q)[::-1]

        compiled = jax.jit(jax.vmap(one) if together else one)

        def solve(force: Array) -> Array:
            return np.asarray(compiled(force) if together else [compiled(across) for across in force])

        yield solve


def _rung(label: str, make: Callable[[], tuple[Any, int, Callable[[Any], Any]]]) -> Rung:
    return Rung(label, partial(_newton, make, False), partial(_newton, make, True))


def _peer(name: str, same: str, rungs: Sequence[Rung]) -> Peer:
    return Peer(
        name=f"soromox {name}",
        modules=("soromox", "jax"),
        same=same,
        also="dynamics, shear and stretch by choice of strains, derivatives of everything by JAX, GPU, "
        "controllers.",
        rungs=rungs,
    )


PCS = _peer(
    "PCS",
    "constant curvature a segment, plane, shear and stretch left out by its own choice of strains.",
    [_rung(f"{n} segment{'s' * (n > 1)}", partial(_pcs, n)) for n in (1, 4, 16)],
)
GVS = _peer(
    "GVS",
    "one segment in space, its curvature in the plane a Legendre series, every other strain left out.",
    # 5 points are its least; each setting takes long to build and to compile
    [_rung(f"order {n}, {m} points", partial(_gvs, n, m)) for n, m in ((0, 5), (1, 6), (3, 12))],
)
