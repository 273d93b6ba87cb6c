"""`fastrod drive` through its words: the emulated bench in stepped time, and one sentence for each wrong
use."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fastrod import load_robot
from fastrod.commands import drive
from fastrod.commands.cli import main
from fastrod.logs.reader import read_log
from fastrod_device.bench import boards, workbench
from fastrod_device.can.clock import SteppedClock, WallClock
from fastrod_device.emulator.emulator import Emulator
from fastrod_device.errors import CalibrationError
from fastrod_device.hardware import SHIPPED, load_hardware
from fastrod_device.vision.calibration import CharucoBoard
from fastrod_device.vision.camera import CameraFrame, load_camera

pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'fastrod[envs]'")
EASY, LATE, TAUT = "3", "7", "--no-home"  # seeds: gravity is hidden; a latency is
CAMERA = load_hardware().camera
Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    """`fastrod drive`, or `camera`, with these words in an empty folder: exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "140")

    def run(*words: str) -> tuple[int, str, str]:
        code = main(["camera" if {*words} & {*drive.CAMERA.functions} else "drive", *words])
        out, err = capsys.readouterr()
        return code, out, err

    return run


def off(found: float, true: float, stderr: float) -> float:
    return abs(found - true) / stderr


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found is not None
    return float(found[1])


def rows(text: str) -> dict[str, list[float]]:
    """Numbers of a printed table by their row's name."""
    found = {}
    for line in text.splitlines():
        cells = re.split(r"\s{2,}", line.strip())
        if len(cells) > 3 and re.fullmatch(r"-?[\d.]+", cells[1]):
            found[cells[0]] = [
                float("nan") if re.search("[a-z]", cell) else float(cell) for cell in cells[1:]
            ]
    return found


# ---------------------------------------------------------------- track


@pytest.mark.study
def test_track_by_the_model_and_by_the_policy(run: Run, tmp_path: Path) -> None:
    code, out, err = run("track", "--emulate", "--seed", EASY, TAUT)
    assert (code, err) == (0, "")
    assert "wrote circle.csv" in out
    assert "model" in out
    log = read_log(tmp_path / "circle.csv", load_robot("prototype"))
    assert len(log) > 11.0 * 15.0 - 5
    radius = np.hypot(*log.tip_position[log.measured & (log.t > 3.0) & (log.t < 10.5), :2].T)
    assert np.abs(radius - 0.02).max() < 0.006
    code, out, err = run(
        "track",
        "--emulate",
        "--seed",
        EASY,
        TAUT,
        "--path",
        "square",
        "--policy",
        "shipped",
        "--out",
        "by_policy.csv",
    )
    assert (code, err) == (0, "")
    assert "policy" in out
    assert len(read_log(tmp_path / "by_policy.csv", load_robot("prototype"))) > 11.0 * 15.0 - 5


def test_nothing_is_written_over(run: Run, tmp_path: Path) -> None:
    for name in ("circle.csv", "excite.csv", "camera.toml", "camera_placed.toml"):
        (tmp_path / name).write_text("mine", encoding="utf-8")
    (tmp_path / "loop").mkdir()
    (tmp_path / "loop" / "notes.txt").write_text("mine", encoding="utf-8")
    for action in ("track", "excite", "loop", "calibrate", "register"):
        code, out, err = run(action, "--emulate")
        assert (code, out) == (2, "")
        assert re.search("is there already|is not empty", err)
        assert err.count("\n") == 1
    code, _, err = run("latency", "--emulate", "--out", "camera.toml")
    assert code == 2
    assert "'camera.toml' is there already" in err
    assert all(path.read_text(encoding="utf-8") == "mine" for path in tmp_path.rglob("*.*"))


# ---------------------------------------------------------------- calibrate, register, latency


@pytest.mark.study
def test_calibrate_finds_the_hidden_lens(run: Run, tmp_path: Path) -> None:
    code, out, err = run("calibrate", "--emulate", "--seed", "3", "--views", "12")
    assert (code, err) == (0, "")
    reported = rows(out)
    assert set(reported) == {"fx, px", "fy, px", "cx, px", "cy, px", "k1", "k2", "p1", "p2", "k3"}
    for name in ("fx, px", "fy, px", "cx, px", "cy, px", "k1", "k2", "p1", "p2"):
        found, stderr, _, true = reported[name]
        assert off(found, true, stderr) < 4.0
    # the file's are those of another lens
    assert off(reported["fx, px"][2], reported["fx, px"][3], reported["fx, px"][1]) > 3.0
    assert off(reported["k1"][2], reported["k1"][3], reported["k1"][1]) > 8.0
    assert "12 views used, reprojection error 0." in out
    assert "not at rest" in out
    assert 'camera = "camera.toml"' in out
    camera = load_camera(tmp_path / "camera.toml")
    assert camera.matrix[0][0] == pytest.approx(reported["fx, px"][0], abs=0.006)
    # all but the lens stays
    assert replace(camera, matrix=CAMERA.matrix, distortion=CAMERA.distortion) == CAMERA
    # and the line that it says does it
    text = SHIPPED.read_text(encoding="utf-8")
    text = text[: text.index("[camera]")] + text[text.index("[[drive]]") :]
    (tmp_path / "mine.toml").write_text('camera = "camera.toml"\n' + text, encoding="utf-8")
    code, out, err = run("register", "--emulate", "--seed", "3", "--views", "4", "--hardware", "mine.toml")
    assert (code, err) == (0, "")
    placed = load_camera(tmp_path / "camera_placed.toml")
    assert placed.matrix == camera.matrix
    assert "in mine.toml" in out


