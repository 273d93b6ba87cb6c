"""The benchmark's own instruments: its peers solve the same rod, its count of operations is exact, its rows
become JSON."""

from __future__ import annotations

import importlib
import json
import math
from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from fastrod import Modal
from fastrod.reference import shoot


def measured(capsys: pytest.CaptureFixture[str], name: str, *words: str) -> dict[str, Any]:
    """Rows of each table of a quick run."""
    assert importlib.import_module(f"bench_{name}").main(["--quick", "--json", *words]) == 0
    sections = json.loads(capsys.readouterr().out)["sections"]
    return {key: section["rows"] for key, section in sections.items()}


@pytest.mark.parametrize("tension", [0.0, 2.0])
def test_the_peers_slopes_agree(tension: float) -> None:
    from scipy_rod import N_STATE, array_slope, compiled_slope, rod_slope

    rng = np.random.default_rng(4)
    y, load = rng.normal(size=N_STATE), rng.normal(size=6)
    rod = np.array([0.07, 0.0022, 0.0025, 0.001])
    tendons = np.column_stack([0.01 * rng.normal(size=(4, 2)), tension * rng.random(4)])
    expected = array_slope(0.03, y, load, rod, tendons)
    as_tuples = tuple(map(tuple, tendons.tolist()))
    for slope in (rod_slope, compiled_slope()):
        got = slope(0.03, y, tuple(load.tolist()), tuple(rod.tolist()), as_tuples, np.empty(N_STATE))
        np.testing.assert_allclose(got, expected, rtol=1e-11, atol=1e-9)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("paper", [True, False])
def test_the_peer_solves_the_same_rod(paper: bool) -> None:
    from cases import LINE, appendix_b_robot, arc_lengths
    from scipy_rod import Shooter

    robot = appendix_b_robot(paper)
    length, force = arc_lengths(robot, np.array([[[0.4, -0.5]]]))[0], (0.1, -0.2, 0.15)
    peer = Shooter(robot, "scalars", integrator="DOP853", rtol=1e-9, atol=1e-11)
    tip, residual = peer.solve(length, (*force, *LINE))
    expected = shoot(robot, length, tip_force=force, line_force=LINE)
    assert expected.success
    assert residual < 1e-9
    np.testing.assert_allclose(tip, expected.tip_position, atol=1e-8)


@pytest.mark.study
def test_the_count_of_operations_is_linear_in_the_steps() -> None:
    import flops

    (at_five,) = flops.counted(["paper", "prototype"], True, [5])
    assert flops.count({"paper": 5, "prototype": 5}, True) == at_five
    assert all(tally.flops > 1e4 for tally in at_five.values())


@pytest.mark.study
def test_the_observer_and_rods_of_modes_are_measured_on_the_same_inputs() -> None:
    import rod_modal

    rows = rod_modal.step_section(3, rounds=1).rows
    assert [row["robot"] for row in rows] == ["prototype"] * 10 + ["reacher"] * 10
    assert {row["ok"] for row in rows} == {1.0}
    for row in rows:
        assert ("error_max_m" in row) is ("in motion" not in row["solver"])
        assert row.get("error_max_m", 0.0) < (1e-3 if "(4, 2)" in row["solver"] else 1e-5), row
        assert ("ratio" in row) is ("observer" not in row["solver"])
    one, _ = rod_modal.real_time_section(3, steps=2).rows
    assert one["factor"] == pytest.approx(1e3 * rod_modal.DT / one["ms"])
    assert one["lost"] == 0


def test_rows_become_json_and_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    from report import Column, columns, show, table

    text = "a a [m] | b:.1f | c | d:,.0f two~lines"
    assert columns(text)[1:] == [Column("b", "b", ".1f"), Column("c", "c"), Column("d", "two\nlines", ",.0f")]
    row = {"a": "x", "b": 1.25, "c": True, "d": float("nan")}
    section = table("key", "Title", text, [row], "A note.")
    assert json.loads(json.dumps(section.as_json()))["rows"] == [{**row, "d": None}]
    show([section], "head")
    out = capsys.readouterr().out
    assert all(word in out for word in ("a [m]", "1.2", "yes", "two", "lines", "A note."))


