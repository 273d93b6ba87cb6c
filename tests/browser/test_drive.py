"""Driving a robot in a real browser: sliders, drag, keys, scenes, stop, and a page that is closed."""

from collections.abc import Callable

import numpy as np
import pytest
from pages import PROTOCOL
from windows import Window

import fastrod
from fastrod.logs.simulated import SimulatedRobot
from fastrod_viewer.app import App
from fastrod_viewer.drive.page import DrivePage
from fastrod_viewer.worlds.simulated import FreeWorld

Windows = Callable[..., Window]


def page_of(app: App) -> DrivePage:
    assert isinstance(app.page, DrivePage)
    return app.page


def tip_of(app: App) -> np.ndarray:
    return page_of(app).world.rods[0].state.tip_position[0].copy()


def at_rest(app: App) -> bool:
    """The page's camera has come to where it begins, and the server knows."""
    begins, clients = app.server.initial_camera.position, list(app.server.get_clients().values())
    return bool(clients and np.linalg.norm(clients[0].camera.position - begins) < 1e-2)


@pytest.mark.study
def test_a_slider_moved_by_keys_bends_the_robot_and_the_picture(app: App, window: Windows) -> None:
    app.open("prototype")
    seen = window(app.address)
    before, pixels, teleop = tip_of(app), seen.pixels(), page_of(app).teleop
    seen.slide("Bend x [°]", "ArrowRight", 45)
    assert seen.until(lambda: teleop.arrived and teleop.bent(0)[0] > np.radians(44.0))
    # an arc of 45 degrees and 0.07 m ends at (1 - cos a) l / a beside its base; tendons of 1e-5 m/N stretch a
    # little
    a, length = np.radians(45.0), 0.07
    assert tip_of(app)[0] - before[0] == pytest.approx((1.0 - np.cos(a)) * length / a, rel=0.03)
    assert seen.until(lambda: bool(seen.changed(pixels)[100:700, 340:].sum() > 2000))
    assert seen.errors == []


def last_drag(app: App, seen: Window) -> np.ndarray:
    """(3,) where the tip is pulled to [m], when the mouse's last moves have arrived."""
    before, now = None, np.array(page_of(app).teleop.dragged_to)
    while before is None or not np.array_equal(before, now):
        seen.page.wait_for_timeout(1000)
        before, now = now, np.array(page_of(app).teleop.dragged_to)
    return now


@pytest.mark.study
def test_the_tip_follows_a_drag(app: App, window: Windows) -> None:
    app.open("five_segment_reacher")
    seen = window(app.address)
    before = tip_of(app)
    assert seen.until(lambda: at_rest(app))
    x, y = seen.place_of(page_of(app).drawing.tip(), app)
    mouse = seen.page.mouse
    mouse.move(x, y)
    mouse.down()
    for k in range(1, 21):
        mouse.move(x + 6 * k, y + 3 * k)
        seen.page.wait_for_timeout(30)
    assert seen.until(lambda: page_of(app).teleop.dragged_to is not None)
    pull = last_drag(app, seen)
    assert seen.until(lambda: bool(np.linalg.norm(tip_of(app) - pull) < 2e-3))
    mouse.up()
    # let go, its drives may still be on their way to the last command: then it stays where it was pulled to
    assert seen.until(lambda: page_of(app).teleop.arrived)
    held = tip_of(app)
    assert np.linalg.norm(held - before) > 0.02
    assert np.linalg.norm(held - pull) < 2e-3
    seen.page.wait_for_timeout(500)
    assert np.linalg.norm(tip_of(app) - held) < 1e-4


def test_keys_bend_pause_reset_and_stop(app: App, window: Windows) -> None:
    app.open("five_segment_reacher")
    seen = window(app.address)
    page, keys = page_of(app), seen.page.keyboard
    assert seen.until(lambda: at_rest(app))
    keys.press("2")
    for _ in range(3):
        keys.press("l")
    assert seen.until(lambda: abs(page.teleop.bent(1)[0] - np.radians(15.0)) < 1e-6)
    assert page.teleop.bent(0)[0] == pytest.approx(0.0, abs=1e-6)
    seen.page.wait_for_timeout(500)
    assert at_rest(app)  # keys that bend do not fly the camera
    keys.press("Space")
    assert seen.until(lambda: page.session.paused)
    keys.press("Space")
    assert seen.until(lambda: not page.session.paused)
    keys.press("Escape")
    assert seen.until(lambda: page.session.stopped)
    page.teleop.bend(0, 0.5, 0.0)
    seen.page.wait_for_timeout(300)
    assert abs(page.teleop.now.action[1]) < 1e-12
    keys.press("Escape")
    seen.button("STOP").dblclick()
    seen.page.wait_for_timeout(300)
    assert page.session.stopped
    seen.button("Resume").click()
    assert seen.until(lambda: not page.session.stopped)
    keys.press("r")
    assert seen.until(lambda: float(np.abs(page.teleop.goals.action).max()) < 1e-9)


