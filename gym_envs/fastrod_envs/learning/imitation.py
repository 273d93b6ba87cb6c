"""Lessons from a task's scripted baseline: the policy acts, the baseline says what it would have done
(dataset aggregation).

Ross, Gordon, Bagnell, "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
Learning", AISTATS 2011.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm

from fastrod_envs.vector import BatchEnv

_ROUNDS = 10
_BATCH = 512
_EPOCHS = 6  # over all lessons, after each round


def actor_mean(model: BaseAlgorithm, observation: torch.Tensor) -> torch.Tensor:
    """(batch, n_actions) of the policy without its noise, differentiable."""
    policy: Any = model.policy
    if hasattr(policy, "get_distribution"):
        mean: torch.Tensor = policy.get_distribution(observation).distribution.mean
        return mean
    if model.__class__.__name__ == "SAC":
        return torch.as_tensor(policy.actor(observation, deterministic=True))
    return torch.as_tensor(policy.actor(observation))


def imitate(
    model: BaseAlgorithm,
    env: BatchEnv,
    steps: int,
    seed: int,
    progress: Callable[[str, int, int], None] | None = None,
) -> float:
    """Fit the policy's mean to the baseline over about `steps` environment steps; the root mean square of
    what is left, in actions.

    In the first round the baseline acts, from then on the policy with less and less of it, so that the
    lessons are where the policy goes.
    """
    rng, policy = np.random.default_rng(seed), model.policy
    per_round = max(1, steps // (_ROUNDS * env.num_envs))
    seen: list[np.ndarray] = []
    said: list[np.ndarray] = []
    observation, _ = env.reset(seed=seed)
    parameters = [
        p
        for name, p in policy.named_parameters()
        if "log_std" not in name and "critic" not in name and "value" not in name
    ]
    optimizer = torch.optim.Adam(parameters, lr=1e-3)
    left = float("nan")
    for k in range(_ROUNDS):
        fraction = 0.5**k if k < _ROUNDS // 2 else 0.0
        for _ in range(per_round):
            lesson = env.baseline()
            seen.append(observation)
            said.append(lesson)
            own, _ = model.predict(observation, deterministic=True)
            noise = rng.normal(0.0, 0.1, lesson.shape)
            acts = np.where(rng.random((env.num_envs, 1)) < fraction, lesson, own) + noise
            observation, *_ = env.step(acts)
        if progress is not None:
            progress("lessons", k, _ROUNDS)
        x, y = torch.as_tensor(np.concatenate(seen)), torch.as_tensor(np.concatenate(said))
        policy.set_training_mode(True)
        epochs = _EPOCHS * (3 if k == _ROUNDS - 1 else 1)
        n_batches = -(-len(x) // _BATCH)
        for group in optimizer.param_groups:
            group["lr"] = 1e-3
        for epoch in range(epochs):
            if k == _ROUNDS - 1:
                for group in optimizer.param_groups:
                    group["lr"] = 1e-3 * (1.0 - epoch / epochs)
            order, total = torch.as_tensor(rng.permutation(len(x))), 0.0
            for b in range(n_batches):
                rows = order[b * _BATCH : (b + 1) * _BATCH]
                loss = torch.nn.functional.mse_loss(actor_mean(model, x[rows]), y[rows])
                optimizer.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                total += float(loss.detach()) * len(rows)
            left = float(np.sqrt(total / len(x)))
        policy.set_training_mode(False)
    return left
