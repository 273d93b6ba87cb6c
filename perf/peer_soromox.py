"""soromox on the rod of Appendix J: piecewise constant and geometric variable strain in JAX, bending alone
free.

It has dynamics, forces and Jacobians, but no solver for rest: that is Newton's method on its stiffness
matrix and its forward kinematics, differentiated and compiled by JAX as one would write it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any

from appendix_j import BENDING, LENGTH, Peer, Rung, Solve
from soromox_rod import Made, SoromoxRod, compiled

_SMALL = 1e-9  # of the last step, in curvature times length
_MOST = 30
_ROD = SoromoxRod(length=LENGTH, bending=BENDING, radius=4e-3, line_density=0.05)
"""Radius and density are without influence on the answer."""


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
                return q - change, jnp.abs(change).max() * LENGTH, i + 1

            start = (jnp.zeros(n), jnp.inf, 0)
            q, _, _ = jax.lax.while_loop(lambda state: (state[1] > _SMALL) & (state[2] < _MOST), body, start)
            return tip(q)[::-1]

        yield compiled(one, together)


def _rung(label: str, make: Callable[[], Made]) -> Rung:
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
    [_rung(f"{n} segment{'s' * (n > 1)}", partial(_ROD.pcs, n)) for n in (1, 4, 16)],
)
GVS = _peer(
    "GVS",
    "one segment in space, its curvature in the plane a Legendre series, every other strain left out.",
    # 5 points are its least; each setting takes long to build and to compile
    [_rung(f"order {n}, {m} points", partial(_ROD.gvs, n, m)) for n, m in ((0, 5), (1, 6), (3, 12))],
)
