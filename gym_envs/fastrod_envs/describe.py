"""Description of a task for people: its documentation, and every number of its observations and actions
with its unit."""

from __future__ import annotations

import dataclasses
import inspect
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from fastrod_envs.registration import make_task, name_of, names, task_class
from fastrod_envs.task import Field

_TIMED, _DRAWN = 0.3, 10  # s; actions


def summary() -> str:
    """A line for each task; tasks on a rigid host step one after the other, however many there are."""
    lines = []
    for name in names():
        kind = task_class(name)
        first = (inspect.getdoc(kind) or "").partition("\n\n")[0].replace("\n", " ")
        lines.append(f"fastrod/{name}-v0  {first}{' (on PyBullet)' if kind.hosted else ''}")
    return "\n".join(lines)


def describe(name: str, options: Mapping[str, Any] | None = None, *, timed: bool = True) -> str:
    """Documentation of a task: what it is, its options, observation and action number by number, and with
    `timed` how fast it is here. Raises `UnknownNameError`, `InputError`."""
    kind = task_class(name)
    task = make_task(name, 1, options or {})
    try:
        seen = task.goals if task.options.observation == "goal" else task.states
        entries = [
            f"fastrod/{name_of(name)}-v0",
            inspect.getdoc(kind) or "",
            f"An episode has {task.options.n_steps or task.n_steps} steps of {task.dt:g} s.",
            "Observation\n" + _fields(seen),
            "Action, each number from -1 to 1, which mean\n" + _fields(task.actions),
            "Options\n" + _options(kind.options_class),
            *([_speed(name, kind.hosted, options or {})] if timed else []),
        ]
    finally:
        task.close()
    return "\n\n".join(entries)


def _speed(name: str, hosted: bool, options: Mapping[str, Any]) -> str:
    """Return how fast the task steps on this machine, alone and side by side."""
    from fastrod_envs.vector import BatchEnv

    said = []
    for n in (1, 16 if hosted else 256):
        batch = BatchEnv(name, n, **options)
        batch.reset(seed=0)
        rng = np.random.default_rng(0)
        drawn = [rng.uniform(-1.0, 1.0, (n, batch.task.n_actions)) for _ in range(_DRAWN)]
        batch.step(drawn[0])  # what is compiled by then is not counted
        begun, steps = time.perf_counter(), 0
        while time.perf_counter() - begun < _TIMED:
            batch.step(drawn[steps // n % _DRAWN])
            steps += n
        said.append(f"{steps / (time.perf_counter() - begun):,.0f} with {n}")
        batch.close()
    why = "on PyBullet, one robot after the other" if hosted else "all robots in one batch"
    return f"Speed\n  steps a second here, {why}: {', '.join(said)}"


def _fields(entries: tuple[Field, ...]) -> str:
    lines, at = [], 0
    for entry in entries:
        n = len(entry.low)
        where = f"{at}" if n == 1 else f"{at}..{at + n - 1}"
        low, high = ("same" if len(set(side)) == 1 else "mixed" for side in (entry.low, entry.high))
        span = (
            f"{entry.low[0]:g} to {entry.high[0]:g}"
            if low == high == "same"
            else "; ".join(f"{a:g} to {b:g}" for a, b in zip(entry.low, entry.high, strict=True))
        )
        lines.append(f"  {where:>7}  {entry.name:<12} {entry.unit or '-':<5} {entry.about} ({span})")
        at += n
    return "\n".join(lines)


def _options(kind: type[Any]) -> str:
    docs = {name: text for base in reversed(kind.__mro__) for name, text in attribute_docs(base).items()}
    return "\n".join(
        f"  {option.name} = {option.default!r}: {docs.get(option.name, '')}"
        for option in dataclasses.fields(kind)
    )


def attribute_docs(kind: type[Any]) -> dict[str, str]:
    """The sentences below the attributes of a class, by name."""
    import ast

    if kind is object:
        return {}
    body = ast.parse(inspect.getsource(kind)).body[0]
    assert isinstance(body, ast.ClassDef)
    found: dict[str, str] = {}
    for one, following in zip(body.body, body.body[1:], strict=False):
        text = (
            following.value.value
            if isinstance(following, ast.Expr) and isinstance(following.value, ast.Constant)
            else None
        )
        if isinstance(one, ast.AnnAssign) and isinstance(one.target, ast.Name) and isinstance(text, str):
            found[one.target.id] = " ".join(text.split())
    return found
