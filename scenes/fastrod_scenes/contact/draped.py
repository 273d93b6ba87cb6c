"""A heavy rod, clamped level, sags; a cylinder rises under it until it carries more than half of the weight.

Closed form: a level cantilever of length L, stiffness EI and weight w a length, held at x = a at height h,
rests there with R = w (6 L^2 - 4 L a + a^2) / (8 a) + 3 EI h / a^3 (Euler-Bernoulli, small slopes). At the
end of the run h is about zero, and the rod so straight that this holds.
"""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene, cylinder
from fastrod.model.robot import Robot, Segment
from fastrod.simulator import Simulator
from fastrod_scenes.contact.balance import DEPTH, FORCE, contacts_of, force_error, rises
from fastrod_scenes.scene import RodScene

LENGTH = 0.3
STIFFNESS = 0.02
"""EI [N m^2]."""
WEIGHT = 0.3 * 9.81
"""[N/m]"""
BODY = 0.005
"""Radius of the rod [m]."""
RADIUS = 0.03
"""Radius of the cylinder, whose axis is level and across the rod [m]."""
UNDER = LENGTH / 2.0
"""Distance of the cylinder from the clamp [m]."""
LOW, HIGH = -0.11, -RADIUS - BODY
"""Height of the cylinder's axis, first and last [m]."""
BEAM = 0.01
"""Fraction by which the support may differ from the closed form: slopes of 0.2 cost their square, a quarter
of it here."""

_ACROSS = (math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0)


@final
class Draped(RodScene):
    """The rod lies along x; the drum is frictionless."""

    name = "draped"
    about = "A cylinder rises under a heavy, sagging rod, which drapes itself over it."
    dt = 0.01
    duration = 1.5

    def simulator(self) -> Simulator:
        rod = Segment(
            length=LENGTH,
            bending_stiffness=(STIFFNESS, STIFFNESS),
            torsional_stiffness=0.015,
            body_radius=BODY,
            line_density=WEIGHT / 9.81,
            mode="passive",
        )
        robot = Robot(
            name="cable", segments=(rod,), base_quaternion=(math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)
        )
        drum = cylinder(RADIUS, 0.2, name="drum", position=(UNDER, 0.0, LOW), quaternion=_ACROSS)
        return Simulator(robot, dt=self.dt, points_per_segment=40, contact=ContactScene(obstacles=[drum]))

    def inputs(self, t: float) -> dict[str, Any]:
        return {"obstacle_pose": {"drum": (UNDER, 0.0, LOW + (HIGH - LOW) * self.progress(t), *_ACROSS)}}

    def check(self) -> dict[str, float]:
        balance = reaction = torque = depth = 0.0
        passes = 0
        support: list[float] = []
        for t, state in self.run():
            self.expect(bool(state.ok[0]), f"at {t:.3g} s the rod is lost: {state.problems}")
            contacts = contacts_of(state)
            balance = max(balance, force_error(state, (0.0, 0.0, -WEIGHT * LENGTH)))
            reaction = max(reaction, float(np.abs(contacts.wrench[0, 0, :3] + contacts.total_force[0]).max()))
            torque = max(torque, abs(float(contacts.wrench[0, 0, 4])))
            depth, passes = max(depth, -float(contacts.clearance[0])), max(passes, int(state.passes[0]))
            if contacts.count[0]:
                support.append(float(contacts.total_force[0, 2]))
        at = float(contacts.arclength[0, 0])
        height = float(np.interp(at, state.arclength[0], state.position[0, :, 2]))
        beam = (
            WEIGHT * (6.0 * LENGTH**2 - 4.0 * LENGTH * at + at**2) / (8.0 * at)
            + 3.0 * STIFFNESS * height / at**3
        )
        aside = float(np.abs(state.position[0, :, 1]).max())
        self.expect(
            balance < FORCE, f"weight, base force and the drum's force are {balance:.3g} N out of balance."
        )
        self.expect(reaction < 1e-12, f"the drum's force and the rod's differ by {reaction:.3g} N.")
        self.expect(
            torque < FORCE, f"a drum without friction has about its axis a moment of {torque:.3g} N m."
        )
        self.expect(depth <= DEPTH, f"the rod lies {depth:.3g} m deep in the drum.")
        self.expect(len(support) > 50 and rises(support), "the drum does not carry more the higher it is.")
        self.expect(
            aside < 1e-9, f"the rod leaves its plane by {aside:.3g} m, though nothing pushes it there."
        )
        self.expect(
            abs(support[-1] / beam - 1.0) < BEAM,
            f"the drum carries {support[-1]:.4g} N at last; beam theory says {beam:.4g} N.",
        )
        return {
            "support at the end, N": support[-1],
            "support by beam theory, N": beam,
            "balance of forces, N": balance,
            "torque on the drum's axis, N m": torque,
            "depth, m": depth,
            "passes, most": float(passes),
        }
