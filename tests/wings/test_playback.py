"""Playback: the figures of `replay`, the true shape behind every predicted tip, a clock without pauses."""

import json
from dataclasses import replace
from importlib.resources import as_file, files
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import fastrod
from fastrod.errors import InputError, LogError
from fastrod.identification.log.replay import replay
from fastrod.logs.reader import read_log
from fastrod.logs.runlog import RunLog, write_log
from fastrod.model.robot import Robot
from fastrod.model.robotfile import save_robot
from fastrod.rotation import matrix_from_quaternion
from fastrod_viewer.replay.playback import BEFORE, POINTS_PER_SEGMENT, SWITCHED_OFF, Playback, identify, load
from fastrod_viewer.replay.residual_plot import curves, svg

ROBOT = fastrod.load_robot("prototype")
MEMORY = {"name": "backlash", "half_width": 3e-4}
LOAD = {"name": "tip_force", "x": 0.05}
CAMERA = {"name": "frame_misalignment", "rotation_y": 0.1, "shift_x": 0.004}
MARKER = {"name": "marker_offset", "x": 0.01}


@pytest.fixture(scope="module")
def demo() -> RunLog:
    with as_file(files("fastrod").joinpath("data").joinpath("demo_log.csv")) as path:
        return read_log(path, ROBOT)


def with_(*effects: dict[str, object]) -> Robot:
    return replace(ROBOT, effects=effects)


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("robot", [ROBOT, with_(MEMORY, LOAD)], ids=["bare", "effects"])
def test_figures_are_those_of_replay(demo: RunLog, robot: Robot) -> None:
    made, straight = Playback.of(demo, robot), replay(demo, robot)
    assert_array_equal(made.origin, np.flatnonzero(demo.driven))
    residual = np.linalg.norm(straight.residual, axis=1)[made.origin]
    assert_allclose(made.before.tip_position, straight.tip_position[made.origin], rtol=0, atol=1e-12)
    assert_allclose(made.before.residual, residual, rtol=0, atol=1e-12)
    assert made.before.rms == pytest.approx(straight.rms, rel=1e-12)


@pytest.mark.study(beyond=2)
@pytest.mark.parametrize(
    "robot", [ROBOT, with_(MEMORY, CAMERA), with_(MEMORY), with_(MEMORY, LOAD), with_(CAMERA)]
)
def test_the_drawn_tip_is_the_predicted_tip(demo: RunLog, robot: Robot) -> None:
    track = (made := Playback.of(demo, robot, frames=400)).before
    shapes, predicted = track.shapes, track.tip_position[made.frames]
    there = np.isfinite(predicted).all(1)
    assert shapes.ok.all()
    assert there.mean() > 0.9
    assert_allclose(shapes.position[there, -1], predicted[there], rtol=0, atol=1e-6)
    assert_allclose(shapes.tip_position[there], predicted[there], rtol=0, atol=1e-6)
    n_points = ROBOT.n_segments * POINTS_PER_SEGMENT + 1
    assert shapes.position.shape == (400, n_points, 3)
    assert shapes.rotation.shape == (400, n_points, 3, 3)
    along = np.linalg.norm(np.diff(shapes.position, axis=1), axis=2).sum(axis=1)
    # the backbone does not stretch; chords are a little short
    assert_allclose(along, ROBOT.length, rtol=1e-3)
    unit = np.swapaxes(shapes.rotation, 2, 3) @ shapes.rotation
    assert_allclose(unit, np.broadcast_to(np.eye(3), unit.shape), atol=1e-7)
    slope = shapes.position[:, 1] - shapes.position[:, 0]
    # tangent, camera and all
    assert_allclose(slope / np.linalg.norm(slope, axis=1)[:, None], shapes.rotation[:, 0, :, 2], atol=0.05)


def test_a_camera_sees_the_whole_backbone_move(demo: RunLog) -> None:
    plain, seen = (Playback.of(demo, robot, frames=50).before.shapes for robot in (ROBOT, with_(CAMERA)))
    rotation = matrix_from_quaternion(np.array([np.cos(0.05), 0.0, np.sin(0.05), 0.0]))
    # of two step sizes
    assert_allclose(seen.position, plain.position @ rotation.T + (0.004, 0.0, 0.0), rtol=0, atol=2e-5)
    assert_allclose(seen.rotation, rotation @ plain.rotation, rtol=0, atol=1e-3)


def test_a_marker_stands_off_the_tip(demo: RunLog) -> None:
    made = Playback.of(demo, with_(MARKER), frames=50).before.shapes
    off = made.tip_position - made.position[:, -1]
    assert_allclose(off, 0.01 * made.rotation[:, -1, :, 0], rtol=0, atol=1e-9)


