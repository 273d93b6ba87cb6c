"""Laws over the whole registry of effects, and robot files that name them."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from identification import logs
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod
from verification.test_derivatives import difference

import fastrod
import fastrod.effects.base as registry
from fastrod import Robot, Simulator, load_robot, save_robot
from fastrod.commands.cli import main
from fastrod.effects.base import (
    BodyOperator,
    Operator,
    Seam,
    columns,
    effect_names,
    get_effect,
    has_memory,
    trait,
)
from fastrod.effects.pipeline import EffectPipeline
from fastrod.errors import EffectError, UnknownNameError
from fastrod.kernels.operators import BUFFER
from fastrod.model.compile import compile_robots
from fastrod.model.robotfile import dumps, loads
from fastrod.model.routing import route
from fastrod.solver.inputs import Inputs, Reader

NAMES = effect_names()
OPERATORS = [name for name in NAMES if isinstance(get_effect(name), Operator)]
N_STEPS, N_ROBOTS, DT = 15, 3, 0.05
STATE = "position rotation curvature arclength tension path_length base_wrench residual passes"
Table = dict[str, Any]
Seen = dict[str, np.ndarray]


one_segment, two_segments = (partial(make, 0.1) for make in (logs.one_segment, logs.two_segments))
ROBOTS = pytest.mark.parametrize("robot", [one_segment(), two_segments()], ids=lambda robot: robot.name)


def having(robot: Robot, *tables: Table) -> Robot:
    return replace(robot, effects=tables)


def at_neutral(name: str, robot: Robot, *, shaped: bool = False) -> Table:
    """The effect's table with every value neutral; `shaped`: but for the parameters that only shape it."""
    parameters = [p.on(route(robot)) for p in get_effect(name).parameters]
    return {"name": name} | {p.name: p.starts[0] if shaped and p.shape else p.neutral for p in parameters}


def at_typical(name: str, robot: Robot, times: float = 1.0) -> Table:
    """The effect's table with typical sizes, or a multiple of them; what shapes it is neutral."""
    sizes = [p for p in (p.on(route(robot)) for p in get_effect(name).parameters) if not p.shape]
    values = (float(np.clip(p.neutral + times * (p.typical or 0.0), *p.bounds)) for p in sizes)
    return {"name": name, **dict(zip((p.name for p in sizes), values, strict=True))}


def commands(robot: Robot, n_steps: int = N_STEPS) -> np.ndarray:
    """(n_steps, N_ROBOTS, n_tendons) bends there and back, up to about 1.2 rad; robots out of step."""
    t = np.linspace(0.0, 1.0, n_steps)[:, None] + 0.1 * np.arange(N_ROBOTS)
    lengths = np.zeros((n_steps, N_ROBOTS, robot.n_tendons))
    for k in range(robot.n_segments):
        size = 1.2 / robot.n_segments
        x, y = size * np.sin(7.0 * t + k), 0.6 * size * np.cos(5.0 * t - 2 * k)
        unit = [bend(robot, *a, segment=k) - robot.rest_tendon_length for a in np.eye(2)]
        lengths += x[..., None] * unit[0] + y[..., None] * unit[1]
    return np.asarray(lengths + robot.rest_tendon_length * (1.0 - 1e-4 * t[..., None]))


def given(robot: Robot, step: int, moving: bool) -> dict[str, np.ndarray]:
    """Every kind of load and another base for each robot; `moving`: the tip force changes while they run."""
    number, half = np.arange(N_ROBOTS), 0.3 * np.arange(N_ROBOTS)
    tip = np.outer(number, [0.02, -0.03, 0.01]) * (1.0 + 0.1 * step * moving)
    turned = np.column_stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half])
    pose = np.column_stack([np.outer(number, [0.1, 0.2, 0.3]), turned])
    line = np.full((robot.n_segments, 4, 3), 0.05) * np.arange(4)[:, None]
    loads = {"tip_force": tip, "line_force": line, "tip_moment": np.array([1e-4, 0.0, 2e-4])}
    return loads | {"base_pose": pose}


