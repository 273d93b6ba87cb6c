"""Slow, honest twins of the kernels in plain numpy and scipy: what parity tests and timings compare against.

One robot a call and no code shared with the kernels. `shoot` and `solve_bvp` solve the tendon rod of Rucker
and Webster, IEEE T-RO 27(6), 2011, section III (and, in mode `paper`, the reduced one of Kasaei et al., CoRL
2024, eq. 1-3) by two methods; `constant_curvature` is the geometry that needs no mechanics.
"""

from fastrod.reference.arcs import constant_curvature
from fastrod.reference.collocation import solve_bvp
from fastrod.reference.rod import ReferenceShape
from fastrod.reference.shooting import shoot

__all__ = ["ReferenceShape", "constant_curvature", "shoot", "solve_bvp"]