def test_the_shape_is_in_the_base_frame_of_a_robot_that_hangs(demo: RunLog) -> None:
    few = replace(demo.rows(slice(0, 300)), base_quaternion=None, payload=None)
    hangs = replace(ROBOT, base_quaternion=(0.0, 1.0, 0.0, 0.0), base_position=(0.3, 0.2, 0.1))
    upright, hanging = (Playback.of(few, robot, frames=40).before.shapes for robot in (ROBOT, hangs))
    assert_allclose(hanging.position, upright.position, rtol=0, atol=1e-8)
    assert_allclose(hanging.rotation, upright.rotation, rtol=0, atol=1e-6)


def test_thinning_keeps_both_ends_and_is_even(demo: RunLog) -> None:
    made = Playback.of(demo, ROBOT, frames=101)
    assert len(made.frames) == 101
    assert made.frames[[0, -1]].tolist() == [0, len(made.log) - 1]
    assert np.ptp(np.diff(made.frames)) <= 1
    whole = Playback.of(demo.rows(slice(0, 90)), ROBOT, frames=101)
    assert_array_equal(whole.frames, np.arange(90))
    with pytest.raises(InputError, match="keeps 2 at least"):
        Playback.of(demo, ROBOT, frames=1)


def test_the_clock_closes_pauses_and_finds_its_frames(demo: RunLog) -> None:
    few = demo.rows(slice(0, 60))
    t = 0.1 * np.arange(60.0)
    t[20:40] += 3600.0  # another run, an hour later
    t[50:] += 100.0  # a pause inside the third
    run = np.repeat(["a", "b", "c"], 20)
    made = Playback.of(replace(few, t=t, run=run), ROBOT)
    assert made.breaks.tolist() == [20, 40, 50]
    assert_allclose(made.time, 0.1 * np.arange(60.0), atol=1e-9)
    assert made.duration == pytest.approx(5.9)
    assert [made.at(when) for when in (-1.0, 0.0, 0.19, 2.001, 99.0)] == [0, 0, 1, 20, 59]
    assert [made.run_at(frame) for frame in (0, 19, 20, 59)] == ["a", "a", "b", "c"]
    assert made.base_quaternion.shape == (60, 4)


def test_rows_that_drive_nothing_are_left_out(demo: RunLog) -> None:
    dl, tip = demo.dl[:40].copy(), demo.tip_position[:40].copy()
    dl[3], tip[5] = np.nan, np.nan
    made = Playback.of(replace(demo.rows(slice(0, 40)), dl=dl, tip_position=tip), ROBOT)
    assert made.origin.tolist() == [k for k in range(40) if k != 3]
    assert np.isnan(made.before.residual).tolist() == [k == 5 for k in made.origin]
    assert made.before.shapes.ok.all()  # the model is drawn where only the camera was blind


def test_progress_goes_up_to_all(demo: RunLog) -> None:
    seen: list[tuple[int, int]] = []
    Playback.of(demo, ROBOT, with_(MEMORY), progress=lambda done, total: seen.append((done, total)))
    assert seen[-1][0] == seen[-1][1]
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)
    assert len({total for _, total in seen}) == 1


@pytest.fixture
def folder(tmp_path: Path, demo: RunLog) -> Path:
    """A log beside what `fastrod identify` has written about it."""
    write_log(demo, tmp_path / "wobble.csv")
    out = tmp_path / "wobble_identified"
    out.mkdir()
    report = {
        "log": "wobble",
        "verdict": "explained",
        "summary": "Backlash.",
        "effects": [{"name": "backlash"}],
        "held_out": ["every fourth of 20 stretches of each run"],
        "error": {"held_out": {"before_rms_m": 3e-3, "after_rms_m": None}},
    }
    (out / "report.json").write_text(json.dumps(report))
    save_robot(with_(MEMORY, MARKER), out / "identified.toml")
    return tmp_path


@pytest.mark.study
def test_an_identification_beside_the_log_is_found(folder: Path, demo: RunLog) -> None:
    made = load(folder / "wobble.csv", frames=20)
    assert made.after.robot == with_(MEMORY, MARKER)
    assert made.before.robot == with_(MARKER)  # only what was found is switched off
    assert (made.before.label, made.after.label) == (SWITCHED_OFF, "with backlash")
    assert made.findings.effects == ("backlash",)
    assert made.findings.held_out_rms[0] == 3e-3
    assert np.isnan(made.findings.held_out_rms[1])
    assert made.tested.mean() == pytest.approx(0.25, abs=0.01)
    assert made.after.rms == pytest.approx(replay(demo, with_(MEMORY, MARKER)).rms, rel=1e-12)
    assert made.before.rms == pytest.approx(replay(demo, with_(MARKER)).rms, rel=1e-12)


