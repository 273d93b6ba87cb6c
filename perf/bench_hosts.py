"""Rods on rigid hosts, a step of rod and world: `fastrod bench hosts`, or this file as a script; `--json` for
programs, `--quick` for a smoke run."""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import report
import two_engines
from report import Column, Row, Section, note_progress

DT = 0.005
SIZE = 0.06
"""Edge of the cube [m]."""


def mounted(robot: str, mass: float, place: Sequence[float], gravity: float, touch: bool) -> tuple[Any, int]:
    """A rod along x on a fixed body, and a cube at `place`, which it feels if `touch`."""
    import fastrod
    from fastrod.hosts import BulletLink, MountedRod, connect

    world = connect(dt=DT, gravity=(0.0, 0.0, -gravity))
    post = world.createMultiBody(0.0, -1, -1, [0.0, 0.0, 0.0])
    cube = world.createMultiBody(
        mass, world.createCollisionShape(world.GEOM_BOX, halfExtents=[SIZE / 2] * 3), -1, list(place)
    )
    world.changeDynamics(cube, -1, linearDamping=0.0, angularDamping=0.0)
    along_x = BulletLink(world, post, quaternion=(0.5**0.5, 0.0, 0.5**0.5, 0.0))
    return MountedRod(fastrod.load_robot(robot), along_x, contact_bodies=[cube] if touch else []), cube


def timed(what: str, step: Callable[[int], Any], steps: int, touching: Callable[[], bool]) -> Row:
    """Milliseconds of a step: median, 95th percentile and the longest, and how many touched or failed."""
    note_progress(what)
    for k in range(3):
        step(k)
    taken, touched, failed = [], 0, 0
    for k in range(3, 3 + steps):
        t, state = report.seconds(lambda k=k: step(k))
        taken.append(1e3 * t)
        touched += touching()
        failed += state is not None and not bool(state.ok[0])
    return {
        "what": what,
        "median_ms": statistics.median(taken),
        "p95_ms": float(np.quantile(taken, 0.95)),
        "longest_ms": max(taken),
        "touching": touched / steps,
        "failed": failed,
        "steps": steps,
    }


def rods(steps: int) -> list[Row]:
    """Mounted rods, free and in contact."""
    rows = []
    for robot in ("prototype", "five_segment_reacher"):
        rod, _ = mounted(robot, 0.1, (5.0, 0.0, 0.0), 0.0, touch=False)
        rows.append(
            timed(
                f"{robot}, free",
                lambda k, rod=rod: rod.step(tip_force=(0.0, 0.0, 1e-4 * np.sin(0.1 * k))),
                steps,
                lambda: False,
            )
        )
    rod, _ = mounted("prototype", 0.1, (0.1 + 0.5 * SIZE - 0.017, 0.0, 0.0), 0.0, touch=True)
    rest, world = rod.simulator.robots[0].rest_tendon_length, rod.bullet

    def push(k: int) -> Any:
        world.resetBasePositionAndOrientation(rod.host.body, [0.1 * DT * k, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        world.resetBaseVelocity(rod.host.body, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
        return rod.step(tendon_length=rest)

    rows.append(
        timed("prototype, pushes a free cube", push, steps, lambda: bool(rod.state.contacts.count[0]))
    )
    long, _ = mounted("five_segment_reacher", 0.02, (0.15, 0.0, 0.1), 9.81, touch=True)
    rows.append(
        timed(
            "five_segment_reacher, 20 g fall on it",
            lambda _: long.step(),
            steps,
            lambda: bool(long.state.contacts.count[0]),
        )
    )
    return rows


def paper(steps: int) -> list[Row]:
    """The paper's class."""
    from fastrod.hosts import SoftManiSim

    soft = SoftManiSim()
    soft.add_a_cube([0.1, 0.1, 0.03], size=[0.06] * 3)
    wave = np.array([0.0, 0.002, 0.001] * 3)
    rows = [
        timed(
            "SoftManiSim, 3 segments: move_robot_ori",
            lambda k: soft.move_robot_ori(wave * np.sin(0.02 * k)) and None,
            steps,
            lambda: False,
        ),
        timed(
            "calc_tip_pos",
            lambda k: soft.calc_tip_pos(wave * np.sin(0.02 * k)) and None,
            steps,
            lambda: False,
        ),
        timed(
            "capture_image, 640 x 480",
            lambda _: soft.capture_image() and None,
            max(3, steps // 20),
            lambda: False,
        ),
    ]
    soft.close()
    return rows


def engines(steps: int) -> list[Row]:
    """The same rod on the same UR5 in both engines."""
    rows: list[Row] = []
    for case in two_engines.CASES:
        note_progress(f"two engines, {case}")
        found = {engine: two_engines.at_rest(engine, case, max(steps, 100)) for engine in two_engines.ENGINES}
        taken = {
            engine: timed(f"{engine}, {case}", lambda _, r=r: r.step(), steps, lambda: False)
            for engine, r in found.items()
        }
        apart = two_engines.apart(found["PyBullet"], found["MuJoCo"])
        rows.append(
            {
                "what": case,
                **{name: 100.0 * value for name, value in apart.items()},
                "pybullet_ms": taken["PyBullet"]["median_ms"],
                "mujoco_ms": taken["MuJoCo"]["median_ms"],
            }
        )
    return rows


def measure(options: argparse.Namespace) -> list[Section]:
    """All rows."""
    steps = 10 if options.quick else 200
    columns = [
        Column("what", "step of"),
        Column("median_ms", "median\nms", ".2f"),
        Column("p95_ms", "95 %\nms", ".2f"),
        Column("longest_ms", "longest\nms", ".1f"),
        Column("touching", "in contact", ".2f"),
        Column("failed", "not ok", "d"),
        Column("steps", "steps", "d"),
    ]
    notes = [
        f"One thread, world steps of {1e3 * DT:g} ms, ten points a segment; the step of PyBullet's "
        "world is in it. Warm."
    ]
    pair = [
        Column("what", "UR5 and rod,\nat rest"),
        Column("tip", "tips apart\n% of length", ".4f"),
        Column("force", "forces apart\n%", ".4f"),
        Column("moment", "moments apart\n%", ".4f"),
        Column("pybullet_ms", "PyBullet\nms a step", ".2f"),
        Column("mujoco_ms", "MuJoCo\nms a step", ".2f"),
    ]
    alike = [
        f"Tip of the rod and wrench on the flange, world, after {max(steps, 100)} steps; PyBullet's motors "
        "hold the arm rigidly, "
        "MuJoCo's servos give way by some 1e-5 rad."
    ]
    both = Section("engines", "The same rod and host in PyBullet and in MuJoCo", pair, engines(steps), alike)
    return [Section("hosts", "Rods on rigid hosts", columns, rods(steps) + paper(steps), notes), both]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    return report.command(argparse.ArgumentParser(prog="bench_hosts", description=__doc__), argv, measure)


if __name__ == "__main__":
    sys.exit(main())
