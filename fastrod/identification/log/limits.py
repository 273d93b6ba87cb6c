"""What no effect of the library can carry, because the rod's state does not hold it; said where a robot is
likely to show it."""

from __future__ import annotations

import math

from fastrod.identification.log.forward import LogSamples
from fastrod.model.robot import Robot

_SHEAR = 2.65  # (r / l)^2 times this is shear over bending at the tip: 3 EI / (k G A l^2), E = 3 G, circle
_WORTH_SAYING = 0.03
_SLOW = 10.0  # Hz; a rod that rings more slowly shows it


def limits(robot: Robot, samples: LogSamples) -> list[str]:
    """Sentences on shear and inertia, where this robot is thick or slow enough for them."""
    found = []
    thickest = max((s.body_radius / robot.length for s in robot.segments), default=0.0)
    if (fraction := _SHEAR * thickest**2) > _WORTH_SAYING:
        found.append(
            f"shear is not the rod's: {1.0 / (2.0 * thickest):.1f} times as long as thick, it is some "
            f"{100 * fraction:.0f} % of the deflection"
        )
    mass = sum(s.line_density * s.length for s in robot.segments)
    if mass > 0.0:
        soft = min(min(s.bending_stiffness) for s in robot.segments)
        frequency = 0.56 * math.sqrt(soft / (mass * robot.length**3))
        steps = sorted(samples.dt[samples.dt > 0.0].tolist())
        if frequency < _SLOW and steps and 2.0 * frequency * steps[len(steps) // 2] < 1.0:
            found.append(
                f"inertia and damping are not the rod's: it rings near {frequency:.1f} Hz, which a "
                "static model cannot follow"
            )
    return found