def test_the_runner_reads_options_and_says_what_failed(capsys: pytest.CaptureFixture[str]) -> None:
    from fastrod.errors import InputError
    from report import bench, table

    given = []

    def measure(options: Any) -> list[Any]:
        given.append(vars(options))
        if options.kind == "odd":
            raise InputError("odd is no kind.")
        return [table("key", "Title", "a", [{"a": 1}], failed=options.bad)]

    kinds, several = ("--kind", ["even", "odd"], "one"), ("--some", (int,), "several")
    main = bench("What.", measure, ("--n", 3, "count"), ("--bad", False, "flag"), kinds, several)
    assert main(["--json", "--some", "1", "2"]) == 0
    words = {"n": 3, "bad": False, "kind": None, "some": [1, 2], "json": True, "quick": False}
    assert given == [words]
    assert json.loads(capsys.readouterr().out)["sections"]["key"]["rows"] == [{"a": 1}]
    assert main(["--bad", "--quick", "--n", "7"]) == 1
    assert given[1] == {**words, "n": 7, "bad": True, "some": None, "json": False, "quick": True}
    assert main(["--kind", "odd"]) == 2
    assert capsys.readouterr().err == "odd is no kind.\n"


def test_what_is_compared_is_measured_in_alternation() -> None:
    from report import alternate, goal

    calls: list[str] = []
    found = alternate([lambda: calls.append("a"), lambda: calls.append("b")], 3)
    assert calls == ["a", "b"] * 3
    assert all(len(one.times) == 3 and one.least <= one.median <= max(one.times) for one in found)
    assert goal(2.0, 1.0) == {"target": 1.0, "met": False}
    assert goal(2.0, 1.0, least=True, name="x_") == {"x_target": 1.0, "x_met": True}


def outcome(
    case: str, true: str, named: list[str], verdict: str, left: float = 0.0, classes: Any = None
) -> dict[str, Any]:
    """A row of the attribution benchmark: `left` of the error above a floor of 0.5 mm, 2 mm before."""
    return {
        "case": case,
        "seed": 1,
        "true": true.split(),
        "verdict": verdict,
        "kind": "none",
        "named": named,
        "classes": classes or [[] for _ in named],
        "before": 2.5e-3,
        "after": 0.5e-3 + 2e-3 * left,
        "floor": 0.5e-3,
        "bounds": 3,
        "left": left,
        "seconds": 1.0,
        "rows": 100,
    }


WANTED = [
    (True, outcome("single", "creep", ["creep"], "explained")),
    (False, outcome("single", "creep", ["friction", "creep"], "explained")),
    (False, outcome("single", "creep", [], "none", 1.0)),
    (True, outcome("none", "", [], "none", 1.0)),
    (False, outcome("none", "", ["lens"], "explained")),
    (True, outcome("outside", "bump", [], "not_in_library", 1.0)),
    (False, outcome("outside", "bump", ["time_drift"], "partly_explained", 0.3)),
    (True, outcome("two", "creep lens", ["lens", "creep"], "explained")),
    (True, outcome("two", "creep lens", ["lens", "friction"], "explained", classes=[[], ["creep"]])),
    (False, outcome("two", "creep lens", ["lens"], "partly_explained", 0.2)),
    (True, outcome("dominant", "creep lens gravity", ["friction"], "explained", classes=[["creep"]])),
    (False, outcome("dominant", "creep lens gravity", ["lens", "creep"], "explained")),
    (False, outcome("dominant", "creep lens gravity", [], "none", 1.0)),
    (True, outcome("deleted", "creep", ["friction"], "explained", 0.14)),
    (False, outcome("deleted", "creep", ["friction"], "explained", 0.16)),
    (False, outcome("deleted", "creep", ["friction"], "ambiguous", 0.16)),
    (True, outcome("deleted", "creep", ["friction"], "not_in_library", 0.5)),
    (True, outcome("deleted", "creep", [], "not_in_library", 1.0)),
    (True, outcome("operator", "creep", ["friction"], "ambiguous")),
    (True, outcome("operator", "creep", [], "none", 1.0)),
    (False, outcome("operator", "creep", ["friction"], "explained")),
    (True, outcome("noise", "lens", ["lens"], "ambiguous")),
    (True, outcome("segments", "coupling", ["coupling"], "explained")),
    (False, {"case": "segments", "seed": 1, "true": ["coupling"], "error": "ValueError: it broke"}),
]


