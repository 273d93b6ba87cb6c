"""The cap on what a test costs: who is dear without a mark fails the run, and the first cases of a study that
says `beyond` stay in the check."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cost import MOST, PACE, Cost


def cost_of(*, quick: bool = False) -> Cost:
    options = {"--quick": quick}
    hook = SimpleNamespace(pytest_deselected=lambda items: None)
    config: Any = SimpleNamespace(getoption=options.get, hook=hook)
    return Cost(config, once=None)  # type: ignore[arg-type]


class Item:
    """A collected case."""

    def __init__(self, nodeid: str, *marks: pytest.Mark) -> None:
        self.nodeid, self.own_markers = nodeid, list(marks)

    def get_closest_marker(self, name: str) -> pytest.Mark | None:
        return next((mark for mark in self.own_markers if mark.name == name), None)


@pytest.mark.parametrize(("beyond", "studies"), [({}, "abc"), ({"beyond": 1}, "bc"), ({"beyond": 3}, "")])
def test_the_first_cases_of_a_study_stay_in_the_check(beyond: dict[str, int], studies: str) -> None:
    items: list[Any] = [Item(f"t.py::test[{name}]", pytest.mark.study(**beyond).mark) for name in "abc"]
    cost_of().pytest_collection_modifyitems(items)
    marked = [item.nodeid for item in items if item.get_closest_marker("study")]
    assert marked == [f"t.py::test[{name}]" for name in studies]


def test_quick_leaves_out_what_is_known_to_be_dear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = tmp_path / "costs.json"
    known.write_text('{"t.py::test_dear": 0.4}', encoding="utf-8")
    monkeypatch.setattr("cost.COSTS", known)
    items: list[Any] = [Item("t.py::test_dear[a]"), Item("t.py::test_new")]
    cost_of(quick=True).pytest_collection_modifyitems(items)
    assert [item.nodeid for item in items] == ["t.py::test_new"]


@pytest.mark.parametrize(
    ("study", "share", "slow"),
    [(False, 0.4, 0.5), (False, 0.6, 0.5), (True, 0.6, 1.0), (False, 0.6, 1.1), (False, 0.6, 1.3)],
)
def test_a_function_is_dear_by_all_its_cases_that_are_no_studies(
    study: bool, share: float, slow: float
) -> None:
    """On a core that is as fast as the cap is meant for, or faster; on a slower one the cap is higher."""
    cost = cost_of()
    for case in "ab":
        properties = [("cost", (share * MOST, study)), ("pace", slow * PACE)]
        report = SimpleNamespace(nodeid=f"t.py::test[{case}]", when="call", user_properties=properties)
        cost.pytest_runtest_logreport(report)  # type: ignore[arg-type]
    dear = not study and 2.0 * share > max(1.0, slow)
    expected = {"t.py::test": pytest.approx(2.0 * share * MOST)} if dear else {}
    assert cost.too_dear() == expected