@pytest.mark.study
def test_register_finds_the_hidden_place(run: Run, tmp_path: Path) -> None:
    code, out, err = run("register", "--emulate", "--seed", "4", "--views", "16")
    assert (code, err) == (0, "")
    reported = rows(out)
    assert list(reported) == [
        "x, mm",
        "y, mm",
        "z, mm",
        *(f"turned about the camera's {axis}, deg" for axis in "xyz"),
    ]
    for found, stderr, _, true in reported.values():
        assert off(found, true, stderr) < 4.0
    assert max(off(file, true, stderr) for _, stderr, file, true in reported.values()) > 10.0
    assert "16 views used" in out
    camera = load_camera(tmp_path / "camera_placed.toml")
    assert 1e3 * camera.position[2] == pytest.approx(reported["z, mm"][0], abs=6e-4)
    assert replace(camera, position=CAMERA.position, quaternion=CAMERA.quaternion) == CAMERA


@pytest.mark.study
def test_register_at_places_that_are_given(run: Run) -> None:
    board = CharucoBoard(columns=5, rows=4, square=0.02, marker=0.014)
    place = [f"{number:.6f}" for part in boards.fixtures(CAMERA, board)[0] for number in part]
    board_words = ("--board", "5x4", "--board-marker", "0.014")
    code, out, err = run("register", "--emulate", "--seed", "4", "--views", "5", *board_words, "--at", *place)
    assert (code, err) == (0, "")
    assert "5 views used" in out
    # a board that nobody can see there
    code, out, err = run(
        "register", "--emulate", "--out", "none.toml", "--at", "2", "2", "2", "1", "0", "0", "0"
    )
    assert code == 1
    assert re.fullmatch(
        r"no picture of the board could be taken in 60 s; frames passed over: \d+ no board "
        r"seen\.\n",
        err,
    )