@pytest.mark.parametrize(("wanted", "row"), WANTED)
def test_a_verdict_is_scored_as_its_goal_wants(wanted: bool, row: dict[str, Any]) -> None:
    from bench_attribution import score

    assert score(row["case"], row) is wanted


def test_verdicts_are_summed_up_by_case(capsys: pytest.CaptureFixture[str]) -> None:
    from bench_attribution import confusion, sections, summary
    from report import show

    rows = [row for _, row in WANTED]
    table = {line["case"]: line for line in summary(rows)}
    assert {
        case: (line["logs"], round(line["as_wanted"] * line["logs"])) for case, line in table.items()
    } == {
        case: (n, sum(wanted for wanted, row in WANTED if row["case"] == case))
        for case, n in Counter(r["case"] for r in rows).items()
    }
    assert table["segments"]["crashed"] == 1
    assert table["deleted"]["verdicts"] == "2 explained, 1 ambiguous, 2 not_in_library"
    assert table["single"]["after_over_floor_median"] == pytest.approx(1.0)  # of those that named something
    assert table["deleted"]["after_within_1.15"] == 0.0
    assert confusion(rows) == {
        "creep": {"creep": 1, "friction": 1, "none": 1},
        "none": {"none": 1, "lens": 1},
        "bump": {"not_in_library": 1, "time_drift": 1},
        "lens": {"lens": 1},
    }
    assert json.loads(json.dumps(table))
    found = sections(rows, 2)
    assert [row["case"] for row in found[1].rows] == [row["case"] for wanted, row in WANTED if not wanted]
    show(found, "head")
    out = capsys.readouterr().out
    assert "ValueError: it broke" in out
    assert "33.3%" in out
    assert "friction (creep)" not in out  # as wanted


def test_a_fraction_of_the_sealed_logs_has_some_of_each_kind() -> None:
    from bench_attribution import GOALS, cases

    few, total = cases(0.02, []), sum(count for count, _ in GOALS.values())
    assert {case.kind for case in few} == set(GOALS)
    assert len(few) < 0.05 * total
    every = cases(1.0, [])
    assert len(every) == total
    assert set(few) <= set(every)
    assert len(set(every)) == len(every)
    assert {case.kind for case in cases(0.1, ["none", "two"])} == {"none", "two"}


def test_a_log_that_breaks_is_a_row() -> None:
    from bench_attribution import Case, safely, score

    row = safely(Case("single", 3, "no such effect"))
    assert row["error"]
    assert not score("single", row)


@pytest.mark.study
def test_the_contact_bench_runs_and_its_states_are_what_they_say(capsys: pytest.CaptureFixture[str]) -> None:
    tables = measured(capsys, "contact", "--robots", "3")
    steps = tables["contact_steps"]
    states = ["free", "grazing", "in contact"]
    assert [row["state"] for row in steps] == ["no scene", *(state for state in states for _ in range(2))]
    assert {row["not_ok"] for row in steps} == {0}
    assert {row["touching"] for row in steps if row["state"] != "in contact"} == {0.0}
    assert {row["touching"] for row in steps if row["state"] == "in contact"} == {1.0}
    assert all(1e-3 < row["gap_m"] < 6e-3 for row in steps if row["state"] == "grazing")
    assert all(row["gap_m"] > 0.3 for row in steps if row["state"] == "free")
    assert all(row["passes"] == 1.0 for row in steps if row["state"] in ("free", "grazing"))
    queries = tables["contact_query"]
    assert [row["faces"] for row in queries] == [320, 1280] * 3
    assert all(row["fcl_us"] > 0.0 and row["warm_us"] > 0.0 for row in queries)


