"""The shared reference answers computed to 1e-12 by others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from rods import Table, rod

from fastrod import Robot, Segment, Simulator, Tendon, load_robot

Read = Callable[[str], Table]


def test_appendix_j_cantilever(truth: Read) -> None:
    table = truth("appJ_truth.csv")
    force = np.column_stack([0.0 * table("Fy_N"), table("Fy_N"), 0.0 * table("Fy_N")])
    state = Simulator(rod("passive"), n_robots=len(force)).settle(tip_force=force)
    assert state.ok.all()
    # fourth order at 20 steps of at most 0.06 rad: far below the micrometre that is asked
    np.testing.assert_allclose(state.tip_position[:, 1:], table("tip_y_m", "tip_z_m"), rtol=0, atol=1e-7)
    np.testing.assert_allclose(state.curvature[:, 0, 0], table("u0x_1_per_m"), rtol=1e-6)


def test_appendix_b_paper_mode_from_a_cold_start(truth: Read) -> None:
    table = truth("appB_truth.csv")
    loads = {"tip_force": table("Fx", "Fy", "Fz"), "line_force": (1.0, 1.0, 1.0)}
    state = Simulator(rod("paper", offset=0.01), n_robots=100).settle(table("L1", "L2", "L3", "L4"), **loads)
    assert state.ok.all()
    assert state.passes.max() <= 6
    assert state.residual.max() <= 1e-9
    np.testing.assert_allclose(state.tip_position, table("tip_x", "tip_y", "tip_z"), rtol=0, atol=5e-7)
    np.testing.assert_allclose(state.curvature[:, 0], table("u0x", "u0y", "u0z"), rtol=0, atol=1e-3)


def test_appendix_b_path_one_pass_a_step(truth: Read) -> None:
    """500 points through the first 100 cases, five to the next: the observer follows without iterating."""
    table = truth("appB_truth.csv")
    given = np.column_stack([table("L1", "L2", "L3", "L4"), table("Fx", "Fy", "Fz")])
    part = np.linspace(0, 1, 5, endpoint=False)[:, None]
    path = np.concatenate([a + part * (b - a) for a, b in zip(given, np.roll(given, -1, 0), strict=True)])
    sim = Simulator(rod("paper", offset=0.01))
    sim.settle(path[0, :4], tip_force=path[0, 4:], line_force=(1.0, 1.0, 1.0))
    residual = [sim.step(p[:4], tip_force=p[4:], line_force=(1.0, 1.0, 1.0)).residual[0] for p in path]
    assert np.median(residual) <= 5e-5  # the paper reports 5e-4


@pytest.mark.parametrize("name", ["A", "B"])
@pytest.mark.parametrize("mode", ["tendon_tension", "tendon_length"])
def test_two_segment_robots(truth: Read, name: str, mode: str) -> None:
    table = truth("tdcr_cases.csv").where("robot", name)
    robot = load_robot(f"tdcr_{name.lower()}")
    robot = replace(robot, segments=tuple(replace(s, mode=mode) for s in robot.segments))
    tension, length = table(*(f"q{i}" for i in range(1, 7))), table(*(f"kir_len{i}" for i in range(1, 7)))
    loads = {"tip_force": table("fx", "fy", "fz"), "tip_moment": table("mx", "my", "mz")}
    sim = Simulator(robot, n_robots=len(tension))
    given = {"tension": tension} if mode == "tendon_tension" else {"tendon_length": length - 1e-5 * tension}
    state = sim.settle(**given, **loads)
    assert state.ok.all()
    np.testing.assert_allclose(state.tip_position, table("kir_px", "kir_py", "kir_pz"), rtol=0, atol=1e-7)
    rotation = table(*(f"kir_r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3))).reshape(-1, 3, 3)
    np.testing.assert_allclose(state.tip_rotation, rotation, rtol=0, atol=1e-6)
    np.testing.assert_allclose(state.path_length, length, rtol=0, atol=1e-8)
    np.testing.assert_allclose(state.tension, tension, rtol=0, atol=1e-5)


def robot_of(row: dict[str, str], n: int) -> Robot:
    number = {name: float(row[name]) for name in ("l", "EI", "GJ", "offset", "c")}
    stiffness = {"bending_stiffness": (number["EI"],) * 2, "torsional_stiffness": number["GJ"]}
    tendons = tuple(
        Tendon(offset=number["offset"], angle=2 * np.pi * i / n, compliance=number["c"]) for i in range(n)
    )
    return Robot(name=row["case"], segments=(Segment(length=number["l"], **stiffness, tendons=tendons),))


@pytest.mark.parametrize("n", [3, 4])
def test_prescribed_lengths_loads_in_any_direction(truth: Read, n: int) -> None:
    table = truth("tendon_length_truth.csv").where("n", str(n))
    lengths, tension = table(*(f"L{i + 1}" for i in range(n))), table(*(f"T{i + 1}" for i in range(n)))
    loads = {"tip_force": table("Fx", "Fy", "Fz"), "line_force": table("fx", "fy", "fz")}
    state = Simulator([robot_of(row, n) for row in table.rows]).settle(lengths, **loads)
    assert state.ok.all()
    np.testing.assert_allclose(state.tip_position, table("tip_x", "tip_y", "tip_z"), rtol=0, atol=1e-7)
    np.testing.assert_allclose(state.tension, tension, rtol=1e-4)
