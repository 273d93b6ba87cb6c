"""Adapters of the measured sets: units, frames, order, on a few rows in the published form; and on the sets
where they are there."""

import math
import os
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import load_robot
from fastrod.commands.cli import main
from fastrod.errors import LogError, UnknownNameError
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.check import check
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import write_log
from fastrod.logs.table import read_table
from fastrod.model.robotfile import dumps, loads
from fastrod.model.routing import route
from fastrod_scenes import measured
from fastrod_scenes.measured import armlab_tdcr, asl_trunk, detect, ethz_beam, opencr_ftv4

DATA = Path(os.environ.get("FASTROD_DATA", Path(__file__).parents[3] / "shared" / "data"))
needs_data = pytest.mark.skipif(
    not (DATA / "asl_trunk.csv").is_file(), reason="no measured sets here; FASTROD_DATA names their folder"
)

MARKERS = [f"{k}{axis}" for k in (1, 2, 3) for axis in "xyz"]
ANGLES = [f"{name}{k}_deg" for name in ("u", "phi") for k in range(1, 7)]
ASL_HEADER = ",".join(["run,payload_g,row,t_s", *ANGLES, *(f"{m[1]}{m[0]}_mm" for m in MARKERS)])
ETHZ_HEADER = ",".join(
    ["run,tip_load_N,t_s", *(f"{end}{m[0]}_{m[1]}_mm" for end in ("tip", "base") for m in MARKERS)]
)
ARMLAB = """row,l1_mm,l2_mm,l3_mm,x_mm,y_mm,z_mm,glitch,after_jump
0,0,0,0.1,-43,-144,276,0,0
1,0,0.1,0,-43,-144,278,0,0
7,0,8,0,-36,-114,334,0,0
8,0,8.1,0,500,500,500,1,0
"""


def armlab_file(tmp_path: Path, text: str = ARMLAB) -> Path:
    path = tmp_path / "tdcr.csv"
    path.write_text(text)
    return path


def asl_file(tmp_path: Path) -> Path:
    rest = "100,-106,105,100,-202,105,100,-320,105"
    pulled = "100,-106,105,100,-202,105,130,-310,145"
    rows = [
        f"first,100,0,0,{','.join('0' * 6)},{','.join('0' * 6)},{rest}",
        f"first,100,1,0.04,1,2,3,4,5,6,10,20,30,40,50,60,{pulled}",
    ]
    path = tmp_path / "trunk.csv"
    path.write_text("\n".join([ASL_HEADER, *rows, rows[0].replace("first", "second")]))
    return path


def test_asl_trunk_units_frame_and_order(tmp_path: Path) -> None:
    log, robot = asl_trunk(asl_file(tmp_path))
    assert log.runs == ["first", "second"]
    assert_allclose(log.tip_position[:2], [[0.0, 0.0, 0.320], [0.030, 0.040, 0.310]], atol=1e-12)
    assert log.points is not None
    assert_allclose(log.points[0], [[0.0, 0.0, 0.106], [0.0, 0.0, 0.202]], atol=1e-12)
    # commanded; motors 3 5 | 1 6 | 2 4
    assert_allclose(np.degrees(-log.dl[1, ::2] / measured.ASL_SPOOL_RADIUS), [3, 5, 1, 6, 2, 4])
    assert_array_equal(log.dl[:, 1::2], -log.dl[:, ::2])  # the antagonist is paid out
    assert log.pos is not None
    order = [motor for pair in measured.ASL_MOTORS for motor in pair]
    felt = np.radians([10.0 * motor for motor in order])  # measured, the antagonist the other way
    assert_allclose(log.pos[1, ::2], -measured.ASL_SPOOL_RADIUS * felt)
    assert_allclose(log.pos[1, 1::2], measured.ASL_SPOOL_RADIUS * felt)
    assert log.payload is not None
    assert_allclose(log.payload, 0.1)
    assert robot.length == pytest.approx(0.320)
    assert_allclose(robot.rest_tendon_length, np.repeat([0.106, 0.202, 0.320], 4))
    assert all(tendon.unilateral and tendon.pretension > 0.0 for tendon in robot.tendons)
    every = np.array([tendon.position(1)[0] for tendon in robot.tendons]) / measured.ASL_PITCH_RADIUS
    assert_allclose(every[1::2], -every[::2], atol=1e-12)
    assert_array_equal(route(robot).drive, np.repeat(np.arange(6), 2))  # both are one motor's
    places = every[::2]
    assert_allclose(places[4], [math.cos(math.radians(-105.0)), math.sin(math.radians(-105.0))])
    # the two tendons of a segment pull at right angles, so that they set its whole bend
    assert_allclose(np.sum(places[::2] * places[1::2], axis=1), 0.0, atol=1e-12)
    assert_allclose(asl_trunk(asl_file(tmp_path), run="second")[0].t, [0.0])