def test_another_scene_is_picked_in_the_page(app: App, window: Windows) -> None:
    app.open("prototype")
    seen = window(app.address)
    seen.pick("Show", "Robot · TDCR A")
    assert seen.until(lambda: app.page is not None and app.page.title == "tdcr_a")
    assert seen.until(lambda: seen.page.get_by_text("All bend x [°]").count() == 1)
    assert seen.errors == []


@pytest.mark.study
def test_a_load_bends_the_robot(app: App, window: Windows) -> None:
    app.open("tdcr_b")
    seen = window(app.address)
    before = tip_of(app)
    seen.tab("Loads")
    seen.slide("Tip force x [N]", "ArrowRight", 10)
    assert seen.until(lambda: float(tip_of(app)[0] - before[0]) > 1e-3)


@pytest.mark.study
def test_two_pages_show_the_same_and_closing_one_changes_nothing(app: App, window: Windows) -> None:
    app.open("prototype")
    first, second = window(app.address), window(app.address)
    first.slide("Bend x [°]", "ArrowRight", 20)
    assert second.until(lambda: second.slider("Bend x [°]").get_attribute("aria-valuenow") == "20")
    assert second.until(lambda: page_of(app).teleop.arrived)  # what still moves stops as its page closes
    first.close()
    assert second.until(lambda: len(app.server.get_clients()) == 1)
    second.slide("Bend x [°]", "ArrowRight")
    assert second.until(lambda: abs(page_of(app).teleop.bent(0)[0] - np.radians(21.0)) < 1e-6)


def test_of_two_pages_one_drives(app: App, window: Windows, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fastrod_viewer.holder.PATIENCE", 600.0)  # a click may take seconds without a GPU
    monkeypatch.setattr("fastrod_viewer.holder.IDLE", 600.0)
    monkeypatch.setattr("fastrod_viewer.holder.AGAIN", 0.0)
    app.open("prototype")
    first, second = window(app.address), window(app.address)
    teleop = page_of(app).teleop
    assert first.shows("No page has the controls.", once=True)
    first.page.keyboard.press("l")
    assert first.shows("This page has the controls.", once=True)
    assert second.shows("This one watches", once=True)
    bent = teleop.bent(0)[0]
    assert bent > 0.05
    thumb = second.slide("Bend x [°]", "End")
    assert second.shows("Request them in the window Controls", once=True)
    assert second.until(lambda: thumb.get_attribute("aria-valuenow") == "5")  # it goes back
    assert teleop.bent(0)[0] == bent
    for answer in ("Keep control", "Yield control"):
        second.page.get_by_role("button", name="Request control").click()
        first.page.get_by_role("button", name=answer).click()
    assert second.shows("This page has the controls.", once=True)
    thumb.press("ArrowRight")
    assert second.until(lambda: teleop.bent(0)[0] > bent + 0.01)
    first.page.keyboard.press("Escape")
    assert first.until(lambda: page_of(app).session.stopped)
    assert first.errors == second.errors == []


@pytest.mark.parametrize(("page", "let_in"), [("about:blank", False), ("another site", False), ("", True)])
def test_a_websocket_opens_from_its_own_page(app: App, window: Windows, page: str, let_in: bool) -> None:
    app.open("prototype")
    seen = window()
    with App(port=0, folder=app.folder, say=lambda _: None) as other:  # another port is another site
        seen.page.goto({"": app.address, "another site": other.address}.get(page, page))
        address = app.address.replace("http", "ws", 1).rstrip("/")
        opened = seen.page.evaluate(
            """([address, protocol]) => new Promise(done => {
                const socket = new WebSocket(address, [protocol]);
                socket.onopen = () => done(true);
                socket.onerror = () => done(false);
            })""",
            [address, PROTOCOL],
        )
    assert opened == let_in


@pytest.mark.study
def test_closing_the_page_stops_a_real_robot(app: App, window: Windows) -> None:
    robot = fastrod.load_robot("prototype")
    link = SimulatedRobot(robot, real=True)
    app.open(FreeWorld(robot), link=link)
    seen = window(app.address)
    seen.slide("Speed [°/s]", "Home")  # slow, so that it is still on its way
    seen.slide("Bend x [°]", "End")
    assert seen.until(lambda: bool(link.read().dl.min() < -1e-5))
    assert not link.stopped
    seen.close()
    other = window()
    assert other.until(lambda: link.stopped)
    there = link.read().dl
    other.page.wait_for_timeout(500)
    assert np.array_equal(link.read().dl, there)
    assert there.min() > -0.0075 * np.pi / 2.0 + 1e-3  # it had not arrived
    other.go(app.address)
    other.page.wait_for_timeout(1100)  # sooner it is ignored
    other.button("Resume").click()
    assert other.until(lambda: not link.stopped)


def test_it_fits_a_phone(app: App, window: Windows) -> None:
    app.open("prototype")
    seen = window(app.address, width=390, height=844)
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= 390
    colors = np.unique(seen.pixels()[:400].reshape(-1, 3), axis=0)
    assert len(colors) > 200  # the robot is drawn above the sheet of controls
