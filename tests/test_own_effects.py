"""A user's own effect: registered, at a port, refused, and brought by an installed package."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod
from test_effects import NAMES, assert_same, commands, having, run, simulator, two_segments
from verification.test_derivatives import difference

import fastrod.effects.base as registry
from fastrod import Robot, Simulator
from fastrod.effects.base import Parameter, Seam, Static, effect, effect_names, get_effect, unregister
from fastrod.effects.ports import EffectPorts
from fastrod.errors import EffectError, UnknownNameError
from fastrod.model.routing import route
from fastrod.types import Floats


class Weight:
    """Self-weight of the backbone, written by a user.

    Equation: f(s) -= w e_z, world frame
    Source: Rucker and Webster 2011, distributed load of the rod equations
    Residual signature: tip error along gravity, grows with length, blind to speed
    """

    seam = Seam.LOAD
    parameters = (Parameter("weight", "N/m", neutral=0.0, bounds=(0.0, 5.0)),)

    def memory(self, n_robots: int, n_tendons: int) -> Floats:
        return np.empty(0)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.line_force[..., 2] -= values[:, :, None]


@pytest.fixture
def clean_registry() -> Iterator[None]:
    before, synonyms = dict(registry._REGISTRY), dict(registry._SYNONYMS)
    yield
    for kept, then in ((registry._REGISTRY, before), (registry._SYNONYMS, synonyms)):
        kept.clear()
        kept.update(then)


@pytest.mark.usefixtures("clean_registry")
def test_a_users_effect_works_where_the_librarys_do() -> None:
    assert effect(Weight) is Weight
    effect(Weight)  # a module that is read again registers again
    assert "weight" in effect_names()
    robot = having(rod(), {"name": "weight", "weight": 0.1 * 9.81})
    here = Simulator(robot).settle(bend(robot, 0.5, 0.0))
    there = Simulator(rod(line_density=0.1)).settle(bend(robot, 0.5, 0.0))
    assert_allclose(here.position, there.position, atol=1e-14)
    pair = (two_segments(), having(two_segments(), {"name": "weight"}))
    assert_same(*(run(simulator(r), commands(r), moving=True) for r in pair))
    unregister("weight")
    with pytest.raises(UnknownNameError, match="no effect 'weight'"):
        Simulator(robot)


@pytest.mark.usefixtures("clean_registry")
def test_unregister_takes_a_synonym_too() -> None:
    unregister("gear_play")
    assert "backlash" not in effect_names()
    for name in ("backlash", "gear_play"):
        with pytest.raises(UnknownNameError):
            get_effect(name)
    assert "gear_play" not in registry._SYNONYMS


class Poke(Static):
    """Something leans on the backbone, written by a user.

    Equation: F at arclength a
    Source: cantilever with a load within its span
    Residual signature: a bend that no tendon asks for
    """

    frame: ClassVar[Any] = "world"
    seam = Seam.LOAD
    parameters = (
        Parameter("force", "N", typical=0.05),
        Parameter("arclength", "m", bounds=(0.0, 1.0), typical=0.03, shape=True),
    )

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.add_point_force(values[:, 1], values[:, :1] * np.array([0.0, 1.0, 0.0]), self.frame)


Lean = type("Lean", (Poke,), {"__doc__": Poke.__doc__, "__module__": __name__, "frame": "material"})


def poked(robot: Robot, force: float, arclength: float, name: str = "poke") -> Robot:
    """The robot under a force of Poke, or of Lean."""
    effect({"poke": Poke, "lean": Lean}[name])
    return having(robot, {"name": name, "force": force, "arclength": arclength})


@pytest.mark.usefixtures("clean_registry")
@pytest.mark.parametrize("name", ["poke", "lean"])
def test_a_point_force_of_an_effect_bends_a_cantilever_as_the_closed_form_says(name: str) -> None:
    """Half way: P l^3 / 24 EI there, 5 P l^3 / 48 EI at the tip."""
    load, length = 1e-3, 0.07  # P l^2 / EI; what the closed form leaves out is its square, 1e-6
    sim = Simulator(poked(rod("passive"), load * 0.0022 / length**2, 0.5 * length, name))
    state = sim.settle(tolerance=1e-13)
    assert_allclose(state.tip_position[0, 1], 5.0 / 48.0 * load * length, rtol=1e-5)
    assert_allclose(sim.shape(0.5 * length).position[0, 0, 1], load * length / 24.0, rtol=1e-5)


@pytest.mark.usefixtures("clean_registry")
def test_a_point_force_of_an_effect_is_one_that_is_given() -> None:
    lengths, near, far = bend(rod(), 0.5, -0.3), (0.031, (0.0, 0.1, 0.0)), (0.05, (0.02, 0.0, -0.03))
    one, two = Simulator(poked(rod(), 0.1, 0.031), n_robots=2), Simulator(rod(), n_robots=2)
    for given in ({}, {"line_force": np.outer(np.arange(4), [0.1, 0.3, 0.0])[None]}):
        here = one.settle(lengths, point_force=[far], tolerance=1e-13, **given)
        there = two.settle(lengths, point_force=[far, near], tolerance=1e-13, **given)
        assert_allclose(here.position, there.position, rtol=0.0, atol=1e-12)
        assert_allclose(here.tension, there.tension, rtol=0.0, atol=1e-8)  # 1e-13 m of stiff tendons
        assert_allclose(one.jacobian(), two.jacobian(), rtol=1e-6, atol=1e-7)
    assert_array_equal(
        Simulator(poked(rod(), 0.0, 0.031)).settle(lengths).tension,
        Simulator(rod()).settle(lengths, point_force=[(0.031, (0.0, 0.0, 0.0))]).tension,
    )
    beyond = Simulator(poked(rod(), 0.1, 0.9)).settle(lengths, tolerance=1e-13)
    at_tip = Simulator(rod()).settle(lengths, tip_force=(0.0, 0.1, 0.0), tolerance=1e-13)
    assert_allclose(beyond.position, at_tip.position, atol=1e-13)
    broken = np.tile(lengths, (2, 1))
    broken[1, 2] = np.nan
    assert one.settle(broken).ok.tolist() == [True, False]


@pytest.mark.usefixtures("clean_registry")
def test_the_jacobian_keeps_what_effects_add_beside_a_point_force() -> None:
    robot = having(
        poked(rod(extension=(-0.01, 0.01)), 0.1, 0.031),
        {"name": "poke", "force": 0.1, "arclength": 0.031},
        {"name": "gravity", "line_density": 0.3},
    )
    sim = Simulator(robot, points_per_segment=4)
    base = {"tendon_length": bend(robot, 0.5, -0.3), "extension": np.array([0.001])}
    assert sim.settle(**base, tolerance=1e-13).ok.all()
    jacobian = sim.jacobian()[0]
    expected = difference(sim, base, "extension", 0, 1e-6)
    assert_allclose(jacobian[:, 4], expected, atol=5e-6 * np.abs(expected).max())


@pytest.mark.usefixtures("clean_registry")
def test_a_material_force_of_an_effect_turns_with_the_rod() -> None:
    lengths, half = bend(rod(), 0.9, -0.4), np.sqrt(0.5)
    sim = Simulator(poked(rod(), 0.1, 0.031, "lean"))
    first = sim.settle(lengths, tolerance=1e-13)
    for _ in range(8):  # each by the shape of the one before
        state = sim.settle(lengths, tolerance=1e-13)
    assert np.abs(state.position - first.position).max() > 1e-6
    force = sim.shape(0.031).rotation[0, 0] @ [0.0, 0.1, 0.0]
    there = Simulator(rod()).settle(lengths, point_force=[(0.031, force)], tolerance=1e-13)
    assert_allclose(state.position, there.position, atol=1e-11)
    turned = sim.settle(lengths, base_pose=(0.1, 0.2, 0.3, half, half, 0.0, 0.0), tolerance=1e-13)
    quarter = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # about x
    assert_allclose(turned.position[0], state.position[0] @ quarter.T + [0.1, 0.2, 0.3], atol=1e-11)


@pytest.mark.usefixtures("clean_registry")
def test_a_point_force_that_cannot_be_is_refused_in_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    short = Simulator(poked(rod(), 0.1, 0.031, "lean"), outputs="tip")
    lengths = bend(rod(), 0.5, 0.0)
    short.step(lengths)  # straight before
    with pytest.raises(EffectError, match="material frame goes by the last shape; outputs='tip' keeps no"):
        short.step(lengths)
    monkeypatch.setattr(Poke, "frame", "materiel")
    with pytest.raises(EffectError, match="no frame 'materiel' of a point force; did you mean 'material'"):
        Simulator(poked(rod(), 0.1, 0.031)).step(lengths)
    monkeypatch.setattr(
        Poke, "apply", lambda self, values, memory, ports, state, dt: ports.add_point_force(0.1, (1.0, 2.0))
    )
    with pytest.raises(EffectError, match=r"force of shape \(2,\); give \(1,\) \[m\] and \(1, 3\) \[N\]"):
        Simulator(poked(rod(), 0.1, 0.031)).step(lengths)


def variant(name: str = "Weight", **changes: Any) -> type:
    return type(name, (Weight,), {"__doc__": Weight.__doc__, "__module__": "elsewhere"} | changes)


@pytest.mark.parametrize(
    ("made", "sentence"),
    [
        (
            variant(__doc__="Equation: x\nSource: y"),
            "'weight' does not say its Residual signature; its docstring needs a line",
        ),
        (variant(__doc__=None), "does not say its Equation"),
        (type("Bare", (), {"__doc__": Weight.__doc__}), "'bare' has no seam"),
        (variant(seam=3), "has seam 3; give one of"),
        (variant(parameters=()), "at least one"),
        (variant(parameters=("weight",)), "give a tuple of Parameter"),
        (variant("Backlash"), "'backlash' is already registered by fastrod.effects.laws.backlash"),
        (variant("GearPlay"), "'gear_play' is already .*backlash"),
        (variant(synonyms=("backlash",)), "'backlash' is already .*backlash"),
        (variant(synonyms=("gear_play",)), "'gear_play' is already .*backlash"),
    ],
)
@pytest.mark.usefixtures("clean_registry")
def test_a_class_that_is_no_effect_is_refused(made: type, sentence: str) -> None:
    with pytest.raises(EffectError, match=sentence) as caught:
        effect(made)
    assert "\n" not in str(caught.value)
    assert effect_names() == NAMES
    assert get_effect("gear_play") is get_effect("backlash")


def test_a_parameter_has_its_neutral_value_in_its_bounds() -> None:
    with pytest.raises(
        EffectError, match=r"'size' has neutral value 0\.0; it must lie in its bounds 1\.0 to 2\.0"
    ):
        Parameter("size", "m", bounds=(1.0, 2.0))
    assert Parameter("size", "m", bounds=(0.0, 2.0)).scale == pytest.approx(0.2)
    assert Parameter("size", "m").starts == (1.0,)
    scaled = Parameter("size", "m", bounds=(0.0, 2.0), typical=0.5, of="length").on(route(two_segments()))
    assert (scaled.bounds, scaled.of) == ((0.0, pytest.approx(0.26)), "")
    assert scaled.typical == pytest.approx(0.065)
    wiring = route(two_segments())
    curvature = Parameter("curvature", "1/m^2", bounds=(-3.0, 3.0), typical=0.1, of="1/offset^2").on(wiring)
    assert curvature.typical == pytest.approx(0.1 / wiring.tendon_offset.mean() ** 2)
    assert curvature.bounds == pytest.approx((-30.0 * curvature.scale, 30.0 * curvature.scale))


@pytest.mark.usefixtures("clean_registry")
def test_installed_packages_bring_effects_by_entry_point(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    source = '''
from fastrod.effects.base import Parameter, Seam, Static, effect

@effect
class Wind(Static):
    """Equation: F += f e_x
    Source: weather
    Residual signature: sideways
    """

    seam = Seam.LOAD
    parameters = (Parameter("force", "N", typical=0.1),)

    def apply(self, values, memory, ports, state, dt):
        ports.tip_force[:, :1] += values
'''
    (tmp_path / "breezy_effects.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    plug_in = EntryPoint("breezy", "breezy_effects", "fastrod.effects")
    found = {"fastrod.effects": [plug_in]}
    monkeypatch.setattr(registry, "entry_points", lambda group: found.get(group, []))
    registry.load_library.cache_clear()
    assert "wind" in effect_names()
    here = Simulator(having(rod(), {"name": "wind", "force": 0.1})).settle(bend(rod(), 0.3, 0.1))
    there = Simulator(rod()).settle(bend(rod(), 0.3, 0.1), tip_force=(0.1, 0.0, 0.0))
    assert_array_equal(here.position, there.position)
