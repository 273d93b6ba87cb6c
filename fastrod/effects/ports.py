"""`EffectPorts`: what an effect may read and change, a row for each robot (or for each sample of a log)."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from fastrod.errors import EffectError, nearest
from fastrod.model.routing import Routing
from fastrod.rotation import matrix_from_quaternion, product, quaternion_from_vector
from fastrod.types import Floats, Params, Ports

CHANGEABLE = (
    "tendon_length",
    "tension",
    "base_pose",
    "extension",
    "offset",
    "compliance",
    "pretension",
    "stiffness",
    "precurvature",
    "rest_bend",
    "tip_force",
    "tip_moment",
    "line_force",
)
"""Ports that an effect before the camera may change."""


def _none() -> Floats:
    return np.empty((0, 0, 3))


@dataclass
class EffectPorts:
    """The ports of a step with the robot's own numbers beside them; every array has its row axis expanded and
    may be changed in place, unless "read" is said. World frame unless said otherwise."""

    routing: Routing
    """Read: how tendons and bends hang together."""
    rest_length: Floats
    """Read: (n_tendons,) lengths of the straight rest robot [m]."""
    gravity: Floats
    """Read: (n, 3) [m/s^2]."""
    base_rotation: Floats
    """Read: (n, 3, 3) world_from_base."""
    time: Floats
    """Read: (n,) since the start of the run [s]."""
    tendon_length: Floats
    """(n, n_tendons) absolute [m]; change it through `shift_tendons`, `shift_bend`. Where forces drive the
    tendons, the rest length less the force [N]: see `Routing`."""
    extension: Floats
    """(n, n_segments) [m]."""
    offset: Floats
    """(n, n_segments, n_tendons, 2) tendon positions in the material frame [m]."""
    compliance: Floats
    """(n, n_tendons) [m/N]."""
    pretension: Floats
    """(n, n_tendons) of tendons at their rest length [N]."""
    tension: Floats
    """(n, n_tendons) that is commanded where a segment is driven by tension [N]; nothing reads the others."""
    base_pose: Floats
    """(n, 7) position [m] and unit quaternion w x y z, world_from_base; change it through `move_base`.
    `measure` goes by the base as it then stands, as a camera on it does; `base_rotation` stays that of the
    command."""
    stiffness: Floats
    """(n, n_segments, n_k, 3) diag K, n_k 1 or 2 n_steps + 1 [N m^2]; see `resolve`."""
    precurvature: Floats
    """(n, n_segments, n_k, 3) u*, material frame [1/m]."""
    rest_bend: Floats
    """(n, n_segments, 2) bend without moments beside `precurvature`, uniform in a segment [rad]."""
    tip_force: Floats
    """(n, 3) [N]."""
    tip_moment: Floats
    """(n, 3) [N m]."""
    line_force: Floats
    """(n, n_segments, n_f, 3) [N/m]."""
    n_steps: int
    """Read: integration steps of a segment."""
    stateless: bool = False
    """Read: rows are samples of a log; no state is carried from one to the next."""
    state: Any = None
    """Read: the last `State`, as `apply` has it."""
    solved_tension: Floats = field(default_factory=lambda: np.zeros((1, 1)))
    """Read: (n, n_tendons) or (1, 1) of the last solution, for effects that read it; 0 before the first
    [N]."""
    solved_bend: Floats = field(default_factory=lambda: np.zeros((1, 1, 2)))
    """Read: (n, n_segments, 2) about d1 and d2 of the last solution, for effects that read it; 0 before the
    first [rad]."""
    point_forces: list[tuple[Floats, Floats]] = field(default_factory=list)
    """Arclength (n,) [m] and force (n, 3) [N] of each that effects have added through `add_point_force`."""
    tip_position: Floats = field(default_factory=_none)
    """SENSING, and effects that feel the tip, only: (n, 3) base frame [m]."""
    tip_rotation: Floats = field(default_factory=_none)
    """SENSING only: (n, 3, 3) base_from_tip."""
    points: Floats = field(default_factory=_none)
    """SENSING only: (n, k, 3) further measured points, base frame [m]."""

    def __len__(self) -> int:
        return len(self.time)

    def rows(self, which: slice) -> EffectPorts:
        """A copy of some rows."""
        alike = ("routing", "rest_length", "n_steps", "stateless", "state", "solved_tension", "solved_bend")
        return EffectPorts(
            **{
                f.name: getattr(self, f.name) if f.name in alike else getattr(self, f.name)[which].copy()
                for f in fields(self)
                if f.name != "point_forces"
            }
        )

    @property
    def dl(self) -> Floats:
        """(n, n_tendons) tendon lengths against the straight rest robot [m], a new array."""
        return self.tendon_length - self.rest_length

    def bend(self) -> Floats:
        """(n, n_segments, 2) bend about d1 and d2 that the tendons ask for now [rad], a new array."""
        return self.routing.bend(self.dl)

    def common(self) -> Floats:
        """(n, n_segments) change of length that the tendons of a segment share, beyond that of the segment
        before [m]."""
        odd = self.dl - self.routing.tendon_change(self.bend())
        ends = np.zeros((len(odd), self.routing.n_segments))
        for k in range(self.routing.n_segments):
            if (own := self.routing.tendon_segment == k).any():
                ends[:, k] = odd[:, own].mean(1)
            elif k:
                ends[:, k] = ends[:, k - 1]
        return np.diff(ends, axis=1, prepend=0.0)

    def shift_bend(self, change: Floats) -> None:
        """Let the tendons ask for another bend: (n, n_segments, 2) [rad] more."""
        self.tendon_length += self.routing.tendon_change(change)

    def shift_tendons(self, change: Floats) -> None:
        """Change tendon lengths by (n, n_tendons) [m], the part of it that bends.

        A change that all tendons of a segment share would be taken up by tendons and backbone; between stiff
        tendons and an incompressible rod it would only be tension without bound. Of forces all is
        taken.
        """
        if self.routing.by_tension:
            self.tendon_length += change
        else:
            self.shift_bend(self.routing.bend(change))

    def move_base(self, shift: Floats, rotation: Floats) -> None:
        """Move the base by (n, 3) [m] and about itself by rotation vectors (n, 3) [rad], both world: a mount
        that gives."""
        self.base_pose[:, :3] += shift
        self.base_pose[:, 3:] = product(quaternion_from_vector(rotation), self.base_pose[:, 3:])

    def resolve(self) -> None:
        """Give `stiffness` and `precurvature` a value at every half step, n_k = 2 n_steps + 1: the kernel
        wants both alike."""
        n_k = 2 * self.n_steps + 1
        for name in ("stiffness", "precurvature"):
            port = getattr(self, name)
            setattr(self, name, np.array(np.broadcast_to(port, (*port.shape[:2], n_k, 3)), order="C"))

    @property
    def fraction(self) -> Floats:
        """(2 n_steps + 1,) s / l at every half step."""
        return np.linspace(0.0, 1.0, 2 * self.n_steps + 1)

    def add_line_force(self, force: Floats) -> None:
        """Add (n, n_segments, 3) [N/m], uniform over each segment."""
        self.line_force += force[:, :, None, :]

    def add_point_force(
        self, arclength: ArrayLike, force: ArrayLike, frame: Literal["world", "material"] = "world"
    ) -> None:
        """Add (n, 3) or (3,) [N] at arclengths (n,), or one for all [m]; beyond the tip is at the tip.

        A "material" force is along d1, d2, d3 of the cross-section where it acts, as it stood in the last
        state; before the first, as in the straight rod. Raises `EffectError` for another frame, for a shape
        that does not fit, and for a material force where no shape is carried: over a log, and with
        outputs="tip".
        """
        n = len(self)
        try:
            at = np.array(np.broadcast_to(np.asarray(arclength, float), (n,)))
            vector = np.array(np.broadcast_to(np.asarray(force, float), (n, 3)))
        except (TypeError, ValueError) as error:
            raise EffectError(
                f"a point force has arclength of shape {np.shape(arclength)} and force of shape "
                f"{np.shape(force)}; give ({n},) [m] and ({n}, 3) [N]."
            ) from error
        if frame == "material":
            vector = np.einsum("nij,nj->ni", self._cross_section(at), vector)
        elif (given := str(frame)) != "world":  # a law of somebody's package may say anything
            raise EffectError(f"no frame {given!r} of a point force; {nearest(given, ('world', 'material'))}")
        self.point_forces.append((at, vector))

    def _cross_section(self, arclength: Floats) -> Floats:
        """(n, 3, 3) world_from_material at (n,) [m]: the last state's, on the base where it is now."""
        base, last = matrix_from_quaternion(self.base_pose[:, 3:]), self.state
        if self.stateless or (last is not None and not len(last.arclength)):
            where = "over a log no state is carried" if self.stateless else "outputs='tip' keeps no shape"
            raise EffectError(f"a point force in the material frame goes by the last shape; {where}.")
        if last is None:
            return base
        row = np.arange(len(self))
        node = np.abs(last.arclength - arclength[:, None]).argmin(1)
        beyond = (arclength - last.arclength[row, node])[:, None] * last.curvature[row, node]
        there = last.rotation[row, node] @ matrix_from_quaternion(quaternion_from_vector(beyond))
        found = base @ np.swapaxes(last.rotation[:, 0], 1, 2) @ there
        return np.where(np.isfinite(found).all((1, 2))[:, None, None], found, base)


