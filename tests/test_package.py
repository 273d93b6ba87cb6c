"""The built packages: one wheel, an sdist that builds the same, extras that stand alone."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
SMOKE = """
import fastrod, fastrod_scenes, fastrod_viewer, fastrod_device
assert fastrod.robot_names() == ["ethz_beam", "five_segment_reacher", "prototype", "tdcr_a", "tdcr_b"]
assert fastrod.load_robot("prototype").n_tendons == 4
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import write_log
from importlib.resources import files
log = read_log(files("fastrod") / "data" / "demo_log.csv", fastrod.load_robot("prototype"))
"""
"""Smoke test of every installation."""
ALSO = {
    "": "import numba, scipy, fcl, trimesh, rich, matplotlib",
    "parquet": "write_log(log, 'log.parquet'); assert len(read_log('log.parquet', "
    "fastrod.load_robot('prototype'))) == len(log)",
    "envs": "import gymnasium, fastrod_envs; assert gymnasium.spec('fastrod/Reach-v0').vector_entry_point",
    "rl": "import torch, stable_baselines3; from fastrod_envs.learning.policies import Policy, find; assert "
    "Policy(find('Reach', 'shipped'))",
    "viewer": "from fastrod_viewer.server import serve; server = serve(port=0); server.stop()",
    "device": "import can, canopen, cv2; from fastrod_device.hardware import load_hardware; assert "
    "load_hardware().robot.n_tendons == 4",
    "hosts": "from fastrod.hosts import connect; world = connect(dt=0.01); world.stepSimulation()",
    "mujoco": "import mujoco; from fastrod.hosts import MujocoRod, add_capsules",
    "ray": "import ray, pyarrow; from fastrod.generation.plan import Plan",
    "ros": "import rosbags; from fastrod.logs.bag import read_bag",
    "cuda": "from fastrod.solver.gpu import device",
    "network": "from fastrod.identification.learned import network; import sklearn",
}
"""Purpose of each extra, in one line."""


def built(target: Path, source: Path) -> list[Path]:
    words = [sys.executable, "-m", "hatchling", "build", "-d", str(target)]
    subprocess.run(words, cwd=source, check=True, capture_output=True)
    return sorted(target.iterdir())


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    pytest.importorskip("hatchling", reason="hatchling is not installed: pip install 'fastrod[test]'")
    return built(tmp_path_factory.mktemp("dist"), ROOT)


@pytest.fixture(scope="module")
def wheel(artifacts: list[Path]) -> Path:
    (path,) = (a for a in artifacts if a.suffix == ".whl")
    return path


def contents(wheel: Path) -> list[str]:
    with zipfile.ZipFile(wheel) as archive:
        return sorted(archive.namelist())


@pytest.mark.study
def test_the_wheel_has_five_packages_and_the_trained_policies(wheel: Path) -> None:
    names = contents(wheel)
    packages = {name.split("/")[0] for name in names if not name.startswith("fastrod-")}
    assert packages == {"fastrod", "fastrod_scenes", "fastrod_envs", "fastrod_viewer", "fastrod_device"}
    assert len([name for name in names if name.endswith("/actor.npz")]) == 10


@pytest.mark.study
def test_the_sdist_builds_the_same(artifacts: list[Path], wheel: Path, tmp_path: Path) -> None:
    (sdist,) = (a for a in artifacts if a.name.endswith(".tar.gz"))
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    (again,) = (a for a in built(tmp_path / "dist", source) if a.suffix == ".whl")
    assert contents(again) == contents(wheel)


def test_every_extra_of_a_user_is_tried() -> None:
    assert {*ALSO} == {"", *EXTRAS} - {"all", "docs", "peers", "test"}


@pytest.mark.study
@pytest.mark.parametrize("extra", ALSO)
def test_it_works_in_an_empty_environment_with_one_extra(extra: str, wheel: Path, tmp_path: Path) -> None:
    uv = shutil.which("uv", path=f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}")
    if uv is None:
        pytest.skip("uv is not installed; pip install uv")
    # uv reads neither pip's settings nor its environment
    places = {"UV_FIND_LINKS": os.environ["PIP_FIND_LINKS"]} if "PIP_FIND_LINKS" in os.environ else {}
    given = {"env": {**os.environ, **places}, "capture_output": True, "text": True}
    for name in ("PYTHONPATH", "VIRTUAL_ENV"):
        given["env"].pop(name, None)
    python = tmp_path / "venv" / "bin" / "python"
    wanted = f"{wheel}[{extra}]" if extra else str(wheel)
    for command in (
        [uv, "venv", "-q", "--python", sys.executable, str(tmp_path / "venv")],
        [uv, "pip", "install", "-q", "--python", str(python), wanted],
    ):
        done = subprocess.run(command, **given)
        assert done.returncode == 0, done.stderr
    (tmp_path / "empty").mkdir()
    done = subprocess.run([python, "-c", SMOKE + ALSO[extra]], cwd=tmp_path / "empty", **given)
    assert done.returncode == 0, done.stderr
    version = subprocess.run([python.parent / "fastrod", "--version"], check=True, **given).stdout
    assert version.strip().endswith(wheel.name.split("-")[1])