def test_ethz_beam_starts_straight_and_drops_along_gravity(tmp_path: Path) -> None:
    def row(t: float, drop: float) -> str:
        markers = [f"{60 - drop + 10 * k},30,{75 + 3 * k}" for k in (-1, 0, 1)]
        return f"load,0.5,{t}," + ",".join(markers) + ",0" * 9

    path = tmp_path / "beam.csv"
    path.write_text("\n".join([ETHZ_HEADER, row(0.0, 0.0), row(3.0, 20.0), row(5.5, 16.0), row(6.0, 16.0)]))
    log, robot = ethz_beam(path)
    assert_array_equal(log.measured, [False, False, True, True])
    assert_allclose(log.tip_position[2], [-0.016, 0.0, 0.1], atol=1e-12)
    assert log.tip_force is not None
    assert_allclose(log.tip_force[0], [-0.5, 0.0, 0.0])
    assert np.dot(log.tip_force[0], robot.gravity) > 0.0  # the load hangs down
    assert log.dl.shape == (4, 0)
    whole, _ = ethz_beam(path, settled=None)
    assert_allclose(whole.tip_position[0], [0.0, 0.0, 0.1], atol=1e-12)
    assert whole.measured.all()


def test_armlab_tdcr_rest_tip_is_straight_and_glitches_are_missing(tmp_path: Path) -> None:
    log, robot = armlab_tdcr(armlab_file(tmp_path))
    straight = (0.0, 0.0, measured.ARMLAB_LENGTH)
    assert_allclose(log.tip_position[:2].mean(axis=0), straight, atol=1e-12)
    assert_allclose(log.tip_position[2] - straight, [0.007, 0.057, -0.030], atol=1e-12)
    assert_array_equal(log.measured, [True, True, True, False])
    assert_allclose(log.dl[2], [0.0, -0.008, 0.0])
    # 2.5 mm each: 8 mm of tendon 2 is in the fourth
    assert log.run.tolist() == ["cell_000", "cell_000", "cell_030", "cell_030"]
    # the tip goes toward the tendon that is pulled, tendon 2 at 85 deg
    assert np.dot(log.tip_position[2, :2], robot.tendons[1].position(1)[0]) > 0.0


def test_a_pull_at_the_edge_of_the_cube_is_in_the_last_cell(tmp_path: Path) -> None:
    log, _ = armlab_tdcr(armlab_file(tmp_path, ARMLAB.replace("8,0,8.1,0", "8,2.5,25,30")))
    assert log.run[-1] == "cell_199"


def test_robots_say_what_is_not_known_of_them(tmp_path: Path) -> None:
    """Identification may move the numbers that nobody publishes, and the frame, but not what is published."""
    (_, trunk), (_, tdcr) = asl_trunk(asl_file(tmp_path)), armlab_tdcr(armlab_file(tmp_path))
    free = {robot.name: [u.name for u in base_model(robot).unknowns] for robot in (trunk, tdcr)}
    tendons = {f"tendon.{k}.{what}" for k in range(1, 13, 2) for what in ("gain", "zero")}
    slack = {f"tendon.{k}.{what}" for k in range(1, 13) for what in ("compliance", "pretension")}
    assert set(free["asl_trunk"]) >= tendons | slack | {"segment.3.length", "segment.3.axial_stiffness"}
    assert {"segment.1.length", "tendon.*.offset"} <= set(free["armlab_tdcr"])
    for robot in (trunk, tdcr):
        assert robot.sensor["registration_sd"] == (0.01, 0.05)
        assert any(name.startswith("frame_misalignment.") for name in free[robot.name])
    assert [tendon.compliance for tendon in tdcr.tendons] == [1e-4] * 3


