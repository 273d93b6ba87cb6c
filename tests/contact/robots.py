"""Robots and inputs that the contact tests share."""

from __future__ import annotations

import numpy as np

from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.types import Floats

OFFSET, LENGTH = 0.0075, 0.07


def prototype(compliance: float = 1e-7) -> Robot:
    """The paper's robot; tendons that hardly stretch hold the mean curvature that they are given."""
    routed = tuple(Tendon(offset=OFFSET, angle=0.5 * np.pi * i, compliance=compliance) for i in range(4))
    rod = Segment(
        length=LENGTH, bending_stiffness=(0.0022, 0.0022), torsional_stiffness=0.001, tendons=routed
    )
    return Robot(name="prototype", segments=(rod,))


def bent(x: float | Floats, y: float | Floats = 0.0) -> Floats:
    """(..., 4) tendon lengths that bend it toward +x and +y by these curvatures [1/m]."""
    angle = 0.5 * np.pi * np.arange(4)
    return LENGTH * (
        1.0 - OFFSET * (np.cos(angle) * np.asarray(x)[..., None] + np.sin(angle) * np.asarray(y)[..., None])
    )


def passive(length: float = 0.3, stiffness: float = 0.02, weight: float = 0.3) -> Robot:
    """A rod without tendons; `weight` [kg/m]."""
    rod = Segment(
        length=length,
        bending_stiffness=(stiffness, stiffness),
        torsional_stiffness=stiffness,
        mode="passive",
        line_density=weight,
    )
    half = np.sqrt(0.5)
    return Robot(name="passive", segments=(rod,), base_quaternion=(float(half), 0.0, float(half), 0.0))
