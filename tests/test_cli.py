"""The command line: exit codes, and one sentence on stderr for each bad input."""

from __future__ import annotations

import contextlib
import io
import json
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from reportlog import backlash_log

from fastrod.commands import cli
from fastrod.errors import InputError
from fastrod.logs.runlog import read_log, write_log
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot

HEADER = "t,run,dl_1,dl_2,dl_3,dl_4,tip_x,tip_y,tip_z\n"
LOG = HEADER + "0,a,0,0,0,0,0,0,0.07\n0.1,a,0,0,0,0,0.001,0,0.07\n0,b,0,0,0,0,0,0,0.07\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(LOG)
    return path


@pytest.fixture
def straight(monkeypatch: pytest.MonkeyPatch) -> None:
    """A simulator whose robots stay straight, so that the words of the command line are tested without the
    model."""

    class Straight:
        def __init__(self, robot: Robot, n_robots: int) -> None:
            self.tip = np.tile((0.0, 0.0, robot.length), (n_robots, 1))

        def settle(self, **given: Any) -> SimpleNamespace:
            return SimpleNamespace(tip_position=self.tip, ok=np.ones(len(self.tip), dtype=bool))

    monkeypatch.setitem(sys.modules, "fastrod.simulator", SimpleNamespace(Simulator=Straight))


def refused(capsys: pytest.CaptureFixture[str], *argv: str) -> str:
    """The sentence on stderr of a command line that must exit with 2 and print nothing else."""
    assert cli.main(argv) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    assert not err.startswith("fastrod:")
    return err


