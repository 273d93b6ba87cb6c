"""Environments, steps a second: `fastrod bench envs`, or this file as a script; `--json` for programs,
`--quick` for a smoke run."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

import report
from report import Column, Row, Section, note_progress

PAPER = (
    "For information, measured elsewhere: the paper's public reacher takes 240 to 390 env steps/s in "
    "one process, 686 on 64 workers."
)
SEED = 0


def draw(env: Any, n: int) -> Any:
    """(n, *action shape) actions from -1 to 1."""
    return np.random.default_rng(SEED).uniform(-1.0, 1.0, (n, *env.action_space.shape)).astype(np.float32)


def walk(env: Any, actions: Any) -> None:
    """These actions, one after another; episodes end and begin in between."""
    for action in actions:
        env.step(action)


def step_seconds(env: Any, n: int, repeats: int) -> float:
    """Seconds a step of the whole batch, warm: best of several runs of `n` steps."""
    env.reset(seed=SEED)
    actions = draw(env, n)
    walk(env, actions[: min(n, 45)])  # past the first ends of episodes
    return report.best(lambda: walk(env, actions), repeats) / n


def simulator_share(env: Any, n: int) -> float | None:
    """Part of a step's time that the simulator takes, its settling and putting back of robots included; None
    where rigid bodies move."""
    simulator = getattr(env.task, "simulator", None)
    if simulator is None:
        return None
    spent = 0.0

    def timed(call: Callable[..., Any]) -> Callable[..., Any]:
        def run(*given: Any, **named: Any) -> Any:
            nonlocal spent
            start = time.perf_counter()
            try:
                return call(*given, **named)
            finally:
                spent += time.perf_counter() - start

        return run

    own = {name: getattr(simulator, name) for name in ("step", "settle", "restore", "replace")}
    actions = draw(env, n)
    try:
        for name, call in own.items():
            setattr(simulator, name, timed(call))
        whole, _ = report.seconds(lambda: walk(env, actions))
    finally:
        for name in own:
            delattr(simulator, name)
    return spent / whole


def steps_for(n_envs: int, quick: bool) -> int:
    """Of one run: some 100 ms, and no fewer than an episode."""
    return 3 if quick else max(40, min(2000, 100_000 // n_envs))


def reach_section(quick: bool) -> Section:
    """Reach in native batches, beside Gymnasium's SyncVectorEnv of its single environments."""
    from gymnasium.vector import AutoresetMode, SyncVectorEnv

    from fastrod_envs.single import SingleEnv
    from fastrod_envs.vector import BatchEnv

    repeats = 1 if quick else 5
    sync: dict[int, float] = {}
    rows: list[Row] = []
    for n in (1, 4) if quick else (1, 64):
        note_progress(f"SyncVectorEnv of {n}")
        env = SyncVectorEnv(
            [lambda: SingleEnv("Reach", threads=1)] * n, autoreset_mode=AutoresetMode.SAME_STEP
        )
        sync[n] = step_seconds(env, steps_for(40 * n, quick), repeats)
        env.close()
        rows.append(row("SyncVectorEnv", n, 1, sync[n]))
    for n in (1, 4) if quick else (1, 64, 1024, 8192):
        for threads in dict.fromkeys(report.thread_counts()):
            note_progress(f"{n} environments, {threads} threads")
            batch = BatchEnv("Reach", n, threads=threads)
            took = step_seconds(batch, steps_for(n, quick), repeats)
            least = sync.get(n, sync[max(sync)] * n / max(sync))
            rows.append(
                row("native batch", n, threads, took)
                | {"ratio": least / took, "share": simulator_share(batch, steps_for(n, quick))}
            )
            batch.close()
    columns = [
        Column("way", "fastrod/Reach-v0"),
        Column("n", "N", ",d"),
        Column("threads", "threads", "d"),
        Column("rate", "env steps/s", ",.0f"),
        Column("step_us", "us / env step", ",.2f"),
        Column("ratio", "times as fast as\nSyncVectorEnv", ",.1f"),
        Column("share", "simulator's share\nof a step", ".0%"),
    ]
    notes = [
        "Random actions, drawn beforehand; episodes of 40 steps end and begin in between. Warm, best of "
        "several runs. A step: action to "
        "tendon lengths, one observer pass, reward, observation, info, and new episodes where one has ended.",
        "SyncVectorEnv holds our own single environments, in this process; their simulators have one "
        "thread. Beyond "
        f"N = {max(sync)} the ratio is to its time an environment at N = {max(sync)}.",
        PAPER,
    ]
    return Section("reach", "Reach: environment steps", columns, rows, notes)


