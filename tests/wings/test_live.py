"""`fastrod.view`: a page that follows the user's own loop."""

import numpy as np
import pytest

import fastrod
from fastrod.contact import ContactScene, plane
from fastrod.errors import InputError
from fastrod_viewer.live import LiveWorld, view


def test_the_world_is_the_simulator_as_it_is_now() -> None:
    wall = ContactScene(obstacles=[plane(point=(0.05, 0.0, 0.0), normal=(-1.0, 0.0, 0.0), name="wall")])
    sim = fastrod.Simulator(fastrod.load_robot("prototype"), n_robots=2, contact=wall)
    sim.settle()
    world = LiveWorld(sim)
    before = world.rods[0].state.tip_position
    sim.step(sim.robots[0].rest_tendon_length + 0.003 * np.array([1.0, 0.0, -1.0, 0.0]))
    world.play()
    assert np.abs(world.rods[0].state.tip_position - before).max() > 1e-3
    assert [body.name for body in world.bodies] == ["wall"]
    assert world.poses().shape == (1, 7)
    with pytest.raises(InputError, match="nothing is dragged"):
        world.jacobian()


def test_a_view_returns_at_once_and_ends() -> None:
    sim = fastrod.Simulator(fastrod.load_robot("prototype"))
    with view(sim, port=0) as page:
        assert page.address.startswith("http://127.0.0.1:")
        assert page.address in page._repr_html_()
        assert sim.step(sim.robots[0].rest_tendon_length).ok.all()
    tips = fastrod.Simulator(fastrod.load_robot("prototype"), outputs="tip")
    with pytest.raises(InputError, match="tips only"):
        view(tips, port=0)
