"""The peers in motion: all swing the same rod, nearer if finer; one that is missing is a sentence."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import appendix_j
import bench_motion
import release

ONE = np.array([release.FORCE])


def peer(name: str) -> Any:
    (found,) = (one for one in bench_motion.PEERS if one.name == name)
    if sentence := found.missing():
        pytest.skip(sentence)
    return found


def errors(name: str, rungs: slice) -> list[float]:
    found = []
    for rung in peer(name).rungs[rungs]:
        with rung.build() as solve:
            found.append(bench_motion.error(solve(ONE), ONE))
    return found


def test_the_force_begins_and_ends_without_a_jump() -> None:
    t = np.linspace(0.0, release.END, 5001)
    f = np.array([release.pull(x) for x in t])
    slope = np.gradient(f, t)
    assert f.max() == pytest.approx(1.0)
    assert np.abs(np.diff(f)).max() < 2e-3
    assert np.abs(np.diff(slope)).max() < 1e-3 * 2.0 * math.pi**2 / release.PULL**2


def test_the_rod_that_is_pulled_slowly_bends_as_the_elastica() -> None:
    """62 mm to the side at rest, as a fraction of the length that of a rod of Appendix J under the same
    F l^2/EI."""
    scaled = release.FORCE * release.LENGTH**2 / release.BENDING
    same = scaled * appendix_j.BENDING / appendix_j.LENGTH**2
    across = appendix_j.tips(np.array([same]))[0, 0] / appendix_j.LENGTH * release.LENGTH
    assert across == pytest.approx(0.062, abs=1e-3)


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "rungs"),
    [
        ("fastrod, in motion", slice(0, 4)),
        ("MuJoCo chain, hinges", slice(0, 4)),
        ("MuJoCo chain, ball joints", slice(0, 3)),
        ("PyElastica", slice(0, 3)),
    ],
)
def test_a_finer_setting_is_nearer_to_the_reference(name: str, rungs: slice) -> None:
    """The chains share no code with the reference."""
    found = errors(name, rungs)
    assert np.all(np.diff(found) < 0.0), found
    assert found[-1] < 2e-3


@pytest.mark.study
def test_a_chain_of_links_goes_to_the_reference_at_second_order() -> None:
    chain = peer("MuJoCo chain, hinges")
    links = [int(rung.label.split()[0]) for rung in chain.rungs[2:5]]
    slope = np.polyfit(np.log(links), np.log(errors(chain.name, slice(2, 5))), 1)[0]
    assert slope == pytest.approx(-2.0, abs=0.15)


@pytest.mark.parametrize("name", ["fastrod, in motion", "MuJoCo chain, hinges"])
@pytest.mark.study(beyond=1)
def test_all_in_one_call_is_one_after_the_other(name: str) -> None:
    rung, force = peer(name).rungs[1], bench_motion.forces(3)
    with rung.together() as together, rung.build() as alone:
        each = np.concatenate([alone(force[i : i + 1]) for i in range(3)])
        np.testing.assert_allclose(together(force), each, rtol=0, atol=1e-9)


@pytest.mark.study
def test_the_bench_runs_and_what_is_missing_is_a_sentence(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hinges = peer("MuJoCo chain, hinges")
    absent = replace(hinges, name="Unheard", modules=("unheard_of",))
    monkeypatch.setattr(bench_motion, "PEERS", [release.PEER, hinges, absent])
    assert bench_motion.main(["--quick", "--json"]) == 0
    sections = json.loads(capsys.readouterr().out)["sections"]
    words = "Unheard is left out: unheard_of is not installed (pip install -e '.[peers]')."
    assert words in sections["motion"]["notes"]
    for key in ("motion", "motion_batch"):
        rows = sections[key]["rows"]
        assert [row["peer"] for row in rows] == [release.PEER.name] * 2 + [hinges.name] * 2
        assert all(row["error_m"] < 1e-2 and row["ms"] > 0.0 for row in rows)
        assert all(("met" in row) is (row["peer"] == hinges.name) for row in rows)
    (summary,) = sections["motion_summary"]["rows"]
    assert summary["peer"] == hinges.name
