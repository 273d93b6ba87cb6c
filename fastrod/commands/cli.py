"""The `fastrod` command: words to functions, errors to exit codes; no logic of its own."""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from functools import cache, partial
from importlib import import_module
from json import dumps, loads
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from fastrod.commands import drive, generate, own
from fastrod.commands.parser import (
    Actions,
    Command,
    Pairs,
    Parser,
    UsageError,
    add_command,
    add_group,
    call,
    flags,
    unknown_option,
)
from fastrod.commands.terminal import (
    DONE,
    FAILED,
    FailedError,
    folder,
    lines,
    needing,
    print_written,
    progress,
    refuse,
)
from fastrod.errors import FastrodError, InputError, UnknownNameError, nearest

if TYPE_CHECKING:
    from fastrod.logs.runlog import RunLog
    from fastrod.model.robot import Robot

_SMALL = 0.3  # of the steps of a preset: fewer are worth a word


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`; the exit code: 0 done, 2 the input is wrong (one sentence on stderr), 1 it
    failed."""
    try:
        given, rest = parse(list(sys.argv[1:] if argv is None else argv))
        if rest and isinstance(getattr(given, "logs", None), list):  # more of them after an option
            given.logs += [Path(word) for word in rest if not word.startswith("-")]
            rest = [word for word in rest if word.startswith("-")]
        if rest:
            raise unknown_option(given.parser, rest[0])
        return call(given)
    except (UsageError, FastrodError) as error:
        return refuse(str(error))
    except FailedError as error:
        return refuse(str(error), FAILED)
    except OSError as error:
        return refuse(f"{error.filename or 'a file'}: {error.strerror or error}.", FAILED)
    except KeyboardInterrupt:
        return refuse("interrupted.", FAILED)


def parse(words: list[str]) -> tuple[argparse.Namespace, list[str]]:
    """Read the words of a command line; with it, those that nobody knows. Raises `UsageError`."""
    parser = build()
    if words and words[0].startswith("-") and words[0] not in ("-h", "--help", "--version"):
        raise unknown_option(parser, words[0])
    return parser.parse_known_args(_with_action(words))


def _with_action(words: list[str]) -> list[str]:
    """The words with the action of a command that has them, second. Raises `UsageError` for a name that is
    none."""
    if not words or words[0].startswith("-"):
        return words
    command, *rest = words
    if command not in COMMANDS:
        raise UsageError(f"no command {command!r}; {nearest(command, COMMANDS)}")
    group = COMMANDS[command]
    if not isinstance(group, Actions) or (rest and rest[0] in ("-h", "--help", *group.functions)):
        return words
    if rest and not rest[0].startswith("-"):
        raise UsageError(f"no action {rest[0]!r} of fastrod {command}; {nearest(rest[0], group.functions)}")
    alone = flags(group)
    for at, word in enumerate(rest):
        before = rest[at - 1] if at else ""
        if word in group.functions and (before in alone or "=" in before or not before.startswith("-")):
            return [command, word, *rest[:at], *rest[at + 1 :]]
    if not group.default:
        raise UsageError(f"fastrod {command} needs an action; {nearest('', group.functions)}")
    return [command, group.default, *rest]


def demo(*, out: Path | None = None, seed: int | None = None, no_view: bool = False) -> int:
    """The main job on an embedded default, start to end.

    --out DIR: where logs and report go (default: a folder of its own)
    --seed S: of what the emulator hides (default: nobody knows it)
    --no-view: end with the report; do not serve the viewer
    """
    from fastrod.commands.demo import run

    run(out, seed=seed, view=not no_view)
    return DONE


def replay(
    log: Path,
    *,
    robot: str | None = None,
    run: str | None = None,
    dynamics: bool = False,
    out: Path | None = None,
) -> int:
    """The model beside a measurement: residual table and plot.

    LOG: run log (.csv or .parquet), or the raw file of a measured set
    --robot R: a shipped robot's name or a path to a .toml; a measured set brings its own
    --run RUN: only this run of the log
    --dynamics: in motion, with inertia and damping (needs line_density or damping_time)
    --out DIR: where residuals.csv and replay.png go (default: LOG's name + _replay)
    """
    from rich.console import Console

    from fastrod.identification.log.replay import replay as compare
    from fastrod.identification.log.replay_output import table, write
    from fastrod.loading import load_robot

    read, its = _read(log, None if robot is None else load_robot(robot))
    if run is not None:
        read = read.only(run)
    out = out or Path(f"{log.stem}_replay")
    with folder(out), progress() as bar:
        result = compare(
            read, its, dynamics=dynamics, progress=None if bar is None else partial(bar, "replay")
        )
    Console().print(table(result))
    if not result.compared.any():
        raise FailedError(f"the model converged on none of the {len(read)} rows.")
    print_written(write(result, out))
    for question in result.questions:  # it has shown what was requested: that is no refusal
        refuse(question)
    return DONE


def _read(path: Path, given: Robot | None) -> tuple[RunLog, Robot]:
    from fastrod_scenes.measured import read

    return read(path, given)


def identify(
    *logs: Path,
    robot: str | None = None,
    held_out: Sequence[str] = (),
    max_effects: int = 4,
    free_camera: bool = False,
    only_session: bool = False,
    dynamics: bool = False,
    network: bool = False,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """Find what the model lacks: report.json, report.html, identified.toml.

    LOG: run logs of one robot, or raw files of a measured set
    --robot R: a shipped robot's name or a path to a .toml; a measured set brings its own
    --held-out RUN: runs that no fit sees, or RUN@START:END in seconds (default: every fourth stretch)
    --max-effects K: name this many at most, 0: fit the base model alone
    --free-camera: fit the camera's registration, marker offset and latency too
    --only-session: fit this session's zeros, registration and delay alone, of a robot identified before
    --dynamics: fit and search in motion, with inertia and damping (needs line_density or damping_time)
    --network: train a network on what is left, reported apart (needs fastrod[network])
    --out DIR: where the files go (default: LOG's name + _identified)
    --json: print report.json to stdout and nothing else; files only with --out
    """
    from rich.console import Console

    from fastrod.identification.attribution import identify as find
    from fastrod.identification.report import report
    from fastrod.loading import load_robot

    # `--held-out RUN LOG`: no run is named like a file that is there.
    swallowed = [word for word in held_out if Path(word).suffix and Path(word).is_file()]
    paths = [*logs, *(Path(word) for word in swallowed)]
    if not paths:
        raise UsageError(
            "the following arguments are required: LOG; `fastrod identify --help` says how it is used."
        )
    given = None if robot is None else load_robot(robot)
    read, robots = zip(*(_read(path, given) for path in paths), strict=True)
    if any(robot != robots[0] for robot in robots):
        raise InputError("these files bring different robots; name one with --robot, or identify each alone.")
    out = out or (None if json else Path(f"{paths[0].stem}_identified"))
    with folder(out), progress() as bar:
        result = find(
            read,
            robots[0],
            held_out=[word for word in held_out if word not in swallowed],
            max_effects=max_effects,
            free_camera=free_camera,
            network=network,
            dynamics=dynamics,
            only_session=only_session,
            progress=bar or lines(),
        )
    written = [] if out is None else report.write(result, out)
    if json:
        print(report.text(result))
        return DONE
    Console().print(report.table(result))
    print_written(written)
    return DONE


def excite(
    *,
    robot: str,
    out: Path | None = None,
    bend: float = 0.9,
    payload: float | None = None,
    rate: float = 15.0,
    speed: float = 1.0,
) -> int:
    """Write the run that separates effects, to be driven and measured.

    --robot R: a shipped robot's name or a path to a .toml
    --out FILE: the run log, .csv or .parquet (default: NAME_excitation.csv)
    --bend RAD: largest bend of a segment
    --payload KG: known mass at the tip, on and off (default: F l^2/EI = 1)
    --rate HZ: samples a second
    --speed RAD/S: of the triangles
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from fastrod.identification.excite import excitation
    from fastrod.loading import load_robot
    from fastrod.logs.runlog import write_log

    its = load_robot(robot)
    made = excitation(its, bend=bend, payload=payload, rate=rate, speed=speed)
    path = out or Path(f"{its.name}_excitation.csv")
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{str(path)!r} does not end in .csv or .parquet; a run log does.")
    write_log(made.log, path, comment=made.comment)
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("from s", "to s"):
        grid.add_column(name, justify="right")
    for name in ("section", "purpose"):
        grid.add_column(name)
    said: set[str] = set()
    for section in made.phases:
        purpose = "as above" if section.purpose in said else section.purpose
        grid.add_row(f"{section.start:.1f}", f"{section.end:.1f}", section.name, purpose)
        said.add(section.purpose)
    console = Console()
    console.print(grid)
    next_step = f"wrote {path}: drive it, fill tip_x tip_y tip_z, then fastrod identify"
    console.print(next_step, soft_wrap=True, highlight=False, markup=False)
    return DONE


def view(
    what: str | None = None,
    *,
    robot: str | None = None,
    robots: int = 1,
    play: bool = False,
    dynamics: bool = False,
    line_density: float | None = None,
    dt: float | None = None,
    port: int | None = None,
    host: str = "127.0.0.1",
    no_open: bool = False,
) -> int:
    """Viewer and teleop in the browser, or a log beside the model.

    WHAT: a scene, a robot (name or .toml), or a run log (default: a robot to try)
    --robot R: whose log it is: a shipped robot's name or a path to a .toml
    --robots N: so many of the robot, in a grid, driven alike
    --play: begin with the robot's demo motion; scenes always begin with their script
    --dynamics: a robot with inertia: pull its tip, let go, and it rings; in slow motion if you like
    --line-density KG/M: with --dynamics: mass per length of all segments (default: the robot's)
    --dt S: with --dynamics: time step (default: 0.001 s)
    --port P: default: the first free one from 8080 on
    --host H: address to listen on (default: 127.0.0.1, this machine alone); the printed address is the key
    --no-open: do not open a browser
    """
    from fastrod_viewer.server import serve

    # first: a browser loads the page while the simulator is imported
    server = serve(host, port)
    from fastrod_viewer.app import FIRST
    from fastrod_viewer.app import view as show

    show(
        FIRST if what is None else what,
        robot=robot,
        n_robots=robots,
        host=host,
        open_browser=not no_open,
        script=play or (what is None and not dynamics),
        server=server,
        dynamics=dynamics,
        line_density=line_density,
        dt=dt,
    )
    return DONE


@needing("envs", "envs", "gymnasium")
def envs(env: str | None = None, *, option: Pairs | None = None) -> int:
    """The environments; of one, its task, observation, action and options.

    ENV: a task, such as Reach or fastrod/Reach-v0 (default: a line for each)
    --option NAME=VALUE: of the environment, such as n_steps=1 or randomise=mine.toml
    """
    from fastrod_envs.describe import describe, summary

    print(summary() if env is None else describe(env, option or {}))
    return DONE


@needing("train", "rl", "stable_baselines3")
def train(
    env: str | None = None,
    *,
    algo: str | None = None,
    steps: int | None = None,
    envs: int | None = None,
    seed: int = 0,
    imitate: int | None = None,
    curriculum: float = 1.0,
    option: Pairs | None = None,
    set_: Pairs | None = None,
    out: Path | None = None,
    resume: bool = False,
    trust: bool = False,
) -> int:
    """Train a policy for an environment, on stable-baselines3.

    ENV: a task, such as Reach, or FILE.py:Class of your own; with --resume the folder knows
    --algo A: sac, ppo or td3 (default: the task's preset)
    --steps N: environment steps in all (default: the preset's)
    --envs N: environments side by side (default: the preset's)
    --seed S: of policy and environments
    --imitate N: steps of lessons by the scripted baseline before (default: the preset's)
    --curriculum D: difficulty at the start, rising to 1 (default: 1, none)
    --option NAME=VALUE: of the environment, such as n_steps=1 or randomise=mine.toml
    --set NAME=VALUE: a setting of the algorithm, such as batch_size=512
    --out DIR: policy, configuration, checkpoints, curves (default: NAME_ALGO_SEED)
    --resume: resume the training in --out, after a kill or to more --steps
    --trust: --resume: read a file of stable-baselines3 where the folder has none of our own; this runs code
        of the file's author
    """
    from fastrod_envs.learning.training import make_plan, read_config
    from fastrod_envs.learning.training import resume as resume_training
    from fastrod_envs.learning.training import train as train_policy
    from fastrod_envs.registration import name_of

    if env is not None:
        name_of(env)  # of a file of one's own, which is run now
    if resume:
        if out is None:
            raise InputError("--resume needs --out DIR, the folder of the training to resume.")
        plan = read_config(out)[0]
        with progress() as bar:
            path = resume_training(out, steps, bar, trust=trust)
    else:
        if env is None:
            raise UsageError(
                "the following arguments are required: ENV; `fastrod train --help` says how it is used."
            )
        plan = make_plan(
            env,
            algorithm=algo,
            steps=steps,
            n_envs=envs,
            seed=seed,
            imitate=imitate,
            options=option or {},
            settings=set_ or {},
            curriculum=curriculum,
        )
        usual = make_plan(env).steps
        if plan.steps < _SMALL * usual:
            few = f"{plan.steps:,} steps are {100.0 * plan.steps / usual:.2g} % of the {usual:,}"
            print(f"{few} that the preset takes: expect little success.", file=sys.stderr)
        out = out or Path(f"{plan.env.partition('/')[2]}_{plan.algorithm}_{plan.seed}")
        with progress() as bar:
            path = train_policy(plan, out, bar)
    print(f"wrote {path}; see it with: fastrod evaluate {env or plan.env} {out}")
    return DONE


@needing("evaluate", "envs", "gymnasium")
def evaluate(
    env: str,
    policy: str,
    *,
    trust: bool = False,
    episodes: int = 100,
    seed: int = 1000,
    no_baselines: bool = False,
    option: Pairs | None = None,
    out: Path | None = None,
    json: bool = False,
) -> int:
    """A policy beside the baselines: success, distance, contacts.

    ENV: a task, such as Reach, or FILE.py:Class of your own
    POLICY: a folder of `fastrod train`, `shipped`, or `none` for the baselines alone
    --trust: read a file of stable-baselines3 where the folder has none of our own; this runs code of the
        file's author
    --episodes N: one for each seed
    --seed S: of the first episode
    --no-baselines: the policy alone
    --option NAME=VALUE: of the environment, such as n_steps=1 or randomise=mine.toml
    --out DIR: write evaluation.json and evaluation.png there
    --json: print the figures to stdout and nothing else
    """
    from rich.console import Console

    from fastrod_envs.learning import evaluation
    from fastrod_envs.learning.policies import Policy, find
    from fastrod_envs.registration import name_of

    name_of(env)  # of a file of one's own, which is run now
    with progress() as bar:
        result = evaluation.evaluate(
            env,
            None if policy == "none" else Policy(find(env, policy), trust=trust),
            episodes=episodes,
            seed=seed,
            options=option or {},
            baselines=not no_baselines,
            progress=bar,
        )
    written = [] if out is None else evaluation.write(result, out)
    if json:
        print(dumps(evaluation.figures(result), indent=1))
        return DONE
    console = Console()
    console.width = max(console.width, 140)
    console.print(evaluation.table(result))
    print_written(written)
    return DONE


def bench(name: str | None = None, *, json: bool = False) -> int:
    """The figures of perf/ as ratios: how fast, how accurate, beside what.

    NAME: one benchmark (default: all)
    --json: print JSON to stdout and nothing else
    """
    # each perf/bench_NAME.py has `main(argv) -> int`; with --json it prints one JSON value
    scripts = {path.stem.removeprefix("bench_"): path for path in sorted(_PERF.glob("bench_*.py"))}
    if not scripts and (_PERF.parent / "pyproject.toml").is_file():
        raise InputError(f"no benchmarks are in {str(_PERF)!r}; each is a bench_NAME.py there.")
    if not scripts:
        raise InputError(
            "fastrod bench needs the source checkout, whose folder perf/ holds the benchmarks; "
            "an installed package has none."
        )
    if name is not None and name not in scripts:
        raise UnknownNameError(f"no benchmark {name!r}; {nearest(name, scripts)}")
    chosen = scripts if name is None else {name: scripts[name]}
    if not json:
        return max(_script(path, []) for path in chosen.values())
    figures: dict[str, object] = {}
    for each, path in chosen.items():
        with redirect_stdout(io.StringIO()) as out:
            if code := _script(path, ["--json"]):
                return code
        figures[each] = loads(out.getvalue())
    print(dumps(figures if name is None else figures[name], indent=1))
    return DONE


_PERF = Path(__file__).parents[2] / "perf"
"""Beside the package's source in a checkout, editable installs included."""


def _script(path: Path, argv: list[str]) -> int:
    """The exit code of the script's `main(argv)`."""
    sys.path.insert(
        0, str(path.parent)
    )  # as `python perf/bench_NAME.py` has it, for the scripts' common modules
    try:
        # imported by name, so that a process that a benchmark starts finds its functions
        return int(import_module(path.stem).main(argv) or DONE)
    finally:
        sys.path.remove(str(path.parent))


def warmup(*groups: str) -> int:
    """Compile the kernels now, not in the first step.

    GROUP: rod, contact (with what it needs of the rod), modes (default: all)
    """
    from fastrod.commands.warmup import warm_up

    with progress() as bar:
        warm_up(groups, bar)
    return DONE


COMMANDS: dict[str, Command | Actions] = {
    "demo": demo,
    "replay": replay,
    "identify": identify,
    "excite": excite,
    "new": own.new,
    "import": own.bring,
    "check": own.check,
    "export": own.export,
    "view": view,
    "drive": drive.DRIVE,
    "camera": drive.CAMERA,
    "envs": envs,
    "train": train,
    "evaluate": evaluate,
    "generate": generate.GENERATE,
    "bench": bench,
    "warmup": warmup,
}
"""Functions of the commands."""
GROUPS: Mapping[str, tuple[str, ...]] = {
    "look": ("demo", "view"),
    "your robot and your log": ("new", "check", "import", "export"),
    "measure and explain": ("excite", "drive", "camera", "identify", "replay"),
    "learn": ("envs", "train", "evaluate"),
    "scale and compare": ("generate", "bench", "warmup"),
}
"""Every command once, in the order of what one wants to do."""
_EXAMPLES = (
    ("fastrod demo", "excite, identify, plan anew, track, on an emulated robot"),
    ("fastrod view", "a robot in the browser: drag its tip"),
    ("fastrod identify run.csv --robot mine.toml", "what the model lacks, in run_identified/report.html"),
    ("fastrod train Reach --out mine", "a policy; then fastrod evaluate Reach mine"),
)


class _Front(Parser):
    """Its help has the commands by what they are for."""

    about: Mapping[str, str]
    """Description of each command, in a line."""

    def format_help(self) -> str:
        text = [
            "usage: fastrod COMMAND [...]",
            "",
            "Tendon-driven continuum robots, simulated in batches and met with measured data.",
        ]
        for title, names in GROUPS.items():
            text += ["", f"{title}:", *(f"  {name:<10}{self.about[name]}" for name in names)]
        width = max(len(line) for line, _ in _EXAMPLES)
        text += ["", "examples:", *(f"  {line:<{width}}  {what}" for line, what in _EXAMPLES)]
        text += [
            "",
            "`fastrod COMMAND --help` lists all options of one; `fastrod --version` prints the version.",
            "",
        ]
        return "\n".join(text)


class _Version(argparse.Action):
    """Prints the version; looked up only then, so that no other command waits for it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"{parser.prog} {version('fastrod')}")
        parser.exit()


@cache
def build() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = _Front(prog="fastrod")
    about = "print the version and exit"
    parser.add_argument("--version", action=_Version, nargs=0, default=argparse.SUPPRESS, help=about)
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=Parser)
    for name, command in COMMANDS.items():
        if isinstance(command, Actions):
            add_group(commands, name, command)
        else:
            add_command(commands, name, command, own.QUESTIONS if command is own.new else None)
    parser.about = {action.dest: action.help or "" for action in commands._get_subactions()}
    return parser


if __name__ == "__main__":
    sys.exit(main())
