"""Random steps over all tasks: is a robot lost that `settle` can solve? Exit code 1 where one is."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import numpy as np

import fastrod_envs
from fastrod.errors import HostError
from fastrod.simulator import Simulator
from fastrod.types import Ports
from fastrod_envs.registration import task_class
from fastrod_envs.vector import BatchEnv
from report import Row, Section, bench, note_progress, table

# kg/m of weight that half of the steps draw on top: at the upper end most passes of the reacher diverge at
# first
HEAVY = {"gravity.line_density": (0.02, 0.1)}
_TOLERANCE = 1e-9


@dataclass
class Count:
    """Counts of the robots of one task."""

    steps: int = 0  # of environments
    robots: int = 0  # robot-steps of all simulators
    settled: int = 0  # robot-steps without contact of more than a step's passes: it diverged, `step` settled
    lost: int = 0  # robot-steps that were not ok, though their input could be used
    solvable: int = 0  # of those, which a new simulator settles on the same inputs
    in_contact: int = 0  # of the lost, those of a simulator whose rods feel contact
    solvable_in_contact: int = 0  # of those, which a new simulator settles: cold, maybe beyond a wall
    ended: int = 0  # episodes that ended as lost


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

    with patch.object(Simulator, "step", stepping), patch.object(Simulator, "_read", reading):
        yield


def _anew(simulator: Simulator, i: int, **changes: Any) -> Simulator:
    """Another simulator of robot i alone: as it is, or changed and without contact."""
    robot = replace(simulator.robots[i if len(simulator.robots) > 1 else 0], **changes)
    scene, points = None if changes else simulator.contact, simulator._layout.n_steps
    return Simulator(robot, points_per_segment=points, threads=1, contact=scene)


def _row(arrays: Any, i: int, n: int) -> Any:
    """Robot i of a NamedTuple of arrays whose robot axis is n, 1 or 0."""
    return type(arrays)(*(a[i : i + 1] if len(a) == n else a for a in arrays))


def _settled(simulator: Simulator, i: int, ports: Ports) -> bool:
    """Whether a new simulator settles on what the kernel was given for robot i, effects included."""
    fresh = _anew(simulator, i, effects=())
    params = _row(simulator._params, i, simulator.n_robots)
    return bool(fresh.settle_ports(_row(ports, i, simulator.n_robots), params, _TOLERANCE).ok[0])


def _settled_in_contact(simulator: Simulator, i: int, named: dict[str, Any]) -> bool:
    fresh = _anew(simulator, i)

    def one(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: one(v) for key, v in value.items()}
        return value[i] if np.ndim(value) > 1 and len(value) == simulator.n_robots else value

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
                # a direction that stays for a while, so that robots move far
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


def endure(task: str, total: int) -> Row | None:
    """Undirected random steps: anything not finite or out of the space, robots lost, memory grown; None
    where the task needs what is not installed."""
    n = 256 if task in _FRACTION else 1 if task_class(task).hosted else 16
    steps = max(3, round(total * _FRACTION.get(task, 0.004) / n))
    note_progress(f"endurance of {task}")
    try:
        env = BatchEnv(task, n)
    except HostError:  # PyBullet is not installed
        return None
    env.reset(seed=0)
    rng, space, bad = np.random.default_rng(0), env.single_observation_space, np.zeros(2, dtype=np.bool_)
    lost, ended, start = 0, 0, 0
    for k in range(steps):
        seen, reward, terminated, truncated, info = env.step(rng.uniform(-1.0, 1.0, (n, env.task.n_actions)))
        finite = all(np.isfinite(a).all() for a in (seen, reward, info["distance"]))
        bad |= not finite, not ((seen >= space.low) & (seen <= space.high)).all()
        lost, ended = lost + int(info["lost"].sum()), ended + int((terminated | truncated).sum())
        if k == steps // 4:
            start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    env.close()
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - start) / 1024.0
    found = {"finite": not bad[0], "within": not bad[1], "ended": ended, "lost": lost, "grown": grown}
    return {"task": task, "steps": n * steps, **found}


_FRACTION = {"Reach": 0.4, "Catch": 0.3, "Track": 0.2, "ReachObstacle": 0.08}  # of all steps of `endure`


def measure(options: Any) -> list[Section]:
    tasks = options.tasks or fastrod_envs.names()
    each = 4 if options.quick else -(-options.steps // (2 * len(tasks)))
    rows: list[Row] = []
    for task in tasks:
        note_progress(task)
        rows.append({"task": task, **vars(drive(task, each, options.seed))})
        rows.append({"task": f"{task}, heavy", **vars(drive(task, each, options.seed + 1, randomise=HEAVY))})
    total = {key: sum(row[key] for row in rows) for key in vars(Count())}
    return [
        table(
            "lost",
            "Random steps: robots lost, and which of them a new simulator settles",
            "task | steps:,d environment~steps | robots:,d robot-~steps | settled:,d | lost:d"
            "| solvable:d of these~solvable | in_contact:d lost in~contact"
            "| solvable_in_contact:d of these~solvable | ended:d episodes~lost",
            [*rows, {"task": "all", **total}],
            f"Heavy: with a weight of {HEAVY['gravity.line_density']} kg/m on top. Settled: the pass "
            "diverged, and `step` settled. In contact a new simulator begins cold, and may find a rod on the "
            "other side of a wall.",
            failed=total["solvable"] > 0,
        )
    ]


main = bench(
    __doc__,
    measure,
    ("--steps", 10_000, "over all tasks"),
    ("--tasks", (str,), "these alone"),
    ("--seed", 0, "of all"),
)
