"""Access to a page, its websocket and its controls: strangers, nonsense, too many, and two at once."""

import re
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from subprocess import PIPE, Popen

import msgspec.msgpack
import numpy as np
import pytest
from numpy.testing import assert_array_equal

pytest.importorskip("viser", reason="viser is not installed: pip install 'fastrod[viewer]'")

from pages import CAMERA, DRIVE, HANDSHAKE, RawPage, request, slider, until, websocket

from fastrod.access import MOST_PAGES, Access, serve_guarded
from fastrod.errors import InputError
from fastrod.logs.simulated import SimulatedRobot
from fastrod.model.robotfile import load_robot
from fastrod_viewer.app import DEMO_LOG, App
from fastrod_viewer.drive.page import DrivePage
from fastrod_viewer.holder import AGAIN, IDLE, PATIENCE, Holder
from fastrod_viewer.worlds.simulated import FreeWorld


@pytest.fixture(scope="module", params=["viewer", "replay", "drive", "environments"])
def address(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of each kind of page."""
    folder = tmp_path_factory.mktemp("access")
    if request.param == "drive":
        with Popen(DRIVE, cwd=folder, stdout=PIPE, stderr=PIPE, text=True) as process:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.search(r"http://\S+", line)
            if found is None:
                pytest.fail(f"{line!r} has no address: {process.communicate()[1]}")
            yield found[0]
            process.send_signal(signal.SIGTERM)
            _, said = process.communicate(timeout=60)
        key = found[0].split("/")[3]
        assert process.returncode == 0, said
        assert "Traceback" not in said
        assert key not in said
        written = [path.read_text(errors="replace") for path in folder.iterdir()]
        assert "emergency stop" in "".join(written)  # the journal: to end is a stop, too
        assert not any(key in text for text in written)
    elif request.param == "environments":
        served = serve_guarded("127.0.0.1", 0)
        yield served.address
        served.stop()
    else:
        with App(port=0, folder=folder, say=lambda _: None) as app:
            app.open("prototype" if request.param == "viewer" else DEMO_LOG)
            yield app.address


OWN, ORIGIN = "Host: {host}", "Origin: "
STRANGERS = {
    "another origin": ("/{key}/", OWN, ORIGIN + "http://evil.example"),
    "another port's origin": ("/{key}/", OWN, ORIGIN + "http://127.0.0.1:1"),
    "another name's origin": ("/{key}/", OWN, ORIGIN + "http://localhost:{port}"),
    "an encrypted origin": ("/{key}/", OWN, ORIGIN + "https://{host}"),
    "an origin that is null": ("/{key}/", OWN, ORIGIN + "null"),
    "an empty origin": ("/{key}/", OWN, ORIGIN),
    "two origins": ("/{key}/", OWN, ORIGIN + "http://{host}", ORIGIN + "http://evil.example"),
    "a rebound name": ("/{key}/", "Host: evil.example:{port}"),
    "a rebound origin": ("/{key}/", "Host: evil.example:{port}", ORIGIN + "http://evil.example:{port}"),
    "a name that begins alike": ("/{key}/", "Host: 127.0.0.1.evil.example:{port}"),
    "another port": ("/{key}/", "Host: 127.0.0.1:1"),
    "no port": ("/{key}/", "Host: 127.0.0.1"),
    "all addresses": ("/{key}/", "Host: 0.0.0.0:{port}"),
    "no host": ("/{key}/",),
    "two hosts": ("/{key}/", OWN, "Host: evil.example"),
    "no key": ("/", OWN),
    "no key, its own origin": ("/", OWN, ORIGIN + "http://{host}"),
    "a file without a key": ("/index.html", OWN),
    "another key": (f"/{Access('127.0.0.1').key}/", OWN),
    "a key cut short": ("/{short}/", OWN),
    "a key and more": ("/{key}A/", OWN),
    "a key in other letters": ("/{swapped}/", OWN),
    "a key in its query": ("/?{key}", OWN),
    "a key further on": ("/x/{key}/", OWN),
    "a key behind two strokes": ("//{key}/", OWN),
    "a cookie": ("/", OWN, "Cookie: {key}={key}"),
}


@pytest.mark.study(beyond=52)
@pytest.mark.parametrize("how", ["page", "websocket"])
@pytest.mark.parametrize("stranger", STRANGERS)
def test_a_stranger_is_refused_in_a_sentence(address: str, stranger: str, how: str) -> None:
    _, _, host, key, _ = address.split("/")
    port, swapped = host.split(":")[1], key.swapcase()
    names = {"host": host, "port": port, "key": key, "short": key[:-1], "swapped": swapped}
    path, *lines = (line.format(**names) for line in STRANGERS[stranger])
    headers = [tuple(line.split(": ", 1)) for line in lines]
    headers += list(HANDSHAKE.items()) if how == "websocket" else []
    connection, status, text = request(address, path, headers)
    connection.close()
    assert status == 403
    (said,) = re.findall(r"<p>(.*)</p>", text)
    assert "open the address that was printed in the terminal" in said
    assert key not in text


@pytest.mark.study(beyond=12)
@pytest.mark.parametrize("how", ["page", "websocket"])
@pytest.mark.parametrize(
    ("name", "origin", "path"),
    [
        ("127.0.0.1", "", "/"),
        ("127.0.0.1", "", ""),
        ("127.0.0.1", "http://127.0.0.1", "/?websocket=ws://127.0.0.1"),
        ("localhost", "http://localhost", "/"),
        ("LOCALHOST", "http://localhost", "/"),
        ("[::1]", "http://[::1]", "/"),
    ],
)
def test_whoever_has_the_address_is_let_in(address: str, name: str, origin: str, path: str, how: str) -> None:
    _, _, host, key, _ = address.split("/")
    port = host.split(":")[1]
    sent = [("Host", f"{name}:{port}")] + ([("Origin", f"{origin}:{port}")] if origin else [])
    sent += list(HANDSHAKE.items()) if how == "websocket" else []
    connection, status, text = request(address, f"/{key}{path}", sent)
    connection.close()
    assert status == (101 if how == "websocket" else 200)
    assert ("<html" in text) == (how == "page")


@pytest.mark.study(beyond=1)
def test_a_client_without_a_browser_gets_what_the_page_shows(address: str) -> None:
    with websocket(address) as opened:
        assert len(opened.recv(timeout=60.0)) > 16


@pytest.mark.parametrize(
    ("bound", "reached", "host", "let_in"),
    [
        ("0.0.0.0", "192.168.1.5", "192.168.1.5:80", True),
        ("0.0.0.0", "192.168.1.5", "192.168.1.5", True),  # a browser leaves out port 80
        ("0.0.0.0", "192.168.1.5", "192.168.1.6:80", False),
        ("0.0.0.0", "192.168.1.5", f"{socket.gethostname()}:80", True),  # printed where there is no route
        ("0.0.0.0", "192.168.1.5", "evil.example:80", False),
        ("0.0.0.0", "192.168.1.5", "0.0.0.0:80", False),
        ("robot.lab", "192.168.1.5", "Robot.lab:80", True),
        ("robot.lab", "192.168.1.5", "lab:80", False),
        ("::", "fd00::5", "[fd00::5]:80", True),
        ("::", "fd00::5", "[fd00::6]:80", False),
    ],
)
def test_another_host_is_served_by_its_addresses(bound, reached, host, let_in):
    from websockets.datastructures import Headers as Given

    access = Access(bound)
    why = access.refusal(f"/{access.key}/", Given(Host=host), (reached, 80))
    assert (why is None) == let_in
    assert access.refusal("/", Given(Host=host), (reached, 80)) is not None


def test_each_server_has_a_key_of_its_own_and_says_who_has_access(tmp_path: Path) -> None:
    made = [serve_guarded(host, 0) for host in ("127.0.0.1", "127.0.0.1", "0.0.0.0")]
    try:
        assert len({served.key for served in made}) == 3
        assert all(len(served.key) >= 40 for served in made)
        assert [bool(served.elsewhere) for served in made] == [False, False, True]
        every = made[2]
        assert every.address == every.at("localhost")
        assert every.elsewhere.endswith(f":{every.viser.get_port()}/{every.key}/")
        connection, status, _ = request(every.address, "/", [("Host", every.address.split("/")[2])])
        connection.close()
        assert status == 403
    finally:
        for served in made:
            served.stop()


def test_a_server_that_cannot_be_guarded_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    from viser.infra import _infra
    from websockets.asyncio import server as web

    class Elsewhere:
        """websockets, from where a later viser might take it."""

        class asyncio:  # noqa: N801
            class server:  # noqa: N801
                serve = web.serve

        exceptions, datastructures = _infra.websockets.exceptions, _infra.websockets.datastructures

    monkeypatch.setattr(_infra, "websockets", Elsewhere)
    with pytest.raises(InputError, match="serves pages in a way that cannot be guarded"):
        serve_guarded("127.0.0.1", 0)


@pytest.fixture
def app(tmp_path: Path) -> Iterator[App]:
    with App(port=0, folder=tmp_path, say=lambda _: None) as served:
        yield served


def arrived(page: DrivePage, bend_x: float) -> bool:
    """Segment 1 gets there [degrees]; nothing is on its way then."""
    return until(lambda: page.teleop.arrived and abs(page.teleop.bent(0)[0] - np.radians(bend_x)) < 1e-6)


def page_of(app: App) -> DrivePage:
    assert isinstance(app.page, DrivePage)
    return app.page


def test_an_exported_page_and_a_log_hold_no_key(app: App, tmp_path: Path) -> None:
    app.open("prototype")
    page, key = page_of(app), app.served.key
    assert key in app.address
    page.session.submit(lambda: page.session.record(tmp_path / "log.csv"))
    assert until(lambda: page.session.recorder is not None)
    html = page.export()
    page.session.submit(lambda: page.session.end_recording() and None)
    assert until(lambda: (tmp_path / "log.csv").is_file())
    assert key not in html + (tmp_path / "log.csv").read_text()
    assert f":{app.server.get_port()}" not in html


def camera(*values: object) -> dict[str, object]:
    """The message of a page's camera with these values for all its fields."""
    fields = [name for name in CAMERA.as_serializable_dict() if name != "type"]
    return {"type": "ViewerCameraMessage", **dict(zip(fields, values, strict=True))}


def nonsense(uuid: str) -> dict[str, bytes | str]:
    """Return what a page may send that makes no sense; `uuid` of a slider."""
    update = {"type": "GuiUpdateMessage", "uuid": uuid}
    upload = {"type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "t"}
    upload |= {"filename": "f", "mime_type": "m", "part_count": 0, "size_bytes": 0}
    drag = {"type": "SceneNodeDragMessage", "phase": "update", "name": "/drag_handle", "instance_index": None}
    drag |= {"start_position": [0.0] * 3, "start_screen_pos": [0.0] * 2, "end_position": [float("nan")] * 3}
    drag |= {"end_screen_pos": [0.0] * 2, "button": "left", "modifier": None, "owner": ""}
    messages: dict[str, object] = {
        "a number": 7,
        "a list": [1, 2],
        "no kind": {"value": 1},
        "an unknown kind": {"type": "Launch"},
        "fields missing": {"type": "GuiUpdateMessage"},
        "fields too many": {**update, "updates": {}, "more": 1},
        "updates that are a list": {**update, "updates": [1]},
        "no such control": {**update, "uuid": "x", "updates": {"value": 1.0}},
        "a control that is a list": {**update, "uuid": [1], "updates": {"value": 1.0}},
        "not a number": {**update, "updates": {"value": float("nan")}},
        "a word for a number": {**update, "updates": {"value": "far"}},
        "far beyond": {**update, "updates": {"value": 1e9}},
        "an attribute": {**update, "updates": {"update_cb": []}},
        "an attribute that is none": {**update, "updates": {"nope": 1}},
        "a file for a slider": upload,
        "a tunnel": {"type": "ShareUrlRequest"},
        "a camera of words": camera(["a"] * 4, None, "wide", [], {}, "x", "y", 3, "up"),
        "a camera of the wrong sizes": camera([1.0], [], 1.0, 1.0, 1.0, 1, 0, [0.0], [1.0]),
        "a drag to nowhere": drag,
    }
    raw = {"text": "hello", "nothing": b"", "noise": np.random.default_rng(5).bytes(4000)}
    return raw | {name: msgspec.msgpack.encode(message) for name, message in messages.items()}


def test_nonsense_ends_in_a_sentence(app: App, capfd: pytest.CaptureFixture[str]) -> None:
    app.open("prototype")
    page, bend = page_of(app), slider(app, "Bend x [°]")
    for what, message in nonsense(bend._impl.uuid).items():
        sender = RawPage(app)
        sender.send(message)
        sender.close()
        assert until(lambda: not app.server.get_clients()), what
    for number, value in enumerate((12.0, 21.0)):  # page after page drives as before
        driver = RawPage(app)
        driver.put(bend, value)
        assert arrived(page, value), number
        driver.press(page.stop)
        assert until(lambda: page.session.stopped)
        driver.press(page.go_on)
        assert until(lambda: not page.session.stopped)
        driver.close()
        assert until(lambda: not app.server.get_clients())
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err
    assert said.err.count("A page sent a message that makes no sense") == 1
    assert app.server._share_tunnel is None


def test_what_pages_send_arrives_in_order_whatever_threads_do(app: App) -> None:
    app.open("prototype")
    page, bend, driver, done = page_of(app), slider(app, "Bend x [°]"), RawPage(app), threading.Event()
    [app.server._thread_executor.submit(done.wait) for _ in range(100)]  # those of viser are busy
    driver.put(bend, 20.0)
    for _ in range(9):
        driver.key("Bend toward +x")
    assert arrived(page, 65.0)
    done.set()
    driver.close()


def test_of_many_pages_some_are_refused_in_a_sentence_and_any_other_stops(app: App) -> None:
    app.open("prototype")
    page, driver = page_of(app), RawPage(app)
    sent = [("Host", app.address.split("/")[2]), *HANDSHAKE.items()]

    def again() -> bool:
        connection, status, _ = request(app.address, f"/{app.served.key}/", sent[:1])
        connection.close()
        return status == 200

    opened = [request(app.address, f"/{app.served.key}", sent) for _ in range(200)]
    assert [status for _, status, _ in opened] == [101] * (MOST_PAGES - 1) + [503] * (201 - MOST_PAGES)
    said = f"{MOST_PAGES} pages are open, which is the most"
    assert all(said in text for _, status, text in opened if status == 503)
    driver.press(page.stop)
    assert until(lambda: page.session.stopped)
    opened[0][0].close()
    assert until(again)
    for connection, _, _ in opened[1:]:
        connection.close()
    driver.close()


class Clock:
    """Stands until it is released."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_one_page_has_the_controls_and_another_asks_for_them() -> None:
    pages, clock, moved = {1, 2, 3}, Clock(), []
    holder = Holder(lambda: pages, moved=lambda: moved.append(clock.now), clock=clock)
    assert [holder.standing(page) for page in (1, 2)] == ["free", "free"]
    assert holder.acts(1)  # the first that acts
    assert not holder.acts(2)
    assert [holder.standing(page) for page in (1, 2)] == ["has", "other"]
    holder.request(2)
    holder.request(3)  # waits in the queue
    assert [holder.standing(page) for page in (1, 2, 3)] == ["requested", "asking", "other"]
    assert holder.acts(1)
    clock.now += 0.9 * PATIENCE
    holder.tick()
    holder.keep(2)  # not its own to keep
    holder.grant(3)
    holder.keep(1)
    assert [holder.standing(page) for page in (1, 2)] == ["has", "refused"]
    holder.request(2)  # too soon
    assert holder.standing(1) == "has"
    clock.now += 1.1 * AGAIN
    holder.tick()
    assert holder.standing(2) == "other"
    assert holder.acts(1)
    holder.request(2)
    assert moved == []
    clock.now += 1.1 * PATIENCE
    holder.tick()  # nobody refused
    assert [holder.standing(page) for page in (1, 2)] == ["other", "has"]
    assert moved == [clock.now]
    assert not holder.acts(1)
    holder.request(1)
    holder.grant(2)
    assert holder.standing(1) == "has"
    clock.now += 1.1 * IDLE
    holder.request(3)  # at once: page 1 did nothing for long
    assert [holder.acts(page) for page in (1, 2, 3)] == [False, False, True]
    pages.remove(3)  # it left
    holder.tick()
    assert holder.standing(2) == "free"
    assert holder.acts(2)
    pages.remove(2)
    assert holder.acts(1)  # before anybody noticed
    assert holder.acts(None)  # the program itself


def test_two_pages_do_not_drive_at_once_and_either_stops(app: App, monkeypatch: pytest.MonkeyPatch) -> None:
    robot = load_robot("prototype")
    link = SimulatedRobot(robot, real=True)
    monkeypatch.setattr("fastrod_viewer.drive.session._HASTY", 0.0)
    app.open(FreeWorld(robot), link=link)
    page, bend, other = page_of(app), slider(app, "Bend x [°]"), slider(app, "Bend y [°]")
    one, two = RawPage(app), RawPage(app)

    def answered(by: RawPage) -> None:
        """All that this page sent before was dealt with: its stop, after the other's, comes last."""
        by.press(page.stop)
        assert until(lambda: page.session.stopped)

    one.put(bend, 20.0)
    assert arrived(page, 20.0)
    assert (app.holder.standing(one.number), app.holder.standing(two.number)) == ("has", "other")
    before = link.read().dl
    two.put(other, 30.0)
    two.put(bend, -30.0)
    two.key("Bend toward +x")
    two.put(page.run, "Reset")
    assert until(lambda: other.value == 0.0 and bend.value == 20.0)  # they go back
    assert_array_equal(link.read().dl, before)
    answered(two)  # the one that may not drive stops
    assert until(lambda: link.stopped)  # a moment after the page says so
    two.press(page.go_on)
    assert until(lambda: two.number in app._panels._noted)
    assert page.session.stopped
    one.press(page.go_on)
    assert until(lambda: not page.session.stopped)
    two.key("Stop")
    assert until(lambda: page.session.stopped)
    one.press(page.go_on)
    assert until(lambda: not page.session.stopped)
    two.put(page.run, "Pause")
    assert until(lambda: page.session.paused)
    two.put(page.run, "Resume")
    one.key("Pause or resume")
    assert until(lambda: not page.session.paused)

    assert until(lambda: two.own("Request control").visible)
    two.press(two.own("Request control"))
    assert until(lambda: one.own("Keep control").visible)
    one.press(one.own("Keep control"))
    assert until(lambda: app.holder.standing(two.number) == "refused")
    monkeypatch.setattr("fastrod_viewer.holder.AGAIN", 0.0)
    monkeypatch.setattr("fastrod_viewer.holder.PATIENCE", 0.0)
    assert until(lambda: two.own("Request control").visible)
    two.press(two.own("Request control"))
    assert until(lambda: app.holder.standing(two.number) == "has")
    one.put(bend, -10.0)
    two.put(other, 15.0)
    assert until(lambda: page.teleop.arrived and abs(page.teleop.bent(0)[1] - np.radians(15.0)) < 1e-6)
    assert page.teleop.bent(0)[0] == pytest.approx(np.radians(20.0), abs=1e-6)
    one.close()
    two.close()


@pytest.mark.parametrize("watched", [False, True], ids=["alone", "watched"])
def test_a_page_that_closes_in_motion_leaves_no_motion_behind(app: App, watched: bool) -> None:
    robot = load_robot("prototype")
    link = SimulatedRobot(robot, real=True)
    app.open(FreeWorld(robot), link=link)
    page, driver = page_of(app), RawPage(app)
    watcher = RawPage(app) if watched else None
    speed, bend = slider(app, "Speed [°/s]"), slider(app, "Bend x [°]")
    driver.put(speed, 5)  # slow, so that it is still on its way
    driver.put(bend, 85.0)
    assert until(lambda: bool(link.read().dl.min() < -1e-5))
    page.session.submit(lambda: threading.Event().wait(1.0) and None)  # what comes now waits
    driver.put(slider(app, "Bend y [°]"), 40.0)
    driver.close()
    assert until(lambda: page.session.idle and page.teleop.arrived)  # what it was sent to is given up
    assert page.teleop.bent(0)[1] == pytest.approx(0.0, abs=1e-3)
    assert link.read().dl.min() > -0.0075 * np.radians(80.0)
    assert until(lambda: link.stopped != watched)
    if watcher is not None:
        watcher.put(bend, 1.0)
        assert arrived(page, 1.0)
        watcher.close()
