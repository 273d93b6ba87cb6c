"""Rigid hosts: other physics engines that carry a rod, feel its weight, and whose bodies it touches.

`Rod` knows no engine; README.md beside this file says how any engine carries one. PyBullet (`pip install
'fastrod[hosts]'`) and MuJoCo (`pip install 'fastrod[mujoco]'`) are imported on first use.
"""

from typing import TYPE_CHECKING, Any

from fastrod.hosts.host import Host, Motion

if TYPE_CHECKING:
    from fastrod.hosts.arm import BulletArm as BulletArm
    from fastrod.hosts.bodies import RodBodies as RodBodies
    from fastrod.hosts.bullet import Bullet as Bullet
    from fastrod.hosts.bullet import connect as connect
    from fastrod.hosts.camera import HostCamera as HostCamera
    from fastrod.hosts.capsules import Capsules as Capsules
    from fastrod.hosts.link import BulletLink as BulletLink
    from fastrod.hosts.mounted import MountedRod as MountedRod
    from fastrod.hosts.mujoco import MujocoBody as MujocoBody
    from fastrod.hosts.mujoco import MujocoRod as MujocoRod
    from fastrod.hosts.mujoco import add_capsules as add_capsules
    from fastrod.hosts.rod import Rod as Rod
    from fastrod.hosts.softmanisim import SoftManiSim as SoftManiSim
    from fastrod.hosts.visuals import Visuals as Visuals

_HOME = {
    "Bullet": "bullet",
    "BulletArm": "arm",
    "BulletLink": "link",
    "HostCamera": "camera",
    "Capsules": "capsules",
    "MountedRod": "mounted",
    "MujocoBody": "mujoco",
    "MujocoRod": "mujoco",
    "Rod": "rod",
    "RodBodies": "bodies",
    "SoftManiSim": "softmanisim",
    "Visuals": "visuals",
    "add_capsules": "mujoco",
    "connect": "bullet",
}

__all__ = ["Host", "Motion", *_HOME]


def __getattr__(name: str) -> Any:
    import importlib

    if name in _HOME:
        return getattr(importlib.import_module(f"fastrod.hosts.{_HOME[name]}"), name)
    from fastrod.errors import nearest

    raise AttributeError(f"module 'fastrod.hosts' has no {name!r}; {nearest(name, __all__)}")
