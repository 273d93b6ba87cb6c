"""A log that cannot be excited, held out, merged or fitted gives one sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identification.logs import one_segment, runs_of, two_segments
from rods import rod

from fastrod.errors import FastrodError, InputError, LogError, RobotError, UnknownNameError
from fastrod.identification.excite import excitation
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.log.split import held_out_rows, merged

NAN = float("nan")


def excited(**given: float) -> object:
    return excitation(one_segment(), **{"bend": 0.8, "rate": 15.0, "speed": 1.0, "payload": 0.03} | given)


def held_out(*words: str, labels: tuple[str, ...] = ("a", "b")) -> object:
    return held_out_rows(sample(runs_of(labels=labels)), list(words))


def together(**columns: tuple[Any, Any]) -> object:
    """Logs named first and second, with columns that may differ; None is a log's own."""
    logs = []
    for k, name in enumerate(("first", "second")):
        given = {column: values[k] for column, values in columns.items() if values[k] is not None}
        logs.append(replace(runs_of(name), **given))
    return merged(logs)


def fitted(target: str, **prior: float) -> object:
    return base_model(two_segments(fit={target: prior}))


Rows = list[tuple[Callable[[], object], str]]
INPUTS: Rows = [
    (
        lambda: replay(runs_of(), rod("tendon_tension")),
        "is driven by tendon forces, and log .* gives lengths; mode of its segments would be 'tendon_length'",
    ),
    (lambda: excitation(rod("passive")), "robot 'passive' has no tendons; there is nothing to excite"),
    (lambda: excited(bend=0.0), "bend is 0.0 rad; it must be positive"),
    (lambda: excited(rate=-15.0), "rate is -15.0 Hz; it must be positive"),
    (lambda: excited(speed=NAN), "speed is nan rad/s; it must be positive"),
    (lambda: excited(bend=50.0), r"bend is 50.0 rad; .* Was it given in degrees\?"),
    (lambda: excited(payload=-0.01), "payload is -0.01 kg; it must be between 0 and 10 kg"),
    (lambda: excited(payload=50.0), "payload is 50.0 kg; it must be between 0 and 10 kg"),
    (lambda: excited(payload=NAN), "payload is nan kg"),
]
NAMES: Rows = [
    (lambda: held_out("c"), "no run 'c' to hold out in log 'log'; known: a, b"),
    (
        lambda: held_out("c", labels=("",)),
        r"no run 'c' to hold out; log 'log' names no runs: give a time, as in '@60:'",
    ),
    (lambda: held_out("cirle", labels=("circle", "square")), "did you mean 'circle'"),
]
POINTS = np.zeros((80, 2, 3))
LOGS: Rows = [
    (
        lambda: held_out("a@1-2"),
        "'a@1-2' is no stretch of time; write RUN@START:END in seconds, for example a@90:150",
    ),
    (lambda: held_out("a@1.2.3:"), "no stretch of time"),
    (lambda: held_out("a@.:2"), "no stretch of time"),
    (lambda: held_out("a@10:20"), "'a@10:20' has no samples; the log's runs last to 3.9 s"),
    (lambda: held_out("a@2:1"), "has no samples"),
    (lambda: held_out("a", "b"), "everything in log 'log' is held out"),
    (lambda: held_out("@0:"), "everything in log 'log' is held out"),
    (lambda: merged([]), r"^no log was given\.$"),
    (lambda: merged([runs_of(), runs_of("other"), runs_of()]), "two logs are named 'log'; rename one"),
    (
        lambda: together(tip_quaternion=(np.tile([1.0, 0.0, 0.0, 0.0], (80, 1)), None)),
        "log 'first' has columns for tip_quaternion, log 'second' has none",
    ),
    (lambda: together(dl=(None, np.zeros((80, 3)))), "different numbers of tendons"),
    (lambda: together(points=(POINTS, POINTS[:, :1])), "different numbers of points"),
]
TARGETS: Rows = [
    (
        lambda: fitted("segment.1.lenght", sd=1e-3),
        r"\[fit\] 'segment.1.lenght' is no parameter; did you mean 'segment.\*.length'",
    ),
    (lambda: fitted("tendon.*.gian", sd=1e-3), r"did you mean 'tendon.\*.gain'"),
    (lambda: fitted("tendons.1.gain", sd=1e-3), r"did you mean 'tendon.\*.gain'"),
    (lambda: fitted("tendon.*.length", sd=1e-3), r"'tendon.\*.length' is no parameter"),
    (lambda: fitted("length", sd=1e-3), "'length' is no parameter"),
    (lambda: fitted("segment.3.length", sd=1e-3), "'segment.3.length'; the robot has segments 1 to 2"),
    (lambda: fitted("segment.0.length", sd=1e-3), "segments 1 to 2"),
    (lambda: fitted("tendon.9.gain", sd=1e-3), "the robot has tendons 1 to 8"),
    (lambda: fitted("segment.1.length", sd=0.0), "has sd 0.0; it must be positive: leave out what is known"),
    (lambda: fitted("segment.1.length", sd=NAN), "has sd nan"),
    (lambda: fitted("segment.1.length", std=1e-3), r"is \{'std': 0.001\}; give \{sd = ...\}"),
    (lambda: fitted("segment.1.length"), "give {sd = ...}"),
]
REFUSED = [
    *((InputError, *row) for row in INPUTS),
    *((UnknownNameError, *row) for row in NAMES),
    *((LogError, *row) for row in LOGS),
    *((RobotError, *row) for row in TARGETS),
]


@pytest.mark.parametrize(("kind", "call", "sentence"), REFUSED, ids=[row[2][:40] for row in REFUSED])
def test_it_is_one_sentence(kind: type[FastrodError], call: Callable[[], object], sentence: str) -> None:
    with pytest.raises(kind, match=sentence) as caught:
        call()
    assert "\n" not in str(caught.value)
    if kind is RobotError:
        assert "'two'" in str(caught.value)