@pytest.mark.usefixtures("straight")
def test_replay_prints_the_table_and_names_its_files(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert cli.main(["replay", str(log), "--robot", "prototype", "--out", str(out)]) == 0
    printed, err = capsys.readouterr()
    assert "excursion" in printed
    assert str(out / "residuals.csv") in printed
    assert str(out / "replay.png") in printed
    assert err == ""
    assert sorted(path.name for path in out.iterdir()) == ["replay.png", "residuals.csv"]


@pytest.mark.usefixtures("straight")
def test_replay_of_one_run_into_the_default_folder(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["replay", str(log), "--robot", "prototype", "--run", "b"]) == 0
    assert len((tmp_path / "log_replay" / "residuals.csv").read_text().splitlines()) == 2


@pytest.mark.usefixtures("straight")
def test_replay_knows_a_measured_set_by_its_header(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "raw.csv"
    path.write_text(
        "row,l1_mm,l2_mm,l3_mm,x_mm,y_mm,z_mm,glitch,after_jump\n"
        "0,0,0,0.1,-43,-144,276,0,0\n1,0,4,0,-42,-136,305,0,0\n"
    )
    assert cli.main(["replay", str(path), "--out", str(tmp_path / "out")]) == 0
    assert "armlab_tdcr" in capsys.readouterr().out
    assert "robot 'prototype' has 4 tendons, the one of raw.csv has 3" in refused(
        capsys, "replay", str(path), "--robot", "prototype"
    )


@pytest.mark.usefixtures("straight")
def test_replay_that_converges_nowhere_has_failed(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def settle(self: Any, **given: Any) -> SimpleNamespace:
        return SimpleNamespace(tip_position=self.tip, ok=np.zeros(len(self.tip), dtype=bool))

    monkeypatch.setattr(sys.modules["fastrod.simulator"].Simulator, "settle", settle)
    assert cli.main(["replay", str(log), "--robot", "prototype", "--out", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == "the model converged on none of the 3 rows.\n"


@pytest.mark.usefixtures("straight")
def test_folder_that_cannot_be_written_is_refused_before_the_work(
    log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(*args: Any, **given: Any) -> None:
        raise AssertionError("the work began")

    monkeypatch.setattr("fastrod.identification.log.replay.replay", work)
    monkeypatch.setattr("fastrod.commands.demo._batch", work)
    for command in (("replay", str(log), "--robot", "prototype"), ("demo",)):
        assert refused(capsys, *command, "--out", str(log)) == (
            f"folder {str(log)!r} cannot be written: it is a file.\n"
        )
        below = log / "below"
        assert refused(capsys, *command, "--out", str(below)) == (
            f"folder {str(below)!r} cannot be written: Not a directory.\n"
        )


@pytest.mark.usefixtures("straight")
def test_file_that_cannot_be_written_has_failed(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "out" / "residuals.csv.part").mkdir(parents=True)
    assert cli.main(["replay", str(log), "--robot", "prototype", "--out", str(tmp_path / "out")]) == 1
    assert capsys.readouterr().err == f"{tmp_path / 'out' / 'residuals.csv.part'}: Is a directory.\n"


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with backlash, as a file."""
    path = tmp_path_factory.mktemp("log") / "small.csv"
    write_log(backlash_log(), path)
    return path


def test_identify_prints_the_verdict_and_names_its_files(
    measured: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    # A log behind --held-out is a log all the same.
    words = [
        "identify",
        "--robot",
        "prototype",
        "--max-effects",
        "1",
        "--out",
        str(out),
        "--held-out",
        "two",
        str(measured),
    ]
    assert cli.main(words) == 0
    printed, err = capsys.readouterr()
    assert err == ""
    for word in (
        "backlash",
        "half width",
        "noise floor",
        "held out",
        str(out / "report.html"),
        str(out / "identified.toml"),
    ):
        assert word in printed
    assert json.loads((out / "report.json").read_text())["held_out"] == ["two"]


def test_identify_json_prints_json_and_nothing_else(
    measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert (
        cli.main(
            [
                "identify",
                str(measured),
                "--robot",
                "prototype",
                "--held-out",
                "two",
                "three@8:",
                "--max-effects",
                "0",
                "--json",
            ]
        )
        == 0
    )
    printed, err = capsys.readouterr()
    assert json.loads(printed)["held_out"] == ["two", "three@8:"]
    assert err == ""
    assert not list(tmp_path.iterdir())


def test_identify_takes_several_logs_and_the_default_folder(
    measured: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: dict[str, Any] = {}

    def stand_in(logs: Any, robot: Robot, **given: Any) -> Any:
        seen.update(given, names=[log.name for log in logs], folder=Path("small_identified").is_dir())
        raise InputError("seen enough.")

    monkeypatch.setattr("fastrod.identification.attribution.identify", stand_in)
    monkeypatch.chdir(tmp_path)
    other = tmp_path / "other.csv"
    other.write_bytes(measured.read_bytes())
    assert (
        cli.main(
            [
                "identify",
                str(measured),
                "--robot",
                "prototype",
                str(other),
                "--free-camera",
                "--max-effects",
                "2",
            ]
        )
        == 2
    )
    assert seen["names"] == ["small", "other"]
    assert (seen["held_out"], seen["max_effects"], seen["free_camera"], seen["progress"]) == (
        [],
        2,
        True,
        None,
    )
    assert seen["folder"]  # made before the long work, and gone where nothing came of it
    assert not (tmp_path / "small_identified").exists()


def test_excite_writes_a_run_to_be_driven(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["excite", "--robot", "prototype", "--bend", "0.5", "--rate", "10"]) == 0
    assert "step and hold" in capsys.readouterr().out
    path = tmp_path / "prototype_excitation.csv"
    assert path.read_text().startswith("# Inputs of a run that separates effects")
    log = read_log(path, load_robot("prototype"))
    assert log.payload is not None
    assert (log.payload.max(), np.isnan(log.tip_position).all()) == (0.046, True)  # F l^2 / EI = 1
    assert log.t[1] == pytest.approx(0.1)


def test_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        cli.main(["--version"])
    assert not end.value.code
    assert capsys.readouterr().out == f"fastrod {version('fastrod')}\n"


WRONG = {
    "no command": ([], "the following arguments are required: COMMAND"),
    "unknown command": (["repaly"], "no command 'repaly'; did you mean 'replay'?"),
    "unknown option": (["demo", "--speed"], "fastrod demo does not know '--speed'"),
    "no log": (["replay"], "the following arguments are required: LOG"),
    "log not there": (
        ["replay", "none.csv", "--robot", "prototype"],
        "log 'none.csv' cannot be read: No such file or directory.",
    ),
    "unknown robot": (
        ["replay", "LOG", "--robot", "prototpye"],
        "no robot 'prototpye'; did you mean 'prototype'?",
    ),
    "no robot": (
        ["replay", "LOG"],
        "log.csv is a run log and does not say whose; name its robot with --robot.",
    ),
    "unknown run": (
        ["replay", "LOG", "--robot", "prototype", "--run", "c"],
        "no run 'c' in log 'log'; known: a, b.",
    ),
    "other robot": (
        ["replay", "LOG", "--robot", "tdcr_a"],
        "has 4 dl_ columns (dl_1 to dl_4); robot 'tdcr_a' has 6 tendons",
    ),
    "identify: no log": (["identify", "--robot", "prototype"], "the following arguments are required: LOG"),
    "identify: no robot": (
        ["identify", "LOG"],
        "log.csv is a run log and does not say whose; name its robot with --robot.",
    ),
    "identify: unknown option": (
        ["identify", "LOG", "--robot", "prototype", "--jsn"],
        "fastrod identify does not know '--jsn'",
    ),
    "identify: short log": (
        ["identify", "LOG", "--robot", "prototype", "--json"],
        "has 3 measured rows; identification needs 40",
    ),
    "identify: the same log twice": (
        ["identify", "LOG", "LOG", "--robot", "prototype", "--json"],
        "two logs are named 'log'",
    ),
    "identify: effects": (
        ["identify", "LOG", "--robot", "prototype", "--json", "--max-effects", "-1"],
        "max_effects is -1",
    ),
    "identify: folder": (
        ["identify", "LOG", "--robot", "prototype", "--out", "LOG"],
        "cannot be written: it is a file.",
    ),
    "excite: no robot": (["excite"], "the following arguments are required: --robot"),
    "excite: bend": (["excite", "--robot", "prototype", "--bend", "50"], "Was it given in degrees?"),
    "excite: text": (["excite", "--robot", "prototype", "--rate", "fast"], "invalid float value: 'fast'"),
    "excite: suffix": (
        ["excite", "--robot", "prototype", "--out", "run.txt"],
        "'run.txt' does not end in .csv or .parquet",
    ),
    "bench option": (["bench", "--jsno"], "fastrod bench does not know '--jsno'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence_and_code_2(
    log: Path, capsys: pytest.CaptureFixture[str], case: str
) -> None:
    argv, sentence = WRONG[case]
    assert sentence in refused(capsys, *(str(log) if word == "LOG" else word for word in argv))


BAD_CELLS = {
    "text in a number": (LOG.replace("0.001", "left"), "log.csv row 2, column tip_x is 'left'"),
    "millimetres": (LOG.replace("0.001", "1000"), "Was it given in mm?"),
    "empty": ("", "log.csv is empty"),
    "column name over two lines": (
        't,"zz\nyy"\n0,0\n',
        "lacks columns tip_x, tip_y, tip_z that every run log has; its columns are t, zz yy.",
    ),
    "nothing measured": (HEADER + "0,a,0,0,0,0,,,\n", "there is nothing to compare"),
}


@pytest.mark.parametrize("case", BAD_CELLS)
def test_bad_log_is_one_sentence_and_code_2(log: Path, capsys: pytest.CaptureFixture[str], case: str) -> None:
    text, sentence = BAD_CELLS[case]
    log.write_text(text)
    assert sentence in refused(capsys, "replay", str(log), "--robot", "prototype")


def test_bad_robot_file_is_one_sentence_and_code_2(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = tmp_path / "robot.toml"
    robot.write_text('name = "x"\n[[segmnt]]\n')
    assert "did you mean 'segment'?" in refused(capsys, "replay", str(log), "--robot", str(robot))


def test_bench_runs_the_scripts_of_perf(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, figure in (("step", 1), ("settle", 2)):
        text = (
            f"def main(argv):\n    print('{{\"ratio\": {figure}}}' if argv == ['--json'] else 'ratio "
            f"{figure}')\n    return 0\n"
        )
        (tmp_path / f"bench_{name}.py").write_text(text)
    monkeypatch.setattr(cli, "_PERF", tmp_path)
    assert cli.main(["bench", "step"]) == 0
    assert capsys.readouterr().out == "ratio 1\n"
    assert cli.main(["bench", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"settle": {"ratio": 2}, "step": {"ratio": 1}}
    assert "no benchmark 'stepp'; did you mean 'step'?" in refused(capsys, "bench", "stepp")
    monkeypatch.setattr(cli, "_PERF", tmp_path / "absent")
    assert "fastrod bench needs the source checkout" in refused(capsys, "bench")
    (tmp_path / "pyproject.toml").touch()
    assert f"no benchmarks are in {str(tmp_path / 'absent')!r}" in refused(capsys, "bench")


def test_run_of_a_log_without_runs(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log.write_text("t,dl_1,dl_2,dl_3,dl_4,tip_x,tip_y,tip_z\n0,0,0,0,0,0,0,0.07\n")
    sentence = refused(capsys, "replay", str(log), "--robot", "prototype", "--run", "zz")
    assert sentence == "no run 'zz'; log 'log' names no runs.\n"


def test_help_has_every_command_once(capsys: pytest.CaptureFixture[str]) -> None:
    from fastrod.commands.arguments import build

    with pytest.raises(SystemExit) as end:
        cli.main(["--help"])
    assert not end.value.code
    said = capsys.readouterr().out
    parser, names = build()
    lines = [line.split()[0] for line in said.partition("examples:")[0].splitlines() if line.startswith("  ")]
    assert sorted(lines) == sorted(names)
    assert max(map(len, said.splitlines())) <= 120
    for example in [
        line.strip().split("  ")[0]
        for line in said.partition("examples:")[2].splitlines()
        if line.startswith("  ")
    ]:
        assert parser.parse_known_args(example.split()[1:])[1] == []


def test_help_does_not_load_numba() -> None:
    code = (
        "import sys; from fastrod.commands.cli import main\ntry: main(['--help'])\nexcept SystemExit as "
        "end: assert not end.code\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code + "assert 'numba' not in sys.modules"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "replay" in done.stdout


SEED = 5
"""Of what the emulator of these tests hides."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The whole demo, once: its folder and what it printed."""
    out, printed = tmp_path_factory.mktemp("demo") / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert cli.main(["demo", "--seed", str(SEED), "--no-view", "--out", str(out)]) == 0
    return out, printed.getvalue()


def test_demo_names_what_was_sealed_into_its_emulator(demo: tuple[Path, str]) -> None:
    out, printed = demo
    made, loop = (json.loads((out / name).read_text()) for name in ("report.json", "loop.json"))
    (sealed,) = loop["sealed"]
    first = made["effects"][0]
    assert sealed in (first["name"], *first["cannot_be_told_from"])
    assert made["verdict"] in ("explained", "ambiguous")
    assert made["error"]["held_out"]["after_rms_m"] < 1.3 * made["noise_floor_m"]
    assert "1000 of 1000 converged" in printed
    assert sealed.replace("_", " ") in printed
    assert printed.index("what the model lacked") < printed.index("the seal, opened now")
    assert "the run beside both models, in a browser: fastrod view" in printed


def test_demo_leaves_what_it_says(demo: tuple[Path, str]) -> None:
    out, printed = demo
    for name in ("report.json", "report.html", "identified.toml", "loop.json", "tracking.png"):
        assert (out / name).stat().st_size > 100
        assert f"wrote {out / name}" in printed
    found = load_robot(out / "identified.toml")
    named = [effect["name"] for effect in json.loads((out / "report.json").read_text())["effects"]]
    # beside them the zeros of the wires, which homing does not know better than it says
    assert {table["name"] for table in found.effects} == {*named, "encoder_offset"}
    runs = sorted(path.stem for path in out.glob("*.csv"))
    assert runs == sorted(
        [
            "excite",
            *(f"{path}_{when}" for path in ("triangle", "square", "circle") for when in ("before", "after")),
        ]
    )
    assert not list(out.glob("*.part"))
    assert read_log(out / "excite.csv", found).measured.mean() > 0.98


def test_tracking_is_nearer_to_the_path_with_what_was_found(demo: tuple[Path, str]) -> None:
    out, _ = demo
    loop = json.loads((out / "loop.json").read_text())
    assert set(loop["tracking"]) == {"triangle", "square", "circle"}
    noise = loop["noise_floor_m"]
    for runs in loop["tracking"].values():
        # what is left when the camera's noise is taken off, and what there was
        left, was = (
            np.sqrt(max(runs[when]["distance_rms_m"] ** 2 - noise**2, 0.0)) for when in ("after", "before")
        )
        assert left <= 0.5 * was
        assert np.all(np.array(runs["after"]["rms_m"]) <= np.array(runs["after"]["floor_rms_m"]) + 7e-4)


def test_demo_refuses_a_folder_that_is_not_empty(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fastrod.commands.demo._batch", lambda *args: pytest.fail("the work began"))
    (tmp_path / "mine.csv").write_text("t\n")
    assert "is not empty" in refused(capsys, "demo", "--out", str(tmp_path))
    assert (tmp_path / "mine.csv").read_text() == "t\n"


def test_demo_without_the_device_wing_names_what_was_sealed_into_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("fastrod.commands.demo._batch", lambda *args: None)
    monkeypatch.setattr("fastrod.commands.demo.find_spec", lambda name: None)
    assert cli.main(["demo", "--out", str(tmp_path / "out")]) == 0
    printed, err = capsys.readouterr()
    assert err == ""
    made = json.loads((tmp_path / "out" / "report.json").read_text())
    assert made["effects"][0]["name"] == "friction"
    assert made["verdict"] in ("explained", "ambiguous")
    assert made["error"]["held_out"]["after_rms_m"] < 1.15 * made["noise_floor_m"]
    assert "friction" in printed
    assert f"wrote {tmp_path / 'out' / 'report.html'}" in printed


def test_demo_without_the_device_wing_takes_the_shipped_log_and_writes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The words around the work; the work on that log is above."""
    seen: list[int] = []

    def stand_in(log: Any, robot: Robot) -> Any:
        seen.append(len(log))
        return "a result"

    monkeypatch.setattr("fastrod.commands.demo._batch", lambda *args: None)
    monkeypatch.setattr("fastrod.commands.demo.find_spec", lambda name: None)
    monkeypatch.setattr("fastrod.identification.attribution.identify", stand_in)
    monkeypatch.setattr("fastrod.identification.report.report.table", str)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["demo"]) == 0
    printed = capsys.readouterr().out
    assert "a result" in printed
    assert "pip install 'fastrod[device,viewer]'" in printed
    assert "wrote" not in printed
    assert seen[0] > 2000
    assert not list(tmp_path.iterdir())
