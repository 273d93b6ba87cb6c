"""The benchmark's model of N machines: exact where it can be done by hand."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.mark.study
def test_machines_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "perf"))
    from bench_generate import Costs, machines

    section = machines(Costs(task=2.0, start=1.0, dispatch=1e-3, check=1e-9, bytes=100.0), 10_000, 10)
    by = {(row["count"], row["machines"]): row for row in section.rows}
    # 100 tasks on 10 cores: ten rounds of 2 s; on 80 cores two rounds; on more, one
    assert by["1,000,000", 1]["seconds"] == pytest.approx(1.0 + 20.0 + 1e-3)
    assert by["1,000,000", 8]["seconds"] == pytest.approx(1.0 + 4.0 + 1e-3)
    assert (
        by["1,000,000", 32]["seconds"] == by["1,000,000", 128]["seconds"] == pytest.approx(1.0 + 2.0 + 1e-3)
    )
    # a million tasks hand out in 1000 s what 1280 cores do in 1564
    assert by["10,000,000,000", 128]["seconds"] == pytest.approx(1.0 + 2.0 * 782 + 10.0)
    assert by["10,000,000,000", 128]["bound"] == "work"
    assert by["10,000,000,000", 1]["efficiency"] == 1.0
    slow = machines(Costs(task=2.0, start=1.0, dispatch=1e-2, check=1e-9, bytes=100.0), 10_000, 10)
    assert slow.rows[-1]["bound"] == "dispatch"
    assert slow.rows[-1]["seconds"] == pytest.approx(1.0 + 1e4 + 10.0)
