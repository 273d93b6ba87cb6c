"""Which samples are held out, in the words of the command line; several logs as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identification.logs import runs_of as log
from numpy.testing import assert_array_equal

from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.log.split import held_out_rows, merged
from fastrod.logs.runlog import RunLog


def samples(**changes: tuple[str, ...]) -> LogSamples:
    return sample(log(**changes))


def test_by_default_every_fourth_of_twenty_stretches_of_each_run() -> None:
    mask, words = held_out_rows(samples(), [])
    expected = np.isin(np.arange(40) // 2 % 4, 2)
    assert_array_equal(mask, np.tile(expected, 2))
    assert mask.mean() == 0.25
    assert words == ["every fourth of 20 stretches of each run"]


@pytest.mark.parametrize(
    ("text", "first", "last"),
    [
        ("a", 0, 39),
        ("b", 40, 79),
        ("a@1:2", 10, 19),
        ("b@3:", 70, 79),
        ("b@:0.5", 40, 44),
        ("a@2.25:2.55", 23, 25),
        ("a@.45:1.", 5, 9),
    ],
)
def test_held_out_syntax(text: str, first: int, last: int) -> None:
    mask, words = held_out_rows(samples(), [text])
    assert_array_equal(np.flatnonzero(mask), np.arange(first, last + 1))
    assert words == [text]


def test_several_stretches_and_every_run_at_once() -> None:
    for words, rows in (
        (["a@0:1", "b@3:"], [*range(10), *range(70, 80)]),
        (["@3:"], [*range(30, 40), *range(70, 80)]),  # in seconds of each run's own time
    ):
        assert_array_equal(np.flatnonzero(held_out_rows(samples(), words)[0]), rows)
    unnamed, _ = held_out_rows(samples(labels=("",)), ["@1:2"])
    assert_array_equal(np.flatnonzero(unnamed), np.arange(10, 20))


def test_one_log_stays_itself() -> None:
    one = log()
    assert merged([one]) is one


def test_several_logs_become_runs_of_one() -> None:
    heavy = replace(log("second", ("",), 30), payload=np.full(30, 0.02), tip_position=np.ones((30, 3)))
    both = merged([log("first"), heavy])
    assert both.name == "first + second"
    assert both.runs == ["first:a", "first:b", "second"]
    assert len(both) == 110
    # a log that does not mention a load has none
    assert_array_equal(both.payload, np.repeat([0.0, 0.02], [80, 30]))
    assert_array_equal(both.tip_position[80:], 1.0)
    assert_array_equal(both.t[80:], heavy.t)
    held = merged([replace(log("first"), tip_force=np.ones((80, 3))), heavy])
    assert_array_equal(held.tip_force, np.repeat([[1.0], [0.0]], [80, 30], axis=0) * np.ones(3))
    mask, _ = held_out_rows(sample(both), ["second"])
    assert_array_equal(mask, np.repeat([False, True], [80, 30]))


def test_a_gap_in_time_is_a_hold() -> None:
    """Memories go on under the command before it, and no row is added to what is compared."""
    t = np.concatenate([0.1 * np.arange(10), 20.0 + 0.1 * np.arange(10)])
    dl = np.repeat([[0.0], [2e-3]], 10, axis=0)
    tip = np.zeros((20, 3))
    gapped = RunLog(name="gap", t=t, run=np.full(20, "a"), dl=dl, tip_position=tip)
    held = sample(gapped)
    assert len(held.log) == 21
    assert_array_equal(held.origin[held.given], np.arange(20))
    assert_array_equal(held.rows, held.given)
    assert held.time[10] == pytest.approx(19.9)
    assert held.log.dl[10, 0] == 0.0
    assert_array_equal(sample(gapped.rows(slice(0, 10))).given, np.arange(10))
