"""`Actor`: a policy without its noise as plain arrays, so that asking it needs neither torch nor
stable-baselines3."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from fastrod.errors import InputError, shown
from fastrod.types import Floats
from fastrod_envs.learning.arrays import read_arrays, write_arrays

Activation = Literal["tanh", "relu"]
Singles = NDArray[np.float32]
# of a weight or bound, and of `reach`: products of three layers fit single precision
_MOST, _LEAST = 1e5, 1e-7


class Actor(NamedTuple):
    """Layers of a network from observations, scaled by the bounds of their space, to actions from -1 to 1."""

    weights: tuple[Singles, ...]
    """Each (n_out, n_in)."""
    biases: tuple[Singles, ...]
    """Each (n_out,)."""
    middle: Singles
    """(n_obs,) of the observations' bounds."""
    half_range: Singles
    """(n_obs,) from there to a bound."""
    activation: Activation
    """Activation function of the hidden layers."""
    squashed: bool
    """The last layer ends in a tanh (SAC, TD3); otherwise it is clipped."""

    def act(self, observation: np.ndarray) -> Floats:
        """(n, n_actions) of observations (n, n_obs)."""
        x = (np.asarray(observation, np.float32) - self.middle) / self.half_range
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = x @ weight.T + bias
            if k < len(self.weights) - 1:
                x = np.tanh(x) if self.activation == "tanh" else np.maximum(x, 0.0)
        return np.asarray(np.tanh(x) if self.squashed else np.clip(x, -1.0, 1.0), dtype=float)

    def save(self, path: Path) -> None:
        """Write a .npz file."""
        held: dict[str, Any] = {f"weight_{k}": w for k, w in enumerate(self.weights)}
        held |= {f"bias_{k}": b for k, b in enumerate(self.biases)}
        held |= {
            "middle": self.middle,
            "reach": self.half_range,
            "activation": self.activation,
            "squashed": self.squashed,
        }
        write_arrays(path, held, compress=True)


def load_actor(path: Path) -> Actor:
    """The actor in a .npz file. Raises `InputError` where it is damaged, or its layers do not fit
    together."""
    held = read_arrays(path, "no actor that `fastrod train` wrote")
    n = sum(name.startswith("weight_") for name in held)
    names = (
        "middle",
        "reach",
        "activation",
        "squashed",
        *(f"{kind}_{k}" for k in range(n) for kind in ("weight", "bias")),
    )
    if wrong := set(names) ^ held.keys():
        raise InputError(
            f"{str(path)!r} is no actor that `fastrod train` wrote: {sorted(wrong)[0]!r} is "
            "missing or too much."
        )
    weights, biases = [held[f"weight_{k}"] for k in range(n)], [held[f"bias_{k}"] for k in range(n)]
    activation = str(held["activation"])
    squashed = held["squashed"]
    middle = held["middle"]
    half_range = held["reach"]
    why = _misfit(weights, biases, middle, half_range)
    if activation not in get_args(Activation) or squashed.shape != () or squashed.dtype != np.bool_:
        why = f"its activation is {shown(activation, 40)} and squashed {shown(squashed.tolist(), 40)}"
    if why:
        raise InputError(f"{str(path)!r} is no actor that `fastrod train` wrote: {why}.")
    return Actor(
        tuple(weights),
        tuple(biases),
        middle,
        half_range,
        "tanh" if activation == "tanh" else "relu",
        bool(squashed),
    )


def _misfit(
    weights: list[np.ndarray], biases: list[np.ndarray], middle: np.ndarray, half_range: np.ndarray
) -> str:
    """Return what hinders the layers to be one network of finite numbers, or nothing."""
    arrays = (middle, half_range, *weights, *biases)
    if not weights or any(a.dtype != np.float32 for a in arrays):
        return "its layers are not numbers of single precision"
    if any(not np.isfinite(a).all() for a in arrays):
        return "it holds a number that is not finite"
    ends = [*(w.shape for w in weights), *(b.shape for b in biases), middle.shape, half_range.shape]
    widths = [middle.size, *(b.size for b in biases)]
    fitting = [
        *zip(widths[1:], widths[:-1], strict=True),
        *((size,) for size in widths[1:]),
        (widths[0],),
        (widths[0],),
    ]
    if ends != fitting or not all(widths):
        return f"its layers of shapes {shown([*ends])} do not fit together"
    if any(np.abs(a).max() > _MOST for a in arrays):
        return f"it holds a number beyond {_MOST:g}, which no training comes to"
    return (
        "" if (half_range >= _LEAST).all() else "its observations have bounds without a distance between them"
    )


def actor_of(model: Any) -> Actor:
    """The actor of a model of stable-baselines3 with `ScaledFeatures`."""
    import torch

    policy = model.policy
    if hasattr(policy, "mlp_extractor"):  # PPO
        modules = [*policy.mlp_extractor.policy_net, policy.action_net]
        features = policy.features_extractor
        squashed = False
    elif hasattr(policy.actor, "latent_pi"):  # SAC
        modules = [*policy.actor.latent_pi, policy.actor.mu]
        features = policy.actor.features_extractor
        squashed = True
    else:  # TD3
        modules, features, squashed = list(policy.actor.mu), policy.actor.features_extractor, True

    def plain(a: Any) -> Singles:
        return np.array(a.detach().cpu().numpy(), dtype=np.float32)

    linear = [module for module in modules if isinstance(module, torch.nn.Linear)]
    hidden = next(module for module in modules if not isinstance(module, torch.nn.Linear))
    return Actor(
        tuple(plain(module.weight) for module in linear),
        tuple(plain(module.bias) for module in linear),
        plain(features.middle),
        plain(features.reach),
        "tanh" if isinstance(hidden, torch.nn.Tanh) else "relu",
        squashed,
    )
