"""`fastrod view`: ports, hosts and names, right and wrong, without a browser."""

import asyncio
import contextlib
import os
import re
import signal
import socket
import sys
import tempfile
import time
import urllib.request
import webbrowser
from pathlib import Path
from subprocess import PIPE, Popen, run

import pytest

from fastrod.access import free_port, is_loopback
from fastrod.commands.cli import main
from fastrod.errors import InputError, UnknownNameError
from fastrod.logs.simulated import SimulatedRobot
from fastrod.model.robotfile import load_robot
from fastrod_viewer.app import DEMO_LOG, App, found, view
from fastrod_viewer.replay.playback import Playback
from fastrod_viewer.server import serve
from fastrod_viewer.worlds.simulated import FreeWorld, SceneWorld


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["wal"], "no scene and no robot 'wal'; did you mean 'wall'?"),
        (["nope.csv"], "log 'nope.csv' cannot be read: there is no such file."),
        (["nope.toml"], "nope.toml"),
        (["prototype", "--port", "99999"], "port is 99999; it must be between 1 and 65535"),
        ([""], "no scene and no robot ''"),
        (["prototype", "--robots", "100000"], "n_robots is 100000; a browser draws up to 1024."),
        (["prototype", "--robots", "0"], "n_robots is 0; it must be a whole number, at least 1."),
        (["wall", "--robots", "3"], "'wall' is a scene, which has its own robots"),
        (["prototype", "--robot", "tdcr_a"], "--robot goes with a run log; 'prototype' is none."),
        (["prototype", "--host", "192.0.2.1"], "host '192.0.2.1' is not an address of this machine"),
    ],
)
def test_what_cannot_be_shown_is_one_sentence(words, sentence, capsys):
    assert main(["view", "--no-open", *words]) == 2
    said = capsys.readouterr()
    assert sentence in said.err
    assert len(said.err.strip().splitlines()) == 1
    assert said.out == ""


def test_a_log_without_its_robot_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.csv"
    path.write_text("t,dl_1,tip_x,tip_y,tip_z\n0,0,0,0,0.07\n")
    assert main(["view", "--no-open", str(path)]) == 2
    assert "name its robot with --robot" in capsys.readouterr().err


def test_a_port_in_use_names_a_free_one() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f"port {port} is in use on 127.0.0.1; "):
            free_port("127.0.0.1", port)
    assert free_port("127.0.0.1", 0) == 0


class _Changing(asyncio.Event):
    """Its waiters change while another thread wakes them, once."""

    raised = False

    def set(self) -> None:
        super().set()
        if not self.raised:
            self.raised = True
            raise RuntimeError("deque mutated during iteration")


def test_a_message_is_sent_although_a_client_began_to_wait_in_that_moment() -> None:
    serve(port=0).stop()
    from viser._messages import ResetGuiMessage
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    event = _Changing()
    with contextlib.closing(asyncio.new_event_loop()) as loop:
        buffer = AsyncMessageBuffer(loop, persistent_messages=True, message_event=event)
        buffer.push(ResetGuiMessage())
        assert event.raised
        assert len(buffer.message_from_id) == 1
        event.clear()
        loop.run_until_complete(asyncio.sleep(0))  # what was left to do in the loop's own thread
        assert event.is_set()


def test_a_page_that_has_left_takes_no_message() -> None:
    serve(port=0).stop()
    from viser._messages import ResetGuiMessage
    from viser.infra._async_message_buffer import AsyncMessageBuffer

    with contextlib.closing(asyncio.new_event_loop()) as loop:
        buffer = AsyncMessageBuffer(loop, persistent_messages=False, message_event=asyncio.Event())
        buffer.set_done()
        buffer.push(ResetGuiMessage())  # a warning of viser's would fail this test
        assert not buffer.message_from_id


def test_loopback_is_distinguished() -> None:
    hosts = ("127.0.0.1", "localhost", "::1", "0.0.0.0", "192.168.1.2", "robot.lab")
    assert [is_loopback(host) for host in hosts] == [True] * 3 + [False] * 3


