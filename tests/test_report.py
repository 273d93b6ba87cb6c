"""The report of an identification: the contract's keys, one offline page, whole files, friendly units."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import replace
from html import escape, unescape
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from reportlog import backlash_log

from fastrod.effects.base import effect_names
from fastrod.identification.attribution import identify
from fastrod.identification.report import report, wording
from fastrod.identification.report.page import page
from fastrod.identification.report.result import Found, Result
from fastrod.identification.report.signals import Signals
from fastrod.identification.search.model_selection import DetectionLimit
from fastrod.identification.search.residual_test import ResidualStructure
from fastrod.identification.search.solve import Estimate
from fastrod.model.robotfile import load_robot
from fastrod.simulator import Simulator

NAN = float("nan")


@pytest.fixture(scope="module")
def result() -> Result:
    return identify(backlash_log(), load_robot("prototype"), held_out=["two"], max_effects=1)


@pytest.fixture(scope="module")
def html(result: Result) -> str:
    return page(result)


def found(
    name: str, title: str, gain: float, evidence: Any = None, others: Any = (), **parameters: Estimate
) -> Found:
    return Found(
        name=name,
        title=title,
        parameters=parameters,
        held_out_gain=gain,
        evidence=evidence or {},
        cannot_be_told_from=[*others],
    )


def wild(result: Result) -> Result:
    """The same with all that may turn up: three effects, odd text, nan, marks."""
    delay = Estimate(value=0.043, stderr=0.002, unit="s", identifiable=True, prior_sd=0.1, at_bound=True)
    mass = Estimate(value=0.012, stderr=NAN, unit="kg", identifiable=True, prior_sd=NAN)
    more = [
        found("latency", "Delay <b> & more", 0.04, {"z": NAN}, ["second_order_lag"], delay=delay),
        found("payload", "Mass", 0.2, mass=mass),
    ]
    gain = Estimate(value=0.0, stderr=0.3, unit="", identifiable=False, why="no <load>", prior_sd=0.3)
    return replace(
        result,
        log=replace(result.log, name="a <script>alert(1)</script> & $x$"),
        effects=[*result.effects, *more],
        base_parameters={**result.base_parameters, "tendon.1.gain": gain},
        remaining=ResidualStructure(0.1, 0.05, 0.02, 0.01, 3.0),
        remaining_kind="static",
        remaining_fraction=0.12,
        patterns=["it <jumps>"],
        test=replace(result.test, interval=(NAN, NAN)),
        advice=["turn <it>"],
        notes=["odd & even"],
        verdict="partly_explained",
        network={"held_out_rms_m": 0.0003, "inputs": 40.0},
    )


KEYS = (
    "log robot n_samples held_out noise_floor_m error verdict effects base_parameters remaining candidates "
    "advice bounds path patterns summary notes correlation"
)


@pytest.mark.study
def test_json_has_the_keys_and_types_of_the_contract(result: Result) -> None:
    made = report.to_json(result)
    assert set(made) >= set(KEYS.split())
    head = [made[key] for key in ("log", "robot", "n_samples", "held_out")]
    assert head == ["small", "prototype", 420, ["two"]]
    assert made["noise_floor_m"] == result.noise.floor
    assert set(made["error"]["train"]) == {"shipped_rms_m", "before_rms_m", "after_rms_m"}
    assert set(made["error"]["held_out"]) == {*made["error"]["train"], "interval_m", "all_rows_rms_m"}
    low, high = made["error"]["held_out"]["interval_m"]
    assert low < made["error"]["held_out"]["after_rms_m"] < high
    assert made["verdict"] in ("none", "explained", "partly_explained", "ambiguous", "not_in_library")
    (effect,) = made["effects"]
    assert effect["name"] == "backlash"
    assert set(effect) >= {"name", "parameters", "held_out_gain", "evidence", "cannot_be_told_from"}
    assert set(effect["parameters"]["half_width"]) >= {"value", "stderr", "unit", "identifiable"}
    assert_allclose(effect["parameters"]["half_width"]["value"], 3e-4, atol=2e-5)
    numbers = made["base_parameters"].values()
    assert all(set(e) >= {"value", "stderr", "unit", "identifiable", "why"} for e in numbers)
    assert set(made["remaining"]) >= {"structured_fraction", "kind"}
    assert made["remaining"]["kind"] in ("none", "static", "memory", "drift", "unknown")
    assert all(set(c) >= {"name", "held_out_rms_m", "score", "kept", "why"} for c in made["candidates"])
    assert [c["name"] for c in made["candidates"] if c["kept"]] == ["backlash"]
    assert len(made["correlation"]["matrix"]) == len(made["correlation"]["names"])
    assert [stage["name"] for stage in made["path"]] == ["base", "backlash"]


@pytest.mark.study
def test_json_holds_plain_values_and_null_for_what_is_no_number(result: Result) -> None:
    def check(value: Any) -> None:
        assert type(value) in (dict, list, str, int, float, bool, type(None)), value
        assert not isinstance(value, float) or math.isfinite(value)
        for inner in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
            check(inner)

    made = report.to_json(wild(result))
    check(made)
    assert made["error"]["held_out"]["interval_m"] == [None, None]
    assert made["effects"][1]["evidence"]["z"] is None
    assert json.loads(report.text(wild(result))) == made


class Reader(HTMLParser):
    """Collects attributes, text and whether every element is closed."""

    void = frozenset(("meta", "br", "img", "link", "input"))

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.addresses: list[str] = []
        self.tags: set[str] = set()
        self.ids: list[str] = []
        self.words = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.add(tag)
        places = ("src", "href", "xlink:href", "srcset", "data", "action")
        self.addresses += [value or "" for name, value in attrs if name in places]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        if tag not in self.void:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in self.void:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] != "style":
            self.words += data


@pytest.mark.study
def test_page_is_one_offline_file(html: str) -> None:
    read = Reader(html)
    assert read.open == []
    assert all(address.startswith(("#", "data:image/png;base64,")) for address in read.addresses)
    assert not re.search(r"https?:|@import|url\((?!#)", html)
    assert not read.tags & {"script", "link", "iframe", "object"}
    assert len(html) < 1_500_000
    inside = {address[1:] for address in read.addresses if address.startswith("#")}
    inside |= set(re.findall(r"url\(#([^)]*)\)", html))
    assert inside <= set(read.ids)  # no figure took another one's names


@pytest.mark.study
def test_page_says_verdict_effects_and_what_to_run(result: Result, html: str) -> None:
    words = Reader(html).words
    assert all(sentence in words for sentence in re.split(r"(?<=\.) (?=[A-Z])", result.summary))
    assert wording.VERDICTS[result.verdict] in words
    half_width = result.effects[0].parameters["half_width"]
    assert wording.with_error(half_width.value, half_width.stderr, "m") in words
    for text in (wording.law("backlash")["Equation"], wording.law("backlash")["Source"], *result.advice):
        assert text in words
    assert f"noise floor {1e3 * result.noise.floor:.3g} mm" in words
    assert html.count("<svg") == 8
    for title in ("before", "after", "lag [s]", "measured, held out", "commanded bend"):
        assert title in words


@pytest.mark.study
def test_page_escapes_what_others_wrote_and_takes_what_is_missing(result: Result) -> None:
    html = page(wild(result))
    read = Reader(html)
    assert read.open == []
    assert "script" not in read.tags
    assert escape("a <script>alert(1)</script> & $x$") in html
    odd = ("Delay <b> & more", "it <jumps>", "turn <it>", "odd & even", "no <load>")
    for text in (*odd, "at bound", "second order lag", "43.0 ± 2.0 ms"):
        assert text in read.words, text
    plain = unescape(re.sub(r"base64,[^\"]*|<style.*?</style>", "", html, flags=re.DOTALL))
    assert "nan" not in plain.lower()


@pytest.mark.study
def test_page_without_effects_shows_the_base_model_alone(result: Result) -> None:
    bare = replace(result, effects=[], path=result.path[:1], after=result.before, tried=[], bounds=[])
    bare = replace(bare, correlation=(["a"], np.ones((1, 1))), advice=[], summary="No effect explains it.")
    words = Reader(page(replace(bare, verdict="not_in_library", patterns=["the tip jumps"]))).words
    assert "the tip jumps" in words
    assert "base model" in words
    assert "Before and after" not in words
    assert "Correlations" not in words


@pytest.mark.study
def test_files_are_written_whole(result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = report.write(result, tmp_path / "out")
    assert [path.name for path in written] == ["report.json", "report.html", "identified.toml"]
    assert sorted((tmp_path / "out").iterdir()) == sorted(written)
    before = (tmp_path / "out" / "report.html").read_bytes()
    assert report.write(result, tmp_path / "out") == written
    assert (tmp_path / "out" / "report.html").read_bytes() == before  # deterministic

    def fails(self: Path, *args: Any, **given: Any) -> int:
        self.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", fails)
    with pytest.raises(OSError, match="No space"):
        report.write(result, tmp_path / "out")
    assert (tmp_path / "out" / "report.html").read_bytes() == before
    assert not list((tmp_path / "out").glob("*.part"))


@pytest.mark.study
def test_identified_robot_loads_and_simulates(result: Result, tmp_path: Path) -> None:
    robot = load_robot(report.write(result, tmp_path)[2])
    assert "backlash" in (tmp_path / "identified.toml").read_text()
    state = Simulator(robot, n_robots=1, dt=0.05).step(robot.rest_tendon_length)
    assert np.isfinite(state.tip_position).all()


@pytest.mark.study
def test_terminal_table_fits_80_columns(result: Result) -> None:
    from rich.console import Console

    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(report.table(wild(result)))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= 80
    words = (
        "tip error, rms [mm]",
        "backlash",
        "half width",
        "latency cannot be distinguished from second order lag",
    )
    for word in (*words, "run next: turn <it>"):
        assert word in text, word


@pytest.mark.study
@pytest.mark.parametrize("name", effect_names())
def test_every_effect_has_a_signal(result: Result, name: str) -> None:
    value = Estimate(value=1.0, stderr=0.1, unit="", identifiable=True)
    view = Signals(result).view(found(name, "", 1.0, x=value, y=value, time_constant=value))
    assert len(view.rows) == len(view.signal) == len(view.before) == len(view.after) > 0.2 * 420
    assert np.isfinite([view.signal, view.before, view.after]).all()


@pytest.mark.study
def test_backlash_is_drawn_as_loops_that_close(result: Result) -> None:
    view = Signals(result).view(result.effects[0])
    assert view.connected
    assert np.std(view.after) < 0.4 * np.std(view.before)


FRIENDLY = {
    (0.0048, "kg"): "4.8 g",
    (3.6e-6, "m"): "3.6 µm",
    (0.00034, "m"): "0.34 mm",
    (0.0023, "rad"): "0.13°",
    (0.00052, "s"): "0.52 ms",
    (15.0, "s"): "15 s",
    (0.0014, ""): "0.14 %",
    (0.3, "N"): "0.30 N",
    (0.0068, "N"): "6.8 mN",
    (0.372, "kg/m"): "370 g/m",
    (2.2e-7, "m/s"): "0.013 mm/min",
    (-0.01, "rad"): "−0.57°",
    (0.0, "m"): "0 µm",
    (NAN, "m"): "–",
    (2.0, "V"): "2.0 V",
}


def test_numbers_are_said_in_friendly_units() -> None:
    assert {key: wording.amount(*key) for key in FRIENDLY} == FRIENDLY
    assert wording.with_error(0.00034284, 2.7e-6, "m") == "0.3428 ± 0.0027 mm"
    assert wording.with_error(0.372, 0.0, "kg/m") == "372 g/m"
    assert [wording.percent(s) for s in (0.12, 0.04, 0.0, 1.0, NAN)] == ["12 %", "4.0 %", "0 %", "100 %", "–"]
    assert wording.plain_name("segment.*.bending_stiffness") == "bending stiffness, all segments"
    assert wording.plain_name("tendon.2.gain") == "gain, tendon 2"


BOUNDS = {
    DetectionLimit("payload", "mass", "kg", 0.007): "payload: a mass above 7.0 g",
    DetectionLimit("encoder_offset", "offset_1", "m", 1e-4): "encoder offset: an offset above 0.10 mm",
    DetectionLimit("tip_force", "x", "N", 0.2): "tip force: a component along x above 0.20 N",
}


def test_bounds_are_sentences() -> None:
    for bound, words in BOUNDS.items():
        assert wording.bound_sentence(bound) == f"{words} would have shown"
    none = wording.bound_sentence(DetectionLimit("axial_compression", "per_bend", "1/rad", NAN))
    assert none.startswith("this log cannot show axial compression")
