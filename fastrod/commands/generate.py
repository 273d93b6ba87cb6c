"""`fastrod generate`: its words, the plan that they make, and what is printed in the end."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from fastrod.errors import InputError
from fastrod.generation.plan import Plan
from fastrod.generation.rollouts import Rollouts
from fastrod.generation.run import Summary, generate
from fastrod.generation.shapes import Shapes
from fastrod.generation.sweep import Sweep
from fastrod.generation.trajectories import Trajectories
from fastrod.loading import load_robot, with_line_density
from fastrod.model.robotfile import dumps

if TYPE_CHECKING:
    from rich.table import Table


def plan_of(arguments: argparse.Namespace, options: Mapping[str, object]) -> Plan:
    """The plan of a command line; `options` are those of an environment. Raises `InputError` and what a plan
    raises."""
    made = {"shapes": _shapes, "rollouts": _rollouts, "sweep": _sweep}[arguments.kind](arguments, options)
    return Plan(work=made, count=arguments.count, seed=arguments.seed, shard_rows=_shard_rows(arguments))


def run(
    arguments: argparse.Namespace,
    options: Mapping[str, object],
    progress: Callable[[str, int, int], None] | None,
) -> Summary:
    """Make what the arguments say."""
    plan = plan_of(arguments, options)
    return generate(plan, arguments.out, workers=arguments.workers, ray=arguments.ray, progress=progress)


def figures(summary: Summary) -> dict[str, object]:
    """The summary, for --json."""
    return {**asdict(summary), "rate": summary.rate}


def table(summary: Summary) -> Table:
    """For a terminal."""
    from rich import box
    from rich.table import Table

    unit = "rows" if summary.kind in ("shapes", "sweep") else "episodes"
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_header=False)
    grid.title, grid.title_justify = f"{summary.kind} in {summary.folder}", "left"
    grid.add_row(
        unit,
        f"{summary.count:,}, each once"
        + (f"; {summary.rows:,} rows" if summary.rows != summary.count else ""),
    )
    grid.add_row("without success", f"{summary.failed:,}, kept and marked")
    made = f"{summary.made:,} made now" if summary.made < summary.shards else "all made now"
    grid.add_row(
        "shards",
        f"{summary.shards:,}, {made if summary.made else 'all were there'}; {summary.bytes / 1e6:,.1f} MB",
    )
    grid.add_row(
        "seconds",
        f"{summary.seconds:.1f}"
        + (f"; {summary.rate:,.{0 if summary.rate >= 10.0 else 2}f} {unit}/s" if summary.made else ""),
    )
    return grid


def _shard_rows(arguments: argparse.Namespace) -> int:
    if arguments.shard_rows is not None and arguments.shard_rows < 1:
        raise InputError(f"--shard-rows is {arguments.shard_rows}; it must be at least 1.")
    return arguments.shard_rows or 0


def _robot(arguments: argparse.Namespace, *, density: float | None = None) -> str:
    """The robot as a text, so that the plan needs no other file."""
    return dumps(with_line_density(load_robot(arguments.robot), density))


def _given(arguments: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Options that were given; the others are the plan's own."""
    return {name: value for name in names if (value := getattr(arguments, name)) is not None}


def _shapes(arguments: argparse.Namespace, _: Mapping[str, object]) -> Shapes:
    if arguments.force is not None and arguments.force < 0.0:
        raise InputError(f"--force is {arguments.force!r} N; it must be zero or positive.")
    words = _given(arguments, "bend", "force", "tolerance", "points_per_segment", "points", "chain")
    return Shapes(robot=_robot(arguments, density=arguments.line_density), **words)


def _rollouts(arguments: argparse.Namespace, options: Mapping[str, object]) -> Rollouts | Trajectories:
    if (arguments.env is None) == (arguments.robot is None):
        raise InputError(
            "rollouts are of an environment or of a robot's own motion; give --env ENV or --robot R."
        )
    of_robot = _given(arguments, "steps", "dt", "bend", "speed", "force", "line_density", "dynamics")
    if arguments.env is None:
        if options or arguments.policy is not None:
            raise InputError(
                "--policy and --option are of an environment; with --robot the commands are random."
            )
        robot = _robot(arguments, density=of_robot.pop("line_density", None))
        return Trajectories(robot=robot, effects=tuple(arguments.effect), **of_robot)
    if of_robot or arguments.effect:
        wrong = f"--{next(iter(of_robot), 'effect').replace('_', '-')}"
        raise InputError(
            f"{wrong} is of a robot's own motion; with --env give --option NAME=VALUE, such as n_steps=100."
        )
    return Rollouts(env=arguments.env, options=tuple(options.items()), **_given(arguments, "policy"))


def _sweep(arguments: argparse.Namespace, _: Mapping[str, object]) -> Sweep:
    words = _given(arguments, "noise", "rate", "bend")
    if arguments.effect:
        words["effects"] = tuple(arguments.effect)
    return Sweep(robot=_robot(arguments), **words)
