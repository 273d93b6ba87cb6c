"""fastrod: tendon-driven continuum robots, simulated in batches and corrected by measured data."""

from typing import TYPE_CHECKING, Any

from fastrod.errors import Problem
from fastrod.loading import load_robot
from fastrod.model.robot import Lump, Robot, Segment, Tendon
from fastrod.model.robotfile import robot_names, save_robot

if TYPE_CHECKING:
    from fastrod import reference
    from fastrod.contact.scene import ContactScene
    from fastrod.hosts.rod import Rod
    from fastrod.identification.attribution import identify
    from fastrod.identification.log.check import check
    from fastrod.identification.log.replay import replay
    from fastrod.logs.reader import read_log
    from fastrod.logs.runlog import RunLog, write_log
    from fastrod.simulator import Simulator
    from fastrod.solver.options import Modal, Modes, Observer
    from fastrod.solver.state import Pose, State
    from fastrod.solver.tape import Tips
    from fastrod_viewer.live import view

__all__ = [
    "ContactScene",
    "Lump",
    "Modal",
    "Modes",
    "Observer",
    "Pose",
    "Problem",
    "Robot",
    "Rod",
    "RunLog",
    "Segment",
    "Simulator",
    "State",
    "Tendon",
    "Tips",
    "check",
    "identify",
    "load_robot",
    "read_log",
    "reference",
    "replay",
    "robot_names",
    "save_robot",
    "view",
    "write_log",
]
_HOME = {
    "ContactScene": "fastrod.contact.scene",
    "Modal": "fastrod.solver.options",
    "Modes": "fastrod.solver.options",
    "Observer": "fastrod.solver.options",
    "Pose": "fastrod.solver.state",
    "Rod": "fastrod.hosts.rod",
    "RunLog": "fastrod.logs.runlog",
    "Simulator": "fastrod.simulator",
    "State": "fastrod.solver.state",
    "Tips": "fastrod.solver.tape",
    "check": "fastrod.identification.log.check",
    "identify": "fastrod.identification.attribution",
    "read_log": "fastrod.logs.reader",
    "replay": "fastrod.identification.log.replay",
    "view": "fastrod_viewer.live",
    "write_log": "fastrod.logs.runlog",
}


def __getattr__(name: str) -> Any:
    """The simulator and the twins on first use: numba and scipy take half a second that a robot file does not
    need."""
    import importlib

    if name == "reference":
        return importlib.import_module("fastrod.reference")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    from fastrod.errors import nearest

    raise AttributeError(f"module 'fastrod' has no {name!r}; {nearest(name, __all__)}")