def test_fcl_finds_the_same_distances() -> None:
    from directscene import DirectScene

    import contact_batch

    batch, obstacle = contact_batch.make_batch(2), contact_batch.make_mesh(2)
    pose = contact_batch.places(batch, contact_batch.GRAZING)
    timed = contact_batch.run(batch, obstacle, contact_batch.GRAZING, 1, 0.0)
    for i in range(2):
        scene = DirectScene([obstacle])
        scene.place(0, pose[i, :3], pose[i, 3:])
        nodes = timed.last.position[i]
        chords = min(scene.segment(0, a, b).distance for a, b in pairwise(nodes))
        assert timed.last.contacts is not None
        # a curve and its chords
        assert timed.last.contacts.clearance[i] == pytest.approx(chords - batch.rod_radius, abs=2e-4)
        answer = contact_batch.ask_fcl(contact_batch.questions(timed, obstacle, pose, [i]))
        assert answer == pytest.approx(chords, abs=1e-4)  # capsules of 1e-6 m, and the iteration of libccd
    assert contact_batch.fcl_seconds(timed, obstacle, pose, 2)[1] == 2


@pytest.mark.study
def test_the_control_bench_runs_and_both_follow_the_path(capsys: pytest.CaptureFixture[str]) -> None:
    exact, differences = measured(capsys, "control")["control_step"]
    assert exact["kind"] == "analytic"
    assert exact["ratio"] > 1.0
    assert max(exact["error_m"], differences["error_m"]) < 1e-3


@pytest.mark.study
def test_the_hosts_bench_runs_and_its_states_are_what_they_say(capsys: pytest.CaptureFixture[str]) -> None:
    tables = measured(capsys, "hosts")
    rows = {row["what"]: row for row in tables["hosts"]}
    assert len(rows) == 7
    assert rows["prototype, pushes a free cube"]["in_contact"] > 0.0
    assert rows["prototype, free"]["in_contact"] == 0.0
    assert all(row["failed"] == 0 for row in rows.values())
    assert len(tables["engines"]) == 4
    # per cent
    assert all(max(row["tip"], row["force"], row["moment"]) < 1.0 for row in tables["engines"])


@pytest.mark.study
def test_the_envs_bench_runs_over_every_task(capsys: pytest.CaptureFixture[str]) -> None:
    import fastrod_envs

    tables = measured(capsys, "envs")
    reach, others = tables["reach"], tables["tasks"]
    assert {row["kind"] for row in reach} == {"SyncVectorEnv", "native batch"}
    assert all(row["rate"] > 0.0 for row in [*reach, *others])
    assert all(0.0 < row["fraction"] < 1.0 for row in reach if row["kind"] == "native batch")
    assert {row["kind"] for row in others} == set(fastrod_envs.names()) - {"Reach"}


def test_heavy_upright_robots_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    import motion_steps

    monkeypatch.setattr(motion_steps, "N_ROBOTS", 3)
    count = motion_steps.run(True, 1e-3, 3 * 40, 1, math.inf)
    assert (count.steps, count.lost, count.not_finite) == (120, 0, 0)
    assert count.passes >= count.steps
    assert count.holds > 0
    assert count.grown <= count.holds
    assert math.isfinite(count.growth + count.peak)


@pytest.mark.study
def test_the_energy_that_the_campaign_counts_is_kept() -> None:
    """Second order: a quarter of a millisecond leaves some 1e-4 of what goes from bend to motion and back."""
    import motion_steps
    from fastrod import Simulator

    robot = motion_steps.upright(False)
    sim, rest = Simulator(robot, 1, 2.5e-4, 8, solver=Modal(dynamics=True, rho=0.9)), robot.rest_tendon_length
    states = [sim.settle(rest, tip_force=(0.4, 0.0, 0.0)), *(sim.step(rest) for _ in range(400))]
    energy = np.array([motion_steps.energy(robot, state)[0] for state in states])
    kinetic, bend = (
        np.array([getattr(state, f"{k}_energy")[0] for state in states]) for k in ("kinetic", "strain")
    )
    assert np.ptp(energy) < 1e-3 * kinetic.max()
    assert np.ptp(energy - kinetic - bend) > 0.1 * kinetic.max()  # tendons and weight have their fraction
