"""The arrays by name: what the kernels read, keep and write.

The robot axis comes first. An array that is the same for all robots may have length 1 on it; one that is not
used has length 0. Frames: world unless "material" is said.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]


class Layout(NamedTuple):
    """Counts and routing: the same for every robot of a batch."""

    first_tendon: Ints
    """(n_segments,) first tendon that crosses the segment; all later ones cross it too."""
    tendon_segment: Ints
    """(n_tendons,) segment at whose end the tendon is fixed."""
    free_tendon: Ints
    """(n_free,) tendons whose tension is unknown: those of `tendon_length` segments."""
    row_tendon: Ints
    """(n_rows,) tendons whose length is a boundary residual: the free ones, or all in paper mode."""
    paper: int
    """1: the paper's reduced model, for the whole chain."""
    n_steps: int
    """Integration steps per segment."""


class Params(NamedTuple):
    """What a robot is."""

    length: Floats
    """(n_robots, n_segments) without extension [m]."""
    offset: Floats
    """(n_robots, n_segments, n_tendons, 2) tendon position in the material frame [m]."""
    compliance: Floats
    """(n_robots, n_tendons) [m/N]."""
    pretension: Floats
    """(n_robots, n_tendons) [N]."""
    unilateral: Flags
    """(n_robots, n_tendons) goes slack at T = 0."""
    moment_scale: Floats
    """(n_robots,) EI/l, smallest EI over the whole length [N m]: makes moments comparable."""
    tension_scale: Floats
    """(n_robots,) EI/(d l), d the mean tendon offset [N]."""
    rod_length: Floats
    """(n_robots,) of the whole robot [m]."""


class Ports(NamedTuple):
    """What the kernel reads at one step; effects change it in place at their seam."""

    tendon_length: Floats
    """(n_robots, n_tendons) absolute, base to where the tendon ends [m]."""
    tension: Floats
    """(n_robots, n_tendons) of `tendon_tension` segments [N]."""
    extension: Floats
    """(n_robots, n_segments) [m]."""
    stiffness: Floats
    """(n_robots, n_segments, n_k, 3) diag K; n_k is 1, or 2 n_steps + 1 at every half step [N m^2]."""
    precurvature: Floats
    """(n_robots, n_segments, n_k, 3) u*, material [1/m]."""
    tip_force: Floats
    """(n_robots, 3) [N]."""
    tip_moment: Floats
    """(n_robots, 3) [N m]."""
    follower_force: Floats
    """(n_robots, 3) at the tip, material; length 0 if there is none [N]."""
    line_force: Floats
    """(n_robots, n_segments, n_f, 3); n_f is 1, or 2 n_steps: at the start and the end of every step, linear
    between [N/m]."""
    node_force: Floats
    """(n_robots, n_points, 3) point forces on nodes; length 0 if there are none [N]."""
    grid: Floats
    """(n_robots, n_segments, n_steps + 1) nodes as fractions of the segment; length 0 if they are even."""
    base_pose: Floats
    """(n_robots, 7) position [m] and quaternion w x y z, world_from_base."""


class Memory(NamedTuple):
    """What the observer carries from one step to the next."""

    x: Floats
    """(n_robots, n_x) boundary unknowns: base moment, material [N m]; tensions of the free tendons [N]; with
    a follower force its world value [N]. Paper mode: m_x and m_y at the base of each segment."""
    covariance: Singles
    """(n_robots, n_x (n_x + 1) / 2) P of the scaled unknowns, lower triangle row by row; length 0 where it is
    not carried."""
    gain: Singles
    """(n_robots, n_x, n_e) change of x per boundary residual, tendon lengths first, which is also that per
    commanded length; where tracked, three columns more for the tip force."""
    move: Singles
    """(n_robots, n_x) first-order change of the scaled unknowns at the last change of inputs."""
    defect: Singles
    """(n_robots, n_x) second-order change of the scaled unknowns at that change: what was foreseen and what
    the pass added."""
    length_before: Floats
    """(n_robots, n_rows) tendon lengths that x belongs to [m]."""
    force_before: Floats
    """(n_robots, 3) tip force that x belongs to; length 0 where not tracked [N]."""
    curvature_guess: Floats
    """(n_robots, 3) u at the base, from which the first cross-section is solved [1/m]."""