def simulator(robot: Robot | list[Robot], n_robots: int = N_ROBOTS) -> Simulator:
    return Simulator(robot, n_robots=n_robots, dt=DT, points_per_segment=3)


def run(
    sim: Simulator, lengths: np.ndarray, *, moving: bool = False, first: int = 0, rows: Any = slice(None)
) -> Seen:
    """All that is seen of a simulator along `lengths`; `rows`: which of the N_ROBOTS it has."""
    seen: dict[str, list[np.ndarray]] = {}
    for i, here in enumerate(lengths, first):
        loads = given(sim.robots[0], i, moving)
        loads |= {name: loads[name][rows] for name in ("tip_force", "base_pose")}
        state = sim.step(here[rows], **loads)
        for name in STATE.split():
            seen.setdefault(name, []).append(getattr(state, name))
        for name, value in sim.measure()._asdict().items():
            seen.setdefault(f"measured {name}", []).append(value)
    return {name: np.array(a) for name, a in seen.items()}


def assert_same(one: Seen, two: Seen, rows_one: Any = slice(None), rows_two: Any = slice(None)) -> None:
    for name, a in one.items():
        assert_array_equal(a[:, rows_one], two[name][:, rows_two], err_msg=name)


@pytest.mark.study(beyond=4)
@ROBOTS
@pytest.mark.parametrize("name", NAMES)
def test_a_neutral_effect_is_the_base_model_bit_for_bit(name: str, robot: Robot) -> None:
    lengths = commands(robot)
    base = run(simulator(robot), lengths, moving=True)
    for shaped in (False, True):
        with_effect = having(robot, at_neutral(name, robot, shaped=shaped))
        assert_same(base, run(simulator(with_effect), lengths, moving=True))
    assert_same(base, run(simulator([with_effect] * N_ROBOTS), lengths, moving=True))
    one, two = simulator(robot), simulator(with_effect)
    assert_array_equal(one.settle(lengths[0]).position, two.settle(lengths[0]).position)


def test_the_whole_library_at_once_at_neutral_is_the_base_model() -> None:
    robot = two_segments()
    everything = having(robot, *(at_neutral(name, robot) for name in reversed(NAMES)))
    assert_same(*(run(simulator(r), commands(robot), moving=True) for r in (robot, everything)))


@pytest.mark.study(beyond=11)
@ROBOTS
@pytest.mark.parametrize("name", NAMES)
def test_a_typical_effect_is_seen_where_the_robot_can_show_it(name: str, robot: Robot) -> None:
    lengths = commands(robot)
    if name == "plastic_set":  # nothing yields below 0.7 rad of a segment
        lengths = robot.rest_tendon_length + 2.0 * (lengths - robot.rest_tendon_length)
    base, seen = (run(simulator(r), lengths) for r in (robot, having(robot, at_typical(name, robot))))
    moved = np.abs(seen["measured tip_position"] - base["measured tip_position"]).max((0, 2))
    assert np.isfinite(seen["measured tip_position"]).all()
    if name == "load_offset":  # the first robot bears no load
        assert moved[0] == 0.0
        moved = moved[1:]
    two_sided = name == "tightening"  # of tendons that can push nothing shows
    if two_sided or robot.n_segments < trait(get_effect(name), "least_segments"):
        assert (moved == 0.0).all()
    else:
        # a camera sees a tenth of a millimetre, a short run shows only a part of a slow effect
        assert (moved > 1e-6).all()
    if get_effect(name).seam is Seam.SENSING:
        assert_array_equal(seen["position"], base["position"])
    assert_array_equal(seen["measured points"].shape, (N_STEPS, N_ROBOTS, len(robot.log_points), 3))


