"""Two rods that cross at a right angle; the tendons of one press it against the other.

Without friction the crossing is stable while the rods are bent by less than they are thick: the force P of
two rods of radius r pushes them apart sidewise as a spring of stiffness -P / 2r would.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene
from fastrod.model.robotfile import load_robot
from fastrod.simulator import Simulator
from fastrod_scenes.contact.balance import FORCE, Worst, contacts_of, rises, watch, worst
from fastrod_scenes.scene import RodScene

ROD = 0.012
"""Radius of both rods [m]."""
GAP = 0.006
"""Between the straight rods [m]."""
CROSSING = 0.25
"""Distance of the crossing from both bases [m]."""
BEND = 0.25
"""Bend of the first rod toward the second at the end [rad]."""
OFFSET = 0.01
"""Offset of the tendons from the backbone [m]."""
CONTACT_GAP = 1e-7
"""Largest gap of a contact that presses [m]."""


@final
class Pair(RodScene):
    """The first rod stands upright, the second lies along y, on the first one's side of larger x; no
    friction."""

    name = "pair"
    about = "A rod bends onto another that crosses it, and the two press on each other."
    dt = 0.01
    duration = 1.0

    def simulator(self) -> Simulator:
        first = load_robot("tdcr_a")
        second = replace(
            first,
            name="across",
            base_position=(2.0 * ROD + GAP, -CROSSING, CROSSING),
            base_quaternion=(math.sqrt(0.5), -math.sqrt(0.5), 0.0, 0.0),
        )
        return Simulator([first, second], dt=self.dt, contact=ContactScene(worlds=[0, 0]))

    def inputs(self, t: float) -> dict[str, Any]:
        robot = load_robot("tdcr_a")
        bend = BEND * self.progress(t) * np.array([0.5, 1.0])[robot.tendon_segment]
        angle = np.array([tendon.angle for tendon in robot.tendons])
        pull = OFFSET * bend * np.cos(angle)
        return {"tendon_length": np.stack([robot.rest_tendon_length - pull, robot.rest_tendon_length])}

    def check(self) -> dict[str, float]:
        figures: list[Worst] = []
        reaction = apart = gap = 0.0
        force: list[float] = []
        for _, state in watch(self, self.run(), figures):
            contacts = contacts_of(state)
            if contacts.count.any():
                reaction = max(reaction, float(np.abs(contacts.total_force.sum(axis=0)).max()))
                apart = max(apart, float(np.linalg.norm(contacts.point[0, 0] - contacts.point[1, 0])))
                gap = max(gap, float(np.abs(contacts.gap[:, 0]).max()))
                force.append(float(np.linalg.norm(contacts.total_force[0])))
        self.expect(len(force) > 20, f"the rods touch in {len(force)} steps only.")
        self.expect(
            bool(contacts.in_contact("rod 1")[0] and contacts.in_contact("rod 0")[1]),
            "the rods do not name each other.",
        )
        self.expect(rises(force), "the force between the rods does not grow with every bit of bend.")
        self.expect(reaction < 1e-12, f"what one rod does to the other and back differ by {reaction:.3g} N.")
        self.expect(
            gap < CONTACT_GAP and apart < CONTACT_GAP,
            f"the rods press on each other {gap:.3g} m apart, at points {apart:.3g} m apart.",
        )
        most = worst(figures)
        self.expect(most.force < FORCE, f"base forces and contact forces differ by {most.force:.3g} N.")
        self.expect(
            most.moment < FORCE, f"base moments and those of the contacts differ by {most.moment:.3g} N m."
        )
        return {
            "force at the end, N": force[-1],
            "action and reaction, N": reaction,
            "gap, m": gap,
            "points apart, m": apart,
            "balance of forces, N": most.force,
            "balance of moments, N m": most.moment,
            "depth, m": most.depth,
            "passes, most": float(most.passes),
        }
