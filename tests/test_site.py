"""The documentation site: built offline, without a warning, with every name on it."""

from __future__ import annotations

import argparse
import html
import importlib
import re
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import pytest

from fastrod.commands.cli import build
from fastrod.effects.base import effect_names
from fastrod.errors import FastrodError, Problem
from fastrod.identification.log.unknowns import MATERIAL, SEGMENT_UNITS, TENDON_UNITS
from fastrod.model.logformat import COLUMNS, LogFormat
from fastrod.model.robot import Lump, Segment, Tendon
from fastrod.model.robotfile import SENSOR

ROOT = Path(__file__).parent.parent
PUBLIC = ("fastrod", "fastrod.contact", "fastrod.hosts", "fastrod.control", "fastrod.generation")
PUBLIC += ("fastrod.reference", "fastrod_scenes", "fastrod_envs")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "-d", str(out)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr  # a warning is an error
    return out


def words(site: Path, page: str) -> str:
    return html.unescape(re.sub(r"<[^>]+>", " ", (site / page / "index.html").read_text("utf-8")))


@pytest.mark.study
def test_site_has_every_name(site: Path) -> None:
    names: dict[str, list[str]] = {
        "robot-file": [f.name for kind in (Segment, Tendon, Lump, LogFormat) for f in fields(kind)],
        "run-log": list(COLUMNS),
        "effects": [name.replace("_", " ") for name in effect_names()],
        "errors": [*(kind.__name__ for kind in FastrodError.__subclasses__()), *(p.name for p in Problem)],
    }
    names["errors"] += ["SceneError", "DeviceError", "CalibrationError"]
    names["robot-file"] += [*SENSOR, *(f"segment.*.{k}" for k in SEGMENT_UNITS)]
    names["robot-file"] += [f"tendon.*.{k}" for k in TENDON_UNITS] + [f"material.{k}" for k in MATERIAL]
    (group,) = [a for a in build()._actions if isinstance(a, argparse._SubParsersAction)]
    names["commands"] = [f"fastrod {name}" for name in group.choices]
    names["commands"] += [
        option
        for command in group.choices.values()
        for a in command._actions
        for option in a.option_strings[:1]
    ]
    names["commands"] = [name for name in names["commands"] if name != "-h"]
    names["environments"] = importlib.import_module("fastrod_envs").names()
    names["scenes"] = importlib.import_module("fastrod_scenes").names()
    names["api"] = [name for package in PUBLIC for name in importlib.import_module(package).__all__]
    missing = {
        page: lacking
        for page, wanted in names.items()
        if (lacking := [name for name in wanted if name not in words(site, page)])
    }
    assert missing == {}
    assert all((site / "effects" / name / "index.html").is_file() for name in effect_names())
