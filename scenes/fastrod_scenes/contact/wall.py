"""The prototype pulls its tip against a wall, on which it slides."""

from __future__ import annotations

from typing import Any, final

import numpy as np

from fastrod.contact import ContactScene, plane
from fastrod.model.robotfile import load_robot
from fastrod.simulator import Simulator
from fastrod_scenes.contact.balance import FORCE, Worst, contacts_of, rises, watch, worst
from fastrod_scenes.scene import RodScene

DISTANCE = 0.02
"""Distance of the wall from the base, along x [m]."""
PULL = 0.009
"""Pull of the tendon toward the wall at the end, let out by the one across [m]."""


@final
class Wall(RodScene):
    """The wall is frictionless: x < `DISTANCE` is free."""

    name = "wall"
    about = "The prototype's tendons press its tip against a wall, and it slides along it."
    dt = 0.01
    duration = 1.0

    def simulator(self) -> Simulator:
        wall = plane(point=(DISTANCE, 0.0, 0.0), normal=(-1.0, 0.0, 0.0), name="wall")
        return Simulator(load_robot("prototype"), dt=self.dt, contact=ContactScene(obstacles=[wall]))

    def inputs(self, t: float) -> dict[str, Any]:
        pull = PULL * self.progress(t)
        return {
            "tendon_length": load_robot("prototype").rest_tendon_length + np.array([-pull, 0.0, pull, 0.0])
        }

    def check(self) -> dict[str, float]:
        figures: list[Worst] = []
        radius = load_robot("prototype").segments[0].body_radius
        force: list[float] = []
        height: list[float] = []
        away = 0.0
        for t, state in watch(self, self.run(), figures):
            contacts = contacts_of(state)
            if contacts.in_contact("wall")[0]:
                self.expect(
                    bool(contacts.tip_in_contact[0]),
                    f"at {t:.3g} s the rod touches the wall, but not by its tip.",
                )
                away = max(away, abs(DISTANCE - radius - float(state.tip_position[0, 0])))
                force.append(-float(contacts.total_force[0, 0]))
                height.append(float(state.tip_position[0, 2]))
        self.expect(
            len(force) > 40,
            f"the tip is on the wall in {len(force)} steps; it must be there in the second half of the run.",
        )
        self.expect(rises(force), "the force on the wall does not grow with every bit of pull.")
        self.expect(
            rises(height[::-1]), "the pressed tip does not slide toward the base with every bit of pull."
        )
        self.expect(away < 1e-6, f"the tip is {away:.3g} m off the wall that it presses on.")
        most = worst(figures)
        self.expect(most.force < FORCE, f"base force and contact force differ by {most.force:.3g} N.")
        self.expect(
            most.moment < FORCE, f"base moment and that of the contacts differ by {most.moment:.3g} N m."
        )
        return {
            "force at the end, N": force[-1],
            "slide, m": height[0] - height[-1],
            "balance of forces, N": most.force,
            "balance of moments, N m": most.moment,
            "depth, m": most.depth,
            "passes, most": float(most.passes),
        }
