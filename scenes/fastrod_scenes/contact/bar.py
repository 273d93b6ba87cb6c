"""The five-segment reacher closes around a bar and grips it at three places.

Straight segments, which lie on the bar, alternate with bent ones, which stand off it: a rounded triangle
around the bar.
"""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene, cylinder
from fastrod.model.robotfile import load_robot
from fastrod.simulator import Simulator
from fastrod_scenes.contact.balance import FORCE, Worst, contacts_of, watch, worst
from fastrod_scenes.scene import RodScene

RADIUS = 0.065
"""Radius of the bar, whose axis is along y [m]: what fits into a triangle of this robot."""
ROD = 0.012
"""Radius of the robot [m]."""
GAP = 0.001
"""Between the straight robot and the bar [m]."""
HEIGHT = 0.05
"""Height of the bar's axis above the base: the middle of the first segment [m]."""
FIRST, SECOND = 2.1, 2.18
"""Bend of the second and of the fourth segment at the end, about y [rad]."""
OFFSET = 0.0075
"""Offset of the robot's tendons from its backbone [m]."""


@final
class Bar(RodScene):
    """The robot stands upright beside the bar; friction 0.3 keeps the grip from sliding along it."""

    name = "bar"
    about = "The five-segment reacher closes around a bar and grips it."
    dt = 0.01
    duration = 1.5

    def simulator(self) -> Simulator:
        bar = cylinder(
            RADIUS,
            0.3,
            name="bar",
            position=(RADIUS + ROD + GAP, 0.0, HEIGHT),
            quaternion=(math.sqrt(0.5), math.sqrt(0.5), 0.0, 0.0),
            friction=0.3,
        )
        return Simulator(
            load_robot("five_segment_reacher"), dt=self.dt, contact=ContactScene(obstacles=[bar])
        )

    def inputs(self, t: float) -> dict[str, Any]:
        robot = load_robot("five_segment_reacher")
        phase = 2.0 * self.progress(t)
        bend = np.cumsum([0.0, FIRST * min(phase, 1.0), 0.0, SECOND * max(phase - 1.0, 0.0), 0.0])[
            robot.tendon_segment
        ]
        angle = np.array([tendon.angle for tendon in robot.tendons])
        return {"tendon_length": robot.rest_tendon_length - OFFSET * bend * np.cos(angle)}

    def check(self) -> dict[str, float]:
        figures: list[Worst] = []
        passes = []
        for _, state in watch(self, self.run(), figures):
            passes.append(int(state.passes[0]))
        contacts, most = contacts_of(state), worst(figures)
        count = int(contacts.count[0])
        self.expect(count >= 3, f"the robot touches the bar at {count} places; a grip needs three.")
        outward = contacts.normal[0, :count]
        spread = float(np.linalg.norm(outward.sum(axis=0)) / count)
        self.expect(spread < 0.5, f"the contacts are on one side of the bar (mean normal {spread:.3g}).")
        squeeze = float(np.linalg.norm(contacts.force[0, :count], axis=1).min())
        self.expect(squeeze > 1e-3, f"one place presses with only {squeeze:.3g} N.")
        self.expect(most.force < FORCE, f"base force and contact forces differ by {most.force:.3g} N.")
        self.expect(
            most.moment < FORCE, f"base moment and that of the contacts differ by {most.moment:.3g} N m."
        )
        return {
            "contacts at the end": float(count),
            "least force of a contact, N": squeeze,
            "largest force of a contact, N": float(np.linalg.norm(contacts.force[0, :count], axis=1).max()),
            "balance of forces, N": most.force,
            "balance of moments, N m": most.moment,
            "depth, m": most.depth,
            "passes, most": float(most.passes),
            "passes, mean": float(np.mean(passes)),
        }
