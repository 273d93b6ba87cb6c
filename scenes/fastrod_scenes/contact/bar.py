"""A thin robot winds itself around a bar of 30 mm and holds it."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene, cylinder
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.simulator import Simulator
from fastrod.solver.options import Modal, Modes
from fastrod.types import Floats
from fastrod_scenes.contact.balance import contacts_of, force_error, moment_error
from fastrod_scenes.scene import RodScene

RADIUS, HEIGHT, GAP = 0.015, 0.02, 0.0005
"""Constants of the bar, whose axis is along y: its radius, its height above the base, its distance from the
straight robot [m]."""
LENGTH, ROD, OFFSET = 0.06, 0.004, 0.003
"""Length of either segment, radius of the robot, offset of its tendons [m]."""
BEND, BENDS = math.radians(330.0), 1.9
"""Bend of the whole robot about y at the end [rad], and how long it takes [s]."""
FRICTION = 0.3
INSIDE = 1e-5
"""Largest overlap of a rod in motion [m]."""
BALANCE = 1e-3
"""Largest error of the balance of a robot that holds, of the largest of its forces."""


def _robot() -> Robot:
    tendons = tuple(Tendon(offset=OFFSET, angle=angle, compliance=1e-5) for angle in (0.0, math.pi))
    segment = Segment(
        length=LENGTH,
        bending_stiffness=(0.01, 0.01),
        torsional_stiffness=0.008,
        body_radius=ROD,
        line_density=0.05,
        damping_time=2e-3,
        tendons=tendons,
    )
    return Robot(name="creeper", segments=(segment, segment), gravity=(0.0, 0.0, 0.0))


def wound(points: Floats) -> float:
    """Angle around the bar from the first to the last of these points (n, 3) on it, in their order [rad]."""
    angle = np.unwrap(np.arctan2(points[:, 2] - HEIGHT, RADIUS + ROD + GAP - points[:, 0]))
    return float(angle[-1] - angle[0]) if len(points) else 0.0


@final
class Bar(RodScene):
    """The robot stands upright beside the bar, in motion, in steps of 10 ms; no gravity."""

    name = "bar"
    about = "A thin robot winds itself around a bar of 30 mm and holds it."
    dt = 0.01
    duration = 2.2

    def simulator(self) -> Simulator:
        bar = cylinder(
            RADIUS,
            0.1,
            name="bar",
            position=(RADIUS + ROD + GAP, 0.0, HEIGHT),
            quaternion=(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
            friction=FRICTION,
        )
        scene = ContactScene(obstacles=[bar], max_contacts=48)
        # every contact makes a kink in the curvature, which pieces can have at their ends
        solver = Modal(dynamics=True, modes=Modes(4, 2, pieces=3))
        return Simulator(_robot(), dt=self.dt, solver=solver, contact=scene, points_per_segment=60)

    def inputs(self, t: float) -> dict[str, Any]:
        robot = _robot()
        bend = BEND * min(t / BENDS, 1.0) * np.array([0.5, 1.0])[robot.tendon_segment]
        angle = np.array([tendon.angle for tendon in robot.tendons])
        return {"tendon_length": robot.rest_tendon_length - OFFSET * bend * np.cos(angle)}

    def check(self) -> dict[str, float]:
        depth, passes = 0.0, []
        for t, state in self.run():
            self.expect(bool(state.ok.all()), f"at {t:.3g} s the rod is lost: {state.problems}")
            depth = max(depth, float(-contacts_of(state).clearance[0]))
            passes.append(float(state.passes[0]))
        contacts = contacts_of(state)
        count = int(contacts.count[0])
        along = np.argsort(contacts.arclength[0, :count])
        around = wound(contacts.point[0, along])
        strength = np.linalg.norm(contacts.force[0, :count], axis=1)
        most = float(strength.max(initial=1e-9))
        off = max(force_error(state), moment_error(state) / LENGTH) / most
        self.expect(
            around > math.radians(250.0), f"the robot lies on {math.degrees(around):.3g} degrees only."
        )
        self.expect(depth < INSIDE, f"the rod lies {depth:.3g} m deep in the bar, more than {INSIDE:g} m.")
        self.expect(off < BALANCE, f"base and contact forces differ by {off:.3g} of the largest.")
        return {
            "angle on the bar, degrees": math.degrees(around),
            "contacts at the end": float(count),
            "largest force of a contact, N": most,
            "balance of forces and moments, of the largest": off,
            "depth, m": depth,
            "passes, most": max(passes),
            "passes, mean": float(np.mean(passes)),
        }