def _rows(a: Floats, n: int) -> Floats:
    out = np.empty((n, *a.shape[1:]))
    out[:] = a
    return out


def open_ports(
    ports: Ports,
    params: Params,
    routing: Routing,
    *,
    n: int,
    rest_length: Floats,
    gravity: Floats,
    base_rotation: Floats,
    time: Floats,
    n_steps: int,
    stateless: bool = False,
) -> EffectPorts:
    """The ports of a step with a row for each of `n` robots, ready to be changed."""
    length = rest_length - ports.tension if routing.by_tension else ports.tendon_length
    return EffectPorts(
        routing=routing,
        rest_length=rest_length,
        gravity=np.broadcast_to(gravity, (n, 3)),
        base_rotation=np.broadcast_to(base_rotation, (n, 3, 3)),
        time=np.broadcast_to(time, (n,)),
        tendon_length=_rows(length, n),
        extension=_rows(ports.extension, n),
        offset=_rows(params.offset, n),
        compliance=_rows(params.compliance, n),
        pretension=_rows(params.pretension, n),
        tension=_rows(ports.tension, n),
        base_pose=_rows(ports.base_pose, n),
        stiffness=_rows(ports.stiffness, n),
        precurvature=_rows(ports.precurvature, n),
        rest_bend=np.zeros((n, routing.n_segments, 2)),
        tip_force=_rows(ports.tip_force, n),
        tip_moment=_rows(ports.tip_moment, n),
        line_force=_rows(ports.line_force, n),
        n_steps=n_steps,
        stateless=stateless,
    )


