"""A soft, bent tip is pushed through a ribbed tube: every rib holds it until it jumps over."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene, mesh
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.simulator import Simulator
from fastrod.types import Floats, Ints
from fastrod_scenes.contact.balance import contacts_of
from fastrod_scenes.scene import RodScene

SHAFT, TIP, BODY, OFFSET = 0.06, 0.04, 0.002, 0.0015
"""Constants of the robot: length of its stiff and of its soft segment, radius, offset of its tendons [m]."""
STIFFNESS, SOFT, DENSITY, DAMPING = 2e-3, 1e-4, 0.03, 2e-3
"""EI of either segment [N m^2], line density [kg/m], damping time [s]."""
BEND, BENDS = 1.2, 0.4
"""Bend of the tip, which presses it against the wall [rad], and how long it takes [s]."""
N_RIBS, BORE, RIB, PITCH, WALL = 5, 0.009, 0.0016, 0.01, 0.004
"""Constants of the tube: how many ribs; its radius between, their height and distance, its wall [m]."""
FRICTION, SPEED, DEPTH = 0.3, 0.02, 0.006
"""Friction of the wall, speed of the base [m/s], depth of the straight tip at first [m]."""
FASTER, SLOWER = 1.75, 0.5
"""Speeds of a tip that jumps and of one that is held, over that of the base."""
INSIDE = 1e-5
"""Largest overlap of a rod in motion [m]."""
_AROUND, _ALONG = 48, 24  # cells of the mesh, and of one rib


def ribbed_tube() -> tuple[Floats, Ints]:
    """Vertices (n, 3) [m] and faces (m, 3) of a tube about z from 0 on, with round ribs inside."""
    z = np.linspace(0.0, N_RIBS * PITCH, N_RIBS * _ALONG + 1)
    inner = BORE - RIB * np.sin(math.pi * z / PITCH) ** 2
    outline = np.concatenate([np.stack([inner, z], 1), [[BORE + WALL, z[-1]], [BORE + WALL, z[0]]]])
    angle = 2.0 * math.pi * np.arange(_AROUND) / _AROUND
    radius, height = np.repeat(outline[:, None], _AROUND, axis=1).transpose(2, 0, 1)
    vertices = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=2)
    i, j = np.meshgrid(np.arange(len(outline)), np.arange(_AROUND), indexing="ij")
    above, beside = (i + 1) % len(outline), (j + 1) % _AROUND
    a, b, c, d = (p * _AROUND + q for p, q in ((i, j), (above, j), (above, beside), (i, beside)))
    return vertices.reshape(-1, 3), np.stack([a, b, c, a, c, d], axis=2).reshape(-1, 3)


def _robot() -> Robot:
    segments = tuple(
        Segment(
            length=length,
            bending_stiffness=(stiffness, stiffness),
            torsional_stiffness=0.8 * stiffness,
            body_radius=BODY,
            line_density=DENSITY,
            damping_time=DAMPING,
            tendons=tuple(
                Tendon(offset=OFFSET, angle=2.0 * math.pi * j / 3, compliance=1e-4) for j in range(3)
            ),
        )
        for length, stiffness in ((SHAFT, STIFFNESS), (TIP, SOFT))
    )
    return Robot(name="probe", segments=segments, gravity=(0.0, 0.0, 0.0))


@final
class Insertion(RodScene):
    """A rod in motion, in steps of 5 ms; no gravity."""

    name = "insertion"
    about = "A soft, bent tip is pushed through a ribbed tube: every rib holds it until it jumps over."
    dt = 0.005
    duration = 2.4

    def simulator(self) -> Simulator:
        tube = mesh(ribbed_tube(), name="tube", friction=FRICTION)
        return Simulator(_robot(), dt=self.dt, dynamics=True, contact=ContactScene(obstacles=[tube]))

    def inputs(self, t: float) -> dict[str, Any]:
        robot = _robot()
        angle = np.array([tendon.angle for tendon in robot.tendons])
        bend = BEND * min(t / BENDS, 1.0) * np.array([0.0, 1.0])[robot.tendon_segment]
        base = DEPTH - robot.length + SPEED * max(t - BENDS, 0.0)
        return {
            "tendon_length": robot.rest_tendon_length - OFFSET * bend * np.cos(angle),
            "base_pose": (0.0, 0.0, base, 1.0, 0.0, 0.0, 0.0),
        }

    def check(self) -> dict[str, float]:
        depth, beyond, push, passes, speed = 0.0, 0.0, [0.0], [], []
        for t, state in self.run():
            self.expect(bool(state.ok.all()), f"at {t:.3g} s the rod is lost: {state.problems}")
            contacts = contacts_of(state)
            force = contacts.force[0, : contacts.count[0]]
            normal = contacts.normal[0, : contacts.count[0]]
            pressed = (force * normal).sum(1)
            along = np.linalg.norm(force - pressed[:, None] * normal, axis=1)
            beyond = max(beyond, float((along - FRICTION * pressed).max(initial=0.0)))
            depth = max(depth, float(-contacts.clearance[0]))
            passes.append(float(state.passes[0]))
            if t > 1.5 * BENDS:
                assert state.velocity is not None
                speed.append(float(state.velocity[0, -1, 2]) / SPEED)
                push.append(-float(state.base_wrench[0, 2]))
        jumps, held = 0, False
        for v in speed:
            jumps += held and v > FASTER
            held = v < SLOWER or (held and v <= FASTER)
        self.expect(depth < INSIDE, f"the rod lies {depth:.3g} m deep in the tube, more than {INSIDE:g} m.")
        self.expect(beyond < 1e-6, f"friction is {beyond:.3g} N more than the cone of {FRICTION:g} has.")
        self.expect(jumps >= 3, f"the tip is held and jumps {jumps} times only.")
        return {
            "jumps": float(jumps),
            "slowest tip, of the base's speed": min(speed),
            "fastest tip, of the base's speed": max(speed),
            "largest push, N": max(push),
            "friction beyond its cone, N": beyond,
            "depth, m": depth,
            "passes, most": max(passes),
            "passes, mean": float(np.mean(passes)),
        }
