"""Reading of a file that is damaged, hostile or fine: it is read right, or refused in one sentence.

File number k is the same for the same seed (`fuzz_seeds.py` makes it); `python perf/fuzz_files.py` tries
thousands.
"""

from __future__ import annotations

import io
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from fuzz_seeds import KINDS, Originals, write_case, write_fine

SECONDS, BYTES = 10.0, 1_000_000_000
"""Largest cost of one file."""
FINE = ("right", "refused")
_HARM = ("traceback", "code run", "over time", "over memory", "died")
WRONG = (*_HARM, "more than a line", "printed beside", "wrong exit code", "wrong values")
"""Forbidden outcomes of a file."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """Outcome of one file."""

    index: int
    kind: str
    attack: str
    """Kind of attack."""
    verdict: str
    """One of `FINE` or `WRONG`."""
    said: str
    """The sentence, or the end of the traceback."""
    seconds: float
    memory: int
    """Bytes that it added to the largest resident size of the process."""


def try_file(index: int, seed: int, folder: Path, originals: Originals) -> Outcome:
    """Make file number `index` of a seed in `folder`, and give it to what reads it."""
    rng, kind = np.random.default_rng((seed, index)), KINDS[index % len(KINDS)]
    canary = folder / "canary"
    path, attack = write_case(kind, rng, folder / str(index), canary, originals)
    _forget_peak()
    held = _peak()  # of files before, or of tests, where the system does not forget
    out, err, began = io.StringIO(), io.StringIO(), time.monotonic()
    with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("always")  # each is printed, and counted so
        verdict, said = _read(kind, path)
    seconds, memory = time.monotonic() - began, _peak() - held
    noise = err.getvalue() if kind != "policy" else ""
    if verdict in FINE and (len(said.splitlines()) > 1 or not said.isprintable()):
        verdict = "more than a line"
    if verdict in FINE and noise:
        verdict, said = "printed beside", noise
    if verdict in FINE and (seconds > SECONDS or memory > BYTES):
        verdict = "over time" if seconds > SECONDS else "over memory"
        said = f"{seconds:.1f} s, {memory / 1e9:.2f} GB; {said}"
    if canary.exists():
        verdict = "code run"
        canary.rmdir()
    _remove(path)
    return Outcome(
        index=index, kind=kind, attack=attack, verdict=verdict, said=said, seconds=seconds, memory=memory
    )


def _read(kind: str, path: Path) -> tuple[str, str]:
    """Verdict and sentence of what reads this kind of file."""
    from fastrod.errors import FastrodError

    try:
        return _READERS[kind.partition(" ")[0]](path)
    except FastrodError as error:  # the command prints it and exits with 2
        return "refused", str(error)
    except Exception:
        return "traceback", traceback.format_exc()


def _policy(path: Path) -> tuple[str, str]:
    from fastrod.commands.cli import main

    options = "--episodes 1 --no-baselines --json --option n_steps=2"
    code = main(["evaluate", "Reach", str(path), *options.split()])
    said = sys.stderr.getvalue().removesuffix("\n") if isinstance(sys.stderr, io.StringIO) else ""
    if code == 0:
        return ("right", "") if not said else ("printed beside", said)
    return ("refused" if code == 2 and said else "wrong exit code", said)


def _robot(path: Path) -> tuple[str, str]:
    from fastrod import Simulator
    from fastrod.model.robotfile import load_robot

    robot = load_robot(path)
    inputs = {"tendon_length": robot.rest_tendon_length}
    if any(segment.mode == "tendon_tension" for segment in robot.segments):
        inputs["tension"] = np.full(robot.n_tendons, 0.1)
    state = Simulator(robot, points_per_segment=4).settle(**inputs)
    finite = np.isfinite(state.tip_position[state.ok]).all()
    return _right(finite and set(state.problems) == set(np.flatnonzero(~state.ok).tolist()))


def _hardware(path: Path) -> tuple[str, str]:
    from fastrod_device.hardware import load_hardware
    from fastrod_device.units import Transmission

    drives = Transmission(load_hardware(path).drives)
    there = drives.counts(np.full(drives.n_drives, 0.001))
    return _right(np.isfinite(drives.dl(there)).all() and np.isfinite(drives.tension(there)).all())


def _log(path: Path) -> tuple[str, str]:
    from fastrod.model.robotfile import load_robot
    from fastrod_scenes.measured import read

    log = read(path, load_robot("prototype"))[0]
    return _right(len(log) and not np.isinf(log.dl).any() and not np.isinf(log.tip_position).any())


def _mesh(path: Path) -> tuple[str, str]:
    from fastrod.contact import mesh

    made = mesh(path)
    inside = len(made.faces) and made.faces.min() >= 0 and made.faces.max() < len(made.vertices)
    return _right(inside and np.isfinite(made.vertices).all())


def _right(holds: object) -> tuple[str, str]:
    return ("right" if holds else "wrong values"), ""


_READERS: dict[str, Callable[[Path], tuple[str, str]]] = {
    "policy": _policy,
    "robot": _robot,
    "hardware": _hardware,
    "log": _log,
    "mesh": _mesh,
}


def _forget_peak() -> None:
    """Begin to measure the largest resident size anew, where the system (Linux) lets a process do so."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return


def _peak() -> int:
    """Largest resident size since `_forget_peak` [bytes]; 0 where the system does not say."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")), 0)


def _remove(path: Path) -> None:
    if path.is_dir():
        for inside in path.iterdir():
            inside.unlink()
        path.rmdir()
    else:
        path.unlink(missing_ok=True)


def warm(folder: Path, originals: Originals) -> None:
    """Import what reads, and load the kernels: no file's time. Raises `AssertionError` on a fine file."""
    for kind in KINDS:
        path = write_fine(kind, folder / "fine", originals)
        with redirect_stdout(io.StringIO()):
            verdict, said = _read(kind, path)
        if kind != "policy":
            assert verdict == "right", f"{kind}: {verdict}: {said}"
        _remove(path)
