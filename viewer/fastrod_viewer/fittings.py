"""Spacer discs on a backbone, and the tendons that run through them."""

from __future__ import annotations

from typing import final

import numpy as np

from fastrod.model.robot import Robot
from fastrod.types import Flags, Floats, Params
from fastrod_viewer import palette
from fastrod_viewer.curves import Nodes, Sampler, pieces
from fastrod_viewer.options import ViewOptions
from fastrod_viewer.palette import Colors, Range
from fastrod_viewer.shapes import Instances, instances

SLACK = 1e-3
"""A tendon that can go slack is drawn so at tensions below this fraction of EI/(d l); one that can push,
below minus that."""

_TENDON_RADIUS = 0.06  # of the smallest tendon offset
_PROBLEM = 0.65  # fraction of the warning in the colour of a robot that is not ok


def warned(color: Colors, bad: Flags) -> Colors:
    """(n_robots, ..., 3) colours, those of `bad` robots reddish."""
    if not bad.any():
        return color
    return np.where(
        bad.reshape(-1, *[1] * (color.ndim - 1)), palette.blend(color, palette.PROBLEM, _PROBLEM), color
    )


def smallest_offset(params: Params) -> float:
    """Smallest offset of all tendons from the backbone [m]; 0 without tendons."""
    distance = np.linalg.norm(params.offset, axis=-1)
    return float(distance[distance > 0.0].min(initial=np.inf)) if distance.any() else 0.0


@final
class Spacers:
    """Discs as wide as the body: one at the base, then about 1.6 body radii apart to the end of every
    segment, where one stands always."""

    def __init__(self, params: Params, radius: Floats, options: ViewOptions, n_steps: int) -> None:
        """`radius` (n_segments,) of the body [m]."""
        segment, fraction, width, thick, color = [0], [0.0], [1.15], [0.35], [palette.BASE]
        for k, (length, r) in enumerate(zip(params.length[0], radius, strict=True)):
            n = max(1, round(float(length / (1.6 * r))))
            segment += [k] * n
            fraction += [(i + 1) / n for i in range(n)]
            width += [1.0] * n
            thick += [0.14] * (n - 1) + [0.28]
            color += [palette.SPACER] * (n - 1)
            color.append(palette.segment_color(k) if options.color_by == "segment" else palette.SEGMENT_END)
        self._scale = np.stack([width, width, thick], axis=1) * radius[segment, None]
        self._color = np.array(color, np.uint8)
        self._sample = Sampler(n_steps, np.array(segment), np.array(fraction))

    def instances(self, rod: Nodes, bad: Flags) -> Instances:
        """(n_robots * n_discs) robot by robot, base first; of `bad` robots reddish."""
        at = self._sample(rod)
        shape = (*at.position.shape[:2], 3)
        color = warned(np.broadcast_to(self._color, shape), bad)
        return instances("disc", at.position, at.quaternion, np.broadcast_to(self._scale, shape), color)


@final
class TendonLines:
    """Lines of tendons at their offsets from the backbone, one for each segment that a tendon crosses."""

    def __init__(
        self, robot: Robot, params: Params, surface: Floats | None, n_steps: int, n_pieces: int
    ) -> None:
        """`surface` (n_segments,) [m]: so far from the backbone, as on the skin of the body; None: where they
        are. `n_pieces` a segment."""
        pairs = [(t, k) for t, end in enumerate(robot.tendon_segment) for k in range(int(end) + 1)]
        self.tendon, self.segment = np.array(pairs, np.int64).reshape(-1, 2).T
        """(n_crossings,) tendon, and segment that it crosses, of each chain."""
        self.n_pieces = n_pieces
        offset = params.offset[:, self.segment, self.tendon]
        if surface is not None:
            offset = offset * (surface[self.segment] / np.linalg.norm(offset, axis=-1))[..., None]
        self._offset: Floats = np.ascontiguousarray(offset)  # (1 or n_robots, n_crossings, 2)
        self._radius = _TENDON_RADIUS * smallest_offset(params)
        self._small = SLACK * params.tension_scale[:, None]
        # the reduced model of the paper has no tensions: it knows of no slack
        self._unilateral = params.unilateral & (robot.segments[0].mode != "paper")
        ends = np.linspace(0.0, 1.0, n_pieces + 1)
        n = robot.n_segments
        self._sample = Sampler(n_steps, np.repeat(np.arange(n), len(ends)), np.tile(ends, n))
        self._n_segments = n

    def instances(self, rod: Nodes, tension: Floats, ok: Flags, colors: Range | None) -> Instances:
        """(n_robots * n_crossings * n_pieces) of `tension` (n_robots, n_tendons) [N], coloured by it within a
        range, which grows with the tensions of robots that are `ok`, or None: by taut, slack and pushing.
        What is not known, nan, is taut."""
        line = pieces(self._sample(rod), self._n_segments, self.segment, self._offset)
        # the arc over the chord, so that a chain is as long as its tendon
        length = line.length * (1.0 + line.bend**2 / 24.0)
        slack = self._unilateral & (tension <= self._small)
        thick = np.where(slack, 0.6 * self._radius, self._radius)[:, self.tendon, None]
        thick = np.broadcast_to(thick, length.shape)
        if colors is None:
            kind = np.where(slack, 1, np.where(~self._unilateral & (tension < -self._small), 2, 0))
            color = np.array([palette.TAUT, palette.SLACK, palette.PUSHING], np.uint8)[kind]
        else:
            known = np.where(np.isfinite(tension), tension, 0.0)
            color = palette.diverging(known, colors.see(known[ok]))
        color = np.broadcast_to(color[:, self.tendon, None], (*length.shape, 3))
        return instances(
            "thin_tube", line.centre, line.quaternion, np.stack([thick, thick, length], axis=-1), color
        )
