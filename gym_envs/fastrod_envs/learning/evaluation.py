"""A policy's episodes beside those of the scripted baseline, of random and goal-blind actions, and of none:
table, figures, plot."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fastrod.checks import COUNT, check_number
from fastrod.types import Flags, Floats
from fastrod_envs.learning.policies import Policy
from fastrod_envs.registration import name_of, task_class
from fastrod_envs.vector import BatchEnv

if TYPE_CHECKING:
    from rich.table import Table

Progress = Callable[[str, int, int], None]
Agent = Callable[[BatchEnv, Any, Any], Any]
"""(environments, observation, (n,) step of each episode) -> actions."""
_MOST = 128  # environments side by side
_MOST_HOSTED = 4
_VARIES = 1e-3  # m: an axis along which goals differ by less has no correlation


class Trial(NamedTuple):
    """The ends of an agent's episodes, in the order of their seeds; robot axis first."""

    distance: Floats
    """(n,) [m]"""
    success: Flags
    """(n,) the criterion held at the end."""
    contact: Flags
    """(n,) at the end something was touched that should not be."""
    lost: Flags
    """(n,) the simulation did not find the shape."""
    position: Floats
    """(n, 3) [m]"""
    desired: Floats
    """(n, 3) [m]"""
    returned: Floats
    """(n,) sum of rewards."""
    steps: Floats
    """(n,)"""
    facts: dict[str, Floats]
    """Further facts of the task, (n, ...)."""


@dataclass(frozen=True)
class Evaluation:
    """Trials of all agents of one environment."""

    env: str
    seed: int
    options: Mapping[str, Any]
    accuracy: float
    """Distance of a success [m]."""
    trials: Mapping[str, Trial]
    """By agent: policy, baseline, goal-blind, random, still."""


def evaluate(
    env: str,
    policy: Policy | None,
    *,
    episodes: int = 100,
    seed: int = 0,
    options: Mapping[str, Any] | None = None,
    baselines: bool = True,
    progress: Progress | None = None,
) -> Evaluation:
    """Episodes of seeds `seed`, `seed` + 1, ..., one each, for every agent.

    `policy` None evaluates the baselines alone; otherwise options that it was trained on hold where they
    change what it sees or does. Goal-blind repeats, step by step, the mean of what the policy (or the
    baseline) did in these very episodes: what is left when it does not look. Still does not move at all.
    Raises `InputError`, `UnknownNameError`.
    """
    check_number("episodes", episodes, COUNT, whole=True)
    kind, wanted = task_class(env), {**({} if policy is None else policy.options), **(options or {})}
    n = min(episodes, _MOST_HOSTED if kind.hosted else _MOST)
    batch = BatchEnv(name_of(env), num_envs=n, **wanted)
    try:
        if policy is not None:
            policy.check(batch)
        agents: dict[str, Agent] = (
            {} if policy is None else {"policy": lambda _, observation, __: policy.act(observation)}
        )
        if baselines or policy is None:
            agents["baseline"] = lambda e, _, __: e.baseline()
        trials: dict[str, Trial] = {}
        means: Floats = np.zeros((0, 0))
        for name, agent in agents.items():
            trials[name], done = _run(batch, agent, episodes, seed, name, progress)
            means = done if not len(means) else means
        if baselines:
            rng = np.random.default_rng(seed)
            blind: dict[str, Agent] = {
                "goal-blind": lambda _, __, step: means[np.minimum(step, len(means) - 1)],
                "random": lambda e, _, __: rng.uniform(-1.0, 1.0, (e.num_envs, e.task.n_actions)),
                "still": lambda e, _, __: np.zeros((e.num_envs, e.task.n_actions)),
            }
            for name, agent in blind.items():
                trials[name], _ = _run(batch, agent, episodes, seed, name, progress)
        return Evaluation(f"fastrod/{name_of(env)}-v0", seed, wanted, batch.task.accuracy, trials)
    finally:
        batch.close()


def _run(
    env: BatchEnv, agent: Agent, episodes: int, seed: int, name: str, progress: Progress | None
) -> tuple[Trial, Floats]:
    """The trial, and the mean action (n_steps, n_actions) of each step over the episodes."""
    ends: list[dict[str, Any]] = []
    total, count = np.zeros((env.n_steps, env.task.n_actions)), np.zeros((env.n_steps, 1))
    for start in range(0, episodes, env.num_envs):
        observation, _ = env.reset(seed=seed + start)
        wanted = np.arange(env.num_envs) + start < episodes
        found: list[dict[str, Any] | None] = [None] * env.num_envs
        open_ = wanted.copy()
        while open_.any():
            step = env.elapsed
            actions = np.asarray(agent(env, observation, step), dtype=float)
            np.add.at(total, step[open_], np.clip(actions[open_], -1.0, 1.0))
            np.add.at(count, step[open_], 1.0)
            observation, _, terminated, truncated, info = env.step(actions)
            for i in np.flatnonzero((terminated | truncated) & open_):
                final = info["final_info"]
                found[i] = {
                    key: value[i]
                    for key, value in final.items()
                    if isinstance(value, np.ndarray) and not key.startswith("_")
                }
                episode = final["episode"]
                found[i] |= {"r": episode["r"][i], "l": episode["l"][i]}  # type: ignore[operator]
                open_[i] = False
            if progress is not None:
                progress(name, min(episodes, start + int((wanted & ~open_).sum())), episodes)
        ends += [row for row in found if row is not None]
    columns = {key: np.array([row[key] for row in ends]) for key in ends[0]}
    own = {
        key: columns.pop(key)
        for key in ("distance", "success", "contact", "lost", "position", "desired", "r", "l")
    }
    trial = Trial(
        own["distance"],
        own["success"],
        own["contact"],
        own["lost"],
        own["position"],
        own["desired"],
        own["r"],
        own["l"].astype(float),
        columns,
    )
    return trial, total / np.maximum(count, 1.0)


