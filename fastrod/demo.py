"""The main job on an embedded default, start to end: a batch of robots, then a log and what the model lacks to explain it."""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from importlib.resources import as_file, files
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fastrod.robot import Robot
from fastrod.robotfile import load_robot
from fastrod.types import Floats

if TYPE_CHECKING:
    from rich.console import Console


N_ROBOTS = 1000
N_STEPS = 200
DT = 0.01  # s
_BEND = 1.0  # rad, largest bend of a random robot
_FORCE = 0.2  # N, largest random tip load
_SEED = 7


def run(out: Path | None = None) -> None:
    """Print a batch of random prototypes and what the shipped log tells; the report goes to the folder `out` if given.

    Raises `InputError`, before the work, where that folder cannot be written.
    """
    from rich.console import Console

    from fastrod.identification.replay import make_folder

    if out is not None:
        make_folder(out)
    console = Console()
    robot = load_robot("prototype")
    _batch(robot, console)
    _identified(robot, console, out)


def random_bend(rng: np.random.Generator, robot: Robot, n_robots: int) -> Floats:
    """(n_robots, n_tendons) absolute tendon lengths [m] of single-segment robots bent by a random angle in a random direction."""
    direction = rng.uniform(0.0, 2.0 * np.pi, n_robots)
    bend = _BEND * np.sqrt(rng.uniform(0.0, 1.0, n_robots))
    vector = bend[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)
    places = np.array([tendon.position(1)[0] for tendon in robot.tendons])
    return np.asarray(robot.rest_tendon_length - vector @ places.T, dtype=np.float64)


def _batch(robot: Robot, console: Console) -> None:
    from fastrod.simulator import Simulator

    rng = np.random.default_rng(_SEED)
    start, end = random_bend(rng, robot, N_ROBOTS), random_bend(rng, robot, N_ROBOTS)
    force = rng.uniform(-_FORCE, _FORCE, (N_ROBOTS, 3)) / np.sqrt(3.0)
    sim = Simulator(robot, n_robots=N_ROBOTS, dt=DT)
    console.print(f"[bold]{N_ROBOTS} prototypes[/], random tendon lengths, random tip loads to {_FORCE:g} N")
    with _waiting("compiling the kernels, once on this machine"):
        sim.settle(start, tip_force=force)
        sim.step(start, tip_force=force)
    clock = time.perf_counter()
    state = Simulator(robot, n_robots=N_ROBOTS, dt=DT).settle(start, tip_force=force)
    settled = time.perf_counter() - clock
    reach = 1e3 * np.ptp(state.tip_position, axis=0)
    console.print(
        f"  settle: {int(np.sum(state.ok))} of {N_ROBOTS} converged in {1e3 * settled:.1f} ms; "
        f"tips span {reach[0]:.0f} x {reach[1]:.0f} x {reach[2]:.0f} mm"
    )
    per_pass, residual = _steps(sim, start, end, force)
    console.print(
        f"  step:   {N_STEPS} steps of {1e3 * DT:g} ms to other lengths, {1e6 * per_pass:.2f} us a robot and step\n"
        f"          median boundary residual at the end {1e6 * residual:.2g} um"
    )


def _steps(sim: Any, start: Floats, end: Floats, force: Floats) -> tuple[float, float]:
    """Seconds a robot and pass, and the median boundary residual at the end [m], on the way from `start` to `end`."""
    commands = [start + (k + 1) / N_STEPS * (end - start) for k in range(N_STEPS)]
    clock = time.perf_counter()
    for command in commands:
        state = sim.step(command, tip_force=force)
    elapsed = time.perf_counter() - clock
    return elapsed / (N_STEPS * len(start)), float(np.median(state.residual))


def _waiting(why: str) -> AbstractContextManager[object]:
    """A line on stderr while something takes long, where stderr is a terminal."""
    from rich.console import Console

    return Console(stderr=True).status(why) if sys.stderr.isatty() else nullcontext()


def _identified(robot: Robot, console: Console, out: Path | None) -> None:
    from fastrod.identification import report
    from fastrod.identification.attribution import identify
    from fastrod.runlog import read_log

    console.print("\n[bold]demo_log.csv[/], a prototype simulated by another solver, with noise and an effect that nobody declared")
    with as_file(files("fastrod").joinpath("data").joinpath("demo_log.csv")) as path:
        log = read_log(path, robot)
    with _waiting("looking for what the model lacks"):
        result = identify(log, robot)
    console.print(report.table(result))
    for written in report.write(result, out) if out is not None else []:
        console.print(f"wrote {written}", soft_wrap=True, highlight=False)
    console.print("next: fastrod identify LOG --robot R looks for it in your own log; --out DIR writes the report", highlight=False)
