"""The words of the `fastrod` command: its parser, and nothing of what the words do."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from fastrod.commands import own
from fastrod.errors import UnknownNameError, nearest

ACTIONS = {
    "teleop": "by hand, in the browser",
    "excite": "the run that separates effects, recorded for `fastrod identify`",
    "track": "one lap of a path, by the model or by a policy, recorded",
    "loop": "excite, identify, plan anew, track; the error before and after",
    "calibrate": "the camera's lens, from pictures of a charuco board that is waved; no drives needed",
    "register": "where the camera stands, from pictures of a board at known places; no drives needed",
    "latency": "how late the camera is, from a motion of some seconds",
}
"""Actions of `fastrod drive`, and what they do."""
BOARD_ACTIONS = ("calibrate", "register")
"""Those that need a camera and a board, and no drives."""
DATA_SETS = ("shapes", "rollouts", "sweep")
"""Kinds of data that `fastrod generate` makes."""
_MOVING = tuple(name for name in ACTIONS if name not in BOARD_ACTIONS)
_OF: dict[str, tuple[str, ...]] = {
    "eds": _MOVING,
    "no_home": _MOVING,
    "path": ("track",),
    "policy": ("track",),
    "trust": ("track",),
    "payload": ("excite", "loop"),
    "views": BOARD_ACTIONS,
    "board": BOARD_ACTIONS,
    "square": BOARD_ACTIONS,
    "board_marker": BOARD_ACTIONS,
    "dictionary": BOARD_ACTIONS,
    "at": ("register",),
    "port": ("teleop",),
    "no_open": ("teleop",),
    "out": tuple(name for name in ACTIONS if name != "teleop"),
    "bus": _MOVING,
}
"""Options of `fastrod drive` that are not of every action."""


class UsageError(Exception):
    """Error that argparse would have printed over several lines."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; `{self.prog} --help` says how it is used.")


class _Front(_Parser):
    """Its help has the commands in the order of what one wants to do, not of the alphabet."""

    commands: dict[str, str]
    """Description of each command, in a line."""

    def format_help(self) -> str:
        return overview(self.commands)


