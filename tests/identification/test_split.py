"""Which samples are held out, in the words of the command line; several logs as one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identification.logs import log_of, one_segment
from numpy.testing import assert_array_equal

from fastrod.errors import LogError, UnknownNameError
from fastrod.identification.log.forward import LogSamples, sample
from fastrod.identification.log.split import held_out_rows, merged
from fastrod.logs.runlog import RunLog


def log(name: str = "log", labels: tuple[str, ...] = ("a", "b"), n: int = 40, begin: float = 5.0) -> RunLog:
    """Runs of 4 s at 10 Hz, whose clocks begin at `begin`."""
    t = np.tile(begin + 0.1 * np.arange(n), len(labels))
    made = log_of(one_segment(), np.full((n * len(labels), 4), 1e-3), 0.1, run=np.repeat(labels, n))
    return replace(made, name=name, t=t)


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
    mask, _ = held_out_rows(samples(), ["a@0:1", "b@3:"])
    assert_array_equal(np.flatnonzero(mask), [*range(10), *range(70, 80)])
    both, _ = held_out_rows(samples(), ["@3:"])  # in seconds of each run's own time
    assert_array_equal(np.flatnonzero(both), [*range(30, 40), *range(70, 80)])
    unnamed, _ = held_out_rows(sample(log(labels=("",))), ["@1:2"])
    assert_array_equal(np.flatnonzero(unnamed), np.arange(10, 20))


@pytest.mark.parametrize(
    ("text", "kind", "sentence"),
    [
        (["c"], UnknownNameError, "no run 'c' to hold out in log 'log'; known: a, b"),
        (
            ["a@1-2"],
            LogError,
            "'a@1-2' is no stretch of time; write RUN@START:END in seconds, for example a@90:150",
        ),
        (["a@10:20"], LogError, "'a@10:20' has no samples; the log's runs last to 3.9 s"),
        (["a@2:1"], LogError, "has no samples"),
        (["a", "b"], LogError, "everything in log 'log' is held out"),
        (["@0:"], LogError, "everything in log 'log' is held out"),
    ],
)
def test_what_cannot_be_held_out(text: list[str], kind: type[Exception], sentence: str) -> None:
    with pytest.raises(kind, match=sentence) as caught:
        held_out_rows(samples(), text)
    assert "\n" not in str(caught.value)


def test_runs_that_have_no_names() -> None:
    with pytest.raises(
        UnknownNameError, match=r"no run 'c' to hold out; log 'log' names no runs: give a time, as in '@60:'"
    ):
        held_out_rows(sample(log(labels=("",))), ["c"])
    with pytest.raises(UnknownNameError, match="did you mean 'circle'"):
        held_out_rows(samples(labels=("circle", "square")), ["cirle"])


@pytest.mark.parametrize("text", ["a@1.2.3:", "a@.:2"])
def test_a_number_that_is_none_gets_a_sentence(text: str) -> None:
    with pytest.raises(LogError, match="no stretch of time"):
        held_out_rows(samples(), [text])


def test_one_log_stays_itself_and_none_is_refused() -> None:
    one = log()
    assert merged([one]) is one
    with pytest.raises(LogError, match=r"^no log was given\.$"):
        merged([])


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


def test_logs_that_do_not_go_together() -> None:
    with pytest.raises(LogError, match="two logs are named 'log'; rename one"):
        merged([log("log"), log("other"), log("log")])
    with pytest.raises(LogError, match="log 'first' has columns for tip_quaternion, log 'second' has none"):
        merged([replace(log("first"), tip_quaternion=np.tile([1.0, 0.0, 0.0, 0.0], (80, 1))), log("second")])
    with pytest.raises(LogError, match="different numbers of tendons"):
        merged([log("first"), replace(log("second"), dl=np.zeros((80, 3)))])
    two_points, one_point = (
        replace(log(name), points=np.zeros((80, k, 3))) for name, k in (("first", 2), ("second", 1))
    )
    with pytest.raises(LogError, match="different numbers of points"):
        merged([two_points, one_point])
