"""Impossible inputs give one sentence: what was given, and what would be right."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rods import rod

import fastrod.reference as reference
from fastrod import Lump, Modal, Modes, Observer, Robot, Segment, Simulator, Tendon, load_robot
from fastrod.commands.demo import run as demo
from fastrod.contact import ContactScene, sphere
from fastrod.control.inverse import plan
from fastrod.errors import FastrodError, InputError, LogError, RobotError, UnknownNameError
from fastrod.identification.excite import excitation
from fastrod.logs.link import Measurement
from fastrod.logs.reader import read_log
from fastrod.logs.recording import Recorder
from fastrod.logs.runlog import RunLog
from fastrod.logs.simulated import SimulatedRobot
from fastrod.model.robotfile import dumps, loads, save_robot
from fastrod.model.segment_actions import SegmentActions

Rows = list[tuple[Callable[[], object], str]]
REST = rod().rest_tendon_length
BALL = sphere(0.01, name="ball", position=(0.1, 0.0, 0.1))
PROTOTYPE, REACHER, TDCR_A = (load_robot(name) for name in ("prototype", "five_segment_reacher", "tdcr_a"))
PLAIN, LONG, HUGE = dumps(PROTOTYPE), "a" * 5000, 10**400


def scene(**given: Any) -> ContactScene:
    return ContactScene(obstacles=[BALL], **given)


def touching() -> Simulator:
    sim = Simulator(rod(), 2, contact=scene(rod_radius=0.003), points_per_segment=4)
    sim.settle(REST)
    return sim


def segment(**given: Any) -> Segment:
    usual = {"length": 0.07, "bending_stiffness": (0.002, 0.002), "torsional_stiffness": 0.001}
    return Segment(**usual | {"tendons": (Tendon(offset=0.007, angle=0.0),)} | given)


def slack() -> Robot:
    tendon = Tendon(offset=0.007, angle=0.0, unilateral=True)
    return Robot(name="slack", segments=(segment(mode="tendon_tension", tendons=(tendon,)),))


def reading(t: float) -> Measurement:
    return replace(SimulatedRobot(rod()).read(), t=t)


def recorder(t: float = 0.0) -> Recorder:
    made = Recorder(rod())
    made.start(t)
    return made


def of_another_shape() -> Any:
    return reference.constant_curvature(TDCR_A, TDCR_A.rest_tendon_length)


def settle(*given: Any, **named: Any) -> object:
    return Simulator(rod(), n_robots=2).settle(*given, **named)


def step(**named: Any) -> object:
    """Step three robots that may extend."""
    return three().step(REST, **named)


def three() -> Simulator:
    return Simulator(rod(extension=(-0.005, 0.02)), 3, points_per_segment=5)


def settled(*given: Any, **named: Any) -> Simulator:
    sim = Simulator(*given, **named)
    sim.settle(sim.robots[0].rest_tendon_length)
    return sim


def reacher() -> Simulator:
    return Simulator(REACHER)


def rod_with(name: str, **values: Any) -> Robot:
    return replace(rod(), effects=({"name": name, **values},))


def sensor(line: str) -> object:
    return loads(f"{PLAIN}[sensor]\n{line}\n")


def stiff(mode: str) -> Robot:
    return Robot(name="stiff", segments=(segment(mode=mode),) * 2)


def chain_of_thirty() -> Robot:
    stretching = segment(
        tendons=(Tendon(offset=0.01, angle=0.0), Tendon(offset=0.01, angle=1.5)), extension=(-0.001, 0.001)
    )
    return Robot(name="many", segments=(stretching,) * 30)


LENGTHS = [0.07] * 4
MASKED = np.ma.array(REACHER.rest_tendon_length, mask=[True] + 14 * [False])
FORCE = np.ma.array([0.0, 0.0, 0.1], mask=[False, False, True])
PLACE = np.ma.array([0.1], mask=[True])
HOME = REACHER.rest_tendon_length

INPUTS: Rows = [
    (lambda: settle(tendon_length=np.zeros((3, 4))), r"shape \(3, 4\); it must be \(2, 4\)"),
    (lambda: settle(tendon_length="abc"), "not an array of numbers"),
    (lambda: settle(tendon_length=[70.0] * 4), "Was it given in mm"),
    (lambda: settle(tendon_length=[0.001, 0.0, -0.001, 0.0]), "Add Robot.rest_tendon_length"),
    (lambda: settle(tendon_length=[np.nan] * 4), "not finite"),
    (lambda: settle(tendon_length=[-0.07] * 4), "impossible"),
    (lambda: three().step(), "tendon_length is missing"),
    (lambda: settle(LENGTHS, tip_force=[1.0, 2.0]), r"tip_force has shape \(2,\)"),
    (lambda: settle(LENGTHS, extension=[0.01]), "outside the range"),
    (lambda: settle(LENGTHS, point_force=[(0.1, (0, 0, 1))]), "the rod runs from 0 to 0.07"),
    (lambda: settle(LENGTHS, point_force=[0.1, 0.2]), "pairs"),
    (lambda: settle(LENGTHS, base_pose=[0, 0, 0, 1, 1, 0, 0]), "norm"),
    (lambda: settle(LENGTHS, tolerance=0.0), "tolerance"),
    (lambda: settle(LENGTHS, line_force=np.zeros((2, 5, 3, 2))), "line_force has shape"),
    (lambda: settle(LENGTHS, line_force=np.zeros((1, 1, 3))), "two or more"),
    (lambda: settle(LENGTHS, tension=[1.0] * 4), "no segment of this robot"),
    (lambda: three().settle(REST, tolerance=HUGE), r"tolerance is 1000.* m; it must be a number"),
    (
        lambda: step(tip_force=(0.0, 0.0, 1e13)),
        r"tip_force holds a value beyond 1e\+12 N: \[0\.e\+00 0\.e\+00 1\.e\+13\]\.",
    ),
    (lambda: step(tip_force=[HUGE, 0, 0]), "tip_force is not an array of numbers"),
    (lambda: step(point_force=[(HUGE, (0, 0, 1))]), "point_force must be"),
    (lambda: reacher().restore("x"), r"^the snapshot is 'x'; give what Simulator.snapshot\(\) returned"),
    (lambda: reacher().step(dt=0.1), r"^step has no input 'dt'; the time step is given once: Simulator\("),
    (lambda: reacher().settle(tip_forc=(0, 0, 1)), "^settle has no input 'tip_forc'; did you mean"),
    (lambda: reacher().step(MASKED), "^tendon_length is a masked array that hides 1 of 15 entries"),
    (lambda: reacher().step(HOME, tip_force=FORCE), "tip_force is a masked array"),
    (lambda: reacher().step(HOME, point_force=[(0.1, FORCE)]), "point_force is a masked array"),
    (lambda: reacher().step(HOME, point_force=[(PLACE, (0, 0, 1))]), "arclength"),
    (lambda: reacher().step(HOME, gravity=9.81), r"gravity has shape \(\); it must be"),
    (lambda: reacher().settle(HOME, rows=np.ma.array([0], mask=[True])), "rows is a masked array"),
    (
        lambda: Simulator(rod("paper")).step(REST, follower_tip_force=(0.0, 0.0, 0.1)),
        "follower_tip_force was given, but mode paper has dead loads only",
    ),
    (
        lambda: Simulator(rod("tendon_tension")).step(),
        "tension is missing; segments in mode tendon_tension need tension",
    ),
    (
        lambda: Simulator(chain_of_thirty()).step(
            chain_of_thirty().rest_tendon_length, extension=np.full(30, 0.0123456)
        ),
        "lies outside the range of the segments",
    ),
    (
        lambda: SegmentActions(chain_of_thirty()).inputs(np.full(90, np.nan)),
        "action holds a value that is not finite",
    ),
    (lambda: SegmentActions(chain_of_thirty()).inputs([HUGE] * 90), r"action is .*; give 90 numbers \[m\]\."),
]

SIMULATORS: Rows = [
    (lambda: Simulator(rod(), n_robots=0), "n_robots is 0"),
    (lambda: Simulator(rod(), n_robots=2.5), "whole number"),
    (lambda: Simulator(rod(), n_robots=HUGE), "take fewer"),
    (lambda: Simulator(rod(), points_per_segment=1), "at least 2"),
    (lambda: Simulator(rod(), outputs="tips"), "'full' or 'tip'"),
    (lambda: Simulator(rod(), threads=1000), "threads is 1000"),
    (lambda: Simulator(REACHER, 10**12), r"n_robots 1e\+12 with 101 points each would take [\d.e+]+ GiB"),
    (lambda: Simulator(REACHER, 10**12, outputs="tip"), r"take fewer\.$"),
    (lambda: Simulator(REACHER, 2, points_per_segment=10**12), r"n_robots 2 with 5e\+12 points each"),
    (lambda: Simulator(rod()).jacobian(), "call step or settle first"),
    (lambda: Simulator(rod()).compliance(), "call step or settle first"),
    (lambda: Simulator(rod()).shape(0.01), "call step or settle first"),
    (lambda: Simulator(rod()).measure(), "call step or settle first"),
    (lambda: settled(rod()).shape(0.08), r"arclength 0.08 m; robot 0 runs from 0 to 0.07"),
    (lambda: settled(rod()).shape(HUGE), r"arclength is 1000.*; give numbers"),
    (
        lambda: settled(rod(), outputs="tip").shape(0.01),
        r"shape needs Simulator\(..., outputs='full'\); this one keeps the tip only",
    ),
    (
        lambda: Simulator(rod(), 2).restore(settled(rod(), 3).snapshot()),
        "another simulator; its robots, tendons or their number differ",
    ),
    (
        lambda: Simulator(rod_with("creep", share=0.1), 3).restore(settled(rod(), 3).snapshot()),
        "another simulator; its effects differ",
    ),
    (
        lambda: Simulator(rod_with("creep")).restore(Simulator(rod_with("backlash")).snapshot()),
        "another simulator",
    ),
    (
        lambda: settled(rod(), 3).replace([0, 1], [rod()]),
        r"rows has shape \(2,\) for 1 robots; give the index of each",
    ),
    *(
        (
            lambda name=name, value=value: excitation(PROTOTYPE, **{name: value}),
            f"{name} is {value!r} .*; it must be between",
        )
        for name, value in (("bend", 1e-300), ("rate", 1e9), ("rate", 1e-9), ("speed", 1e-9), ("speed", 1e9))
    ),
]

SEGMENT = "[[segment]]\nlength = 0.07\nbending_stiffness = [0.002, 0.002]\ntorsional_stiffness = 0.001\n"
A = 'name = "a"\n' + SEGMENT
TENDON = "tendons = [{offset = 0.01, angle = 0.0"


def moving(robot: Robot | None = None, **options: Any) -> Simulator:
    return Simulator(robot or rod(line_density=0.1), points_per_segment=4, **{"dynamics": True} | options)


def settled_moving(**options: Any) -> Simulator:
    sim = moving(**options)
    sim.settle(REST)
    return sim


MOTION: Rows = [
    (
        lambda: moving(rod()),
        r"^segment 1 of 'tendon_length' has line_density 0 kg/m, and dynamics=True needs",
    ),
    (lambda: moving(rod("paper", line_density=0.1)), "^mode 'paper' has no energy, and so no modes; take"),
    (lambda: Simulator(rod(), solver="modl"), "^solver is 'modl'; did you mean 'modal'"),
    (lambda: Simulator(rod(), solver=3), "^solver is 3; known: modal, observer"),
    (
        lambda: moving(solver="observer"),
        "^solver is 'observer' with dynamics=True, which needs solver='modal'",
    ),
    (
        lambda: Simulator(rod(axial_stiffness=9.0), solver="observer"),
        "^solver is 'observer' with a robot with axial_stiffness",
    ),
    (
        lambda: Simulator(rod(lumps=(Lump(at=0.01, mass=0.1),)), solver="observer"),
        "^solver is 'observer' with a robot with lumps",
    ),
    (lambda: moving(scheme="bdf3"), "^scheme is 'bdf3'; did you mean 'bdf2'"),
    (lambda: Modal(dynamics=True, rho=1), "^rho is 1; it must be a number from 0 to 0.9. Beyond it"),
    (lambda: moving(dt=0.0), "^dt is 0.0 s; it must be a number, positive and finite"),
    (lambda: moving(dynamics=False, scheme="bdf2"), "^scheme is 'bdf2' without dynamics, and nothing moves"),
    (lambda: Modal(rho=0.8), "^rho is 0.8 without dynamics"),
    (lambda: Modal(modes=(4, 2)), r"^modes is \(4, 2\); give fastrod.Modes\(bending=4, torsion=2\)"),
    *(
        (
            lambda name=name, value=value: Modal(modes=Modes(**{name: value})),
            f"^modes.{name} is {value!r}; .* a whole number from 1 to {16 if name == 'pieces' else 8}",
        )
        for name, value in (("bending", 0), ("torsion", 9), ("strain", 1.5), ("pieces", "two"))
    ),
    (
        lambda: Simulator(rod(), modes=Modes(4, 2)),
        "no input 'modes'; it is one of the solver: solver=fastrod.Modal",
    ),
    (lambda: moving(solver=Observer()), "^dynamics was given beside a solver; give solver=fastrod.Modal"),
    (lambda: moving(solver=Modal(), dynamics=False, scheme="bdf2"), "^scheme was given beside a solver"),
    *(
        (lambda n=n: moving().step(REST, passes=n), f"^passes is {n!r}; .* a whole number from 1 to 100")
        for n in (0, 101, 1.5, "two")
    ),
    (lambda: Simulator(rod()).step(REST, passes=2), "^passes is 2; the observer takes one a step"),
    (lambda: moving().step(REST, extension=[0.01]), r"^extension \[0.01\] m lies outside the range"),
    (lambda: moving().frequencies(), "^frequencies needs a state; call step or settle first"),
    (lambda: settled(rod()).frequencies(), "^frequencies needs inertia; give Simulator"),
    (lambda: settled_moving().frequencies(0), "^count is 0; it must be a whole number, at least 1"),
    (lambda: settled_moving().frequencies(99), "^count is 99; these rods have 10 unknowns: give more modes"),
]

ROBOTS: Rows = [
    (lambda: Lump(at=0.01, mass=0.1, inertia=(1.0, 1.0, 3.0)), "no body has it"),
    (lambda: rod(lumps=(Lump(at=0.08, mass=0.1),)), "^Lump.at is 0.08 m, beyond the 0.07 m of its segment"),
    (lambda: rod(lumps=(0.1,)), r"^Segment.lumps is \(0.1,\); give a tuple of Lump"),
    (
        lambda: Simulator([rod(lumps=(Lump(at=0.01, mass=0.1),)), rod()]),
        "^robot 1 of the batch has lumps on other segments than robot 0, or more or fewer",
    ),
    (lambda: loads(A + "lumps = [{at = 0.01, mas = 0.1}]\n" + TENDON + "}]"), "did you mean 'mass'"),
    (lambda: loads(A + "lumps = [{at = 0.01}]\n" + TENDON + "}]"), "mass"),
    (lambda: loads(A + "damping_tme = 0.1\n" + TENDON + "}]"), "did you mean 'damping_time'"),
    (lambda: loads('name = "a"'), "no segments"),
    (lambda: loads(SEGMENT + 'mode = "passive"'), "no name"),
    (lambda: loads('name = "a"\nlenght = 3\n'), "unknown key 'lenght'"),
    (lambda: loads(A.replace("length", "lenght")), "did you mean 'length'"),
    (lambda: loads(A.replace("0.07", "70")), "Was it given in mm"),
    (lambda: loads(A.replace("0.07", "-0.07")), "length is -0.07 m; it must be a number from 1e-06 to 10 m"),
    (lambda: loads(A.replace("0.07", '"long"')), "length: Expected 'float'"),
    (lambda: loads(A + 'mode = "tendon_lenght"'), "tendon_length"),
    (lambda: loads(A + TENDON + ", colour = 1}]"), "unknown key 'colour'"),
    (lambda: loads(A + "tendons = [{offset = 0.01, angle = 90.0}]"), "degrees"),
    (lambda: loads(A + "body_radius = 0.005\n" + TENDON + "}]"), "beyond the body radius"),
    (lambda: loads(A + "youngs_modulus = 3e5"), "all of youngs_modulus"),
    (lambda: loads(A + 'mode = "passive"\n[base]\nquaternion = [1, 1, 0, 0]'), "it must be 1"),
    (lambda: loads("name = "), "not TOML"),
    (lambda: Simulator("prototype"), "load_robot"),
    (lambda: Simulator(None), "load_robot"),
    (lambda: Simulator([]), "load_robot"),
    (lambda: Simulator([rod(n_tendons=3), rod(n_tendons=4)]), "n_tendons 4, robot 0 has 3"),
    (lambda: Simulator([rod(), rod("tendon_tension")]), "modes"),
    (
        lambda: replace(TDCR_A, segments=(replace(TDCR_A.segments[0], mode="paper"), TDCR_A.segments[1])),
        "whole robot",
    ),
    (
        lambda: Simulator([rod(), rod_with("gravity", line_density=0.1)]),
        "robot 1 of the batch has effects gravity, robot 0 has none",
    ),
    (
        lambda: Simulator(
            [
                replace(rod(offset=d), effects=({"name": "gravity", "line_density": 0.1},))
                for d in (7.5e-3, 8e-3)
            ]
        ),
        "robot 1 of the batch has segments of other lengths or tendons at other places",
    ),
    (lambda: load_robot("a\0.toml"), r"robot file 'a\\x00.toml' cannot be read: embedded null byte\."),
    (lambda: load_robot(LONG), r"cannot be read: File name too long\."),
    (
        lambda: loads("x = " + "[" * 100_000),
        "robot file is not a robot: its tables stand too deep in one another",
    ),
    (lambda: loads("x = " + "9" * 5000), "robot file holds a number that nothing has: Exceeds the limit"),
    (
        lambda: loads(PLAIN + '[fit]\n"segment.1.length" = {sd = ' + "9" * 400 + "}\n"),
        r"robot file: fit: Number out of range\.",
    ),
    (
        lambda: loads("name = 'x'\nsegment = ['" + LONG + "']"),
        r"robot file: segment 1 is 'aaa+ \.\.\. a+'; it must be a table",
    ),
    (lambda: sensor("latency_sd = [0.1, 0.1]"), r"\[sensor\] latency_sd has 2 numbers; give one\."),
    (lambda: sensor("latency_sd = [0.1]"), r"\[sensor\] latency_sd is \[0.1\]; give one number\."),
    (
        lambda: sensor("registration_sd = [0.1]"),
        r"registration_sd has 1 numbers; give one, or two: m and rad\.",
    ),
    (
        lambda: sensor("noise = -1e-3"),
        r"\[sensor\] noise is -0.001; it must be zero or positive, and finite\.",
    ),
    *(
        (
            lambda robots=robots: settled(rod(), 3).replace([0], robots),
            r"robots is .*; give a list of Robot, one for each row\.",
        )
        for robots in (None, "x", [None])
    ),
    (lambda: rod("paper", 0), "A segment in mode 'paper' needs tendons; give some, or mode 'passive'"),
    (
        lambda: SegmentActions(stiff("tendon_tension")),
        r"^segment 1 of robot 'stiff' is tendon_tension; an action needs tendons driven by length\.$",
    ),
]

NAMES: Rows = [
    (lambda: load_robot(""), r"no robot ''; known: .*A path must end in \.toml\."),
    (lambda: load_robot("prototpye"), "did you mean 'prototype'"),
]

OTHERS: Rows = [
    (lambda: touching().ray_cast([1.0, 2.0], [[0.0, 0.0, 1.0]]), r"rays have origins of shape \(2,\)"),
    (
        lambda: touching().ray_cast([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]),
        "a ray has .* a direction of length 0",
    ),
    (
        lambda: touching().ray_cast([[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]], longest=0.0),
        "longest is 0.0 m; it must be a number, positive",
    ),
    (lambda: touching().state.contacts.in_contact("bal"), "no obstacle 'bal'; did you mean 'ball'"),
    (
        lambda: touching().step(REST, obstacle_pose={"ball": "here"}),
        r"obstacle_pose\['ball'\] is not an array of numbers",
    ),
    (
        lambda: touching().step(REST, obstacle_pose={"ball": [math.nan] * 7}),
        "holds a value that is not finite",
    ),
    (
        lambda: Simulator(rod(), contact=scene(rod_radius=(1.0, 2.0))),
        "rod_radius is .*; give one radius or 1, one a segment",
    ),
    (
        lambda: plan(rod(), np.zeros((3, 3)), 0.1, start="there"),
        r"start is not an array of numbers; give \(4,\), one change",
    ),
    (lambda: demo(None, seed=-1), "seed is -1; it must be a whole number, zero or positive"),
    (lambda: recorder(math.nan), "a recording begins at t = nan; it must be a finite time"),
    (lambda: recorder().add(reading(math.inf)), "the reading has t = inf; a row needs a finite time"),
    (
        lambda: reference.constant_curvature(rod(), [0.07]),
        r"tendon_length has shape \(1,\); it must be \(4,\), one length",
    ),
    (lambda: reference.shoot(slack(), tension=[-1.0]), "a unilateral tendon cannot push"),
    (lambda: reference.shoot(rod(), REST, point_force=[(0.01,)]), "each entry must be a pair of arclength"),
    (
        lambda: reference.shoot(rod(), REST, points_per_segment=0),
        "points_per_segment is 0; it must be 1 or more",
    ),
    (lambda: reference.shoot(rod(), REST, guess=of_another_shape()), "guess is the shape of another robot"),
    (
        lambda: segment(extension=(-0.1, 0.0)),
        r"extension is \[-0.1, 0.0\] m; give \[smallest, largest\] change",
    ),
    (lambda: segment(mode="passive"), "A passive segment has no tendons; it was given 1"),
    (
        lambda: Robot(name="r", segments=(segment(length=0.005),)),
        "Tendon offset 0.007 m of segment 1 is larger than the length 0.005 m",
    ),
    (lambda: load_robot(3), "robot is 3; give the name of a shipped robot or the path of a .toml"),
    (lambda: save_robot(rod(), "mine.json"), "'mine.json' does not end in .toml; a robot file does"),
    (lambda: loads("name = 'r'\n[[segment]]\ntendons = 3\n"), "tendons must be a list of tables"),
    (
        lambda: RunLog(
            name="none",
            t=np.zeros(0),
            dl=np.zeros((0, 4)),
            tip_position=np.zeros((0, 3)),
            run=np.zeros(0, np.str_),
        ),
        "log 'none' has no rows",
    ),
    (lambda: SimulatedRobot(rod()).command("far"), r"dl is not an array of numbers; give \(4,\)"),
    (
        lambda: Simulator([rod(), rod()], 3),
        "2 robots for n_robots 3; give one for all, or a list of n_robots",
    ),
    (lambda: touching().shape(np.zeros((3, 4, 5))), r"arclength has shape \(3, 4, 5\); it must be"),
    (lambda: Observer(proces_noise=1.0), "no field 'proces_noise'; did you mean 'process_noise'"),
]

REFUSED = [
    *((InputError, *row) for row in INPUTS + SIMULATORS + MOTION),
    *((RobotError, *row) for row in ROBOTS),
    *((UnknownNameError, *row) for row in NAMES),
    (LogError, lambda: read_log("a\0.csv", PROTOTYPE), r"cannot be read: embedded null byte\."),
    *((FastrodError, *row) for row in OTHERS),
]


@pytest.mark.parametrize(
    ("kind", "call", "sentence"), REFUSED, ids=[f"{kind.__name__}: {said[:40]}" for kind, _, said in REFUSED]
)
@pytest.mark.study(beyond=124)
def test_it_says_what_was_given_and_what_would_be_right(
    kind: type[FastrodError], call: Callable[[], object], sentence: str
) -> None:
    with pytest.raises(kind, match=sentence) as caught:
        call()
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < (400 if kind is RobotError else 1000)


def test_files_that_cannot_be_what_they_should_be(tmp_path: Path) -> None:
    import pyarrow as arrow
    from pyarrow import parquet

    empty, folder = tmp_path / "empty.parquet", tmp_path / "folder.csv"
    parquet.write_table(arrow.table({}), empty)
    with pytest.raises(FastrodError, match="has no columns"):
        read_log(empty, rod())
    folder.mkdir()
    with pytest.raises(FastrodError, match="is a folder; give the file to record to"):
        Recorder(rod(), folder)
    done = Recorder(rod(), tmp_path / "done.csv")
    done.start(0.0)
    done.add(reading(0.1))
    done.stop()
    with pytest.raises(FastrodError, match=r"done\.csv is written; record the next session to another file"):
        done.start(0.0)
    (tmp_path / "file").write_text("")
    with pytest.raises(FastrodError, match="cannot be written"):
        save_robot(rod(), tmp_path / "file" / "mine.toml")


def test_hosts_say_what_cannot_be_carried() -> None:
    pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")
    from fastrod.hosts import BulletLink, RodBodies, SoftManiSim, connect

    world = connect(dt=0.01)
    body = world.createMultiBody(1.0, world.createCollisionShape(world.GEOM_SPHERE, radius=0.1))
    with pytest.raises(FastrodError, match=r"position has shape \(2,\); it must be \(3,\), of the mount"):
        BulletLink(world, body, position=(0.0, 0.0))
    with pytest.raises(FastrodError, match=r"radius is 0.0 m; it must be positive"):
        RodBodies(world, 0.1, 0.0, 3)
    with pytest.raises(AttributeError, match="PyBullet has no 'stepSimulaton'"):
        _ = world.stepSimulaton
    with pytest.raises(FastrodError, match="robot is 'ur5'; give a Robot"):
        SoftManiSim(robot="ur5")
