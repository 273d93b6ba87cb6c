"""What fuzzing has found, each once: odd files, paths and inputs that now are a result or one sentence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from rods import rod

from fastrod import Robot, Segment, Simulator, Tendon
from fastrod.contact import ContactScene, sphere
from fastrod.effects.base import Parameter, Seam, Static, effect, unregister
from fastrod.errors import EffectError, InputError, LogError, RobotError, UnknownNameError, shown
from fastrod.identification.excite import excitation
from fastrod.logs.recording import recover
from fastrod.logs.runlog import read_log
from fastrod.model.robotfile import dumps, load_robot, loads, save_robot
from fastrod.model.segment_actions import SegmentActions
from fastrod.solver.merge import merge_rows

PROTOTYPE = dumps(load_robot("prototype"))
LONG = "a" * 5000


def test_paths_that_no_file_can_have(tmp_path: Path) -> None:
    robot = load_robot("prototype")
    with pytest.raises(RobotError, match=r"robot file 'a\\x00.toml' cannot be read: embedded null byte\."):
        load_robot("a\0.toml")
    with pytest.raises(RobotError, match=r"cannot be read: File name too long\."):
        load_robot(LONG)
    with pytest.raises(RobotError, match=r"cannot be read: .*surrogates not allowed"):
        load_robot("a\ud800.toml")
    with pytest.raises(UnknownNameError, match=r"no robot ''; known: .*A path must end in \.toml\."):
        load_robot("")
    with pytest.raises(RobotError, match=r"cannot be written: embedded null byte\."):
        save_robot(robot, tmp_path / "a\0.toml")
    with pytest.raises(RobotError, match=r"cannot be written: .*surrogates not allowed"):
        save_robot(replace(robot, name="a\ud800"), tmp_path / "a.toml")
    with pytest.raises(LogError, match=r"cannot be read: embedded null byte\."):
        read_log("a\0.csv", robot)
    assert not list(tmp_path.iterdir())


def test_a_robot_file_may_begin_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "robot.toml"
    path.write_text(PROTOTYPE, encoding="utf-8-sig")
    assert load_robot(path) == load_robot("prototype")


TEXTS = {
    "too deep": (
        "x = " + "[" * 100_000,
        "robot file is not a robot: its tables stand too deep in one another",
    ),
    "digits": ("x = " + "9" * 5000, "robot file holds a number that nothing has: Exceeds the limit"),
    "place": (
        PROTOTYPE + '[fit]\n"segment.1.length" = {sd = ' + "9" * 400 + "}\n",
        r"robot file: fit: Number out of range\.",
    ),
    "a long table": (
        "name = 'x'\nsegment = ['" + LONG + "']",
        r"robot file: segment 1 is 'aaa+ \.\.\. a+'; it must be a table",
    ),
    "sensor list": (
        PROTOTYPE + "[sensor]\nlatency_sd = [0.1, 0.1]\n",
        r"\[sensor\] latency_sd has 2 numbers; give one\.",
    ),
    "sensor single": (
        PROTOTYPE + "[sensor]\nlatency_sd = [0.1]\n",
        r"\[sensor\] latency_sd is \[0.1\]; give one number\.",
    ),
    "sensor pair": (
        PROTOTYPE + "[sensor]\nregistration_sd = [0.1]\n",
        r"registration_sd has 1 numbers; give one, or two: m and rad\.",
    ),
    "sensor negative": (
        PROTOTYPE + "[sensor]\nnoise = -1e-3\n",
        r"\[sensor\] noise is -0.001; it must be zero or positive, and finite\.",
    ),
    "sensor nan": (
        PROTOTYPE + "[sensor]\nnoise = nan\n",
        r"\[sensor\] noise is nan; it must be zero or positive",
    ),
}


@pytest.mark.parametrize("case", TEXTS)
def test_texts_of_robots_that_are_none(case: str) -> None:
    text, sentence = TEXTS[case]
    with pytest.raises(RobotError, match=sentence) as caught:
        loads(text)
    assert len(str(caught.value)) < 400


NUMBERS: dict[str, tuple[Any, str]] = {
    "stiffness": (
        lambda: rod(bending_stiffness=(1e-300, 1.0)),
        r"bending_stiffness is 1e-300 N m\^2; it must be between 1e-20 and 1e\+15",
    ),
    "torsion": (
        lambda: rod(torsional_stiffness=1e200),
        r"torsional_stiffness is 1e\+200 N m\^2; it must be between",
    ),
    "length": (lambda: rod(length=1e-300), r"Segment.length is 1e-300 m; it must be between 1e-06 and inf m"),
    "offset": (
        lambda: Tendon(offset=5e-324, angle=0.0),
        r"Tendon.offset is 5e-324 m; it must be between 1e-06 and 10 m",
    ),
    "compliance": (
        lambda: Tendon(offset=0.01, angle=0.0, compliance=1e300),
        "compliance is 1e.300 m/N; it must be zero or positive",
    ),
    "pretension": (lambda: Tendon(offset=0.01, angle=0.0, pretension=1e300), "Tendon.pretension is 1e.300 N"),
    "gravity": (
        lambda: replace(rod(), gravity=(0.0, 0.0, 1e300)),
        r"Robot.gravity is \[0.0, 0.0, 1e\+300\]; its numbers must be between",
    ),
    "line density": (lambda: rod(line_density=1e300), "Segment.line_density is 1e.300 kg/m"),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_numbers_that_nothing_real_has(case: str) -> None:
    make, sentence = NUMBERS[case]
    with pytest.raises(RobotError, match=sentence):
        make()


def test_an_effect_without_bounds_still_needs_a_number_that_is_finite() -> None:
    @effect
    class Boundless(Static):
        """Nothing.

        Equation: none
        Source: none
        Residual signature: none
        """

        seam = Seam.LOAD
        parameters = (Parameter("size", "N"),)

        def apply(self, values: Any, memory: Any, ports: Any, state: Any, dt: float) -> None:
            """Nothing."""

    try:
        for value in (np.inf, 10**400, "x"):
            with pytest.raises(
                EffectError, match=r"size of effect 'boundless' is .* N; it must be a number from"
            ) as caught:
                Simulator(replace(rod(), effects=({"name": "boundless", "size": value},)))
            assert len(str(caught.value)) < 400
    finally:
        unregister("boundless")


def test_a_passive_robot_takes_its_own_rest_lengths() -> None:
    """There are none."""
    robot = rod("passive")
    state = Simulator(robot).settle(robot.rest_tendon_length)
    assert state.ok.all()


def pair(**given: Any) -> tuple[Simulator, Simulator, np.ndarray]:
    """Two simulators that have settled, and lengths."""
    robot = rod(extension=(-0.005, 0.02))
    one, other = (Simulator(robot, 3, points_per_segment=5, **given) for _ in range(2))
    lengths = robot.rest_tendon_length + np.array([[0.001, 0.0, -0.001, 0.0]]) * np.array(
        [[1.0], [2.0], [-1.0]]
    )
    return one, other, lengths


@pytest.mark.parametrize("name", ["tip_force", "extension", "base_pose", "tip_moment", "line_force"])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("cold", [True, False])
def test_a_bad_row_changes_no_bit_of_its_neighbours(name: str, value: float, cold: bool) -> None:
    sim, twin, lengths = pair()
    usual = {"extension": np.zeros((3, 1)), "base_pose": np.tile([0.0, 0, 0, 1, 0, 0, 0], (3, 1))}.get(
        name, np.zeros((3, 3))
    )
    bad = usual.copy()
    bad[1, -1] = value
    if not cold:
        for one in (sim, twin):
            one.settle(lengths, **{name: usual})
    for given in (bad, bad, usual):
        state, wanted = sim.step(lengths, **{name: given}), twin.step(lengths, **{name: usual})
        assert_array_equal(state.position[[0, 2]], wanted.position[[0, 2]])
        assert_array_equal(state.residual[[0, 2]], wanted.residual[[0, 2]])
        assert state.ok[1] == (given is usual)
        assert all("\n" not in sentence for sentence in state.problems.values())


def test_a_value_beyond_any_unit_is_refused() -> None:
    sim, _, lengths = pair()
    with pytest.raises(
        InputError, match=r"tip_force holds a value beyond 1e\+12 N: \[0\.e\+00 0\.e\+00 1\.e\+13\]\."
    ):
        sim.step(lengths, tip_force=(0.0, 0.0, 1e13))
    with pytest.raises(InputError, match="tip_force is not an array of numbers"):
        sim.step(lengths, tip_force=[10**400, 0, 0])
    with pytest.raises(InputError, match="tip_force is not an array of numbers"):
        sim.step(lengths, tip_force=np.zeros(3, "datetime64[s]"))
    with pytest.raises(InputError, match="point_force must be"):
        sim.step(lengths, point_force=[(10**400, (0, 0, 1))])
    assert sim.step(lengths, point_force={}).ok.all()


def test_a_refused_step_leaves_the_obstacles_where_they_were() -> None:
    scene = ContactScene(obstacles=[sphere(0.01, name="ball")])
    sim, twin, lengths = pair(contact=scene, feel_contact=False)
    for one in (sim, twin):
        one.settle(lengths)
    moved = {"ball": (0.0, 0.0, -0.02, 1.0, 0.0, 0.0, 0.0)}
    for call in (sim.step, sim.settle):
        with pytest.raises(InputError, match="tip_force has shape"):
            call(lengths, tip_force=np.zeros(5), obstacle_pose=moved)
    for one in (sim, twin):
        one.step(lengths)
    assert_array_equal(sim.clearance("ball"), twin.clearance("ball"))
    assert_array_equal(sim.swept_clearance(), twin.swept_clearance())


def test_rows_of_no_robot() -> None:
    sim, _, lengths = pair()
    sim.settle(lengths)
    bad: list[Any] = [[0.5], [[0, 1]], True, [True, False], "x", 2**63, 10**30, [[0], [1, 2]], {"a": 1}, 3]
    for rows in bad:
        with pytest.raises(InputError, match=r"rows is .*; give indices of robots from 0 to 2, or a mask\."):
            sim.reset(rows)
    sim.reset([])
    assert sim.step(lengths).ok.all()
    for robots in (None, "x", [None]):
        with pytest.raises(RobotError, match=r"robots is .*; give a list of Robot, one for each row\."):
            sim.replace([0], robots)
    with pytest.raises(InputError, match=r"arclength is 1000.*; give numbers"):
        sim.shape(10**400)
    with pytest.raises(InputError, match=r"tolerance is 1000.* m; it must be a number"):
        sim.settle(lengths, tolerance=10**400)


def test_merged_rows_keep_the_order_that_kernels_are_compiled_for() -> None:
    """Another order of axes in memory is another type to numba: a first call would wait for its
    compilation."""
    now, then = np.zeros((1, 2, 3, 4)), np.ones((3, 2, 3, 4))
    merged = merge_rows(now, then, np.array([True, False, False]))
    assert merged.flags.c_contiguous
    assert_array_equal(merged[:, 0, 0, 0], [1.0, 0.0, 0.0])


def test_sentences_about_many_numbers_are_one_line() -> None:
    given: Any = {
        "length": 0.05,
        "bending_stiffness": (0.01, 0.01),
        "torsional_stiffness": 0.01,
        "extension": (-0.001, 0.001),
    }
    wires = (Tendon(offset=0.01, angle=0.0), Tendon(offset=0.01, angle=1.5))
    many = Robot(name="many", segments=tuple(Segment(tendons=wires, **given) for _ in range(30)))
    sim = Simulator(many)
    with pytest.raises(InputError, match="lies outside the range of the segments") as caught:
        sim.step(many.rest_tendon_length, extension=np.full(30, 0.0123456))
    assert "\n" not in str(caught.value)
    actions = SegmentActions(many)
    with pytest.raises(InputError, match="action holds a value that is not finite") as caught:
        actions.inputs(np.full(90, np.nan))
    assert "\n" not in str(caught.value)
    with pytest.raises(InputError, match=r"action is .*; give 90 numbers \[m\]\."):
        actions.inputs([10**400] * 90)


def test_a_part_without_a_recorders_columns_is_no_recording(tmp_path: Path) -> None:
    part = tmp_path / "session.csv.part"
    part.write_text("t,run,tip_x,tip_y,tip_z\n0.0,,0,0,0.07\n")
    with pytest.raises(LogError, match=r"session.csv.part is no recording: it lacks column tip_qw"):
        recover(part)
    assert part.exists()


@pytest.mark.parametrize("kind", ["list", "span", "bytes", "struct"])
def test_a_parquet_column_of_something_else(tmp_path: Path, kind: str) -> None:
    why = "pyarrow is not installed: pip install 'fastrod[parquet]'"
    arrow, parquet = (pytest.importorskip(name, reason=why) for name in ("pyarrow", "pyarrow.parquet"))
    cells = {
        "list": arrow.array([[1.0, 2.0]]),
        "span": arrow.array([5], arrow.duration("s")),
        "bytes": arrow.array([b"\xff"]),
        "struct": arrow.array([{"a": 1}]),
    }[kind]
    names = ("t", "dl_1", "dl_2", "dl_3", "dl_4", "tip_x", "tip_y", "tip_z")
    table = {name: arrow.array([0.0]) for name in names}
    parquet.write_table(arrow.table(table | {"note": cells}), tmp_path / "log.parquet")
    assert len(read_log(tmp_path / "log.parquet", load_robot("prototype")).extra["note"]) == 1
    parquet.write_table(arrow.table(table | {"tip_y": cells}), tmp_path / "log.parquet")
    with pytest.raises(LogError, match=r"log.parquet row 1, column tip_y is .*; it must be a number"):
        read_log(tmp_path / "log.parquet", load_robot("prototype"))


def test_what_is_shown_is_short() -> None:
    assert shown([1, 2]) == "[1, 2]"
    assert len(shown("x" * 10_000)) == 200


@pytest.mark.parametrize(
    ("name", "value"), [("bend", 1e-300), ("rate", 1e9), ("rate", 1e-9), ("speed", 1e-9), ("speed", 1e9)]
)
def test_a_run_of_no_rows_or_of_too_many_is_not_made(name: str, value: float) -> None:
    with pytest.raises(InputError, match=f"{name} is {value!r} .*; it must be between"):
        excitation(load_robot("prototype"), **{name: value})


def test_modes_say_what_they_take() -> None:
    lengths = rod().rest_tendon_length
    with pytest.raises(InputError, match="follower_tip_force was given, but mode paper has dead loads only"):
        Simulator(rod("paper")).step(lengths, follower_tip_force=(0.0, 0.0, 0.1))
    with pytest.raises(InputError, match="tension is missing; segments in mode tendon_tension need tension"):
        Simulator(rod("tendon_tension")).step()
    with pytest.raises(
        RobotError, match="A segment in mode 'paper' needs tendons; give some, or mode 'passive'"
    ):
        rod("paper", 0)
    tip = Simulator(rod(), outputs="tip")
    tip.settle(lengths)
    with pytest.raises(
        InputError, match=r"shape needs Simulator\(..., outputs='full'\); this one keeps the tip only"
    ):
        tip.shape(0.01)


def test_a_snapshot_belongs_to_its_simulator() -> None:
    sim, _, lengths = pair()
    sim.settle(lengths)
    with pytest.raises(InputError, match="another simulator; its robots, tendons or their number differ"):
        Simulator(rod(), 2).restore(sim.snapshot())
    with pytest.raises(InputError, match="another simulator; its effects differ"):
        Simulator(replace(rod(), effects=({"name": "creep", "share": 0.1},)), 3).restore(sim.snapshot())
    with pytest.raises(InputError, match=r"rows has shape \(2,\) for 1 robots; give the index of each"):
        sim.replace([0, 1], [sim.robots[0]])
