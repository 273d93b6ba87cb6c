"""A thin robot is fed into a branching airway; its tendons steer it into one bronchus or the other."""

from __future__ import annotations

import math
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from fastrod.contact import ContactScene, mesh
from fastrod.model.robot import Robot, Segment, Tendon
from fastrod.simulator import Simulator
from fastrod.solver.state import State
from fastrod_scenes.contact.airway_mesh import BRANCHES, RADIUS, airway, heading, lumen_distance, middle
from fastrod_scenes.contact.balance import FORCE, Worst, contacts_of, watch, worst
from fastrod_scenes.scene import RodScene

SEGMENT = 0.045
"""Length of each of the three segments [m]."""
BODY = 0.002
"""Radius of the robot [m]."""
STIFFNESS = 3e-4
"""EI [N m^2]."""
OFFSET = 0.0015
"""Offset of the tendons from the backbone [m]."""
OUTSIDE, INSIDE = -0.005, 0.09
"""Depth of the fed length, at first and at last, along z from the entry [m]."""
LAG = 0.0063
"""A segment bends as the airway does so far behind its end: a segment that is half in a curve bends outside
of it too [m]."""
FACET = 1.5e-4
"""Largest intrusion of the mesh into the smooth lumen [m]: a cell of 1.8 mm on a curve of 6 mm gives 0.07 mm,
its shifted vertices as much."""
LARGEST = 0.05
"""Force of the wall that a bronchus takes without harm, at one place [N]."""


def _robot() -> Robot:
    segments = tuple(
        Segment(
            length=SEGMENT,
            bending_stiffness=(STIFFNESS, STIFFNESS),
            torsional_stiffness=0.8 * STIFFNESS,
            body_radius=BODY,
            tendons=tuple(Tendon(offset=OFFSET, angle=2.0 * math.pi * (j / 3 + k / 9)) for j in range(3)),
        )
        for k in range(3)
    )
    return Robot(name="endoscope", segments=segments)


def _inside(state: State, robot: int) -> NDArray[np.float64]:
    """(n, 3) nodes of this robot's centreline beyond the entry [m]."""
    points: NDArray[np.float64] = state.position[robot]
    return points[points[:, 2] > 0.0]


@final
class Airway(RodScene):
    """Two robots, each in a world of its own: the first is steered left, the second right. The insertion is
    straight, along z."""

    name = "airway"
    about = (
        "A thin robot is fed into a forked airway and steered into the left bronchus, its twin into the "
        "right one."
    )
    dt = 0.01
    duration = 1.9

    def simulator(self) -> Simulator:
        obstacle = mesh(airway(), name="airway", friction=0.1)
        return Simulator(
            _robot(), n_robots=len(BRANCHES), dt=self.dt, contact=ContactScene(obstacles=[obstacle])
        )

    def inputs(self, t: float) -> dict[str, Any]:
        robot = _robot()
        depth = OUTSIDE + (INSIDE - OUTSIDE) * self.progress(t)
        ends = robot.rest_tendon_length
        angle = np.array([tendon.angle for tendon in robot.tendons])
        bend = np.array([heading(depth - robot.length + end - LAG) for end in ends])
        pull = OFFSET * bend * np.cos(angle - np.array(list(BRANCHES.values()))[:, None])
        return {
            "tendon_length": ends - pull,
            "base_pose": (0.0, 0.0, depth - robot.length, 1.0, 0.0, 0.0, 0.0),
        }

    def check(self) -> dict[str, float]:
        figures: list[Worst] = []
        closest, largest = -math.inf, 0.0
        steps, in_contact = 0, np.zeros(len(BRANCHES), int)
        passes = np.zeros(len(BRANCHES))
        for t, state in watch(self, self.run(), figures):
            contacts = contacts_of(state)
            steps, in_contact, passes = steps + 1, in_contact + (contacts.count > 0), passes + state.passes
            largest = max(
                largest, float(np.linalg.norm(np.nan_to_num(contacts.force), axis=2).max(initial=0.0))
            )
            nodes = np.concatenate([_inside(state, i) for i in range(len(BRANCHES))])
            closest = max(closest, float(lumen_distance(nodes).max(initial=-math.inf)))
            self.expect(
                closest < FACET - BODY,
                f"at {t:.3g} s the centreline comes within {-closest:.4g} m of the lumen's wall.",
            )
        self.expect(bool((in_contact > 0).all()), "a robot never touches the wall.")
        self.expect(
            largest < LARGEST,
            f"the wall is pressed with {largest:.3g} N at one place, more than {LARGEST:g} N.",
        )
        off = [
            float(np.linalg.norm(middle(b, np.array([INSIDE])) - state.tip_position[i]))
            for i, b in enumerate(BRANCHES)
        ]
        for branch, away in zip(BRANCHES, off, strict=True):
            self.expect(
                away < RADIUS, f"the tip meant for the {branch} bronchus ends {away:.3g} m from its middle."
            )
        most = worst(figures)
        self.expect(most.force < FORCE, f"base force and contact forces differ by {most.force:.3g} N.")
        self.expect(
            most.moment < FORCE, f"base moment and that of the contacts differ by {most.moment:.3g} N m."
        )
        return {
            "centreline to the lumen's wall, least, m": -closest,
            "force at one place, largest, N": largest,
            "steps in contact, left": float(in_contact[0]),
            "steps in contact, right": float(in_contact[1]),
            "tip from the middle, m": max(off),
            "balance of forces, N": most.force,
            "balance of moments, N m": most.moment,
            "depth, m": most.depth,
            "passes, most": float(most.passes),
            "passes, mean": float(passes.max() / steps),
        }
