"""Old module names: an import of one is refused with its new name."""

from __future__ import annotations

import sys
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec

_NOW = {
    "chain": "effects.pipeline",
    "cli": "commands.cli",
    "compile": "model.compile",
    "demo": "commands.demo",
    "driving": "commands.drive",
    "effect": "effects.base",
    "gpu": "solver.gpu",
    "inputs": "solver.inputs",
    "link": "logs.link",
    "passes": "solver.boundary",
    "ports": "effects.ports",
    "recording": "logs.recording",
    "response": "solver.response",
    "robot": "model.robot",
    "robotfile": "model.robotfile",
    "runlog": "logs.runlog",
    "segments": "model.segment_actions",
    "settle": "solver.settle",
    "simulated": "logs.simulated",
    "state": "solver.state",
    "wiring": "model.routing",
    "generation.command": "commands.generate",
    "hosts.mujoco_touched": "hosts.mujoco_body_contact",
    "hosts.touching": "hosts.body_contact",
    "identification.forward": "identification.log.forward",
    "identification.replay": "identification.log.replay",
    "identification.result": "identification.report.result",
}


class _Moved(MetaPathFinder):
    """Comes last, so that it is asked only for what is not there."""

    def find_spec(self, fullname: str, *_: object) -> ModuleSpec | None:
        now = _NOW.get(fullname.removeprefix("fastrod."))
        if now is None or not fullname.startswith("fastrod."):
            return None
        raise ModuleNotFoundError(f"{fullname} is now fastrod.{now}.", name=fullname)


def refuse_old_names() -> None:
    """Let Python say where a module has gone."""
    if not any(isinstance(finder, _Moved) for finder in sys.meta_path):
        sys.meta_path.append(_Moved())
