"""Training on stable-baselines3: a folder with policy, configuration, checkpoints and curves; it goes on
after a kill."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, TypedDict

import msgspec

from fastrod.checks import COUNT, Bound, check, check_number
from fastrod.errors import InputError, UnknownNameError, nearest, shown
from fastrod.reading import reading
from fastrod_envs.learning.actor import actor_of
from fastrod_envs.learning.checkpoints import load_checkpoint, load_replay, save_checkpoint, save_replay
from fastrod_envs.learning.presets import ALGORITHMS, NETWORK, check_settings, preset_of, settings_of
from fastrod_envs.registration import NAMESPACE, VERSION, name_of

Progress = Callable[[str, int, int], None]
CONFIG = "config.json"
POLICY = "policy.zip"
ACTOR = "actor.npz"
CHECKPOINT = "checkpoint.npz"
REPLAY = "replay.npz"
FOREIGN = ("checkpoint.zip", POLICY)
"""Files of stable-baselines3: to read one runs code of whoever made it."""
_EVERY = 20  # checkpoints of a training
_LARGEST = 1_000_000  # bytes of a config.json; those that ship have a thousand


@dataclass(frozen=True, kw_only=True)
class TrainingPlan:
    """Plan of a training; `config.json` holds it."""

    env: str
    """Id of the environment."""
    algorithm: str
    n_envs: Annotated[int, Bound(least=1, most=10**6)]
    steps: Annotated[int, Bound(least=0, most=10**15)]
    """Environment steps in all."""
    seed: Annotated[int, Bound(least=0, most=2**32 - 1)]
    imitate: Annotated[int, Bound(least=0, most=10**15)]
    """Steps of lessons by the scripted baseline before."""
    options: dict[str, Any]
    """Options of the environment."""
    settings: dict[str, Any]
    """Keyword arguments of the algorithm, as stable-baselines3 names them."""
    curriculum: Annotated[float, Bound(least=0.0, most=1.0)]
    """Difficulty at the start; it rises evenly to 1 over the first half."""

    def __post_init__(self) -> None:
        name_of(self.env)
        if self.algorithm not in ALGORITHMS:
            raise UnknownNameError(f"no algorithm {self.algorithm!r}; {nearest(self.algorithm, ALGORITHMS)}")
        check(self, "")
        check_settings(self.algorithm, self.settings)


class _State(TypedDict):
    """Progress of a training."""

    steps_done: int
    seconds: float


def make_plan(
    env: str,
    *,
    algorithm: str | None = None,
    steps: int | None = None,
    n_envs: int | None = None,
    seed: int = 0,
    imitate: int | None = None,
    options: Mapping[str, Any] | None = None,
    settings: Mapping[str, Any] | None = None,
    curriculum: float = 1.0,
) -> TrainingPlan:
    """The preset of a task, with what is given here instead. Raises `UnknownNameError`, `InputError`."""
    from fastrod_envs.registration import task_class

    preset = preset_of(env)
    # before rollouts are divided among them
    check_number("n_envs", 1 if n_envs is None else n_envs, COUNT, whole=True)
    kind = task_class(env)
    chosen = algorithm or preset.algorithm
    own = dict(preset.settings) if chosen == preset.algorithm else {}
    many, in_all = n_envs or preset.n_envs, preset.steps if steps is None else steps
    wanted = {**preset.options, **(options or {})}
    n_steps = kind.options_class.read(wanted).n_steps or kind.n_steps
    return TrainingPlan(
        env=f"{NAMESPACE}/{name_of(env)}-{VERSION}",
        algorithm=chosen,
        n_envs=many,
        steps=in_all,
        seed=seed,
        imitate=preset.imitate if imitate is None else imitate,
        options=wanted,
        settings=settings_of(chosen, many, n_steps, in_all, {**own, **(settings or {})}),
        curriculum=curriculum,
    )


def train(plan: TrainingPlan, out: Path, progress: Progress | None = None) -> Path:
    """Train into the folder `out`; the path of its policy.zip.

    The folder holds config.json (the plan, versions, steps and seconds done), checkpoint.npz (with replay.npz
    for SAC and TD3, until the end), actor.npz with the network alone, tensorboard curves, and at the end
    policy.zip, for stable-baselines3 itself. Raises `InputError` where the folder holds a training already.
    """
    if (out / CONFIG).exists():
        raise InputError(f"{str(out)!r} holds a training; go on with it by --resume, or name another folder.")
    out.mkdir(parents=True, exist_ok=True)
    _write_config(out, plan, {"steps_done": 0, "seconds": 0.0})
    return _run(plan, out, progress)


def resume(
    out: Path, steps: int | None = None, progress: Progress | None = None, *, trust: bool = False
) -> Path:
    """Go on with the training in `out` from its last checkpoint, to its own number of steps or to `steps`.

    SAC and TD3 have an empty replay buffer where it had ended. A folder that has a file of stable-baselines3
    in place of checkpoint.npz is refused without `trust`: to read that file runs code of whoever made it.
    Raises `InputError`.
    """
    plan, _ = read_config(out)
    if steps is not None:
        plan = replace(plan, steps=steps)
    return _run(plan, out, progress, trust)


def read_config(out: Path) -> tuple[TrainingPlan, dict[str, Any]]:
    """Plan and state of the training in a folder. Raises `InputError`, `UnknownNameError`."""
    path = out / CONFIG
    hint = "; `fastrod train ENV --out DIR` writes one."
    what = "is no configuration of a training"
    with reading(path, repr(str(path)), InputError, what, most=_LARGEST, hint=hint):
        held = json.loads(path.read_text(encoding="utf-8"))
        plan = msgspec.convert(held["plan"], TrainingPlan)
        if unknown := held["plan"].keys() - {field.name for field in fields(TrainingPlan)}:
            raise ValueError(
                f"it has an unknown key {min(unknown)!r}; "
                f"{nearest(min(unknown), [field.name for field in fields(TrainingPlan)])}"
            )
        state = {**msgspec.convert(held["state"], dict[str, Any]), **msgspec.convert(held["state"], _State)}
        if not 0.0 <= state["seconds"] < float("inf"):
            raise ValueError(f"it says that {state['seconds']} s are done")
    return plan, state


def algorithm_class(name: str) -> Any:
    """Return the algorithm's class of stable-baselines3. Raises `InputError`."""
    import stable_baselines3

    if name not in ALGORITHMS:
        raise InputError(f"no algorithm {name!r}; {nearest(name, ALGORITHMS)}")
    return getattr(stable_baselines3, name.upper())


