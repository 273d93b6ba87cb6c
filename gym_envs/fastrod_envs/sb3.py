"""stable-baselines3 on a batch: a `VecEnv` around `BatchEnv`, and features scaled by the bounds of the
observation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv

from fastrod.errors import InputError
from fastrod_envs.episodes import Singles
from fastrod_envs.task import Task
from fastrod_envs.vector import BatchEnv


def make(task: str | type[Task], num_envs: int = 1, **options: Any) -> BatchVecEnv:
    """Make environments of a task for stable-baselines3; arguments as of `BatchEnv`.

    >>> make("Reach", 2).num_envs
    2
    """
    return BatchVecEnv(BatchEnv(task, num_envs, **options))


@final
class BatchVecEnv(VecEnv):
    """A `BatchEnv` as stable-baselines3 wants it: `terminal_observation`, `TimeLimit.truncated` and `episode`
    in the infos of those that ended, with what the last step reported of them (distance, success, ...).

    >>> env = BatchVecEnv(BatchEnv("Reach", num_envs=2))
    >>> env.reset().shape == (2, *env.observation_space.shape)
    True
    """

    def __init__(self, env: BatchEnv) -> None:
        """Raises `InputError` for a batch that begins episodes in the next step."""
        if env.metadata["autoreset_mode"] is not AutoresetMode.SAME_STEP:
            raise InputError("stable-baselines3 needs a batch with autoreset='same_step'.")
        self.env = env
        self.render_mode = env.render_mode
        self._action: Singles | None = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)

    def reset(self) -> Singles:
        """(n, n_obs) of new episodes; seeds are those of `seed`."""
        seeds = None if all(seed is None for seed in self._seeds) else self._seeds
        observation, _ = self.env.reset(seed=seeds)
        self._reset_seeds()
        return observation

    def step_async(self, actions: np.ndarray) -> None:
        """Note the actions (n, n_actions)."""
        self._action = actions

    def step_wait(self) -> Any:
        """Observations, rewards, dones and infos of the step."""
        observation, reward, terminated, truncated, batch_info = self.env.step(
            self._action if self._action is not None else []
        )
        done = terminated | truncated
        nothing: dict[str, Any] = {}
        infos = [nothing] * self.num_envs
        if done.any():
            final = batch_info["final_info"]
            plain = [
                name for name, a in final.items() if not name.startswith("_") and not isinstance(a, dict)
            ]
            for i in np.flatnonzero(done):
                row: dict[str, Any] = {name: final[name][i] for name in plain}
                episode = final["episode"]
                row["episode"] = {"r": float(episode["r"][i]), "l": int(episode["l"][i]), "t": 0.0}
                row["is_success"] = bool(final["success"][i])
                row["terminal_observation"] = batch_info["final_obs"][i]
                row["TimeLimit.truncated"] = bool(truncated[i])
                infos[i] = row
        return observation, reward.astype(np.float32), done, infos

    def close(self) -> None:
        """Close the batch."""
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The batch's attribute, once for each index."""
        return [getattr(self.env, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Environments of a batch have no attributes of their own."""
        raise InputError(
            f"attribute {attr_name!r} cannot be set: the environments of a batch share their attributes."
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call the batch's method once; its answer stands for each index."""
        answer = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [answer] * len(list(self._get_indices(indices)))

    def env_is_wrapped(
        self, wrapper_class: type[gymnasium.Wrapper[Any, Any, Any, Any]], indices: Any = None
    ) -> list[bool]:
        """None is."""
        return [False] * len(list(self._get_indices(indices)))

    def get_images(self) -> Sequence[np.ndarray | None]:
        """A picture of each environment, with render_mode rgb_array."""
        return list(self.env.render() or [None] * self.num_envs)


@final
class ScaledFeatures(BaseFeaturesExtractor):
    """Observations from -1 to 1 by the bounds of their space: part of the policy, so that it needs nothing
    beside its file."""

    middle: torch.Tensor
    reach: torch.Tensor

    def __init__(self, observation_space: gymnasium.spaces.Box) -> None:
        super().__init__(observation_space, features_dim=int(np.prod(observation_space.shape)))
        low, high = torch.as_tensor(observation_space.low), torch.as_tensor(observation_space.high)
        self.register_buffer("middle", 0.5 * (low + high))
        self.register_buffer("reach", (0.5 * (high - low)).clamp(min=1e-6))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(batch, n_obs)"""
        return (observations - self.middle) / self.reach