@pytest.mark.study(beyond=3)
@pytest.mark.parametrize("name", NAMES)
def test_snapshot_and_reset_take_the_effects_along(name: str) -> None:
    robot = two_segments()
    lengths = commands(robot)
    sim = simulator(having(robot, at_typical(name, robot)))
    whole = run(sim, lengths)
    sim.reset()
    assert_same(whole, run(sim, lengths))
    sim.reset()
    run(sim, lengths[:7])
    kept = sim.snapshot()
    rest = [run(sim, lengths[7:], first=7)]
    sim.restore(kept)
    rest.append(run(sim, lengths[7:], first=7))
    assert_same(*rest)
    assert_same({key: a[7:] for key, a in whole.items()}, rest[0])
    sim.restore(kept)
    sim.reset([1])
    after = run(sim, lengths[7:], first=7)
    assert_same(rest[0], after, [0, 2], [0, 2])
    fresh = run(simulator(having(robot, at_typical(name, robot))), lengths[7:], first=7)
    assert_same(fresh, after, [1], [1])


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize("name", NAMES)
def test_a_batch_of_different_values_is_its_robots_bit_by_bit(name: str) -> None:
    robots = [having(two_segments(), at_typical(name, two_segments(), times)) for times in (0.0, 1.0, 1.4)]
    lengths = commands(robots[0])
    together = run(simulator(robots), lengths)
    for i, robot in enumerate(robots):
        assert_same(run(simulator(robot, 1), lengths, rows=[i]), together, [0], [i])


@pytest.mark.study(beyond=5)
@pytest.mark.parametrize("name", NAMES)
def test_a_bad_input_spoils_no_memory(name: str) -> None:
    """Robot 1 misses two steps: the others do not notice, and it goes on as if these two had not been."""
    robot = having(two_segments(), at_typical(name, two_segments()))
    lengths = commands(robot)
    clean = run(simulator(robot), lengths)
    broken = lengths.copy()
    broken[5, 1, 2], broken[6, 1, 0] = np.nan, np.inf
    sim = simulator(robot)
    seen = run(sim, broken)
    assert_same(clean, seen, [0, 2], [0, 2])
    assert np.isnan(seen["position"][5:7, 1]).all()
    alone = run(simulator(robot, 1), np.delete(lengths, [5, 6], axis=0), rows=[1])
    state = sim.settle(broken[6], **given(robot, 6, False))
    assert state.ok.tolist() == [True, False, True]
    assert np.isfinite(sim.jacobian()).all((1, 2)).tolist() == [True, False, True]
    assert_same(alone, {key: np.delete(a, [5, 6], axis=0) for key, a in seen.items()}, [0], [1])
    late = lengths.copy()
    late[0, 1] = np.nan  # and a robot whose first input is bad begins with its second
    after = {key: a[1:] for key, a in run(simulator(robot), late).items()}
    assert_same(run(simulator(robot, 1), lengths[1:], rows=[1]), after, [0], [1])


ON_FORCES = ("latency", "second_order_lag", "drum_gain")


def changes_tendons(robot: Robot, **inputs: Any) -> bool:
    """Whether effects change where tendons run or how they stretch, and not only their lengths."""
    layout, params, rest = compile_robots((replace(robot, effects=()),), N_STEPS)
    ports = Reader(layout, params, rest, 1).ports(Inputs(**inputs))
    pipeline = EffectPipeline([robot], 1)
    _, changed, _ = pipeline.act(ports, params, None, DT, N_STEPS, np.zeros(1, bool))
    pairs = ((getattr(changed, name), getattr(params, name)) for name in ("offset", "compliance"))
    return not all(np.array_equal(now, then) for now, then in pairs)


@pytest.mark.parametrize("name", NAMES)
def test_robots_without_wires_or_with_tensions_take_every_effect(name: str) -> None:
    """Effects on lengths do nothing where no length is commanded, but for those that act on forces, too."""
    for robot, inputs in (
        (rod("passive", extension=(-0.01, 0.01)), {}),
        (rod("tendon_tension", 3, extension=(-0.01, 0.01)), {"tension": [0.3, 0.0, 0.1]}),
    ):
        table = at_typical(name, robot)
        base, sim = (Simulator(r, points_per_segment=3) for r in (robot, having(robot, table)))
        for _ in range(2):
            one, two = base.step(**inputs), sim.step(**inputs)
        assert two.ok.all()
        if name in ON_FORCES and inputs:
            if name == "drum_gain":  # the others show in motion
                assert not np.array_equal(two.position, one.position)
        elif get_effect(name).seam is Seam.ACTUATION and not changes_tendons(having(robot, table), **inputs):
            assert_array_equal(two.position, one.position)
            assert_array_equal(sim.jacobian(), base.jacobian())


