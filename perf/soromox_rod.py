"""A clamped rod in soromox: piecewise constant and geometric variable strain in JAX, bending alone free."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from appendix_j import Solve

Made = tuple[Any, int, Callable[[Any], Any]]
"""Robot, degrees of freedom, and (along, across) of the tip from them."""


@dataclass(frozen=True, kw_only=True)
class SoromoxRod:
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


def compiled(one: Callable[[Any], Any], together: bool) -> Solve:
    """Return what solves one force, compiled: for all forces in one call, or one after the other."""
    import jax

    fast = jax.jit(jax.vmap(one) if together else one)
    return lambda force: np.asarray(fast(force) if together else [fast(across) for across in force])
