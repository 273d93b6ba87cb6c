"""A rod that rings, in a real browser: its tip is pulled, let go, and dies down; slow motion and pause."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from rods import rod
from windows import Window

import fastrod
from fastrod_viewer.app import App
from fastrod_viewer.drive.page import DrivePage
from fastrod_viewer.worlds.simulated import FreeWorld

LENGTH = 0.3


def damped() -> fastrod.Robot:
    """A rod of 2.8 Hz without weight, whose lowest mode loses a fifth of its amplitude in a period."""
    material = {"bending_stiffness": (0.01, 0.01), "torsional_stiffness": 0.008, "line_density": 0.05}
    made = rod("passive", length=LENGTH, damping_time=4e-3, **material)
    return replace(made, name="whip", gravity=(0.0, 0.0, 0.0))


def energy(page: DrivePage) -> float:
    """Kinetic and strain energy [J]."""
    state = page.world.rods[0].state
    return float(state.kinetic_energy[0] + state.strain_energy[0])


@pytest.mark.study
def test_a_pulled_tip_let_go_rings_and_dies_down(app: App, window: Callable[..., Window]) -> None:
    app.open(FreeWorld(damped(), dt=2e-3, dynamics=True))
    seen = window(app.address)
    page = app.page
    assert isinstance(page, DrivePage)
    world, session = page.world, page.session
    start = world.rods[0].state.tip_position[0].copy()
    begins = app.server.initial_camera.position
    assert seen.until(
        lambda: any(
            np.linalg.norm(client.camera.position - begins) < 1e-2
            for client in app.server.get_clients().values()
        )
    )
    assert seen.shows("Rings at")
    assert seen.shows("2.78 Hz")
    x, y = seen.place_of(page.drawing.tip(), app)
    mouse = seen.page.mouse
    mouse.move(x, y)
    mouse.down()
    for k in range(1, 21):
        mouse.move(x + 6 * k, y + 2 * k)
        seen.page.wait_for_timeout(30)
    assert seen.until(lambda: page.teleop.dragged_to is not None)
    pulled = page.teleop.dragged_to
    # a spring of ten times its stiffness: the tip follows most of the way, and the page shows the force
    assert seen.until(lambda: energy(page) > 1e-4 and world.rods[0].state.kinetic_energy[0] < 1e-7)
    held = world.rods[0].state.tip_position[0]
    assert np.linalg.norm(held - start) > 0.5 * np.linalg.norm(pulled - start)
    stored = energy(page)
    mouse.up()
    assert seen.until(lambda: page.teleop.dragged_to is None)
    side = (held - start) / np.linalg.norm(held - start)
    # it swings through to the other side, again and again, and each time less
    assert seen.until(lambda: float((world.rods[0].state.tip_position[0] - start) @ side) < 0.0)
    seen.pick("Slow motion", "1/5")
    assert seen.until(lambda: session.speed == 0.2)
    assert seen.until(lambda: float((world.rods[0].state.tip_position[0] - start) @ side) > 0.0)
    assert energy(page) < stored
    assert seen.shows(re.compile(r" s, (1\d|20|[1-9])% of real time"))
    seen.button("Pause").click()
    assert seen.until(lambda: session.paused)
    seen.page.wait_for_timeout(200)
    still = world.t
    seen.page.wait_for_timeout(300)
    assert world.t == still
    seen.button("Resume").last.click()  # the first is that after a stop
    seen.pick("Slow motion", "real time")
    assert seen.until(lambda: session.speed == 1.0)
    assert seen.until(lambda: bool(world.ringing.rests))
    assert energy(page) < 1e-6 * stored
    assert np.linalg.norm(world.rods[0].state.tip_position[0] - start) < 1e-3 * LENGTH
    assert seen.errors == []
