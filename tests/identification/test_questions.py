"""Questions of `identify` and `replay` on a log of another camera, of mixed-up inputs or another unit."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import farlog
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fastrod import load_robot
from fastrod.commands.cli import main
from fastrod.effects.base import get_effect
from fastrod.errors import LogError
from fastrod.identification.attribution import identify
from fastrod.identification.log.questions import questions
from fastrod.identification.log.registration import align, between
from fastrod.identification.log.replay import replay
from fastrod.identification.report import report
from fastrod.identification.report.result import Result
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog
from fastrod.model.robotfile import loads
from fastrod.rotation import quaternion_from_matrix

ROBOT = loads(farlog.TOML)
TURN, SHIFT = farlog.camera(0.6, 0.34)
HALF = np.diag([-1.0, -1.0, 1.0])
RIGHT = re.escape(
    "Are the units, the signs (negative = pulled) and the order of the dl_ columns right, and "
    "is it this robot?"
)


def log_of(run: farlog.Run, **columns: Any) -> RunLog:
    given = {"name": "far", "t": run.t, "run": np.full(len(run.t), ""), "dl": run.dl, "tip_position": run.tip}
    return RunLog(**given | columns)


@cache
def seen(angle: float = 0.0, distance: float = 0.0) -> RunLog:
    """The run as a camera sees it that is turned [rad] and moved [m]."""
    rotation, shift = farlog.camera(angle, distance)
    return log_of(farlog.log(900, rotation=rotation, shift=shift))


def order(*columns: int) -> Callable[[], RunLog]:
    return lambda: replace(seen(), dl=seen().dl[:, list(columns)])


def scaled(factor: float) -> Callable[[], RunLog]:
    return lambda: replace(seen(), dl=factor * seen().dl)


def mirrored(matrix: list[list[float]], log: Callable[[], RunLog] = seen) -> Callable[[], RunLog]:
    return lambda: replace(log(), tip_position=log().tip_position @ np.array(matrix).T)


# Rough registration


CLOUDS = {
    "a bowl": lambda u, v: np.column_stack([u, v, -0.5 * (u**2 + v**2)]),
    "a plane": lambda u, v: np.column_stack([u, 0.3 * v, 0.0 * u]),
    "an arc": lambda u, v: np.column_stack([u, 0.0 * u, -2.0 * u**2]),
}


@pytest.mark.parametrize("cloud", CLOUDS)
@pytest.mark.parametrize("angle", [0.6, 3.0, np.pi])
def test_points_in_space_or_in_a_plane_tell_any_rotation(cloud: str, angle: float) -> None:
    rng = np.random.default_rng(2)
    points = 0.05 * CLOUDS[cloud](*rng.uniform(-1.0, 1.0, (2, 400)))
    rotation, shift = farlog.camera(angle, 0.34)
    measured = points @ rotation.T + shift + 3e-4 * rng.normal(size=points.shape)
    measured[::11] += 0.2 * rng.normal(size=measured[::11].shape)  # outliers
    found = align(measured, points)
    # the pull towards no rotation is a thousandth of the spread: of an arc, some hundredths
    assert Rotation.from_matrix(found.rotation @ rotation.T).magnitude() < 0.03
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert np.linalg.norm(found.shift - shift) < 2e-3


@pytest.mark.parametrize("turn", [0.0, 0.6])
def test_points_on_a_line_tell_no_rotation_about_it(turn: float) -> None:
    """About another axis the line follows, about itself nothing; with orientations all is known."""
    rng = np.random.default_rng(5)
    points = np.column_stack([rng.uniform(-0.05, 0.05, 300), np.zeros(300), np.full(300, 0.07)])
    rotation = Rotation.from_rotvec([0.0, turn, 0.0]).as_matrix()
    measured = points @ rotation.T + 3e-4 * rng.normal(size=points.shape)
    found = align(measured, points)
    assert np.allclose(found.rotation, rotation, atol=0.03)
    spun = rotation @ Rotation.from_rotvec([1.1, 0.0, 0.0]).as_matrix()
    measured = points @ spun.T + 3e-4 * rng.normal(size=points.shape)
    turns = np.broadcast_to(spun, (300, 3, 3))
    assert np.allclose(align(measured, points, rotations=turns, lever=0.03).rotation, spun, atol=0.03)


def test_a_file_that_has_a_camera_gets_one_registration_on_the_other() -> None:
    known = replace(ROBOT, effects=({"name": "registration", "rotation_z": 0.4, "shift_x": 0.1},))
    found = align(seen(0.6, 0.34).tip_position, seen().tip_position)
    twice = found.on(known)
    (table,) = twice.effects
    assert table["name"] == "frame_misalignment"
    again = between(known, twice)
    assert (again.angle, again.distance) == (pytest.approx(found.angle), pytest.approx(found.distance))


# identify


@cache
def identified(angle: float, distance: float, *, prior: bool = False) -> Result:
    robot = replace(ROBOT, sensor={"registration_sd": (0.5, 1.0)}) if prior else ROBOT
    return identify(seen(angle, distance), robot, threads=1)


@pytest.mark.study
@pytest.mark.parametrize(("angle", "distance"), [(0.6, 0.34), (3.0, 1.0)])
def test_a_camera_far_off_is_registered_and_the_effect_named_as_ever(
    angle: float, distance: float, tmp_path: Path
) -> None:
    result = identified(angle, distance)
    assert result.registration is not None
    assert result.registration.angle == pytest.approx(angle, abs=0.02)
    assert result.registration.distance == pytest.approx(distance, abs=3e-3)
    place = f"{np.degrees(result.registration.angle):.1f} deg and {result.registration.distance:.2g} m"
    assert f"The camera stands {place} from where the robot" in result.summary
    assert report.to_json(result)["registration"]["angle_rad"] == result.registration.angle
    assert result.effects[0].name in ("backlash", "friction")  # friction without spread is backlash
    width = result.effects[0].parameters["half_width"]
    assert width.value == pytest.approx(farlog.PLAY, rel=0.03)
    # arcs are no rods of Kirchhoff: measured 1.40 without coupling, and 1.00 with it
    assert result.test.after < 1.5 * result.noise.floor < 0.2 * result.test.before
    paths = {path.name: path for path in report.write(result, tmp_path)}
    again = replay(seen(angle, distance), load_robot(paths["identified.toml"]))
    rms = np.sqrt((again.residual[result.tested] ** 2).sum(1).mean())
    assert rms == pytest.approx(result.test.after, rel=0.01)
    assert again.questions == ()


@pytest.mark.study
def test_it_takes_no_more_than_with_the_right_prior() -> None:
    """Batches of the rod, which are the work."""
    far, prior = identified(0.6, 0.34), identified(0.6, 0.34, prior=True)
    assert far.solves < 1.5 * prior.solves
    # coupling is what the arcs of this log look like, and so is a wave, which has no name: rounding says
    # which, by the kernels of the BLAS
    assert (far.effects[0].name, [e.name for e in prior.effects]) == ("backlash", ["backlash", "coupling"])
    assert max(far.test.after / 1.5 / far.noise.floor, prior.test.after / 1.1 / prior.noise.floor) < 1.0


REFUSED = {
    "signs": (
        lambda: replace(seen(), dl=-seen().dl),
        rf"it moves -0\.\d+ times as predicted\. {RIGHT} .* "
        r"the sign of every dl_ reversed",
    ),
    "half a turn": (
        lambda: log_of(farlog.log(900, rotation=HALF)),
        r"A camera turned by 1[78]\d deg would look the same: if yours is",
    ),
    "columns moved on": (
        order(1, 2, 0, 4, 5, 3),
        rf"{RIGHT} .* the dl_ columns in the order 3, 1, 2, 6, 4, 5",
    ),
    "left-handed": (
        mirrored([[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
        "In a left-handed frame the model would follow",
    ),
    "x and y exchanged": (
        mirrored([[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
        "In a left-handed frame the model would follow",
    ),
    "left-handed and far": (
        mirrored([[1, 0, 0], [0, 1, 0], [0, 0, -1]], lambda: seen(0.6, 0.34)),
        "In a left-handed frame the model would follow",
    ),
}
ASKED = {
    "exchanged": (order(0, 1, 3, 2, 4, 5), rf"as closely with dl_3 and dl_4 exchanged\. {RIGHT}"),
    "segments exchanged": (order(3, 4, 5, 0, 1, 2), "with the dl_ columns in the order 4, 5, 6, 1, 2, 3"),
    "mm": (scaled(1e3), rf"{RIGHT} The model would follow with every dl_ times 0\.001 \(mm to m\)"),
    "twice": (scaled(2.0), r"with every dl_ times 0\.5 \(a diameter for a radius\)"),
    "half": (scaled(0.5), r"with every dl_ times 2 \(a radius for a diameter\)"),
    "time in ms": (
        lambda: replace(seen(), t=1e3 * seen().t),
        r"has a row every 50 s and lasts .* s; is column t in ms\?",
    ),
    "a camera far off": (
        lambda: seen(0.6, 0.34),
        r"the camera stands 34\.\d deg and 0\.34 m from where the robot file says",
    ),
}


@pytest.mark.study
@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_with_a_guess(case: str) -> None:
    make, sentence = REFUSED[case]
    with pytest.raises(LogError, match=sentence) as caught:
        identify(make(), ROBOT, threads=1)
    assert "\n" not in str(caught.value)
    assert "far" in str(caught.value)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("case", REFUSED | ASKED)
def test_replay_asks_and_shows(case: str) -> None:
    make, sentence = (REFUSED | ASKED)[case]
    (asked,) = replay(make(), ROBOT).questions
    assert re.search(sentence, asked)
    assert "\n" not in asked


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize(("angle", "distance"), [(0.0, 0.0), (0.09, 0.038), (0.2, 0.05)])
def test_of_a_log_that_fits_nothing_is_asked(angle: float, distance: float) -> None:
    assert questions(seen(angle, distance), ROBOT) == ()


def test_the_large_prior_of_a_file_lets_the_camera_turn_by_half() -> None:
    free = replace(ROBOT, sensor={"registration_sd": (0.5, 2.0)})
    (asked,) = questions(log_of(farlog.log(900, rotation=HALF)), free)
    assert asked.startswith("the camera stands 1")


def test_orientations_and_points_are_seen_by_the_same_camera() -> None:
    run = farlog.log(900, rotation=TURN, shift=SHIFT)
    log = log_of(run, tip_quaternion=quaternion_from_matrix(run.turn))
    (asked,) = questions(log, ROBOT)
    assert asked.startswith("the camera stands 34.")


@pytest.mark.study
def test_replay_prints_its_questions_and_is_done(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(farlog.TOML)
    run = farlog.log(300)
    Path("flipped.csv").write_text(farlog.csv(run._replace(dl=-run.dl)))
    assert main(["replay", "flipped.csv", "--robot", "mine.toml"]) == 0
    reported = capsys.readouterr()
    assert "excursion" in reported.out
    words = r"^log 'flipped' is further from robot 'mine' .* the sign of every dl_ reversed"
    assert re.search(words, reported.err)
    assert len(reported.err.splitlines()) == 1
    rest = np.asarray(ROBOT.rest_tendon_length)
    Path("absolute.csv").write_text(farlog.csv(run._replace(dl=run.dl + rest)))
    for command in ("replay", "identify"):
        assert main([command, "absolute.csv", "--robot", "mine.toml"]) == 2
        assert "these look like absolute lengths. The log takes changes" in capsys.readouterr().err


def test_a_camera_a_metre_away_is_no_other_unit(tmp_path: Path) -> None:
    rotation, shift = farlog.camera(3.0, 1.0)
    run = farlog.log(120, rotation=rotation, shift=shift)
    (tmp_path / "far.csv").write_text(farlog.csv(run))
    assert len(read_log(tmp_path / "far.csv", ROBOT)) == 120
    (tmp_path / "mm.csv").write_text(farlog.csv(run._replace(tip=1e3 * run.tip)))
    with pytest.raises(LogError, match=r"Was it given in mm, or in cm\?"):
        read_log(tmp_path / "mm.csv", ROBOT)


# Words


def names_of_runs() -> RunLog:
    """Two runs, as the words of an array."""
    return replace(seen(), run=np.repeat(np.array(["one", "two"]), 450))


def held_out(word: np.str_) -> Result:
    return identify(names_of_runs(), ROBOT, held_out=[word])


PROVOKED: dict[str, tuple[Callable[[np.str_], object], str]] = {
    "held out": (held_out, "tow"),
    "held out window": (held_out, "two@x:"),
    "held out too late": (held_out, "two@900:"),
    "one run": (lambda word: names_of_runs().only(word), "tow"),
    "excluded effect": (get_effect, "backlsh"),
}


@pytest.mark.parametrize("case", PROVOKED)
def test_no_message_quotes_words_as_an_array_does(case: str) -> None:
    call, word = PROVOKED[case]
    with pytest.raises(Exception, match=r"tow|two|backlsh") as caught:
        call(np.str_(word))
    assert "np.str_" not in str(caught.value)


@pytest.mark.study
def test_a_jump_in_one_of_several_runs_is_told_by_its_name() -> None:
    """Half way through the second run the camera is moved by 20 mm."""
    log = names_of_runs()
    t = np.concatenate([log.t[:450], log.t[:450]])
    tip = log.tip_position + np.where(np.arange(900)[:, None] > 675, 0.02, 0.0)
    text = report.text(identify(replace(log, t=t, tip_position=tip), ROBOT, threads=1, max_effects=1))
    assert "np.str_" not in text
    assert "of run 'two'" in text
