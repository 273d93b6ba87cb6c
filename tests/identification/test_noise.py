"""Noise of known size, read back; outliers of known places, found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from identification.logs import displacement_of, log_of, one_segment
from numpy.testing import assert_allclose, assert_array_equal
from reportlog import backlash_log

from fastrod.identification.log.autoregression import AutoRegression
from fastrod.identification.log.camera import earlier, pictures, repeated, sentences
from fastrod.identification.log.noise import Noise, at_rest, keep, read_noise
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.model.robotfile import load_robot

SIGMA = np.array([2e-4, 3e-4, 5e-4])
RATE = 15.0
N = 1800  # two minutes
LONG = 2250  # as long as a designed run
REST = (slice(0, 360), slice(1200, 1560))


def samples(n: int = N, *, rests: bool = True) -> LogSamples:
    """Two minutes at 15 Hz: 24 s of rest, motion, 24 s of rest, motion; or motion alone."""
    robot = one_segment()
    moving = np.ones(n)
    if rests:
        for part in REST:
            moving[part] = 0.0
    angle = np.cumsum(moving) / RATE
    bends = 0.8 * np.stack([np.sin(1.3 * angle), np.sin(0.9 * angle)], axis=1)[:, None]
    return sample(log_of(robot, displacement_of(robot, bends), 1.0 / RATE))


def smooth(seed: int, n: int = N) -> np.ndarray:
    """(n, 3) what the model lacks: slow, some sigma large."""
    phase = np.random.default_rng(seed).uniform(0.0, 6.0, 3)
    return 4.0 * SIGMA * np.sin(np.array([0.5, 0.8, 1.1]) * np.arange(n)[:, None] / RATE + phase)


def white(seed: int, n: int = N) -> np.ndarray:
    return SIGMA * np.random.default_rng(seed).normal(size=(n, 3))


def spoilt(noise: np.ndarray, fraction: float, seed: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """The noise with outliers of one to two times `size` sigma along each axis, and which rows they are."""
    rng = np.random.default_rng(seed)
    bad = rng.random(len(noise)) < fraction
    way = rng.uniform(1.0, 2.0, noise.shape) * rng.choice([-1.0, 1.0], noise.shape)
    return noise + np.where(bad[:, None], size * SIGMA * way, 0.0), bad


def test_rest_is_where_no_input_moves() -> None:
    found = at_rest(samples())
    assert len(found) == 2
    for rows, part in zip(found, REST, strict=True):
        assert part.start <= rows[0]
        assert rows[0] <= part.start + RATE + 1  # the first second does not count: the robot may still ring
        assert rows[-1] == part.stop - 1
        assert (np.diff(rows) == 1).all()
    assert at_rest(samples(rests=False)) == []
    # a load that is hung on is a motion, and so is a new run
    t, run = 0.1 * np.array([*range(40), *range(20)]), np.repeat(["a", "a", "b"], 20)
    still = log_of(one_segment(), np.zeros((60, 4)), t=t, run=run, payload=np.repeat([0.0, 0.02], 30))
    assert [(rows[0], rows[-1]) for rows in at_rest(sample(still))] == [(10, 29), (50, 59)]


@pytest.mark.parametrize("seed", range(6))
def test_noise_at_rest(seed: int) -> None:
    """Some 690 samples: known to 1 / sqrt(1380) = 2.7 %; a slow drift of the camera is no noise."""
    drift = np.linspace(0.0, 20.0, N)[:, None] * SIGMA
    found = read_noise(samples(), white(seed) + drift, np.zeros((N, 3)))
    assert "at rest" in found.how
    assert_allclose(found.sigma, SIGMA, rtol=0.1)
    assert abs(found.lag1) < 0.08  # 3.5 / sqrt(3 x 690)
    assert_allclose(found.floor, np.linalg.norm(SIGMA), rtol=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_noise_without_rest(seed: int) -> None:
    """The fastest part of a residual with slow structure is its noise: a median of 2250 third differences,
    3 to 4 %."""
    residual = white(seed, LONG) + smooth(seed, LONG)
    found = read_noise(samples(LONG, rests=False), np.zeros((LONG, 3)), residual)
    assert "never rests" in found.how
    assert_allclose(found.sigma, SIGMA, rtol=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_noise_at_rest_with_outliers(seed: int) -> None:
    """A tenth of the samples is twenty to forty sigma off."""
    tip, _ = spoilt(white(seed), 0.1, 100 + seed, 20.0)
    found = read_noise(samples(), tip, np.zeros((N, 3)))
    assert_allclose(found.sigma, SIGMA, rtol=0.1)


@pytest.mark.parametrize("seed", range(6))
def test_noise_without_rest_with_outliers(seed: int) -> None:
    """Each outlier spoils four third differences, in all 1 - 0.9^4 of them: their median is the 0.76 quantile
    of the good ones, and the noise reads 1.74 times too large at worst; never too small."""
    residual, _ = spoilt(white(seed, LONG) + smooth(seed, LONG), 0.1, 100 + seed, 20.0)
    found = read_noise(samples(LONG, rests=False), np.zeros((LONG, 3)), residual)
    assert (found.sigma > 0.9 * SIGMA).all()
    assert (found.sigma < 1.74 * 1.1 * SIGMA).all()


def test_noise_alone_exceeds_its_limit_once_in_forty_times() -> None:
    """The limit over 4000 means of 200 rows in three axes is exceeded by 2.3 % (to 0.24 %); coloured rows
    are fewer."""
    white = Noise(np.ones(3), 0.0, "given")
    x = np.random.default_rng(0).normal(size=(4000, 200, 3))
    above = np.mean(np.sqrt((x**2).sum(2).mean(1)) > white.most(200))
    assert_allclose(above, 0.023, atol=0.01)
    slow = Noise(np.ones(3), 0.9, "given", AutoRegression((0.9,)))
    assert_allclose(slow.most(1900) - slow.floor, white.most(100) - white.floor, rtol=5e-3)
    assert white.floor < white.most(10_000) < 1.01 * white.floor
    assert Noise(np.ones(3), 0.0, "given", uncertainty=0.1).most(10_000) > 1.2 * white.floor


def test_what_sways_at_rest_is_no_noise() -> None:
    """A line of half a hertz, three sigma, is told from broad noise and taken off."""
    t = np.arange(N)[:, None] / RATE
    found = read_noise(samples(), white(3) + 3.0 * SIGMA * np.sin(2.0 * np.pi * 0.5 * t), np.zeros((N, 3)))
    assert_allclose(found.sway, 0.5, atol=0.005)
    assert "less a line at 0.5 Hz" in found.how
    assert found.model.order == 0
    assert_allclose(found.sigma, SIGMA, rtol=0.1)


def alike(rho: float, seed: int, n: int = N) -> np.ndarray:
    """(n, 3) each sample `rho` times the one before plus news, of SIGMA in all."""
    e = np.sqrt(1.0 - rho**2) * np.random.default_rng(seed).normal(size=(n, 3))
    e[0] /= np.sqrt(1.0 - rho**2)
    for i in range(1, n):
        e[i] += rho * e[i - 1]
    return SIGMA * e


@pytest.mark.study
@pytest.mark.parametrize("rho", [0.5, 0.8, 0.95])
def test_coloured_noise_is_read_as_large_as_it_is(rho: float) -> None:
    """Its variance is known from 690 (1 - rho^2) / (1 + rho^2) samples an axis, in the mean over six logs to
    4 % at 0.95; one of (1 + rho) / (1 - rho) samples is independent."""
    every = [read_noise(samples(), alike(rho, seed), np.zeros((N, 3))) for seed in range(6)]
    assert_allclose(np.mean([n.floor for n in every]), np.linalg.norm(SIGMA), rtol=0.1)
    length = (1.0 + rho) / (1.0 - rho)
    assert_allclose(np.median([n.model.length for n in every]), length, rtol=0.35)
    assert all("coloured" in n.how and not np.isfinite(n.sway) for n in every)
    assert_allclose([n.lag1 for n in every], rho, atol=0.06)


def test_rows_that_are_left_out_are_less_alike() -> None:
    """Every third row: rho^3 from one to the next."""
    found = read_noise(samples(), alike(0.8, 1), np.zeros((N, 3)))
    thinned = samples().on(np.arange(0, N, 3))
    assert_allclose(found.row_correlation(thinned)[1], found.lag1**3, rtol=0.02)
    assert found.row_correlation(samples())[1] == found.lag1
    white_one = read_noise(samples(), white(1), np.zeros((N, 3)))
    assert len(white_one.row_correlation(samples())) == 1


def test_a_robot_that_never_rests_hides_slow_noise_and_says_so() -> None:
    found = read_noise(samples(rests=False), np.zeros((N, 3)), alike(0.9, 2))
    assert "slow noise cannot be seen" in found.how


def test_a_short_log_still_has_a_noise() -> None:
    few = sample(log_of(one_segment(), np.zeros((3, 4))))
    assert (read_noise(few, np.zeros((3, 3)), np.zeros((3, 3))).sigma > 0.0).all()


@pytest.mark.parametrize("seed", range(4))
def test_planted_outliers_are_found_and_good_rows_kept(seed: int) -> None:
    """A twentieth of the rows, twenty sigma and more off, on a residual that itself wanders by four sigma."""
    residual, bad = spoilt(white(seed) + smooth(seed), 0.05, 50 + seed, 20.0)
    good = keep(samples(), residual, Noise(SIGMA, 0.0, "known"))
    assert not good[bad].any()
    assert good[~bad].mean() >= 0.98
    # and where nothing is planted hardly anything goes: 5 sigma, with a spread from 15 samples
    assert keep(samples(), white(seed) + smooth(seed), Noise(SIGMA, 0.0, "known")).mean() >= 0.995


def test_outliers_are_looked_for_in_each_run_alone() -> None:
    """A jump from one run to the next is none; of a run too short for the filter nothing is thrown away."""
    robot = one_segment()
    label = np.repeat(["a", "b", "c"], [60, 60, 10])
    log = log_of(robot, np.zeros((130, 4)), 0.1, run=label)
    residual = np.where(label == "a", 0.0, 1.0)[:, None] * 50.0 * SIGMA + white(1, 130)
    residual[[30, 125]] += 30.0 * SIGMA
    good = keep(sample(log), residual, Noise(SIGMA, 0.0, "known"))
    assert np.flatnonzero(~good).tolist() == [30]


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(
    "law", [{"name": "backlash", "half_width": 3e-4}, {"name": "friction", "half_width": 3e-4}]
)
def test_what_a_slow_camera_repeats_is_known_from_a_robot_that_stands_still(law: Any) -> None:
    log, robot, rows = backlash_log(), load_robot("prototype"), np.arange(420)
    tip = replay(log, replace(robot, effects=(law,))).tip_position
    for seen in (tip, tip.round(3)):
        assert sentences(replace(log, tip_position=seen)) == []
    steps = log.dl[rows // 7 * 7]  # which are held, and a tip that is late
    late = np.concatenate([tip[:1], tip[rows[:-1] // 7 * 7]])
    assert not repeated(late.round(4), steps, steps).any()
    held = rows * 3 // 10  # commands that are held for 3 or 4 rows
    still = replace(log, run=np.full(420, "a"), dl=log.dl[held], tip_position=tip[held])
    assert not pictures(still)[1].any()
    noisy = tip + np.random.default_rng(0).normal(0.0, 1e-4, tip.shape)
    for every in (2, 4, 7):
        seen = replace(log, tip_position=noisy[rows // every * every])
        assert_array_equal(pictures(seen)[0].measured, rows % every == 0)
        assert sentences(seen)[0].startswith(f"{420 - 420 // every} of 420 rows repeat the measured tip")


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(  # rows a picture, and what stands in rows between
    ("every", "between"), [(1.09, "the last"), (4.7, "lines"), (1.6, "nothing"), (3.3, "the last")]
)
def test_pictures_out_of_step_with_a_log_count_for_when_they_were_taken(every: float, between: str) -> None:
    robot, log, rng = load_robot("prototype"), backlash_log(), np.random.default_rng(3)
    log = replace(log, run=np.full(420, "a"))
    shots = np.arange(-0.7 * every, 420.0, every)
    shots = shots[rng.random(len(shots)) > 0.02 * (every > 1.5)] / 15.0  # some are lost
    last = np.searchsorted(shots, log.t, side="right") - 1  # the picture that each row shows
    new = np.append(True, last[1:] != last[:-1])
    waits = np.where(new & (log.t > 0.0), log.t - shots[last], 0.0)
    tip = replay(earlier(log, waits), robot).tip_position
    shown = (tip + rng.normal(0.0, 1e-5, (420, 3)))[np.flatnonzero(new)]
    seen = shown[np.cumsum(new) - 1]
    if between == "nothing":
        seen[~new] = np.nan
    if between == "lines":
        seen = np.stack([np.interp(log.t, log.t[new] - waits[new], x) for x in shown.T], axis=1)
    off = seen - replay(log, robot).tip_position
    log = replace(log, tip_position=seen)
    found, late = pictures(log)
    if between == "lines":  # the first begin, and the last end, who knows where
        new[:5], new[-5:] = found.measured[:5], found.measured[-5:]
    assert_array_equal(found.measured, new)
    assert_allclose(late[new][1:], waits[new][1:], rtol=0, atol=0.1 / 15.0)
    assert 8.0 * replay(log, robot).rms < np.sqrt((off[new] ** 2).sum(1).mean())
    assert sentences(log)[-1].startswith("the camera's pictures are out of step with the rows")
    assert ("interpolated" in sentences(log)[0]) == (between == "lines")
    made = sample(log)
    assert_array_equal(made.origin[made.given], np.arange(420))
    assert_array_equal(made.origin[made.rows], np.flatnonzero(new))
    assert made.step == pytest.approx(1.0 / 15.0)
