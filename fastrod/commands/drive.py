"""`fastrod drive`: the prototype or its emulator, by hand, through a run, along a path, through the whole
loop.

What needs two wings at once is put together here: the viewer drives a link, a policy computes commands.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.loading import load_robot
from fastrod.model.robot import Robot
from fastrod.types import Floats

if TYPE_CHECKING:
    from fastrod_device.bench.experiment import Law, Progress
    from fastrod_device.bench.workbench import BoardBench, EmulatedBench
    from fastrod_device.hardware import Hardware
    from fastrod_device.vision.calibration import CameraCalibration, CharucoBoard, MarkerRegistration
    from fastrod_device.vision.camera import Camera

DONE = 0
_SWITCHES = 1e-3  # s: the thread of the drives waits no longer for one that draws
_EVENTS = "events.csv"


def _teleop(arguments: argparse.Namespace, _: Progress | None) -> int:
    """Drive by hand in the browser; nothing moves when nobody watches. Stops and their reasons are kept in a
    file."""
    import contextlib
    import itertools
    import signal
    import sys

    from fastrod_device.can.pacer import ordinary, urgent
    from fastrod_viewer.app import view
    from fastrod_viewer.server import serve
    from fastrod_viewer.worlds.simulated import FreeWorld

    def say(sentence: str) -> None:
        print(sentence, file=sys.stderr, flush=True)

    # homing, too, ends with the drives switched off
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    hardware = _hardware(arguments)
    urgent(1)  # all threads of the page, too: one that waits for the lock holds up those of the drives
    server = serve(port=arguments.port)  # a port that is taken is no news for after the homing
    say("Preparing the model ...")
    FreeWorld(hardware.robot).jacobian()  # compiled or loaded now: nothing may hold up the drives later
    say(
        "Finding the drives ..."
        if arguments.no_home
        else "Finding the drives, winding the tendons, looking for the marker: about 25 s ..."
    )
    names = itertools.chain(["drive.csv"], (f"drive-{k}.csv" for k in itertools.count(2)))
    journal = next(path for name in names if not (path := Path(name)).with_suffix(".events.csv").exists())
    events = journal.with_suffix(".events.csv")
    switches = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCHES)
    try:
        with _bench(arguments, hardware, stepped=False, journal=journal) as bench:
            say(f"Ready. {bench.prototype.supervisor.status}")
            model = FreeWorld(bench.prototype.robot)
            if not arguments.no_open:
                ordinary()  # a browser must not come before other programs
                server.open_browser()
                urgent(1)
            view(model, link=bench.prototype, server=server, open_browser=False)
        say("The drives are switched off.")
    finally:
        with contextlib.suppress(OSError):
            if events.stat().st_size:
                say(f"What happened to the drives is in {events}.")
            else:
                events.unlink()
        ordinary()
        sys.setswitchinterval(switches)
        server.stop()
    return DONE


def _excite(arguments: argparse.Namespace, progress: Progress | None) -> int:
    """The run that separates effects, recorded."""
    from fastrod.identification.excite import excitation
    from fastrod_device.bench.experiment import excite

    hardware = _hardware(arguments)
    out = _recorded(arguments.out or Path("excite.csv"), hardware)
    run = excitation(hardware.robot, payload=arguments.payload, rate=hardware.camera.rate)
    with _kept(out), _bench(arguments, hardware, journal=out) as bench:
        log = excite(bench.prototype, run, bench.assistant, out, progress=progress)
    print(
        f"wrote {out}: {len(log)} rows, {int(log.measured.sum())} with the tip; next: fastrod identify "
        f"{out} --robot {_named(arguments)}"
    )
    return DONE


def _track(arguments: argparse.Namespace, _: Progress | None) -> int:
    """Follow one lap of a path, by the model or by a policy, recorded."""
    from rich.console import Console

    from fastrod.control import references
    from fastrod_device.bench.experiment import follow, tracking
    from fastrod_device.bench.loop import APPROACH, planned
    from fastrod_device.bench.report import tracking_table

    hardware, name = _hardware(arguments), arguments.path or "circle"
    known = references(hardware.robot.length)
    if name not in known:
        raise UnknownNameError(f"no path {name!r}; {nearest(name, known)}")
    out = _recorded(arguments.out or Path(f"{name}.csv"), hardware)
    law = (
        None
        if arguments.policy is None
        else _policy(arguments.policy, name, APPROACH, hardware.robot, arguments.trust)
    )
    made = planned(hardware.robot, known[name])
    with _kept(out), _bench(arguments, hardware, journal=out) as bench:
        log = follow(bench.prototype, made, out, law=law)
    Console().print(tracking_table([(("policy" if law else "model"), tracking(name, log, made))]))
    print(f"wrote {out}")
    return DONE


def _policy(given: str, path: str, begins: float, robot: Robot, trust: bool) -> Law:
    """A policy of Track as a law; the path begins so many seconds into the plan."""
    try:
        from fastrod_envs.learning.policies import Policy, find
        from fastrod_envs.learning.policy_driver import PolicyDriver
    except ImportError as error:
        raise InputError("--policy needs gymnasium: pip install 'fastrod[envs]'.") from error
    driver = PolicyDriver(Policy(find("Track", given), trust=trust), path, robot)
    return lambda tip, t: driver.command(tip, t - begins)


def _loop(arguments: argparse.Namespace, progress: Progress | None) -> int:
    """Excite, identify, plan anew, track; before and after."""
    from rich.console import Console

    from fastrod.logs.folder import make_folder
    from fastrod_device.bench.loop import close_loop
    from fastrod_device.bench.report import show, write

    hardware, out = _hardware(arguments), arguments.out or Path("loop")
    if out.is_dir() and any(path.name != _EVENTS for path in out.iterdir()):
        raise InputError(
            f"folder {str(out)!r} is not empty; give --out a new one, so that nothing is written over."
        )
    make_folder(out)
    with _kept(out), _bench(arguments, hardware, journal=out / _EVENTS) as bench:
        loop = close_loop(bench.prototype, bench.assistant, out, payload=arguments.payload, progress=progress)
        sealed = None if bench.emulator is None else bench.emulator.seal.open()
    written = write(loop, out, sealed)
    show(loop, Console(), sealed)
    for path in written:
        print(f"wrote {path}")
    return DONE


def _calibrate(arguments: argparse.Namespace, progress: Progress | None) -> int:
    """Calibrate the lens from pictures of a board that is waved."""
    from rich.console import Console

    from fastrod_device.bench.boards import collect, lens_table
    from fastrod_device.vision.calibration import calibrate
    from fastrod_device.vision.camera import save_camera

    hardware, board, out = (
        _hardware(arguments),
        _board(arguments),
        _camera_file(arguments.out or Path("camera.toml")),
    )
    before = hardware.camera
    with _board_bench(arguments, before, board, lens=True) as bench:
        bench.assistant.wave()
        taken = collect(bench.source, board, _views(arguments), bench.clock, progress=progress)
    found = calibrate(taken.pictures, board)
    Console().print(lens_table(found, before, bench.truth))
    _report_views(found, taken.counted)
    save_camera(replace(before, matrix=found.camera().matrix, distortion=found.camera().distortion), out)
    print(f"wrote {out}: the file's camera with this lens; {_put_camera(out, arguments)}")
    return DONE


def _register(arguments: argparse.Namespace, progress: Progress | None) -> int:
    """Calibrate the camera's pose from pictures of a board at known places."""
    from rich.console import Console

    from fastrod_device.bench.boards import collect, fixtures, place_table
    from fastrod_device.vision.calibration import register_base
    from fastrod_device.vision.camera import save_camera

    hardware, board, out = (
        _hardware(arguments),
        _board(arguments),
        _camera_file(arguments.out or Path("camera_placed.toml")),
    )
    before = hardware.camera
    if arguments.at is None and not arguments.emulate:
        raise InputError(
            "say where the board is, base_from_board: --at X Y Z QW QX QY QZ, in metres; once "
            "or several times."
        )
    places = [_place(row) for row in arguments.at] if arguments.at else fixtures(before, board)
    each = -(-_views(arguments) // len(places))
    with _board_bench(arguments, before, board, lens=False) as bench:
        taken = []
        for position, quaternion in places:
            bench.assistant.place(position, quaternion)
            taken.append(collect(bench.source, board, each, bench.clock, apart=0.0, progress=progress))
    pictures = [picture for some in taken for picture in some.pictures]
    counts = [len(some.pictures) for some in taken]
    position, quaternion = (np.repeat(np.stack(rows), counts, axis=0) for rows in zip(*places, strict=True))
    found = register_base(pictures, board, before, position=position, quaternion=quaternion)
    Console().print(place_table(found, before, bench.truth))
    _report_views(found, "; ".join(some.counted for some in taken))
    save_camera(found.camera(before), out)
    print(f"wrote {out}: the file's camera at this place; {_put_camera(out, arguments)}")
    return DONE


def _latency(arguments: argparse.Namespace, _: Progress | None) -> int:
    """Measure the camera's latency from a motion of some seconds."""
    from fastrod_device.bench.latency import measure_latency
    from fastrod_device.vision.camera import save_camera

    hardware, out = _hardware(arguments), None if arguments.out is None else _camera_file(arguments.out)
    with _bench(arguments, hardware) as bench:
        found = measure_latency(bench.prototype)
        sealed = None if bench.emulator is None else bench.emulator.seal.open()
    stated, now = hardware.camera.latency, max(0.0, round(hardware.camera.latency + found.delay, 4))
    print(
        f"the tip is seen {1e3 * found.delay:.1f} ms late (standard error {1e3 * found.stderr:.1f} ms), "
        f"beyond the {1e3 * stated:g} ms "
        "that the hardware file has; of strong friction or backlash some ms may count as late, too"
    )
    if sealed is not None:
        own = 1e3 * sealed.get("latency", {}).get("delay", 0.0)
        print(f"hidden in the emulator: {own:.1f} ms; its effect: {', '.join(sealed) or 'none'}")
    if out is None:
        print(f"in the hardware file's [camera], or in the camera file that it names: latency = {now:g}")
        return DONE
    save_camera(replace(hardware.camera, latency=now), out)
    print(f"wrote {out}: the file's camera with latency = {now:g}; {_put_camera(out, arguments)}")
    return DONE


ACTIONS: dict[str, Callable[[argparse.Namespace, Progress | None], int]] = {
    "teleop": _teleop,
    "excite": _excite,
    "track": _track,
    "loop": _loop,
    "calibrate": _calibrate,
    "register": _register,
    "latency": _latency,
}
"""Run an action and return the exit code."""


def _hardware(arguments: argparse.Namespace) -> Hardware:
    from fastrod_device.hardware import load_hardware

    return load_hardware(arguments.hardware, None if arguments.robot is None else load_robot(arguments.robot))


@contextmanager
def _bench(
    arguments: argparse.Namespace, hardware: Hardware, *, stepped: bool = True, journal: Path | None = None
) -> Iterator[EmulatedBench]:
    import sys

    from fastrod_device.bench import workbench

    events = (
        None
        if journal is None
        else journal
        if journal.name == _EVENTS
        else journal.with_suffix(".events.csv")
    )
    home = not arguments.no_home
    if arguments.emulate:
        made = workbench.emulated(
            hardware,
            seed=arguments.seed,
            stepped=stepped and not arguments.real_time,
            journal=events,
            home=home,
            eds=arguments.eds,
        )
    else:
        made = workbench.real(
            hardware, arguments.bus, camera=_device(arguments), eds=arguments.eds, journal=events, home=home
        )
    with made as bench:
        for sentence in bench.prototype.drives.notices:
            print(sentence, file=sys.stderr, flush=True)
        yield bench


@contextmanager
def _board_bench(
    arguments: argparse.Namespace, camera: Camera, board: CharucoBoard, *, lens: bool
) -> Iterator[BoardBench]:
    """Emulated, what is hidden is the lens, or else where the camera stands."""
    from fastrod_device.bench import workbench

    if arguments.emulate:
        with workbench.emulated_board(
            camera, board, lens=lens, seed=arguments.seed, stepped=not arguments.real_time
        ) as bench:
            yield bench
        return
    device = _device(arguments)
    assert device is not None  # `--camera none` is refused before
    with workbench.real_board(camera, device) as bench:
        yield bench


@contextmanager
def _kept(out: Path) -> Iterator[None]:
    """Says where the rows are that were recorded before something stopped the robot."""
    from fastrod_device.errors import DeviceError, RefusedError

    try:
        yield
    except (DeviceError, RefusedError, KeyboardInterrupt):
        if out.is_file() or (out.is_dir() and any(out.glob("*.csv"))):
            print(f"what was recorded until then is in {out}")
        raise


def _recorded(out: Path, hardware: Hardware) -> Path:
    """A file that can be recorded to; refused before anything moves."""
    from fastrod.logs.recording import Recorder

    Recorder(hardware.robot, out)
    return out


def _camera_file(out: Path) -> Path:
    if out.suffix != ".toml":
        raise InputError(f"{str(out)!r} does not end in .toml; a camera file does.")
    if out.exists():
        raise InputError(
            f"{str(out)!r} is there already; give --out another name, so that nothing is written over."
        )
    if not out.parent.is_dir():
        raise InputError(f"folder {str(out.parent)!r} is not there; make it, or write somewhere else.")
    return out


def _put_camera(out: Path, arguments: argparse.Namespace) -> str:
    from fastrod_device.hardware import SHIPPED

    file = (
        f"{arguments.hardware}"
        if arguments.hardware
        else (f"a copy of {SHIPPED}, which --hardware then names")
    )
    return (
        f'beside the hardware file it is used by the line camera = "{out.name}" above the first table, '
        f"in place of [camera], in {file}"
    )


def _device(arguments: argparse.Namespace) -> int | str | None:
    """Return the number or path of the camera; None: without."""
    given = arguments.camera or "0"
    return None if given == "none" else int(given) if given.isdigit() else str(given)


def _board(arguments: argparse.Namespace) -> CharucoBoard:
    from fastrod_device.vision.calibration import CharucoBoard

    columns, rows = arguments.board or (7, 5)
    square = 0.02 if arguments.square is None else arguments.square
    marker = 0.75 * square if arguments.board_marker is None else arguments.board_marker
    return CharucoBoard(
        columns=columns,
        rows=rows,
        square=square,
        marker=marker,
        dictionary=arguments.dictionary or "DICT_5X5_100",
    )


def _views(arguments: argparse.Namespace) -> int:
    least, views = (
        5 if arguments.action == "calibrate" else 1,
        25 if arguments.views is None else arguments.views,
    )
    if views < least:
        raise InputError(f"--views is {views}; {arguments.action} needs {least} or more.")
    return int(views)


def _place(row: Sequence[float]) -> tuple[Floats, Floats]:
    """Base_from_board as it was given."""
    position, quaternion = np.array(row[:3]), np.array(row[3:])
    norm = float(np.linalg.norm(quaternion))
    if not np.isfinite(row).all() or abs(norm - 1.0) > 1e-2:
        raise InputError(f"--at is {list(row)}; give x y z in metres and a quaternion w x y z of norm 1.")
    if np.abs(position).max() > 3.0:
        raise InputError(f"--at is {list(row)}; the board is more than 3 m away. Was it given in mm?")
    return position, quaternion / norm


def _report_views(found: CameraCalibration | MarkerRegistration, passed: str) -> None:
    print(
        f"{len(found.used)} views used, reprojection error {found.error:.3f} px rms; {len(found.refused)} "
        "views refused"
    )
    for k, why in found.refused:
        print(f"  view {k + 1}: {why}")
    print(f"frames passed over: {passed}")


def _named(arguments: argparse.Namespace) -> str:
    return str(arguments.robot or "prototype")
