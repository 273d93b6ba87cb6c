"""Rods on rigid hosts: a step of rod and world, and one rod on one UR5 in PyBullet and in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

import fastrod
from fastrod.hosts import BulletLink, MountedRod, SoftManiSim, connect
from report import Measurement, Row, Section, bench, note_progress, table

DT = 0.005
SIZE = 0.06  # edge of the cube [m]


def mounted(robot: str, mass: float, place: Sequence[float], gravity: float, felt: bool) -> tuple[Any, int]:
    """A rod along x on a fixed body, and a cube at `place`, which it feels if `felt`."""
    world = connect(dt=DT, gravity=(0.0, 0.0, -gravity))
    post = world.createMultiBody(0.0, -1, -1, [0.0, 0.0, 0.0])
    shape = world.createCollisionShape(world.GEOM_BOX, halfExtents=[SIZE / 2] * 3)
    cube = world.createMultiBody(mass, shape, -1, list(place))
    world.changeDynamics(cube, -1, linearDamping=0.0, angularDamping=0.0)
    along_x = BulletLink(world, post, quaternion=(0.5**0.5, 0.0, 0.5**0.5, 0.0))
    return MountedRod(fastrod.load_robot(robot), along_x, contact_bodies=[cube] if felt else []), cube


def timed(
    what: str, step: Callable[[int], Any], steps: int, contact: Callable[[], bool] = lambda: False
) -> Row:
    note_progress(what)
    for k in range(3):
        step(k)
    taken, in_contact, failed = Measurement(), 0, 0
    for k in range(3, 3 + steps):
        state = taken.take(partial(step, k))
        in_contact += contact()
        failed += state is not None and not bool(state.ok[0])
    times = {"median_ms": taken.median, "p95_ms": taken.quantile(0.95), "longest_ms": max(taken.times)}
    row: Row = {"what": what, **{key: 1e3 * t for key, t in times.items()}}
    return row | {"in_contact": in_contact / steps, "failed": failed, "steps": steps}


def rods(steps: int) -> list[Row]:
    """Mounted rods, free and in contact."""
    rows = []
    for robot in ("prototype", "five_segment_reacher"):
        rod, _ = mounted(robot, 0.1, (5.0, 0.0, 0.0), 0.0, felt=False)
        swing = lambda k, rod=rod: rod.step(tip_force=(0.0, 0.0, 1e-4 * np.sin(0.1 * k)))  # noqa: E731
        rows.append(timed(f"{robot}, free", swing, steps))
    rod, _ = mounted("prototype", 0.1, (0.1 + 0.5 * SIZE - 0.017, 0.0, 0.0), 0.0, felt=True)
    rest, world = rod.simulator.robots[0].rest_tendon_length, rod.bullet

    def push(k: int) -> Any:
        world.resetBasePositionAndOrientation(rod.host.body, [0.1 * DT * k, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        world.resetBaseVelocity(rod.host.body, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0])
        return rod.step(tendon_length=rest)

    def in_contact(rod: Any) -> bool:
        return bool(rod.state.contacts.count[0])

    rows.append(timed("prototype, pushes a free cube", push, steps, partial(in_contact, rod)))
    long, _ = mounted("five_segment_reacher", 0.02, (0.15, 0.0, 0.1), 9.81, felt=True)
    what = "five_segment_reacher, 20 g fall on it"
    return [*rows, timed(what, lambda _: long.step(), steps, partial(in_contact, long))]


def paper(steps: int) -> list[Row]:
    soft = SoftManiSim()
    soft.add_a_cube([0.1, 0.1, 0.03], size=[0.06] * 3)
    most = np.array([0.0, 0.002, 0.001] * 3)

    def wave(k: int) -> Any:
        return most * np.sin(0.02 * k)

    calls: list[tuple[str, Callable[[int], Any], int]] = [
        ("SoftManiSim, 3 segments: move_robot_ori", lambda k: soft.move_robot_ori(wave(k)), steps),
        ("calc_tip_pos", lambda k: soft.calc_tip_pos(wave(k)), steps),
        ("capture_image, 640 x 480", lambda _: soft.capture_image(), max(3, steps // 20)),
    ]
    rows = [timed(what, lambda k, call=call: call(k) and None, n) for what, call, n in calls]
    soft.close()
    return rows


def engines(steps: int) -> list[Row]:
    """The same rod on the same UR5 in both engines."""
    import two_engines

    rows = []
    for case in two_engines.CASES:
        found = {engine: two_engines.at_rest(engine, case, max(steps, 100)) for engine in two_engines.ENGINES}
        apart = two_engines.apart(found["PyBullet"], found["MuJoCo"])
        row: Row = {"what": case, **{name: 100.0 * value for name, value in apart.items()}}
        for engine, result in found.items():
            taken = timed(f"{engine}, {case}", lambda _, result=result: result.step(), steps)
            row[f"{engine.lower()}_ms"] = taken["median_ms"]
        rows.append(row)
    return rows


def falls(ratio: float, dt: float) -> Row:
    """A body of 1 kg that falls for 0.2 s with a rod on it, by defaults; the same with a rod that feels a
    body it does not touch; and a ball whose bent rod is let go, in no engine."""
    import pairs

    note_progress(f"a rod of {ratio:g} times its body's mass, {1e3 * dt:g} ms")
    robot, n = pairs.heavy(ratio), round(0.2 / dt)
    row: Row = {"ratio": ratio, "dt_ms": 1e3 * dt}
    for engine in ("pybullet", "mujoco"):
        for contact in (False, True):
            rod, speed = pairs.falling(engine, robot, dt, contact)
            for _ in range(n):
                rod.step()
            row[f"{engine}{'_felt' if contact else ''}"] = -speed() / (pairs.GRAVITY * n * dt)
    bent = pairs.FreeBody(robot, 1.0 / ratio, dt, (0.0, 0.0, 0.0))
    pull = 1e-3 * np.eye(len(robot.rest_tendon_length))[0]
    bent.rod.settle(pairs.HOME, tendon_length=robot.rest_tendon_length - pull, gravity=np.zeros(3))
    lost, size = np.zeros(6), np.zeros(6)
    for _ in range(n):
        bent.step(tendon_length=robot.rest_tendon_length)
        both = bent.momentum()
        lost, size = np.maximum(lost, np.abs(both.sum(0))), np.maximum(size, np.abs(both).max(0))
    return row | {"linear": lost[:3].max() / size[:3].max(), "angular": lost[3:].max() / size[3:].max()}


def coupled(steps: int) -> list[Row]:
    """A step of a rod on a body that gives way, beside one on a base of prescribed motion."""
    import pairs

    rows = []
    for name in ("prototype", "five_segment_reacher"):
        robot = pairs.heavy(0.2, name)
        pull, row = np.eye(len(robot.rest_tendon_length))[0], dict[str, Any](what=name)
        for key, dynamics, mobility in (
            ("static_ms", False, None),
            ("prescribed_ms", True, None),
            ("gives_way_ms", True, np.diag([1.0] * 3 + [600.0] * 3)),
        ):
            rod = fastrod.Rod(robot, dt=DT, dynamics=dynamics)

            def swing(k: int, rod: Any = rod, given: Any = mobility) -> Any:
                length = robot.rest_tendon_length - 5e-4 * np.sin(0.05 * k) * pull  # noqa: B023
                return rod.advance(pairs.HOME, np.zeros(6), DT, inverse_inertia=given, tendon_length=length)

            row[key] = timed(f"{name}, {key}", swing, steps)["median_ms"]
        rows.append(row | {"ratio": row["gives_way_ms"] / row["static_ms"]})
    return rows


def measure(options: Any) -> list[Section]:
    steps = 10 if options.quick else 200
    return [
        table(
            "hosts",
            "Rods on rigid hosts",
            "what step of | median_ms:.2f median~ms | p95_ms:.2f 95 %~ms | longest_ms:.1f longest~ms"
            "| in_contact:.2f in contact | failed:d not ok | steps:d",
            rods(steps) + paper(steps),
            f"One thread, world steps of {1e3 * DT:g} ms, ten points a segment; the step of PyBullet's world "
            "is in it. Warm.",
        ),
        table(
            "pairs",
            "A rod on a body that gives way",
            "ratio:g rod~/ body | dt_ms:g dt~ms | pybullet:.5f falls at~g, PyBullet "
            "| mujoco:.5f falls at~g, MuJoCo | pybullet_felt:.5f feels contact,~PyBullet "
            "| mujoco_felt:.5f feels contact,~MuJoCo"
            "| linear:.1e momentum~lost | angular:.1e angular~momentum lost",
            [
                falls(ratio, dt)
                for ratio in ((0.05, 5.0) if options.quick else (0.05, 0.5, 1.0, 5.0))
                for dt in (1e-3, 5e-3, 1e-2)
            ],
            "Lost: most over 0.2 s of the pair's, after its bent rod is let go, over the largest of either.",
        ),
        table(
            "coupling",
            "What it costs to give way",
            "what | static_ms:.2f quasi-static~ms | prescribed_ms:.2f in motion,~prescribed "
            "| gives_way_ms:.2f in motion,~gives way | ratio:.2f gives way~/ quasi-static",
            coupled(steps),
            "One thread, without an engine.",
        ),
        table(
            "engines",
            "The same rod and host in PyBullet and in MuJoCo",
            "what UR5 and rod,~at rest | tip:.4f tips apart~% of length | force:.4f forces apart~%"
            "| moment:.4f moments apart~% | pybullet_ms:.2f PyBullet~ms a step | mujoco_ms:.2f MuJoCo~ms a "
            "step",
            engines(steps),
            f"Tip of the rod and wrench on the flange, world, after {max(steps, 100)} steps; PyBullet's "
            "motors hold the arm rigidly, MuJoCo's servos yield by some 1e-5 rad.",
        ),
    ]


main = bench(__doc__, measure)
