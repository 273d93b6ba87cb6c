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

from fastrod.commands import cli, terminal
from fastrod.errors import InputError
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import write_log
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot

HEADER = "t,run,dl_1,dl_2,dl_3,dl_4,tip_x,tip_y,tip_z\n"
LOG = HEADER + "0,a,0,0,0,0,0,0,0.07\n0.1,a,0,0,0,0,0.001,0,0.07\n0,b,0,0,0,0,0,0,0.07\n"


Captured, Patch = pytest.CaptureFixture[str], pytest.MonkeyPatch


def fastrod(line: str) -> int:
    """The exit code of the command with these words."""
    return cli.main(line.split())


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.csv"
    path.write_text(LOG)
    return path


@pytest.fixture
def straight(monkeypatch: Patch) -> None:
    """A simulator whose robots stay straight: the words are tested without the model."""

    class Straight:
        def __init__(self, robot: Robot, n_robots: int) -> None:
            self.tip = np.tile((0.0, 0.0, robot.length), (n_robots, 1))

        def settle(self, **given: Any) -> SimpleNamespace:
            return SimpleNamespace(tip_position=self.tip, ok=np.ones(len(self.tip), dtype=bool))

    monkeypatch.setitem(sys.modules, "fastrod.simulator", SimpleNamespace(Simulator=Straight))


def refused(capsys: Captured, line: str) -> str:
    """The sentence on stderr of a command line that must exit with 2 and print nothing else."""
    assert fastrod(line) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1, err
    assert "Traceback" not in err
    assert not err.startswith("fastrod:")
    return err


@pytest.mark.study
@pytest.mark.usefixtures("straight")
def test_replay_prints_the_table_and_names_its_files(log: Path, tmp_path: Path, capsys: Captured) -> None:
    out = tmp_path / "out"
    assert fastrod(f"replay {log} --robot prototype --out {out}") == 0
    printed, err = capsys.readouterr()
    for word in ("excursion", str(out / "residuals.csv"), str(out / "replay.png")):
        assert word in printed
    assert err == ""
    assert sorted(path.name for path in out.iterdir()) == ["replay.png", "residuals.csv"]