def driven(opened: EffectPorts, ports: Ports) -> tuple[Floats, Floats]:
    """Tendon lengths [m] and tensions [N] that the kernel reads, of ports that effects have changed."""
    if not opened.routing.by_tension:
        return opened.tendon_length, opened.tension
    # 0, and no rounding, where no effect has changed anything
    change = (opened.rest_length - ports.tension) - opened.tendon_length
    return ports.tendon_length, opened.tension + change


def close_ports(
    opened: EffectPorts, ports: Ports, params: Params
) -> tuple[Ports, Params, list[tuple[Floats, Floats]]]:
    """Return what the kernel reads, from ports that effects have changed, and the point forces (arclength
    (n,) [m], force (n, 3) world [N]) that they have added."""
    precurvature = np.ascontiguousarray(opened.precurvature)
    if opened.rest_bend.any():
        precurvature = precurvature.copy()
        precurvature[..., :2] += (opened.rest_bend / opened.routing.length[:, None])[:, :, None]
    length, tension = driven(opened, ports)
    return (
        ports._replace(
            tendon_length=length,
            tension=tension,
            base_pose=opened.base_pose,
            extension=opened.extension,
            stiffness=np.ascontiguousarray(opened.stiffness),
            precurvature=precurvature,
            tip_force=opened.tip_force,
            tip_moment=opened.tip_moment,
            line_force=np.ascontiguousarray(opened.line_force),
        ),
        params._replace(offset=opened.offset, compliance=opened.compliance, pretension=opened.pretension),
        [
            (np.minimum(arclength, (params.length + opened.extension).sum(1)), force)
            for arclength, force in opened.point_forces
        ],
    )
