"""The same simulator on both machines, what it is commanded, and how near its numbers must be."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend

from fastrod import Robot, Simulator, State, load_robot

LENGTHS = ("position", "arclength", "tip_position", "path_length", "residual")
OTHERS = {"rotation": 1.0, "curvature": 14.0, "moment": 0.03, "force": 0.5, "tip_rotation": 1.0}
OTHERS |= {"tension": 5.0, "base_wrench": 0.03}
"""Sizes of the numbers of a state in these robots: 1/l, EI/l, EI/l^2, EI/(d l)."""
PAPER_STEP = ("position", "arclength", "tip_position", "path_length", "residual", "rotation", "tip_rotation")
"""Step in paper mode: four tendons on two unknowns have many gains, which single precision tells apart,
and curvature and moment follow the gain to 1e-9 and some; once settled all agree."""
SINGLE = {"covariance": 1e-5, "gain": 1e-5, "move": 1e-7, "defect": 1e-7}
"""Kept in single precision: their last bit turns on the last bit of a double."""


def chain() -> Robot:
    """Two segments with slack tendons, the last one extensible, no number twice."""
    robot = load_robot("tdcr_b")
    first, last = robot.segments
    slack = tuple(replace(t, unilateral=True, pretension=0.1) for t in last.tendons)
    bent = replace(last, bending_stiffness=(0.002, 0.003), precurvature=(1.0, -2.0, 0.5))
    return replace(robot, segments=(first, replace(bent, tendons=slack, extension=(0.0, 0.02))))


def pair(robot: Robot | Sequence[Robot], n: int | None = 3, **options: Any) -> list[Simulator]:
    given = {"n_robots": n, "points_per_segment": 3, **options}
    return [Simulator(robot, device=device, **given) for device in ("cpu", "cuda")]


def inputs(robot: Robot, k: int, n: int = 3) -> dict[str, Any]:
    """Return what the robots are given at step k: lengths or tensions, and from step 2 on a tip force that
    moves."""
    angle = 0.2 * np.arange(1, n + 1)[:, None] * (1.0, -0.6) + 0.01 * k
    given: dict[str, Any] = {"tip_force": np.outer(np.linspace(0.5, 1.0, n), (0.01, 0.02, -0.01)) * max(k, 1)}
    modes = {segment.mode for segment in robot.segments}
    if "tendon_tension" in modes:
        given["tension"] = 0.2 + np.arange(n)[:, None] * np.array([0.3, 0.0, 0.1, 0.0]) + 0.01 * k
    elif robot.n_tendons:
        given["tendon_length"] = np.stack([bend(robot, *a) for a in angle])
    return given


def assert_same(here: State, there: State, *, only: Sequence[str] | None = None) -> None:
    """To 1e-9 of the natural size of each number, or of its own."""
    length = np.nanmax(here.arclength)
    for name, size in {**dict.fromkeys(LENGTHS, length), **OTHERS}.items():
        if only is not None and name not in only:
            continue
        assert_allclose(getattr(there, name), getattr(here, name), rtol=1e-9, atol=1e-9 * size, err_msg=name)
    assert_array_equal(there.ok, here.ok)
    assert_array_equal(there.passes, here.passes)
    assert there.problems.keys() == here.problems.keys()


def assert_same_memory(here: Simulator, there: Simulator) -> None:
    paper = here.robots[0].segments[0].mode == "paper"
    one, two = here.snapshot().memory, there.snapshot().memory
    for name, a, b in zip(one._fields, one, two, strict=True):
        if paper and name in ("gain", "curvature_guess"):  # `PAPER_STEP`
            continue
        natural = {"move": 1.0, "defect": 1.0, "curvature_guess": OTHERS["curvature"]}
        size = natural.get(name, np.abs(a).max(initial=1e-12))
        assert_allclose(b, a, rtol=0.0, atol=SINGLE.get(name, 1e-9) * size, err_msg=name)
