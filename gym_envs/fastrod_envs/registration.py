"""The ids of the tasks: `import fastrod_envs`, then `gymnasium.make("fastrod/Reach-v0")`."""

from __future__ import annotations

import inspect
import sys
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any, TypeVar

from fastrod.errors import InputError, UnknownNameError, nearest, shown
from fastrod_envs.options import EnvOptions
from fastrod_envs.task import Task

NAMESPACE = "fastrod"
VERSION = "v0"
GROUP = "fastrod.tasks"
"""Entry points of this group name modules of installed packages whose import registers tasks."""
_Class = TypeVar("_Class", bound=type[Task])


@dataclass(frozen=True)
class TaskEntry:
    """One task of the registry."""

    source: str | type[Task]
    """`module:Class` of a shipped task, which imports numba and is imported when one is made; or the
    class."""
    n_steps: int
    """Number of steps of an episode, for Gymnasium."""
    solved: float | None = None
    """Mean return from which the task counts as solved, for Gymnasium; None: nobody has said."""

    @property
    def place(self) -> str:
        """`module:Class`."""
        kind = self.source
        return kind if isinstance(kind, str) else f"{kind.__module__}:{kind.__qualname__}"


# solved: nine tenths of the way from a robot at rest to the shipped policy, with the task's own options (100
# episodes from seed 100, of hosted tasks 4)
_TASKS: dict[str, TaskEntry] = {
    "BoxExplore": TaskEntry("fastrod_envs.tasks.box_explore:BoxExplore", 40, 34.0),
    "Catch": TaskEntry("fastrod_envs.tasks.catch:Catch", 40, 5.0),
    "DualArm": TaskEntry("fastrod_envs.tasks.dual_arm:DualArm", 40),
    "PickPlace": TaskEntry("fastrod_envs.tasks.pick_place:PickPlace", 60, 63.0),
    "Push": TaskEntry("fastrod_envs.tasks.push:Push", 40, 47.0),
    "QuadrupedPush": TaskEntry("fastrod_envs.tasks.quadruped_push:QuadrupedPush", 40, 41.0),
    "Reach": TaskEntry("fastrod_envs.tasks.reach:Reach", 40, 31.0),
    "TubeInsert": TaskEntry("fastrod_envs.tasks.tube_insert:TubeInsert", 50),
    "ReachObstacle": TaskEntry("fastrod_envs.tasks.reach_obstacle:ReachObstacle", 40, 31.0),
    "Track": TaskEntry("fastrod_envs.tasks.track:Track", 200, 196.0),
}


def names() -> tuple[str, ...]:
    """Names of the tasks."""
    return tuple(_TASKS)


def ids() -> tuple[str, ...]:
    """`fastrod/<Name>-v0` of every task."""
    return tuple(map(id_of, _TASKS))


def id_of(name: str) -> str:
    """`fastrod/<Name>-v0` of a task's name."""
    return f"{NAMESPACE}/{name}-{VERSION}"


def name_of(given: str) -> str:
    """The task's name from its name, its id, or `FILE.py:Class` of one's own, whose file is then run. Raises
    `UnknownNameError` with the nearest."""
    path, colon, word = str(given).rpartition(":")
    if colon and path.endswith(".py"):
        return register(_class_in(Path(path), word)).name
    name = str(given).removeprefix("fastrod_envs:").removeprefix(f"{NAMESPACE}/").removesuffix(f"-{VERSION}")
    if name not in _TASKS:
        raise UnknownNameError(f"no environment {given!r}; {nearest(name, _TASKS)}")
    return name


def _class_in(path: Path, word: str) -> type[Task]:
    """The task of this name in a file of Python. Raises `InputError` for a file that cannot be run,
    `UnknownNameError` for a task that is not there."""
    module = f"_fastrod_tasks_{path.stem}"
    if module not in sys.modules:
        spec = spec_from_file_location(module, path)
        if spec is None or spec.loader is None or not path.is_file():
            raise InputError(f"task file {str(path)!r} cannot be read: No such file or directory.")
        made = sys.modules[module] = module_from_spec(spec)
        try:
            spec.loader.exec_module(made)
        except Exception as error:  # a stranger's file raises what it likes
            del sys.modules[module]
            raise InputError(f"task file {str(path)!r} cannot be run: {error!r}.") from error
    known = {
        n: c for n, c in vars(sys.modules[module]).items() if isinstance(c, type) and issubclass(c, Task)
    }
    if word not in known:
        raise UnknownNameError(f"no task {word!r} in {str(path)!r}; {nearest(word, known)}")
    return known[word]


