"""Environments, steps a second: native batches beside Gymnasium's SyncVectorEnv, then every other task."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

import fastrod_envs
from bench_lost import endure
from fastrod.errors import HostError
from fastrod_envs.registration import task_class
from fastrod_envs.single import SingleEnv
from fastrod_envs.vector import BatchEnv
from report import Measurement, Row, Section, bench, best, note_progress, seconds, table, thread_counts

SEED = 0


def actions_for(env: Any, n: int) -> Any:
    """(n, *action shape) actions from -1 to 1."""
    return np.random.default_rng(SEED).uniform(-1.0, 1.0, (n, *env.action_space.shape)).astype(np.float32)


def walk(env: Any, actions: Any) -> None:
    """These actions, one after another; episodes end and begin in between."""
    for action in actions:
        env.step(action)


def step_seconds(env: Any, n: int, repeats: int) -> float:
    """Seconds a step of the whole batch, warm: best of several runs of `n` steps."""
    env.reset(seed=SEED)
    actions = actions_for(env, n)
    walk(env, actions[: min(n, 45)])  # past the first ends of episodes
    return best(partial(walk, env, actions), repeats) / n


def simulator_fraction(env: Any, n: int) -> float:
    """Fraction of a step's time that the simulator takes, settling and putting back robots included."""
    simulator, spent, names = env.task.simulator, Measurement(), ("step", "settle", "restore", "replace")

    def timed(call: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *given, **named: spent.take(lambda: call(*given, **named))

    try:
        for name in names:
            setattr(simulator, name, timed(getattr(simulator, name)))
        whole, _ = seconds(partial(walk, env, actions_for(env, n)))
    finally:
        for name in names:
            delattr(simulator, name)
    return sum(spent.times) / whole


def steps_for(n_envs: int, quick: bool) -> int:
    """Return the number of steps of one run: some 100 ms, and no fewer than an episode."""
    return 3 if quick else max(40, min(2000, 100_000 // n_envs))


def row(kind: str, n: int, threads: int, took: float) -> Row:
    """The columns of every row; `took`: seconds a step of the whole batch."""
    return {"kind": kind, "n": n, "threads": threads, "rate": n / took, "step_us": 1e6 * took / n}


def reach_section(quick: bool) -> Section:
    """Reach in native batches, beside Gymnasium's SyncVectorEnv of its single environments."""
    from gymnasium.vector import AutoresetMode, SyncVectorEnv

    repeats, mode = 1 if quick else 5, AutoresetMode.SAME_STEP
    sync: dict[int, float] = {}
    rows: list[Row] = []
    for n in (1, 4) if quick else (1, 64):
        note_progress(f"SyncVectorEnv of {n}")
        env = SyncVectorEnv([lambda: SingleEnv("Reach", threads=1)] * n, autoreset_mode=mode)
        sync[n] = step_seconds(env, steps_for(40 * n, quick), repeats)
        env.close()
        rows.append(row("SyncVectorEnv", n, 1, sync[n]))
    most = max(sync)
    for n in (1, 4) if quick else (1, 64, 1024, 8192):
        for threads in dict.fromkeys(thread_counts()):
            note_progress(f"{n} environments, {threads} threads")
            batch, steps = BatchEnv("Reach", n, threads=threads), steps_for(n, quick)
            took = step_seconds(batch, steps, repeats)
            ratio = sync.get(n, sync[most] * n / most) / took
            more = {"ratio": ratio, "fraction": simulator_fraction(batch, steps)}
            rows.append(row("native batch", n, threads, took) | more)
            batch.close()
    return table(
        "reach",
        "Reach: environment steps",
        "kind fastrod/Reach-v0 | n:,d N | threads:d | rate:,.0f env steps/s | step_us:,.2f us / env step"
        "| ratio:,.1f times as fast as~SyncVectorEnv | fraction:.0% simulator's fraction~of a step",
        rows,
        "Random actions; episodes of 40 steps. Warm, best of several runs. The simulators of SyncVectorEnv "
        f"have one thread; beyond N = {most} the ratio is to its time an environment at N = {most}.",
        "For information, measured elsewhere: the paper's public reacher takes 240 to 390 env steps/s in one "
        "process, 686 on 64 workers.",
    )


def busy() -> subprocess.Popen[bytes]:
    """A process that keeps one core busy."""
    return subprocess.Popen([sys.executable, "-c", "while True: pass"])


def threads_section(quick: bool) -> Section:
    """One thread and two, alone and beside a process that keeps one core busy."""
    n, most = (64 if quick else 1024), max(thread_counts())
    rows: list[Row] = []
    for beside in (False, True):
        other, rate = busy() if beside else None, 0.0
        for threads in dict.fromkeys((1, most)):
            note_progress(f"{threads} threads{', beside a busy process' if beside else ''}")
            env = BatchEnv("Reach", n, threads=threads)
            begun = time.perf_counter(), time.process_time()
            took = step_seconds(env, steps_for(n, quick), 1 if quick else 5)
            wall, cpu = time.perf_counter() - begun[0], time.process_time() - begun[1]
            rows.append(row("beside a busy process" if beside else "alone", n, threads, took))
            rate = rate or n / took
            rows[-1] |= {"cpu": cpu / wall, "ratio": n / took / rate}
            env.close()
        if other is not None:
            other.kill()
            other.wait()
    return table(
        "threads",
        "Reach: one thread and more",
        "kind machine | n:,d N | threads:d | rate:,.0f env steps/s | cpu:.2f CPU s per second"
        "| ratio:.2f rate to~that of one thread",
        rows,
        "Random actions. Nothing is set in the environment. Warm, best of several runs.",
    )


def task_section(quick: bool) -> Section:
    """Every other task, few steps: a batch where the rods are one simulator's, otherwise one environment."""
    rows: list[Row] = []
    for name in fastrod_envs.names():
        if name == "Reach":
            continue
        hosted = task_class(name).hosted
        n = 1 if hosted else 2 if quick else 64
        note_progress(name)
        try:
            env = BatchEnv(name, n, threads=1)
        except HostError:  # PyBullet is not installed
            continue
        env.reset(seed=SEED)
        first, _ = seconds(partial(walk, env, actions_for(env, 2)))
        actions = actions_for(env, 2 if quick else min(max(int(4.0 / first), 4), 40))
        took = best(partial(walk, env, actions), 1 if quick else 2) / len(actions)
        simulated = {"task_dt": 1e3 * env.task.dt, "real": env.task.dt * n / took}
        rows.append(row(name, n, 1, took) | simulated | {"hosted": hosted, "steps": len(actions)})
        env.close()
    return table(
        "tasks",
        "The other tasks",
        "kind task | n:,d N | threads:d | rate:,.0f env steps/s | step_us:,.0f us / env step"
        "| task_dt:.0f simulated ms~a step | real:,.1f times real time,~all together | hosted rigid bodies"
        "| steps:d",
        rows,
        "Random actions as above, one thread. With rigid bodies every environment is a PyBullet world of its "
        "own.",
    )


def endurance_section(total: int) -> Section:
    """About `total` random steps over all tasks: what they leave behind."""
    rows = [row for name in fastrod_envs.names() if (row := endure(name, total))]
    return table(
        "endurance",
        "Random steps over all tasks",
        "task | steps:,d random steps | finite all finite | within within the space | ended:,d episodes | "
        "lost:,d| grown:.1f peak memory grown after~a quarter of them, MiB",
        rows,
        f"{sum(row['steps'] for row in rows):,d} steps in all.",
    )


def measure(options: Any) -> list[Section]:
    if options.endurance:
        return [endurance_section(0 if options.quick else options.endurance)]
    quick = options.quick
    return [reach_section(quick), threads_section(quick), task_section(quick)]


main = bench(
    __doc__, measure, ("--endurance", 0, "only this: so many random steps over all tasks, 1000000 say")
)
