"""The closed loop on sealed logs: a plant that shares no code with the model hides an effect, `identify`
names it, the seal is opened.

Statistics over hundreds of logs are in perf/bench_attribution.py; here is one log of each kind.
"""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from reportlog import GAP, backlash_log
from truth import other_robots, plant

from fastrod.errors import LogError
from fastrod.identification.attribution import identify
from fastrod.identification.excite import excitation
from fastrod.identification.log.replay import replay
from fastrod.identification.report import report
from fastrod.identification.report.result import Result
from fastrod.identification.search import search
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.types import Floats

SEED = 1000


@cache
def robot() -> Robot:
    return load_robot("prototype")


@cache
def sealed(effect: Any, outliers: float = 0.0, seed: int = SEED) -> tuple[RunLog, plant.Seal]:
    """The designed run, 195 s at 15 Hz, driven by the plant; noise 0.3 mm an axis."""
    log = excitation(robot(), seed=seed).log
    assert log.payload is not None
    assert log.base_quaternion is not None
    seal = plant.draw(seed, effect)
    inputs = plant.Inputs(log.t, log.dl, log.payload, log.base_quaternion)
    return replace(log, tip_position=plant.measure(inputs, seal, outliers=outliers)), seal


@cache
def found(effect: str, *exclude: str, outliers: float = 0.0) -> Result:
    return identify(sealed(effect, outliers)[0], robot(), exclude=exclude, threads=1)


def value(result: Result, name: str, parameter: str) -> tuple[float, float]:
    (effect,) = (e for e in result.effects if e.name == name)
    return effect.parameters[parameter].value, effect.parameters[parameter].stderr


NAMED = ("latency", "gravity", "drum_gain")


@pytest.mark.study
@pytest.mark.parametrize("effect", NAMED)
def test_a_hidden_effect_is_named_and_leaves_the_noise(effect: str) -> None:
    result = found(effect)
    assert result.verdict in ("explained", "ambiguous")
    assert result.effects[0].name == effect
    assert result.test.before > 1.5 * result.noise.floor
    # measured when this was written: 1.03 for a clean log on this run, 1.03 to 1.07 for these
    assert result.test.after < 1.15 * result.noise.floor
    assert result.test.interval[0] <= result.test.after <= result.test.interval[1]
    assert result.train.after < 1.15 * result.noise.floor
    assert result.effects[0].held_out_gain > 0.9
    assert effect.replace("_", " ") in result.summary


PAIRS = {52010: ("tendon_stretch", "axial_compression"), 52000: ("axial_compression", "marker_offset")}


@pytest.mark.study
@pytest.mark.parametrize("seed", PAIRS)
def test_of_two_hidden_effects_neither_is_lost(seed: int) -> None:
    """A spring at the tip stood in for the first two; of the others the smaller passed for a correction of
    the larger one's form."""
    result = identify(sealed(PAIRS[seed], seed=seed)[0], robot(), threads=1)
    assert {effect.name for effect in result.effects} == {*PAIRS[seed]}
    assert result.test.after < 1.1 * result.noise.floor


OTHERS = {"drum_gain": 1008, "gravity": 1027, "precurvature": 1012, "tendon_stretch": 1033}


@pytest.mark.study
@pytest.mark.parametrize(("name", "seed"), OTHERS.items())
def test_on_another_robot_an_effect_is_named_with_its_numbers(name: str, seed: int) -> None:
    """Where slopes lead far off, the rod is solved again there; drives that are alike have one number; a
    stiffness that stands in for a stretch is forgotten where the stretch is tried."""
    log, other, hidden = other_robots.sealed(seed, name)
    result = identify(log, other, threads=1)
    assert [effect.name for effect in result.effects] == [name]
    for label, estimate in result.effects[0].parameters.items():
        assert estimate.value == pytest.approx(hidden[label], abs=4.0 * estimate.stderr)
    assert result.test.after < 1.1 * result.noise.floor


