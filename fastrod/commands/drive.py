"""`fastrod drive`: the prototype or its emulator, by hand, through a run, along a path, through the whole
loop.

What needs two wings at once is put together here: the viewer drives a link, a policy computes commands.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fastrod.commands.parser import Actions, Command, Squares, UsageError
from fastrod.commands.terminal import DONE, FailedError, needing, print_written, progress
from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod.loading import load_robot
from fastrod.model.robot import Robot
from fastrod.types import Floats

if TYPE_CHECKING:
    from fastrod_device.bench.experiment import Law
    from fastrod_device.bench.workbench import BoardBench, EmulatedBench
    from fastrod_device.hardware import Hardware
    from fastrod_device.vision.calibration import CameraCalibration, CharucoBoard, MarkerRegistration
    from fastrod_device.vision.camera import Camera

_SWITCHES = 1e-3  # s: the thread of the drives waits no longer for one that draws
_EVENTS = "events.csv"
_EXIT = """exit code:
  0  done
  1  the robot does not answer, was stopped during the run, or what it measured does not suffice;
     what was recorded until then is kept
  2  the arguments or a file are wrong, and nothing has moved"""
_Pose = tuple[float, float, float, float, float, float, float]
"""x, y, z, and a quaternion w, x, y, z."""


@dataclass(frozen=True)
class _Eye:
    """A camera, or an emulated one.

    --emulate: the emulator in place of drives and camera
    --hardware FILE: drives, limits, camera and marker (default: the paper's prototype)
    --robot R: its model in place of the hardware file's; an identified.toml, say
    --camera DEVICE: number or path of the video device (default: 0); none, for teleop alone
    --seed S: of what the emulator hides (default: nobody knows it)
    --real-time: the emulator as slow as a robot, where nobody watches either; teleop always is
    """

    emulate: bool = False
    hardware: Path | None = None
    robot: str | None = None
    camera: str | None = None
    seed: int | None = None
    real_time: bool = False

    def __post_init__(self) -> None:
        for name, emulated in (("camera", False), ("seed", True), ("real_time", True)):
            if getattr(self, name) not in (None, False) and self.emulate != emulated:
                where = "with --emulate only" if emulated else "for a real bench, not with --emulate"
                raise UsageError(f"--{name.replace('_', '-')} is {where}.")


@dataclass(frozen=True)
class _Drives(_Eye):
    """Drives beside the camera.

    --bus INTERFACE:CHANNEL: of the drives, such as socketcan:can0
    --no-home: the tendons are taut and zero where they should be; do not wind them
    --eds FILE: EDS or DCF of the drives (default: EPOS4)
    """

    bus: str | None = None
    no_home: bool = False
    eds: Path | None = None

    def __post_init__(self) -> None:
        if self.emulate == (self.bus is not None):
            raise UsageError(
                "give --bus INTERFACE:CHANNEL or --emulate, and not both; `fastrod drive --help` says how "
                "it is used."
            )
        if self.bus is not None and ":" not in self.bus:
            raise UsageError(f"--bus is {self.bus!r}; give INTERFACE:CHANNEL, such as socketcan:can0.")
        super().__post_init__()


@dataclass(frozen=True)
class _Boarded(_Eye):
    """A charuco board beside the camera.

    --views N: pictures of the board
    --board CxR: squares side by side, and one below the other (default: 7x5)
    --square M: side of a square, as measured on the print (default: 0.02 m)
    --board-marker M: side of a marker in it (default: 0.75 of a square)
    --dictionary NAME: OpenCV's name of its markers
    --out OUT: camera file to write; never one that is there already
    """

    views: int = 25
    board: Squares = (7, 5)
    square: float = 0.02
    board_marker: float | None = None
    dictionary: str = "DICT_5X5_100"
    out: Path | None = None


def _action(command: str, *modules: str) -> Callable[[Command], Command]:
    """Decorate an action of a bench: errors of a run that failed are the exit code 1: a robot that does not
    answer or is stopped, a plan that it refused, measurements that do not suffice."""

    def decorate(function: Command) -> Command:
        @needing(command, "device", *modules)
        @functools.wraps(function)
        def run(*words: Any, **options: Any) -> int:
            from fastrod_device.errors import CalibrationError, DeviceError, RefusedError

            try:
                return function(*words, **options)
            except (DeviceError, CalibrationError, RefusedError) as error:
                raise FailedError(str(error)) from error
            except EOFError as error:
                what = "nobody answers; give it a terminal, since it prompts for loads and boards."
                raise FailedError(what) from error

        return run

    return decorate


_of_drives = _action("drive", "can", "canopen", "cv2")


@_of_drives
def teleop(drives: _Drives, *, port: int | None = None, no_open: bool = False) -> int:
    """By hand, in the browser.

    --port P: default: the first free one from 8080 on
    --no-open: do not open a browser
    """
    # nothing moves when nobody watches; stops and their reasons are kept in a file
    import contextlib
    import itertools
    import sys

    from fastrod_device.can.pacer import ordinary, urgent
    from fastrod_viewer.app import view
    from fastrod_viewer.ending import Ending
    from fastrod_viewer.server import serve
    from fastrod_viewer.worlds.simulated import FreeWorld

    def say(sentence: str) -> None:
        print(sentence, file=sys.stderr, flush=True)

    hardware = _hardware(drives, blind=True)
    urgent(1)  # all threads of the page, too: one that waits for the lock holds up those of the drives
    server = serve(port=port)  # a port that is taken is no news for after the homing
    say("Preparing the model ...")
    names = itertools.chain(["drive.csv"], (f"drive-{k}.csv" for k in itertools.count(2)))
    journal = next(path for name in names if not (path := Path(name)).with_suffix(".events.csv").exists())
    events = journal.with_suffix(".events.csv")
    switches = sys.getswitchinterval()
    sys.setswitchinterval(_SWITCHES)
    try:
        with Ending() as ending:  # homing, too, ends with the drives switched off
            # compiled or loaded now: nothing may hold up the drives later
            FreeWorld(hardware.robot).jacobian()
            wound = ", winding the tendons, looking for the marker: about 25 s"
            say(f"Finding the drives{'' if drives.no_home else wound} ...")
            with _bench(drives, hardware, stepped=False, journal=journal) as bench:
                say(f"Ready. {bench.prototype.supervisor.status}")
                model = FreeWorld(bench.prototype.robot)
                if not no_open:
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
    if ending.come:
        raise KeyboardInterrupt
    return DONE


@_of_drives
def excite(drives: _Drives, *, out: Path | None = None, payload: float | None = None) -> int:
    """The run that separates effects, recorded for `fastrod identify`.

    --out FILE: the run log, .csv or .parquet; never one that is there already (default: excite.csv)
    --payload KG: known mass at the tip (default: one that suits)
    """
    from fastrod.identification.excite import excitation
    from fastrod_device.bench.experiment import excite as drive

    hardware = _hardware(drives)
    out = _recorded(out or Path("excite.csv"), hardware)
    run = excitation(hardware.robot, payload=payload, rate=hardware.camera.rate)
    with _kept(out), progress() as bar, _bench(drives, hardware, journal=out) as bench:
        log = drive(bench.prototype, run, bench.assistant, out, progress=bar)
    print(
        f"wrote {out}: {len(log)} rows, {int(log.measured.sum())} with the tip; next: fastrod identify "
        f"{out} --robot {drives.robot or 'prototype'}"
    )
    return DONE


@_of_drives
def track(
    drives: _Drives,
    *,
    path: str = "circle",
    policy: str | None = None,
    trust: bool = False,
    out: Path | None = None,
) -> int:
    """One lap of a path, by the model or by a policy, recorded.

    --path P: triangle, square or circle
    --policy POLICY: by a policy of Track, a folder or `shipped` (default: by the model)
    --trust: read a file of stable-baselines3 where the folder has none of our own; this runs code of the
        file's author
    --out FILE: the run log, .csv or .parquet; never one that is there already (default: the path's name)
    """
    from rich.console import Console

    from fastrod.control import references
    from fastrod_device.bench.experiment import follow, tracking
    from fastrod_device.bench.loop import APPROACH, planned
    from fastrod_device.bench.report import tracking_table

    hardware = _hardware(drives)
    known = references(hardware.robot.length)
    if path not in known:
        raise UnknownNameError(f"no path {path!r}; {nearest(path, known)}")
    out = _recorded(out or Path(f"{path}.csv"), hardware)
    law = None if policy is None else _policy(policy, path, APPROACH, hardware.robot, trust)
    made = planned(hardware.robot, known[path])
    with _kept(out), _bench(drives, hardware, journal=out) as bench:
        log = follow(bench.prototype, made, out, law=law)
    Console().print(tracking_table([(("policy" if law else "model"), tracking(path, log, made))]))
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


@_of_drives
def loop(drives: _Drives, *, out: Path | None = None, payload: float | None = None) -> int:
    """Excite, identify, plan anew, track; the error before and after.

    --out DIR: an empty folder, or a new one (default: loop)
    --payload KG: known mass at the tip (default: one that suits)
    """
    from rich.console import Console

    from fastrod.logs.folder import make_folder
    from fastrod_device.bench.loop import close_loop
    from fastrod_device.bench.report import show, write

    hardware, out = _hardware(drives), out or Path("loop")
    if out.is_dir() and any(path.name != _EVENTS for path in out.iterdir()):
        raise InputError(
            f"folder {str(out)!r} is not empty; give --out a new one, so that nothing is written over."
        )
    make_folder(out)
    with _kept(out), progress() as bar, _bench(drives, hardware, journal=out / _EVENTS) as bench:
        made = close_loop(bench.prototype, bench.assistant, out, payload=payload, progress=bar)
        sealed = None if bench.emulator is None else bench.emulator.seal.open()
    written = write(made, out, sealed)
    show(made, Console(), sealed)
    print_written(written)
    return DONE


@_action("camera", "cv2")
def calibrate(eye: _Boarded) -> int:
    """The lens, from pictures of a charuco board that is waved; no drives needed."""
    from rich.console import Console

    from fastrod_device.bench.boards import collect, lens_table
    from fastrod_device.vision.calibration import calibrate as found_lens
    from fastrod_device.vision.camera import save_camera

    before, board, out = _hardware(eye).camera, _board(eye), _camera_file(eye.out or Path("camera.toml"))
    if eye.views < 5:
        raise InputError(f"--views is {eye.views}; calibrate needs 5 or more.")
    with progress() as bar, _board_bench(eye, before, board, lens=True) as bench:
        bench.assistant.wave()
        taken = collect(bench.source, board, eye.views, bench.clock, progress=bar)
    found = found_lens(taken.pictures, board)
    Console().print(lens_table(found, before, bench.truth))
    _report_views(found, taken.counted)
    save_camera(replace(before, matrix=found.camera().matrix, distortion=found.camera().distortion), out)
    print(f"wrote {out}: the file's camera with this lens; {_put_camera(out, eye)}")
    return DONE


@_action("camera", "cv2")
def register(eye: _Boarded, *, at: Sequence[_Pose] = ()) -> int:
    """The camera's place, from pictures of a board at known places; no drives needed.

    --at X Y Z QW QX QY QZ: where the board is, base_from_board [m] and quaternion; its origin is the outer
        corner at the print's top left, x right, y down, z into the paper. Several times: it is put at one
        after the other
    """
    from rich.console import Console

    from fastrod_device.bench.boards import collect, fixtures, place_table
    from fastrod_device.vision.calibration import register_base
    from fastrod_device.vision.camera import save_camera

    before, board = _hardware(eye).camera, _board(eye)
    out = _camera_file(eye.out or Path("camera_placed.toml"))
    if not at and not eye.emulate:
        raise InputError(
            "say where the board is, base_from_board: --at X Y Z QW QX QY QZ, in metres; once "
            "or several times."
        )
    if eye.views < 1:
        raise InputError(f"--views is {eye.views}; register needs 1 or more.")
    places = [_place(row) for row in at] if at else fixtures(before, board)
    each = -(-eye.views // len(places))
    with progress() as bar, _board_bench(eye, before, board, lens=False) as bench:
        taken = []
        for position, quaternion in places:
            bench.assistant.place(position, quaternion)
            taken.append(collect(bench.source, board, each, bench.clock, apart=0.0, progress=bar))
    pictures = [picture for some in taken for picture in some.pictures]
    counts = [len(some.pictures) for some in taken]
    position, quaternion = (np.repeat(np.stack(rows), counts, axis=0) for rows in zip(*places, strict=True))
    found = register_base(pictures, board, before, position=position, quaternion=quaternion)
    Console().print(place_table(found, before, bench.truth))
    _report_views(found, "; ".join(some.counted for some in taken))
    save_camera(found.camera(before), out)
    print(f"wrote {out}: the file's camera at this place; {_put_camera(out, eye)}")
    return DONE


@_of_drives
def latency(drives: _Drives, *, out: Path | None = None) -> int:
    """The latency of the camera, from a motion of some seconds.

    --out OUT: camera file to write; never one that is there already (default: the figure alone)
    """
    from fastrod_device.bench.latency import measure_latency
    from fastrod_device.vision.camera import save_camera

    hardware, out = _hardware(drives), None if out is None else _camera_file(out)
    with _bench(drives, hardware) as bench:
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
    print(f"wrote {out}: the file's camera with latency = {now:g}; {_put_camera(out, drives)}")
    return DONE


DRIVE = Actions(
    "The prototype on its bus, or its emulator: by hand, through a run, along a path, or the whole loop.",
    {"teleop": teleop, "excite": excite, "track": track, "loop": loop, "latency": latency},
    default="teleop",
    epilog=_EXIT,
)
CAMERA = Actions(
    "The camera of the prototype, or an emulated one: its lens, and where it stands.",
    {"calibrate": calibrate, "register": register},
    epilog=_EXIT,
)


def _hardware(eye: _Eye, *, blind: bool = False) -> Hardware:
    """The hardware file. `blind` is for what needs no camera."""
    from fastrod_device.hardware import load_hardware

    if eye.camera == "none" and not blind:
        raise UsageError("--camera none is for teleop alone; all else needs a camera.")
    return load_hardware(eye.hardware, None if eye.robot is None else load_robot(eye.robot))


@contextmanager
def _bench(
    drives: _Drives, hardware: Hardware, *, stepped: bool = True, journal: Path | None = None
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
    home = not drives.no_home
    if drives.bus is None:
        made = workbench.emulated(
            hardware,
            seed=drives.seed,
            stepped=stepped and not drives.real_time,
            journal=events,
            home=home,
            eds=drives.eds,
        )
    else:
        made = workbench.real(
            hardware, drives.bus, camera=_device(drives), eds=drives.eds, journal=events, home=home
        )
    with made as bench:
        for sentence in bench.prototype.drives.notices:
            print(sentence, file=sys.stderr, flush=True)
        yield bench


@contextmanager
def _board_bench(eye: _Boarded, camera: Camera, board: CharucoBoard, *, lens: bool) -> Iterator[BoardBench]:
    """Emulated, what is hidden is the lens, or else where the camera stands."""
    from fastrod_device.bench import workbench

    if eye.emulate:
        with workbench.emulated_board(
            camera, board, lens=lens, seed=eye.seed, stepped=not eye.real_time
        ) as bench:
            yield bench
        return
    device = _device(eye)
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


def _put_camera(out: Path, eye: _Eye) -> str:
    from fastrod_device.hardware import SHIPPED

    file = eye.hardware or f"a copy of {SHIPPED}, which --hardware then names"
    return (
        f'beside the hardware file it is used by the line camera = "{out.name}" above the first table, '
        f"in place of [camera], in {file}"
    )


def _device(eye: _Eye) -> int | str | None:
    """Return the number or path of the camera; None: without."""
    given = eye.camera or "0"
    return None if given == "none" else int(given) if given.isdigit() else str(given)


def _board(eye: _Boarded) -> CharucoBoard:
    from fastrod_device.vision.calibration import CharucoBoard

    columns, rows = eye.board
    marker = 0.75 * eye.square if eye.board_marker is None else eye.board_marker
    return CharucoBoard(
        columns=columns, rows=rows, square=eye.square, marker=marker, dictionary=eye.dictionary
    )


def _place(row: _Pose) -> tuple[Floats, Floats]:
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
