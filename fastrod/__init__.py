"""fastrod: tendon-driven continuum robots, simulated in batches and corrected by measured data."""

from typing import TYPE_CHECKING, Any

from fastrod.errors import Problem
from fastrod.loading import load_robot
from fastrod.model.robot import Lump, Robot, Segment, Tendon
from fastrod.model.robotfile import robot_names, save_robot
from fastrod.moved import refuse_old_names

if TYPE_CHECKING:
    from fastrod import reference
    from fastrod.hosts.rod import Rod
    from fastrod.simulator import Simulator
    from fastrod.solver.modal import Modes
    from fastrod.solver.state import Observer, Pose, State
    from fastrod.solver.tape import Tips

__all__ = [
    "Lump",
    "Modes",
    "Observer",
    "Pose",
    "Problem",
    "Robot",
    "Rod",
    "Segment",
    "Simulator",
    "State",
    "Tendon",
    "Tips",
    "load_robot",
    "reference",
    "robot_names",
    "save_robot",
]
_HOME = {
    "Modes": "solver.modal",
    "Observer": "solver.state",
    "Pose": "solver.state",
    "Rod": "hosts.rod",
    "Simulator": "simulator",
    "State": "solver.state",
    "Tips": "solver.tape",
}

refuse_old_names()


def __getattr__(name: str) -> Any:
    """The simulator and the twins on first use: numba and scipy take half a second that a robot file does not
    need."""
    import importlib

    if name == "reference":
        return importlib.import_module("fastrod.reference")
    if name in _HOME:
        return getattr(importlib.import_module(f"fastrod.{_HOME[name]}"), name)
    from fastrod.errors import nearest

    raise AttributeError(f"module 'fastrod' has no {name!r}; {nearest(name, __all__)}")