def correlation(trial: Trial) -> Floats:
    """(3,) of final and desired position along x, y, z; nan along an axis on which goals do not differ."""
    found = np.full(3, np.nan)
    for k in range(3):
        a, b = trial.position[:, k], trial.desired[:, k]
        if np.isfinite(a).all() and len(a) > 2 and np.std(b) > _VARIES and np.std(a) > 0.0:
            found[k] = np.corrcoef(a, b)[0, 1]
    return found


def figures(evaluation: Evaluation) -> dict[str, dict[str, Any]]:
    """The table's numbers by agent."""
    info: dict[str, dict[str, Any]] = {}
    for name, trial in evaluation.trials.items():
        info[name] = {
            "episodes": len(trial.distance),
            "success": float(trial.success.mean()),
            "distance_mean_m": float(trial.distance.mean()),
            "distance_std_m": float(trial.distance.std()),
            "distance_median_m": float(np.median(trial.distance)),
            "distance_largest_m": float(trial.distance.max()),
            "contact": float(trial.contact.mean()),
            "lost": float(trial.lost.mean()),
            "return_mean": float(trial.returned.mean()),
            "steps_mean": float(trial.steps.mean()),
            "correlation": [None if np.isnan(c) else float(c) for c in correlation(trial)],
            "facts_mean": {
                key: np.asarray(value, float).mean(0).tolist() for key, value in trial.facts.items()
            },
        }
    return info


def table(evaluation: Evaluation) -> Table:
    """For a terminal."""
    from rich import box
    from rich.table import Table

    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    grid.title = (
        f"{evaluation.env}: seeds {evaluation.seed} on; success is a distance below "
        f"{1e3 * evaluation.accuracy:g} mm"
    )
    grid.title_justify = "left"
    for head in (
        "agent",
        "episodes",
        "success",
        "distance mm",
        "median",
        "largest",
        "contact",
        "lost",
        "goal to end: r",
        "return",
    ):
        grid.add_column(head, justify="left" if head == "agent" else "right")
    for name, row in figures(evaluation).items():
        r = [f"{c:.3f}" for c in row["correlation"] if c is not None]
        grid.add_row(
            name,
            str(row["episodes"]),
            f"{100 * row['success']:.0f} %",
            f"{1e3 * row['distance_mean_m']:.2f} ± {1e3 * row['distance_std_m']:.2f}",
            f"{1e3 * row['distance_median_m']:.2f}",
            f"{1e3 * row['distance_largest_m']:.1f}",
            f"{100 * row['contact']:.0f} %",
            f"{100 * row['lost']:.0f} %",
            " ".join(r) or "-",
            f"{row['return_mean']:.2f}",
        )
    for key, value in figures(evaluation)[next(iter(evaluation.trials))]["facts_mean"].items():
        numbers = ", ".join(f"{v:.4g}" for v in np.ravel(value))
        grid.caption = (
            f"{grid.caption}; " if grid.caption else f"mean of the {next(iter(evaluation.trials))}: "
        ) + f"{key} {numbers}"
    return grid


def write(evaluation: Evaluation, out: Path) -> list[Path]:
    """evaluation.json and evaluation.png in the folder `out`; the files written."""
    out.mkdir(parents=True, exist_ok=True)
    info = {
        "env": evaluation.env,
        "seed": evaluation.seed,
        "options": {key: str(v) for key, v in evaluation.options.items()},
        "accuracy_m": evaluation.accuracy,
        "agents": figures(evaluation),
    }
    path = out / "evaluation.json"
    path.write_text(json.dumps(info, indent=1) + "\n", encoding="utf-8")
    return [path, _plot(evaluation, out / "evaluation.png")]


def _plot(evaluation: Evaluation, path: Path) -> Path:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    colors = {
        "policy": "#1b6ca8",
        "baseline": "#2e8b57",
        "goal-blind": "#b8860b",
        "random": "#888888",
        "still": "#bbbbbb",
    }
    for name, trial in evaluation.trials.items():
        x = np.sort(1e3 * trial.distance)
        left.step(
            np.maximum(x, 1e-3),
            np.arange(1, len(x) + 1) / len(x),
            where="post",
            color=colors[name],
            label=name,
            lw=1.8,
        )
    left.axvline(1e3 * evaluation.accuracy, color="#c0392b", ls=":", lw=1.2, label="success")
    left.set(
        xscale="log",
        xlabel="distance [mm]",
        ylabel="part of the episodes",
        ylim=(0.0, 1.02),
        title=evaluation.env,
    )
    left.legend(frameon=False, fontsize=8)
    first, trial = next(iter(evaluation.trials.items()))
    low = 1e3 * min(trial.desired.min(), trial.position.min())
    high = 1e3 * max(trial.desired.max(), trial.position.max())
    right.plot([low, high], [low, high], color="#bbbbbb", lw=1.0)
    for k, (axis, color) in enumerate(zip("xyz", ("#c0392b", "#2e8b57", "#1b6ca8"), strict=True)):
        r = correlation(trial)[k]
        if not np.isnan(r):
            right.plot(
                1e3 * trial.desired[:, k],
                1e3 * trial.position[:, k],
                ".",
                color=color,
                ms=4,
                label=f"{axis}, r = {r:.3f}",
            )
    right.set(xlabel="desired [mm]", ylabel="at the end [mm]", title=f"{first}: end over goal")
    if right.get_legend_handles_labels()[0]:
        right.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)
    return path
