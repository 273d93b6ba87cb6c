"""A large batch on a GPU beside the CPU: `fastrod bench cuda`, or this file as a script; `--json` for
programs, `--quick` for a smoke run, `--robots` for another size. Without a GPU: what a pass reads, writes and
reckons, and one sentence."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np

import cases
import flops
import report
from cases import Case
from fastrod import Simulator, State
from fastrod.errors import InputError
from fastrod.solver.gpu.device import checked
from fastrod.types import Ports
from report import Column, Row, Section, note_progress, seconds

_STEPS = 6
_TARGET = 50.0  # times two threads of the CPU
_H100 = 3.35e12, 33.5e12  # bytes and operations a second of an H100 SXM, from NVIDIA's data sheet
# double precision, of a multiprocessor and cycle
_FMA = {(6, 0): 32, (7, 0): 32, (8, 0): 32, (9, 0): 64, (10, 0): 64}


def sections(n_robots: int, quick: bool) -> list[Section]:
    """Both tables; without a GPU the second alone."""
    try:
        checked("cuda")
    except InputError as missing:
        there, absent = False, str(missing)
    else:
        there, absent = True, ""
    chosen = []
    for key, n in (("prototype", n_robots), ("reacher", max(1, n_robots // 5))):
        (case,) = (case for case in cases.cases(n) if case.key == key)
        chosen.append((case, n, points_of(key, 16 if quick else 256)))
    tallies = flops.count({case.key: points for case, _, points in chosen}, False)
    times: list[Row] = []
    work: list[Row] = []
    for case, n, points in chosen:
        done = sum(tallies[case.key].values(), flops.Tally())
        if there:
            note_progress(f"{case.key}, {n} robots")
            times += time_rows(case, n, points)
        work.append(work_row(case.key, n, points, done.flops))
    return ([time_section(times)] if there else []) + [work_section(work, absent)]


def points_of(key: str, n: int) -> int:
    """The fewest points per segment that keep the tip error of the other tables."""
    (case,) = (case for case in cases.cases(n) if case.key == key)
    pose = case.at(_STEPS, False)
    return cases.fewest_points(case, pose, *cases.fine_solution(case, pose))[0]


class Timed:
    """Best times of a simulator's steps, and of their parts."""

    def __init__(self, sim: Simulator, case: Case) -> None:
        self.sim = sim
        self.step = self.kernel = self.send = self.fetch = np.inf
        self.sent = self.fetched = 0
        for k in range(1, _STEPS + 1):
            words, before = case.words(case.at(k, False)), self._moved()
            used, self.state = seconds(lambda words=words: sim.step(**words))
            sent, fetched = (after - b for after, b in zip(self._moved(), before, strict=True))
            if k > 1:
                self.step, self.sent, self.fetched = min(self.step, used), sent, fetched
        self._parts()

    def _moved(self) -> tuple[int, int]:
        runner = self.sim._passes._runner
        return (0, 0) if runner is None else (runner.sent_bytes, runner.fetched_bytes)

    def _parts(self) -> None:
        """The pass alone, on ports that are there already; then what it costs more on new ones, and to bring
        its shape back."""
        sim, passes = self.sim, self.sim._passes
        ports = sim._ports
        assert ports is not None
        shape = passes.new_shape("tip", False)

        def run(at: Ports) -> None:
            passes.run(sim._all, at, shape, predict=True, process=1.0, noise=1e-20)
            wait(sim.device)

        run(ports)
        self.kernel = report.best(lambda: run(ports), _STEPS)
        new = [ports._replace(tendon_length=ports.tendon_length.copy()) for _ in range(_STEPS)]
        self.send = max(0.0, min(seconds(lambda at=at: run(at))[0] for at in new) - self.kernel)
        self.fetch = report.best(lambda: passes.collect(shape), _STEPS)


def wait(device: str) -> None:
    """Until the GPU has done all it was told."""
    if device == "cuda":
        from numba import cuda

        cuda.synchronize()


def time_rows(case: Case, n: int, points: int) -> list[Row]:
    """The same steps from the same boundary: two threads, all threads, the GPU."""
    import numba

    most = int(numba.config.NUMBA_NUM_THREADS)
    first = Simulator(case.robot, n, points_per_segment=points, outputs="tip")
    first.settle(**case.words(case.at(0, False)))
    start = first.snapshot()
    rows: list[Row] = []
    two: Timed | None = None
    states: list[State] = []
    for device, threads in [("cpu", t) for t in sorted({min(2, most), most})] + [("cuda", None)]:
        sim = Simulator(
            case.robot, n, points_per_segment=points, outputs="tip", threads=threads, device=device
        )
        sim.restore(start)
        timed = Timed(sim, case)
        two = two or timed
        states.append(timed.state)
        error = np.abs(states[-1].tip_position - states[0].tip_position)[states[0].ok]
        rows.append(
            {
                "robot": case.key,
                "robots": n,
                "points": points,
                "device": device if threads is None else f"{device} {threads}",
                "step_ms": 1e3 * timed.step,
                "kernel_ms": 1e3 * timed.kernel,
                "send_ms": 1e3 * timed.send,
                "fetch_ms": 1e3 * timed.fetch,
                "sent_bytes": timed.sent / n,
                "fetched_bytes": timed.fetched / n,
                "step_ratio": two.step / timed.step,
                "kernel_ratio": two.kernel / timed.kernel,
                "target": _TARGET if device == "cuda" else None,
                "met": two.kernel / timed.kernel >= _TARGET if device == "cuda" else None,
                "difference_m": float(error.max(initial=0.0)),
                "ok": float(timed.state.ok.mean()),
            }
        )
    return rows


