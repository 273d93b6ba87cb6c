"""Data sets in shards: shapes, rollouts and identification sweeps, on the cores here or on a Ray cluster; see
README.md here."""

from __future__ import annotations

from fastrod.generation.plan import Plan, read_plan
from fastrod.generation.rollouts import Rollouts
from fastrod.generation.run import Summary, generate
from fastrod.generation.shapes import Shapes
from fastrod.generation.sweep import Sweep
from fastrod.generation.trajectories import Trajectories

__all__ = ["Plan", "Rollouts", "Shapes", "Summary", "Sweep", "Trajectories", "generate", "read_plan"]
