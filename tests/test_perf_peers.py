"""The peers of the benchmark: all solve the rod of Appendix J, the better the finer, and one that is missing
is a sentence."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from truthfiles import numbers, rows

import appendix_j
import bench_peers
import peer_elastica
import peer_mujoco
import peer_pybullet
from bench_peers import Ratio, error_ratio, rms, time_ratio
from fastrod.reference import shoot

NAMES = (
    "fastrod, settle",
    "fastrod, step",
    "scipy shooting",
    "scipy solve_bvp",
    "MuJoCo rod (flexcomp)",
    "MuJoCo chain, ball joints",
    "MuJoCo chain, hinges",
    "PyBullet chain, equal links",
    "PyBullet chain, half end links",
    "PyElastica",
)
COMPILED_LONG = ("soromox PCS", "soromox GVS")
RELAXED = ("MuJoCo", "PyBullet", "PyElastica")
SLOWEST = 3  # rungs that are tried here: the finer ones of the slow peers take seconds


def peer(name: str) -> Any:
    (found,) = (one for one in bench_peers.PEERS if one.name == name)
    if sentence := found.missing():
        pytest.skip(sentence)
    return found


def error(rung: Any, force: np.ndarray) -> float:
    with rung.build() as solve:
        return rms(solve(force), appendix_j.tips(force))


def test_the_names_are_all() -> None:
    assert {one.name for one in bench_peers.PEERS} == {*NAMES, *COMPILED_LONG}
    assert all(one.family in bench_peers.COLOURS and one.same and one.also for one in bench_peers.PEERS)


def test_the_elastica_is_the_truth_of_appendix_j() -> None:
    truth = [numbers(row, "Fy_N", "tip_y_m", "tip_z_m") for row in rows("appJ_truth.csv")]
    force, tips = np.array(truth)[:, 0], np.array(truth)[:, 1:]
    assert_allclose(force, appendix_j.FORCES, atol=1e-12)
    assert_allclose(appendix_j.tips(force), tips, rtol=0, atol=1e-12)


def test_the_elastica_is_the_slow_twin() -> None:
    shape = shoot(appendix_j.robot(), tip_force=(0.0, 0.7, 0.0))
    assert shape.success
    assert_allclose(appendix_j.tips(np.array([0.7]))[0], shape.tip_position[1:], rtol=0, atol=1e-8)


@pytest.mark.parametrize("name", NAMES)
def test_a_finer_setting_is_nearer_to_the_truth(name: str) -> None:
    force = np.array([0.1, 0.35, 0.7])
    found = [error(rung, force) for rung in peer(name).rungs[:SLOWEST]]
    assert np.all(np.diff(found) < 0.0), found
    assert found[-1] < 0.01


@pytest.mark.parametrize("name", COMPILED_LONG)
def test_the_coarsest_setting_that_takes_long_to_compile(name: str) -> None:
    """One arc under a small load: EI l u = F l^2/2, so the tip goes u l^2/2 = F l^3/4EI, 3/4 of the rod's F
    l^3/3EI."""
    force = np.array([0.01])
    with peer(name).rungs[0].build() as solve:
        across = solve(force)[0, 0]
    assert across / appendix_j.tips(force)[0, 0] == pytest.approx(0.75, rel=1e-3)


@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith(RELAXED)])
def test_what_is_relaxed_is_at_rest(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With half as much patience again the tip moves by less than a fifth of what it is off."""
    force, truth = np.array([0.3, 0.6]), appendix_j.tips(np.array([0.3, 0.6]))
    rung = peer(name).rungs[1]
    with rung.build() as solve:
        tips = solve(force)
    if name.startswith("MuJoCo"):
        kind, setting = rung.build.args
        longer = peer_mujoco._one_by_one(kind, replace(setting, steps=2 * setting.steps))
    elif name.startswith("PyBullet"):
        links, half_ends = rung.build.args
        longer = peer_pybullet._chain(links, half_ends, patience=1.5)
    else:
        setting, patience = rung.build.args
        longer = peer_elastica._relax(setting, 1.5 * patience)
    with longer as solve:
        moved = np.linalg.norm(solve(force) - tips, axis=1)
    assert np.all(moved < 0.2 * np.linalg.norm(tips - truth, axis=1))