def load_foreign(path: Path, algorithm: str, env: Any = None, *, trust: bool) -> Any:
    """A model from a file of stable-baselines3, which is a pickle: reading it runs code of whoever made it.

    Raises `InputError`, without `trust` before the file is opened.
    """
    if not trust:
        raise InputError(
            f"{str(path)!r} is a file of stable-baselines3, and to read it runs code of whoever made it; if "
            "you trust "
            "them, add --trust (in Python trust=True), or give a folder with a checkpoint.npz or actor.npz "
            "of `fastrod train`."
        )
    try:
        return algorithm_class(algorithm).load(path, env=env, device="cpu")
    except Exception as error:  # whatever a stranger's file raises
        raise InputError(
            f"{str(path)!r} cannot be read as a model of stable-baselines3: {error!r}."
        ) from error


def _run(plan: TrainingPlan, out: Path, progress: Progress | None, trust: bool = False) -> Path:
    import torch

    from fastrod_envs.learning.imitation import imitate
    from fastrod_envs.sb3 import BatchVecEnv
    from fastrod_envs.vector import BatchEnv

    _, state = read_config(out)
    env = BatchEnv(name_of(plan.env), num_envs=plan.n_envs, **plan.options)
    try:
        env.reset(seed=plan.seed)  # kernels start their threads now, and set those of torch
        torch.set_num_threads(
            len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        )
        vec = BatchVecEnv(env)
        started, before = time.monotonic(), float(state["seconds"])
        foreign = (
            None
            if (out / CHECKPOINT).exists()
            else next((out / name for name in FOREIGN if (out / name).exists()), None)
        )
        if foreign is not None:
            model = load_foreign(foreign, plan.algorithm, vec, trust=trust)
        else:
            model = _fresh(plan, vec, str(out / "tensorboard") if _has_tensorboard() else None)
            if (out / CHECKPOINT).exists():
                load_checkpoint(model, out / CHECKPOINT)
                if (out / REPLAY).exists():
                    load_replay(model, out / REPLAY)
        if foreign is not None or (out / CHECKPOINT).exists():
            vec.seed(plan.seed + 1_000_003 * (1 + model.num_timesteps))
        else:
            vec.seed(plan.seed)
            if plan.imitate:
                lessons = BatchEnv(name_of(plan.env), num_envs=plan.n_envs, **plan.options)
                try:
                    state["lessons_left_rms"] = imitate(model, lessons, plan.imitate, plan.seed, progress)
                finally:
                    lessons.close()
            _save(model, out)

        def note() -> None:
            _save(model, out)
            state["steps_done"] = int(model.num_timesteps)
            state["seconds"] = before + time.monotonic() - started
            _write_config(out, plan, state)

        left = plan.steps - model.num_timesteps
        if left > 0:
            model.learn(
                left,
                callback=_callback(plan, note, progress),
                reset_num_timesteps=False,
                tb_log_name=plan.algorithm,
            )
        note()
        _atomically(out / POLICY, model.save)
        (out / REPLAY).unlink(missing_ok=True)
        return out / POLICY
    finally:
        env.close()