def test_base_frames_hang_right_handed(tmp_path: Path) -> None:
    for _, robot in (asl_trunk(asl_file(tmp_path)), armlab_tdcr(armlab_file(tmp_path))):
        w, x, y, z = robot.base_quaternion
        # d3 of the base in the world
        down = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        assert np.dot(down, robot.gravity) == pytest.approx(9.81)
        assert loads(dumps(robot)) == robot  # an identified robot can be written down


def test_detect_knows_the_raw_files_by_their_header(tmp_path: Path) -> None:
    (tmp_path / "beam.csv").write_text(ETHZ_HEADER)
    (tmp_path / "log.csv").write_text("t,dl_1,tip_x,tip_y,tip_z\n")
    assert detect(asl_file(tmp_path)) is asl_trunk
    assert detect(armlab_file(tmp_path)) is armlab_tdcr
    assert detect(tmp_path / "beam.csv") is ethz_beam
    assert detect(tmp_path / "log.csv") is None
    assert detect(tmp_path / "absent.csv") is None


def test_wrong_file_and_wrong_run_answer_with_one_sentence(tmp_path: Path) -> None:
    path = asl_file(tmp_path)
    sentence = r"trunk\.csv is not the raw file of armlab_tdcr: it lacks column l1_mm"
    with pytest.raises(LogError, match=sentence):
        armlab_tdcr(path)
    with pytest.raises(UnknownNameError, match="no run 'frist' in log 'trunk'; did you mean 'first'"):
        asl_trunk(path, run="frist")
    path.write_text(path.read_text().replace("60,100", "60,1oo"))
    with pytest.raises(LogError, match=r"trunk\.csv row 2, column x1_mm is '1oo'; it must be a number"):
        asl_trunk(path)


@pytest.mark.study
@needs_data
@pytest.mark.parametrize("name", ["asl_trunk", "ethz_beam", "armlab_tdcr", "opencr_ftv4_train"])
def test_measured_set_is_a_valid_run_log(name: str, tmp_path: Path) -> None:
    adapter = detect(DATA / f"{name}.csv")
    assert adapter is not None
    log, robot = adapter(DATA / f"{name}.csv")
    write_log(log, tmp_path / "log.csv")
    back = read_log(tmp_path / "log.csv", robot)
    assert_array_equal(back.tip_position, log.tip_position)
    assert_array_equal(back.measured, log.measured)


@needs_data
def test_ethz_beam_drops_as_published() -> None:
    log, _ = ethz_beam(DATA / "ethz_beam.csv")
    for run, drop in {"gravity_a": 6.5, "gravity_b": 6.5, "load52_a": 16.95, "load52_b": 16.95}.items():
        rows = log.measured & (log.run == run)
        assert -1e3 * log.tip_position[rows, 0].mean() == pytest.approx(drop, abs=0.1)


@needs_data
def test_nominal_replay_of_the_beam_is_an_unshearable_rod() -> None:
    from fastrod.identification.log.replay import replay

    log, robot = ethz_beam(DATA / "ethz_beam.csv")
    result = replay(log, robot)
    assert result.converged.all()
    drop = {run: -1e3 * float(result.tip_position[log.run == run, 0].mean()) for run in log.runs}
    # published for an unshearable rod: 6.6 and 15.8 mm
    assert drop["gravity_a"] == pytest.approx(6.6, abs=0.1)
    assert drop["load52_a"] == pytest.approx(15.8, abs=0.1)