def entry_of(name: str) -> TaskEntry:
    """The entry of a task by its name or id. Raises `UnknownNameError`."""
    return _TASKS[name_of(name)]


def task_class(task: str | type[Task]) -> type[Task]:
    """The class of a task by its name or id; a class, registered or not, is returned as it is. Raises
    `UnknownNameError`, and `InputError` for a class that is no complete task."""
    if isinstance(task, type):
        return _checked(task)
    source = entry_of(task).source
    if isinstance(source, type):
        return source
    module, _, word = source.partition(":")
    found: type[Task] = getattr(import_module(module), word)
    return found


def make_task(task: str | type[Task], n_envs: int, options: Mapping[str, Any]) -> Task:
    """A task for so many robots. Raises `UnknownNameError`, `InputError`."""
    kind = task_class(task)
    return kind(n_envs, kind.options_class.read(options))


def register(task: _Class) -> _Class:
    """Register a task's class under its `name`; returns the class, so that it is also a decorator.

    `gymnasium.make("fastrod/<name>-v0")`, `make_vec`, `BatchEnv` and the commands know it from then on.
    Raises `InputError` for a class that is no complete task, or whose name another class has."""
    _checked(task)
    entry = TaskEntry(task, task.n_steps, task.solved)
    known = _TASKS.get(task.name)
    if known is not None and known.place != entry.place:
        raise InputError(
            f"a task named {task.name!r} is already registered, {known.place}; choose another name."
        )
    if known is not None:
        unregister(task.name)
    _TASKS[task.name] = entry
    _add_to_gymnasium(task.name)
    return task


def unregister(name: str) -> None:
    """Take a task out of the registry, and of Gymnasium's. Raises `UnknownNameError`."""
    from gymnasium.envs.registration import registry

    name = name_of(name)
    del _TASKS[name]
    registry.pop(id_of(name), None)


def register_all() -> None:
    """Register the shipped tasks with Gymnasium."""
    for name in names():
        _add_to_gymnasium(name)


@cache
def load_plug_ins() -> None:
    """Import the modules that installed packages name as entry points of the group `fastrod.tasks`. Warns of
    one that cannot be imported; the others are there all the same."""
    for plug_in in entry_points(group=GROUP):
        try:
            plug_in.load()
        except Exception as error:  # a stranger's module raises what it likes
            warnings.warn(f"the tasks of {plug_in.value!r} are missing: {error!r}.", stacklevel=2)


def _checked(task: type[Any]) -> type[Task]:
    """The class, where it is a complete task, or `InputError`."""
    if not (isinstance(task, type) and issubclass(task, Task)):
        raise InputError(
            f"the task is {shown(task)}; give a name, or a class derived from fastrod_envs.task.Task."
        )
    if inspect.isabstract(task):
        missing = ", ".join(sorted(task.__abstractmethods__))
        raise InputError(f"task {task.__name__} is not complete; it lacks {missing}.")
    for name, kind in (("name", str), ("n_steps", int), ("n_draws", int), ("accuracy", float)):
        value = getattr(task, name, None)
        if not isinstance(value, kind) or isinstance(value, bool):
            raise InputError(f"{task.__name__}.{name} is {shown(value)}; it must be of type {kind.__name__}.")
    if not task.name.isidentifier():
        raise InputError(f"{task.__name__}.name is {task.name!r}; it must be one word of letters and digits.")
    if task.n_steps < 1 or task.n_draws < 0:
        raise InputError(
            f"{task.__name__} has n_steps {task.n_steps} and n_draws {task.n_draws}; "
            "an episode has at least one step, and no fewer than 0 draws."
        )
    return task


def _add_to_gymnasium(name: str) -> None:
    """Register a task's id with Gymnasium, unless it is registered."""
    from gymnasium.envs.registration import register, registry

    if id_of(name) not in registry:
        register(
            id=id_of(name),
            entry_point="fastrod_envs.single:SingleEnv",
            vector_entry_point="fastrod_envs.vector:BatchEnv",
            kwargs={"task": name},
            max_episode_steps=_TASKS[name].n_steps,
            reward_threshold=_TASKS[name].solved,
        )


__all__ = ["EnvOptions", "ids", "make_task", "name_of", "names", "register", "register_all", "task_class"]
