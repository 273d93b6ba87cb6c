"""Vectorised Gymnasium environments over one Simulator: N robots are N environments.

>>> import fastrod_envs
>>> fastrod_envs.ids()[0]
'fastrod/BoxExplore-v0'

A task of your own is a class derived from `fastrod_envs.rodtask.RodTask` (or `task.Task`) with
`@fastrod_envs.register` on it.
"""

from fastrod_envs.randomisation import Randomisation
from fastrod_envs.registration import ids, load_plug_ins, names, register, register_all, unregister

try:
    register_all()
except ModuleNotFoundError as error:
    raise ImportError("fastrod_envs needs gymnasium: pip install fastrod[envs].") from error
load_plug_ins()

__all__ = ["Randomisation", "ids", "names", "register", "unregister"]
