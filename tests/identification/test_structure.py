"""A robot file with push-pull tendons, of a robot whose tendons can only pull."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments
from numpy.testing import assert_allclose

from fastrod import Robot, Tendon
from fastrod.identification.attribution import identify
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import sample
from fastrod.identification.report.report import table, to_json
from fastrod.identification.report.result import Result
from fastrod.identification.search.structure import NAME, _unopposed, _with_antagonists
from fastrod.logs.runlog import RunLog
from fastrod.model.routing import route

NOISE = 1e-4
TRUE = {"compliance": 2e-4, "pretension": 0.6, "axial_stiffness": 80.0}


def built(*, pulls: bool) -> Robot:
    """Three tendons on drives of their own; those that can only pull on a body that shortens."""
    (segment,) = one_segment().segments
    only = {"compliance": TRUE["compliance"], "pretension": TRUE["pretension"], "unilateral": True}
    tendons = tuple(
        Tendon(offset=0.006, angle=math.radians(a), **(only if pulls else {})) for a in (10.0, 130.0, 250.0)
    )
    body = {"axial_stiffness": TRUE["axial_stiffness"]} if pulls else {}
    whole = replace(segment, tendons=tendons, extension=(0.0, 0.0), **body)
    return replace(one_segment(), segments=(whole,), log_points=())


def measured(*, pulls: bool) -> RunLog:
    """Each tendon is pulled while the others are paid out, more than a bend asks for."""
    t = 0.1 * np.arange(400)
    at = 2.0 * np.pi * (t / 11.0)[:, None] - np.radians([10.0, 130.0, 250.0])
    dl = -4e-3 * np.cos(at) * (0.6 + 0.4 * np.cos(0.31 * t))[:, None]
    dl = np.where(dl > 0.0, 1.6 * dl, dl)
    robot = built(pulls=pulls)
    log = log_of(robot, dl, 0.1)
    model, samples = base_model(robot), sample(log)
    pose = predict(model, model.start, samples, PredictedRod(samples, robot))
    assert pose.ok.all()
    return replace(log, tip_position=pose.position + NOISE * np.random.default_rng(0).normal(size=(400, 3)))


@cache
def found() -> Result:
    """Return what identify says of it with the push-pull file."""
    return identify(measured(pulls=True), built(pulls=False))


@pytest.mark.study
def test_tendons_that_can_only_pull_are_named_first() -> None:
    result = found()
    assert result.effects[0].name == NAME
    assert result.test.before > 10.0 * result.test.after
    assert result.test.after < 1.2 * math.sqrt(3.0) * NOISE


@pytest.mark.study
def test_their_numbers_are_those_that_the_log_was_made_with() -> None:
    result = found()
    (segment,) = result.identified.segments
    assert all(tendon.unilateral for tendon in segment.tendons)
    got = {key: np.mean([getattr(t, key) for t in segment.tendons]) for key in ("compliance", "pretension")}
    got["axial_stiffness"] = segment.axial_stiffness
    assert got == pytest.approx(TRUE, rel=0.1)


@pytest.mark.study
def test_a_report_says_what_was_tried_beside_them() -> None:
    made = to_json(found())
    assert [stage["name"] for stage in made["path"]][:2] == ["base", NAME]
    tried = {c["name"]: c for c in made["candidates"] if c["kind"] == "tendons"}
    assert set(tried) == {NAME, "slack_alone", "shortening_alone", "stretch_alone"}
    assert tried[NAME]["kept"]
    assert table(found())


@pytest.mark.study
def test_what_pulls_to_one_side_is_found_with_its_antagonists() -> None:
    """The file has the two tendons that the motors pull, the robot also the two that they pay out."""
    (segment,) = built(pulls=True).segments
    tendons = tuple(replace(segment.tendons[0], angle=math.radians(a)) for a in (0.0, 180.0, 90.0, 270.0))
    robot = replace(built(pulls=True), segments=(replace(segment, tendons=tendons),))
    t = 0.1 * np.arange(400)
    pull = 4e-3 * np.stack([np.sin(0.7 * t) * np.cos(0.05 * t), np.sin(0.45 * t)], axis=1)
    wiring = route(robot)
    log = log_of(robot, pull[:, wiring.drive] * wiring.drive_sign, 0.1)
    model, samples = base_model(robot), sample(log)
    tip = predict(model, model.start, samples, PredictedRod(samples, robot)).position
    tip = tip + NOISE * np.random.default_rng(1).normal(size=(400, 3))
    plain = tuple(Tendon(offset=0.006, angle=a) for a in (0.0, 0.5 * math.pi))
    body = replace(built(pulls=False).segments[0], tendons=plain)
    result = identify(replace(log, dl=pull, tip_position=tip), replace(robot, segments=(body,)))
    assert result.effects[0].name == NAME
    assert result.identified.n_tendons == 4
    assert result.test.after < 1.2 * math.sqrt(3.0) * NOISE


@pytest.mark.study
def test_push_pull_tendons_stay_what_they_are() -> None:
    result = identify(measured(pulls=False), built(pulls=False))
    assert (result.verdict, result.effects) == ("none", [])


@pytest.mark.parametrize(
    "angles", [(0.0, 90.0), (0.0, 120.0, 240.0), (0.0, 90.0, 180.0, 270.0), (0.0, 180.0)]
)
def test_what_nothing_pulls_back_gets_an_antagonist(angles: tuple[float, ...]) -> None:
    (segment,) = built(pulls=False).segments
    tendons = tuple(Tendon(offset=0.006, angle=math.radians(a)) for a in angles)
    given = replace(built(pulls=False), segments=(replace(segment, tendons=tendons),))
    made, columns = _with_antagonists(given)
    assert not _unopposed(made)
    assert made.n_tendons == (4 if angles == (0.0, 90.0) else len(angles))
    # the commands of the added ones are those that the same bend asks for
    dl = route(given).tendon_change(np.array([[[0.3, -0.2]]]))
    assert_allclose(dl @ columns.T, route(made).tendon_change(np.array([[[0.3, -0.2]]])), atol=1e-12)


def test_a_fit_of_a_tendon_stays_that_tendons() -> None:
    given = two_segments(fit={"tendon.6.gain": {"sd": 0.1}, "tendon.*.angle": {"sd": 0.1}})
    halves = tuple(replace(s, tendons=s.tendons[:2]) for s in given.segments)
    angles = [t.angle for s in halves for t in s.tendons]
    made, _ = _with_antagonists(replace(given, segments=halves, fit={"tendon.3.gain": {"sd": 0.1}}))
    (target,) = made.fit
    number = int(target.split(".")[1])
    assert made.tendons[number - 1].angle == angles[2]
