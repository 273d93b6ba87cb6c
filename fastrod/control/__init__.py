"""Tip control: trajectories, the kinematics of a soft robot on a base that moves, and resolved rates."""

from fastrod.control.kinematics import Arm, BaseKinematics, FixedBase, MovingBase, SoftTip
from fastrod.control.resolved_rate import ResolvedRate, scaled_rates
from fastrod.control.trajectories import (
    Trajectory,
    circle,
    figure_eight,
    helix,
    names,
    references,
    square,
    square_helix,
    trajectory,
    triangle,
)

__all__ = [
    "Arm",
    "BaseKinematics",
    "FixedBase",
    "MovingBase",
    "ResolvedRate",
    "SoftTip",
    "Trajectory",
    "circle",
    "figure_eight",
    "helix",
    "names",
    "references",
    "scaled_rates",
    "square",
    "square_helix",
    "trajectory",
    "triangle",
]
