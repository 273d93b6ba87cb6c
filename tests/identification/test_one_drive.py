"""One worn drive among good ones: found as that drive's, and only where the log tells it from all of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from identification.logs import log_of, one_segment, two_segments, wave
from numpy.testing import assert_allclose, assert_array_equal

from fastrod import Robot
from fastrod.effects.base import Operator, get_effect, read_values
from fastrod.effects.executor import act, link
from fastrod.errors import EffectError
from fastrod.identification.attribution import identify
from fastrod.identification.log.base_model import base_model
from fastrod.identification.log.forward import prepare_log
from fastrod.identification.log.replay import replay
from fastrod.identification.log.samples import sample
from fastrod.identification.report.result import Result
from fastrod.model.routing import route

NOISE = 2e-4
SIZES: dict[str, dict[str, Any]] = {
    "backlash": {"half_width": 4e-4},
    "friction": {"half_width": 4e-4, "presliding": 6e-4},
    "slack": {"half_width": 4e-4},
    "creep": {"share": 0.25, "time_constant": 3.0},
}


def worn(name: str, drives: tuple[int, ...], n_drives: int) -> dict[str, Any]:
    """The table of an effect that these drives have, from 1 on; the first parameter is its size."""
    size, *shape = SIZES[name]
    listed = [SIZES[name][size] if k + 1 in drives else 0.0 for k in range(n_drives)]
    return {"name": name, size: listed, **{key: SIZES[name][key] for key in shape}}


@pytest.mark.parametrize("name", SIZES)
def test_a_worn_drive_moves_its_own_tendons_alone(name: str) -> None:
    """The tendons of that drive as if all were worn, the others as commanded, to the bit."""
    robot = one_segment() if name == "slack" else two_segments()
    wiring, dl, dt = route(robot), wave(robot, 120), np.full(120, 0.05)
    n, what = wiring.n_drives, get_effect(name)

    def after(drives: tuple[int, ...]) -> np.ndarray:
        values = read_values(name, worn(name, drives, n), wiring, "test")[None]
        if isinstance(what, Operator):
            return what.sweep(values, what.memory(1, robot.n_tendons), dl[None], dt, wiring)[0]
        opened = prepare_log(sample(log_of(robot, dl)), robot, wiring).open()
        act([link(name, values, wiring).on(len(opened))], opened)
        return np.asarray(opened.dl)

    every = after(tuple(range(1, n + 1)))
    tolerance = 1e-15 if name == "slack" else 0.0  # by the bend of a static effect
    for drive in range(n):
        own, seen = wiring.drive == drive, after((drive + 1,))
        assert_allclose(seen[:, own], every[:, own], rtol=0.0, atol=tolerance)
        assert_allclose(seen[:, ~own], dl[:, ~own], rtol=0.0, atol=tolerance)
        assert np.abs(seen[:, own] - dl[:, own]).max() > 1e-4


def test_a_size_is_one_number_or_one_per_drive_or_one_per_segment() -> None:
    wiring = route(two_segments())
    assert_array_equal(wiring.drive, [0, 1, 0, 1, 2, 3, 2, 3])

    def sizes(given: Any) -> list[float]:
        return read_values("backlash", {"half_width": given}, wiring, "test")[:4].tolist()

    assert sizes(1e-4) == [1e-4] * 4
    assert sizes([1e-4, 2e-4]) == [1e-4, 1e-4, 2e-4, 2e-4]
    assert sizes([1e-4, 2e-4, 3e-4, 0.0]) == [1e-4, 2e-4, 3e-4, 0.0]
    with pytest.raises(EffectError, match="has 3 values; give one, or 4, one per drive"):
        sizes([1e-4, 2e-4, 3e-4])


@pytest.mark.parametrize("name", SIZES)
def test_of_one_drive_there_is_one_unknown(name: str) -> None:
    model = base_model(two_segments())
    size = next(iter(SIZES[name]))
    for drive in range(4):
        one = model.with_effect(name, drive=drive)
        assert [u.name for u in one.unknowns if size in u.name] == [f"{name}.{size}_{drive + 1}"]
        assert np.flatnonzero(one.values(one.start)[name][:4]).tolist() == [drive]
        assert one.drive_of(name) == drive
        (table,) = one.identified(one.start).effects
        assert [value > 0.0 for value in table[size]] == [k == drive for k in range(4)]
    assert model.with_effect(name).drive_of(name) is None
    alone = base_model(rod_of_one_drive()).with_effect(name)
    assert alone.drive_of(name) is None


def rod_of_one_drive() -> Robot:
    (segment,) = one_segment().segments
    return replace(one_segment(), segments=(replace(segment, tendons=segment.tendons[::2]),))


@cache
def found(name: str, drives: tuple[int, ...]) -> Result:
    """Return what is found in a run of 40 s with holds, the sealed drives worn."""
    robot = one_segment()
    t = 0.1 * np.arange(400)
    held = np.where((t > 15.0) & (t < 22.0), 15.0, t)
    held = np.where(t > 33.0, 33.0, held)
    size = 0.45 + 0.3 * np.sin(0.23 * held)
    bends = np.stack([size * np.sin(1.1 * held), size * np.sin(0.83 * held + 0.5)], axis=-1)[:, None]
    bends[:30] = 0.0
    log = log_of(robot, route(robot).tendon_change(bends), 0.1)
    sealed = replace(robot, effects=(worn(name, drives, 2),))
    tip = replay(log, sealed).tip_position + np.random.default_rng(8).normal(0.0, NOISE, (400, 3))
    return identify(replace(log, tip_position=tip), robot, threads=1)


@pytest.mark.study
@pytest.mark.parametrize("name", SIZES)
@pytest.mark.parametrize("drive", [1, 2])
def test_a_worn_drive_is_named(name: str, drive: int) -> None:
    result = found(name, (drive,))
    assert [(effect.name, effect.drive) for effect in result.effects] == [(name, drive)]
    assert f"of drive {drive}" in result.summary
    assert f"Only drive {drive} has it" in result.effects[0].title
    assert result.verdict == "explained"
    assert result.test.before > 1.5 * result.noise.floor
    assert result.test.after < 1.1 * result.noise.floor
    size = next(iter(SIZES[name]))
    estimate = result.effects[0].parameters[f"{size}_{drive}"]
    assert estimate.value == pytest.approx(SIZES[name][size], abs=5.0 * estimate.stderr)
    table = result.identified.effects[0]
    assert table[size][2 - drive] == 0.0


@pytest.mark.study
@pytest.mark.parametrize("name", SIZES)
def test_drives_that_are_alike_are_not_told_apart(name: str) -> None:
    result = found(name, (1, 2))
    assert [(effect.name, effect.drive) for effect in result.effects] == [(name, None)]
    assert "of drive" not in result.summary
    assert result.test.after < 1.1 * result.noise.floor
