"""The words of the `fastrod` command: its parser, and nothing of what the words do."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NoReturn

ACTIONS = ("teleop", "excite", "track", "loop", "calibrate", "register")
"""What `fastrod drive` can do."""


class UsageError(Exception):
    """What argparse would have printed over several lines."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; `{self.prog} --help` says how it is used.")


class _Version(argparse.Action):
    """Prints the version; looked up only then, so that no other command waits for it."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> NoReturn:
        from importlib.metadata import version

        print(f"{parser.prog} {version('fastrod')}")
        parser.exit()


def build() -> tuple[argparse.ArgumentParser, list[str]]:
    """The parser, and the names of its commands."""
    parser = _Parser(prog="fastrod", description="Tendon-driven continuum robots, simulated in batches and met with measured data.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", parser_class=_Parser)

    demo = commands.add_parser("demo", help="the main job on an embedded default, start to end")
    demo.add_argument("--out", type=Path, metavar="DIR", help="where logs and report go (default: a folder of its own)")
    demo.add_argument("--seed", type=int, metavar="S", help="of what the emulator hides (default: nobody knows it)")
    demo.add_argument("--no-view", action="store_true", help="end with the report; do not serve the viewer")

    replay = commands.add_parser("replay", help="the model beside a measurement: residual table and plot")
    replay.add_argument("log", type=Path, metavar="LOG", help="run log (.csv or .parquet), or the raw file of a measured set")
    replay.add_argument("--robot", metavar="R", help="a shipped robot's name or a path to a .toml; a measured set brings its own")
    replay.add_argument("--run", metavar="RUN", help="only this run of the log")
    replay.add_argument("--out", type=Path, metavar="DIR", help="where residuals.csv and replay.png go (default: LOG's name + _replay)")

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

    excite = commands.add_parser("excite", help="write the run that separates effects, to be driven and measured")
    excite.add_argument("--robot", required=True, metavar="R", help="a shipped robot's name or a path to a .toml")
    excite.add_argument("--out", type=Path, metavar="FILE", help="the run log, .csv or .parquet (default: NAME_excitation.csv)")
    excite.add_argument("--bend", type=float, default=0.9, metavar="RAD", help="largest bend of a segment (default: 0.9)")
    excite.add_argument("--payload", type=float, metavar="KG", help="known mass at the tip, on and off (default: F l^2/EI = 1)")
    excite.add_argument("--rate", type=float, default=15.0, metavar="HZ", help="samples a second (default: 15)")
    excite.add_argument("--speed", type=float, default=1.0, metavar="RAD/S", help="of the triangles (default: 1)")

    view = commands.add_parser("view", help="viewer and teleop in the browser, or a log beside the model")
    view.add_argument("what", nargs="?", metavar="WHAT", help="a scene, a robot (name or .toml), or a run log (default: a robot to try)")
    view.add_argument("--robot", metavar="R", help="whose log it is: a shipped robot's name or a path to a .toml")
    view.add_argument("--robots", type=int, default=1, metavar="N", help="so many of the robot, in a grid, driven alike (default: 1)")
    view.add_argument("--play", action="store_true", help="begin with the robot's demo motion; scenes always begin with their script")
    view.add_argument("--port", type=int, metavar="P", help="default: the first free one from 8080 on")
    view.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen on (default: 127.0.0.1, this machine alone)")
    view.add_argument("--no-open", action="store_true", help="do not open a browser")

    drive = commands.add_parser("drive", help="the prototype, or its emulator: by hand, through a run, along a path, or the whole loop")
    drive.add_argument("action", nargs="?", default="teleop", metavar="ACTION", help=f"{', '.join(ACTIONS)} (default: teleop)")
    drive.add_argument("--bus", metavar="INTERFACE:CHANNEL", help="of the drives, such as socketcan:can0")
    drive.add_argument("--emulate", action="store_true", help="the emulator in place of drives and camera")
    drive.add_argument("--hardware", type=Path, metavar="FILE", help="drives, limits, camera and marker (default: the paper's prototype)")
    drive.add_argument("--robot", metavar="R", help="its model in place of the hardware file's; an identified.toml, say")
    drive.add_argument("--eds", type=Path, metavar="FILE", help="the drives' object dictionary (default: built in)")
    drive.add_argument("--camera", default="0", metavar="DEVICE", help="number or path of the video device, or none (default: 0)")
    drive.add_argument("--seed", type=int, metavar="S", help="of what the emulator hides (default: nobody knows it)")
    drive.add_argument("--real-time", action="store_true", help="an emulator as slow as a robot, where nobody watches either")
    drive.add_argument("--path", metavar="P", help="track: triangle, square or circle (default: circle)")
    drive.add_argument("--policy", metavar="POLICY", help="track: by a policy of Track, a folder or `shipped` (default: by the model)")
    drive.add_argument("--payload", type=float, metavar="KG", help="known mass of excite and loop (default: one that suits)")
    drive.add_argument("--views", type=int, default=25, metavar="N", help="calibrate, register: pictures of the board (default: 25)")
    drive.add_argument("--out", type=Path, metavar="OUT", help="file that excite and track record to, folder of loop")
    drive.add_argument("--port", type=int, metavar="P", help="teleop: default the first free one from 8080 on")
    drive.add_argument("--no-open", action="store_true", help="teleop: do not open a browser")
    drive.add_argument("--no-home", action="store_true", help="the wires are taut and zero where they should be; do not wind them")

    envs = commands.add_parser("envs", help="the environments; of one, its task, observation, action and options")
    envs.add_argument("env", nargs="?", metavar="ENV", help="a task, such as Reach or fastrod/Reach-v0 (default: a line for each)")
    _add_options(envs)

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

    evaluate = commands.add_parser("evaluate", help="a policy beside the baselines: success, distance, contacts")
    evaluate.add_argument("env", metavar="ENV", help="a task, such as Reach or fastrod/Reach-v0")
    evaluate.add_argument("policy", metavar="POLICY", help="a folder of `fastrod train`, `shipped`, or `none` for the baselines alone")
    evaluate.add_argument("--episodes", type=int, default=100, metavar="N", help="one for each seed (default: 100)")
    evaluate.add_argument("--seed", type=int, default=1000, metavar="S", help="of the first episode (default: 1000)")
    evaluate.add_argument("--no-baselines", action="store_true", help="the policy alone")
    _add_options(evaluate)
    evaluate.add_argument("--out", type=Path, metavar="DIR", help="write evaluation.json and evaluation.png there")
    evaluate.add_argument("--json", action="store_true", help="print the figures to stdout and nothing else")

    bench = commands.add_parser("bench", help="the figures of perf/ as ratios")
    bench.add_argument("name", nargs="?", metavar="NAME", help="one benchmark (default: all)")
    bench.add_argument("--json", action="store_true", help="print JSON to stdout and nothing else")
    return parser, list(commands.choices)


def _add_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        "--option", action="append", default=[], metavar="NAME=VALUE", help="of the environment, such as n_steps=1 or randomise=mine.toml"
    )
