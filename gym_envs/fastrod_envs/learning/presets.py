"""Training presets of each task, as presets.toml has them, and the settings of an algorithm."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Any

from fastrod.errors import InputError, UnknownNameError, nearest, shown
from fastrod_envs.registration import name_of

ALGORITHMS = ("sac", "ppo", "td3")
NETWORK = (256, 256)
"""Network of the paper, with its learning rate and discount."""
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
    """Options of the environments."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the algorithm."""


_FILE = tomllib.loads((files("fastrod_envs.learning") / "presets.toml").read_text(encoding="utf-8"))
_PRESETS: Mapping[str, Preset] = {name: Preset(**table) for name, table in _FILE["preset"].items()}
_Range = tuple[str, float, float]
_SETTINGS: Mapping[str, Mapping[str, _Range]] = _FILE["settings"]
"""Settings of each algorithm of stable-baselines3 that a command line can give: kind, least and largest
value."""


def preset_of(env: str) -> Preset:
    """The preset of a task by its name or id; tasks without one of their own have the general one. Raises
    `UnknownNameError`."""
    return _PRESETS.get(name_of(env), Preset())


def settings_of(
    algorithm: str, n_envs: int, n_steps: int, steps: int, given: Mapping[str, Any]
) -> dict[str, Any]:
    """Keyword arguments of stable-baselines3's class: the paper's network, learning rate and discount, and
    numbers that use the batch.

    PPO learns from whole episodes of the batch, in ten or more minibatches. SAC and TD3 take one gradient
    step for 16 environment steps, on large minibatches: the learner, not the simulator, is what takes time.
    Raises `UnknownNameError` for an algorithm or a setting that is not there, `InputError` for a setting that
    cannot be.
    """
    if algorithm not in ALGORITHMS:
        raise UnknownNameError(f"no algorithm {algorithm!r}; {nearest(algorithm, ALGORITHMS)}")
    check_settings(algorithm, given)
    common = {"learning_rate": LEARNING_RATE, "gamma": DISCOUNT}
    if algorithm == "ppo":
        rollout = int(given.get("n_steps", min(max(n_steps, 4096 // n_envs), max(steps // n_envs, 2))))
        batch = _divisor(n_envs * rollout, min(4096, n_envs * rollout // 8))
        own = {
            "n_steps": rollout,
            "batch_size": batch,
            "n_epochs": 8,
            "gae_lambda": 0.95,
            "clip_range": 0.2,
            "ent_coef": 0.0,
        }
    else:
        own = {
            "batch_size": 1024,
            "buffer_size": 1_000_000,
            "train_freq": 1,
            "gradient_steps": max(1, n_envs // 16),
            "learning_starts": max(10 * n_envs, 1000),
            "tau": 0.005,
        }
    return {**common, **own, **given}


_WORDS: Mapping[str, str] = {"ent_coef": "auto", "target_entropy": "auto"}
"""Settings of SAC by name: a word that is as good as a number."""
_NONE = ("clip_range_vf", "target_kl")
_DEEPEST, _WIDEST = 16, 4096  # layers of a network and their width: 1 GB of weights
_SYNONYMS: Mapping[str, str] = {
    "lr": "learning_rate",
    "discount": "gamma",
    "epochs": "n_epochs",
    "minibatch": "batch_size",
    "rollout": "n_steps",
    "lambda": "gae_lambda",
    "entropy": "ent_coef",
}
"""Names that other libraries use."""


def check_settings(algorithm: str, given: Mapping[str, Any]) -> None:
    """Raises `UnknownNameError` for a setting that the algorithm does not take, `InputError` for a value that
    it cannot have."""
    known = _SETTINGS[algorithm]
    for name, value in given.items():
        if name == "policy_kwargs" and isinstance(value, Mapping):
            _check_policy(algorithm, value)
            continue
        if name not in known:
            meant = _SYNONYMS.get(name.lower())
            hint = f"did you mean {meant!r}?" if meant in known else nearest(name, known)
            raise UnknownNameError(f"{algorithm} has no setting {name!r}; {hint}")
        if (algorithm == "sac" and _is_word(name, value)) or (value is None and name in _NONE):
            continue
        _check_range(algorithm, name, value, known[name])


def _check_policy(algorithm: str, given: Mapping[str, Any]) -> None:
    net = given.get("net_arch", ())
    for layers in net.values() if isinstance(net, Mapping) else (net,):
        if (
            not isinstance(layers, (list, tuple))
            or len(layers) > _DEEPEST
            or not all(type(width) is int and 1 <= width <= _WIDEST for width in layers)
        ):
            raise InputError(
                f"setting 'net_arch' of {algorithm} is {shown(net)}; it must be a list of at most {_DEEPEST} "
                f"whole numbers from 1 to {_WIDEST}, the widths of its layers."
            )
    known = _SETTINGS["policy_kwargs"]
    for name in known.keys() & given.keys():
        _check_range(algorithm, name, given[name], known[name])


def _check_range(algorithm: str, name: str, value: Any, allowed: _Range) -> None:
    kind, least, most = allowed
    right = (
        isinstance(value, bool)
        if kind == "bool"
        else isinstance(value, int if kind == "int" else (int, float)) and not isinstance(value, bool)
    )
    if not right or not least <= value <= most or (name == "learning_rate" and value == 0.0):
        what = {
            "bool": "true or false",
            "int": f"a whole number from {least:g} to {most:g}",
            "float": f"a number from {least:g} to {most:g}",
        }
        above = ", above 0" if name == "learning_rate" else ""
        raise InputError(
            f"setting {name!r} of {algorithm} is {shown(value)}; it must be {what[kind]}{above}."
        )


def _is_word(name: str, value: object) -> bool:
    """Whether a setting is the word that it may be, for ent_coef also with a start, as in auto_0.1."""
    word = _WORDS.get(name)
    if word is None or not isinstance(value, str):
        return False
    head, _, start = value.partition("_")
    return value == word or (
        name == "ent_coef"
        and head == word
        and re.fullmatch(r"\d*\.?\d+", start) is not None
        and float(start) > 0.0
    )


def _divisor(total: int, most: int) -> int:
    """The largest divisor of `total` up to `most`: minibatches of one size."""
    return max(
        (d for k in range(1, int(total**0.5) + 1) if total % k == 0 for d in (k, total // k) if d <= most),
        default=total,
    )
