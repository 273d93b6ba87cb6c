"""A large batch on a GPU beside the CPU; without a GPU: what a pass reads, writes and computes."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

import cases
import flops
from cases import Case
from fastrod import Simulator
from fastrod.errors import InputError
from fastrod.solver.boundary import new_shape
from fastrod.solver.gpu.device import checked
from fastrod.types import Ports
from report import Measurement, Row, Section, bench, best, goal, note_progress, table

_STEPS = 6
_TARGET = 50.0  # times two threads of the CPU
_H100 = 3.35e12, 33.5e12  # bytes and operations a second of an H100 SXM, from NVIDIA's data sheet
# double precision, of a multiprocessor and cycle
_FMA = {(6, 0): 32, (7, 0): 32, (8, 0): 32, (9, 0): 64, (10, 0): 64}


def case_of(key: str, n: int) -> Case:
    return next(case for case in cases.cases(n) if case.key == key)


def measure(options: Any) -> list[Section]:
    """Both tables; without a GPU the second alone."""
    n_robots, absent = options.robots or (64 if options.quick else 1_000_000), without_gpu()
    sizes = {"prototype": n_robots, "reacher": max(1, n_robots // 5)}
    points = {key: points_of(key, 16 if options.quick else 256) for key in sizes}
    tallies = flops.count(points, False)
    times: list[Row] = []
    for key, n in sizes.items() if not absent else ():
        note_progress(f"{key}, {n} robots")
        times += time_rows(case_of(key, n), n, points[key])
    work = [work_row(key, n, points[key], tallies[key].flops) for key, n in sizes.items()]
    return ([time_section(times)] if times else []) + [work_section(work, absent)]


def without_gpu() -> str:
    """A sentence where there is none."""
    try:
        checked("cuda")
    except InputError as missing:
        return str(missing)
    return ""


def points_of(key: str, n: int) -> int:
    """The fewest points per segment that keep the tip error of the other tables."""
    case = case_of(key, n)
    pose = case.at(_STEPS, False)
    return cases.fewest_points(case, pose, *cases.fine_solution(case, pose))[0]


def transferred(sim: Simulator) -> tuple[int, int]:
    """Bytes sent and fetched until now."""
    runner = sim._rods.passes._runner
    return (0, 0) if runner is None else (runner.sent_bytes, runner.fetched_bytes)


def stages(sim: Simulator) -> dict[str, float]:
    """Seconds of the pass alone, on ports that are there; its extra cost on new ones; bringing its shape
    back."""
    passes, ports, sending = sim._rods.passes, sim._ports, Measurement()
    assert ports is not None
    shape = new_shape(passes.layout, passes.n_robots, "tip", False)

    def run(at: Ports) -> None:
        passes.run(sim._all, at, shape, predict=True, process=1.0, noise=1e-20)
        wait(sim.device)

    run(ports)
    kernel = best(partial(run, ports), _STEPS)
    for new in [ports._replace(tendon_length=ports.tendon_length.copy()) for _ in range(_STEPS)]:
        sending.take(partial(run, new))
    send, fetch = max(0.0, sending.least - kernel), best(lambda: passes.collect(shape), _STEPS)
    return {"kernel": kernel, "send": send, "fetch": fetch}


def wait(device: str) -> None:
    """Until the GPU has done all its work."""
    if device == "cuda":
        from numba import cuda

        cuda.synchronize()


def time_rows(case: Case, n: int, points: int) -> list[Row]:
    """The same steps from the same boundary: two threads, all threads, the GPU."""
    import numba

    most, options = int(numba.config.NUMBA_NUM_THREADS), {"points_per_segment": points, "outputs": "tip"}
    first = Simulator(case.robot, n, **options)
    first.settle(**case.inputs(case.at(0, False)))
    start, rows, two = first.snapshot(), list[Row](), None
    for device, threads in [("cpu", t) for t in sorted({min(2, most), most})] + [("cuda", None)]:
        sim = Simulator(case.robot, n, threads=threads, device=device, **options)
        sim.restore(start)
        steps = Measurement()
        for k in range(1, _STEPS + 1):
            inputs, before = case.inputs(case.at(k, False)), transferred(sim)
            state = steps.take(partial(sim.step, **inputs))
            sent, fetched = (after - b for after, b in zip(transferred(sim), before, strict=True))
        times = {"step": min(steps.times[1:]), **stages(sim)}
        two = two or (times, state)
        step_ratio, ratio = (two[0][stage] / times[stage] for stage in ("step", "kernel"))
        error = np.abs(state.tip_position - two[1].tip_position)[two[1].ok]
        row: Row = {"robot": case.key, "robots": n, "points": points, "ok": state.ok.mean()}
        row |= {"device": f"{device} {threads or ''}".strip(), "difference_m": error.max(initial=0.0)}
        row |= {f"{stage}_ms": 1e3 * took for stage, took in times.items()}
        row |= {"sent_bytes": sent / n, "fetched_bytes": fetched / n}
        row |= {"step_ratio": step_ratio, "kernel_ratio": ratio}
        rows.append(row | (goal(ratio, _TARGET, least=True) if device == "cuda" else {}))
    return rows


def time_section(rows: list[Row]) -> Section:
    return table(
        "cuda",
        "One step of a large batch",
        "robot | robots:,d | points:d | device device,~threads | step_ms:.1f step~[ms] | kernel_ms:.2f "
        "pass~[ms]| send_ms:.2f send~[ms] | fetch_ms:.2f fetch~[ms] | sent_bytes:.0f sent~B / robot"
        "| fetched_bytes:.0f fetched~B / robot | step_ratio:.1f step:~faster | kernel_ratio:.1f pass:~faster"
        "| target:.0f | met | difference_m:.1e tip differs~[m] | ok:.2%",
        rows,
        "Step: `Simulator.step`, outputs='tip', tendon lengths that move; pass: its kernel alone, on inputs "
        "that are there. On a GPU a step besides sends the lengths and fetches the tips; on both it checks "
        "its inputs, on one thread of the CPU.",
        "Faster: than two threads of the CPU (the first row); the target is for the pass. Tip differs, most: "
        "from the first row's after the same steps from the same boundary.",
    )


def work_row(key: str, n_robots: int, points: int, operations: float) -> Row:
    """Return what a pass of one robot must move and compute, from the arrays that it is given."""
    from fastrod.kernels.jit import LANES
    from fastrod.kernels.rod.gather import scratch_size

    n = 64
    small = case_of(key, n)
    sim = Simulator(small.robot, n, points_per_segment=points, outputs="tip")
    sim.settle(**small.inputs(small.at(0, False)))
    passes, ports = sim._rods.passes, sim._ports
    assert ports is not None

    def each(arrays: Any) -> float:
        return sum(a.nbytes for a in arrays if isinstance(a, np.ndarray) and len(a) == n > 1) / n

    moved = each(ports) + each(passes.params) + 2.0 * each(passes.peek()) + 8.0
    moved += each(new_shape(passes.layout, passes.n_robots, "tip", False))
    n_tendons, n_columns = len(passes.layout.tendon_segment), passes.n_columns(ports)
    scratch = scratch_size(n_tendons, passes.n_x, n_columns, passes.n_residuals(ports))
    bandwidth, peak, name = device_limits()
    floors = {"memory_floor_ms": moved / bandwidth, "arithmetic_floor_ms": operations / peak}
    row: Row = {"robot": key, "robots": n_robots, "moved_bytes": moved, "scratch_bytes": 8 * scratch / LANES}
    row |= {"operations": operations, "device": name}
    return row | {name: 1e3 * floor * n_robots for name, floor in floors.items()}


def device_limits() -> tuple[float, float, str]:
    """Bytes and double-precision operations a second: copied and computed here, or of an H100."""
    if without_gpu():
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
    name = device.name.decode() if isinstance(device.name, bytes) else device.name
    return 2.0 * a.nbytes / best(copy, 10), peak, str(name)


def work_section(rows: list[Row], absent: str) -> Section:
    sheet = absent or rows[0]["device"] == "simulated"
    limits = "an H100's data sheet" if sheet else "a copy measured here, and the clock's multiply-adds"
    return table(
        "work",
        "What one pass moves and computes",
        "robot | robots:,d | moved_bytes:,.0f read and written~bytes / robot | scratch_bytes:,.0f "
        "scratch~bytes / thread| operations:,.0f flop~/ pass | device | memory_floor_ms:.2f memory floor~[ms]"
        "| arithmetic_floor_ms:.2f arithmetic floor~[ms]",
        rows,
        *([f"No time was measured: {absent}"] if absent else []),
        "Memory floor: inputs, robot, memory of the observer (read and written) and tip once over the "
        f"bandwidth; limits from {limits}. The scratch of a thread stays on the device and is used again by "
        "its next robot; what of it falls out of the caches comes on top.",
    )


main = bench(
    __doc__, measure, ("--robots", int, "prototypes; reachers are a fifth as many (1000000; 64 with --quick)")
)