def test_register_with_a_real_camera_asks_for_each_place(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    board = CharucoBoard(columns=7, rows=5, square=0.02, marker=0.015)
    truth = boards.moved(CAMERA, 9)
    eye = boards.BoardEye(truth, board, clock=WallClock(), seed=1)
    eye.place(*boards.fixtures(CAMERA, board)[1])
    opened, asked = [], []
    monkeypatch.setattr(
        workbench, "VideoCamera", lambda camera, device: opened.append((camera, device)) or eye
    )
    monkeypatch.setattr("builtins.input", asked.append)
    place = [f"{number:.6f}" for part in boards.fixtures(CAMERA, board)[1] for number in part]
    code, out, err = run("register", "--camera", "2", "--views", "2", "--at", *place)
    assert (code, err) == (0, "")
    assert opened == [(CAMERA, 2)]
    assert len(asked) == 1
    assert "Please fix the board at base_from_board" in asked[0]
    assert "true" not in out


@pytest.mark.study
@pytest.mark.parametrize("seed", [EASY, LATE])
def test_latency(run: Run, tmp_path: Path, seed: str) -> None:
    code, out, err = run("latency", "--emulate", "--seed", seed, TAUT, "--out", "camera.toml")
    assert (code, err) == (0, "")
    found, stderr, hidden = (
        number(rf"{words} (-?[\d.]+)", out) for words in ("seen", "standard error", "hidden in the emulator:")
    )
    assert abs(found - hidden) < 4.0 * stderr + 5.0
    assert load_camera(tmp_path / "camera.toml").latency == pytest.approx(0.03 + 1e-3 * found, abs=2e-4)


# ---------------------------------------------------------------- pictures of a board


@pytest.mark.study
def test_pictures_that_are_collected_differ() -> None:
    board = CharucoBoard(columns=7, rows=5, square=0.02, marker=0.015)
    clock = SteppedClock()
    eye = boards.BoardEye(CAMERA, board, clock=clock, seed=2)
    eye.place(*boards.fixtures(CAMERA, board)[0])
    still = boards.collect(eye, board, 3, clock, patience=1.0)
    assert len(still.pictures) == 1  # a board at rest is one view, however long one looks
    assert still.passed["like one that was taken"] > 5
    assert boards.collect(eye, board, 3, clock, apart=0.0, patience=1.0).passed == {"not at rest": 1}
    eye.wave()
    reported: list[int] = []
    waved = boards.collect(eye, board, 4, clock, progress=lambda _, done, total: reported.append(done))
    assert reported == [1, 2, 3, 4]
    assert waved.passed["not at rest"] > 4
    with pytest.raises(
        CalibrationError,
        match=r"no picture of the board could be taken in 0\.5 s; frames "
        r"passed over: .* no board seen",
    ):
        boards.collect(
            eye,
            CharucoBoard(columns=7, rows=5, square=0.02, marker=0.015, dictionary="DICT_7X7_50"),
            1,
            clock,
            patience=0.5,
        )


# ---------------------------------------------------------------- wrong uses

WRONG = {
    "": "give --bus INTERFACE:CHANNEL or --emulate, and not both",
    "fly --emulate": "no action 'fly' of fastrod drive; known: excite",
    "trak --emulate": "did you mean 'track'?",
    "--seed loop --emulate": "--seed: 'loop' is not a whole number",
    "track --emulate --bus socketcan:can0": "give --bus INTERFACE:CHANNEL or --emulate, and not both",
    "track --emulate --path hexagon": "no path 'hexagon'; known: circle, square, triangle.",
    "track --emulate --policy nowhere": "'nowhere' holds no policy",
    "track --emulate --out run.txt": "'run.txt' does not end in .csv or .parquet",
    "track --emulate --out there/run.csv": "folder 'there' is not there",
    "track --emulate --views 3": "fastrod drive track does not know '--views'",
    "track --emulate --robot prototyp": "no robot 'prototyp'; did you mean 'prototype'?",
    "track --emulate --robot tdcr_a": "there are 4 drives and robot 'tdcr_a' has 6 tendons.",
    "excite --emulate --camera 1": "--camera is for a real bench, not with --emulate",
    "excite --emulate --eds none.eds": "the EDS file none.eds cannot be read: No such file",
    "excite --bus can0": "--bus is 'can0'; give INTERFACE:CHANNEL, such as socketcan:can0.",
    "excite --bus socketcan:can0 --seed 1": "--seed is with --emulate only",
    "excite --bus socketcan:can0 --camera none": "--camera none is for teleop alone; all else needs",
    "loop --bus socketcan:can0 --camera none": "all else needs a camera",
    "loop --emulate --policy shipped": "fastrod drive loop does not know '--policy'",
    "loop --emulate --hardware none.toml": "hardware file 'none.toml' cannot be read",
    "teleop --emulate --out x.csv": "fastrod drive teleop does not know '--out'",
    "calibrate --bus socketcan:can0": "fastrod camera calibrate does not know '--bus'",
    "calibrate --emulate --views 4": "--views is 4; calibrate needs 5 or more.",
    "calibrate --emulate --board seven": "'seven' is not COLUMNSxROWS, such as 7x5",
    "calibrate --emulate --board 2x5": "CharucoBoard has 2 x 5 squares",
    "calibrate --emulate --square 20": "CharucoBoard.marker is 15.0 m, square 20.0 m",
    "calibrate --emulate --dictionary DICT_5X5_10": "did you mean 'DICT_5X5_100'?",
    "calibrate --emulate --out camera.csv": "does not end in .toml",
    "calibrate --emulate --seed -1": "seed is -1; it must be a whole number, zero or positive",
    "register --camera 1": "say where the board is, base_from_board: --at X Y Z QW QX QY QZ",
    "register --emulate --at 1 2 3": "argument --at: expected 7 arguments",
    "register --emulate --at 20 0 0 1 0 0 0": "the board is more than 3 m away. Was it given in mm?",
    "register --emulate --at 0 0 0 1 1 0 0": "a quaternion w x y z of norm 1",
    "latency --emulate --no-open": "fastrod drive latency does not know '--no-open'",
}


@pytest.mark.parametrize("words", WRONG)
def test_a_wrong_use_is_one_sentence(words: str, run: Run, tmp_path: Path) -> None:
    code, out, err = run(*words.split())
    assert code == 2
    assert out == ""
    assert WRONG[words] in err
    assert err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_a_bench_that_is_not_there_failed(run: Run, tmp_path: Path) -> None:
    code, out, err = run("latency", "--bus", "virtual:nobody-is-there", "--camera", str(tmp_path / "none"))
    assert code == 1
    assert out == ""
    assert "cannot be opened; is it plugged in" in err.splitlines()[-1]


@pytest.mark.study
def test_what_was_recorded_before_a_stop_is_told(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    look = Emulator.read

    def covered(emulator: Emulator) -> CameraFrame | None:
        emulator.hidden = emulator.clock.now() > 4.0
        return look(emulator)

    monkeypatch.setattr(Emulator, "read", covered)
    code, out, err = run("track", "--emulate", TAUT, "--seed", EASY)
    assert code == 1
    assert err.count("\n") == 1
    assert out == "what was recorded until then is in circle.csv\n"
    log = read_log(tmp_path / "circle.csv", load_robot("prototype"))
    assert 2.0 < log.t[-1] < 4.6
    assert (tmp_path / "circle.events.csv").read_text(encoding="utf-8").count("\n") > 0


@pytest.mark.parametrize("group", ["drive", "camera"])
def test_help_names_every_action(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main([group, "--help"])
    text = capsys.readouterr().out
    assert left.value.code == 0
    actions = (drive.DRIVE if group == "drive" else drive.CAMERA).functions
    assert all(re.search(rf"^  {name} +\w.*$", text, re.M) for name in actions)
    assert "exit code:" in text