@needs_data
def test_motors_of_the_trunk_follow_their_commands_late() -> None:
    """Why it matters whether `dl` is commanded or measured: on the wandering run they are 11.5 deg apart
    (rms, to 80 deg of motion)."""
    log, _ = asl_trunk(DATA / "asl_trunk.csv", run="perlin_0g")
    reported, felt = (
        np.degrees(-each[:, ::2] / measured.ASL_SPOOL_RADIUS) for each in (log.dl, np.asarray(log.pos))
    )
    assert np.sqrt(np.mean((felt - reported) ** 2)) == pytest.approx(11.5, abs=0.1)
    late = [np.sqrt(np.mean((felt[k:] - reported[: len(reported) - k]) ** 2)) for k in range(12)]
    assert int(np.argmin(late)) > 0


@needs_data
def test_a_servo_of_the_opencr_robot_pulls_the_tip_to_its_tendons_side() -> None:
    """The first patterns pull one servo at a time: its tendon is the one that the adapter says it is."""
    path = DATA / "opencr_ftv4_train.csv"
    (log, robot), patterns = opencr_ftv4(path), np.array(read_table(path)["pattern_label"])
    for k, servo in enumerate(measured.OPENCR_SERVOS):
        rows = np.flatnonzero(patterns == f"rep1_tendon{k}_id{servo}_pull")
        x, y, _ = log.tip_position[rows[np.argmin(log.dl[rows, k])]]
        turned = math.remainder(math.atan2(y, x) - float(robot.tendons[k].angle), 2.0 * math.pi)
        assert abs(turned) < math.radians(20.0)


@needs_data
@pytest.mark.study
def test_cells_of_the_tdcr_cover_its_cube_of_shortenings() -> None:
    log, _ = armlab_tdcr(DATA / "armlab_tdcr.csv")
    assert len(log.runs) == 52
    for cell in ("cell_000", "cell_304"):
        rows = log.run == cell
        low = measured.ARMLAB_CELL * np.array([int(digit) for digit in cell.removeprefix("cell_")])
        pull = -log.dl[rows]
        assert (pull >= low - 1e-12).all()
        assert (pull < low + measured.ARMLAB_CELL + 1e-12).all()


@needs_data
@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("name", ["opencr_ftv4_train", "asl_trunk", "armlab_tdcr", "ethz_beam"])
def test_a_first_look_at_a_measured_set_refuses_nothing(name: str) -> None:
    log, robot = measured.read(DATA / f"{name}.csv", None)
    found = check(log, robot)
    assert found.refusal == ""
    assert found.columns is None


@needs_data
@pytest.mark.study
def test_order_signs_and_angles_of_nine_servos_are_found_from_the_authors_file(tmp_path: Path) -> None:
    """A file that knows nothing of the servos: each segment's tendons at any angle, positive pulls."""
    raw = DATA / "opencr_ftv4_train.csv"
    words = "--segments 3 --tendons 3 --length 60,62.5,64 --offset 4.5 --drive pull"
    assert main(["new", str(tmp_path / "a.toml"), "--log", str(raw), *words.split()]) == 0
    assert (
        main(["check", str(raw), "--robot", str(tmp_path / "a.toml"), "--out", str(tmp_path / "b.toml")]) == 0
    )
    found = load_robot(tmp_path / "b.toml")
    _, built = opencr_ftv4(raw)
    servos = [int(re.findall(r"\d", found.log.sources[f"dl_{k}"])[0]) for k in range(1, 10)]
    assert found.log.sign == -1
    off = []
    for k, (servo, tendon) in enumerate(zip(servos, found.tendons, strict=True)):
        true = measured.OPENCR_SERVOS.index(servo)
        assert true // 3 == k // 3
        off.append(
            math.remainder(float(np.mean(tendon.angle)) - float(np.mean(built.tendons[true].angle)), math.tau)
        )
    # the camera's own angle apart; those of the set are rounded to 30 deg
    assert np.ptp(off) < math.radians(15.0)
    assert abs(np.mean(off)) < math.radians(15.0)
