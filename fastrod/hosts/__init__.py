"""Rigid hosts: other physics engines that carry a rod, feel its weight, and whose bodies it touches.

`Rod` knows no engine; README.md beside this file says how any engine carries one. PyBullet (`pip install
'fastrod[hosts]'`) and MuJoCo (`pip install 'fastrod[mujoco]'`) are imported on first use.
"""

from typing import TYPE_CHECKING, Any

from fastrod.hosts.host import Host, Motion

if TYPE_CHECKING:
    from fastrod.hosts.arm import BulletArm
    from fastrod.hosts.bodies import RodBodies
    from fastrod.hosts.bullet import Bullet, connect
    from fastrod.hosts.camera import HostCamera
    from fastrod.hosts.capsules import Capsules
    from fastrod.hosts.link import BulletLink
    from fastrod.hosts.mounted import MountedRod
    from fastrod.hosts.mujoco import MujocoBody, MujocoRod, add_capsules
    from fastrod.hosts.rod import Rod
    from fastrod.hosts.softmanisim import SoftManiSim
    from fastrod.hosts.visuals import Visuals

__all__ = [
    "Bullet",
    "BulletArm",
    "BulletLink",
    "Capsules",
    "Host",
    "HostCamera",
    "Motion",
    "MountedRod",
    "MujocoBody",
    "MujocoRod",
    "Rod",
    "RodBodies",
    "SoftManiSim",
    "Visuals",
    "add_capsules",
    "connect",
]
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


def __getattr__(name: str) -> Any:
    import importlib

    if name in _HOME:
        return getattr(importlib.import_module(f"fastrod.hosts.{_HOME[name]}"), name)
    from fastrod.errors import nearest

    raise AttributeError(f"module 'fastrod.hosts' has no {name!r}; {nearest(name, __all__)}")
