"""What is built is what was meant: one wheel with five import names, and an sdist that builds the same."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAMES = ("fastrod", "fastrod_scenes", "fastrod_envs", "fastrod_viewer", "fastrod_device")
SMOKE = f"""
import {", ".join(NAMES)}
robot = fastrod.load_robot("prototype")
assert fastrod.robot_names() == ["ethz_beam", "five_segment_reacher", "prototype", "tdcr_a", "tdcr_b"]
print(fastrod.__file__)
"""


def built(target: Path, source: Path) -> list[Path]:
    subprocess.run([sys.executable, "-m", "hatchling", "build", "-d", str(target)], cwd=source, check=True, capture_output=True)
    return sorted(target.iterdir())


@pytest.fixture(scope="module")
def artifacts(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    pytest.importorskip("hatchling")
    return built(tmp_path_factory.mktemp("dist"), ROOT)


def smoke(wheel: Path, folder: Path) -> str:
    """Where fastrod was imported from, in a process that knows the unpacked wheel alone."""
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "site")
    empty = folder / "empty"
    empty.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(folder / "site")}
    done = subprocess.run([sys.executable, "-c", SMOKE], cwd=empty, env=environment, capture_output=True, text=True, check=True)
    return done.stdout


def test_wheel(artifacts: list[Path], tmp_path: Path) -> None:
    (wheel,) = (a for a in artifacts if a.suffix == ".whl")
    assert str(tmp_path / "site") in smoke(wheel, tmp_path)
    with zipfile.ZipFile(wheel) as archive:
        policies = [name for name in archive.namelist() if name.endswith("/actor.npz")]
    assert len(policies) == 10


def test_sdist_builds_the_same(artifacts: list[Path], tmp_path: Path) -> None:
    (sdist,) = (a for a in artifacts if a.name.endswith(".tar.gz"))
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    (wheel,) = (a for a in built(tmp_path / "dist", source) if a.suffix == ".whl")
    assert str(tmp_path / "site") in smoke(wheel, tmp_path)
