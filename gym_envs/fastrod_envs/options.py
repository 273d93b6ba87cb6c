"""Options of every task: length of an episode, what is observed, what an action is, what differs from
robot to robot."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from fastrod.checks import Bound, check, check_number
from fastrod.errors import InputError, nearest
from fastrod.model.robot import Robot
from fastrod.solver.gpu.device import Device, checked_name
from fastrod_envs.randomisation import Randomisation

Observation = Literal["state", "goal"]
Action = Literal["rate", "displacement"]
Made = TypeVar("Made", bound="EnvOptions")


@dataclass(frozen=True, kw_only=True)
class EnvOptions:
    """Keyword arguments of `gymnasium.make` and `make_vec`, the same for every task; some tasks have more."""

    n_steps: Annotated[int | None, Bound(least=1)] = None
    """Steps of an episode, None for the task's own number; 1, with `action="displacement"`, is the paper's
    bandit."""
    observation: Observation = "state"
    """`state`: goal, robot and scene; `goal`: the goal alone, as in the paper."""
    action: Action = "rate"
    """`rate`: how fast tendons are displaced; `displacement`: where they go, at once (the paper's)."""
    randomise: Randomisation | Robot | str | Path | Mapping[str, Any] | None = None
    """Robot parameters and effects that differ from episode to episode (`Randomisation`): a robot file,
    such as an identified.toml, or a mapping of names to ranges."""
    difficulty: Annotated[float, Bound(least=0.0, most=1.0)] = 1.0
    """Difficulty from 0, all goals are the easiest, to 1, the whole task; `set_difficulty` changes it between
    episodes (curriculum)."""
    threads: int | None = None
    """Threads of the simulator; None is numba's number."""
    device: Device = "cpu"
    """Device of the simulator, `cpu` or `cuda`; tasks in which rods feel contact or hold a host's bodies
    have the CPU alone."""

    def __post_init__(self) -> None:
        checked_name(self.device)  # with the nearest of its names
        check(self, "")

    @classmethod
    def read(cls: type[Made], given: Mapping[str, Any]) -> Made:
        """Options from keyword arguments. Raises `InputError` with the nearest name."""
        known = [field.name for field in fields(cls)]
        for name in given:
            if name not in known:
                raise InputError(f"no option {name!r}; {nearest(name, known)}")
        return cls(**given)


def checked_difficulty(level: float) -> float:
    """A level from 0 to 1, or `InputError`."""
    check_number("difficulty", level, Bound(least=0.0, most=1.0))
    return float(level)


def checked_mapping(given: object) -> dict[str, Any]:
    """Return what `reset` is given, as a new dictionary, or `InputError`."""
    if given is not None and not isinstance(given, Mapping):
        raise InputError(f"options are {given!r}; give a dictionary, or None.")
    return dict(given or {})


def with_steps(options: Mapping[str, Any], max_episode_steps: int | None, n_steps: int) -> dict[str, Any]:
    """Options with Gymnasium's name of n_steps as ours; the task's own `n_steps`, which `make_vec` gives
    where nobody else does, yields to an option. Raises `InputError` where both are given and differ."""
    if max_episode_steps is None or (options.get("n_steps") is not None and max_episode_steps == n_steps):
        return dict(options)
    if options.get("n_steps", max_episode_steps) != max_episode_steps:
        raise InputError(
            f"n_steps is {options['n_steps']!r} and max_episode_steps {max_episode_steps!r}; "
            "give one of them."
        )
    return {**options, "n_steps": max_episode_steps}
