"""Training on stable-baselines3: a folder with policy, configuration, checkpoints and curves; it goes on after a kill."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fastrod.errors import InputError, nearest
from fastrod_envs.presets import ALGORITHMS, NETWORK, preset_of, settings_of
from fastrod_envs.registration import NAMESPACE, VERSION, name_of

Progress = Callable[[str, int, int], None]
CONFIG, POLICY, ACTOR, CHECKPOINT, REPLAY = "config.json", "policy.zip", "actor.npz", "checkpoint.zip", "replay.pkl"
_EVERY = 20  # checkpoints of a training


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What is trained and how; `config.json` holds it."""

    env: str
    """Id of the environment."""
    algorithm: str
    n_envs: int
    steps: int
    """Environment steps in all."""
    seed: int
    imitate: int
    """Steps of lessons by the scripted baseline before."""
    options: dict[str, Any]
    """Of the environment."""
    settings: dict[str, Any]
    """Keyword arguments of the algorithm, as stable-baselines3 names them."""
    curriculum: float
    """Difficulty at the start; it rises evenly to 1 over the first half."""


def make_plan(
    env: str, *, algorithm: str | None = None, steps: int | None = None, n_envs: int | None = None, seed: int = 0,
    imitate: int | None = None, options: Mapping[str, Any] | None = None, settings: Mapping[str, Any] | None = None,
    curriculum: float = 1.0,
) -> Plan:  # fmt: skip
    """The preset of a task, with what is given here instead. Raises `UnknownNameError`, `InputError`."""
    from fastrod_envs.registration import task_class

    preset = preset_of(env)
    for what, value, least in (("steps", steps, 0), ("n_envs", n_envs, 1), ("seed", seed, 0), ("imitate", imitate, 0)):
        if value is not None and (not isinstance(value, int) or value < least):
            raise InputError(f"{what} is {value!r}; it must be a whole number, at least {least}.")
    if not 0.0 <= curriculum <= 1.0:
        raise InputError(f"curriculum is {curriculum!r}; it must be the difficulty at the start, from 0 to 1.")
    kind = task_class(env)
    chosen = algorithm or preset.algorithm
    own = dict(preset.settings) if chosen == preset.algorithm else {}
    many, in_all = n_envs or preset.n_envs, preset.steps if steps is None else steps
    wanted = {**preset.options, **(options or {})}
    n_steps = kind.options_class.read(wanted).n_steps or kind.n_steps
    return Plan(
        env=f"{NAMESPACE}/{name_of(env)}-{VERSION}", algorithm=chosen, n_envs=many,
        steps=in_all, seed=seed, imitate=preset.imitate if imitate is None else imitate, options=wanted,
        settings=settings_of(chosen, many, n_steps, in_all, {**own, **(settings or {})}), curriculum=curriculum,
    )  # fmt: skip


def train(plan: Plan, out: Path, progress: Progress | None = None) -> Path:
    """Train into the folder `out`; the path of its policy.zip.

    The folder holds config.json (the plan, versions, steps and seconds done), checkpoint.zip (with replay.pkl for SAC and TD3), tensorboard
    curves, and at the end policy.zip, and actor.npz with its network alone. Raises `InputError` where the folder holds a training already.
    """
    if (out / CONFIG).exists():
        raise InputError(f"{str(out)!r} holds a training; go on with it by --resume, or name another folder.")
    out.mkdir(parents=True, exist_ok=True)
    _write_config(out, plan, {"steps_done": 0, "seconds": 0.0})
    return _run(plan, out, progress)


def resume(out: Path, steps: int | None = None, progress: Progress | None = None) -> Path:
    """Go on with the training in `out` from its last checkpoint, or where it has ended from its policy (SAC and TD3 then begin with an
    empty replay buffer), to its own number of steps or to `steps`. Raises `InputError`."""
    plan, _ = read_config(out)
    if steps is not None:
        plan = replace(plan, steps=steps)
    return _run(plan, out, progress)


