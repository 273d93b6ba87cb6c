"""soromox on the rod that is pulled aside and let go: piecewise constant and geometric variable strain in
JAX, bending alone free."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

from appendix_j import Peer, Rung, Solve
from release import BENDING, DENSITY, END, LENGTH, PULL, RADIUS, TIMES
from soromox_rod import Made, SoromoxRod, compiled

_ROD = SoromoxRod(length=LENGTH, bending=BENDING, radius=RADIUS, line_density=DENSITY)


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

        yield compiled(one, together)


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
    *((f"{n} segments", partial(_ROD.pcs, n), to) for n, to in ((3, 1e-3), (5, 1e-3), (8, 1e-3))),
)
GVS = _peer(
    "GVS",
    "one segment in space, its curvature in the plane a Legendre series, every other strain left out.",
    *(
        (f"order {n}, {m} points", partial(_ROD.gvs, n, m), to)
        for n, m, to in ((1, 6, 1e-3), (2, 8, 1e-3), (3, 8, 1e-4))
    ),
)
