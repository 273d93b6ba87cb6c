"""Contact of rods with obstacles, with themselves and with each other.

`ContactScene` says what may be touched; give it to `Simulator(robot, contact=...)`. What touched is in
`state.contacts`.
"""

from fastrod.contact.contacts import Contacts
from fastrod.contact.geometry import Obstacle, box, capsule, cylinder, mesh, plane, sphere
from fastrod.contact.meshfile import MeshLimits
from fastrod.contact.scene import ContactScene

__all__ = [
    "ContactScene",
    "Contacts",
    "MeshLimits",
    "Obstacle",
    "box",
    "capsule",
    "cylinder",
    "mesh",
    "plane",
    "sphere",
]
