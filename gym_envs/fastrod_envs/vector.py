"""`BatchEnv`: a `gymnasium.vector.VectorEnv` whose N environments are the N robots of one simulator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Literal, final

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from fastrod.checks import COUNT, check_number
from fastrod.errors import InputError, nearest
from fastrod.threads import one_blas_thread
from fastrod.types import Flags, Floats
from fastrod_envs.episodes import Episodes, Singles
from fastrod_envs.options import checked_difficulty, checked_mapping, with_steps
from fastrod_envs.registration import make_task, task_class
from fastrod_envs.rendering import Renderer
from fastrod_envs.task import Task

_AUTORESET = {"same_step": AutoresetMode.SAME_STEP, "next_step": AutoresetMode.NEXT_STEP}


def action_space(task: Task) -> gymnasium.spaces.Box:
    """Return the action space of one environment: from -1 to 1, whose meaning and units `Task.actions`
    has."""
    return gymnasium.spaces.Box(-1.0, 1.0, (task.n_actions,), np.float32)


@final
class BatchEnv(VectorEnv[Singles, Any, Any]):
    """N environments in one; those that end begin anew in the same step (`AutoresetMode.SAME_STEP`), or with
    autoreset="next_step" in the next one, whose action they do not heed, as Gymnasium's vector wrappers want
    it. Actions beyond -1 and 1 are clipped.

    Environment i of `reset(seed=s)` is the environment of `gymnasium.make` after `reset(seed=s + i)`, bit for
    bit, whatever N is.

    `info` holds arrays (n, ...), each with its mask `_name` as Gymnasium has it: distance [m], success,
    contact, lost, position and desired (3,) [m], and reward_terms; after a step in which episodes ended also
    final_obs and final_info of those.

    >>> env = BatchEnv("Reach", num_envs=3)
    >>> observation, info = env.reset(seed=0)
    >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    >>> observation.shape == (3, *env.single_observation_space.shape), reward.shape
    (True, (3,))
    """

    metadata: ClassVar[dict[str, Any]] = {  # type: ignore[misc]
        "autoreset_mode": AutoresetMode.SAME_STEP,
        "render_modes": ["rgb_array", "viser"],
        "render_fps": 25,
    }

    def __init__(
        self,
        task: str | type[Task],
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        autoreset: Literal["same_step", "next_step"] = "same_step",
        **options: Any,
    ) -> None:
        """`task` is the name in the id, `FILE.py:Class`, or a task's class; `options` are those of
        the task (`Options`), `max_episode_steps` is another name of n_steps. Raises `InputError`,
        `UnknownNameError`, `HostError`."""
        check_number("num_envs", num_envs, COUNT, whole=True)
        if autoreset not in _AUTORESET:
            raise InputError(f"autoreset is {autoreset!r}; {nearest(str(autoreset), _AUTORESET)}")
        self.metadata = {**self.metadata, "autoreset_mode": _AUTORESET[autoreset]}  # type: ignore[misc]
        self.render_mode = render_mode
        self._renderer = Renderer(render_mode)
        self.task = make_task(
            task, int(num_envs), with_steps(options, max_episode_steps, task_class(task).n_steps)
        )
        self.num_envs = int(num_envs)
        self._episodes = Episodes(self.task)
        self.single_observation_space = gymnasium.spaces.Box(
            self._episodes.low, self._episodes.high, dtype=np.float32
        )
        self.single_action_space = action_space(self.task)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._every = np.ones(self.num_envs, bool)
        self._next_step, self._over = autoreset == "next_step", np.zeros(self.num_envs, bool)

    @property
    def n_steps(self) -> int:
        """Number of steps of an episode."""
        return self._episodes.n_steps

    @property
    def returned(self) -> Floats:
        """(n,) rewards so far of the episodes under way."""
        return self._episodes.returned.copy()

    @property
    def elapsed(self) -> Any:
        """(n,) steps of the episodes under way."""
        return self._episodes.elapsed.copy()

    @one_blas_thread
    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Singles, dict[str, Any]]:
        """Begin episodes in all environments, or in those of `options={"reset_mask": (n,) bool}`. A
        whole-number seed s gives environment i the seed s + i; those that go on keep theirs. Raises
        `InputError`; then nothing has changed."""
        super().reset(seed=None)
        options = checked_mapping(options)
        mask = np.asarray(options.pop("reset_mask", self._every))
        if mask.shape != (self.num_envs,) or mask.dtype != bool or not mask.any():
            raise InputError(
                f"reset_mask has shape {mask.shape} and type {mask.dtype}; give "
                f"({self.num_envs},) bool, some of it True."
            )
        level = checked_difficulty(options.pop("difficulty", self.task.difficulty))
        if options:
            raise InputError(f"reset has no option {next(iter(options))!r}; known: difficulty, reset_mask.")
        self._episodes.seed(
            [s if begins else None for s, begins in zip(self._seeds(seed), mask, strict=True)]
        )
        self.task.set_difficulty(level)
        self._episodes.begin(np.flatnonzero(mask))
        self._over &= ~mask
        return self._episodes.observation(), {}

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        """One for each environment. Raises `InputError`."""
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)) and not isinstance(seed, bool):
            return [int(seed) + i for i in range(self.num_envs)]
        if (
            isinstance(seed, (bool, str))
            or not isinstance(seed, (Sequence, np.ndarray))
            or len(seed) != self.num_envs
        ):
            raise InputError(
                f"seed is {seed!r}; give one whole number, zero or positive, or one for each "
                f"of {self.num_envs} environments."
            )
        return list(seed)

    @one_blas_thread
    def step(self, actions: ArrayLike) -> tuple[Singles, Floats, Flags, Flags, dict[str, Any]]:
        """One step of all environments: `actions` (n, n_actions); observations (n, size), rewards, terminated
        and truncated (n,), infos.

        Actions beyond -1 and 1 are clipped. Raises `InputError` on a wrong shape and on what is not finite;
        then nothing was simulated.
        """
        begins = self._over
        moment = self._episodes.advance(actions, begins)
        reported = self._episodes.info(moment)
        infos = _masked(reported, self._every)
        if begins.any():  # they began when the last step ended, and have waited for this one
            self._episodes.begin(np.flatnonzero(begins), again=True)
            self._over = np.zeros(self.num_envs, bool)
        observation = self._episodes.observation()
        done = moment.terminated | moment.truncated
        if done.any():
            rows = np.flatnonzero(done)
            final = np.full(self.num_envs, None, dtype=object)
            for i in rows:
                final[i] = observation[i]
            reported["episode"] = {"r": self._episodes.returned.copy(), "l": self._episodes.elapsed.copy()}
            infos |= {
                "final_obs": final,
                "_final_obs": done,
                "final_info": _masked(reported, done),
                "_final_info": done,
            }
            self._episodes.begin(rows)
            if self._next_step:
                self._over = done
                return observation, moment.reward, moment.terminated, moment.truncated, infos
            begun = self._episodes.observation()
            observation = np.where(done[:, None], begun, observation)
        return observation, moment.reward, moment.terminated, moment.truncated, infos

    @one_blas_thread
    def baseline(self) -> Singles:
        """(n, n_actions) what the task's scripted baseline does now."""
        return self.task.baseline().astype(np.float32)

    def set_difficulty(self, level: float) -> None:
        """Curriculum: from the next episodes on, from 0 to 1. Raises `InputError`."""
        self.task.set_difficulty(level)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """With rgb_array a picture (height, width, 3) of every environment; with viser the page shows the
        first ones now."""
        return self._renderer.render(self.task)

    def close_extras(self, **kwargs: Any) -> None:  # noqa: ARG002
        """Close worlds and pages."""
        self._renderer.close()
        self.task.close()


def _masked(reported: dict[str, Any], mask: Flags) -> dict[str, Any]:
    """Gymnasium's infos of a batch: every array with the mask of those who have it."""
    infos: dict[str, Any] = {}
    for name, value in reported.items():
        infos[name] = _masked(value, mask) if isinstance(value, dict) else value
        infos[f"_{name}"] = mask
    return infos
