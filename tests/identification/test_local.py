"""The model near a reference, against the model itself."""

from __future__ import annotations

from dataclasses import replace
from functools import cache, reduce
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, two_segments, wave
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from fastrod import Robot
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import PredictedRod, predict
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.log.unknowns import Model
from fastrod.identification.search.linearised import LinearisedModel, target_of

N = 40
SIGMA = np.array([2e-4, 3e-4, 4e-4])


def robot() -> Robot:
    return two_segments(
        fit={"segment.*.length": {"sd": 1e-3, "shared": True}, "tendon.*.gain": {"sd": 0.02}},
        sensor={"marker_offset_sd": 2e-3, "registration_sd": (1e-3, 0.02)},
    )


def samples() -> LogSamples:
    """Loads, two base orientations, a measured tip some tenths of a millimetre from the nominal one."""
    turned = Rotation.from_rotvec(np.where(np.arange(N)[:, None] < N // 2, 0.0, [0.9, -0.5, 0.3]))
    inputs: dict[str, Any] = {
        "payload": np.where(np.arange(N) % 20 < 10, 0.0, 0.02),
        "base_quaternion": turned.as_quat(scalar_first=True),
    }
    bare = sample(log_of(two_segments(), wave(two_segments(), N), 0.1, points=np.zeros((N, 2, 3)), **inputs))
    model = base_model(two_segments())
    pose = predict(model, model.start, bare, PredictedRod(bare, two_segments(), points=True))
    rng = np.random.default_rng(3)
    tip = pose.position + SIGMA * rng.normal(size=(N, 3))
    turn = Rotation.from_rotvec(0.01 * rng.normal(size=(N, 3))) * Rotation.from_matrix(pose.rotation)
    points = pose.points + SIGMA * rng.normal(size=(N, 2, 3))
    points[4, 1] = np.nan  # a marker that was hidden
    inputs |= {"tip_quaternion": turn.as_quat(scalar_first=True), "points": points}
    return sample(log_of(two_segments(), wave(two_segments(), N), 0.1, tip_position=tip, **inputs))


class Place:
    """A reference, and everything at it."""

    def __init__(self, *effects: str, size: float = 0.0) -> None:
        """With effects of a `size`, in their scales."""
        self.model = reduce(Model.with_effect, effects, base_model(robot()))
        sizes = [size * u.scale * (u.place[0] == "effect" and not u.shape) for u in self.model.unknowns]
        self.theta = self.model.start + sizes
        self.samples = samples()
        self.rod = PredictedRod(self.samples, self.model.robot, points=True)
        self.target = target_of(self.samples, SIGMA, rotation_sigma=0.01, points=True)
        self.linearised = LinearisedModel(self.model, self.theta, self.samples, self.rod, self.target)

    def exact(self, model: Model, theta: np.ndarray) -> np.ndarray:
        # again from where it ended: within the tolerance of one solution, it hangs on what came before
        predict(model, theta, self.samples, self.rod)
        pose = predict(model, theta, self.samples, self.rod)
        assert pose.ok.all()
        return self.target.residual(pose)


@cache
def base() -> Place:
    return Place()


@cache
def with_memory() -> Place:
    return Place("friction", "creep", "tendon_stretch")


@pytest.mark.parametrize("place", [base, with_memory])
def test_at_the_reference_it_is_the_model(place: Any) -> None:
    here = place()
    found, exact = here.linearised.residual(here.model, here.theta), here.exact(here.model, here.theta)
    assert found.shape == (N, 3 + 3 + 6)
    # the rod is settled to 1e-8 of 0.13 m, which is 1e-5 sigma
    assert_allclose(found, exact, atol=1e-4)
    assert np.abs(found).max() > 1.0
    assert_array_equal(found[4, 9:], 0.0)  # a hidden marker says nothing


def exact_slopes(here: Place, model: Model, theta: np.ndarray, j: int) -> np.ndarray:
    """Central difference of exact predictions, over a fifth of the local one's step."""
    step = 0.01 if model.unknowns[j].log else 0.01 * model.unknowns[j].scale
    ends = [here.exact(model, theta + side * step * np.eye(len(theta))[j]) for side in (1.0, -1.0)]
    return (ends[1] - ends[0]) / (2.0 * step)


# What a local slope may be off by, as a fraction of the exact one (root mean square over rows and numbers
# seen): tendons go through the rod by one-sided differences of 2 mrad, the camera by none;
LENGTHS = "drum_gain encoder_offset coupling slack stiffening temperature tendon_interaction"
TENDONS = dict.fromkeys(LENGTHS.split(), 0.004)
CAMERA = dict.fromkeys(
    ["marker_offset", "frame_misalignment", "lens", "camera_scale", "time_drift", "rotation_drift"], 1e-4
)
# but for a time constant, by a one-sided difference of 2e-3 of its logarithm;
CAMERA |= {"settling_drift": 1e-3}
# a force from the tip by one-sided differences of 2e-3 EI / l^2, and from there on linear: a twentieth of a
# typical payload here;
FORCE = dict.fromkeys(["payload", "tip_force"], 0.02)
# operators have corners, which the local difference of a fiftieth of a typical size looks over: play has
# nothing but corners, and an oscillator that is sampled more slowly than it rings answers to its period at
# any phase;
MEMORY = {"latency": 0.015, "backlash": 0.15, "friction": 0.01, "creep": 0.004, "plastic_set": 0.006}
MEMORY |= {"second_order_lag": 0.15}
# and what changes the rod by a one-sided difference of a twentieth of a typical size.
RODS = "gravity tendon_stretch routing_angle axial_compression precurvature stiffness_taper"
ROD = dict.fromkeys([*RODS.split(), "stiffness_anisotropy"], 0.015)
NOTHING = 0.01  # sigma, by a typical size: a slope that small is not compared; nobody can see it


def assert_slopes(
    here: Place, model: Model, theta: np.ndarray, first: int, tolerance: dict[str, float]
) -> None:
    residual = here.linearised.residual(model, theta)
    J = here.linearised.slopes(model, theta, residual)
    assert J.shape == (*residual.shape, len(theta))
    seen = 0
    for j in range(first, len(theta)):
        unknown = model.unknowns[j]
        exact = exact_slopes(here, model, theta, j)
        unit = 1.0 if unknown.log else unknown.scale
        if np.abs(exact).max() * unit < NOTHING:
            assert np.abs(J[..., j]).max() * unit < 2.0 * NOTHING, unknown.name
            continue
        seen += 1
        error = np.sqrt(((J[..., j] - exact) ** 2).sum() / (exact**2).sum())
        assert error < tolerance[unknown.place[1]], f"{unknown.name}: {error:.4f}"
    assert seen > 0


def near_neutral(name: str) -> tuple[Place, Model, np.ndarray, int]:
    """The base's reference and a candidate at hardly anything: a twentieth of its typical size, its shape
    where a fit starts. The lag as a fit starts it: a period far below the time between samples rings at any
    phase."""
    here = base()
    model = here.model.without(name).with_effect(name)
    first = len(model.without(name).unknowns)
    others = [u.place[:2] != ("effect", name) for u in here.model.unknowns]
    theta = np.concatenate([here.theta[others], model.start[first:]])
    for j in range(first, len(theta)):
        unknown = model.unknowns[j]
        if name == "second_order_lag":
            theta[j] = unknown.outside({"period": 0.16, "damping": 0.6}[unknown.name.partition(".")[2]])
        elif not unknown.shape:
            theta[j] = unknown.mean + 0.05 * unknown.scale
    return here, model, theta, first


def test_slopes_of_the_base_parameters() -> None:
    """By one-sided differences of a twentieth of their scale."""
    here, own = base(), {"bending_stiffness": 0.004, "torsional_stiffness": 0.004, "length": 0.01}
    assert_slopes(here, here.model, here.theta, 0, own | TENDONS | CAMERA)


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("name", [*TENDONS, *CAMERA, *FORCE, *MEMORY])
def test_slopes_of_effects_that_need_no_rod(name: str) -> None:
    here, model, theta, first = near_neutral(name)
    before = here.rod.work.batches
    here.linearised.slopes(model, theta, here.linearised.residual(model, theta))
    assert here.rod.work.batches - before <= 4 + 3  # at most what `by_length` and `by_force` took, once
    assert_slopes(here, model, theta, first, TENDONS | CAMERA | FORCE | MEMORY)


@pytest.mark.parametrize("name", ROD)
def test_slopes_of_effects_that_the_reference_has(name: str) -> None:
    here = Place(name, size=1.0)
    assert_slopes(here, here.model, here.theta, len(base().theta), ROD)


@pytest.mark.parametrize("name", ROD)
def test_one_effect_on_the_rod_is_exact_at_its_typical_size(name: str) -> None:
    """Of a candidate slopes are secants over that: their other end, one parameter at a time."""
    here = base()
    first = len(here.theta)
    model = here.model.with_effect(name)
    for j in range(first, len(model.unknowns)):
        theta = np.concatenate([here.theta, [u.mean for u in model.unknowns[first:]]])
        theta[j] += model.unknowns[j].scale
        found, exact = here.linearised.residual(model, theta), here.exact(model, theta)
        # but for the rotation of what the camera sees, which is exact to the third order of a vector
        assert_allclose(found, exact, atol=2e-3)


def test_the_local_model_errs_by_the_square_of_the_distance() -> None:
    """Tendons, forces and camera together: half the way, a quarter of the error."""
    here = base()
    first = len(here.theta)
    model = here.model.with_effect("payload").with_effect("stiffening").with_effect("lens")
    errors = []
    for fraction in (1.0, 0.5):
        theta = np.concatenate([here.theta, [u.mean + fraction * u.scale for u in model.unknowns[first:]]])
        exact = here.exact(model, theta)
        errors.append(np.sqrt(((here.linearised.residual(model, theta) - exact) ** 2).mean()))
    assert 3.0 < errors[0] / errors[1] < 5.0
    assert errors[1] < 0.1 * np.sqrt(((exact - here.exact(here.model, here.theta)) ** 2).mean())


def test_a_local_fit_finds_what_was_planted() -> None:
    """A gain and a marker, planted exactly: the fit comes to them as near as the noise lets it."""
    here = base()
    true = here.theta.copy()
    place = [u.name for u in here.model.unknowns].index("tendon.1.gain")
    true[place] = 0.03
    pose = predict(here.model, true, here.samples, here.rod)
    tip = pose.position + SIGMA * np.random.default_rng(8).normal(size=(N, 3))
    target = target_of(here.samples, SIGMA, rotation_sigma=0.01, points=False)
    target = replace(target, tip=tip, rotation=None)
    assert len(here.samples.log) == N
    rod = PredictedRod(here.samples, here.model.robot, points=True)
    fit = LinearisedModel(here.model, here.theta, here.samples, rod, target).fit(here.model, here.theta, 20)
    error = np.sqrt(np.diag(np.linalg.inv(fit.hessian)))
    assert abs(fit.theta[place] - true[place]) < 3.0 * error[place]
    assert error[place] < 0.02  # the data say more than the prior
    assert fit.loss < 1.2 * N * 3


def test_rows_that_do_not_count() -> None:
    """Outliers and rows that did not converge have no residual and no slope."""
    here = base()
    target = target_of(here.samples, SIGMA, rotation_sigma=0.01, points=True)
    target = replace(target, weight=np.where(np.arange(N) == 7, 0.0, 1.0))
    pose = predict(here.model, here.theta, here.samples, here.rod)
    ok = pose.ok.copy()
    ok[9] = False
    residual = target.residual(pose._replace(ok=ok))
    assert_array_equal(residual[[7, 9]], 0.0)
    others = np.delete(np.arange(N), [7, 9])
    assert_array_equal(residual[others], here.target.residual(pose)[others])
