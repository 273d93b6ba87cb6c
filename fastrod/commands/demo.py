"""The main job on an embedded default, start to end: a batch of robots, then a robot that is excited,
identified and driven anew.

The robot is the emulated prototype with an effect that nobody has declared. Without the packages of the
device wing, a log that ships with fastrod takes its place.
"""

from __future__ import annotations

import sys
import time
from contextlib import AbstractContextManager, nullcontext
from importlib.resources import as_file, files
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, final

import numpy as np

from fastrod.checks import NOT_NEGATIVE, check_number
from fastrod.errors import InputError
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot
from fastrod.types import Floats

if TYPE_CHECKING:
    from rich.console import Console


N_ROBOTS = 1000
N_STEPS = 200
DT = 0.01  # s
_BEND = 1.0  # rad, largest bend of a random robot
_FORCE = 0.2  # N, largest random tip load
_SEED = 7
_DEVICE = {"canopen": "canopen", "python-can": "can", "opencv-python-headless": "cv2"}
"""Packages that the emulated prototype stands on, and their modules."""


def run(out: Path | None = None, *, seed: int | None = None, view: bool = True) -> None:
    """Print a batch of random prototypes, then the whole loop on an emulated one: logs, report and identified
    robot go to the folder `out` if given. `seed` draws what the emulator hides (None: nobody knows). With
    `view`, where somebody looks on, the viewer is served at the end until Ctrl+C.

    Raises `InputError`, before the work, where that folder cannot be written or is not empty.
    """
    from rich.console import Console

    from fastrod.logs.folder import make_folder

    if out is not None:
        make_folder(out)
        if any(out.iterdir()):
            raise InputError(
                f"folder {str(out)!r} is not empty; give --out a new one, so that nothing is written over."
            )
    missing = [name for name, module in _DEVICE.items() if find_spec(module) is None]
    check_number("seed", seed or 0, NOT_NEGATIVE, whole=True)
    console = Console()
    robot = load_robot("prototype")
    _batch(robot, console)
    if missing:
        _identified(robot, console, out)
        said = (
            f"the whole loop, on an emulated prototype, needs {', '.join(missing)}: pip install "
            "'fastrod[device,viewer]'"
        )
        console.print(said, markup=False, soft_wrap=True, highlight=False)
        return
    with TemporaryDirectory() as folder:
        _looped(console, Path(folder) if out is None else out, seed, keep=out is not None, view=view)


def random_bend(rng: np.random.Generator, robot: Robot, n_robots: int) -> Floats:
    """(n_robots, n_tendons) absolute tendon lengths [m] of single-segment robots bent by a random angle in a
    random direction."""
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
    extent = 1e3 * np.ptp(state.tip_position, axis=0)
    console.print(
        f"  settle: {int(np.sum(state.ok))} of {N_ROBOTS} converged in {1e3 * settled:.1f} ms; "
        f"tips span {extent[0]:.0f} x {extent[1]:.0f} x {extent[2]:.0f} mm"
    )
    per_pass, residual = _steps(sim, start, end, force)
    console.print(
        f"  step:   {N_STEPS} steps of {1e3 * DT:g} ms to other lengths, {1e6 * per_pass:.2f} us a robot "
        "and step\n"
        f"          median boundary residual at the end {1e6 * residual:.2g} um"
    )


def _steps(sim: Any, start: Floats, end: Floats, force: Floats) -> tuple[float, float]:
    """Seconds a robot and pass, and the median boundary residual at the end [m], from `start` to `end`."""
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


def _looped(console: Console, out: Path, seed: int | None, *, keep: bool, view: bool) -> None:
    from fastrod_device.bench import report as loop_report
    from fastrod_device.bench.loop import close_loop
    from fastrod_device.bench.workbench import emulated
    from fastrod_device.hardware import load_hardware

    console.print(
        "\n[bold]An emulated prototype[/]: four CiA 402 drives on a virtual CAN bus, a camera whose frames "
        "are drawn, a robot with\n"
        "stiffnesses and an effect that nobody has declared. It is excited, identified, and its tip driven "
        "along three paths."
    )
    stages = Stages(console)
    with stages, emulated(load_hardware(), seed=seed) as bench:
        loop = close_loop(bench.prototype, bench.assistant, out, progress=stages)
        assert bench.emulator is not None
        sealed = bench.emulator.seal.open()
    written = loop_report.write(loop, out, sealed)
    console.print()
    loop_report.show(loop, console, sealed)
    command = f"fastrod view {out / 'excite.csv'} --robot {out / 'identified.toml'}"
    if keep:
        for path in written:
            console.print(f"wrote {path}", soft_wrap=True, highlight=False)
    if view and sys.stdout.isatty() and find_spec("viser") is not None:
        from fastrod_viewer.app import view as serve

        serve(out / "excite.csv", robot=out / "identified.toml")
    elif keep:
        console.print(f"the run beside both models, in a browser: {command}", soft_wrap=True, highlight=False)
    else:
        console.print(
            "logs, report and the identified robot: fastrod demo --out DIR; then fastrod view "
            "DIR/excite.csv --robot DIR/identified.toml "
            "shows the run\nbeside both models in a browser",
            soft_wrap=True,
            highlight=False,
        )
    console.print(
        "next: fastrod drive --emulate drives it by hand; --bus socketcan:can0 the real one", highlight=False
    )


@final
class Stages:
    """A progress callback (what, done, total) that says each stage once it is over, with the seconds that it
    took."""

    def __init__(self, console: Console) -> None:
        from rich.console import Console

        self._console = console
        self._status = Console(stderr=True).status("") if sys.stderr.isatty() else None
        self._what, self._began = "homing", time.perf_counter()

    def __enter__(self) -> Stages:
        if self._status is not None:
            self._status.start()
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        if self._status is not None:
            self._status.stop()
        if kind is None:
            self.begin("")

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show progress: "stage" or "stage: detail", and how far it is; another stage ends the one before."""
        if self._status is not None:
            self._status.update(f"{what}: {done} of {total}")
        if (stage := what.partition(":")[0]) != self._what:
            self.begin(stage)

    def begin(self, stage: str) -> None:
        """The last stage is over, and `stage` begins; "" for none."""
        now = time.perf_counter()
        if self._what:
            self._console.print(f"  {self._what:15} {now - self._began:5.1f} s", highlight=False)
        self._what, self._began = stage, now


def _identified(robot: Robot, console: Console, out: Path | None) -> None:
    from fastrod.identification.attribution import identify
    from fastrod.identification.report import report
    from fastrod.logs.reader import read_log

    console.print(
        "\n[bold]demo_log.csv[/], a prototype simulated by another solver, with noise and an "
        "effect that nobody declared"
    )
    with as_file(files("fastrod").joinpath("data").joinpath("demo_log.csv")) as path:
        log = read_log(path, robot)
    with _waiting("looking for what the model lacks"):
        result = identify(log, robot)
    console.print(report.table(result))
    for written in report.write(result, out) if out is not None else []:
        console.print(f"wrote {written}", soft_wrap=True, highlight=False)
    console.print(
        "next: fastrod identify LOG --robot R looks for it in your own log; --out DIR writes the report",
        highlight=False,
    )
