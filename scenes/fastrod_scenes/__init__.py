"""Scenes: robots with their surroundings, and measured data of real robots brought into run logs.

>>> from fastrod_scenes import names
>>> "airway" in names()
True
"""

from fastrod_scenes.scene import Scene, load, names

__all__ = ["Scene", "load", "names"]