class _Version(argparse.Action):
    """Prints the version; looked up only then, so that no other command waits for it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"{parser.prog} {version('fastrod')}")
        parser.exit()


def build() -> tuple[argparse.ArgumentParser, list[str]]:
    """The parser, and the names of its commands."""
    parser = _Front(prog="fastrod")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    demo = commands.add_parser("demo", help="the main job on an embedded default, start to end")
    demo.add_argument(
        "--out", type=Path, metavar="DIR", help="where logs and report go (default: a folder of its own)"
    )
    demo.add_argument(
        "--seed", type=int, metavar="S", help="of what the emulator hides (default: nobody knows it)"
    )
    demo.add_argument("--no-view", action="store_true", help="end with the report; do not serve the viewer")

    replay = commands.add_parser("replay", help="the model beside a measurement: residual table and plot")
    replay.add_argument(
        "log", type=Path, metavar="LOG", help="run log (.csv or .parquet), or the raw file of a measured set"
    )
    replay.add_argument(
        "--robot",
        metavar="R",
        help="a shipped robot's name or a path to a .toml; a measured set brings its own",
    )
    replay.add_argument("--run", metavar="RUN", help="only this run of the log")
    replay.add_argument(
        "--dynamics", action="store_true", help="in motion, with inertia and damping (needs line_density)"
    )
    replay.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="where residuals.csv and replay.png go (default: LOG's name + _replay)",
    )

    identify = commands.add_parser(
        "identify", help="find what the model lacks: report.json, report.html, identified.toml"
    )
    identify.add_argument(
        "logs",
        type=Path,
        nargs="*",
        metavar="LOG",
        help="run logs of one robot, or raw files of a measured set",
    )
    identify.add_argument(
        "--robot",
        metavar="R",
        help="a shipped robot's name or a path to a .toml; a measured set brings its own",
    )
    held_out = "runs that no fit sees, or RUN@START:END in seconds (default: every fourth stretch)"
    identify.add_argument("--held-out", nargs="+", action="extend", default=[], metavar="RUN", help=held_out)
    identify.add_argument(
        "--max-effects",
        type=int,
        default=4,
        metavar="K",
        help="name this many at most, 0: fit the base model alone (default: 4)",
    )
    identify.add_argument(
        "--free-camera",
        action="store_true",
        help="fit the camera's registration, marker offset and latency too",
    )
    identify.add_argument(
        "--only-session",
        action="store_true",
        help="fit this session's zeros, registration and delay alone, of a robot identified before",
    )
    identify.add_argument(
        "--dynamics",
        action="store_true",
        help="fit and search in motion, with inertia and damping (needs line_density)",
    )
    identify.add_argument(
        "--network",
        action="store_true",
        help="train a network on what is left, reported apart (needs fastrod[network])",
    )
    identify.add_argument(
        "--out", type=Path, metavar="DIR", help="where the files go (default: LOG's name + _identified)"
    )
    identify.add_argument(
        "--json",
        action="store_true",
        help="print report.json to stdout and nothing else; files only with --out",
    )

    excite = commands.add_parser(
        "excite", help="write the run that separates effects, to be driven and measured"
    )
    excite.add_argument(
        "--robot", required=True, metavar="R", help="a shipped robot's name or a path to a .toml"
    )
    excite.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="the run log, .csv or .parquet (default: NAME_excitation.csv)",
    )
    excite.add_argument(
        "--bend", type=float, default=0.9, metavar="RAD", help="largest bend of a segment (default: 0.9)"
    )
    excite.add_argument(
        "--payload",
        type=float,
        metavar="KG",
        help="known mass at the tip, on and off (default: F l^2/EI = 1)",
    )
    excite.add_argument(
        "--rate", type=float, default=15.0, metavar="HZ", help="samples a second (default: 15)"
    )
    excite.add_argument(
        "--speed", type=float, default=1.0, metavar="RAD/S", help="of the triangles (default: 1)"
    )

    view = commands.add_parser("view", help="viewer and teleop in the browser, or a log beside the model")
    view.add_argument(
        "what",
        nargs="?",
        metavar="WHAT",
        help="a scene, a robot (name or .toml), or a run log (default: a robot to try)",
    )
    view.add_argument(
        "--robot", metavar="R", help="whose log it is: a shipped robot's name or a path to a .toml"
    )
    view.add_argument(
        "--robots",
        type=int,
        default=1,
        metavar="N",
        help="so many of the robot, in a grid, driven alike (default: 1)",
    )
    view.add_argument(
        "--play",
        action="store_true",
        help="begin with the robot's demo motion; scenes always begin with their script",
    )
    view.add_argument(
        "--dynamics",
        action="store_true",
        help="a robot with inertia: pull its tip, let go, and it rings; in slow motion if you like",
    )
    view.add_argument(
        "--line-density",
        type=float,
        metavar="KG/M",
        help="with --dynamics: mass per length of all segments (default: the robot's)",
    )
    view.add_argument("--dt", type=float, metavar="S", help="with --dynamics: time step (default: 0.001 s)")
    view.add_argument("--port", type=int, metavar="P", help="default: the first free one from 8080 on")
    view.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="H",
        help="address to listen on (default: 127.0.0.1, this machine alone); the printed address is the key",
    )
    view.add_argument("--no-open", action="store_true", help="do not open a browser")

    _add_drive(
        commands.add_parser(
            "drive",
            help="the prototype, or its emulator: by hand, through a run, along a path, or the whole loop",
            formatter_class=argparse.RawDescriptionHelpFormatter,
            description="The prototype on its bus, or its emulator.\n\nactions:\n"
            + "\n".join(f"  {name:<11}{what}" for name, what in ACTIONS.items()),
            epilog="exit code:\n  0  done\n  1  the robot does not answer, was stopped during the run, or "
            "what it measured does not suffice;\n     what was recorded until then is kept\n"
            "  2  the arguments or a file are wrong, and nothing has moved",
        )
    )

    envs = commands.add_parser(
        "envs", help="the environments; of one, its task, observation, action and options"
    )
    envs.add_argument(
        "env",
        nargs="?",
        metavar="ENV",
        help="a task, such as Reach or fastrod/Reach-v0 (default: a line for each)",
    )
    _add_options(envs)

    train = commands.add_parser("train", help="train a policy for an environment, on stable-baselines3")
    train.add_argument(
        "env",
        nargs="?",
        metavar="ENV",
        help="a task, such as Reach, or FILE.py:Class of your own; with --resume the folder knows",
    )
    train.add_argument("--algo", metavar="A", help="sac, ppo or td3 (default: the task's preset)")
    train.add_argument(
        "--steps", type=int, metavar="N", help="environment steps in all (default: the preset's)"
    )
    train.add_argument(
        "--envs", type=int, metavar="N", help="environments side by side (default: the preset's)"
    )
    train.add_argument(
        "--seed", type=int, default=0, metavar="S", help="of policy and environments (default: 0)"
    )
    train.add_argument(
        "--imitate",
        type=int,
        metavar="N",
        help="steps of lessons by the scripted baseline before (default: the preset's)",
    )
    train.add_argument(
        "--curriculum",
        type=float,
        default=1.0,
        metavar="D",
        help="difficulty at the start, rising to 1 (default: 1, none)",
    )
    _add_options(train)
    train.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting of the algorithm, such as batch_size=512",
    )
    train.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="policy, configuration, checkpoints, curves (default: NAME_ALGO_SEED)",
    )
    train.add_argument(
        "--resume", action="store_true", help="resume the training in --out, after a kill or to more --steps"
    )
    _add_trust(train, "--resume: ")

    evaluate = commands.add_parser(
        "evaluate", help="a policy beside the baselines: success, distance, contacts"
    )
    evaluate.add_argument("env", metavar="ENV", help="a task, such as Reach, or FILE.py:Class of your own")
    evaluate.add_argument(
        "policy",
        metavar="POLICY",
        help="a folder of `fastrod train`, `shipped`, or `none` for the baselines alone",
    )
    _add_trust(evaluate)
    evaluate.add_argument(
        "--episodes", type=int, default=100, metavar="N", help="one for each seed (default: 100)"
    )
    evaluate.add_argument(
        "--seed", type=int, default=1000, metavar="S", help="of the first episode (default: 1000)"
    )
    evaluate.add_argument("--no-baselines", action="store_true", help="the policy alone")
    _add_options(evaluate)
    evaluate.add_argument(
        "--out", type=Path, metavar="DIR", help="write evaluation.json and evaluation.png there"
    )
    evaluate.add_argument("--json", action="store_true", help="print the figures to stdout and nothing else")

    _add_generate(
        commands.add_parser(
            "generate",
            help="data sets in Parquet shards: shapes, rollouts, identification sweeps; here or on Ray",
            description="Data sets of any size in Parquet shards, on the cores here or on a Ray cluster. A "
            "run that was killed is "
            "finished by the same command; a larger --count lets a data set grow.",
        )
    )

    bench = commands.add_parser("bench", help="how fast, how accurate, beside what")
    bench.add_argument("name", nargs="?", metavar="NAME", help="one benchmark (default: all)")
    bench.add_argument("--json", action="store_true", help="print JSON to stdout and nothing else")

    warmup = commands.add_parser("warmup", help="compile the kernels now, not in the first step")
    warmup.add_argument(
        "groups",
        nargs="*",
        metavar="GROUP",
        help="rod, contact (with what it needs of the rod), modes (default: all)",
    )
    own.add_commands(commands)
    parser.commands = {action.dest: action.help or "" for action in commands._get_subactions()}
    return parser, list(commands.choices)


def check_drive(arguments: argparse.Namespace) -> None:
    """Raises `UnknownNameError` for an action that there is not, `UsageError` for options of `fastrod drive`
    that do not go together."""
    action = arguments.action
    if action not in ACTIONS:
        raise UnknownNameError(f"no action {action!r} of fastrod drive; {nearest(action, ACTIONS)}")

    def given(name: str) -> bool:
        return getattr(arguments, name) not in (None, False)

    for name, actions in _OF.items():
        if given(name) and action not in actions:
            flag = f"--{name.replace('_', '-')}"
            raise UsageError(
                f"{flag} is not for {action}, but for {', '.join(actions)}; `fastrod drive "
                "--help` says how it is used."
            )
    if action in _MOVING and arguments.emulate == given("bus"):
        raise UsageError(
            "give --bus INTERFACE:CHANNEL or --emulate, and not both; `fastrod drive --help` "
            "says how it is used."
        )
    if given("bus") and ":" not in arguments.bus:
        raise UsageError(f"--bus is {arguments.bus!r}; give INTERFACE:CHANNEL, such as socketcan:can0.")
    for name, emulated in (("camera", False), ("seed", True), ("real_time", True)):
        if given(name) and arguments.emulate != emulated:
            where = "with --emulate only" if emulated else "for a real bench, not with --emulate"
            raise UsageError(
                f"--{name.replace('_', '-')} is {where}; `fastrod drive --help` says how it is used."
            )
    if arguments.camera == "none" and action != "teleop":
        raise UsageError(f"--camera none is for teleop alone; {action} needs a camera.")


def _add_trust(parser: argparse._ActionsContainer, of: str = "") -> None:
    parser.add_argument(
        "--trust",
        action="store_true",
        help=f"{of}read a file of stable-baselines3 where the folder has none of our own; "
        "this runs code of the file's author",
    )


def _add_drive(drive: argparse.ArgumentParser) -> None:
    drive.add_argument(
        "action", nargs="?", default="teleop", metavar="ACTION", help="one of those above (default: teleop)"
    )
    files = (
        "file that excite and track record to, folder of loop, camera file of calibrate, register and latency"
    )
    drive.add_argument("--out", type=Path, metavar="OUT", help=f"{files}; never one that is there already")

    bench = drive.add_argument_group("the bench")
    bench.add_argument("--bus", metavar="INTERFACE:CHANNEL", help="of the drives, such as socketcan:can0")
    bench.add_argument("--emulate", action="store_true", help="the emulator in place of drives and camera")
    bench.add_argument(
        "--hardware",
        type=Path,
        metavar="FILE",
        help="drives, limits, camera and marker (default: the paper's prototype)",
    )
    bench.add_argument(
        "--robot", metavar="R", help="its model in place of the hardware file's; an identified.toml, say"
    )
    bench.add_argument(
        "--no-home",
        action="store_true",
        help="the tendons are taut and zero where they should be; do not wind them",
    )

    bench.add_argument("--eds", type=Path, metavar="FILE", help="EDS or DCF of the drives (default: EPOS4)")

    real = drive.add_argument_group("a real bench")
    real.add_argument(
        "--camera",
        metavar="DEVICE",
        help="number or path of the video device; for teleop also none (default: 0)",
    )

    emulator = drive.add_argument_group("the emulator")
    emulator.add_argument("--seed", type=int, metavar="S", help="of what it hides (default: nobody knows it)")
    emulator.add_argument(
        "--real-time",
        action="store_true",
        help="as slow as a robot, where nobody watches either; teleop always is",
    )

    runs = drive.add_argument_group("track, excite, loop")
    runs.add_argument("--path", metavar="P", help="track: triangle, square or circle (default: circle)")
    runs.add_argument(
        "--policy",
        metavar="POLICY",
        help="track: by a policy of Track, a folder or `shipped` (default: by the model)",
    )
    _add_trust(runs, "track: ")
    runs.add_argument(
        "--payload",
        type=float,
        metavar="KG",
        help="excite, loop: known mass at the tip (default: one that suits)",
    )

    board = drive.add_argument_group("calibrate, register")
    board.add_argument("--views", type=int, metavar="N", help="pictures of the board (default: 25)")
    board.add_argument(
        "--board",
        type=_grid,
        metavar="CxR",
        help="squares side by side, and one below the other (default: 7x5)",
    )
    board.add_argument(
        "--square",
        type=float,
        metavar="M",
        help="side of a square, as measured on the print (default: 0.02 m)",
    )
    board.add_argument(
        "--board-marker", type=float, metavar="M", help="side of a marker in it (default: 0.75 of a square)"
    )
    board.add_argument(
        "--dictionary", metavar="NAME", help="OpenCV's name of its markers (default: DICT_5X5_100)"
    )
    board.add_argument(
        "--at",
        type=float,
        nargs=7,
        action="append",
        metavar=("X", "Y", "Z", "QW", "QX", "QY", "QZ"),
        help="register: where the board is, base_from_board [m] and quaternion; its origin is the outer "
        "corner at the print's top left, "
        "x right, y down, z into the paper. Several times: it is put at one after the other",
    )

    page = drive.add_argument_group("teleop")
    page.add_argument("--port", type=int, metavar="P", help="default: the first free one from 8080 on")
    page.add_argument("--no-open", action="store_true", help="do not open a browser")


def _add_generate(generate: argparse.ArgumentParser) -> None:
    kinds = generate.add_subparsers(dest="kind", required=True, metavar="WHAT", parser_class=_Parser)
    shapes = kinds.add_parser("shapes", help="a robot at rest under random commands and tip forces")
    rollouts = kinds.add_parser(
        "rollouts", help="episodes of an environment, or a robot's own motion with effects drawn anew"
    )
    sweep = kinds.add_parser("sweep", help="robots with a sealed effect, their logs simulated and identified")
    for kind, unit in ((shapes, "rows"), (rollouts, "episodes"), (sweep, "rows")):
        kind.add_argument(
            "--count",
            type=_whole,
            required=True,
            metavar="N",
            help=f"{unit} in all, such as 1e6; it may grow",
        )
        kind.add_argument(
            "--out",
            type=Path,
            required=True,
            metavar="DIR",
            help="folder of plan.json and shards; a run that was cut off is resumed",
        )
        kind.add_argument(
            "--robot",
            required=kind is not rollouts,
            metavar="R",
            help="a shipped robot's name or a path to a .toml",
        )
        where = kind.add_argument_group("where it runs")
        where.add_argument(
            "--workers",
            type=int,
            metavar="N",
            help="processes, or pending tasks on Ray (default: one for each core)",
        )
        where.add_argument(
            "--ray",
            metavar="ADDRESS",
            help="as tasks of this Ray cluster; `auto` for the one here, `local` to start one (needs "
            "fastrod[ray])",
        )
        where.add_argument(
            "--shard-rows",
            type=int,
            metavar="N",
            help=f"{unit} of a file and task (default: some seconds of work)",
        )
        where.add_argument("--json", action="store_true", help="print the summary to stdout and nothing else")
        kind.add_argument(
            "--seed", type=int, default=0, metavar="S", help="of all that is drawn (default: 0)"
        )
    shapes.add_argument(
        "--bend",
        type=float,
        metavar="RAD",
        help="largest bend of a segment, drawn evenly from a disc (default: 1)",
    )
    shapes.add_argument(
        "--force",
        type=float,
        metavar="N",
        help="radius of the ball of tip forces (default: 2 EI/l^2 of the robot)",
    )
    for kind, what in ((shapes, "for the self-weight"), (rollouts, "for self-weight and inertia")):
        kind.add_argument(
            "--line-density",
            type=float,
            metavar="KG/M",
            help=f"{'robot: ' if kind is rollouts else ''}mass per length, {what} (default: the robot's)",
        )
    shapes.add_argument(
        "--tolerance", type=float, metavar="M", help="largest boundary residual (default: 1e-6)"
    )
    shapes.add_argument(
        "--points",
        type=int,
        metavar="K",
        help="backbone positions in a row, the last at the tip (default: none)",
    )
    shapes.add_argument(
        "--points-per-segment", type=int, metavar="N", help="integration steps of a segment (default: 6)"
    )
    shapes.add_argument(
        "--chain",
        type=int,
        metavar="N",
        help="neighbouring rows that are solved one from the other; 1: none (default: 64)",
    )
    rollouts.add_argument("--env", metavar="ENV", help="a task, such as Reach; not with --robot")
    rollouts.add_argument(
        "--policy", metavar="P", help="the policy that acts: shipped, baseline or random (default: random)"
    )
    _add_options(rollouts)
    rollouts.add_argument("--steps", type=int, metavar="N", help="robot: of an episode (default: 200)")
    rollouts.add_argument("--dt", type=float, metavar="S", help="robot: time step (default: 0.02)")
    rollouts.add_argument(
        "--dynamics",
        action="store_const",
        const=True,
        help="robot: with inertia, so that it rings; rows have the tip's velocity, too. It needs a mass: the "
        "robot file's line_density, or --line-density",
    )
    rollouts.add_argument(
        "--bend", type=float, metavar="RAD", help="robot: largest bend of a segment (default: 0.9)"
    )
    rollouts.add_argument(
        "--speed", type=float, metavar="RAD/S", help="robot: largest rate of a bend (default: 1)"
    )
    rollouts.add_argument(
        "--force", type=float, metavar="N", help="robot: radius of the ball of tip forces (default: 0)"
    )
    sweep.add_argument(
        "--noise", type=float, metavar="M", help="of each coordinate of the measured tip (default: 0.0003)"
    )
    sweep.add_argument("--rate", type=float, metavar="HZ", help="samples a second (default: 15)")
    sweep.add_argument("--bend", type=float, metavar="RAD", help="largest bend of a segment (default: 0.9)")
    rollouts.add_argument(
        "--effect",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="robot: drawn for each episode",
    )
    sweep.add_argument(
        "--effect",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="sealed one after the other (default: backlash)",
    )


def _whole(word: str) -> int:
    """1000000, or 1e6."""
    try:
        return int(word)
    except ValueError:
        pass
    try:
        value = float(word)
        if value == int(value):
            return int(value)
    except (ValueError, OverflowError):
        pass
    raise argparse.ArgumentTypeError(f"{word!r} is not a whole number, such as 1000000 or 1e6")


def _grid(word: str) -> tuple[int, int]:
    """7x5 as columns and rows."""
    columns, _, rows = word.partition("x")
    if not (columns.isdigit() and rows.isdigit()):
        raise argparse.ArgumentTypeError(f"{word!r} is not COLUMNSxROWS, such as 7x5")
    return int(columns), int(rows)


def _add_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="of the environment, such as n_steps=1 or randomise=mine.toml",
    )


GROUPS: Mapping[str, tuple[str, ...]] = {
    "look": ("demo", "view"),
    "your robot and your log": ("new", "check", "import", "export"),
    "measure and explain": ("excite", "drive", "identify", "replay"),
    "learn": ("envs", "train", "evaluate"),
    "scale and compare": ("generate", "bench", "warmup"),
}
"""Every command once."""
_EXAMPLES = (
    ("fastrod demo", "excite, identify, plan anew, track, on an emulated robot"),
    ("fastrod view", "a robot in the browser: drag its tip"),
    ("fastrod identify run.csv --robot mine.toml", "what the model lacks, in run_identified/report.html"),
    ("fastrod train Reach --out mine", "a policy; then fastrod evaluate Reach mine"),
)


def overview(helps: Mapping[str, str]) -> str:
    """The whole text, from the one-line help of each command."""
    lines = [
        "usage: fastrod COMMAND [...]",
        "",
        "Tendon-driven continuum robots, simulated in batches and met with measured data.",
    ]
    for title, names in GROUPS.items():
        lines += ["", f"{title}:", *(f"  {name:<10}{helps[name]}" for name in names)]
    width = max(len(line) for line, _ in _EXAMPLES)
    lines += ["", "examples:", *(f"  {line:<{width}}  {what}" for line, what in _EXAMPLES)]
    lines += [
        "",
        "`fastrod COMMAND --help` lists all options of one; `fastrod --version` prints the version.",
        "",
    ]
    return "\n".join(lines)