@pytest.mark.study
@pytest.mark.usefixtures("straight")
def test_replay_of_one_run_into_the_default_folder(log: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    monkeypatch.chdir(tmp_path)
    assert fastrod(f"replay {log} --robot prototype --run b") == 0
    assert len((tmp_path / "log_replay" / "residuals.csv").read_text().splitlines()) == 2


@pytest.mark.study
@pytest.mark.usefixtures("straight")
def test_replay_knows_a_measured_set_by_its_header(tmp_path: Path, capsys: Captured) -> None:
    path = tmp_path / "raw.csv"
    path.write_text(
        "row,l1_mm,l2_mm,l3_mm,x_mm,y_mm,z_mm,glitch,after_jump\n"
        "0,0,0,0.1,-43,-144,276,0,0\n1,0,4,0,-42,-136,305,0,0\n"
    )
    assert fastrod(f"replay {path} --out {tmp_path / 'out'}") == 0
    assert "armlab_tdcr" in capsys.readouterr().out
    sentence = refused(capsys, f"replay {path} --robot prototype")
    assert "robot 'prototype' has 4 tendons, the one of raw.csv has 3" in sentence


@pytest.mark.usefixtures("straight")
def test_replay_that_converges_nowhere_has_failed(
    log: Path, tmp_path: Path, monkeypatch: Patch, capsys: Captured
) -> None:
    def settle(self: Any, **given: Any) -> SimpleNamespace:
        return SimpleNamespace(tip_position=self.tip, ok=np.zeros(len(self.tip), dtype=bool))

    monkeypatch.setattr(sys.modules["fastrod.simulator"].Simulator, "settle", settle)
    assert fastrod(f"replay {log} --robot prototype --out {tmp_path / 'out'}") == 1
    assert capsys.readouterr().err == "the model converged on none of the 3 rows.\n"


@pytest.mark.usefixtures("straight")
@pytest.mark.parametrize("command", ["replay LOG --robot prototype", "demo"])
@pytest.mark.parametrize(("below", "why"), [("", "it is a file"), ("/below", "Not a directory")])
def test_folder_that_cannot_be_written_is_refused_before_the_work(
    log: Path, monkeypatch: Patch, capsys: Captured, command: str, below: str, why: str
) -> None:
    for work in ("fastrod.identification.log.replay.replay", "fastrod.commands.demo._batch"):
        monkeypatch.setattr(work, lambda *args, **given: pytest.fail("the work began"))
    sentence = refused(capsys, f"{command} --out {log}{below}".replace("LOG", str(log)))
    assert sentence == f"folder '{log}{below}' cannot be written: {why}.\n"


@pytest.mark.usefixtures("straight")
def test_file_that_cannot_be_written_has_failed(log: Path, tmp_path: Path, capsys: Captured) -> None:
    taken = tmp_path / "out" / "residuals.csv.part"
    taken.mkdir(parents=True)
    assert fastrod(f"replay {log} --robot prototype --out {taken.parent}") == 1
    assert capsys.readouterr().err == f"{taken}: Is a directory.\n"


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with backlash, as a file."""
    path = tmp_path_factory.mktemp("log") / "small.csv"
    write_log(backlash_log(), path)
    return path


@pytest.mark.study
def test_identify_prints_the_verdict_and_names_its_files(
    measured: Path, tmp_path: Path, capsys: Captured
) -> None:
    out = tmp_path / "out"
    # A log behind --held-out is a log all the same.
    line = f"identify --robot prototype --max-effects 1 --out {out} --held-out two {measured}"
    assert fastrod(line) == 0
    printed, err = capsys.readouterr()
    assert err == ""
    for word in ("backlash", "half width", "noise floor", "held out", f"{out}/report.html"):
        assert word in printed
    assert str(out / "identified.toml") in printed
    assert json.loads((out / "report.json").read_text())["held_out"] == ["two"]


@pytest.mark.study
def test_identify_json_prints_json_and_nothing_else(
    measured: Path, tmp_path: Path, monkeypatch: Patch, capsys: Captured
) -> None:
    monkeypatch.chdir(tmp_path)
    line = f"identify {measured} --robot prototype --held-out two three@8: --max-effects 0 --json"
    assert fastrod(line) == 0
    printed, err = capsys.readouterr()
    assert json.loads(printed)["held_out"] == ["two", "three@8:"]
    assert err == ""
    assert not list(tmp_path.iterdir())


def test_identify_takes_several_logs_and_the_default_folder(
    measured: Path, tmp_path: Path, monkeypatch: Patch, capsys: Captured
) -> None:
    seen: dict[str, Any] = {}

    def stand_in(logs: Any, robot: Robot, **given: Any) -> Any:
        seen.update(given, names=[log.name for log in logs], folder=Path("small_identified").is_dir())
        given["progress"]("base fit: 0.3 mm left", 0, 4)
        raise InputError("seen enough.")

    monkeypatch.setattr("fastrod.identification.attribution.identify", stand_in)
    monkeypatch.chdir(tmp_path)
    other = tmp_path / "other.csv"
    other.write_bytes(measured.read_bytes())
    assert fastrod(f"identify {measured} --robot prototype {other} --free-camera --max-effects 2") == 2
    assert seen["names"] == ["small", "other"]
    assert [seen[name] for name in ("held_out", "max_effects", "free_camera")] == [[], 2, True]
    assert capsys.readouterr().err == "seen enough.\n"  # short work says nothing where nobody looks on
    monkeypatch.setattr(terminal, "_PATIENCE", 0.0)
    assert fastrod(f"identify {measured} --robot prototype --max-effects 0") == 2
    assert capsys.readouterr().err == "0 s, 0 of 4: base fit: 0.3 mm left\nseen enough.\n"
    assert seen["folder"]  # made before the long work, and gone where nothing came of it
    assert not (tmp_path / "small_identified").exists()


def test_excite_writes_a_run_to_be_driven(tmp_path: Path, monkeypatch: Patch, capsys: Captured) -> None:
    monkeypatch.chdir(tmp_path)
    assert fastrod("excite --robot prototype --bend 0.5 --rate 10") == 0
    assert "step and hold" in capsys.readouterr().out
    path = tmp_path / "prototype_excitation.csv"
    assert path.read_text().startswith("# Inputs of a run that separates effects")
    log = read_log(path, load_robot("prototype"))
    assert log.payload is not None
    assert (log.payload.max(), np.isnan(log.tip_position).all()) == (0.046, True)  # F l^2 / EI = 1
    assert log.t[1] == pytest.approx(0.1)


def test_version_is_that_of_the_package(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as end:
        fastrod("--version")
    assert not end.value.code
    assert capsys.readouterr().out == f"fastrod {version('fastrod')}\n"


MISSING = "the following arguments are required: "
NOT_SAID = "log.csv is a run log and does not say whose; name its robot with --robot."
IDENTIFY = "identify LOG --robot prototype "
WRONG = {
    "no command": ("", MISSING + "COMMAND"),
    "unknown command": ("repaly", "no command 'repaly'; did you mean 'replay'?"),
    "unknown option": ("demo --xyz", "fastrod demo does not know '--xyz'; `fastrod demo --help` lists them."),
    "like an option": ("demo --sede=1", "fastrod demo does not know '--sede=1'; did you mean '--seed'?"),
    "like none of all": ("--verison", "fastrod does not know '--verison'; did you mean '--version'?"),
    "no action": ("generate --count 3", "fastrod generate needs an action; known: rollouts, shapes, sweep."),
    "no log": ("replay", MISSING + "LOG"),
    "log not there": (
        "replay none.csv --robot prototype",
        "log 'none.csv' cannot be read: No such file or directory.",
    ),
    "unknown robot": ("replay LOG --robot prototpye", "no robot 'prototpye'; did you mean 'prototype'?"),
    "no robot": ("replay LOG", NOT_SAID),
    "unknown run": ("replay LOG --robot prototype --run c", "no run 'c' in log 'log'; known: a, b."),
    "other robot": (
        "replay LOG --robot tdcr_a",
        "has 4 dl_ columns (dl_1 to dl_4); robot 'tdcr_a' has 6 tendons",
    ),
    "identify: no log": ("identify --robot prototype", MISSING + "LOG"),
    "identify: no robot": ("identify LOG", NOT_SAID),
    "identify: unknown option": (IDENTIFY + "--jsn", "fastrod identify does not know '--jsn'"),
    "identify: short log": (IDENTIFY + "--json", "has 3 measured rows; identification needs 40"),
    "identify: the same log twice": ("identify LOG LOG --robot prototype --json", "two logs are named 'log'"),
    "identify: effects": (IDENTIFY + "--json --max-effects -1", "max_effects is -1"),
    "identify: folder": (IDENTIFY + "--out LOG", "cannot be written: it is a file."),
    "excite: no robot": ("excite", MISSING + "--robot"),
    "excite: bend": ("excite --robot prototype --bend 50", "Was it given in degrees?"),
    "excite: text": ("excite --robot prototype --rate fast", "invalid float value: 'fast'"),
    "excite: suffix": (
        "excite --robot prototype --out run.txt",
        "'run.txt' does not end in .csv or .parquet",
    ),
    "bench option": ("bench --jsno", "fastrod bench does not know '--jsno'"),
}


@pytest.mark.parametrize("case", WRONG)
def test_wrong_input_is_one_sentence_and_code_2(log: Path, capsys: Captured, case: str) -> None:
    line, sentence = WRONG[case]
    assert sentence in refused(capsys, line.replace("LOG", str(log)))


BAD_CELLS = {
    "text in a number": (LOG.replace("0.001", "left"), "log.csv row 2, column tip_x is 'left'"),
    "millimetres": (LOG.replace("0.001", "1000"), "Was it given in mm, or in cm?"),
    "empty": ("", "log.csv is empty"),
    "column name over two lines": (
        't,"zz\nyy"\n0,0\n',
        "lacks columns tip_x, tip_y, tip_z that every run log has; its columns are t, zz yy.",
    ),
    "nothing measured": (HEADER + "0,a,0,0,0,0,,,\n", "there is nothing to compare"),
}


@pytest.mark.parametrize("case", BAD_CELLS)
def test_bad_log_is_one_sentence_and_code_2(log: Path, capsys: Captured, case: str) -> None:
    text, sentence = BAD_CELLS[case]
    log.write_text(text)
    assert sentence in refused(capsys, f"replay {log} --robot prototype")


def test_run_of_a_log_without_runs(log: Path, capsys: Captured) -> None:
    log.write_text("t,dl_1,dl_2,dl_3,dl_4,tip_x,tip_y,tip_z\n0,0,0,0,0,0,0,0.07\n")
    sentence = refused(capsys, f"replay {log} --robot prototype --run zz")
    assert sentence == "no run 'zz'; log 'log' names no runs.\n"


def test_bad_robot_file_is_one_sentence_and_code_2(log: Path, tmp_path: Path, capsys: Captured) -> None:
    robot = tmp_path / "robot.toml"
    robot.write_text('name = "x"\n[[segmnt]]\n')
    assert "did you mean 'segment'?" in refused(capsys, f"replay {log} --robot {robot}")


def test_bench_runs_the_scripts_of_perf(tmp_path: Path, monkeypatch: Patch, capsys: Captured) -> None:
    for name, figure in (("step", 1), ("settle", 2)):
        printed = f"'{{\"ratio\": {figure}}}' if argv == ['--json'] else 'ratio {figure}'"
        (tmp_path / f"bench_{name}.py").write_text(f"def main(argv):\n    print({printed})\n    return 0\n")
    monkeypatch.setattr(cli, "_PERF", tmp_path)
    assert fastrod("bench step") == 0
    assert capsys.readouterr().out == "ratio 1\n"
    assert fastrod("bench --json") == 0
    assert json.loads(capsys.readouterr().out) == {"settle": {"ratio": 2}, "step": {"ratio": 1}}
    assert "no benchmark 'stepp'; did you mean 'step'?" in refused(capsys, "bench stepp")
    monkeypatch.setattr(cli, "_PERF", tmp_path / "absent")
    assert "fastrod bench needs the source checkout" in refused(capsys, "bench")
    (tmp_path / "pyproject.toml").touch()
    assert f"no benchmarks are in {str(tmp_path / 'absent')!r}" in refused(capsys, "bench")


def test_help_has_every_command_once(capsys: Captured) -> None:
    with pytest.raises(SystemExit) as end:
        fastrod("--help")
    assert not end.value.code
    said = capsys.readouterr().out
    parser = cli.build()
    commands, _, examples = (
        [line.strip() for line in half.splitlines() if line.startswith("  ")]
        for half in said.partition("examples:")
    )
    assert sorted(line.split()[0] for line in commands) == sorted(cli.COMMANDS)
    assert max(map(len, said.splitlines())) <= 120
    for example in examples:
        assert parser.parse_known_args(example.split("  ")[0].split()[1:])[1] == []


def test_help_does_not_load_numba() -> None:
    code = (
        "import sys; from fastrod.commands.cli import main\ntry: main(['--help'])\n"
        "except SystemExit as end: assert not end.code\nassert 'numba' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "replay" in done.stdout


SEED = 5
"""Seed of the emulator's hidden effects."""


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The whole demo, once: its folder and what it printed."""
    out, printed = tmp_path_factory.mktemp("demo") / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert fastrod(f"demo --seed {SEED} --no-view --out {out}") == 0
    return out, printed.getvalue()


@pytest.mark.study
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


@pytest.mark.study
def test_demo_leaves_what_it_says(demo: tuple[Path, str]) -> None:
    out, printed = demo
    for name in ("report.json", "report.html", "identified.toml", "loop.json", "tracking.png"):
        assert (out / name).stat().st_size > 100
        assert f"wrote {out / name}" in printed
    found = load_robot(out / "identified.toml")
    named = [effect["name"] for effect in json.loads((out / "report.json").read_text())["effects"]]
    # beside them the zeros of the tendons, which homing does not know better than it says
    assert {table["name"] for table in found.effects} == {*named, "encoder_offset"}
    driven = {f"{path}_{when}" for path in ("triangle", "square", "circle") for when in ("before", "after")}
    assert sorted(path.stem for path in out.glob("*.csv")) == sorted(driven | {"excite"})
    assert not list(out.glob("*.part"))
    assert read_log(out / "excite.csv", found).measured.mean() > 0.98


@pytest.mark.study
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
    tmp_path: Path, monkeypatch: Patch, capsys: Captured
) -> None:
    monkeypatch.setattr("fastrod.commands.demo._batch", lambda *args: pytest.fail("the work began"))
    (tmp_path / "mine.csv").write_text("t\n")
    assert "is not empty" in refused(capsys, f"demo --out {tmp_path}")
    assert (tmp_path / "mine.csv").read_text() == "t\n"


@pytest.fixture
def no_device(monkeypatch: Patch) -> None:
    """The demo without the device wing, and without its batch."""
    monkeypatch.setattr("fastrod.commands.demo._batch", lambda *args: None)
    monkeypatch.setattr("fastrod.commands.demo.find_spec", lambda name: None)


@pytest.mark.study
@pytest.mark.usefixtures("no_device")
def test_demo_without_the_device_wing_names_what_was_sealed_into_its_log(
    tmp_path: Path, capsys: Captured
) -> None:
    assert fastrod(f"demo --out {tmp_path / 'out'}") == 0
    printed, err = capsys.readouterr()
    assert err == ""
    made = json.loads((tmp_path / "out" / "report.json").read_text())
    assert made["effects"][0]["name"] == "friction"
    assert made["verdict"] in ("explained", "ambiguous")
    assert made["error"]["held_out"]["after_rms_m"] < 1.15 * made["noise_floor_m"]
    assert "friction" in printed
    assert f"wrote {tmp_path / 'out' / 'report.html'}" in printed


@pytest.mark.usefixtures("no_device")
def test_demo_without_the_device_wing_takes_the_shipped_log_and_writes_nothing(
    tmp_path: Path, monkeypatch: Patch, capsys: Captured
) -> None:
    """The words around the work; the work on that log is above."""
    seen: list[int] = []
    identify = "fastrod.identification.attribution.identify"
    monkeypatch.setattr(identify, lambda log, robot: seen.append(len(log)) or "a result")
    monkeypatch.setattr("fastrod.identification.report.report.table", str)
    monkeypatch.chdir(tmp_path)
    assert fastrod("demo") == 0
    printed = capsys.readouterr().out
    assert "a result" in printed
    assert "pip install 'fastrod[device,viewer]'" in printed
    assert "wrote" not in printed
    assert seen[0] > 2000
    assert not list(tmp_path.iterdir())
