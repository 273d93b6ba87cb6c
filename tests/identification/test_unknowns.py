"""The unknowns: the words of a robot file, the vector they make, and the robot that a vector makes."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments, wave
from numpy.testing import assert_allclose, assert_array_equal
from rods import rod

from fastrod import Robot
from fastrod.effects.base import columns, effect_names, get_effect
from fastrod.identification.log.base_model import FREE_CAMERA, STIFFNESS_SD, base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.log.unknowns import Model, effect_unknowns
from fastrod.model.robotfile import dumps, loads
from fastrod.model.routing import route


def fitted(robot: Robot, **targets: Any) -> Model:
    """The model of a robot with this `[fit]`; __ in a name stands for a dot, `all` for the wildcard."""
    fit = {name.replace("__", ".").replace("all", "*"): prior for name, prior in targets.items()}
    return base_model(replace(robot, fit=fit))


def names(model: Model) -> list[str]:
    return [u.name for u in model.unknowns]


def at(model: Model, **values: float) -> np.ndarray:
    """The start, with these numbers (in their unit) changed."""
    theta = model.start
    for name, value in values.items():
        j = names(model).index(name.replace("__", ".").replace("all", "*"))
        theta[j] = model.unknowns[j].outside(value)
    return theta


def test_a_robot_that_says_nothing_has_unknown_stiffness() -> None:
    model = base_model(two_segments())
    assert names(model) == ["segment.*.bending_stiffness", "segment.*.torsional_stiffness"]
    assert_array_equal(model.start, [0.0, 0.0])  # logarithms of factors
    mean, sd = model.prior
    assert_array_equal(mean, [0.0, 0.0])
    assert_array_equal(sd, [STIFFNESS_SD] * 2)
    assert_allclose(model.limits, np.log([[0.05, 0.05], [20.0, 20.0]]))
    assert model.effects == ()
    robot = model.robot_at(np.log([1.5, 0.5]))
    for was, now in zip(two_segments().segments, robot.segments, strict=True):
        # both axes
        assert_allclose(now.bending_stiffness, np.multiply(was.bending_stiffness, 1.5), rtol=1e-14)
        assert_allclose(now.torsional_stiffness, 0.5 * was.torsional_stiffness, rtol=1e-14)


@pytest.mark.parametrize(
    ("target", "prior", "found"),
    [
        ("segment.1.length", {"sd": 1e-3}, ["segment.1.length"]),
        ("segment.*.length", {"sd": 1e-3}, ["segment.1.length", "segment.2.length"]),
        ("segment.*.length", {"sd": 1e-3, "shared": True}, ["segment.*.length"]),
        ("segment.2.line_density", {"sd": 0.05}, ["segment.2.line_density"]),
        ("tendon.*.offset", {"sd": 2e-4}, [f"tendon.{k}.offset" for k in range(1, 9)]),
        ("tendon.*.compliance", {"sd": 1e-5, "shared": True}, ["tendon.*.compliance"]),
        ("tendon.3.angle", {"sd": 0.05}, ["tendon.3.angle"]),
        # gains and zeros are of drives, each named by its first wire
        ("tendon.*.gain", {"sd": 0.02}, ["tendon.1.gain", "tendon.2.gain", "tendon.5.gain", "tendon.6.gain"]),
        ("tendon.*.zero", {"sd": 1e-4, "shared": True}, ["tendon.*.zero"]),
        ("tendon.3.zero", {"sd": 1e-4}, ["tendon.1.zero"]),
    ],
)
def test_targets_and_wildcards(target: str, prior: dict[str, Any], found: list[str]) -> None:
    robot = two_segments(fit={target: prior})
    model = base_model(robot)
    assert names(model)[: len(found)] == found
    assert names(model)[len(found) :] == ["segment.*.bending_stiffness", "segment.*.torsional_stiffness"]
    mean, sd = model.prior
    for u, m, s, low, high in zip(model.unknowns, mean, sd, *model.limits, strict=True):
        assert low <= m < high  # a density or a compliance of zero is at its bound
        assert low < high
        assert s > 0.0
        assert u.scale > 0.0
        assert u.inside(u.outside(u.start)) == pytest.approx(u.start)
    unshared = not prior.get("shared")
    if unshared:
        assert_array_equal(sd[: len(found)], prior["sd"])
    # at its start the model is the robot
    nominal, made = replace(robot, effects=()), model.robot_at(model.start)
    for was, now in zip(nominal.segments, made.segments, strict=True):
        assert_allclose(now.length, was.length, rtol=1e-15)
        for one, other in zip(was.tendons, now.tendons, strict=True):
            assert_allclose(other.offset, one.offset, rtol=1e-14)
            assert_allclose(other.angle, one.angle, rtol=1e-14, atol=1e-15)
            assert_allclose(other.compliance, one.compliance, rtol=1e-14)
    assert_array_equal([v for values in model.values(model.start).values() for v in values], 0.0)


def test_stiffness_that_is_named_is_not_added_again() -> None:
    model = fitted(two_segments(), segment__2__bending_stiffness={"sd": 1e-4})
    assert names(model) == ["segment.2.bending_stiffness", "segment.*.torsional_stiffness"]
    robot = model.robot_at(at(model, segment__2__bending_stiffness=0.002))
    # of an anisotropic one the mean is fitted, the ratio stays: nominal (0.0015, 0.002)
    expected = np.array([0.0015, 0.002]) * 0.002 / 0.00175
    assert_allclose(robot.segments[1].bending_stiffness, expected, rtol=1e-14)
    assert robot.segments[0].bending_stiffness == two_segments().segments[0].bending_stiffness


def test_shared_is_the_same_factor_or_the_same_addition() -> None:
    nominal = two_segments()
    model = fitted(
        nominal,
        segment__all__length={"sd": 1.3e-3, "shared": True},
        tendon__all__offset={"sd": 3e-4, "shared": True},
        tendon__all__angle={"sd": 0.05, "shared": True},
    )
    assert names(model)[:3] == ["segment.*.length", "tendon.*.offset", "tendon.*.angle"]
    # the prior of a factor: its sd over the mean of the nominal values
    assert_allclose(model.prior[1][0], 1.3e-3 / 0.065, rtol=1e-14)
    theta = at(model, segment__all__length=1.1, tendon__all__offset=0.9, tendon__all__angle=0.2)
    robot = model.robot_at(theta)
    for was, now in zip(nominal.segments, robot.segments, strict=True):
        assert_allclose(now.length, 1.1 * was.length, rtol=1e-14)
        for one, other in zip(was.tendons, now.tendons, strict=True):
            assert_allclose(other.offset, np.multiply(one.offset, 0.9), rtol=1e-14)
            assert_allclose(other.angle, np.add(one.angle, 0.2), rtol=1e-14)


def test_one_wire_alone_moves_by_what_is_said() -> None:
    nominal = two_segments()
    model = fitted(nominal, tendon__5__offset={"sd": 3e-4}, tendon__6__angle={"sd": 0.05})
    angle = nominal.tendons[5].angle
    robot = model.robot_at(at(model, tendon__5__offset=0.0066, tendon__6__angle=angle[1] - 0.25))
    # a tendon through two segments has its mean fitted: offsets (6, 5) mm by a factor, angles by an addition
    assert_allclose(robot.tendons[4].offset, np.array([0.006, 0.005]) * 0.0066 / 0.0055, rtol=1e-14)
    assert_allclose(robot.tendons[5].angle, np.add(angle, angle[1] - 0.25 - np.mean(angle)), rtol=1e-13)
    assert all(robot.tendons[k] == nominal.tendons[k] for k in (0, 1, 2, 3, 6, 7))


def test_body_radii_and_log_points_stay_where_they_fit() -> None:
    thick = tuple(replace(s, body_radius=0.0078) for s in two_segments().segments)
    nominal = replace(two_segments(), segments=thick, log_points=(0.05, 0.13))
    length, offset = {"sd": 1e-3, "shared": True}, {"sd": 3e-4, "shared": True}
    model = fitted(nominal, segment__all__length=length, tendon__all__offset=offset)
    robot = model.robot_at(at(model, segment__all__length=0.9, tendon__all__offset=1.2))
    assert_allclose(robot.log_points, (0.05, 0.9 * 0.13), rtol=1e-14)
    # 7.5 mm by 1.2; 5 and 6 mm fit
    assert_allclose([s.body_radius for s in robot.segments], [0.009, 0.0078], rtol=1e-12)


def test_the_camera_is_known_unless_it_is_said_not_to_be() -> None:
    assert base_model(one_segment()).effects == ()
    sensor = {"registration_sd": (1e-3, 0.02), "marker_offset_sd": 2e-3, "latency_sd": 0.05}
    model = base_model(one_segment(sensor=sensor))
    assert model.effects == ("latency", "marker_offset", "frame_misalignment")
    sd = dict(zip(names(model), model.prior[1], strict=True))
    for kind, size in (("shift", 1e-3), ("rotation", 0.02)):
        assert [sd[f"frame_misalignment.{kind}_{a}"] for a in "xyz"] == [size] * 3
    assert [sd[f"marker_offset.{a}"] for a in "xyz"] == [2e-3] * 3
    assert sd["latency.delay"] == 0.05
    changed = {"latency__delay": 0.07, "marker_offset__y": 1e-3, "frame_misalignment__rotation_z": 0.01}
    values = model.values(at(model, **changed))
    assert values["latency"].tolist() == [0.07]
    assert values["marker_offset"].tolist() == [0.0, 1e-3, 0.0]
    turned = columns(get_effect("frame_misalignment"), model.wiring).index("rotation_z")
    assert np.flatnonzero(values["frame_misalignment"]).tolist() == [turned]
    free = base_model(one_segment(), free_camera=True)
    assert dict(zip(names(free), free.prior[1], strict=True))["latency.delay"] == FREE_CAMERA["latency_sd"]
    # what is measured is not measured before it happens
    assert model.limits[0][names(model).index("latency.delay")] == 0.0


def test_effects_of_the_robot_are_known_and_those_added_are_not() -> None:
    creep = {"name": "creep", "share": 0.1, "time_constant": 2.0}
    robot = two_segments(effects=(creep, {"name": "drum_gain", "gain": 0.02}))
    model = base_model(robot)
    assert model.effects == ("drum_gain", "creep")
    assert not any("creep" in name for name in names(model))
    more = model.with_effect("friction", {"half_width": 3e-4}, drop=("growth",))
    assert more.effects == ("drum_gain", "friction", "creep")
    starts = [f"friction.start_{k}" for k in (1, 2, 3, 4)]
    assert names(more)[2:] == ["friction.half_width", "friction.presliding", "friction.spread", *starts]
    values = more.values(more.start)
    assert_array_equal(values["creep"], [0.1] * 4 + [2.0])
    assert_array_equal(values["drum_gain"], [0.02] * 4)
    assert_allclose(values["friction"][:4], 3e-4, rtol=1e-12)  # one number for all drives
    assert values["friction"][5] == 0.0  # left out: neutral
    alike = model.with_effect("routing_angle", alike=True)
    assert names(alike)[2:] == ["routing_angle.angle"]
    assert (alike.alike("routing_angle"), more.alike("friction")) == (True, False)
    back = more.without("friction")
    assert (back.effects, names(back)) == (model.effects, names(model))


@pytest.mark.parametrize("name", effect_names())
def test_every_effect_of_the_library_can_be_unknown(name: str) -> None:
    robot = two_segments()
    found = effect_unknowns(name, route(robot))
    model = base_model(robot).with_effect(name)
    low, high = model.limits
    assert (low <= model.start).all()
    assert (model.start <= high).all()
    for u in found:
        assert math.isfinite(u.sd)
        assert u.sd > 0.0
        assert u.bounds[0] <= u.mean <= u.bounds[1]
    starts = {int(column): u.start for u in found for column in u.place[2:]}
    assert sorted(starts) == [*range(len(columns(get_effect(name), route(robot))))]
    values = model.values(model.start)[name]
    assert_allclose(values, [starts[column] for column in sorted(starts)], rtol=1e-12)


def test_the_identified_robot_is_the_prediction_and_survives_its_file() -> None:
    """`identified` as TOML and back is the same robot, and `replay` of it says what the fit said."""
    robot = two_segments(
        fit={
            "segment.*.length": {"sd": 1e-3, "shared": True},
            "tendon.*.gain": {"sd": 0.02},
            "tendon.*.zero": {"sd": 2e-4},
            # a bend in an effect is that of the offsets that are fitted
            "tendon.*.offset": {"sd": 3e-4, "shared": True},
        },
        effects=({"name": "coupling", "from_distal": 0.05},),
    )
    model = base_model(robot).with_effect("stiffening").with_effect("payload")
    model = model.with_effect("tendon_stretch")
    step = 0.5 * np.minimum(model.prior[1], 0.2) * np.random.default_rng(7).normal(size=len(model.unknowns))
    theta = np.clip(model.start + step, *model.limits)
    made = model.identified(theta)
    back = loads(dumps(made))
    assert back == made
    assert [table["name"] for table in back.effects] == list(model.effects)
    # nothing is fitted twice by accident: a new base model of it starts where this one ended
    again = base_model(back)
    for name, values in again.values(again.start).items():
        if name not in ("drum_gain", "encoder_offset"):  # these its [fit] still frees
            assert_allclose(values, model.values(theta)[name], rtol=1e-12)
    log = log_of(robot, wave(robot, 25), tip_force=np.tile([0.01, -0.02, 0.0], (25, 1)))
    samples = sample(log)
    reported = predict(model, theta, samples, PredictedRod(samples, robot))
    assert reported.ok.all()
    shown = replay(log, back)
    assert shown.converged.all()
    # both to 1e-8 of the length, but with other numbers of integration steps
    assert_allclose(shown.tip_position, reported.position, atol=5e-6)
    assert np.abs(replay(log, robot).tip_position - reported.position).max() > 1e-3


@pytest.mark.parametrize(
    "name", ["marker_offset", "frame_misalignment", "time_drift", "creep", "temperature"]
)
def test_replay_of_the_identified_robot_knows_camera_memory_and_time(name: str) -> None:
    robot = two_segments()
    model = base_model(robot).with_effect(name)
    log = log_of(robot, wave(robot, 25))
    samples = sample(log)
    reported = predict(model, model.start, samples, PredictedRod(samples, robot))
    assert_allclose(replay(log, model.identified(model.start)).tip_position, reported.position, atol=5e-6)


def test_a_passive_robot_has_a_model_too() -> None:
    model = base_model(rod("passive"))
    assert names(model) == ["segment.*.bending_stiffness", "segment.*.torsional_stiffness"]
    assert model.robot_at(model.start).n_tendons == 0
