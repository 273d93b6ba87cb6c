"""`fastrod.view`: a simulator that the user's own loop moves, live in the browser."""

from __future__ import annotations

import time

import numpy as np

from fastrod.errors import FastrodError, InputError
from fastrod.simulator import Simulator
from fastrod.types import Floats
from fastrod_viewer.app import App
from fastrod_viewer.picture.scene_graph import grid_places
from fastrod_viewer.worlds.robots import radii
from fastrod_viewer.worlds.simulated import bodies_of
from fastrod_viewer.worlds.world import Body, DrawnRods, ManualCommand, World

_SPACING = 1.5  # robot lengths between robots that touch nothing


class LiveWorld(World):
    """The last state of a simulator, whoever moves it."""

    about = "A simulator that your own loop moves; the page follows it."
    actions = None
    drivable = False
    scripted = True
    duration = float("inf")
    host = base_moves = loads = False
    dt = 1.0 / 30.0

    def __init__(self, simulator: Simulator) -> None:
        self.simulator, self.robot = simulator, simulator.robots[0]
        self.name = self.robot.name
        self._begun = time.monotonic()
        contact = simulator.contact
        alone = contact is None and simulator.n_robots > 1
        n = simulator.n_robots
        self._place = grid_places(n, _SPACING * self.robot.length) if alone else np.zeros((n, 3))
        self._radius = radii(self.robot, contact)
        self._bodies = bodies_of(contact, self.robot)

    @property
    def t(self) -> float:
        """Time since the page was opened [s]."""
        return time.monotonic() - self._begun

    @property
    def rods(self) -> tuple[DrawnRods, ...]:
        """The robots of the simulator as they are now."""
        sim = self.simulator
        return (DrawnRods(tuple(sim.robots), sim.state, self._place, self._radius),)

    @property
    def bodies(self) -> tuple[Body, ...]:
        """Obstacles."""
        return self._bodies

    def poses(self) -> Floats:
        """Return where they stand."""
        return np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(self._bodies), 1))

    def play(self) -> None:
        """Nothing: the user's loop does it."""

    def drive(self, command: ManualCommand) -> None:
        """Nothing: the user's loop does it."""

    def reset(self) -> None:
        """Nothing: the user's loop does it."""

    def jacobian(self) -> Floats:
        """Raises `InputError`: nothing is dragged here."""
        raise InputError("a live view follows the simulator; nothing is dragged here.")

    def close(self) -> None:
        """Nothing is held."""


class LiveView:
    """A page that follows a simulator; `close` it, or leave it open until Python ends."""

    def __init__(self, app: App) -> None:
        self._app = app

    @property
    def address(self) -> str:
        """URL of the page."""
        return self._app.address

    def close(self) -> None:
        """End the page."""
        self._app.close()

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"LiveView({self.address})"

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.address}" width="100%" height="480"></iframe>'


def view(simulator: Simulator, *, port: int | None = None, open_browser: bool = False) -> LiveView:
    """Show a simulator in the browser, and return at once: the page follows the state that your own loop
    leaves.

    Raises `InputError` for what is no simulator, or one with outputs="tip".
    """
    if not isinstance(simulator, Simulator):
        raise InputError(f"view shows a Simulator; it was given {type(simulator).__name__}.")
    try:
        state = simulator.state
    except FastrodError:  # before the first step
        state = simulator.settle()
    if not state.position.size:
        raise InputError("this simulator keeps tips only; make it with outputs='full' to view it.")
    app = App(port=port, say=lambda _: None)
    app.open(LiveWorld(simulator))
    shown = LiveView(app)
    print(f"{simulator.robots[0].name}: {app.address}", flush=True)
    if open_browser:
        app.served.open_browser()
    return shown