def test_names_and_files_stand_for_what_they_are(tmp_path: Path) -> None:
    assert isinstance(found("prototype"), FreeWorld)
    assert isinstance(found("wall"), SceneWorld)
    assert isinstance(found(DEMO_LOG), Playback)
    many = found("prototype", n_robots=9)
    assert len(many.rods[0].state.ok) == 9
    with pytest.raises(UnknownNameError, match="did you mean 'prototype'"):
        found("prototyp")


def test_what_was_shown_stays_where_another_cannot_be(tmp_path: Path) -> None:
    with App(port=0, folder=tmp_path, say=lambda _: None) as app:
        app.open("prototype")
        before = app.page
        with pytest.raises(UnknownNameError):
            app.open("prototyp")
        assert app.page is before


def test_a_link_goes_with_its_own_model(tmp_path: Path) -> None:
    sentence = "the link's robot 'prototype' has 1 segments"
    with App(port=0, folder=tmp_path, say=lambda _: None) as app, pytest.raises(InputError, match=sentence):
        app.open(FreeWorld(load_robot("tdcr_a")), link=SimulatedRobot(load_robot("prototype")))


@pytest.mark.study
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_it_serves_this_machine_alone_and_ends_at_once(end: signal.Signals) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = [sys.executable, "-m", "fastrod.commands.cli", "view", "prototype", "--no-open", f"--port={port}"]

    def heed() -> None:
        """Background jobs of a shell ignore SIGINT; this one does not."""
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    with Popen(words, stdout=PIPE, stderr=PIPE, text=True, env=os.environ, preexec_fn=heed) as process:
        try:
            printed = rf"prototype: (http://127\.0\.0\.1:{port}/\S+/) \(Ctrl\+C ends it\)\n"
            line = re.fullmatch(printed, process.stdout.readline())
            assert line is not None
            with urllib.request.urlopen(line[1], timeout=5) as page:
                assert b"<html" in page.read(2000).lower()
            with socket.socket() as other:
                other.settimeout(1.0)
                assert other.connect_ex((_address(), port)) != 0
            process.send_signal(end)
            began = time.monotonic()
            assert process.wait(timeout=20) == 0
            assert time.monotonic() - began < 15
            assert "Traceback" not in process.stderr.read()
        finally:
            process.kill()


_INTERRUPTED = {
    "crosses the text of a dataclass": "exec('kill()')",
    "becomes a compiler's error": "try: kill()\n    except KeyboardInterrupt: raise RuntimeError('none')",
    "is swallowed by a callback": "ctypes.CFUNCTYPE(None)(kill)()\n    time.sleep(60.0)",
}


@pytest.mark.parametrize("end", ["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("how", _INTERRUPTED)
def test_what_an_end_interrupts_ends_quietly(how: str, end: str) -> None:
    code = (
        "import ctypes, os, signal, time\nfrom fastrod_viewer.ending import Ending\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"def kill(): os.kill(os.getpid(), signal.{end}); sum(range(9))\n"
        f"with Ending() as ending:\n    {_INTERRUPTED[how]}\nassert ending.come"
    )
    done = run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def _address() -> str:
    """Address of this machine on its network, or a loopback address that nobody serves."""
    address = socket.gethostbyname(socket.gethostname())
    return "127.0.0.2" if address.startswith("127.") else address


@pytest.mark.parametrize(("host", "announced"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_the_address_is_the_key(host, announced, tmp_path, monkeypatch, capsys):
    opened: list[str] = []

    def browse(page: str) -> None:
        """Go where a file leads that others cannot read: they can read a command line."""
        path = Path(page.removeprefix("file://"))
        assert path.stat().st_mode & 0o077 == 0
        opened.extend(re.findall('url=(.+)"', path.read_text()))

    monkeypatch.setattr(App, "wait", lambda app: opened.append(app.served.key))
    monkeypatch.setattr(webbrowser, "open", browse)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    view("prototype", host=host, port=0)
    said = capsys.readouterr()
    assert list(tmp_path.iterdir()) == []
    address, key = opened
    assert address.endswith(f"/{key}/")
    assert f"prototype: {address} (Ctrl+C ends it)" in said.out
    assert ("Other machines can open this page, too, at http://" in said.err) == announced
    assert (f"/{key}/ and whoever has this address can drive: it is the key" in said.err) == announced