@pytest.mark.study
def test_sizes_are_those_in_the_seal() -> None:
    """Within the plant's other form: a density that slopes by up to 15 %, a clock that is off by 1e-4."""
    said, stderr = value(found("latency"), "latency", "delay")
    true = sealed("latency")[1].effects["latency"]
    assert said == pytest.approx(true["delay"], abs=3.0 * stderr + abs(true["skew"]) * 200.0)
    said, _ = value(found("gravity"), "gravity", "line_density")
    assert said == pytest.approx(sealed("gravity")[1].effects["gravity"]["weight"] / 9.81, rel=0.2)
    gains = sealed("drum_gain")[1].effects["drum_gain"]["gain"]
    parameters = found("drum_gain").effects[0].parameters
    assert np.allclose([p.value for p in parameters.values()], gains, atol=0.1 * np.abs(gains).max() + 0.005)


@pytest.mark.study
def test_of_nothing_comes_nothing() -> None:
    result = found("none")
    assert (result.verdict, result.remaining_kind) == ("none", "none")
    assert [*result.effects, *result.patterns] == []
    assert result.test.after == result.test.before < 1.15 * result.noise.floor
    assert_array_equal(result.after, result.before)
    bounds = {bound.name: bound for bound in result.bounds}
    assert bounds["payload"].value < 0.03  # kg; a typical one would have shown
    assert 0.0 < bounds["latency"].value < 0.05  # s


@pytest.mark.study
def test_one_sample_in_ten_thrown_off_changes_no_verdict() -> None:
    result = found("none", outliers=0.1)
    assert (result.verdict, list(result.effects)) == ("none", [])
    assert 0.08 * len(result.log) < result.outlier.sum() < 0.13 * len(result.log)
    assert any("outliers" in note for note in result.notes)
    assert result.noise.floor == pytest.approx(np.sqrt(3.0) * 3e-4, rel=0.1)


@pytest.mark.study
def test_a_camera_that_is_bumped_is_not_in_the_library() -> None:
    result = found("bump")
    assert (result.verdict, result.remaining_kind, list(result.effects)) == ("not_in_library", "drift", [])
    assert any("jumps" in pattern for pattern in result.patterns)
    assert result.test.after == result.test.before
    at = sealed("bump")[1].effects["bump"]["at"] * float(np.ptp(result.log.t))
    said = float(result.patterns[0].split("at ")[1].split(" s")[0])
    assert said == pytest.approx(at, abs=0.03 * float(np.ptp(result.log.t)))