@pytest.mark.parametrize("name", OPERATORS)
def test_a_sweep_over_a_log_is_its_steps_one_by_one(name: str) -> None:
    robot = two_segments()
    wiring, what = route(robot), get_effect(name)
    assert isinstance(what, Operator)
    rng = np.random.default_rng(11)
    table = [at_typical(name, robot, times) for times in (1.0, 2.0)]
    values = np.array([registry.read_values(name, row, wiring, "test") for row in table])
    # beyond the buffer of a delay
    dl = 0.01 * np.cumsum(rng.uniform(-0.2, 0.2, (2, 300, robot.n_tendons)), axis=1)
    dt = rng.uniform(0.0, 0.04, 300) * (rng.random(300) > 0.1)  # irregular, and some at once
    kept = dl.copy()
    whole_memory, parts_memory = (what.memory(2, robot.n_tendons) for _ in range(2))
    whole = what.sweep(values, whole_memory, dl, dt, wiring)
    assert_array_equal(dl, kept)
    parts = [what.sweep(values, parts_memory, dl[:, i : i + 1], dt[i : i + 1], wiring) for i in range(300)]
    assert_array_equal(np.concatenate(parts, axis=1), whole)
    assert_array_equal(parts_memory, whole_memory)
    assert np.abs(whole - dl).max() > 0.0
    alone = what.sweep(values[1:], what.memory(1, robot.n_tendons), dl[1:], dt, wiring)
    assert_array_equal(alone[0], whole[1])