def row(way: str, n: int, threads: int, seconds: float) -> Row:
    """What every row has; `seconds` a step of the whole batch."""
    return {
        "way": way,
        "n": n,
        "threads": threads,
        "rate": n / seconds,
        "step_us": 1e6 * seconds / n,
        "ratio": None,
        "share": None,
    }


def task_section(quick: bool) -> Section:
    """Every other task, few steps: a batch where the rods are one simulator's, otherwise one environment."""
    import fastrod_envs
    from fastrod.errors import HostError
    from fastrod_envs.registration import task_class
    from fastrod_envs.vector import BatchEnv

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
        first, _ = report.seconds(partial(walk, env, draw(env, 2)))
        actions = draw(env, 2 if quick else min(max(int(4.0 / first), 4), 40))
        took = report.best(partial(walk, env, actions), 1 if quick else 2) / len(actions)
        simulated = {"task_dt": 1e3 * env.task.dt, "real": env.task.dt * n / took}
        rows.append(row(name, n, 1, took) | simulated | {"hosted": hosted, "steps": len(actions)})
        env.close()
    columns = [
        Column("way", "task"),
        Column("n", "N", ",d"),
        Column("threads", "threads", "d"),
        Column("rate", "env steps/s", ",.0f"),
        Column("step_us", "us / env step", ",.0f"),
        Column("task_dt", "simulated ms\na step", ".0f"),
        Column("real", "times real time,\nall together", ",.1f"),
        Column("hosted", "rigid bodies"),
        Column("steps", "steps", "d"),
    ]
    notes = [
        "Random actions as above, one thread. With rigid bodies every environment is a PyBullet world "
        "of its own."
    ]
    return Section("tasks", "The other tasks", columns, rows, notes)


def endurance_section(total: int, quick: bool) -> Section:
    """About `total` random steps over all tasks: what they leave behind."""
    import resource

    import fastrod_envs
    from fastrod.errors import HostError
    from fastrod_envs.registration import task_class
    from fastrod_envs.vector import BatchEnv

    part = {"Reach": 0.4, "Catch": 0.3, "Track": 0.2, "ReachObstacle": 0.08}
    rows: list[Row] = []
    for name in fastrod_envs.names():
        note_progress(f"endurance of {name}")
        n = 256 if name in part else 1 if task_class(name).hosted else 16
        steps = 3 if quick else max(1, round(total * part.get(name, 0.004) / n))
        try:
            env = BatchEnv(name, n)
        except HostError:  # PyBullet is not installed
            continue
        env.reset(seed=SEED)
        rng, finite, within, lost, ended, start = np.random.default_rng(SEED), True, True, 0, 0, 0
        space = env.single_observation_space
        for k in range(steps):
            observation, reward, terminated, truncated, told = env.step(
                rng.uniform(-1.0, 1.0, (n, env.task.n_actions))
            )
            finite &= bool(
                np.isfinite(observation).all()
                and np.isfinite(reward).all()
                and np.isfinite(told["distance"]).all()
            )
            within &= bool(((observation >= space.low) & (observation <= space.high)).all())
            lost, ended = lost + int(told["lost"].sum()), ended + int((terminated | truncated).sum())
            if k == steps // 4:
                start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start) / 1024.0
        rows.append(
            {
                "way": name,
                "steps": n * steps,
                "finite": finite,
                "within": within,
                "ended": ended,
                "lost": lost,
                "grown": grown,
            }
        )
        env.close()
    columns = [
        Column("way", "task"),
        Column("steps", "random steps", ",d"),
        Column("finite", "all finite"),
        Column("within", "within the space"),
        Column("ended", "episodes", ",d"),
        Column("lost", "lost", ",d"),
        Column("grown", "peak memory grown after\na quarter of them, MiB", ".1f"),
    ]
    return Section(
        "endurance",
        "Random steps over all tasks",
        columns,
        rows,
        [f"{sum(int(r['steps'] or 0) for r in rows):,d} steps in all."],
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_envs", description=__doc__)
    parser.add_argument(
        "--endurance",
        type=int,
        default=0,
        metavar="N",
        help="only this: so many random steps over all tasks, 1000000 say",
    )

    def measure(options: argparse.Namespace) -> list[Section]:
        if options.endurance:
            return [endurance_section(options.endurance, options.quick)]
        return [reach_section(options.quick), task_section(options.quick)]

    return report.command(parser, argv, measure)


if __name__ == "__main__":
    sys.exit(main())
