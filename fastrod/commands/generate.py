"""`fastrod generate`: its words, the plan that they make, and what is printed in the end."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fastrod.checks import COUNT, Bound, check_number
from fastrod.commands.parser import Actions, Pairs
from fastrod.commands.terminal import DONE, need, progress
from fastrod.errors import InputError

if TYPE_CHECKING:
    from rich.table import Table

    from fastrod.generation.run import Summary


@dataclass(frozen=True)
class DataSet:
    """Size of a data set, and where it is made.

    --count N: rows, or episodes, in all, such as 1e6; it may grow
    --out DIR: folder of plan.json and shards; a run that was cut off is resumed
    --seed S: of all that is drawn
    --workers N: processes, or pending tasks on Ray (default: one for each core)
    --ray ADDRESS: as tasks of this Ray cluster; `auto` for the one here, `local` to start one (needs
        fastrod[ray])
    --shard-rows N: rows, or episodes, of a file and task (default: some seconds of work)
    --json: print the summary to stdout and nothing else
    """

    count: int
    out: Path
    seed: int = 0
    workers: int | None = None
    ray: str | None = None
    shard_rows: int | None = None
    json: bool = False

    def __post_init__(self) -> None:
        need("generate", "parquet", "pyarrow")
        if self.ray is not None:
            need("generate --ray", "ray", "ray")
        check_number("--shard-rows", 1 if self.shard_rows is None else self.shard_rows, COUNT, whole=True)

    def make(self, work: Any) -> int:
        """Make it, and print the summary."""
        from rich.console import Console

        from fastrod.generation.plan import Plan
        from fastrod.generation.run import generate

        plan = Plan(work=work, count=self.count, seed=self.seed, shard_rows=self.shard_rows or 0)
        with progress() as bar:
            summary = generate(plan, self.out, workers=self.workers, ray=self.ray, progress=bar)
        if self.json:
            print(json.dumps({**asdict(summary), "rate": summary.rate}, indent=1))
        else:
            Console().print(_table(summary))
        return DONE


def shapes(
    data: DataSet,
    *,
    robot: str,
    bend: float | None = None,
    force: float | None = None,
    line_density: float | None = None,
    tolerance: float | None = None,
    points: int | None = None,
    points_per_segment: int | None = None,
    chain: int | None = None,
) -> int:
    """A robot at rest under random commands and tip forces.

    --robot R: a shipped robot's name or a path to a .toml
    --bend RAD: largest bend of a segment, drawn evenly from a disc (default: 1)
    --force N: radius of the ball of tip forces (default: 2 EI/l^2 of the robot)
    --line-density KG/M: mass per length, for the self-weight (default: the robot's)
    --tolerance M: largest boundary residual (default: 1e-6)
    --points K: backbone positions in a row, the last at the tip (default: none)
    --points-per-segment N: integration steps of a segment (default: 6)
    --chain N: neighbouring rows that are solved one from the other; 1: none (default: 64)
    """
    from fastrod.generation.shapes import Shapes

    check_number("--force", force or 0.0, Bound(least=0.0, unit="N"))
    words = _given(
        bend=bend,
        force=force,
        tolerance=tolerance,
        points_per_segment=points_per_segment,
        points=points,
        chain=chain,
    )
    return data.make(Shapes(robot=_robot_text(robot, line_density), **words))


def rollouts(
    data: DataSet,
    *,
    robot: str | None = None,
    env: str | None = None,
    policy: str | None = None,
    option: Pairs | None = None,
    effect: Sequence[str] = (),
    steps: int | None = None,
    dt: float | None = None,
    dynamics: bool = False,
    line_density: float | None = None,
    bend: float | None = None,
    speed: float | None = None,
    force: float | None = None,
) -> int:
    """Episodes of an environment, or a robot's own motion with effects drawn anew.

    --robot R: a shipped robot's name or a path to a .toml
    --env ENV: a task, such as Reach; not with --robot
    --policy P: the policy that acts: shipped, baseline or random (default: random)
    --option NAME=VALUE: of the environment, such as n_steps=1 or randomise=mine.toml
    --effect NAME: robot: drawn for each episode
    --steps N: robot: of an episode (default: 200)
    --dt S: robot: time step (default: 0.02)
    --dynamics: robot: with inertia, so that it rings; rows have the tip's velocity, too. It needs a mass: the
        robot file's line_density, or --line-density
    --line-density KG/M: robot: mass per length, for self-weight and inertia (default: the robot's)
    --bend RAD: robot: largest bend of a segment (default: 0.9)
    --speed RAD/S: robot: largest rate of a bend (default: 1)
    --force N: robot: radius of the ball of tip forces (default: 0)
    """
    of_robot = _given(steps=steps, dt=dt, bend=bend, speed=speed, force=force, line_density=line_density)
    of_robot |= {"dynamics": True} if dynamics else {}
    if env is not None and robot is None:
        need("generate rollouts --env", "envs", "gymnasium")
        from fastrod.generation.rollouts import Rollouts

        if of_robot or effect:
            wrong = f"--{next(iter(of_robot), 'effect').replace('_', '-')}"
            raise InputError(
                f"{wrong} is of a robot's own motion; with --env give --option NAME=VALUE, such as "
                "n_steps=100."
            )
        return data.make(Rollouts(env=env, options=tuple((option or {}).items()), **_given(policy=policy)))
    if env is not None or robot is None:
        raise InputError(
            "rollouts are of an environment or of a robot's own motion; give --env ENV or --robot R."
        )
    from fastrod.generation.trajectories import Trajectories

    if option or policy is not None:
        raise InputError("--policy and --option are of an environment; with --robot the commands are random.")
    text = _robot_text(robot, of_robot.pop("line_density", None))
    return data.make(Trajectories(robot=text, effects=tuple(effect), **of_robot))


def sweep(
    data: DataSet,
    *,
    robot: str,
    effect: Sequence[str] = (),
    noise: float | None = None,
    rate: float | None = None,
    bend: float | None = None,
) -> int:
    """Robots with a sealed effect, their logs simulated and identified.

    --robot R: a shipped robot's name or a path to a .toml
    --effect NAME: sealed one after the other (default: backlash)
    --noise M: of each coordinate of the measured tip (default: 0.0003)
    --rate HZ: samples a second (default: 15)
    --bend RAD: largest bend of a segment (default: 0.9)
    """
    from fastrod.generation.sweep import Sweep

    words = _given(noise=noise, rate=rate, bend=bend, effects=tuple(effect) or None)
    return data.make(Sweep(robot=_robot_text(robot), **words))


GENERATE = Actions(
    "Data sets in Parquet shards: shapes, rollouts, identification sweeps; here or on Ray.",
    {"shapes": shapes, "rollouts": rollouts, "sweep": sweep},
    epilog="A run that was killed is finished by the same command; a larger --count lets a data set grow.",
)


def _given(**options: Any) -> dict[str, Any]:
    """Options that were given; the others are the plan's own."""
    return {name: value for name, value in options.items() if value is not None}


def _robot_text(name: str, density: float | None = None) -> str:
    """The robot as a text, so that the plan needs no other file."""
    from fastrod.loading import load_robot, with_line_density
    from fastrod.model.robotfile import dumps

    return dumps(with_line_density(load_robot(name), density))


def _table(summary: Summary) -> Table:
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