def _fresh(plan: TrainingPlan, vec: Any, board: str | None) -> Any:
    """The model of a plan before its first step. Raises `InputError` for settings that its algorithm
    refuses."""
    import torch

    from fastrod_envs.sb3 import ScaledFeatures

    policy: dict[str, Any] = {"net_arch": list(NETWORK), "features_extractor_class": ScaledFeatures}
    if plan.algorithm == "ppo":
        policy |= {"activation_fn": torch.nn.Tanh, "log_std_init": -2.0 if plan.imitate else -1.0}
    settings = dict(plan.settings)
    kind, own = algorithm_class(plan.algorithm), settings.pop("policy_kwargs", {})
    try:
        return kind(
            "MlpPolicy",
            vec,
            seed=plan.seed,
            device="cpu",
            verbose=0,
            tensorboard_log=board,
            policy_kwargs={**policy, **own},
            **settings,
        )
    # of stable-baselines3 and torch
    except (TypeError, ValueError, AssertionError, MemoryError, RuntimeError) as error:
        raise InputError(
            f"{plan.algorithm} cannot be set up with the settings {shown(settings)}: "
            f"{str(error).rstrip('.')}."
        ) from error


def _callback(plan: TrainingPlan, note: Callable[[], None], progress: Progress | None) -> Any:
    """Checkpoints, curves of distance and success, the curriculum, and the bar."""
    from collections import deque

    from stable_baselines3.common.callbacks import BaseCallback

    class TrainingWatch(BaseCallback):
        def __init__(self) -> None:
            super().__init__()
            self.reported: dict[str, deque[float]] = {
                name: deque(maxlen=1000) for name in ("distance", "is_success", "contact", "lost")
            }
            self.next_note = -1

        def _on_step(self) -> bool:
            for i in self.locals["dones"].nonzero()[0]:
                for name, values in self.reported.items():
                    values.append(float(self.locals["infos"][i][name]))
            every = max(1, plan.steps // _EVERY)
            if self.next_note < 0:
                self.next_note = self.num_timesteps + every
            if self.num_timesteps >= self.next_note and plan.algorithm != "ppo":
                note()
                self.next_note += every
            if plan.curriculum < 1.0:
                done_fraction = min(1.0, 2.0 * self.num_timesteps / plan.steps)
                self.training_env.env_method(
                    "set_difficulty", plan.curriculum + (1.0 - plan.curriculum) * done_fraction
                )
            if progress is not None:
                progress(f"{plan.env} {plan.algorithm}", min(self.num_timesteps, plan.steps), plan.steps)
            return True

        def _on_rollout_end(self) -> None:
            for name, values in self.reported.items():
                if values:
                    self.logger.record(f"episodes/{name}", sum(values) / len(values))

        def _on_rollout_start(self) -> None:  # PPO is between two updates here: a checkpoint is whole
            if plan.algorithm == "ppo" and 0 <= self.next_note <= self.num_timesteps:
                note()
                self.next_note += max(1, plan.steps // _EVERY)

    return TrainingWatch()


def _save(model: Any, out: Path) -> None:
    """The checkpoint, whole or not at all, and the network alone."""
    if (
        hasattr(model, "save_replay_buffer")
        and model.replay_buffer is not None
        and model.replay_buffer.size()
    ):
        _atomically(out / REPLAY, partial(save_replay, model))
    _atomically(out / CHECKPOINT, partial(save_checkpoint, model))
    _atomically(out / ACTOR, actor_of(model).save)


def _atomically(path: Path, write: Callable[[Path], Any]) -> None:
    beside = path.with_name(f".{path.stem}.part{path.suffix}")
    write(beside)
    beside.replace(path)


def _write_config(out: Path, plan: TrainingPlan, state: Mapping[str, Any]) -> None:
    packages = {
        name: version(name)
        for name in ("fastrod", "gymnasium", "numba", "numpy", "stable-baselines3", "torch")
    }
    held = {"plan": asdict(plan), "state": dict(state), "versions": packages}
    try:
        text = json.dumps(held, indent=1) + "\n"
    except TypeError as error:
        raise InputError(
            f"the options {plan.options!r} cannot be saved beside the policy; give numbers, "
            "words and file paths."
        ) from error
    _atomically(out / CONFIG, lambda path: path.write_text(text, encoding="utf-8"))


def _has_tensorboard() -> bool:
    from importlib.util import find_spec

    return find_spec("tensorboard") is not None
