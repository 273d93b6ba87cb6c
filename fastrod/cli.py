"""The `fastrod` command: words to functions, errors to exit codes; no logic of its own."""

from __future__ import annotations

import argparse
import io
import json
import runpy
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from fastrod.errors import FastrodError, InputError, UnknownNameError, nearest

if TYPE_CHECKING:
    from fastrod.robot import Robot
    from fastrod.runlog import RunLog

DONE, FAILED, WRONG_INPUT = 0, 1, 2


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`; the exit code: 0 done, 2 the input is wrong (one sentence on stderr), 1 it failed."""
    parser, commands = _parser()
    words = list(sys.argv[1:] if argv is None else argv)
    if words and not words[0].startswith("-") and words[0] not in commands:
        return _refuse(f"no command {words[0]!r}; {nearest(words[0], commands)}")
    try:
        arguments, rest = parser.parse_known_args(words)
        if hasattr(arguments, "logs"):  # more of them after an option
            arguments.logs += [Path(word) for word in rest if not word.startswith("-")]
            rest = [word for word in rest if word.startswith("-")]
        if rest:
            return _refuse(
                f"{parser.prog} {arguments.command} does not know {rest[0]!r}; `{parser.prog} {arguments.command} --help` tells."
            )
        run: Callable[[argparse.Namespace], int] = arguments.run_command
        return run(arguments)
    except _UsageError as error:
        return _refuse(str(error))
    except FastrodError as error:
        return _refuse(str(error))
    except OSError as error:
        return _refuse(f"{error.filename or 'a file'}: {error.strerror or error}.", FAILED)
    except KeyboardInterrupt:
        return _refuse("interrupted.", FAILED)


class _UsageError(Exception):
    """What argparse would have printed over several lines."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise _UsageError(f"{message}; `{self.prog} --help` says how it is used.")


class _Version(argparse.Action):
    """Prints the version; looked up only then, so that no other command waits for it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"{parser.prog} {version('fastrod')}")
        parser.exit()


def _refuse(sentence: str, code: int = WRONG_INPUT) -> int:
    """Print `sentence` on stderr, in one line whatever names it quotes; the exit code `code`."""
    print(" ".join(sentence.split()), file=sys.stderr)
    return code


def _parser() -> tuple[argparse.ArgumentParser, list[str]]:
    """The parser, and the names of its commands."""
    parser = _Parser(prog="fastrod", description="Tendon-driven continuum robots, simulated in batches and met with measured data.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    demo = commands.add_parser("demo", help="the main job on an embedded default, start to end")
    demo.add_argument("--out", type=Path, metavar="DIR", help="write the report there")
    demo.set_defaults(run_command=_demo)

    replay = commands.add_parser("replay", help="the model beside a measurement: residual table and plot")
    replay.add_argument("log", type=Path, metavar="LOG", help="run log (.csv or .parquet), or the raw file of a measured set")
    replay.add_argument("--robot", metavar="R", help="a shipped robot's name or a path to a .toml; a measured set brings its own")
    replay.add_argument("--run", metavar="RUN", help="only this run of the log")
    replay.add_argument("--out", type=Path, metavar="DIR", help="where residuals.csv and replay.png go (default: LOG's name + _replay)")
    replay.set_defaults(run_command=_replay)

    identify = commands.add_parser("identify", help="find what the model lacks: report.json, report.html, identified.toml")
    identify.add_argument("logs", type=Path, nargs="*", metavar="LOG", help="run logs of one robot, or raw files of a measured set")
    identify.add_argument("--robot", metavar="R", help="a shipped robot's name or a path to a .toml; a measured set brings its own")
    held_out = "runs that no fit sees, or RUN@START:END in seconds (default: every fourth stretch)"
    identify.add_argument("--held-out", nargs="+", action="extend", default=[], metavar="RUN", help=held_out)
    identify.add_argument("--max-effects", type=int, default=4, metavar="K", help="name this many at most (default: 4)")
    identify.add_argument("--free-camera", action="store_true", help="fit the camera's registration, marker offset and latency too")
    identify.add_argument("--network", action="store_true", help="train a network on what is left, reported apart (needs fastrod[network])")
    identify.add_argument("--out", type=Path, metavar="DIR", help="where the files go (default: LOG's name + _identified)")
    identify.add_argument("--json", action="store_true", help="print report.json to stdout and nothing else; files only with --out")
    identify.set_defaults(run_command=_identify)

    excite = commands.add_parser("excite", help="write the run that separates effects, to be driven and measured")
    excite.add_argument("--robot", required=True, metavar="R", help="a shipped robot's name or a path to a .toml")
    excite.add_argument("--out", type=Path, metavar="FILE", help="the run log, .csv or .parquet (default: NAME_excitation.csv)")
    excite.add_argument("--bend", type=float, default=0.9, metavar="RAD", help="largest bend of a segment (default: 0.9)")
    excite.add_argument("--payload", type=float, metavar="KG", help="known mass at the tip, on and off (default: F l^2/EI = 1)")
    excite.add_argument("--rate", type=float, default=15.0, metavar="HZ", help="samples a second (default: 15)")
    excite.add_argument("--speed", type=float, default=1.0, metavar="RAD/S", help="of the triangles (default: 1)")
    excite.set_defaults(run_command=_excite)

    view = commands.add_parser("view", help="viewer and teleop in the browser, or a log beside the model")
    view.add_argument("what", nargs="?", metavar="WHAT", help="a scene, a robot (name or .toml), or a run log (default: a robot to try)")
    view.add_argument("--robot", metavar="R", help="whose log it is: a shipped robot's name or a path to a .toml")
    view.add_argument("--robots", type=int, default=1, metavar="N", help="so many of the robot, in a grid, driven alike (default: 1)")
    view.add_argument("--play", action="store_true", help="begin with the robot's demo motion; scenes always begin with their script")
    view.add_argument("--port", type=int, metavar="P", help="default: the first free one from 8080 on")
    view.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen on (default: 127.0.0.1, this machine alone)")
    view.add_argument("--no-open", action="store_true", help="do not open a browser")
    view.set_defaults(run_command=_view)

    envs = commands.add_parser("envs", help="the environments; of one, its task, observation, action and options")
    envs.add_argument("env", nargs="?", metavar="ENV", help="a task, such as Reach or fastrod/Reach-v0 (default: a line for each)")
    _add_options(envs)
    envs.set_defaults(run_command=_envs)

    train = commands.add_parser("train", help="train a policy for an environment, on stable-baselines3")
    train.add_argument("env", nargs="?", metavar="ENV", help="a task, such as Reach or fastrod/Reach-v0; with --resume the folder knows")
    train.add_argument("--algo", metavar="A", help="sac, ppo or td3 (default: the task's preset)")
    train.add_argument("--steps", type=int, metavar="N", help="environment steps in all (default: the preset's)")
    train.add_argument("--envs", type=int, metavar="N", help="environments side by side (default: the preset's)")
    train.add_argument("--seed", type=int, default=0, metavar="S", help="of policy and environments (default: 0)")
    train.add_argument("--imitate", type=int, metavar="N", help="steps of lessons by the scripted baseline before (default: the preset's)")
    train.add_argument("--curriculum", type=float, default=1.0, metavar="D", help="difficulty at the start, rising to 1 (default: 1, none)")
    _add_options(train)
    train.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="a setting of the algorithm, such as batch_size=512"
    )
    train.add_argument("--out", type=Path, metavar="DIR", help="policy, configuration, checkpoints, curves (default: NAME_ALGO_SEED)")
    train.add_argument("--resume", action="store_true", help="go on with the training in --out, after a kill or to more --steps")
    train.set_defaults(run_command=_train)

    evaluate = commands.add_parser("evaluate", help="a policy beside the baselines: success, distance, contacts")
    evaluate.add_argument("env", metavar="ENV", help="a task, such as Reach or fastrod/Reach-v0")
    evaluate.add_argument("policy", metavar="POLICY", help="a folder of `fastrod train`, `shipped`, or `none` for the baselines alone")
    evaluate.add_argument("--episodes", type=int, default=100, metavar="N", help="one for each seed (default: 100)")
    evaluate.add_argument("--seed", type=int, default=1000, metavar="S", help="of the first episode (default: 1000)")
    evaluate.add_argument("--no-baselines", action="store_true", help="the policy alone")
    _add_options(evaluate)
    evaluate.add_argument("--out", type=Path, metavar="DIR", help="write evaluation.json and evaluation.png there")
    evaluate.add_argument("--json", action="store_true", help="print the figures to stdout and nothing else")
    evaluate.set_defaults(run_command=_evaluate)

    bench = commands.add_parser("bench", help="the figures of perf/ as ratios")
    bench.add_argument("name", nargs="?", metavar="NAME", help="one benchmark (default: all)")
    bench.add_argument("--json", action="store_true", help="print JSON to stdout and nothing else")
    bench.set_defaults(run_command=_bench)
    return parser, list(commands.choices)


def _add_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="of the environment, such as n_steps=1 or randomise=mine.toml"
    )


def _demo(arguments: argparse.Namespace) -> int:
    from fastrod.demo import run

    run(arguments.out)
    return DONE


def _replay(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from fastrod.identification import replay as room
    from fastrod.robotfile import load_robot

    path: Path = arguments.log
    log, robot = _read(path, None if arguments.robot is None else load_robot(arguments.robot))
    if arguments.run is not None:
        log = log.only(arguments.run)
    out = arguments.out or Path(f"{path.stem}_replay")
    fresh = not out.exists()
    room.make_folder(out)
    try:
        with _progress() as bar:
            result = room.replay(log, robot, progress=None if bar is None else partial(bar, "replay"))
    except FastrodError:
        if fresh:
            out.rmdir()
        raise
    console = Console()
    console.print(room.table(result))
    if not result.compared.any():
        return _refuse(f"the model converged on none of the {len(log)} rows.", FAILED)
    for written in room.write(result, out):
        console.print(f"wrote {written}", soft_wrap=True, highlight=False)
    return DONE


def _read(path: Path, given: Robot | None) -> tuple[RunLog, Robot]:
    from fastrod_scenes.measured import read

    return read(path, given)


def _identify(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from fastrod.identification import report
    from fastrod.identification.attribution import identify
    from fastrod.identification.replay import make_folder
    from fastrod.robotfile import load_robot

    # `--held-out RUN LOG`: no run is named like a file that is there.
    swallowed = [word for word in arguments.held_out if Path(word).suffix and Path(word).is_file()]
    paths: list[Path] = arguments.logs + [Path(word) for word in swallowed]
    if not paths:
        raise _UsageError("the following arguments are required: LOG; `fastrod identify --help` says how it is used.")
    given = None if arguments.robot is None else load_robot(arguments.robot)
    logs, robots = zip(*(_read(path, given) for path in paths), strict=True)
    if any(robot != robots[0] for robot in robots):
        raise InputError("these files bring different robots; name one with --robot, or identify each alone.")
    out = arguments.out or (None if arguments.json else Path(f"{paths[0].stem}_identified"))
    if out is not None:
        make_folder(out)
    with _progress() as bar:
        result = identify(
            logs, robots[0], held_out=[word for word in arguments.held_out if word not in swallowed],
            max_effects=arguments.max_effects, free_camera=arguments.free_camera,
            network=arguments.network, progress=bar,
        )  # fmt: skip
    written = [] if out is None else report.write(result, out)
    if arguments.json:
        print(report.text(result))
        return DONE
    console = Console()
    console.print(report.table(result))
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True, highlight=False, markup=False)
    return DONE


def _excite(arguments: argparse.Namespace) -> int:
    from rich import box
    from rich.console import Console
    from rich.table import Table

    from fastrod.identification.excite import excitation
    from fastrod.robotfile import load_robot
    from fastrod.runlog import write_log

    robot = load_robot(arguments.robot)
    made = excitation(robot, bend=arguments.bend, payload=arguments.payload, rate=arguments.rate, speed=arguments.speed)
    path: Path = arguments.out or Path(f"{robot.name}_excitation.csv")
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{str(path)!r} does not end in .csv or .parquet; a run log does.")
    write_log(made.log, path, comment=made.comment)
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("from", "to", "part", "tells"):
        grid.add_column(f"{name} s" if name in ("from", "to") else name, justify="right" if name in ("from", "to") else "left")
    said: set[str] = set()
    for part in made.parts:
        grid.add_row(f"{part.start:.1f}", f"{part.end:.1f}", part.name, part.purpose if part.purpose not in said else "as above")
        said.add(part.purpose)
    console = Console()
    console.print(grid)
    console.print(f"wrote {path}: drive it, fill tip_x tip_y tip_z, then fastrod identify", soft_wrap=True, highlight=False, markup=False)
    return DONE


def _view(arguments: argparse.Namespace) -> int:
    from fastrod_viewer.server import serve

    server = serve(arguments.host, arguments.port)  # first: a browser loads the page while the simulator is imported
    from fastrod_viewer.app import FIRST, view

    view(
        FIRST if arguments.what is None else arguments.what, robot=arguments.robot, n_robots=arguments.robots, host=arguments.host,
        open_browser=not arguments.no_open, script=arguments.play, server=server,
    )  # fmt: skip
    return DONE


def _envs(arguments: argparse.Namespace) -> int:
    _need("gymnasium", "envs", "envs")
    from fastrod_envs.describe import describe, summary

    print(summary() if arguments.env is None else describe(arguments.env, _pairs(arguments.option, "--option")))
    return DONE


def _train(arguments: argparse.Namespace) -> int:
    _need("stable_baselines3", "train", "rl")
    from fastrod_envs.training import make_plan, read_config, resume, train

    out: Path | None = arguments.out
    if arguments.resume:
        if out is None:
            raise InputError("--resume needs --out DIR, the folder of the training to go on with.")
        plan = read_config(out)[0]
        with _progress() as bar:
            path = resume(out, arguments.steps, bar)
    else:
        if arguments.env is None:
            raise _UsageError("the following arguments are required: ENV; `fastrod train --help` says how it is used.")
        plan = make_plan(
            arguments.env, algorithm=arguments.algo, steps=arguments.steps, n_envs=arguments.envs, seed=arguments.seed,
            imitate=arguments.imitate, options=_pairs(arguments.option, "--option"), settings=_pairs(arguments.set, "--set"),
            curriculum=arguments.curriculum,
        )  # fmt: skip
        out = out or Path(f"{plan.env.partition('/')[2]}_{plan.algorithm}_{plan.seed}")
        with _progress() as bar:
            path = train(plan, out, bar)
    print(f"wrote {path}; see it with: fastrod evaluate {plan.env} {out}")
    return DONE


def _evaluate(arguments: argparse.Namespace) -> int:
    _need("gymnasium", "evaluate", "envs")
    from rich.console import Console

    from fastrod_envs import evaluation
    from fastrod_envs.policies import Policy, find

    options = _pairs(arguments.option, "--option")
    policy = None if arguments.policy == "none" else Policy(find(arguments.env, arguments.policy))
    with _progress() as bar:
        result = evaluation.evaluate(
            arguments.env, policy, episodes=arguments.episodes, seed=arguments.seed, options=options,
            baselines=not arguments.no_baselines, progress=bar,
        )  # fmt: skip
    written = [] if arguments.out is None else evaluation.write(result, arguments.out)
    if arguments.json:
        print(json.dumps(evaluation.figures(result), indent=1))
        return DONE
    console = Console()
    console.width = max(console.width, 140)
    console.print(evaluation.table(result))
    for path in written:
        console.print(f"wrote {path}", soft_wrap=True, highlight=False, markup=False)
    return DONE


def _pairs(given: Sequence[str], flag: str) -> dict[str, object]:
    """NAME=VALUE as names and numbers, lists, true, false, none, or words."""
    told: dict[str, object] = {}
    for pair in given:
        name, equals, word = pair.partition("=")
        if not equals or not name:
            raise InputError(f"{flag} is {pair!r}; give NAME=VALUE.")
        try:
            told[name] = None if word in ("none", "None") else json.loads(word)
        except ValueError:
            told[name] = word
    return told


def _need(module: str, command: str, extra: str) -> None:
    """Raises `InputError` where what a command stands on is not installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise InputError(f"fastrod {command} needs {module.replace('_', '-')}: pip install fastrod[{extra}].")


def _bench(arguments: argparse.Namespace) -> int:
    """Each perf/bench_NAME.py has `main(argv) -> int`; with --json it prints one JSON value."""
    scripts = {path.stem.removeprefix("bench_"): path for path in sorted(_PERF.glob("bench_*.py"))}
    if not scripts and (_PERF.parent / "pyproject.toml").is_file():
        raise InputError(f"no benchmarks are in {str(_PERF)!r}; each is a bench_NAME.py there.")
    if not scripts:
        raise InputError("fastrod bench needs the source checkout, whose folder perf/ holds the benchmarks; an installed package has none.")
    if arguments.name is not None and arguments.name not in scripts:
        raise UnknownNameError(f"no benchmark {arguments.name!r}; {nearest(arguments.name, scripts)}")
    chosen = scripts if arguments.name is None else {arguments.name: scripts[arguments.name]}
    if not arguments.json:
        return max(_script(path, []) for path in chosen.values())
    figures: dict[str, object] = {}
    for name, path in chosen.items():
        with redirect_stdout(io.StringIO()) as out:
            if code := _script(path, ["--json"]):
                return code
        figures[name] = json.loads(out.getvalue())
    print(json.dumps(figures if arguments.name is None else figures[arguments.name], indent=1))
    return DONE


_PERF = Path(__file__).parents[1] / "perf"
"""Beside the package's source in a checkout, editable installs included."""


def _script(path: Path, argv: list[str]) -> int:
    """The exit code of the script's `main(argv)`."""
    sys.path.insert(0, str(path.parent))  # as `python perf/bench_NAME.py` has it, for what the scripts share
    try:
        return int(runpy.run_path(str(path))["main"](argv) or DONE)
    finally:
        sys.path.remove(str(path.parent))


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None] | None]:
    """A callback (what, done, total) that draws a bar on stderr, or None where stderr is no terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)
        yield lambda what, done, total: bar.update(task, description=what, completed=done, total=total)


if __name__ == "__main__":
    sys.exit(main())
