"""`fastrod drive`: the prototype or its emulator, by hand, through a run, along a path, through the whole loop.

What needs two wings at once is put together here: the viewer drives a link, a policy asks for commands.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.robotfile import load_robot

if TYPE_CHECKING:
    from fastrod_device.experiment import Law, Progress
    from fastrod_device.hardware import Hardware
    from fastrod_device.workbench import Bench

DONE = 0


def _teleop(arguments: argparse.Namespace, _: Progress | None) -> int:
    """Hands drive in the browser; nothing moves when nobody watches."""
    from fastrod_viewer.app import view

    hardware = _hardware(arguments)
    with _bench(arguments, hardware, stepped=False) as bench:
        view(hardware.robot, link=bench.prototype, port=arguments.port, open_browser=not arguments.no_open)
    return DONE


def _excite(arguments: argparse.Namespace, progress: Progress | None) -> int:
    """The run that separates effects, recorded."""
    from fastrod.identification.excite import excitation
    from fastrod_device.experiment import excite

    hardware, out = _hardware(arguments), _file(arguments.out, "excite.csv")
    run = excitation(hardware.robot, payload=arguments.payload, rate=hardware.camera.rate)
    with _bench(arguments, hardware, journal=out) as bench:
        log = excite(bench.prototype, run, bench.hands, out, progress=progress)
    print(f"wrote {out}: {len(log)} rows, {int(log.measured.sum())} with the tip; next: fastrod identify {out} --robot {_named(arguments)}")
    return DONE


def _track(arguments: argparse.Namespace, _: Progress | None) -> int:
    """One turn of a path, by the model or by a policy, recorded."""
    from rich.console import Console

    from fastrod.control.inverse import plan
    from fastrod_device.experiment import follow, tracking
    from fastrod_device.loop import APPROACH, PERIOD, RATE, paths
    from fastrod_device.loop_report import tracking_table

    hardware, name = _hardware(arguments), arguments.path or "circle"
    known = paths(hardware.robot.length)
    if name not in known:
        raise UnknownNameError(f"no path {name!r}; {nearest(name, known)}")
    out = _file(arguments.out, f"{name}.csv")
    made = plan(hardware.robot, known[name].position(np.arange(0.0, PERIOD, 1.0 / RATE)), RATE, approach=APPROACH)
    law = None if arguments.policy is None else _policy(arguments.policy, name, APPROACH)
    with _bench(arguments, hardware, journal=out) as bench:
        log = follow(bench.prototype, made, out, law=law)
    Console().print(tracking_table([(("policy" if law else "model"), tracking(name, log, made))]))
    print(f"wrote {out}")
    return DONE


def _policy(given: str, path: str, begins: float) -> Law:
    """A policy of Track as a law; the path begins so many seconds into the plan."""
    try:
        from fastrod_envs.pilot import TrackPilot
        from fastrod_envs.policies import Policy, find
    except ImportError as error:
        raise InputError("--policy needs gymnasium: pip install fastrod[envs].") from error
    pilot = TrackPilot(Policy(find("Track", given)), path)
    return lambda tip, t: pilot.command(tip, t - begins)


def _loop(arguments: argparse.Namespace, progress: Progress | None) -> int:
    """Excite, identify, plan anew, track; before and after."""
    from rich.console import Console

    from fastrod.identification.replay import make_folder
    from fastrod_device.loop import close_loop
    from fastrod_device.loop_report import show, write

    hardware, out = _hardware(arguments), arguments.out or Path("loop")
    if out.exists() and any(out.iterdir()):
        raise InputError(f"folder {str(out)!r} is not empty; give --out a new one, so that nothing is written over.")
    make_folder(out)
    with _bench(arguments, hardware, journal=out / "events.csv") as bench:
        loop = close_loop(bench.prototype, bench.hands, out, payload=arguments.payload, progress=progress)
        sealed = None if bench.emulator is None else bench.emulator.seal.open()
    written = write(loop, out, sealed)
    show(loop, Console(), sealed)
    for path in written:
        print(f"wrote {path}")
    return DONE


def _calibrate(arguments: argparse.Namespace, progress: Progress | None) -> int:
    raise NotImplementedError


def _register(arguments: argparse.Namespace, progress: Progress | None) -> int:
    raise NotImplementedError


ACTIONS: dict[str, Callable[[argparse.Namespace, Progress | None], int]] = {
    "teleop": _teleop, "excite": _excite, "track": _track, "loop": _loop, "calibrate": _calibrate, "register": _register,
}  # fmt: skip
"""What each action does; the exit code."""


def _hardware(arguments: argparse.Namespace) -> Hardware:
    from fastrod_device.hardware import load_hardware

    return load_hardware(arguments.hardware, None if arguments.robot is None else load_robot(arguments.robot))


@contextmanager
def _bench(arguments: argparse.Namespace, hardware: Hardware, *, stepped: bool = True, journal: Path | None = None) -> Iterator[Bench]:
    from fastrod_device import workbench

    events = None if journal is None else journal if journal.name == "events.csv" else journal.with_suffix(".events.csv")
    home = not arguments.no_home
    if arguments.emulate:
        with workbench.emulated(
            hardware, seed=arguments.seed, stepped=stepped and not arguments.real_time, journal=events, home=home
        ) as bench:
            yield bench
        return
    camera = None if arguments.camera == "none" else int(arguments.camera) if arguments.camera.isdigit() else arguments.camera
    with workbench.real(hardware, arguments.bus, camera=camera, eds=arguments.eds, journal=events, home=home) as bench:
        yield bench


def _file(given: Path | None, name: str) -> Path:
    return given or Path(name)


def _named(arguments: argparse.Namespace) -> str:
    return str(arguments.robot or "prototype")
