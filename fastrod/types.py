"""The arrays by name: what the kernels read, keep and write.

The robot axis comes first. An array that is the same for all robots may have length 1 on it; one that is not
used has length 0. Frames: world unless "material" is said.
"""

from __future__ import annotations

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Singles: TypeAlias = NDArray[np.float32]
Ints: TypeAlias = NDArray[np.int64]
Flags: TypeAlias = NDArray[np.bool_]
Records: TypeAlias = NDArray[Any]
"""An array of records (`_record`); mypy does not know their fields."""


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
    """Parameters of robots."""

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
    """Inputs that the kernel reads at one step; effects change it in place at their seam."""

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
    follower_line: Floats
    """(n_robots, n_segments, n_f, 3) material, else as `line_force`; length 0 if there is none [N/m]."""
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
    """Memory of the observer from one step to the next."""

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
    """Output of a pass: shapes, units and frames as in `fastrod.solver.state.State`; arrays that are not
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

    primitive: Ints
    """(n_obstacles, 3) addresses, in this process, of the compiled distance and curvature of a simple shape
    (`kernels.contact.primitive`), 0 for a mesh; and of a distance that stands for the search of a mesh, 0
    where the kernels' own is meant."""
    size: Floats
    """(n_obstacles, 3) of a simple shape [m]; a mesh's number for the distance that stands for its search."""
    sphere: Floats
    """(n_obstacles, 4) centre and radius of a ball that holds the obstacle; radius infinite for a plane
    [m]."""
    convex: Flags
    """(n_obstacles,) which are convex: every simple shape is."""
    friction: Floats
    """(n_obstacles,) Coulomb coefficient against the rod."""
    compliance: Floats
    """(n_obstacles,) depth per normal force; 0 is rigid [m/N]."""
    body: Ints
    """(n_obstacles,) number of the rigid body that it is part of."""
    mobility: Floats
    """(n_obstacles, 6, 6) displacement [m] and rotation [rad] of that body within a step by a force [N] at
    its `center` and a moment [N m], world. Zero: it is not free, its pose is prescribed."""
    center: Floats
    """(n_obstacles, 3) of that body, world [m]."""
    ahead: Floats
    """(n_obstacles, 6) by how much its pose is beyond where it would be without the rods [m, rad]."""
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


def _record(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    """A dtype whose elements have their fields as attributes, in Python as in a kernel. (No field may have
    the name of an attribute that numpy gives every element, such as `size`.)"""
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


CONTACT = _record(
    ("obstacle", np.int64),
    ("partner", np.int64),
    ("arclength", np.float64),
    ("normal", np.float64, (3,)),
    ("gap", np.float64),
    ("force", np.float64, (3,)),
    ("radius", np.float64),
    ("held", np.float64, (3,)),
    ("slid", np.float64),
    ("place", np.float64, (3,)),
    ("matched", np.bool_),
)
"""One contact of a rod. obstacle: its index, from n_obstacles on a rod's; partner: number that both sides of
a contact between rods share, or -1; arclength [m]; normal: toward the rod, world; gap [m]; force: on the
rod, world [N]; radius: of the rod there [m]; held: the part of the force along the surface at the last step's
end, world [N]; slid: how far it has slipped in this one [m]; place: of the centreline in the obstacle when it
was measured last [m]; matched: a candidate of this pass belongs to it."""

CANDIDATE = _record(
    ("obstacle", np.int64), ("arclength", np.float64), ("gap", np.float64), ("normal", np.float64, (3,))
)
"""A local minimum of the gap along a rod: where a contact may be needed."""

WALL = _record(("distance", np.float64), ("normal", np.float64, (3,)), ("triangle", np.int64))
"""A face of a mesh that a point is in front of."""

SAMPLE = _record(("fraction", np.float64), ("distance", np.float64), ("slope", np.float64))
"""Signed distance of the centreline and its slope along the rod, at a fraction of an interval."""


class ContactRods(NamedTuple):
    """Data of the robots that contact needs."""

    radius: Floats
    """(n_robots, n_segments) [m]."""
    first: Floats
    """(n_robots,) arclength where contact begins: what is nearer to the base belongs to its mounting [m]."""
    spacing: Floats
    """(n_robots,) length of an integration step [m]."""
    length: Floats
    """(n_robots,) of the whole chain [m]."""
    n_steps: int
    friction: float
    """Coulomb coefficient of rod on rod."""
    compliance: float
    """Depth per normal force of rod on rod; 0 is rigid [m/N]."""
    own: int
    """1: a rod touches itself too."""


class ContactMotion(NamedTuple):
    """Rods and obstacles in one pass, and at the last step.

    The rods' arrays one by one, for numba hands no tuple of tuples to threads.
    """

    frames: Floats
    """(1 or n_robots, n_obstacles, 12) rotation row by row, position: world_from_obstacle."""
    frames_before: Floats
    """(1 or n_robots, n_obstacles, 12) when the rods were in the shape before."""
    frames_slip: Floats
    """(1 or n_robots, n_obstacles, 12) where the obstacles' material was at the last step: what slip is
    counted from. Another than `frames_before` where a velocity was given (a belt moves, its frame does
    not)."""
    position: Floats
    rotation: Floats
    curvature: Floats
    arclength: Floats
    """These four as in `RodShape`."""
    position_before: Floats
    rotation_before: Floats
    curvature_before: Floats
    arclength_before: Floats
    """Cross-sections from which the rods have come, having met nothing since."""
    position_slip: Floats
    rotation_slip: Floats
    curvature_slip: Floats
    arclength_slip: Floats
    """The shapes at the last step: what slip is counted from."""
    distance: Floats
    measured_at: Floats
    gap: Floats
    """The fields of `Clearance`, to be kept up to date."""
    tracked: Flags
    """(n_robots,) the shape before holds where the robot was."""
    slides: Flags
    """(n_robots,) slip is counted from there; where not, friction is left out."""
    tolerance: float
    """Violation that counts as none [m]."""
    margin: float
    """Gap below which a contact is watched, as a fraction of the rod's length."""


class ContactSet(NamedTuple):
    """The contacts of every robot, kept from one step to the next."""

    used: Ints
    """(n_robots,) how many each has."""
    contact: Records
    """(n_robots, max_contacts) of `CONTACT`."""


class Clearance(NamedTuple):
    """Distances that are known between each robot and all obstacles: while a node moves less, its own need
    not be evaluated again."""

    distance: Floats
    """(n_robots, n_points) lower bound of the signed distance of the centreline; -inf where nothing is known
    [m]."""
    position: Floats
    """(n_robots, n_points, 3) where that was, world [m]."""
    gap: Floats
    """(n_robots,) smallest gap of the rod's surface to anything [m]."""


class ContactRows(NamedTuple):
    """Robots, world by world."""

    start: Ints
    """(n_worlds + 1,) first row of each world (the robots that may touch each other), with the end at
    last."""
    robot: Ints
    """(n_rows,) index of the robot."""


class SearchWork(NamedTuple):
    """Workspace of a search; in the arguments of a batch with an axis more at first, one part of it a
    thread."""

    known: Floats
    """(n_points,) lower bound of each node's distance from all obstacles [m]."""
    least: Floats
    """(n_points,) smallest distance that was evaluated [m]."""
    phi: Floats
    """(n_points,) signed distance of one obstacle [m]."""
    slope: Floats
    """(n_points,) its slope along the rod."""
    sample: Records
    """(n_samples,) of `SAMPLE`: the halves of one interval."""
    stack: Floats
    """Links of a mesh's hierarchy that wait (`kernels.contact.bvh`)."""
