"""Sentences that nothing else provokes: what was given, and what would be right."""

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
from fastrod import Observer, Robot, Segment, Simulator, Tendon, load_robot
from fastrod.commands.demo import run as demo
from fastrod.contact import ContactScene, sphere
from fastrod.control.inverse import plan
from fastrod.errors import FastrodError
from fastrod.logs.link import Measurement
from fastrod.logs.recording import Recorder
from fastrod.logs.runlog import RunLog, read_log
from fastrod.logs.simulated import SimulatedRobot
from fastrod.model.robotfile import loads, save_robot

REST = rod().rest_tendon_length
BALL = sphere(0.01, name="ball", position=(0.1, 0.0, 0.1))


def scene(**given: Any) -> ContactScene:
    return ContactScene(obstacles=[BALL], **given)


def touching() -> Simulator:
    sim = Simulator(rod(), 2, contact=scene(rod_radius=0.003), points_per_segment=4)
    sim.settle(REST)
    return sim


def segment(**given: Any) -> Segment:
    one_tendon = (Tendon(offset=0.007, angle=0.0),)
    return Segment(
        **{
            "length": 0.07,
            "bending_stiffness": (0.002, 0.002),
            "torsional_stiffness": 0.001,
            "tendons": one_tendon,
        }
        | given
    )


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
    return reference.constant_curvature(load_robot("tdcr_a"), load_robot("tdcr_a").rest_tendon_length)


SENTENCES: list[tuple[Callable[[], object], str]] = [
    (lambda: touching().ray_cast([1.0, 2.0], [[0.0, 0.0, 1.0]]), r"rays have origins of shape \(2,\)"),
    (
        lambda: touching().ray_cast([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]),
        "a ray has .* a direction of length 0",
    ),
    (
        lambda: touching().ray_cast([[0.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]], longest=0.0),
        "longest is 0.0 m; it must be positive",
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
    (lambda: scene(rod_friction=-1.0), "rod_friction is -1.0; it must be zero or positive"),
    (lambda: scene(max_contacts=65), "max_contacts is 65; it must be a whole number from 1 to 64"),
    (
        lambda: scene(max_passes=60),
        r"max_passes is now max_iterations; give ContactScene\(max_iterations=60\)",
    ),
    (lambda: scene(max_iterations=3), "max_iterations is 3; it must be a whole number, at least 20"),
    (lambda: scene(watch=0.5), "watch is 0.5; it is a fraction of the rod's length"),
    (lambda: scene(mounting=-0.1), "mounting is -0.1 m; it must be zero or positive"),
    (
        lambda: Simulator(rod(), contact=scene(rod_radius=(1.0, 2.0))),
        "rod_radius is .*; give one radius or 1, one a segment",
    ),
    (
        lambda: plan(rod(), np.zeros((3, 3)), 0.1, start="there"),
        "start is 'there'; give 4 changes of tendon length",
    ),
    (lambda: demo(None, seed=-1), "seed is -1; it must be a whole number from 0"),
    (lambda: recorder(math.nan), "a recording begins at t = nan; it must be a finite time"),
    (lambda: recorder().add(reading(math.inf)), "the reading has t = inf; a row needs a finite time"),
    (
        lambda: reference.constant_curvature(rod(), [0.07]),
        r"tendon_length has shape \(1,\); it must be \(4,\) finite lengths",
    ),
    (lambda: reference.shoot(slack(), tension=[-1.0]), "a unilateral tendon cannot push"),
    (lambda: reference.shoot(rod(), REST, point_force=[(0.01,)]), "each entry must be a pair of arclength"),
    (
        lambda: reference.shoot(rod(), REST, points_per_segment=0),
        "points_per_segment is 0; it must be 1 or more",
    ),
    (lambda: reference.shoot(rod(), REST, guess=of_another_shape()), "guess is the shape of another robot"),
    (lambda: segment(bending_stiffness=0.002), "bending_stiffness is 0.002; give two values, EI_x and EI_y"),
    (lambda: segment(precurvature=(1.0, 2.0)), r"precurvature is \[1.0, 2.0\]; it must be 3 finite numbers"),
    (
        lambda: segment(extension=(-0.1, 0.0)),
        r"extension is \[-0.1, 0.0\] m; give \[smallest, largest\] change",
    ),
    (lambda: segment(mode="tendon_lenght"), "mode is 'tendon_lenght'; did you mean 'tendon_length'"),
    (lambda: segment(mode="passive"), "A passive segment has no tendons; it was given 1"),
    (lambda: segment(body_radius=-1.0), "body_radius is -1.0 m; it must be between 0 and"),
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
    (lambda: SimulatedRobot(rod()).command("far"), "dl is 'far'; give 4 numbers"),
    (
        lambda: Simulator([rod(), rod()], 3),
        "2 robots for n_robots 3; give one for all, or a list of n_robots",
    ),
    (lambda: touching().shape(np.zeros((3, 4, 5))), r"arclength has shape \(3, 4, 5\); it must be"),
    (lambda: Observer(process_noise=0.0), "Observer.process_noise is 0.0; it must be positive and finite"),
]


@pytest.mark.parametrize(("call", "sentence"), SENTENCES, ids=[sentence[:40] for _, sentence in SENTENCES])
def test_it_says_what_was_given_and_what_would_be_right(call: Callable[[], object], sentence: str) -> None:
    with pytest.raises(FastrodError, match=sentence) as told:
        call()
    assert len(str(told.value).splitlines()) == 1


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
    with pytest.raises(FastrodError, match=r"the mount is .*; give a position \(3,\)"):
        BulletLink(world, body, position=(0.0, 0.0))
    with pytest.raises(FastrodError, match=r"radius is 0.0 m; it must be positive"):
        RodBodies(world, 0.1, 0.0, 3)
    with pytest.raises(AttributeError, match="PyBullet has no 'stepSimulaton'"):
        _ = world.stepSimulaton
    with pytest.raises(FastrodError, match="robot is 'ur5'; give a Robot"):
        SoftManiSim(robot="ur5")
    world.disconnect()
