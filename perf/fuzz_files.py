"""Files from strangers by the thousand: each damaged, hostile or fine, and given to what reads it; a table of
what came of them.

    python perf/fuzz_files.py --count 20000 --seed 1

File number k is the same for the same seed (`fuzz_seeds.py` makes it). It is read right, or refused in one
sentence with exit code 2; anything else is counted in a column of its own and listed by number, which `--only
K` reads again.
"""

from __future__ import annotations

import argparse
import io
import json
import math
import multiprocessing
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from pathlib import Path

import numpy as np

from fuzz_seeds import KINDS, Originals, write_case, write_fine

SECONDS, BYTES = 10.0, 2_000_000_000
"""What one file may cost."""
_STUCK = 40.0  # seconds after which a worker is ended, on a machine that does other things too
FINE = ("right", "refused")
WRONG = (
    "traceback",
    "code run",
    "more than a line",
    "printed beside",
    "wrong exit code",
    "wrong values",
    "over time",
    "over memory",
    "died",
)
"""What may come of a file, and what may not."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of one file."""

    index: int
    kind: str
    attack: str
    """How it was spoilt."""
    verdict: str
    """One of `FINE` or `WRONG`."""
    said: str
    """The sentence, or the end of the traceback."""
    seconds: float
    memory: int
    """Largest resident size of the process while it was read, and of what it held before [bytes]."""


def try_file(index: int, seed: int, folder: Path, originals: Originals) -> Outcome:
    """Make file number `index` of a seed in `folder`, and give it to what reads it."""
    rng, kind = np.random.default_rng((seed, index)), KINDS[index % len(KINDS)]
    canary = folder / "canary"
    path, attack = write_case(kind, rng, folder / str(index), canary, originals)
    _forget_peak()
    out, err, began = io.StringIO(), io.StringIO(), time.monotonic()
    with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("always")  # each is printed, and counted so
        verdict, said = _read(kind, path)
    seconds, memory = time.monotonic() - began, _peak()
    noise = err.getvalue() if kind != "policy" else ""
    if verdict in FINE and (len(said.splitlines()) > 1 or not said.isprintable()):
        verdict = "more than a line"
    if verdict in FINE and noise:
        verdict, said = "printed beside", noise
    if verdict in FINE and (seconds > SECONDS or memory > BYTES):
        verdict, said = (
            "over time" if seconds > SECONDS else "over memory",
            f"{seconds:.1f} s, {memory / 1e9:.2f} GB; {said}",
        )
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

    words = [
        "evaluate",
        "Reach",
        str(path),
        "--episodes",
        "1",
        "--no-baselines",
        "--json",
        "--option",
        "n_steps=2",
    ]
    code = main(words)
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
    return (
        "right"
        if finite and set(state.problems) == set(np.flatnonzero(~state.ok).tolist())
        else "wrong values"
    ), ""


def _hardware(path: Path) -> tuple[str, str]:
    from fastrod_device.hardware import load_hardware
    from fastrod_device.units import Transmission

    drives = Transmission(load_hardware(path).drives)
    there = drives.counts(np.full(drives.n_drives, 0.001))
    return (
        "right"
        if np.isfinite(drives.dl(there)).all() and np.isfinite(drives.tension(there)).all()
        else "wrong values"
    ), ""


def _log(path: Path) -> tuple[str, str]:
    from fastrod.model.robotfile import load_robot
    from fastrod_scenes.measured import read

    log = read(path, load_robot("prototype"))[0]
    return (
        "right"
        if len(log) and not np.isinf(log.dl).any() and not np.isinf(log.tip_position).any()
        else "wrong values"
    ), ""


def _mesh(path: Path) -> tuple[str, str]:
    from fastrod.contact import mesh

    made = mesh(path)
    inside = len(made.faces) and made.faces.min() >= 0 and made.faces.max() < len(made.vertices)
    return ("right" if inside and np.isfinite(made.vertices).all() else "wrong values"), ""


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
    """Import what reads, and load the kernels: no file's time. Raises `AssertionError` where a fine file is
    not read."""
    for kind in KINDS:
        path = write_fine(kind, folder / "fine", originals)
        with redirect_stdout(io.StringIO()):
            verdict, said = _read(kind, path)
        if kind != "policy":
            assert verdict == "right", f"{kind}: {verdict}: {said}"
        _remove(path)


def _work(indices: Sequence[int], seed: int, ends: Connection) -> None:
    """Of a worker process: an index before each file, its outcome after it."""
    with tempfile.TemporaryDirectory() as folder:
        originals = Originals()
        warm(Path(folder), originals)
        for index in indices:
            ends.send(index)
            ends.send(try_file(index, seed, Path(folder), originals))
    ends.close()