def time_section(rows: list[Row]) -> Section:
    columns = [
        Column("robot", "robot"),
        Column("robots", "robots", ",d"),
        Column("points", "points", "d"),
        Column("device", "device,\nthreads"),
        Column("step_ms", "step\n[ms]", ".1f"),
        Column("kernel_ms", "pass\n[ms]", ".2f"),
        Column("send_ms", "send\n[ms]", ".2f"),
        Column("fetch_ms", "fetch\n[ms]", ".2f"),
        Column("sent_bytes", "sent\nB / robot", ".0f"),
        Column("fetched_bytes", "fetched\nB / robot", ".0f"),
        Column("step_ratio", "step:\nfaster", ".1f"),
        Column("kernel_ratio", "pass:\nfaster", ".1f"),
        Column("target", "target", ".0f"),
        Column("met", "met"),
        Column("difference_m", "tip differs\n[m]", ".1e"),
        Column("ok", "ok", ".2%"),
    ]
    notes = [
        'Step: `Simulator.step`, outputs="tip", tendon lengths that move; pass: its kernel alone, on inputs '
        "that are there. On a GPU a "
        "step besides sends the lengths and fetches the tips; on both it checks its inputs, on one thread "
        "of the CPU.",
        "Faster: than two threads of the CPU (the first row); the target is for the pass. Tip differs, "
        "most: from the first row's after "
        "the same steps from the same boundary.",
    ]
    return Section("cuda", "One step of a large batch", columns, rows, notes)


def work_row(key: str, n_robots: int, points: int, operations: float) -> Row:
    """What a pass of one robot must move and reckon, from the arrays that it is given."""
    from fastrod.kernels.jit import LANES
    from fastrod.kernels.rod.workspace import scratch_size

    n = 64
    (small,) = (case for case in cases.cases(n) if case.key == key)
    sim = Simulator(small.robot, n, points_per_segment=points, outputs="tip")
    sim.settle(**small.words(small.at(0, False)))
    passes, ports = sim._passes, sim._ports
    assert ports is not None
    memory, shape = passes.peek(), passes.new_shape("tip", False)

    def each(arrays: Any) -> float:
        return sum(a.nbytes for a in arrays if isinstance(a, np.ndarray) and len(a) == n > 1) / n

    moved = each(ports) + each(passes.params) + 2.0 * each(memory) + each(shape) + 8.0
    scratch = (
        8
        * scratch_size(
            len(passes.layout.tendon_segment), passes.n_x, passes.n_columns(ports), passes.n_residuals(ports)
        )
        / LANES
    )
    bandwidth, peak, name = device_limits()
    return {
        "robot": key,
        "robots": n_robots,
        "moved_bytes": moved,
        "scratch_bytes": scratch,
        "operations": operations,
        "device": name,
        "memory_floor_ms": 1e3 * moved * n_robots / bandwidth,
        "arithmetic_floor_ms": 1e3 * operations * n_robots / peak,
    }


def device_limits() -> tuple[float, float, str]:
    """Bytes and double-precision operations a second: copied and reckoned here, or of an H100."""
    try:
        checked("cuda")
    except InputError:
        return *_H100, "H100 SXM, data sheet"
    from numba import cuda

    from fastrod.solver.gpu.kernels.jit import SIMULATED

    if SIMULATED:
        return *_H100, "simulated"
    found: Any = cuda
    device = found.get_current_device()
    a, b = (found.device_array(2**25, np.float64) for _ in range(2))

    def copy() -> None:
        a.copy_to_device(b)
        wait("cuda")

    copy()
    fma = _FMA.get(tuple(device.compute_capability), 2)
    peak = 2.0 * fma * device.MULTIPROCESSOR_COUNT * 1e3 * device.CLOCK_RATE
    return (
        2.0 * a.nbytes / report.best(copy, 10),
        peak,
        str(device.name.decode() if isinstance(device.name, bytes) else device.name),
    )


def work_section(rows: list[Row], absent: str) -> Section:
    columns = [
        Column("robot", "robot"),
        Column("robots", "robots", ",d"),
        Column("moved_bytes", "read and written\nbytes / robot", ",.0f"),
        Column("scratch_bytes", "scratch\nbytes / thread", ",.0f"),
        Column("operations", "flop\n/ pass", ",.0f"),
        Column("device", "device"),
        Column("memory_floor_ms", "memory floor\n[ms]", ".2f"),
        Column("arithmetic_floor_ms", "arithmetic floor\n[ms]", ".2f"),
    ]
    limits = (
        "an H100's data sheet"
        if absent or rows[0]["device"] == "simulated"
        else "a copy measured here, and the clock's multiply-adds"
    )
    notes = [
        "Memory floor: inputs, robot, memory of the observer (read and written) and tip once over the "
        f"bandwidth; limits from {limits}. "
        "The scratch of a thread stays on the device and is used again by its next robot; what of it falls "
        "out of the caches comes on top."
    ]
    if absent:
        notes.insert(0, f"No time was measured: {absent}")
    return Section("work", "What one pass moves and reckons", columns, rows, notes)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_cuda", description=__doc__)
    parser.add_argument(
        "--robots",
        type=int,
        default=None,
        help="prototypes; reachers are a fifth as many (1000000; 64 with --quick)",
    )
    return report.command(
        parser,
        argv,
        lambda options: sections(options.robots or (64 if options.quick else 1_000_000), options.quick),
    )


if __name__ == "__main__":
    sys.exit(main())
