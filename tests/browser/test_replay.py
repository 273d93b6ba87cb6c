"""Record, replay, export in a real browser."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from windows import Window

import fastrod
from fastrod.identification.log.replay import replay
from fastrod.logs.reader import read_log
from fastrod_viewer.app import DEMO_LOG, App
from fastrod_viewer.drive.page import DrivePage
from fastrod_viewer.export import external_references
from fastrod_viewer.replay.page import ReplayPage
from fastrod_viewer.replay.playback import load

Windows = Callable[..., Window]


def replayed(app: App) -> ReplayPage:
    assert isinstance(app.page, ReplayPage)
    return app.page


def box_at_rest(seen: Window, thumb: Any) -> Any:
    """The box of a slider's thumb when it has come to where it goes."""
    boxes = [thumb.bounding_box()]

    def stands() -> bool:
        seen.page.wait_for_timeout(500)
        boxes.append(thumb.bounding_box())
        return bool(boxes[-1] == boxes[-2])

    assert seen.until(stands)
    return boxes[-1]


@pytest.mark.study
def test_the_time_slider_moves_the_robot_and_the_figures(app: App, window: Windows) -> None:
    app.open(DEMO_LOG)
    page = replayed(app)
    page._toggle()  # what plays moves the slider, too
    seen = window(app.address)
    thumb = seen.slide("Time [s]", "End")
    assert seen.until(lambda: page.frame == len(page.playback.frames) - 1)
    row = page.playback.frames[-1]
    assert seen.shows(f"{1e3 * page.playback.before.residual[row]:.2f} mm")
    right = box_at_rest(seen, thumb)
    thumb.press("Home")
    assert seen.until(lambda: page.frame == 0)
    left = box_at_rest(seen, thumb)
    assert left["x"] < right["x"]
    before = seen.pixels()
    aside = np.argmin(np.abs(page.playback.base_quaternion[:, 0] - np.sqrt(0.5)))  # the base lies on its side
    rotated_at = float(page.playback.frame_time[aside])
    fraction = (rotated_at + 5.0) / page.playback.duration
    x = left["x"] + 0.5 * left["width"] + fraction * (right["x"] - left["x"])
    seen.page.mouse.click(x, left["y"] + 0.5 * left["height"])
    assert seen.until(lambda: abs(page.playback.frame_time[page.frame] - rotated_at) < 10.0)
    seen.page.wait_for_timeout(500)
    assert seen.changed(before)[:500, 340:].sum() > 1000
    for label in ("Play", "Pause"):
        seen.page.get_by_role("button", name=label).click()
    assert seen.until(lambda: seen.page.get_by_role("button", name="Play").count() == 1)
    assert seen.errors == []


@pytest.mark.study
def test_before_and_after_can_be_switched(app, window, tmp_path, log_with_report):
    app.open(load(log_with_report))
    seen = window(app.address)
    page = replayed(app)
    before, after = page.playback.tracks
    assert after.rms < before.rms
    for option in (before.label, after.label, "both"):
        seen.pick("Model", option)
        assert seen.until(lambda option=option: page.choice == option)
    assert seen.page.get_by_text("friction").count() > 0
    assert seen.errors == []


def test_a_session_is_recorded_read_back_and_replayed(app: App, window: Windows, tmp_path: Path) -> None:
    app.open("prototype")
    seen = window(app.address)
    page = app.page
    assert isinstance(page, DrivePage)
    seen.tab("Save")
    seen.page.get_by_role("button", name="Record a run log").click()
    assert seen.until(lambda: page.session.recorder is not None)
    for _ in range(6):
        seen.page.keyboard.press("l")
        seen.page.wait_for_timeout(150)
    seen.page.get_by_role("button", name="Stop and save").click()
    path = tmp_path / "prototype-session.csv"
    assert seen.until(path.is_file)
    robot = fastrod.load_robot("prototype")
    log = read_log(path, robot)
    assert len(log) > 20
    assert log.dl[-1, 0] == pytest.approx(-0.0075 * np.radians(30.0), rel=1e-9)
    # the model that was driven answers as it did: 20 points a segment here, 10 there
    result = replay(log, robot)
    assert result.rms < 1e-6
    seen.page.get_by_role("button", name="Replay the recording").click()
    assert seen.until(lambda: isinstance(app.page, ReplayPage))
    assert seen.until(lambda: seen.page.get_by_text("Time [s]", exact=True).count() == 1)
    assert seen.errors == []


@pytest.mark.study(beyond=1)
@pytest.mark.parametrize("what", ["prototype", DEMO_LOG])
def test_an_exported_page_opens_from_disk_without_a_network(app, window, tmp_path, what):
    app.open(what)
    seen = window(app.address)
    if what == "prototype":
        seen.tab("Save")
    path = tmp_path / "page.html"
    seen.save("Export as a web page", path)
    assert external_references(path.read_text(encoding="utf-8")) == []
    alone = window(offline=True)
    alone.go(path.as_uri())
    alone.page.wait_for_timeout(2500)
    picture = alone.pixels()
    assert len(np.unique(picture[150:600, 420:860].reshape(-1, 3), axis=0)) > 200  # a robot, and not a blank
    assert alone.errors == []
    assert [url for url in alone.requested if not url.startswith(("file:", "data:", "blob:"))] == []
    assert app.served.key not in path.read_text(encoding="utf-8")


def test_a_picture_is_saved(app: App, window: Windows, tmp_path: Path) -> None:
    from matplotlib.image import imread

    app.open("prototype")
    seen = window(app.address)
    seen.tab("Save")
    seen.save("Save a picture (PNG)", tmp_path / "picture.png")
    picture = imread(tmp_path / "picture.png")
    assert picture.shape[0] > 300
    assert picture.std() > 0.02
