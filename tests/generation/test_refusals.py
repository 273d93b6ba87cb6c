"""Data sets that cannot be made: one sentence, and no folder."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from generation_folders import small

from fastrod import load_robot
from fastrod.commands import cli
from fastrod.errors import FastrodError, InputError, RobotError, UnknownNameError
from fastrod.generation import Plan, Rollouts, Shapes, Sweep, Trajectories, generate
from fastrod.model.robotfile import dumps

SHAPES = "shapes --robot prototype --count 600 --shard-rows 50 --seed 3"
NO_WHOLE = (
    "is not a whole number, such as 1000000 or 1e6; `fastrod generate shapes --help` says how it is used."
)
OF_WHAT = "rollouts are of an environment or of a robot's own motion; give --env ENV or --robot R."

COMMANDS = {
    f"{SHAPES} --count 1e6.5": f"argument --count: '1e6.5' {NO_WHOLE}",
    f"{SHAPES} --count 0.5": f"argument --count: '0.5' {NO_WHOLE}",
    f"{SHAPES} --xyz": (
        "fastrod generate shapes does not know '--xyz'; `fastrod generate shapes --help` lists them."
    ),
    f"{SHAPES} --count 0": "count is 0; it must be a whole number from 1 to 1000000000000.",
    f"{SHAPES} --seed -1": "seed is -1; it must be a whole number from 0 to 9223372036854775808.",
    f"{SHAPES} --shard-rows 0": "--shard-rows is 0; it must be a whole number, at least 1.",
    f"{SHAPES} --workers 0": "workers is 0; it must be a whole number from 1 to 4096.",
    f"{SHAPES} --force -1": "--force is -1.0 N; it must be a number, zero or positive and finite.",
    f"{SHAPES} --robot protoype": "no robot 'protoype'; did you mean 'prototype'? A path must end in .toml.",
    SHAPES.replace("shapes", "shape"): "no action 'shape' of fastrod generate; did you mean 'shapes'?",
    "xyz": "no action 'xyz' of fastrod generate; known: rollouts, shapes, sweep.",
    "rollouts --seed 0": OF_WHAT,
    "rollouts --env Reach --robot prototype": OF_WHAT,
    "rollouts --robot prototype --policy random": (
        "--policy and --option are of an environment; with --robot the commands are random."
    ),
    "rollouts --env Reach --steps 3": (
        "--steps is of a robot's own motion; with --env give --option NAME=VALUE, such as n_steps=100."
    ),
    "rollouts --env Reech": "no environment 'Reech'; did you mean 'Reach'?",
    "rollouts --env Reach --policy shiped": "no policy 'shiped' to roll out; did you mean 'shipped'?",
    "rollouts --env Reach --option n_stepz=3": "no option 'n_stepz'; did you mean 'n_steps'?",
    "rollouts --robot prototype --effect backlsh": "no effect 'backlsh'; did you mean 'backlash'?",
    "sweep --robot ethz_beam": "robot 'ethz_beam' has no tendons; there is nothing to excite.",
    "sweep --robot prototype --noise 2": "noise is 2.0 m; it must be a number from 0 to 1 m.",
}


@pytest.mark.parametrize("line", COMMANDS)
def test_a_wrong_command_is_one_sentence(
    line: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    kind, *words = line.split()
    assert cli.main(["generate", kind, *(["--count", "1", "--out", "out"] if words else []), *words]) == 2
    assert capsys.readouterr() == ("", f"{COMMANDS[line]}\n")
    assert not list(tmp_path.iterdir())


PROTOTYPE = load_robot("prototype")
PLAIN = dumps(PROTOTYPE)
(SEGMENT,) = PROTOTYPE.segments
WORN = dumps(replace(PROTOTYPE, effects=({"name": "backlash", "half_width": 1e-4},)))
PASSIVE = dumps(replace(PROTOTYPE, segments=(replace(SEGMENT, mode="passive", tendons=()),)))
PAIRS = "give pairs of name and value, such as (('n_steps', 100),)."
SEVERAL = dumps(load_robot("five_segment_reacher"))


def exactly(sentence: str) -> str:
    return f"^{re.escape(sentence)}$"


def reach(**given: Any) -> object:
    return Rollouts(**{"env": "Reach", **given})


CALLS: list[tuple[type[FastrodError], Callable[[Path], object], str]] = [
    (
        InputError,
        lambda _: Plan(work=3, count=1),
        exactly("work is 3; give Shapes, Rollouts, Trajectories, Sweep."),
    ),
    (
        InputError,
        lambda _: Shapes(robot=5),
        exactly("robot is 5; give the text of a robot file, such as fastrod.model.robotfile.dumps(robot)."),
    ),
    (InputError, lambda _: Shapes(robot=PROTOTYPE), r"^robot is Robot\("),
    (
        InputError,
        lambda _: Sweep(robot=PLAIN, effects="backlash"),
        r"^effects are 'backlash'; give a tuple of names, such as \(",
    ),
    (
        InputError,
        lambda _: Trajectories(robot=PLAIN, effects=(3,)),
        r"^effects are \(3,\); give a tuple of names, such as \(",
    ),
    (InputError, lambda path: generate(3, path), exactly("plan is 3; give a fastrod.generation.Plan.")),
    (InputError, lambda _: generate(small(), None), "^folder is None; give a path."),
    (
        InputError,
        lambda path: generate(small(), path, ray=True),
        "^ray is True; give the address of a cluster, 'auto' for the one here, or",
    ),
    (InputError, lambda _: reach(options={"n_steps": 5}), exactly("options are {'n_steps': 5}; " + PAIRS)),
    (InputError, lambda _: reach(options=("a",)), exactly("options are ('a',); " + PAIRS)),
    (InputError, lambda _: reach(options=3), exactly("options are 3; " + PAIRS)),
    (
        InputError,
        lambda _: reach(policy=None),
        exactly("no policy None to roll out; known: baseline, random, shipped."),
    ),
    (InputError, lambda _: reach(env=None), exactly("env is None; give a task's name, such as 'Reach'.")),
    (
        InputError,
        lambda _: reach(options=(("randomise", 5),)),
        exactly("randomise is 5; give a Randomisation, a robot file, or a mapping of names to ranges."),
    ),
    (
        InputError,
        lambda _: reach(options=(("n_steps", {1}),)),
        exactly("option 'n_steps' is {1}; a plan holds finite numbers, words, lists and mappings."),
    ),
    (
        InputError,
        lambda _: Sweep(robot=PLAIN, effects=()),
        "a sweep has no effects; name one, such as backlash",
    ),
    (
        UnknownNameError,
        lambda _: Sweep(robot=PLAIN, effects=("frction",)),
        "no effect 'frction'; did you mean 'friction'",
    ),
    (
        InputError,
        lambda _: Sweep(robot=WORN),
        "has effects already; a sweep seals its own into a plain robot",
    ),
    (InputError, lambda _: Shapes(robot=WORN), "has effects; a shape is that of the plain rod"),
    (RobotError, lambda _: Shapes(robot=PASSIVE), "an action needs tendons driven by length"),
    *(
        (InputError, lambda _, given=given: Shapes(robot=SEVERAL, **given), exactly(sentence))
        for given, sentence in (
            ({"bend": 0.0}, "bend is 0.0 rad; it must be a number between 0 and 3 rad."),
            (
                {"points": 4},
                "points is 4; the rod has 30 steps, of which they must be an even fraction, such as 3.",
            ),
        )
    ),
]


@pytest.mark.parametrize(("kind", "call", "sentence"), CALLS, ids=[row[2][:40] for row in CALLS])
def test_a_wrong_call_is_one_sentence(
    kind: type[FastrodError], call: Callable[[Path], object], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(kind, match=sentence) as error:
        call(tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()