def read_config(out: Path) -> tuple[Plan, dict[str, Any]]:
    """Plan and state of the training in a folder. Raises `InputError`."""
    path = out / CONFIG
    try:
        held = json.loads(path.read_text(encoding="utf-8"))
        return Plan(**held["plan"]), held["state"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{str(path)!r} is no configuration of a training; `fastrod train ENV --out DIR` writes one.") from error


def algorithm_class(name: str) -> Any:
    """Of stable-baselines3. Raises `InputError`."""
    import stable_baselines3

    if name not in ALGORITHMS:
        raise InputError(f"no algorithm {name!r}; {nearest(name, ALGORITHMS)}")
    return getattr(stable_baselines3, name.upper())


def _run(plan: Plan, out: Path, progress: Progress | None) -> Path:
    import torch

    from fastrod_envs.actor import actor_of
    from fastrod_envs.imitation import imitate
    from fastrod_envs.sb3 import BatchVecEnv, ScaledFeatures
    from fastrod_envs.vector import BatchEnv

    _, state = read_config(out)
    env = BatchEnv(name_of(plan.env), num_envs=plan.n_envs, **plan.options)
    try:
        env.reset(seed=plan.seed)  # kernels start their threads now, and set those of torch
        torch.set_num_threads(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)
        vec, kind = BatchVecEnv(env), algorithm_class(plan.algorithm)
        started, before = time.monotonic(), float(state["seconds"])
        held = next((out / name for name in (CHECKPOINT, POLICY) if (out / name).exists()), None)
        if held is not None:
            model = kind.load(held, env=vec, device="cpu")
            if (out / REPLAY).exists():
                model.load_replay_buffer(out / REPLAY)
            vec.seed(plan.seed + 1_000_003 * (1 + model.num_timesteps))
        else:
            vec.seed(plan.seed)
            policy: dict[str, Any] = {"net_arch": list(NETWORK), "features_extractor_class": ScaledFeatures}
            if plan.algorithm == "ppo":
                policy |= {"activation_fn": torch.nn.Tanh, "log_std_init": -2.0 if plan.imitate else -1.0}
            settings = dict(plan.settings)
            policy |= settings.pop("policy_kwargs", {})
            board = str(out / "tensorboard") if _has_tensorboard() else None
            model = kind("MlpPolicy", vec, seed=plan.seed, device="cpu", verbose=0, tensorboard_log=board, policy_kwargs=policy, **settings)
            if plan.imitate:
                lessons = BatchEnv(name_of(plan.env), num_envs=plan.n_envs, **plan.options)
                try:
                    state["lessons_left_rms"] = imitate(model, lessons, plan.imitate, plan.seed, progress)
                finally:
                    lessons.close()
            _save(model, out)

        def note() -> None:
            _save(model, out)
            state["steps_done"], state["seconds"] = int(model.num_timesteps), before + time.monotonic() - started
            _write_config(out, plan, state)

        left = plan.steps - model.num_timesteps
        if left > 0:
            model.learn(left, callback=_callback(plan, note, progress), reset_num_timesteps=False, tb_log_name=plan.algorithm)
        note()
        _atomically(out / ACTOR, actor_of(model).save)
        _atomically(out / POLICY, model.save)
        (out / REPLAY).unlink(missing_ok=True)
        (out / CHECKPOINT).unlink(missing_ok=True)
        return out / POLICY
    finally:
        env.close()


def _callback(plan: Plan, note: Callable[[], None], progress: Progress | None) -> Any:
    """Checkpoints, curves of distance and success, the curriculum, and the bar."""
    from collections import deque

    from stable_baselines3.common.callbacks import BaseCallback

    class Watch(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.told: dict[str, deque[float]] = {name: deque(maxlen=1000) for name in ("distance", "is_success", "contact", "lost")}
            self.next_note = -1

        def _on_step(self) -> bool:
            for i in self.locals["dones"].nonzero()[0]:
                for name, values in self.told.items():
                    values.append(float(self.locals["infos"][i][name]))
            every = max(1, plan.steps // _EVERY)
            if self.next_note < 0:
                self.next_note = self.num_timesteps + every
            if self.num_timesteps >= self.next_note and plan.algorithm != "ppo":
                note()
                self.next_note += every
            if plan.curriculum < 1.0:
                part = min(1.0, 2.0 * self.num_timesteps / plan.steps)
                self.training_env.env_method("set_difficulty", plan.curriculum + (1.0 - plan.curriculum) * part)
            if progress is not None:
                progress(f"{plan.env} {plan.algorithm}", min(self.num_timesteps, plan.steps), plan.steps)
            return True

        def _on_rollout_end(self) -> None:
            for name, values in self.told.items():
                if values:
                    self.logger.record(f"episodes/{name}", sum(values) / len(values))

        def _on_rollout_start(self) -> None:  # PPO is between two updates here: a checkpoint is whole
            if plan.algorithm == "ppo" and 0 <= self.next_note <= self.num_timesteps:
                note()
                self.next_note += max(1, plan.steps // _EVERY)

    return Watch()


def _save(model: Any, out: Path) -> None:
    """The checkpoint, whole or not at all."""
    if hasattr(model, "save_replay_buffer") and model.replay_buffer is not None and model.replay_buffer.size():
        _atomically(out / REPLAY, model.save_replay_buffer)
    _atomically(out / CHECKPOINT, model.save)


def _atomically(path: Path, write: Callable[[Path], Any]) -> None:
    beside = path.with_name(f".{path.stem}.part{path.suffix}")
    write(beside)
    beside.replace(path)


def _write_config(out: Path, plan: Plan, state: Mapping[str, Any]) -> None:
    packages = {name: version(name) for name in ("fastrod", "gymnasium", "numba", "numpy", "stable-baselines3", "torch")}
    held = {"plan": asdict(plan), "state": dict(state), "versions": packages}
    try:
        text = json.dumps(held, indent=1) + "\n"
    except TypeError as error:
        raise InputError(f"the options {plan.options!r} cannot be saved beside the policy; give numbers, words and file paths.") from error
    _atomically(out / CONFIG, lambda path: path.write_text(text, encoding="utf-8"))


def _has_tensorboard() -> bool:
    from importlib.util import find_spec

    return find_spec("tensorboard") is not None
