"""Contact of rods with obstacles, with themselves and with each other.

`ContactScene` says what may be touched; give it to `Simulator(robot, contact=...)`. What touched is in
`state.contacts`.
"""

from fastrod.contact.contacts import Contacts
from fastrod.contact.geometry import Obstacle, mesh, obstacle
from fastrod.contact.meshfile import MeshLimits
from fastrod.contact.primitive import Primitive, register
from fastrod.contact.scene import ContactScene
from fastrod.contact.shapes.box import box
from fastrod.contact.shapes.capsule import capsule
from fastrod.contact.shapes.cylinder import cylinder
from fastrod.contact.shapes.ellipsoid import ellipsoid
from fastrod.contact.shapes.plane import plane
from fastrod.contact.shapes.sphere import sphere

__all__ = [
    "ContactScene",
    "Contacts",
    "MeshLimits",
    "Obstacle",
    "Primitive",
    "box",
    "capsule",
    "cylinder",
    "ellipsoid",
    "mesh",
    "obstacle",
    "plane",
    "register",
    "sphere",
]
