"""`SingleEnv`: one environment, for `gymnasium.make`; the same episodes as a batch of one."""

from __future__ import annotations

import sys
import warnings
from typing import Any, ClassVar, final

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import ArrayLike

from fastrod.errors import InputError
from fastrod_envs.episodes import Episodes, Singles
from fastrod_envs.options import checked_difficulty, checked_mapping, with_steps
from fastrod_envs.registration import make_task, task_class
from fastrod_envs.rendering import Renderer
from fastrod_envs.task import Task
from fastrod_envs.vector import action_space


@final
class SingleEnv(gymnasium.Env[Singles, Any]):
    """One robot. `info` holds distance [m], success, contact, lost, position and desired (3,) [m],
    reward_terms, and facts of the task.

    >>> env = SingleEnv("Reach")
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    >>> sorted(info["reward_terms"])
    ['height', 'reach']
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "render_modes": ["rgb_array", "viser"],
        "render_fps": 25,
    }

    def __init__(
        self,
        task: str | type[Task],
        *,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ) -> None:
        """See `BatchEnv`, with one environment. One that `gymnasium.make` makes without n_steps leaves the
        end of an episode to it."""
        self._spec: EnvSpec | None = None
        self._own_steps = max_episode_steps is not None or options.get("n_steps") is not None
        self.render_mode = render_mode
        self._renderer = Renderer(render_mode)
        self.task = make_task(task, 1, with_steps(options, max_episode_steps, task_class(task).n_steps))
        self._episodes = Episodes(self.task)
        self.observation_space = gymnasium.spaces.Box(
            self._episodes.low, self._episodes.high, dtype=np.float32
        )
        self.action_space = action_space(self.task)

    @property
    def spec(self) -> EnvSpec | None:
        """Return what `gymnasium.make` made it from; None where nobody did."""
        return self._spec

    @spec.setter
    def spec(self, made: EnvSpec | None) -> None:
        self._spec = made
        if made is not None and not self._own_steps:
            # its TimeLimit counts, to max_episode_steps of gymnasium.make or of the registry
            self._episodes.n_steps = sys.maxsize

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Singles, dict[str, Any]]:
        """Begin an episode; `options={"difficulty": level}` sets the curriculum's level. Raises
        `InputError`."""
        super().reset(seed=seed)
        options = checked_mapping(options)
        level = checked_difficulty(options.pop("difficulty", self.task.difficulty))
        if options:
            raise InputError(f"reset has no option {next(iter(options))!r}; known: difficulty.")
        self._warn_of_limit()
        self._episodes.seed([seed])
        self.task.set_difficulty(level)
        self._episodes.begin(np.array([0]))
        return self._episodes.observation()[0], {}

    def step(self, action: ArrayLike) -> tuple[Singles, float, bool, bool, dict[str, Any]]:
        """One step. Raises `InputError` on a wrong shape and on what is not finite; then nothing was
        simulated."""
        moment = self._episodes.advance(np.asanyarray(action)[None])
        return (
            self._episodes.observation()[0],
            float(moment.reward[0]),
            bool(moment.terminated[0]),
            bool(moment.truncated[0]),
            _first(self._episodes.info(moment)),
        )

    def _warn_of_limit(self) -> None:
        """Say that the TimeLimit of `gymnasium.make` has ended an episode before its n_steps; nobody else
        resets at this very step."""
        usual, own = self.task.n_steps, self._episodes.n_steps
        if self._spec is not None and self._own_steps and own > usual == self._episodes.elapsed[0]:
            warnings.warn(
                f"n_steps is {own}, but gymnasium.make ended the episode after {usual} steps; give "
                f"max_episode_steps={own} as well.",
                stacklevel=3,
            )

    def baseline(self) -> Singles:
        """(n_actions,) what the task's scripted baseline does now."""
        return np.asarray(self.task.baseline()[0], dtype=np.float32)

    def set_difficulty(self, level: float) -> None:
        """Curriculum: from the next episode on, from 0 to 1. Raises `InputError`."""
        self.task.set_difficulty(level)

    def render(self) -> np.ndarray | None:
        """With rgb_array a picture (height, width, 3); with viser the page shows the robot now."""
        pictures = self._renderer.render(self.task)
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Close worlds and pages."""
        self._renderer.close()
        self.task.close()


def _first(reported: dict[str, Any]) -> dict[str, Any]:
    """The first row of every array, numbers as Python's own."""
    row: dict[str, Any] = {}
    for name, value in reported.items():
        row[name] = (
            _first(value) if isinstance(value, dict) else value[0].item() if np.ndim(value) == 1 else value[0]
        )
    return row
