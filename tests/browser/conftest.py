"""A real browser: Debian's chromium, driven by playwright. Where it is missing these tests skip, but for
.ci/run, where they fail."""

import os
import shutil
from collections.abc import Callable, Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any

import pytest
from windows import ARGUMENTS, PATIENCE, Window

import fastrod
from fastrod.identification.attribution import identify
from fastrod.identification.report.report import write
from fastrod.logs.reader import read_log
from fastrod_viewer.app import App

REQUIRED = bool(os.environ.get("FASTROD_REQUIRE_BROWSER"))


def _missing() -> str:
    try:
        import playwright  # noqa: F401
        import viser  # noqa: F401
    except ImportError as error:
        return f"{error.name} is not installed: pip install 'fastrod[test]'"
    return "" if shutil.which("chromium") else "chromium is not installed: apt-get install chromium"


@pytest.fixture(scope="session")
def chromium() -> Iterator[Any]:
    """The browser."""
    if why := _missing():
        if REQUIRED:
            pytest.fail(f"FASTROD_REQUIRE_BROWSER is set, and {why}.")
        pytest.skip(why)
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(autouse=True)
def _slow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without a graphics card, and on one core, a browser takes seconds to answer."""
    monkeypatch.setattr("fastrod_viewer.watch._PATIENCE", 30.0)
    monkeypatch.setattr("fastrod_viewer.drive.session._SAID", PATIENCE)


@pytest.fixture
def window(chromium: Any) -> Iterator[Callable[..., Window]]:
    """Opens windows; closed afterwards, and no request of theirs has left the machine."""
    opened: list[Window] = []

    def make(address: str = "", *, width: int = 1280, height: int = 800, offline: bool = False) -> Window:
        one = Window(chromium, width, height, offline)
        opened.append(one)
        if address:
            one.go(address)
        return one

    yield make
    for one in opened:
        one.close()
    strays = [url for one in opened for url in one.strays]
    assert strays == []


@pytest.fixture
def app(chromium: Any, tmp_path: Path) -> Iterator[App]:
    """A server on a free port; what it says is kept in `app.said`."""
    del chromium
    with App(port=0, folder=tmp_path, say=lambda _: None) as served:
        yield served


@pytest.fixture(scope="session")
def log_with_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The log that ships with the package, and what `fastrod identify` writes beside it."""
    folder = tmp_path_factory.mktemp("identified")
    path = folder / "demo_log.csv"
    path.write_bytes((files("fastrod") / "data" / "demo_log.csv").read_bytes())
    robot = fastrod.load_robot("prototype")
    write(identify(read_log(path, robot), robot), folder / "demo_log_identified")
    return path