def test_an_identification_of_another_robot_is_not_taken(folder: Path) -> None:
    other = replace(ROBOT, name="other")
    made = load(folder / "wobble.csv", other, frames=20)
    assert made.after is None
    assert made.before.robot == other
    with pytest.raises(InputError, match=r"lacks report.json and identified.toml of log 'wobble'"):
        load(folder / "wobble.csv", identified=folder)
    (folder / "wobble_identified" / "report.json").write_text("{}")
    with pytest.raises(InputError, match=r"is not a report of fastrod identify"):
        load(folder / "wobble.csv")


def test_a_log_without_a_robot_asks_for_one(folder: Path, demo: RunLog) -> None:
    write_log(demo, folder / "bare.csv")
    with pytest.raises(InputError, match="name its robot with --robot"):
        load(folder / "bare.csv")
    save_robot(with_(MEMORY), folder / "identified.toml")
    assert load(folder / "bare.csv", frames=5).before.robot == with_(MEMORY)
    with pytest.raises(LogError, match="no such file"):
        load(folder / "none.csv")


def test_a_wrong_robot_and_a_blind_log_are_said_in_a_sentence(folder: Path, demo: RunLog) -> None:
    trunk = next(
        r for r in map(fastrod.load_robot, fastrod.robot_names()) if r.n_tendons not in (0, ROBOT.n_tendons)
    )
    with pytest.raises(LogError, match="dl_ columns"):
        load(folder / "wobble.csv", trunk)
    with pytest.raises(InputError, match="leave --robot out to take the identified one"):
        load(folder / "wobble.csv", trunk, identified=folder / "wobble_identified")
    with pytest.raises(LogError, match="nothing to compare"):
        Playback.of(replace(demo, tip_position=np.full((len(demo), 3), np.nan)), ROBOT)


@pytest.mark.study
def test_identify_shows_before_and_after(demo: RunLog) -> None:
    slop = with_({"name": "drum_gain", "gain": 0.08})
    few = demo.rows(slice(0, 900))
    truth = replay(few, slop)
    noise = np.random.default_rng(2).normal(0.0, 2e-4, (len(few), 3))
    log = replace(few, tip_position=truth.tip_position + noise).rows(truth.converged)
    made = identify(Playback.of(log, ROBOT, frames=20), frames=20)
    assert "drum_gain" in made.findings.effects
    assert made.before.label == BEFORE
    assert made.nominal == ROBOT
    assert made.after.rms < 5e-4 < made.before.rms
    before, after = made.findings.held_out_rms
    for track, rms in ((made.after, after), (made.before, before)):  # the report leaves outliers out
        assert np.sqrt(np.nanmean(track.residual[made.tested] ** 2)) == pytest.approx(rms, rel=0.05)


def test_live_curves_keep_every_peak(demo: RunLog) -> None:
    made = Playback.of(demo, ROBOT, with_(MEMORY), frames=20)
    for most in (200, 2000, 10_000):
        shown = curves(made, most)
        assert len(shown.time) == len(shown.before) == len(shown.after) <= most
        assert (np.diff(shown.time) >= 0.0).all()
        for line, track in ((shown.before, made.before), (shown.after, made.after)):
            assert np.nanmax(line) == 1e3 * np.nanmax(track.residual)
            assert np.nanmin(line) == 1e3 * np.nanmin(track.residual)
    assert len(curves(made, 10_000).time) == len(made.log)
    with pytest.raises(InputError, match="20 points at least"):
        curves(made, 3)


def test_live_curves_break_between_runs(demo: RunLog) -> None:
    runs = {"run": np.repeat(["a", "b", "c"], 200), "t": np.tile(0.1 * np.arange(200.0), 3)}
    made = Playback.of(replace(demo.rows(slice(0, 600)), **runs), ROBOT, frames=20)
    for most in (100, 2000):
        shown = curves(made, most)
        assert len(shown.time) <= most
        gaps = np.flatnonzero(np.isnan(shown.before))
        assert_allclose(shown.time[gaps], made.time[[200, 400]])


def test_the_drawn_plot_is_the_same_each_time_and_leads_nowhere(demo: RunLog) -> None:
    made = Playback.of(demo, ROBOT, with_(MEMORY), frames=20)
    text = svg(made)
    assert text == svg(made)
    assert text.startswith("<svg viewBox=")
    assert text.endswith("</svg>")
    assert "http" not in text
    assert "<text" not in text
