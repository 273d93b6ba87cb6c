"""Any words at all behind `fastrod`: exit code 2 and one sentence, and nothing begins."""

from __future__ import annotations

import io
import os
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

import pytest
from fuzz.strategies import odd_words, tried
from hypothesis import given
from hypothesis import strategies as st

from fastrod.commands import cli
from fastrod.commands.drive import CAMERA, DRIVE

ACTIONS = [*DRIVE.functions, *CAMERA.functions]
OPTIONS = (
    "--out --seed --no-view --robot --run --held-out --max-effects --free-camera --network --json --bend "
    "--payload --rate --speed --robots --play --port --host --no-open --option --algo --steps --envs "
    "--imitate --curriculum --set --resume --episodes --no-baselines --bus --emulate --hardware --camera "
    "--eds --path --policy --views --board --square --at --dictionary --board-marker --real-time --no-home"
)
VALUES = "1 -1 0 nan inf 1e400 7x5 x none socketcan:can0 prototype none.csv a=b = -- - ."
# no shell can give a NUL
words = st.sampled_from([*OPTIONS.split(), *ACTIONS, *VALUES.split()])
words |= odd_words.filter(lambda word: "\0" not in word)


class BegunError(Exception):
    """A command was taken, and its work would begin."""


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("words")


def answered(*given_: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command line."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            code = cli.main(given_)
        except SystemExit as end:  # --help and --version print, and are done
            assert any(word.startswith(("-h", "--h", "--v")) for word in given_)
            code = int(end.code or 0)
    return code, out.getvalue(), err.getvalue()


def begin(*_: object, **__: object) -> int:
    raise BegunError


@pytest.mark.study
@tried(150)
@given(command=st.sampled_from([*cli.COMMANDS]) | odd_words, rest=st.lists(words, max_size=5))
def test_words_are_a_command_or_a_sentence(command: str, rest: list[str]) -> None:
    """The words alone: no command does its work."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "call", begin)
        try:
            code, _, err = answered(command, *rest)
        except BegunError:
            return
    assert code in (0, 2)
    if code:
        assert err.count("\n") == 1, err
        assert "Traceback" not in err


@tried(60)
@given(command=st.sampled_from(["replay", "identify"]), rest=st.lists(words, min_size=1, max_size=4))
@pytest.mark.study
def test_logs_that_are_not_there_are_refused(elsewhere: Path, command: str, rest: list[str]) -> None:
    before = Path.cwd()
    os.chdir(elsewhere)
    try:
        code, _, err = answered(command, *rest, "none.csv")
        assert code == 2 or any(word.startswith(("-h", "--h")) for word in rest)
        assert code == 0 or err.count("\n") == 1, err
        assert not list(elsewhere.iterdir())
    finally:
        os.chdir(before)


BAD = ["nan", "-1", "inf", "1e9"]


@tried(40)
@given(
    bend=st.sampled_from(["nan", "inf", "-1", "0", "50", "1e400", "1e-300", "x"]),
    rate=st.sampled_from(["nan", "inf", "-1", "0", "1e9", "1e-9", "x"]),
    other=st.sampled_from(["", *(f"--payload {p}" for p in BAD[:4]), "--speed 0", "--speed nan"]),
)
def test_a_run_that_nobody_could_drive_is_refused(elsewhere: Path, bend: str, rate: str, other: str) -> None:
    line = f"excite --robot prototype --bend {bend} --rate {rate} --out"
    code, _, err = answered(*line.split(), str(elsewhere / "run.csv"), *other.split())
    assert code == 2
    assert err.count("\n") == 1, err
    assert not list(elsewhere.iterdir())


@tried(60)
@given(rest=st.lists(words, max_size=5), action=st.sampled_from(sorted(ACTIONS)) | odd_words)
def test_a_bench_that_is_not_there_is_refused(rest: list[str], action: str) -> None:
    """`fastrod drive`, up to where a bench would be looked for."""
    from fastrod.commands import drive as driving

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(driving, "_hardware", begin)
        try:
            code, _, err = answered("camera" if action in CAMERA.functions else "drive", action, *rest)
        except BegunError:
            return
    assert code in (0, 2)
    assert code == 0 or err.count("\n") == 1, err


@tried(20)
@given(
    command=st.sampled_from(["envs", "evaluate"]),
    env=odd_words | st.sampled_from(["Reach", "Raech", "fastrod/Reach-v0"]),
    rest=st.lists(words, max_size=3),
)
def test_an_environment_that_is_not_is_refused(command: str, env: str, rest: list[str]) -> None:
    if command == "evaluate":
        from fastrod_envs.learning import evaluation

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(evaluation, "evaluate", begin)
            try:
                code, _, err = answered(command, env, *rest)
            except BegunError:
                return
    else:
        code, _, err = answered(command, env, *rest)
    assert code in (0, 2)
    assert code == 0 or err.count("\n") == 1, err
