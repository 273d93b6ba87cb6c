"""A robot as a chain of MuJoCo: as many controls as tendons, and at rest where the rod is."""

from pathlib import Path

import pytest
from rods import behind_a_passive_one

import fastrod
from fastrod.commands.cli import main
from fastrod.errors import InputError
from fastrod.hosts.mjcf import mjcf, static_error

mujoco = pytest.importorskip("mujoco")


def test_the_chain_has_the_robots_joints_tendons_and_length() -> None:
    robot = fastrod.load_robot("tdcr_a")
    model = mujoco.MjModel.from_xml_string(mjcf(robot, pieces=8, comment="a -- b"))
    assert model.nu == model.ntendon == robot.n_tendons
    assert model.nv == 3 * 8 * robot.n_segments
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert data.site_xpos[model.site("tip").id][2] == pytest.approx(robot.length)
    assert data.actuator_length == pytest.approx(robot.rest_tendon_length, abs=1e-9)


@pytest.mark.study
@pytest.mark.parametrize("name", ["prototype", "tdcr_a", "tdcr_b", "catheter"])
def test_at_rest_the_tip_is_where_the_rod_has_it(name: str) -> None:
    robot = fastrod.load_robot("prototype" if name == "catheter" else name)
    assert static_error(behind_a_passive_one(robot) if name == "catheter" else robot, count=4) < 4e-3


def test_a_robot_without_tendons_and_a_wrong_file_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="robot 'ethz_beam' is not driven by tendon lengths"):
        mjcf(fastrod.load_robot("ethz_beam"))
    assert main(["export", "prototype", "--mjcf", "a.toml"]) == 2
    assert "does not end in .xml" in capsys.readouterr().err
    assert main(["export", "prototype", "--mjcf", "a.xml", "--pieces", "0"]) == 2
    assert "--pieces is 0; it must be a whole number from 4 to 200." in capsys.readouterr().err


@pytest.mark.study
def test_the_file_says_how_far_it_is_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "a.xml"
    assert main(["export", "prototype", "--mjcf", str(file), "--pieces", "8"]) == 0
    said = capsys.readouterr().out
    assert "at rest the tip is within" in said
    assert said.partition("; ")[2].strip() in file.read_text()
    assert mujoco.MjModel.from_xml_path(str(file)).nu == 4
