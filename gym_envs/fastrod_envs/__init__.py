"""Vectorised Gymnasium environments over one Simulator: N robots are N environments.

>>> import fastrod_envs
>>> fastrod_envs.ids()[0]
'fastrod/Reach-v0'
"""

from fastrod_envs.randomisation import Randomisation
from fastrod_envs.registration import ids, names, register_all

try:
    register_all()
except ModuleNotFoundError as error:
    raise ImportError("fastrod_envs needs gymnasium: pip install fastrod[envs].") from error

__all__ = ["Randomisation", "ids", "names"]
