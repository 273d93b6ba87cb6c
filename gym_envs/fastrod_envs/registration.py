"""The ids of the tasks: `import fastrod_envs`, then `gymnasium.make("fastrod/Reach-v0")`."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

from fastrod.errors import UnknownNameError, nearest
from fastrod_envs.options import EnvOptions
from fastrod_envs.task import Task

_TASKS: Mapping[str, str] = {
    "BoxExplore": "fastrod_envs.tasks.box_explore:BoxExplore",
    "Catch": "fastrod_envs.tasks.catch:Catch",
    "DualArm": "fastrod_envs.tasks.dual_arm:DualArm",
    "PickPlace": "fastrod_envs.tasks.pick_place:PickPlace",
    "Push": "fastrod_envs.tasks.push:Push",
    "QuadrupedPush": "fastrod_envs.tasks.quadruped_push:QuadrupedPush",
    "Reach": "fastrod_envs.tasks.reach:Reach",
    "TubeInsert": "fastrod_envs.tasks.tube_insert:TubeInsert",
    "ReachObstacle": "fastrod_envs.tasks.reach_obstacle:ReachObstacle",
    "Track": "fastrod_envs.tasks.track:Track",
}
N_STEPS: Mapping[str, int] = {
    "BoxExplore": 40,
    "Catch": 40,
    "DualArm": 40,
    "PickPlace": 60,
    "Push": 40,
    "QuadrupedPush": 40,
    "Reach": 40,
    "TubeInsert": 50,
    "ReachObstacle": 40,
    "Track": 200,
}
"""`n_steps` of each task's class, for Gymnasium: the tasks themselves, which import numba, are imported when
one is made."""
SOLVED: Mapping[str, float] = {
    "BoxExplore": 34.0,
    "Catch": 5.0,
    "PickPlace": 67.0,
    "Push": 49.0,
    "QuadrupedPush": 43.0,
    "Reach": 31.0,
    "ReachObstacle": 31.0,
    "Track": 196.0,
}
"""Mean return from which a task counts as solved, for Gymnasium: nine tenths of the way from a robot at rest
to the shipped policy, with the task's own options (100 episodes from seed 100, of hosted tasks 4)."""
NAMESPACE = "fastrod"
VERSION = "v0"


def names() -> tuple[str, ...]:
    """Names of the tasks."""
    return tuple(_TASKS)


def ids() -> tuple[str, ...]:
    """`fastrod/<Name>-v0` of every task."""
    return tuple(f"{NAMESPACE}/{name}-{VERSION}" for name in _TASKS)


def name_of(given: str) -> str:
    """The task's name from its name or its id. Raises `UnknownNameError` with the nearest."""
    name = str(given).removeprefix("fastrod_envs:").removeprefix(f"{NAMESPACE}/").removesuffix(f"-{VERSION}")
    if name not in _TASKS:
        raise UnknownNameError(f"no environment {given!r}; {nearest(name, _TASKS)}")
    return name


def task_class(name: str) -> type[Task]:
    """The class of a task by its name or id. Raises `UnknownNameError`."""
    module, word = _TASKS[name_of(name)].split(":")
    found: type[Task] = getattr(import_module(module), word)
    return found


def make_task(name: str, n_envs: int, options: Mapping[str, Any]) -> Task:
    """A task for so many robots. Raises `UnknownNameError`, `InputError`."""
    kind = task_class(name)
    return kind(n_envs, kind.options_class.read(options))


def register_all() -> None:
    """Tell Gymnasium of every task."""
    from gymnasium.envs.registration import register, registry

    for name, id_ in zip(names(), ids(), strict=True):
        if id_ not in registry:
            register(
                id=id_,
                entry_point="fastrod_envs.single:SingleEnv",
                vector_entry_point="fastrod_envs.vector:BatchEnv",
                kwargs={"task": name},
                max_episode_steps=N_STEPS[name],
                reward_threshold=SOLVED.get(name),
            )


__all__ = ["EnvOptions", "ids", "make_task", "name_of", "names", "register_all", "task_class"]
