"""The `fastrod` command: words to functions, errors to exit codes; no logic of its own."""

from __future__ import annotations

import argparse
import io
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from fastrod.commands import own
from fastrod.commands.arguments import BOARD_ACTIONS, DATA_SETS, UsageError, build, check_drive
from fastrod.errors import FastrodError, InputError, UnknownNameError, nearest

if TYPE_CHECKING:
    from fastrod.logs.runlog import RunLog
    from fastrod.model.robot import Robot

DONE, FAILED, WRONG_INPUT = 0, 1, 2
BASE_FIT = "base fit: "
"""Beginning of the sentence that `identify` prints once its base model is fitted."""
_SMALL = 0.3  # of the steps of a preset: fewer are worth a word
_PATIENCE = 10.0  # s without a line


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv`; the exit code: 0 done, 2 the input is wrong (one sentence on stderr), 1 it
    failed."""
    parser, commands = build()
    words = list(sys.argv[1:] if argv is None else argv)
    if words and not words[0].startswith("-") and words[0] not in commands:
        return _refuse(f"no command {words[0]!r}; {nearest(words[0], commands)}")
    if (
        words[:1] == ["generate"]
        and len(words) > 1
        and not words[1].startswith("-")
        and words[1] not in DATA_SETS
    ):
        return _refuse(f"no data set {words[1]!r} to generate; {nearest(words[1], DATA_SETS)}")
    try:
        arguments, rest = parser.parse_known_args(words)
        if hasattr(arguments, "logs"):  # more of them after an option
            arguments.logs += [Path(word) for word in rest if not word.startswith("-")]
            rest = [word for word in rest if word.startswith("-")]
        if rest:
            what = " ".join(
                [
                    parser.prog,
                    arguments.command,
                    *([arguments.kind] if arguments.command == "generate" else []),
                ]
            )
            return _refuse(f"{what} does not know {rest[0]!r}; `{what} --help` lists them.")
        return _RUN[arguments.command](arguments)
    except UsageError as error:
        return _refuse(str(error))
    except FastrodError as error:
        return _refuse(str(error))
    except OSError as error:
        return _refuse(f"{error.filename or 'a file'}: {error.strerror or error}.", FAILED)
    except KeyboardInterrupt:
        return _refuse("interrupted.", FAILED)


def _refuse(sentence: str, code: int = WRONG_INPUT) -> int:
    """Print `sentence` on stderr, in one line whatever names it quotes; the exit code `code`."""
    print(" ".join(sentence.split()), file=sys.stderr)
    return code


def _demo(arguments: argparse.Namespace) -> int:
    from fastrod.commands.demo import run

    run(arguments.out, seed=arguments.seed, view=not arguments.no_view)
    return DONE


def _replay(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from fastrod.identification.log.replay import replay
    from fastrod.identification.log.replay_output import table, write
    from fastrod.loading import load_robot

    path: Path = arguments.log
    log, robot = _read(path, None if arguments.robot is None else load_robot(arguments.robot))
    if arguments.run is not None:
        log = log.only(arguments.run)
    out = arguments.out or Path(f"{path.stem}_replay")
    with _folder(out), _progress() as bar:
        result = replay(
            log, robot, dynamics=arguments.dynamics, progress=None if bar is None else partial(bar, "replay")
        )
    console = Console()
    console.print(table(result))
    if not result.compared.any():
        return _refuse(f"the model converged on none of the {len(log)} rows.", FAILED)
    for written in write(result, out):
        console.print(f"wrote {written}", soft_wrap=True, highlight=False)
    for question in result.questions:  # it has shown what was requested: that is no refusal
        _refuse(question, DONE)
    return DONE


def _read(path: Path, given: Robot | None) -> tuple[RunLog, Robot]:
    from fastrod_scenes.measured import read

    return read(path, given)


def _identify(arguments: argparse.Namespace) -> int:
    from rich.console import Console

    from fastrod.identification.attribution import identify
    from fastrod.identification.report import report
    from fastrod.loading import load_robot

    # `--held-out RUN LOG`: no run is named like a file that is there.
    swallowed = [word for word in arguments.held_out if Path(word).suffix and Path(word).is_file()]
    paths: list[Path] = arguments.logs + [Path(word) for word in swallowed]
    if not paths:
        raise UsageError(
            "the following arguments are required: LOG; `fastrod identify --help` says how it is used."
        )
    given = None if arguments.robot is None else load_robot(arguments.robot)
    logs, robots = zip(*(_read(path, given) for path in paths), strict=True)
    if any(robot != robots[0] for robot in robots):
        raise InputError("these files bring different robots; name one with --robot, or identify each alone.")
    out = arguments.out or (None if arguments.json else Path(f"{paths[0].stem}_identified"))
    with _folder(out), _progress() as bar:
        result = identify(
            logs,
            robots[0],
            held_out=[word for word in arguments.held_out if word not in swallowed],
            max_effects=arguments.max_effects,
            free_camera=arguments.free_camera,
            network=arguments.network,
            dynamics=arguments.dynamics,
            only_session=arguments.only_session,
            progress=bar or _lines(),
        )
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
    from fastrod.loading import load_robot
    from fastrod.logs.runlog import write_log

    robot = load_robot(arguments.robot)
    made = excitation(
        robot, bend=arguments.bend, payload=arguments.payload, rate=arguments.rate, speed=arguments.speed
    )
    path: Path = arguments.out or Path(f"{robot.name}_excitation.csv")
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{str(path)!r} does not end in .csv or .parquet; a run log does.")
    write_log(made.log, path, comment=made.comment)
    grid = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for name in ("from", "to", "section", "purpose"):
        grid.add_column(
            f"{name} s" if name in ("from", "to") else name,
            justify="right" if name in ("from", "to") else "left",
        )
    said: set[str] = set()
    for section in made.phases:
        grid.add_row(
            f"{section.start:.1f}",
            f"{section.end:.1f}",
            section.name,
            section.purpose if section.purpose not in said else "as above",
        )
        said.add(section.purpose)
    console = Console()
    console.print(grid)
    console.print(
        f"wrote {path}: drive it, fill tip_x tip_y tip_z, then fastrod identify",
        soft_wrap=True,
        highlight=False,
        markup=False,
    )
    return DONE


def _view(arguments: argparse.Namespace) -> int:
    from fastrod_viewer.server import serve

    # first: a browser loads the page while the simulator is imported
    server = serve(arguments.host, arguments.port)
    from fastrod_viewer.app import FIRST, view

    view(
        FIRST if arguments.what is None else arguments.what,
        robot=arguments.robot,
        n_robots=arguments.robots,
        host=arguments.host,
        open_browser=not arguments.no_open,
        script=arguments.play or (arguments.what is None and not arguments.dynamics),
        server=server,
        dynamics=arguments.dynamics,
        line_density=arguments.line_density,
        dt=arguments.dt,
    )
    return DONE


def _drive(arguments: argparse.Namespace) -> int:
    """Errors of a run that failed: a robot that does not answer or is stopped, a plan that it refused,
    measurements that do not suffice."""
    check_drive(arguments)
    for module in ("cv2",) if arguments.action in BOARD_ACTIONS else ("can", "canopen", "cv2"):
        _need(module, "drive", "device")
    from fastrod.commands import drive as driving
    from fastrod_device.errors import CalibrationError, DeviceError, RefusedError

    with _progress() as bar:
        try:
            return driving.ACTIONS[arguments.action](arguments, bar)
        except (DeviceError, CalibrationError, RefusedError) as error:
            return _refuse(str(error), FAILED)
        except EOFError:
            return _refuse(
                "nobody answers; give it a terminal, since it prompts for loads and boards.", FAILED
            )


def _envs(arguments: argparse.Namespace) -> int:
    _need("gymnasium", "envs", "envs")
    from fastrod_envs.describe import describe, summary

    print(
        summary() if arguments.env is None else describe(arguments.env, _pairs(arguments.option, "--option"))
    )
    return DONE


def _train(arguments: argparse.Namespace) -> int:
    _need("stable_baselines3", "train", "rl")
    from fastrod_envs.learning.training import make_plan, read_config, resume, train
    from fastrod_envs.registration import name_of

    out: Path | None = arguments.out
    if arguments.env is not None:
        name_of(arguments.env)  # of a file of one's own, which is run now
    if arguments.resume:
        if out is None:
            raise InputError("--resume needs --out DIR, the folder of the training to resume.")
        plan = read_config(out)[0]
        with _progress() as bar:
            path = resume(out, arguments.steps, bar, trust=arguments.trust)
    else:
        if arguments.env is None:
            raise UsageError(
                "the following arguments are required: ENV; `fastrod train --help` says how it is used."
            )
        plan = make_plan(
            arguments.env,
            algorithm=arguments.algo,
            steps=arguments.steps,
            n_envs=arguments.envs,
            seed=arguments.seed,
            imitate=arguments.imitate,
            options=_pairs(arguments.option, "--option"),
            settings=_pairs(arguments.set, "--set"),
            curriculum=arguments.curriculum,
        )
        usual = make_plan(arguments.env).steps
        if plan.steps < _SMALL * usual:
            few = f"{plan.steps:,} steps are {100.0 * plan.steps / usual:.2g} % of the {usual:,}"
            print(f"{few} that the preset takes: expect little success.", file=sys.stderr)
        out = out or Path(f"{plan.env.partition('/')[2]}_{plan.algorithm}_{plan.seed}")
        with _progress() as bar:
            path = train(plan, out, bar)
    print(f"wrote {path}; see it with: fastrod evaluate {arguments.env or plan.env} {out}")
    return DONE


def _evaluate(arguments: argparse.Namespace) -> int:
    _need("gymnasium", "evaluate", "envs")
    from rich.console import Console

    from fastrod_envs.learning import evaluation
    from fastrod_envs.learning.policies import Policy, find
    from fastrod_envs.registration import name_of

    options = _pairs(arguments.option, "--option")
    name_of(arguments.env)  # of a file of one's own, which is run now
    policy = (
        None
        if arguments.policy == "none"
        else Policy(find(arguments.env, arguments.policy), trust=arguments.trust)
    )
    with _progress() as bar:
        result = evaluation.evaluate(
            arguments.env,
            policy,
            episodes=arguments.episodes,
            seed=arguments.seed,
            options=options,
            baselines=not arguments.no_baselines,
            progress=bar,
        )
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


def _generate(arguments: argparse.Namespace) -> int:
    _need("pyarrow", "generate", "parquet")
    if arguments.ray is not None:
        _need("ray", "generate --ray", "ray")
    if arguments.kind == "rollouts" and arguments.env is not None:
        _need("gymnasium", "generate rollouts --env", "envs")
    from rich.console import Console

    from fastrod.commands import generate as command

    with _progress() as bar:
        summary = command.run(arguments, _pairs(getattr(arguments, "option", ()), "--option"), bar)
    if arguments.json:
        print(json.dumps(command.figures(summary), indent=1))
        return DONE
    Console().print(command.table(summary))
    return DONE


def _pairs(given: Sequence[str], flag: str) -> dict[str, object]:
    """NAME=VALUE as names and numbers, lists, true, false, none, or words."""
    options: dict[str, object] = {}
    for pair in given:
        name, equals, word = pair.partition("=")
        if not equals or not name:
            raise InputError(f"{flag} is {pair!r}; give NAME=VALUE.")
        try:
            options[name] = None if word in ("none", "None") else json.loads(word)
        except ValueError:
            options[name] = word
    return options


def _need(module: str, command: str, extra: str) -> None:
    """Raises `InputError` where what a command stands on is not installed."""
    from importlib.util import find_spec

    if find_spec(module) is None:
        raise InputError(
            f"fastrod {command} needs {module.replace('_', '-')}: pip install 'fastrod[{extra}]'."
        )


def _bench(arguments: argparse.Namespace) -> int:
    """Each perf/bench_NAME.py has `main(argv) -> int`; with --json it prints one JSON value."""
    scripts = {path.stem.removeprefix("bench_"): path for path in sorted(_PERF.glob("bench_*.py"))}
    if not scripts and (_PERF.parent / "pyproject.toml").is_file():
        raise InputError(f"no benchmarks are in {str(_PERF)!r}; each is a bench_NAME.py there.")
    if not scripts:
        raise InputError(
            "fastrod bench needs the source checkout, whose folder perf/ holds the benchmarks; "
            "an installed package has none."
        )
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


def _warmup(arguments: argparse.Namespace) -> int:
    from fastrod.commands.warmup import warm_up

    with _progress() as bar:
        warm_up(arguments.groups, bar)
    return DONE


_RUN: dict[str, Callable[[argparse.Namespace], int]] = {
    "demo": _demo,
    "replay": _replay,
    "identify": _identify,
    "excite": _excite,
    "new": own.new,
    "import": own.bring,
    "check": own.check,
    "export": own.export,
    "view": _view,
    "drive": _drive,
    "envs": _envs,
    "train": _train,
    "evaluate": _evaluate,
    "generate": _generate,
    "bench": _bench,
    "warmup": _warmup,
}
"""Functions of the commands."""


@contextmanager
def _folder(out: Path | None) -> Iterator[None]:
    """Make the folder of what is about to be computed before rather than after; gone again where nothing
    comes of it."""
    from fastrod.logs.folder import make_folder

    fresh = out is not None and not out.exists()
    if out is not None:
        make_folder(out)
    try:
        yield
    except FastrodError:
        if out is not None and fresh:
            out.rmdir()
        raise


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None] | None]:
    """A callback (what, done, total) that draws a bar on stderr, or None where stderr is no terminal. A
    line of figures stays."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def draw(what: str, done: int, total: int) -> None:
            if what.startswith(BASE_FIT):
                bar.console.print(what, highlight=False)
            bar.update(task, description=what, completed=done, total=total)

        yield draw


def _lines() -> Callable[[str, int, int], None]:
    """The same for a stderr that is no terminal: a line every ten seconds, for work that may take minutes."""
    begun = said = time.monotonic()

    def line(what: str, done: int, total: int) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said > _PATIENCE or (what.startswith(BASE_FIT) and now - begun > _PATIENCE):
            said = now
            print(f"{now - begun:.0f} s, {done} of {total}: {what}", file=sys.stderr, flush=True)

    return line


if __name__ == "__main__":
    sys.exit(main())
