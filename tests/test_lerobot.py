"""Run logs as data sets of LeRobot."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod.commands.cli import main
from fastrod.errors import LogError
from fastrod.logs.lerobot import write_lerobot

parquet = pytest.importorskip(
    "pyarrow.parquet", reason="pyarrow is not installed: pip install 'fastrod[parquet]'"
)
LOG = str(files("fastrod") / "data" / "demo_log.csv")


def test_log_is_an_episode_at_an_even_rate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = fastrod.read_log(LOG, "prototype")
    out = tmp_path / "set"
    assert main(["import", LOG, "--robot", "prototype", "--lerobot", str(out), "--fps", "10"]) == 0
    info = json.loads((out / "meta/info.json").read_text())
    n = info["total_frames"]
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v2.1", 10, len(log.runs))
    assert f"{n} frames" in capsys.readouterr().out
    table = parquet.read_table(out / "data/chunk-000/episode_000000.parquet").to_pydict()
    assert {*table} == {*info["features"]}
    assert_allclose(np.diff(table["timestamp"]), 0.1, atol=1e-4)
    assert_array_equal(table["index"], np.arange(len(table["index"])))
    state, action = (np.array(table[name]) for name in ("observation.state", "action"))
    assert state.shape[1] == len(info["features"]["observation.state"]["names"])
    rows = np.flatnonzero(log.measured & (log.run == log.runs[0]))
    assert_allclose(state[0, :3], log.tip_position[rows[0]], atol=1e-7)
    assert_allclose(action[0], log.dl[rows[0]], atol=1e-9)
    stats = json.loads((out / "meta/episodes_stats.jsonl").read_text().splitlines()[0])["stats"]
    assert_allclose(stats["action"]["max"], action.max(axis=0), atol=1e-7)


def test_folder_that_holds_something_is_refused(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("")
    log = fastrod.read_log(LOG, "prototype")
    with pytest.raises(LogError, match="holds something already"):
        write_lerobot(log, tmp_path, robot="prototype", fps=30, task="move")
    with pytest.raises(LogError, match="fps is 0"):
        write_lerobot(log, tmp_path / "new", robot="prototype", fps=0, task="move")
