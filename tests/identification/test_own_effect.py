"""An effect in a package of its own: identification knows it as it knows the library's."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments, wave

from fastrod import Robot
from fastrod.effects import base
from fastrod.effects.base import Signal, effect_names, get_effect, signal_of, trait
from fastrod.identification.log.advice import separating_run
from fastrod.identification.log.unknowns import effect_unknowns
from fastrod.identification.report.page import _would_show
from fastrod.identification.report.result import Found
from fastrod.identification.report.signals import Signals
from fastrod.identification.search.model_selection import DetectionLimit
from fastrod.identification.search.search import Search
from fastrod.model.routing import route

CABLE = '''"""A cable that stiffens the robot as it wears."""

import numpy as np

from fastrod.effects.base import Parameter, Seam, Signal, Static, effect


@effect
class WornCable(Static):
    """A cable beside the robot pulls its bends back, more with time.

    Equation: theta -> theta (1 - r t)
    Source: none
    Residual signature: grows with time, in proportion to the bend
    """

    seam = Seam.ACTUATION
    parameters = (Parameter("rate", "1/s", bounds=(0.0, 1.0), typical=0.01),)
    excited_by = "the same path once more after an hour"
    separated_by = {"creep": "an hour of rest"}
    signal = Signal.TIME
    least_segments = 2
    frequent = True

    def apply(self, values, memory, ports, state, dt):
        ports.shift_bend(-values[:, 0, None, None] * ports.time[:, None, None] * ports.bend())
'''


@pytest.fixture
def package(tmp_path: Path) -> Iterator[None]:
    """The package as it lies once it is installed: one file, and its entry point."""
    (tmp_path / "wornlab.py").write_text(CABLE)
    info = tmp_path / "wornlab-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: wornlab\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[fastrod.effects]\nworn = wornlab\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(tmp_path))
        base.load_library.cache_clear()
        yield
        if "worn_cable" in effect_names():
            base.unregister("worn_cable")
        del sys.modules["wornlab"]


def tried(robot: Robot) -> list[str]:
    """Names that a search tries on a robot."""
    model: Any = SimpleNamespace(robot=robot, wiring=route(robot), effects=())
    return Search.names(SimpleNamespace(excluded=()), SimpleNamespace(model=model))


def test_a_search_tries_it_where_the_robot_can_show_it(package: None) -> None:
    assert "worn_cable" in effect_names()
    assert "worn_cable" in tried(two_segments())
    assert "worn_cable" not in tried(one_segment())
    (unknown,) = effect_unknowns("worn_cable", route(two_segments()))
    assert (unknown.name, unknown.unit) == ("worn_cable.rate", "1/s")


def test_the_run_that_separates_it_is_its_own(package: None) -> None:
    assert separating_run("worn_cable", "creep") == "to tell worn cable from creep: an hour of rest"
    assert separating_run("creep", "worn_cable") == "to tell creep from worn cable: an hour of rest"
    assert "after an hour; " in separating_run("worn_cable", "gravity")


def test_a_report_draws_it_against_its_signal(package: None) -> None:
    robot = two_segments()
    dl = wave(robot, 200)
    seen = np.column_stack([dl[:, :2], np.full(len(dl), robot.length)])
    log = log_of(robot, dl, tip_position=seen)
    left = {"residual_before": 0.001 * np.sin(seen), "residual_after": 0.0 * seen}
    rows = {"measured": np.ones(len(log), bool), "outlier": np.zeros(len(log), bool)}
    result: Any = SimpleNamespace(robot=robot, log=log, before=seen, after=seen, **left, **rows)
    usual: Any = {"title": "", "held_out_gain": 1.0, "evidence": {}, "cannot_be_told_from": []}
    view = Signals(result).view(Found(name="worn_cable", parameters={}, **usual))
    assert view.signal_label == "time since the start of the run [s]"
    assert len(view.rows) == len(log)


def test_its_bound_is_among_the_first(package: None) -> None:
    bounds = [DetectionLimit(name, "rate", "1/s", 0.1) for name in (*effect_names()[:8], "worn_cable")]
    assert any("worn cable" in sentence for sentence in _would_show(bounds))


def test_every_law_of_the_library_has_what_it_had() -> None:
    """Signal, segments and rank are by seam and memory unless a law says its own."""
    own = {name: signal_of(get_effect(name)) for name in effect_names() if trait(get_effect(name), "signal")}
    assert own == {
        "creep": Signal.LAG,
        "second_order_lag": Signal.MOTION,
        "latency": Signal.MOTION,
        "temperature": Signal.TIME,
        "time_drift": Signal.TIME,
        "settling_drift": Signal.TIME,
        "rotation_drift": Signal.TIME,
        "slip": Signal.TIME,
        "tip_force": Signal.FORCE,
        "tip_spring": Signal.TIP,
    }
    assert signal_of(get_effect("gravity")) is signal_of(get_effect("payload")) is Signal.GRAVITY
    assert signal_of(get_effect("friction")) is Signal.LOOP
    assert signal_of(get_effect("lens")) is Signal.TIP
    assert signal_of(get_effect("drum_gain")) is Signal.BEND
    assert [name for name in effect_names() if trait(get_effect(name), "least_segments") > 1] == ["coupling"]
    frequent = {"payload", "gravity", "friction", "backlash", "latency", "creep"}
    assert {name for name in effect_names() if trait(get_effect(name), "frequent")} == frequent
    pairs = [(name, other) for name in effect_names() for other in trait(get_effect(name), "separated_by")]
    assert all(other in effect_names() for _, other in pairs)
    assert len({frozenset(pair) for pair in pairs}) == len(pairs) == 46


def test_a_class_of_no_base_has_the_same_defaults() -> None:
    bare: Any = SimpleNamespace(seam=base.Seam.SENSING, memory=lambda *_: np.empty(0))
    assert trait(bare, "order") == 50.0
    assert trait(bare, "separated_by") == {}
    assert signal_of(bare) is Signal.TIP
