"""Compile the large kernels into the cache, two processes at a time: a free rod, a rod in
contact, a rod of modes."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np

MANY = 128
"""Robots from which on a pass is spread over threads."""


def free(n: int) -> None:
    import fastrod

    robot = fastrod.load_robot("prototype")
    sim = fastrod.Simulator(robot, n, points_per_segment=2)
    sim.settle(robot.rest_tendon_length)
    sim.step(robot.rest_tendon_length, tip_force=(0.0, 0.01, 0.0))


def touching(n: int) -> None:
    import fastrod
    from fastrod.contact import ContactScene, cylinder

    robot = fastrod.load_robot("prototype")
    bar = cylinder(0.01, 0.2, name="bar", position=(0.018, 0, 0.05), quaternion=(0.5**0.5, 0.5**0.5, 0, 0))
    sim = fastrod.Simulator(
        robot, n, points_per_segment=5, contact=ContactScene(obstacles=[bar], rod_radius=0.003)
    )
    for pull in np.linspace(0.0, 0.006, 20):
        state = sim.step(robot.rest_tendon_length + np.array([-pull, 0.0, pull, 0.0]))
    assert state.contacts is not None
    assert state.contacts.in_contact().all()


def modes(n: int) -> None:
    import fastrod

    robot = fastrod.load_robot("prototype")
    sim = fastrod.Simulator(robot, n, points_per_segment=2, solver="modal")
    sim.settle(robot.rest_tendon_length)
    sim.jacobian()


def main() -> int:
    """The exit code."""
    if len(sys.argv) > 1:
        {"free": free, "touching": touching, "modes": modes}[sys.argv[1]](int(sys.argv[2]))
        return 0
    with ThreadPoolExecutor(2) as pool:
        for some in ((("free", 1), ("free", MANY)), (("touching", 1), ("touching", MANY), ("modes", 1))):
            codes = pool.map(lambda one: subprocess.call([sys.executable, __file__, *map(str, one)]), some)
            if any(list(codes)):
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
