"""Random steps over all tasks: is a robot lost that `settle` can solve? A script; `--steps`, `--tasks`,
`--json`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

import fastrod_envs
from fastrod.simulator import Simulator
from fastrod.types import Ports
from fastrod_envs.registration import task_class
from fastrod_envs.vector import BatchEnv

HEAVY = {"gravity.line_density": (0.02, 0.1)}
"""Weight [kg/m] that half of the steps draw on top: at the upper end most passes of the reacher diverge at
first."""
_TOLERANCE = 1e-9


@dataclass
class Count:
    """What happened to the robots of one task."""

    steps: int = 0
    """Of environments."""
    robots: int = 0
    """Robot-steps of all simulators."""
    settled: int = 0
    """Robot-steps without contact that took more than a step's passes: the pass diverged and `step`
    settled."""
    lost: int = 0
    """Robot-steps that were not ok, though their input could be used."""
    solvable: int = 0
    """Of those, which a new simulator settles on the same inputs."""
    in_contact: int = 0
    """Of the lost, those of a simulator whose rods feel contact."""
    solvable_in_contact: int = 0
    """Of those, which a new simulator settles: cold, so it may find a rod on the other side of a wall."""
    ended: int = 0
    """Episodes that ended as lost."""


@contextmanager
def watched(count: Count) -> Iterator[None]:
    """Every step of every simulator counted, and every lost robot settled anew by another one."""
    step, read = Simulator.step, Simulator._read
    ports: list[Ports] = []

    def reading(self: Simulator, *given: Any, **named: Any) -> Any:
        found = read(self, *given, **named)
        ports[:] = [found[0]]
        return found

    def stepping(self: Simulator, *given: Any, **named: Any) -> Any:
        state = step(self, *given, **named)
        count.robots += self.n_robots
        feels = self._felt is not None
        if not feels:
            count.settled += int((state.ok & (state.passes > 2)).sum())
        for i in np.flatnonzero(~state.ok & (state.passes != 0)):
            solved = _settled_in_contact(self, int(i), named) if feels else _settled(self, int(i), ports[0])
            count.lost += not feels
            count.solvable += solved and not feels
            count.in_contact += feels
            count.solvable_in_contact += solved and feels
        return state

    Simulator.step, Simulator._read = stepping, reading  # type: ignore[method-assign,assignment]
    try:
        yield
    finally:
        Simulator.step, Simulator._read = step, read  # type: ignore[method-assign]


def _robot(simulator: Simulator, i: int) -> Any:
    return simulator.robots[i if len(simulator.robots) > 1 else 0]


def _row(arrays: Any, i: int, n: int) -> Any:
    """Robot i of a NamedTuple of arrays whose robot axis is n, 1 or 0."""
    return type(arrays)(*(a[i : i + 1] if len(a) == n else a for a in arrays))


def _settled(simulator: Simulator, i: int, ports: Ports) -> bool:
    """Whether a new simulator settles on what the kernel was given for robot i, effects included."""
    plain = replace(_robot(simulator, i), effects=())
    fresh = Simulator(plain, points_per_segment=simulator._layout.n_steps, threads=1)
    params = _row(simulator._passes.params, i, simulator.n_robots)
    return bool(fresh.settle_ports(_row(ports, i, simulator.n_robots), params, _TOLERANCE).ok[0])


def _settled_in_contact(simulator: Simulator, i: int, named: dict[str, Any]) -> bool:
    n, layout = simulator.n_robots, simulator._layout
    robot, scene = _robot(simulator, i), simulator.contact
    fresh = Simulator(robot, points_per_segment=layout.n_steps, threads=1, contact=scene)

    def one(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: one(v) for key, v in value.items()}
        return value[i] if np.ndim(value) > 1 and len(value) == n else value

    return bool(fresh.settle(**{name: one(value) for name, value in named.items()}).ok[0])


def drive(task: str, steps: int, seed: int = 0, **options: Any) -> Count:
    """So many random steps of environments of a task, in episodes one after another."""
    count, n = Count(), 4 if task_class(task).hosted else 16
    env = BatchEnv(task, min(n, steps), threads=1, **options)
    rng = np.random.default_rng(seed)
    try:
        with watched(count):
            env.reset(seed=seed)
            while count.steps < steps:
                # a direction that stays for a while, so that robots get somewhere
                held = rng.uniform(-1.0, 1.0, env.action_space.shape)
                for _ in range(5):
                    info = env.step(np.clip(held + 0.3 * rng.normal(size=held.shape), -1.0, 1.0))[4]
                    count.steps += env.num_envs
                    if "final_info" in info:
                        count.ended += int(np.sum(info["final_info"]["lost"] & info["_final_info"]))
                    if count.steps >= steps:
                        break
    finally:
        env.close()
    return count


def main(argv: Sequence[str] | None = None) -> int:
    """1 where a robot was lost that settles."""
    parser = argparse.ArgumentParser(prog="bench_lost", description=__doc__)
    parser.add_argument("--steps", type=int, default=10_000, help="over all tasks (%(default)s)")
    parser.add_argument("--tasks", nargs="*", default=fastrod_envs.names(), metavar="TASK")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(argv)
    each = -(-given.steps // (2 * len(given.tasks)))
    rows: dict[str, Count] = {}
    for task in given.tasks:
        rows[task] = drive(task, each, given.seed)
        heavy = drive(task, each, given.seed + 1, randomise=HEAVY)
        rows[f"{task}, heavy"] = heavy
        for name in (task, f"{task}, heavy"):
            if not given.json:
                figures = (f"{key} {value:6}" for key, value in vars(rows[name]).items())
                print(f"{name:24}", *figures, sep="  ", flush=True)
    if given.json:
        print(json.dumps({name: vars(count) for name, count in rows.items()}))
    total = {key: sum(vars(count)[key] for count in rows.values()) for key in vars(Count())}
    print(", ".join(f"{key} {value}" for key, value in total.items()), file=sys.stderr)
    return int(total["solvable"] > 0)


if __name__ == "__main__":
    sys.exit(main())
