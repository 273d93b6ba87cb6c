"""The benchmark's own instruments: its peers solve the same rod, its count of operations is exact, its rows become JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fastrod.reference import shoot


@pytest.fixture(autouse=True)
def _perf_on_path(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "perf"))


@pytest.mark.parametrize("tension", [0.0, 2.0])
def test_the_peers_slopes_agree(tension: float) -> None:
    from peers import N_STATE, array_slope, compiled_slope, rod_slope

    rng = np.random.default_rng(4)
    y, load = rng.normal(size=N_STATE), rng.normal(size=6)
    rod = np.array([0.07, 0.0022, 0.0025, 0.001])
    tendons = np.column_stack([0.01 * rng.normal(size=(4, 2)), tension * rng.random(4)])
    expected = array_slope(0.03, y, load, rod, tendons)
    as_tuples = tuple(map(tuple, tendons.tolist()))
    for slope in (rod_slope, compiled_slope()):
        got = slope(0.03, y, tuple(load.tolist()), tuple(rod.tolist()), as_tuples, np.empty(N_STATE))
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-9)


@pytest.mark.parametrize("paper", [True, False])
def test_the_peer_solves_the_same_rod(paper: bool) -> None:
    from cases import LINE, appendix_b_robot, arc_lengths
    from peers import Peer

    robot = appendix_b_robot(paper)
    length, force = arc_lengths(robot, np.array([[[0.4, -0.5]]]))[0], (0.1, -0.2, 0.15)
    peer = Peer(robot, "scalars", integrator="DOP853", rtol=1e-9, atol=1e-11)
    tip, residual = peer.solve(length, (*force, *LINE))
    expected = shoot(robot, length, tip_force=force, line_force=LINE)
    assert expected.success
    assert residual < 1e-9
    np.testing.assert_allclose(tip, expected.tip_position, atol=1e-8)


def test_the_count_of_operations_is_linear_in_the_steps() -> None:
    import flops

    (at_five,) = flops.counted(["paper", "prototype"], True, [5])
    assert flops.count({"paper": 5, "prototype": 5}, True) == at_five
    assert all(sum(parts.values(), flops.Tally()).flops > 1e4 for parts in at_five.values())


def test_rows_become_json_and_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    from report import Column, Section, show

    section = Section("key", "Title", [Column("a", "a [m]"), Column("b", "b", ".1f"), Column("c", "c")], [{"a": "x", "b": 1.25, "c": True}])
    assert json.loads(json.dumps(section.as_json()))["rows"] == [{"a": "x", "b": 1.25, "c": True}]
    show([section], "head")
    out = capsys.readouterr().out
    assert "a [m]" in out
    assert "1.2" in out
    assert "yes" in out
