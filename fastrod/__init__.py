"""fastrod: tendon-driven continuum robots, simulated in batches and corrected by measured data."""

from typing import TYPE_CHECKING, Any

from fastrod.loading import load_robot
from fastrod.robot import Robot, Segment, Tendon
from fastrod.robotfile import robot_names, save_robot

if TYPE_CHECKING:
    from fastrod import reference
    from fastrod.hosts.rod import Rod
    from fastrod.simulator import Simulator
    from fastrod.state import Observer, Pose, State

__all__ = [
    "Observer", "Pose", "Robot", "Rod", "Segment", "Simulator", "State", "Tendon", "load_robot", "reference", "robot_names", "save_robot",
]  # fmt: skip
_HOME = {"Observer": "state", "Pose": "state", "Rod": "hosts.rod", "Simulator": "simulator", "State": "state"}


def __getattr__(name: str) -> Any:
    """The simulator and the twins on first use: numba and scipy take half a second that a robot file does not need."""
    import importlib

    if name == "reference":
        return importlib.import_module("fastrod.reference")
    if name in _HOME:
        return getattr(importlib.import_module(f"fastrod.{_HOME[name]}"), name)
    from fastrod.errors import nearest

    raise AttributeError(f"module 'fastrod' has no {name!r}; {nearest(name, __all__)}")
