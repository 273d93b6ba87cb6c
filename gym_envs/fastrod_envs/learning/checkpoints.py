"""A training between two steps as plain arrays: weights, optimizers, counters, replay buffer; no pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from fastrod.errors import InputError
from fastrod_envs.learning.arrays import LARGEST, read_arrays, write_arrays

_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")
_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def save_checkpoint(model: Any, path: Path) -> None:
    """Write weights, the optimizers' memory and counters of a model of stable-baselines3 to a .npz."""
    held: dict[str, Any] = {}
    for name, state in model.get_parameters().items():
        held |= {f"{name}/{key}": value for key, value in _flat(state).items()}
    held |= {f"variable/{name}": getattr(model, name) for name in _variables(model)}
    arrays = {name: np.asarray(value.detach().cpu().numpy()) for name, value in held.items()}
    write_arrays(path, arrays | {f"counter/{name}": np.int64(getattr(model, name)) for name in _COUNTERS})


def load_checkpoint(model: Any, path: Path) -> None:
    """Put what `save_checkpoint` wrote into a fresh model of its plan. Raises `InputError` for another or
    damaged file."""
    import torch

    held = read_arrays(path, "a checkpoint of `fastrod train`", LARGEST + 4 * _size(model))
    states: dict[str, Any] = {}
    try:
        for name, state in model.get_parameters().items():
            tensors = {
                key.removeprefix(f"{name}/"): _tensor(held, key) for key in held if key.startswith(f"{name}/")
            }
            if "param_groups" in state:
                memory: dict[int, dict[str, Any]] = {}
                for key, tensor in tensors.items():
                    number, _, field = key.partition("/")
                    memory.setdefault(int(number), {})[field] = tensor
                _check_memory(model, name, memory)
                tensors = {"state": memory, "param_groups": state["param_groups"]}
            states[name] = tensors
        model.set_parameters(states, exact_match=True, device="cpu")
        with torch.no_grad():
            for name in _variables(model):
                getattr(model, name).copy_(_tensor(held, f"variable/{name}"))
        for name in _COUNTERS:
            count = held[f"counter/{name}"]
            if count.shape != () or count.dtype != np.int64 or count < 0:
                raise ValueError(f"{name} is {count!r}")
            setattr(model, name, int(count))
    except (KeyError, ValueError, RuntimeError, TypeError) as error:
        why = f"{error} is missing" if isinstance(error, KeyError) else str(error)
        raise InputError(
            f"{str(path)!r} is no checkpoint of the plan beside it: {why.rstrip('.')}."
        ) from error


def save_replay(model: Any, path: Path) -> None:
    """Write what the replay buffer holds to a .npz."""
    buffer = model.replay_buffer
    n = buffer.buffer_size if buffer.full else buffer.pos
    write_arrays(
        path,
        {name: getattr(buffer, name)[:n] for name in _REPLAY}
        | {"pos": np.int64(buffer.pos), "full": np.bool_(buffer.full)},
    )


def load_replay(model: Any, path: Path) -> None:
    """Put what `save_replay` wrote into the buffer of a fresh model. Raises `InputError` for another or
    damaged file."""
    buffer = model.replay_buffer
    into = {name: getattr(buffer, name) for name in _REPLAY}
    held = read_arrays(
        path, "a replay buffer of `fastrod train`", LARGEST + sum(a.nbytes for a in into.values())
    )
    misfit = InputError(
        f"{str(path)!r} is no replay buffer of the plan beside it; without that file the training goes on "
        "with an empty one."
    )
    if set(held) != {*_REPLAY, "pos", "full"} or any(held[name].shape != () for name in ("pos", "full")):
        raise misfit
    pos, full = int(held["pos"]), bool(held["full"])
    n = buffer.buffer_size if full else pos
    if not (0 <= pos < buffer.buffer_size or (full and pos == 0)):
        raise misfit
    for name, values in into.items():
        if (
            held[name].shape != (n, *values.shape[1:])
            or held[name].dtype != values.dtype
            or not np.isfinite(held[name]).all()
        ):
            raise misfit
        values[:n] = held[name]
    buffer.pos, buffer.full = pos, full


def _flat(state: dict[str, Any]) -> dict[str, Any]:
    """Tensors of a module's or an optimizer's state by name."""
    if "param_groups" not in state:
        return state
    return {
        f"{number}/{field}": value
        for number, memory in state["state"].items()
        for field, value in memory.items()
    }


def _variables(model: Any) -> list[str]:
    """Names of tensors of a model beside its modules: the entropy coefficient of SAC."""
    names: list[str] = model._get_torch_save_params()[1]  # what `model.save` goes by
    return [name for name in names if getattr(model, name) is not None]


def _size(model: Any) -> int:
    """Bytes of its weights, which an optimizer holds twice more."""
    return sum(p.numel() * p.element_size() for p in model.policy.parameters())


def _tensor(held: dict[str, np.ndarray], name: str) -> Any:
    import torch

    values = held[name]
    if not np.issubdtype(values.dtype, np.floating) or not np.isfinite(values).all():
        raise ValueError(f"{name} holds a number that is not finite, or none at all")
    return torch.as_tensor(values)


def _check_memory(model: Any, name: str, memory: dict[int, dict[str, Any]]) -> None:
    """Raise `ValueError` for moments that do not fit their parameters; torch notices in its first step
    only."""
    whole: Any = model
    for attribute in name.split("."):
        whole = getattr(whole, attribute)
    parameters = [p for group in whole.param_groups for p in group["params"]]
    for number, fields in memory.items():
        shape = parameters[number].shape if 0 <= number < len(parameters) else None
        wanted = {"step": (), "exp_avg": shape, "exp_avg_sq": shape}  # Adam's
        if {field: tensor.shape for field, tensor in fields.items()} != wanted:
            raise ValueError(f"the memory of parameter {number} of {name} has not the shapes that Adam keeps")