def order(name: str) -> float:
    """Slope of log error over log links, 4 to 16 links."""
    force, links = np.array([0.2, 0.5]), [4, 8, 16]
    found = [error(rung, force) for rung in peer(name).rungs if int(rung.label.split()[0]) in links]
    return -float(np.polyfit(np.log(links), np.log(found), 1)[0])


def test_half_end_links_converge_at_second_order_and_equal_links_at_first() -> None:
    assert order("PyBullet chain, equal links") == pytest.approx(1.0, abs=0.15)
    assert order("PyBullet chain, half end links") == pytest.approx(2.0, abs=0.15)
    assert order("MuJoCo chain, hinges") == pytest.approx(2.0, abs=0.1)


@pytest.mark.parametrize(
    "name", ["fastrod, settle", "MuJoCo rod (flexcomp)", "MuJoCo chain, ball joints", "MuJoCo chain, hinges"]
)
def test_all_in_one_call_is_one_after_the_other(name: str) -> None:
    force = np.array([0.65, 0.05, 0.3])
    rung = peer(name).rungs[1]
    with rung.build() as one_by_one, rung.together() as together:
        assert_allclose(together(force), one_by_one(force), rtol=0, atol=1e-9)
        # nothing is left of the call before
        assert_allclose(together(force[:2]), one_by_one(force[:2]), rtol=0, atol=1e-9)


def test_ratios_are_read_between_the_measured_settings_and_never_beyond() -> None:
    own = [(1e-3, 1e-4), (2e-3, 1e-6), (4e-3, 1e-8)]
    assert time_ratio(1e-5, 1.0, own).value == pytest.approx(1.0 / math.sqrt(2e-6))
    assert time_ratio(1e-3, 1.0, own) == Ratio(1e3, least=True)
    assert math.isnan(time_ratio(1e-9, 1.0, own).value)
    assert error_ratio(1e-3, 1e-2, own) == Ratio(1e5, least=True)
    assert error_ratio(1e-3, 2e-3, own).value == pytest.approx(1e3)
    assert math.isnan(error_ratio(1e-3, 5e-4, own).value)
    assert [str(Ratio(math.nan)), str(Ratio(1234.5, least=True)), str(Ratio(0.51))] == [
        "-",
        ">= 1,234",
        "0.51",
    ]


def test_only_points_that_none_beats_are_on_the_front() -> None:
    made = [
        bench_peers.Point(None, None, error, time, 0.0)
        for error, time in ((1e-3, 1.0), (1e-4, 3.0), (1e-2, 2.0), (1e-5, 2.5))
    ]
    assert bench_peers.front(made) == [(1.0, 1e-3), (2.5, 1e-5)]


@pytest.mark.study
def test_the_bench_runs_and_what_is_missing_is_a_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    absent = replace(peer("fastrod, step"), name="Unheard", modules=("unheard_of",))
    monkeypatch.setattr(bench_peers, "PEERS", [peer("fastrod, settle"), peer("scipy solve_bvp"), absent])
    file = tmp_path / "peers.png"
    assert bench_peers.main(["--quick", "--json", "--plot", str(file)]) == 0
    sections = json.loads(capsys.readouterr().out)["sections"]
    assert (
        "Unheard is left out: unheard_of is not installed (pip install -e '.[peers]')."
        in sections["peers"]["notes"]
    )
    names = {"fastrod, settle", "fastrod, settle" + bench_peers.IN_ONE_CALL, "scipy solve_bvp"}
    assert {row["peer"] for row in sections["peers"]["rows"]} == names
    (summary,) = sections["peers_summary"]["rows"]
    assert summary["peer"] == "scipy solve_bvp"
    coarse = sections["peers_batch_1e-04"]["rows"]
    assert [row["peer"] for row in coarse] == ["fastrod, settle", "scipy solve_bvp"]
    assert coarse[0]["how"] == "one call"
    assert all(row["error_m"] < 1e-4 and row["measured"] == 64 for row in coarse)
    fine = sections["peers_batch_1e-06"]  # the two settings of a quick run are not that good
    assert fine["rows"] == []
    assert fine["notes"][1].startswith("Not that accurate at any measured setting: fastrod, settle (")
    assert file.read_bytes()[:4] == b"\x89PNG"