def test_memories_are_as_wide_as_their_operators_need() -> None:
    """Columns of a sweep: numbers in every column of a tendon, a bend or a step, and no other."""
    columns_of = {"backlash": 3, "friction": 6, "creep": 2, "second_order_lag": 3}
    assert {*columns_of, "latency", "plastic_set"} <= set(OPERATORS)
    robot = two_segments()
    wiring, n = route(robot), robot.n_tendons
    dl = 0.002 * np.cumsum(np.random.default_rng(3).uniform(-1.0, 1.0, (1, 20, n)), axis=1)
    for name in OPERATORS:
        what: Any = get_effect(name)
        memory = what.memory(1, n)
        values = np.array([registry.read_values(name, at_typical(name, robot), wiring, "test")])
        what.sweep(values, memory, dl, np.full(20, 0.1), wiring)
        if name == "latency":
            assert memory.shape[1] == 1 + BUFFER * (1 + n)
            used = 1 + 20 * (1 + n)
        else:
            width = columns_of.get(name, memory.shape[1] // n) * n  # of others, whole columns for each tendon
            used = 2 * robot.n_segments if name == "plastic_set" else width
            assert memory.shape[1] == (2 * n if name == "plastic_set" else used)
        assert np.isfinite(memory[0, :used]).all()
        assert np.isnan(memory[0, used:]).all()


def test_a_set_needs_no_memory_where_no_wire_ends() -> None:
    """More segments than tendons: a passive one, then one with two tendons. What no tendon commands keeps no
    set, and nothing is written beside the memory."""
    (near,) = one_segment().segments
    chain = (replace(near, mode="passive", tendons=()),) * 2 + (replace(near, tendons=near.tendons[:2]),)
    few = Robot(name="few tendons", segments=chain)
    robot = having(few, {"name": "plastic_set", "share": 0.2, "yield_at": 0.1})
    wiring = route(robot)
    what: Any = get_effect("plastic_set")
    memory = what.memory(1, 2)
    dl = 0.004 * np.ones((1, 5, 2)) * np.arange(5)[:, None]
    held = np.vstack([memory, np.full((1, 4), 7.0)])  # the row behind it
    out = what.sweep(np.array([[0.2, 0.1]]), held[:1], dl, np.full(5, 0.1), wiring)
    assert (held[1] == 7.0).all()
    assert np.isfinite(held[0, :2]).all()
    assert np.isnan(held[0, 2:]).all()
    assert np.abs(out - dl).max() > 1e-5


JACOBIANS: list[Table] = [
    {"name": "drum_gain", "gain": [0.2, -0.1, 0.1, 0.05]},
    {"name": "coupling", "from_distal": 0.2, "from_proximal": -0.1},
    {"name": "routing_angle", "angle": [0.1, -0.2, 0.1, 0.15]},
    {"name": "tendon_stretch", "compliance": [3e-4, 1e-4]},
    {"name": "axial_compression", "per_bend": [0.05, 0.1], "common_share": [0.5, 0.9]},
    {"name": "stiffening", "cubic": [0.2, 0.1]},
    {"name": "compression_softening", "gain": 40.0},
    {"name": "tendon_interaction", "slope": [20.0, -10.0, 10.0, 5.0], "pair": 10.0, "next": 500.0},
]


@pytest.mark.parametrize(
    "tables", [*([table] for table in JACOBIANS), JACOBIANS], ids=[*(t["name"] for t in JACOBIANS), "all"]
)
def test_the_jacobian_is_by_what_is_commanded(tables: list[Table]) -> None:
    robot = having(two_segments(), *tables)
    lengths = bend(robot, 0.4, -0.3) + bend(robot, -0.3, 0.5, 1) - robot.rest_tendon_length - 1e-5
    force, extension = np.array([0.05, 0.02, -0.03]), np.array([0.001, -0.002])
    base = {"tendon_length": lengths, "tip_force": force, "extension": extension}
    sim = Simulator(robot, points_per_segment=4)
    assert sim.settle(**base, tolerance=1e-13).ok.all()
    jacobian = sim.jacobian()[0]
    columns = [("tendon_length", i, 1e-6, 1e-6) for i in range(8)]
    # tendons that hold a body that stretches twist it, steeply: the step of 1e-4 of the length of `jacobian`
    # is then too long by its square; twice what is left
    columns += [("extension", k, 1e-6, 5e-6) for k in range(2)]
    for j, (name, i, delta, tolerance) in enumerate(columns):
        expected = difference(sim, base, name, i, delta)
        assert_allclose(jacobian[:, j], expected, atol=tolerance * np.abs(expected).max())


def test_the_jacobian_of_an_effect_with_memory_stays_in_its_loop() -> None:
    """Within its play a gear moves nothing; beyond it the wire follows at once."""
    robot = having(rod(), {"name": "backlash", "half_width": 0.0004})
    sim = Simulator(robot, points_per_segment=3)
    for scale in (0.0, 0.5, 0.47):
        sim.settle(bend(robot, scale, 0.0))
    before = [link.memory.copy() for link in sim._chain.links]
    jacobian = sim.jacobian()[0, :, :4]
    assert_array_equal(before, [link.memory for link in sim._chain.links])
    assert np.abs(jacobian @ [0.0, 1.0, 0.0, -1.0]).max() < 1e-6 * np.abs(jacobian).max()


def test_effects_of_a_robot_file_come_back_and_act(tmp_path: Path) -> None:
    gain = {"name": "drum_gain", "gain": [0.1, 0.0, -0.1, 0.2]}
    tables = gain, {"name": "creep", "share": 0.1, "time_constant": 2.0}
    robot = having(two_segments(), *tables)
    save_robot(robot, tmp_path / "mine.toml")
    again = load_robot(tmp_path / "mine.toml")
    assert again == robot
    assert list(again.effects) == list(tables)
    lengths = commands(robot, 4)
    assert_same(run(simulator(robot), lengths), run(simulator(again), lengths))
    text = dumps(load_robot("prototype")) + '\n[[effect]]\nname = "play"\nhalf_width = 0.0002\n'
    (link,) = Simulator(loads(text)).__dict__["_chain"].links
    assert (link.name, link.values.tolist()) == ("backlash", [[0.0002, 0.0002, 0.0, 0.0, 0.0]])


def lash(**values: Any) -> Table:
    return {"name": "backlash", **values}


def creep(**values: Any) -> Table:
    return {"name": "creep", **values}


UNKNOWN: list[tuple[Any, ...]] = [
    ("no effect 'backlsh'; did you mean 'backlash'", {"name": "backlsh"}),
    ("did you mean 'gear_play'", {"name": "gear_ply"}),
]
WRONG: list[tuple[Any, ...]] = [
    ("robot 'two': .* no parameter 'half_widht'; did you mean 'half_width'", lash(half_widht=1e-4)),
    ("is -0.0001 m; it must be a number from 0 to", lash(half_width=-1e-4)),
    ("is 1.0 m; it must be a number from 0 to 0.00", lash(half_width=1.0)),
    ("share of effect 'creep' is 'a'", creep(share="a")),
    ("is True", creep(share=True)),
    ("is nan", creep(share=float("nan"))),
    ("it must be a number from 0.05 to 300", creep(time_constant=0.0)),
    (
        "gain of effect 'drum_gain' has 2 values; give one, or 4, one per drive",
        {"name": "drum_gain", "gain": [0.1, 0.2]},
    ),
    ("has 3 values; give one", creep(share=[0.1, 0.2, 0.3])),
    ("has effect 'payload' twice", {"name": "payload"}, {"name": "payload"}),
    ("has effect 'backlash' twice", lash(), {"name": "gear_play"}),
    ("has no name", {"half_width": 1e-4}),
]
TABLES = [*((UnknownNameError, *row) for row in UNKNOWN), *((EffectError, *row) for row in WRONG)]


@pytest.mark.parametrize("row", TABLES, ids=[row[1][:40] for row in TABLES])
def test_bad_tables_get_one_sentence(row: tuple[Any, ...]) -> None:
    kind, sentence, *tables = row
    with pytest.raises(kind, match=sentence) as caught:
        Simulator(having(two_segments(), *tables))
    assert "\n" not in str(caught.value)


LASH = 'name = "backlash"\n'
FILES = {
    'name = "backlsh"': (UnknownNameError, "no effect 'backlsh'; did you mean 'backlash'"),
    LASH + "half_widht = 1e-4": (EffectError, "has no parameter 'half_widht'; did you mean 'half_width'"),
    LASH + "half_width = 1.0": (
        EffectError,
        "half_width of effect 'backlash' is 1.0 m; it must be a number from 0",
    ),
    'name = "play"\n[[effect]]\nname = "backlash"': (EffectError, "has effect 'backlash' twice"),
}


@pytest.mark.parametrize("table", FILES)
def test_a_robot_file_with_an_effect_that_is_none_is_refused_when_it_is_loaded(
    table: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, (kind, sentence) = tmp_path / "mine.toml", FILES[table]
    path.write_text(dumps(load_robot("prototype")) + f"[[effect]]\n{table}\n")
    with pytest.raises(kind, match=sentence) as caught:
        fastrod.load_robot(path)
    assert "mine.toml" in str(caught.value)
    assert main(["excite", "--robot", str(path), "--out", str(tmp_path / "run.csv")]) == 2
    assert str(caught.value) in capsys.readouterr().err
    assert not (tmp_path / "run.csv").exists()


def test_robots_of_a_batch_differ_in_what_their_effects_do_not_read() -> None:
    heavy = having(rod(), {"name": "gravity", "line_density": 0.1})
    Simulator([rod(), rod(offset=0.008)])  # which robots without effects may
    stiff = having(rod(bending_stiffness=(0.003, 0.003)), *heavy.effects)
    assert Simulator([heavy, stiff]).settle(rod().rest_tendon_length).ok.all()


def test_measure_sees_from_the_base() -> None:
    robot = replace(rod(), log_points=(0.02,))
    sim = Simulator(robot)
    state = sim.settle(bend(robot, 0.5, 0.2), base_pose=(1.0, 2.0, 3.0, np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0))
    seen = sim.measure()
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # a quarter about x
    assert_allclose(turn @ seen.tip_position[0] + [1.0, 2.0, 3.0], state.tip_position[0], atol=1e-15)
    assert_allclose(turn @ seen.tip_rotation[0], state.tip_rotation[0], atol=1e-15)
    assert_allclose(turn @ seen.points[0, 0] + [1.0, 2.0, 3.0], sim.shape(0.02).position[0, 0], atol=1e-15)


# What the library says of itself


@pytest.mark.parametrize("name", ["dynamics", "inertia", "oscillation"])
def test_a_filter_on_the_tendons_is_not_called_dynamics(name: str) -> None:
    """A robot file with the old name is answered with the new one, and with what has inertia."""
    with pytest.raises(UnknownNameError, match=r"second_order_lag.*Simulator\(dynamics=True\)") as refused:
        Simulator(having(two_segments(), {"name": name, "period": 0.1}))
    assert str(refused.value).count("\n") == 0
    assert name not in NAMES


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_says_what_it_is(name: str) -> None:
    what = get_effect(name)
    doc = type(what).__doc__ or ""
    for section in ("Equation", "Source", "Residual signature"):
        line = next(line.strip() for line in doc.splitlines() if line.strip().startswith(f"{section}:"))
        assert len(line) > len(section) + 8
    assert getattr(what, "excited_by", "x")
    for other in getattr(what, "confounded_with", ()):
        assert other in NAMES
        assert other != name
    for synonym in getattr(what, "synonyms", ()):
        assert get_effect(synonym) is what
        assert synonym not in NAMES
    for p in what.parameters:
        low, high = p.bounds
        assert all(low <= start <= high for start in (*p.starts, p.scale))
        assert p.shape or p.neutral == 0.0 != p.scale
    assert any(not p.shape for p in what.parameters)
    wiring = route(two_segments())
    assert len(columns(what, wiring)) == len(registry.read_values(name, {}, wiring, "test"))
    assert has_memory(what) == isinstance(what, (Operator, BodyOperator))


def test_effects_act_from_the_motor_to_the_camera() -> None:
    seams = [get_effect(name).seam.value for name in NAMES]
    assert seams == sorted(seams)
    contracted = (
        "gravity payload tip_force friction backlash tendon_stretch creep latency frame_misalignment "
        "marker_offset drum_gain encoder_offset precurvature routing_angle coupling stiffness_anisotropy "
        "stiffness_taper stiffening axial_compression time_drift"
    )
    assert set(contracted.split()) <= set(NAMES)


def test_wires_and_bends_belong_together() -> None:
    for robot in (one_segment(), two_segments(), load_robot("tdcr_b"), rod(n_tendons=3), rod("passive")):
        wiring = route(robot)
        change = np.random.default_rng(2).uniform(-1.0, 1.0, (5, robot.n_segments, 2))
        dl = wiring.tendon_change(change)
        for k in range(robot.n_segments) if robot.n_tendons else ():
            alone = change * (np.arange(robot.n_segments) == k)[:, None]
            expected = [bend(robot, *a[k], segment=k) - robot.rest_tendon_length for a in alone]
            assert_allclose(wiring.tendon_change(alone), expected, atol=1e-15)
        if robot.n_tendons:
            assert_allclose(wiring.bend(dl), change, atol=1e-12)
    wiring = route(two_segments())
    assert wiring.drive.tolist() == [0, 1, 0, 1, 2, 3, 2, 3]
    assert wiring.drive_sign.tolist() == [1.0, 1.0, -1.0, -1.0] * 2
    assert route(rod(n_tendons=3)).n_drives == 3
