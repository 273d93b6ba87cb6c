"""Twelve motions of an independent chain of links (../shared/truth/dynamics_truth.json)."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from modal_rods import Rods

from fastrod import Modes, Robot, Segment, Tendon
from fastrod.kernels.rod.modal.motion import GENERALIZED_ALPHA
from fastrod.model.robot import Lump
from fastrod.solver.modal import Step

TRUTH = Path(__file__).parents[3] / "shared" / "truth" / "dynamics_truth.json"
CASES = json.loads(TRUTH.read_text()) if TRUTH.exists() else []
Inputs = Callable[[float], dict[str, Any]]


def robot_of(case: dict[str, Any]) -> Robot:
    """The rod of a case, with its tendons and its tip's mass."""
    tendons: tuple[Tendon, ...] = ()
    if "tendon" in case:
        numbers = {name: case["tendon"][name] for name in ("offset", "compliance", "pretension")}
        tendons = tuple(Tendon(angle=angle, **numbers) for angle in (0.0, math.pi))
    x, z = case["gravity"]
    rod = Segment(
        length=case["l"],
        bending_stiffness=(case["EI"],) * 2,
        torsional_stiffness=case["EI"],
        line_density=case["rhoA"],
        damping_time=case["tau"],
        lumps=(Lump(at=case["l"], mass=case["tip_mass"]),) if case["tip_mass"] else (),
        mode="tendon_length" if tendons else "passive",
        tendons=tendons,
    )
    return Robot(name="truth", segments=(rod,), gravity=(x, 0.0, z))


def inputs_of(case: dict[str, Any]) -> Inputs:
    """Return what acts from t = 0 on."""
    if "tendon" in case:
        t_end, change = case["tendon"]["ramp"], case["tendon"]["offset"] * case["tendon"]["bend"]

        def pull(t: float) -> dict[str, Any]:
            x = min(t / t_end, 1.0)
            k = change * x * x * (3.0 - 2.0 * x)
            return {"tendon_length": (case["l"] - k, case["l"] + k)}

        return pull
    if case.get("shake"):
        a, omega = case["shake"][0], 2.0 * math.pi * case["shake"][1]
        return lambda t: {"base_pose": (a * (1.0 - math.cos(omega * t)), 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)}
    return lambda _: {}


def tip_error(case: dict[str, Any], dt: float) -> float:
    """Root mean square over the times of the case, as a fraction of the length."""
    given, every = inputs_of(case), max(1, round(case["t"][1] / dt))
    rods = Rods(robot_of(case), modes=Modes(4, 2), n_steps=1)
    rest = {"gravity": (0.0, 0.0, 0.0)} if case["kind"] == "drop" else given(0.0)
    if case.get("force"):
        rest["tip_force"] = (case["force"], 0.0, 0.0)
    tips = [rods.settle(**rest)[0]]
    how = Step(GENERALIZED_ALPHA, case["t"][1] / every)
    for k in range(1, every * (len(case["t"]) - 1) + 1):
        inputs = given(k * how.dt)
        tip = rods.step(how, jump=k == 1, **inputs)[0]
        if k % every == 0:
            tips.append(tip - np.array(inputs.get("base_pose", (0.0, 0.0, 0.0))[:3]))
    off = np.array(tips)[:, [0, 2]] - np.array(case["tip_xz"])
    return float(np.sqrt((off**2).sum(1).mean()) / case["l"])


@pytest.mark.study(beyond=1)
@pytest.mark.skipif(not CASES, reason="../shared/truth/dynamics_truth.json is not there")
@pytest.mark.parametrize("case", CASES, ids=[f"{c['id']} {c['kind']}" for c in CASES])
def test_a_rod_moves_as_a_chain_of_links(case: dict[str, Any]) -> None:
    """Also where it starts suddenly: the acceleration after the jump is part of the first step."""
    own = case["error"] / case["l"]
    assert tip_error(case, 1e-3) < 3e-3 + own
    assert tip_error(case, 1e-4) < 5e-4 + own