@pytest.mark.study
@pytest.mark.parametrize(("camera", "every"), [("slow", 3.0), ("out of step", 1.618), ("coarse", 1.0)])
def test_a_camera_is_taken_for_what_it_is(camera: str, every: float) -> None:
    """One whose pictures come every third row, or every 1.618 rows, and one that says millimetres."""
    tip = np.asarray((log := sealed("gravity")[0]).tip_position)
    rows = np.arange(len(tip))
    seen = np.stack([np.interp(rows // every * every, rows, x) for x in tip.T], axis=1)
    seen = seen.round(3) if camera == "coarse" else seen
    result = identify(replace(log, tip_position=seen), robot(), threads=1)
    assert [effect.name for effect in result.effects] == ["gravity"]
    assert result.test.after < 1.15 * result.noise.floor
    assert ("repeat the measured tip" in "".join(result.notes)) == (camera != "coarse")
    assert ("out of step" in "".join(result.notes)) == (camera == "out of step")


@pytest.mark.study
def test_without_the_true_effect_no_sibling_is_called_the_explanation() -> None:
    """One effect of several: for others a sibling fits to the noise."""
    result = found("stiffness_anisotropy", "stiffness_anisotropy")
    assert all(c.name != "stiffness_anisotropy" for c in result.tried)
    assert result.verdict in ("not_in_library", "partly_explained")
    assert result.remaining_kind == "static"
    assert result.remaining_fraction > 0.03


@pytest.mark.study
@pytest.mark.parametrize("effect", ["latency", "gravity"])
def test_the_identified_robot_predicts_what_the_report_says(effect: str, tmp_path: Path) -> None:
    """Written, read and replayed: the error on held-out rows is `after`, to the rod's step of settling."""
    result = found(effect)
    again = load_robot(next(p for p in report.write(result, tmp_path) if p.name == "identified.toml"))
    one, two = ([table["name"] for table in each.effects] for each in (again, result.identified))
    assert one == two
    played = replay(sealed(effect)[0], again)
    rms = np.sqrt((played.residual[result.tested] ** 2).sum(1).mean())
    assert rms == pytest.approx(result.test.after, rel=0.01)


@pytest.mark.study
def test_commands_that_are_held_until_the_next_row_are_said_to_look_like_a_delay() -> None:
    log = sealed("none")[0]
    tip = np.concatenate([log.tip_position[:1], log.tip_position[:-1]])
    result = identify(replace(log, tip_position=tip), robot(), threads=1)
    assert value(result, "latency", "delay")[0] == pytest.approx(1.0 / 15.0, rel=0.03)
    assert "is within a row of this log: commands held until the next row look so, too." in result.summary
    assert "within a row" not in found("latency").summary


# On a log of 28 s


@cache
def short() -> Result:
    return identify(backlash_log(), robot(), held_out=["two"], threads=1)


def same(one: Any, two: Any, where: str = "result") -> None:
    """Equal to the last bit, arrays and nan included."""
    if isinstance(one, np.ndarray):
        assert_array_equal(one, two, err_msg=where)
    elif hasattr(one, "__dataclass_fields__"):
        assert type(one) is type(two)
        for field in fields(one):
            same(getattr(one, field.name), getattr(two, field.name), f"{where}.{field.name}")
    elif isinstance(one, dict):
        assert list(one) == list(two), where
        for key in one:
            same(one[key], two[key], f"{where}[{key}]")
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(two), where
        for i, (a, b) in enumerate(zip(one, two, strict=True)):
            same(a, b, f"{where}[{i}]")
    else:
        assert one == two or (one != one and two != two), where


@pytest.mark.study
def test_the_same_log_gives_the_same_result() -> None:
    again = identify(backlash_log(), robot(), held_out=["two"], threads=1)
    same(short(), again)
    assert report.text(short()) == report.text(again)


@pytest.mark.study
def test_play_in_the_wires_is_found_on_a_short_log() -> None:
    assert short().effects[0].name == "backlash"
    said, stderr = value(short(), "backlash", "half_width")
    assert said == pytest.approx(GAP, abs=3.0 * stderr + 1e-5)


@pytest.mark.study
@pytest.mark.parametrize("change", ["noise", "elsewhere"])
def test_no_fit_sees_what_is_held_out(change: str) -> None:
    """Tips of held-out rows are replaced: what was fitted, and what every candidate was worth, stays to the
    last bit. Only the verdict may change, for it is the held-out error's."""
    log = backlash_log()
    rows = log.run == "two"
    tip, noise = log.tip_position.copy(), 1e-4 * np.random.default_rng(9).normal(size=(rows.sum(), 3))
    tip[rows] += noise if change == "noise" else (0.0, 0.02, 0.01)
    one, two = short(), identify(replace(log, tip_position=tip), robot(), held_out=["two"], threads=1)
    assert two.test.after > 1.02 * one.test.after
    same(one.noise, two.noise)
    same(one.before, two.before)
    same(one.path[0].train, two.path[0].train)
    tried = [[(c.name, c.held_out_rms, c.score, c.bic_gain) for c in each.tried] for each in (one, two)]
    same(*tried)
    same(one.remaining, two.remaining)
    if change == "noise":
        same([(e.name, e.parameters) for e in one.effects], [(e.name, e.parameters) for e in two.effects])
        same(one.base_parameters, two.base_parameters)
        same(one.after, two.after)
        assert one.identified == two.identified
    else:
        assert (two.verdict, list(two.effects)) == ("not_in_library", [])


def other(columns: list[int]) -> RunLog:
    log = backlash_log()
    return replace(log, dl=log.dl[:, columns])


def every_other(change: Callable[[Floats], Floats]) -> RunLog:
    """Every other row has another tip: two markers, or two robots."""
    log = backlash_log()
    rows = np.arange(len(log))[:, None] % 2 == 0
    return replace(log, tip_position=np.where(rows, change(log.tip_position), log.tip_position))


def all_rows(**fields: Any) -> RunLog:
    """The log with the same number in every row of these fields."""
    log = backlash_log()
    return replace(log, **{name: np.full_like(getattr(log, name), value) for name, value in fields.items()})


AFAR = "further from robot 'prototype' than from a robot that stands still"
MIXED = "jumps by .* mm from sample to sample while the inputs rest.*two robots or two markers mixed"
UNITS = (
    "than from a robot that stands still: (the model cannot be solved|it moves .* times as predicted).*units"
)
SIGNS = r"it moves -0\.9\d* times as predicted.*signs \(negative = pulled\)"
BAD = {
    "three rows": (lambda: backlash_log().rows(slice(0, 3)), "has 3 measured rows; identification needs 40"),
    "constant input": (lambda: all_rows(dl=1e-3), "no input ever changes; nothing can be learnt"),
    "no tip": (lambda: all_rows(tip_position=np.nan), "there is nothing to explain"),
    "no input": (lambda: all_rows(dl=np.nan), "no row in which every input is there"),
    "a tip that stands still": (lambda: all_rows(tip_position=0.05), "the measured tip never moves"),
    "signs": (lambda: replace(backlash_log(), dl=-backlash_log().dl), SIGNS),
    "columns turned on": (lambda: other([1, 2, 3, 0]), rf"{AFAR}.* in the order 4, 1, 2, 3\. "),
    "columns reversed": (lambda: other([3, 2, 1, 0]), AFAR),
    "millimetres": (lambda: replace(backlash_log(), dl=1e3 * backlash_log().dl), UNITS),
    "two markers": (lambda: every_other(lambda tip: np.add(tip, [0.02, 0.0, 0.0])), MIXED),
    "two robots": (lambda: every_other(lambda tip: 2.0 * tip), MIXED),
}


@pytest.mark.study(beyond=4)
@pytest.mark.parametrize("case", BAD)
def test_a_log_that_cannot_tell_anything_is_refused_in_a_sentence(case: str) -> None:
    make, sentence = BAD[case]
    with pytest.raises(LogError, match=sentence) as caught:
        identify(make(), robot(), threads=1)
    assert "\n" not in str(caught.value)
    assert "small" in str(caught.value)


def test_neighbouring_columns_that_are_swapped_are_refused() -> None:
    """Half of the motion is as predicted, but another order follows it far better."""
    with pytest.raises(LogError, match="times as closely with dl_1 and dl_2 exchanged"):
        identify(other([1, 0, 2, 3]), robot(), threads=1)


def test_too_much_held_out_is_refused() -> None:
    sentence = r"leaves \d+ rows to fit once two, three, one@2: are held out; it needs 40"
    with pytest.raises(LogError, match=sentence):
        identify(backlash_log(), robot(), held_out=["two", "three", "one@2:"], threads=1)


@pytest.mark.study
def test_a_search_that_would_not_end_stops_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "MOST_PASSES", 1.0)
    result = identify(backlash_log(), robot(), threads=1)
    assert list(result.effects) == []
    why = {c.why for c in result.tried if c.kind == "effect"}
    assert why == {"not tried: the model hardly converges on this log"}
    stopped = "the search stopped early: the model hardly converges"
    assert any(note.startswith(stopped) for note in result.notes)
