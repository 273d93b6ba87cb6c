"""How each task is trained unless the command says otherwise: algorithm, batch, steps, and the options of its environments."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fastrod.errors import UnknownNameError, nearest
from fastrod_envs.registration import name_of

ALGORITHMS = ("sac", "ppo", "td3")
NETWORK = (256, 256)
"""Of the paper, as learning rate and discount."""
LEARNING_RATE, DISCOUNT = 3e-4, 0.99


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Settings of a training."""

    algorithm: str = "ppo"
    n_envs: int = 256
    steps: int = 3_000_000
    """Environment steps in all."""
    imitate: int = 0
    """Steps of the scripted baseline's lessons before (dataset aggregation, Ross 2011)."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Of the environments."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Of the algorithm."""


_ROBOTS: Mapping[str, Any] = {
    "backlash.half_width": (0.0, 4e-4), "friction.half_width": (0.0, 3e-4), "drum_gain.gain": (-0.1, 0.1), "latency.delay": (0.0, 0.1),
    "gravity.line_density": (0.0, 0.3), "creep.share": (0.0, 0.1), "tendon_stretch.compliance": (0.0, 5e-4),
    "stiffening.cubic": (-0.1, 0.1),
}  # fmt: skip
"""Effects of a prototype that may be: what Track is trained on."""

_PRESETS: Mapping[str, Preset] = {
    "Reach": Preset(n_envs=512, steps=3_000_000, options={"reward": "precise"}),
    "ReachObstacle": Preset(n_envs=512, steps=4_000_000, options={"reward": "precise"}),
    "Catch": Preset(n_envs=256, steps=500_000, imitate=50_000),
    "TubeInsert": Preset(n_envs=32, steps=0, imitate=24_000),
    "Push": Preset(n_envs=8, steps=0, imitate=24_000),
    "QuadrupedPush": Preset(n_envs=8, steps=0, imitate=12_000),
    "BoxExplore": Preset(n_envs=8, steps=0, imitate=12_000),
    "PickPlace": Preset(n_envs=8, steps=0, imitate=40_000),
    "DualArm": Preset(n_envs=8, steps=0, imitate=12_000),
    "Track": Preset(n_envs=128, steps=1_000_000, imitate=100_000, options={"reward": "precise", "randomise": {**_ROBOTS, "absent": 0.4}}),
}


def preset_of(env: str) -> Preset:
    """The preset of a task by its name or id; tasks without one of their own have the general one. Raises `UnknownNameError`."""
    return _PRESETS.get(name_of(env), Preset())


def settings_of(algorithm: str, n_envs: int, n_steps: int, steps: int, given: Mapping[str, Any]) -> dict[str, Any]:
    """Keyword arguments of stable-baselines3's class: the paper's network, learning rate and discount, and numbers that use the batch.

    PPO learns from whole episodes of the batch, in ten or more minibatches. SAC and TD3 take one gradient step for 16 environment
    steps, on large minibatches: the learner, not the simulator, is what takes time. Raises `UnknownNameError` for an algorithm that
    is not there.
    """
    common = {"learning_rate": LEARNING_RATE, "gamma": DISCOUNT}
    if algorithm == "ppo":
        rollout = int(given.get("n_steps", min(max(n_steps, 4096 // n_envs), max(steps // n_envs, 2))))
        batch = _divisor(n_envs * rollout, min(4096, n_envs * rollout // 8))
        own = {"n_steps": rollout, "batch_size": batch, "n_epochs": 8, "gae_lambda": 0.95, "clip_range": 0.2, "ent_coef": 0.0}
    elif algorithm in ALGORITHMS:
        own = {
            "batch_size": 1024, "buffer_size": 1_000_000, "train_freq": 1, "gradient_steps": max(1, n_envs // 16),
            "learning_starts": max(10 * n_envs, 1000), "tau": 0.005,
        }  # fmt: skip
    else:
        raise UnknownNameError(f"no algorithm {algorithm!r}; {nearest(algorithm, ALGORITHMS)}")
    return {**common, **own, **given}


def _divisor(total: int, most: int) -> int:
    """The largest divisor of `total` up to `most`: minibatches of one size."""
    return max((d for k in range(1, int(total**0.5) + 1) if total % k == 0 for d in (k, total // k) if d <= most), default=total)
