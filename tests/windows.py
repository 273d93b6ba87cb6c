"""`Window`: one page of the viewer in a browser, as a person uses it."""

from __future__ import annotations

import io
import time
from collections.abc import Callable
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
        self.context = browser.new_context(
            viewport={"width": width, "height": height}, offline=offline, accept_downloads=True
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

    def close_toast(self) -> None:
        """Close the note that the page is drawn in software, which covers a corner of the picture."""
        toast = self.page.locator(".mantine-Notification-closeButton")
        try:
            toast.first.click(timeout=8_000)
        except Exception:  # a browser with a graphics card shows none
            return

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

    def pick(self, label: str, option: str) -> None:
        """Choose an option of a dropdown."""
        row = self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
        row.locator("input").first.click()
        self.page.get_by_role("option", name=option, exact=True).click()

    def place_of(self, point: Any, app: Any) -> tuple[float, float]:
        """Where a point (3,) world [m] is drawn, in pixels of the window."""
        camera = next(iter(app.server.get_clients().values())).camera
        index = matrix_from_quaternion(np.array([camera.wxyz]))[0]
        x, y, z = index.T @ (np.asarray(point) - camera.position)
        box = self.page.locator("canvas").first.bounding_box()
        scale = 0.5 * box["height"] / np.tan(0.5 * camera.fov)
        return box["x"] + 0.5 * box["width"] + scale * x / z, box["y"] + 0.5 * box["height"] + scale * y / z

    def pixels(self) -> NDArray[np.uint8]:
        """(height, width, 3) what is seen of the canvas and all over it."""
        from matplotlib.image import imread

        picture = imread(io.BytesIO(self.page.screenshot()), format="png")[..., :3]
        return np.asarray(255.0 * picture, dtype=np.uint8)

    def close(self) -> None:
        """Close the window."""
        self.context.close()