def run(indices: Sequence[int], seed: int, workers: int) -> Iterator[Outcome]:
    """Outcomes of these files, as they come, from so many processes; one that is stuck or dies is counted,
    and another goes on."""
    context = multiprocessing.get_context("spawn")  # numba's threads do not survive a fork
    todo = [list(indices[k::workers]) for k in range(workers)]

    def start(left: Sequence[int]) -> tuple[Connection, multiprocessing.process.BaseProcess]:
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=_work, args=(left, seed, there), daemon=False)
        process.start()
        there.close()
        return here, process

    live = {k: (*start(left), time.monotonic(), -1) for k, left in enumerate(todo) if left}
    while live:
        for ready in wait([ends for ends, *_ in live.values()], timeout=1.0):
            k = next(k for k, (ends, *_) in live.items() if ends is ready)
            ends, process, _, at = live[k]
            try:
                got = ends.recv()
            except EOFError:
                process.join()
                del live[k]
                if todo[k]:
                    yield from _lost(at, "died", f"exit code {process.exitcode}", 0.0)
                    todo[k].remove(at)
                    live |= {k: (*start(todo[k]), time.monotonic(), -1)} if todo[k] else {}
                continue
            if isinstance(got, Outcome):
                todo[k].remove(got.index)
                yield got
            live[k] = (ends, process, time.monotonic(), got if isinstance(got, int) else -1)
        for k, (ends, process, since, at) in list(live.items()):
            if at >= 0 and time.monotonic() - since > _STUCK:
                process.kill()
                process.join()
                ends.close()
                yield from _lost(at, "over time", f"ended after {_STUCK:g} s", math.inf)
                todo[k].remove(at)
                del live[k]
                live |= {k: (*start(todo[k]), time.monotonic(), -1)} if todo[k] else {}


def _lost(index: int, verdict: str, said: str, seconds: float) -> Iterator[Outcome]:
    yield Outcome(
        index=index,
        kind=KINDS[index % len(KINDS)],
        attack="?",
        verdict=verdict,
        said=said,
        seconds=seconds,
        memory=0,
    )


def figures(outcomes: Sequence[Outcome]) -> dict[str, dict[str, float]]:
    """Counts, longest time [s] and largest memory [bytes] by kind, and of all."""
    groups = {kind: [o for o in outcomes if o.kind == kind] for kind in KINDS} | {"all": list(outcomes)}
    found = {}
    for kind, group in groups.items():
        counts = Counter(o.verdict for o in group)
        found[kind] = {"files": len(group), **{verdict: counts[verdict] for verdict in (*FINE, *WRONG)}}
        found[kind] |= {
            "longest s": max((o.seconds for o in group), default=0.0),
            "largest GB": max((o.memory for o in group), default=0) / 1e9,
        }
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; the exit code: 0 where every file was read right or refused in one sentence."""
    parser = argparse.ArgumentParser(description="Damaged and hostile files, and what comes of them.")
    parser.add_argument("--count", type=int, default=2000, metavar="N", help="files (default: 2000)")
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="of all files (default: 1)")
    parser.add_argument("--workers", type=int, default=2, metavar="W", help="processes (default: 2)")
    parser.add_argument(
        "--only",
        type=int,
        nargs="+",
        metavar="K",
        help="these files alone, by number, each with what was said",
    )
    parser.add_argument("--json", action="store_true", help="print the figures to stdout and nothing else")
    arguments = parser.parse_args(argv)
    outcomes = []
    for outcome in run(arguments.only or range(arguments.count), arguments.seed, arguments.workers):
        outcomes.append(outcome)
        if outcome.verdict not in FINE or arguments.only:
            said = outcome.said.strip()[-2000:]
            print(
                f"file {outcome.index}, {outcome.kind}, {outcome.attack}: {outcome.verdict}: {said}",
                file=sys.stderr,
                flush=True,
            )
        if len(outcomes) % 500 == 0:
            print(f"{len(outcomes)} files", file=sys.stderr, flush=True)
    found = figures(outcomes)
    if arguments.json:
        print(json.dumps(found, indent=1))
    else:
        names = [
            name
            for name in found["all"]
            if name in ("files", *FINE, "longest s", "largest GB") or found["all"][name]
        ]
        print("  ".join(["kind".ljust(14), *(name.rjust(max(8, len(name))) for name in names)]))
        for kind, row in found.items():
            cells = [f"{row[name]:.2f}" if isinstance(row[name], float) else str(row[name]) for name in names]
            print(
                "  ".join(
                    [
                        kind.ljust(14),
                        *(cell.rjust(max(8, len(name))) for name, cell in zip(names, cells, strict=True)),
                    ]
                )
            )
    return 0 if all(o.verdict in FINE for o in outcomes) else 1


if __name__ == "__main__":
    sys.exit(main())
