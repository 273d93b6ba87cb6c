"""Rollouts of an environment: what a policy, the scripted baseline or chance does in it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, final

import numpy as np

from fastrod.errors import InputError, nearest, shown
from fastrod.generation.columns import Column, numbered
from fastrod.generation.draws import robot_of
from fastrod.loading import load_robot
from fastrod.model.robot import Robot
from fastrod.model.robotfile import dumps

POLICIES = ("shipped", "baseline", "random")


@final
@dataclass(frozen=True, kw_only=True)
class Rollouts:
    """Episodes of an environment, each from a seed of its own, which `gymnasium.make(...).reset(seed=...)`
    takes as well."""

    env: str
    """A task's name or id."""
    policy: str = "random"
    """Policy that acts: one of `POLICIES`."""
    options: tuple[tuple[str, Any], ...] = ()
    """Options of the environment, name and value, as JSON has it. A robot, or a robot file's name, becomes
    the file's text, so that the data set hangs on no file that may change."""

    def __post_init__(self) -> None:
        from fastrod_envs.learning.policies import find
        from fastrod_envs.randomisation import Randomisation
        from fastrod_envs.registration import name_of, task_class

        if not isinstance(self.env, str):
            raise InputError(f"env is {shown(self.env)}; give a task's name, such as 'Reach'.")
        object.__setattr__(self, "env", name_of(self.env))
        pairs = self.options if isinstance(self.options, (tuple, list)) else (self.options,)
        if not all(
            isinstance(pair, (tuple, list)) and len(pair) == 2 and isinstance(pair[0], str) for pair in pairs
        ):
            raise InputError(
                f"options are {shown(self.options)}; give pairs of name and value, such as "
                "(('n_steps', 100),)."
            )
        object.__setattr__(self, "options", tuple((name, _written(name, value)) for name, value in pairs))
        if self.policy not in POLICIES:
            raise InputError(f"no policy {self.policy!r} to roll out; {nearest(str(self.policy), POLICIES)}")
        if self.policy == "shipped":
            find(self.env, self.policy)
        given = self._given()
        task_class(self.env).options_class.read(given)
        Randomisation.of(given.get("randomise"))

    @property
    def index(self) -> str:
        """Episodes are counted."""
        return "episode"

    @property
    def usual(self) -> int:
        """Episodes of a shard."""
        from fastrod_envs.registration import task_class

        return 8 if task_class(self.env).hosted else 256

    def make(self, first: int, count: int, seed: Sequence[int]) -> list[Column]:
        """Every episode with one row more than steps: the last holds the final observation, and no action."""
        from fastrod_envs.learning.policies import Policy, find
        from fastrod_envs.vector import BatchEnv

        rng = np.random.default_rng(seed)
        seeds = [
            int(np.random.SeedSequence((seed[0], first + i)).generate_state(1, np.uint64)[0] >> np.uint64(1))
            for i in range(count)
        ]
        policy = Policy(find(self.env, self.policy)) if self.policy == "shipped" else None
        options = {**({} if policy is None else policy.options), "threads": 1, **self._given()}
        env = BatchEnv(self.env, num_envs=count, **options)
        try:
            if policy is not None:
                policy.check(env)
            return self._run(env, policy, first, seeds, rng)
        finally:
            env.close()

    def _given(self) -> dict[str, Any]:
        """The options, with robots for the texts of robot files."""
        given = dict(self.options)
        randomise = given.get("randomise")
        if isinstance(randomise, str):
            given["randomise"] = robot_of(randomise)
        elif isinstance(randomise, Mapping) and isinstance(text := randomise.get("robot"), str):
            given["randomise"] = {**randomise, "robot": robot_of(text)}
        return given

    def _run(
        self, env: Any, policy: Any, first: int, seeds: Sequence[int], rng: np.random.Generator
    ) -> list[Column]:
        n, n_steps, n_actions = env.num_envs, env.n_steps, env.task.n_actions
        seen = np.full((n, n_steps + 1, env.single_observation_space.shape[0]), np.nan, np.float32)
        done = np.full((n, n_steps + 1, n_actions), np.nan, np.float32)
        reward, distance = np.full((n, n_steps + 1), np.nan), np.full((n, n_steps + 1), np.nan)
        flags = {
            name: np.zeros((n, n_steps + 1), bool) for name in ("terminated", "truncated", "success", "lost")
        }
        length = np.zeros(n, np.int64)
        observation, _ = env.reset(seed=list(seeds))
        open_ = np.ones(n, bool)
        for step in range(n_steps):
            drawn = rng.uniform(-1.0, 1.0, (n, n_actions))
            act = (
                policy.act(observation)
                if policy is not None
                else env.baseline()
                if self.policy == "baseline"
                else drawn
            )
            act = np.clip(np.asarray(act, np.float32), -1.0, 1.0)
            seen[open_, step], done[open_, step] = observation[open_], act[open_]
            observation, gained, terminated, truncated, info = env.step(act)
            reward[open_, step], distance[open_, step] = gained[open_], info["distance"][open_]
            for name, values in {**info, "terminated": terminated, "truncated": truncated}.items():
                if name in flags:
                    flags[name][open_, step] = values[open_]
            ended = np.flatnonzero((terminated | truncated) & open_)
            for i in ended:
                seen[i, step + 1], length[i] = info["final_obs"][i], step + 1
            open_[ended] = False
            if not open_.any():
                break
        used = np.arange(n_steps + 1) <= length[:, None]
        episode, place = np.nonzero(used)
        columns = [
            Column("episode", episode + first, "", "counts over the whole data set"),
            Column("step", place, "", "of the episode; the last has the final observation and no action"),
            Column("seed", np.asarray(seeds, np.int64)[episode], "", "of the episode, for reset(seed=...)"),
        ]
        columns += numbered(
            "obs", seen[used], "", "observation before the step, as the environment scales it"
        )
        columns += numbered("action", done[used], "", "from -1 to 1; nan in the last row")
        columns.append(Column("reward", reward[used], "", "of the step; nan in the last row"))
        columns.append(
            Column("distance", distance[used], "m", "from the goal, after the step; nan in the last row")
        )
        columns += [Column(name, values[used], "", "after the step") for name, values in flags.items()]
        return columns

    def failed(self, columns: Sequence[Column]) -> int:
        """Episodes whose robot was lost."""
        return sum(int(np.asarray(column.values).sum()) for column in columns if column.name == "lost")


def _written(name: str, value: object) -> Any:
    """An option as a plan holds it. Raises `InputError` for what JSON has no words for, and what `load_robot`
    raises."""
    from fastrod_envs.randomisation import Randomisation

    plain = value
    if name == "randomise":
        if isinstance(plain, Randomisation):
            plain = {field.name: getattr(plain, field.name) for field in fields(plain)}
        if isinstance(plain, Mapping):
            plain = {**plain, **({"robot": _text(plain["robot"])} if "robot" in plain else {})}
            plain = {
                key: dict(entry) if isinstance(entry, Mapping) else entry for key, entry in plain.items()
            }
        else:
            plain = _text(plain)
    try:
        return json.loads(json.dumps(plain, allow_nan=False))
    except (TypeError, ValueError) as error:
        raise InputError(
            f"option {name!r} is {shown(value)}; a plan holds finite numbers, words, lists and mappings."
        ) from error


def _text(robot: object) -> object:
    """The text of a robot file; what is neither robot nor file stays."""
    if isinstance(robot, (str, Path)) and "\n" not in str(robot):
        robot = load_robot(robot)
    return dumps(robot) if isinstance(robot, Robot) else robot
