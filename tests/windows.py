"""`Window`: one page of the viewer in a browser, as a person uses it."""

import io
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import urlparse

import numpy as np
from numpy.typing import NDArray

from fastrod.rotation import matrix_from_quaternion

ARGUMENTS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
]
_LOCAL = ("127.0.0.1", "localhost")
PATIENCE = 240.0
"""s: what ends a test that hangs. Without a graphics card, and on one core, a frame may take a second."""


class Window:
    """A browser window of its own, with what it asked for."""

    def __init__(self, browser: Any, width: int = 1280, height: int = 800, offline: bool = False) -> None:
        # half the resolution: without a graphics card the pixels are what a frame costs
        self.context = browser.new_context(
            viewport={"width": width, "height": height},
            device_scale_factor=0.5,
            offline=offline,
            accept_downloads=True,
        )
        self.page = self.context.new_page()
        self.page.set_default_timeout(1e3 * PATIENCE)
        self.requested: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.requested.append(request.url))
        self.page.on("websocket", lambda socket: self.requested.append(socket.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))

    @property
    def strays(self) -> list[str]:
        """Requests that left the machine."""
        return [
            url
            for url in self.requested
            if urlparse(url).scheme in ("http", "https", "ws", "wss") and urlparse(url).hostname not in _LOCAL
        ]

    def go(self, address: str) -> None:
        """Open a page and wait until it draws."""
        self.page.goto(address)
        self.page.wait_for_selector("canvas")

    def until(self, holds: Callable[[], bool], seconds: float = PATIENCE) -> bool:
        """Wait until something holds; whether it does."""
        end = time.monotonic() + seconds
        while not holds() and time.monotonic() < end:
            self.page.wait_for_timeout(30)
        return holds()

    def slider(self, label: str) -> Any:
        """The thumb of a slider, by its label."""
        row = self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//*[@role='slider']][1]")
        return row.locator("[role=slider]").first

    def slide(self, label: str, key: str, times: int = 1) -> Any:
        """Press a key on a slider, once it is there to be seen (what is hidden takes no keys); its thumb."""
        thumb = self.slider(label)
        thumb.wait_for()
        for _ in range(times):
            thumb.press(key)
        return thumb

    def button(self, name: str) -> Any:
        """A button, by its whole name."""
        return self.page.get_by_role("button", name=name, exact=True)

    def shows(self, words: str | re.Pattern[str], once: bool = False) -> bool:
        """Wait until the page has these words, in one place alone if `once`; whether it does."""
        found = self.page.get_by_text(words)
        return self.until(lambda: found.count() == 1 if once else found.count() > 0)

    def tab(self, name: str) -> None:
        """Choose a tab of the controls."""
        self.page.get_by_role("tab", name=name).click()

    def save(self, name: str, path: Path) -> None:
        """Press a button that has a file downloaded."""
        with self.page.expect_download() as waiting:
            self.page.get_by_role("button", name=name).click()
        waiting.value.save_as(path)

    def changed(self, before: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(height, width) pixels that differ clearly from those before."""
        return np.abs(self.pixels().astype(int) - before).max(axis=2) > 40

    def pick(self, label: str, option: str) -> None:
        """Choose an option of a dropdown."""
        row = self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
        row.locator("input").first.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def place_of(self, point: Any, app: Any) -> tuple[float, float]:
        """Return where a point (3,) world [m] is drawn, in pixels of the window."""
        camera = next(iter(app.server.get_clients().values())).camera
        index = matrix_from_quaternion(np.array([camera.wxyz]))[0]
        x, y, z = index.T @ (np.asarray(point) - camera.position)
        box = self.page.locator("canvas").first.bounding_box()
        scale = 0.5 * box["height"] / np.tan(0.5 * camera.fov)
        return box["x"] + 0.5 * box["width"] + scale * x / z, box["y"] + 0.5 * box["height"] + scale * y / z

    def pixels(self) -> NDArray[np.uint8]:
        """(height, width, 3) what is seen of the canvas and all over it."""
        from matplotlib.image import imread

        picture = imread(io.BytesIO(self.page.screenshot(scale="css")), format="png")[..., :3]
        return np.asarray(255.0 * picture, dtype=np.uint8)

    def close(self) -> None:
        """Close the window."""
        self.context.close()