class RodShape(NamedTuple):
    """What a pass writes: shapes, units and frames as in `fastrod.solver.state.State`; arrays that are not
    wanted have length 0."""

    position: Floats
    rotation: Floats
    curvature: Floats
    arclength: Floats
    moment: Floats
    """(n_robots, n_points, 3) total internal moment, material [N m]."""
    force: Floats
    """(n_robots, n_points, 3) total internal force beyond the node, world [N]."""
    tip_position: Floats
    tip_rotation: Floats
    tension: Floats
    path_length: Floats
    base_wrench: Floats
    residual: Floats


class Response(NamedTuple):
    """Linear response of a pass, for Jacobian and compliance; arrays of length 0 where not wanted."""

    residual: Floats
    """(n_robots, n_e, n_col) change of the boundary residuals per unknown (and per tip force)."""
    tip: Floats
    """(n_robots, 6, n_col) change of the tip: position, world [m], and rotation vector, world [rad]."""
    error: Floats
    """(n_robots, n_e) the boundary residuals [m]."""


class Surfaces(NamedTuple):
    """The obstacles of a contact scene, each in its own frame; triangles of all meshes stand in the order of
    their hierarchies' leaves."""

    kind: Ints
    """(n_obstacles,) mesh, sphere, box, ...: the codes of `kernels.primitive`."""
    size: Floats
    """(n_obstacles, 3) of a simple shape [m]."""
    sphere: Floats
    """(n_obstacles, 4) centre and radius of a ball that holds the obstacle; radius infinite for a plane
    [m]."""
    friction: Floats
    """(n_obstacles,) Coulomb coefficient against the rod."""
    compliance: Floats
    """(n_obstacles,) depth per normal force; 0 is rigid [m/N]."""
    body: Ints
    """(n_obstacles,) number of the rigid body that it is part of."""
    give: Floats
    """(n_obstacles, 13) how far that body moves within a step under a unit force at its centre of mass [m/N],
    and turns under a unit moment [rad/(N m)], (3, 3) row by row, world; the centre of mass, world [m]. Zero:
    it goes where it is told."""
    root: Ints
    """(n_obstacles,) link to the top of a mesh's hierarchy."""
    box: Floats
    """(n_nodes, 12) boxes of both children: lower corner, upper corner [m]."""
    link: Ints
    """(n_nodes, 2) to both children (`kernels.bvh`)."""
    corner: Floats
    """(n_faces, 9) corners of each triangle [m]."""
    normal: Floats
    """(n_faces, 7, 3) pseudonormals of face, edges ab, bc, ca, corners a, b, c."""


class PointLoads(NamedTuple):
    """Contact points of the robots of one pass, in the order of its rows: loads in, linear response out.
    Length 0 if none."""

    node: Ints
    """(n_rows, n_probes) node that the contact is on; -1 where there is none."""
    force: Floats
    """(n_rows, n_probes, 3) on the rod, world [N]."""
    arm: Floats
    """(n_rows, n_probes, 3) from the centreline to the point of contact, world [m]."""
    motion: Floats
    """(n_rows, 3 n_probes, 1 + 3 n_probes) motion of the contact points, world: first what closing the
    boundary does at these forces [m], then the compliance [m/N]."""
    unknown: Floats
    """(n_rows, n_x, 1 + 3 n_probes) the same of the boundary unknowns."""


class ContactRods(NamedTuple):
    """What contact needs to know of the robots themselves."""

    radius: Floats
    """(n_robots, n_segments) [m]."""
    first: Floats
    """(n_robots,) arclength where contact begins: what is nearer to the base belongs to its mounting [m]."""
    spacing: Floats
    """(n_robots,) length of an integration step [m]."""
    reach: Floats
    """(n_robots,) length of the whole chain [m]."""
    moment_scale: Floats
    """(n_robots,) EI/l [N m]."""
    tension_scale: Floats
    """(n_robots,) EI/(d l) [N]."""
    n_free: int
    """Tendons whose tension is an unknown."""
    n_steps: int
    friction: float
    """Coulomb coefficient of rod on rod."""
    compliance: float
    """Depth per normal force of rod on rod; 0 is rigid [m/N]."""
    own: int
    """1: a rod touches itself too."""


class ContactSet(NamedTuple):
    """The contacts of every robot, kept from one step to the next."""

    used: Ints
    """(n_robots,) slots in use."""
    slot: Floats
    """(n_robots, n_slots, SLOT) the numbers of one contact, in the order of `kernels.slots`."""


class Clearance(NamedTuple):
    """What is known about how far each node is from all obstacles: while it moves less, it need not be asked
    again."""

    distance: Floats
    """(n_robots, n_points) lower bound of the signed distance of the centreline; -inf where nothing is known
    [m]."""
    position: Floats
    """(n_robots, n_points, 3) where that was, world [m]."""
