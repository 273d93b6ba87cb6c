"""The viewer in a real browser: answer to a slider, load of the server, start, memory."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import Any

import numpy as np

from fastrod.errors import InputError
from report import Row, Section, bench, goal, note_progress, table

PAGES = 5  # that come and go
STAY = 12.0  # of a page [s]


def check_installed() -> None:
    """Raises `InputError` where there is no browser to drive."""
    for name in ("playwright", "psutil", "viser"):
        if find_spec(name) is None:
            raise InputError(f"bench viewer needs {name}: pip install 'fastrod[test]'.")
    if not shutil.which("chromium"):
        raise InputError("bench viewer needs chromium: apt-get install chromium.")


@contextmanager
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright
    from windows import ARGUMENTS

    with sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        yield found
        found.close()


def wait_for_controls(page: Any, address: str, seconds: float = 120.0) -> None:
    """Load a page as soon as it is served, and wait until it has its controls."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            page.goto(address, timeout=30_000)
            break
        except Exception:  # nobody listens yet
            time.sleep(0.02)
    while not (page.get_by_role("button", name="STOP").count() and page.locator("canvas").count()):
        if time.monotonic() > end:
            raise RuntimeError(f"{address} was not ready after {seconds:g} s")
        page.wait_for_timeout(10)


@contextmanager
def shown(*words: str, port: int) -> Iterator[tuple[Any, Any, str, float]]:
    """Chromium with a window on `fastrod view`, that server's process, its address, and the time to its
    controls [s]."""
    import psutil
    from windows import Window

    command = [sys.executable, "-m", "fastrod.commands.cli", "view", *words, "--port", str(port)]
    environment = {**os.environ, "BROWSER": "echo"}  # prints the address when a browser is opened
    pipes: Any = {"stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL, "text": True}
    with browser() as chromium:
        window, began = Window(chromium), time.perf_counter()
        with subprocess.Popen(command, env=environment, **pipes) as server:
            try:
                address = server.stdout.readline().strip()
                wait_for_controls(window.page, address)
                yield chromium, psutil.Process(server.pid), address, time.perf_counter() - began
            finally:
                server.terminate()
                server.communicate(timeout=20)
        window.close()


def answers(presses: int) -> list[float]:
    """Measure the times from a key on a slider to the change of the simulator's state, each [s]; one page."""
    from windows import Window

    from fastrod_viewer.app import App

    taken: list[float] = []
    with browser() as chromium, App(port=0, say=lambda _: None) as app:
        app.open("five_segment_reacher")
        window = Window(chromium)
        window.go(app.address)
        page: Any = app.page
        rod, thumb = page.world.rods[0], window.slider("All bend x [°]")
        thumb.focus()
        changed, closing, moved_at = threading.Event(), threading.Event(), [0.0]

        def watch() -> None:
            last = rod.state
            while not closing.is_set():
                state = rod.state
                moved = float(np.linalg.norm(state.tip_position[0] - last.tip_position[0]))
                if moved > 1e-6 and not changed.is_set():
                    moved_at[0] = time.perf_counter()
                    changed.set()
                last = state
                time.sleep(0.0005)

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        for k in range(presses + 5):
            window.page.wait_for_timeout(700 + 37 * (k % 7))  # at rest, and not in step with the pictures
            changed.clear()
            start = time.perf_counter()
            thumb.press("ArrowRight" if k % 20 < 10 else "ArrowLeft")
            changed.wait(3.0)
            if k >= 5:
                taken.append(moved_at[0] - start)
        closing.set()
        watcher.join()
        window.close()
    return taken


def pace(what: str, seconds: float) -> Row:
    """Seconds of a scene in a second, and pictures, while its script plays for one page; its restarts left
    out."""
    from windows import Window

    from fastrod_viewer.app import App

    note_progress(f"pace, {what}")
    seen: list[tuple[float, float]] = []
    with browser() as chromium, App(port=0, say=lambda _: None) as app:
        app.open(what, script=True)
        window = Window(chromium)
        window.go(app.address)
        page: Any = app.page
        draw = page.session._draw

        def counted(frame: Any) -> None:
            draw(frame)
            seen.append((time.perf_counter(), page.world.t))

        time.sleep(2.0)
        page.session._draw = counted
        time.sleep(seconds)
        window.close()
    taken, gone = np.diff(seen, axis=0).T
    on = gone > 0.0
    return {
        "what": what,
        "pace": float(gone[on].sum() / taken[on].sum()),
        "pictures": float(1.0 / taken[on].mean()),
        "late": 1e3 * float(np.quantile(taken[on], 0.95)),
    }


def load(what: str, seconds: float, port: int) -> float:
    note_progress(f"load, {what}")
    with shown(what, "--play", port=port) as (_, process, *_):
        time.sleep(4.0)
        before, began = process.cpu_times(), time.perf_counter()
        time.sleep(seconds)
        after, taken = process.cpu_times(), time.perf_counter() - began
    return 100.0 * float(after.user + after.system - before.user - before.system) / taken


def start(port: int) -> float:
    note_progress("start")
    with shown("five_segment_reacher", port=port) as (*_, taken):
        return taken


def memory(minutes: float, port: int) -> list[Row]:
    """Resident memory of the server while its script plays and five pages come and go."""
    from windows import Window

    rows: list[Row] = []
    with shown("five_segment_reacher", "--play", port=port) as (chromium, process, address, *_):
        windows, began, opened = list[Any](), time.monotonic(), 0

        def note(gone: float) -> None:
            note_progress(f"memory, minute {gone / 60.0:.1f}")
            value = process.memory_info().rss / 2**20
            rows.append({"what": f"after {gone / 60.0:.1f} min", "value": value, "pages": opened})

        while (gone := time.monotonic() - began) < 60.0 * minutes + 1.0:
            if len(windows) >= PAGES - 1:  # and the first
                windows.pop(0).close()
            windows.append(Window(chromium, 640, 400))
            windows[-1].page.goto(address)
            opened += 1
            if gone >= 60.0 * len(rows):
                note(gone)
            time.sleep(STAY / PAGES)
        note(time.monotonic() - began)
        for window in windows:
            window.close()
    return rows


def measure(options: Any) -> list[Section]:
    check_installed()
    port, seconds = options.port, 3.0 if options.quick else 20.0
    note_progress("answer to a slider")
    taken = 1e3 * np.array(answers(6 if options.quick else 60))
    loads = [load(what, seconds, port) for what in ("five_segment_reacher", "grid")]
    rows = [
        ("slider to server state, median", float(np.median(taken)), "ms", 80.0),
        ("slider to server state, 95 %", float(np.quantile(taken, 0.95)), "ms", 150.0),
        ("page ready from `fastrod view`", start(port), "s", 5.0),
        ("server, one five-segment robot at 30 Hz", loads[0], "% of a core", 10.0),
        ("server, 64 five-segment robots at 30 Hz", loads[1], "% of a core", 60.0),
    ]
    found = memory(0.2 if options.quick else options.minutes, port)
    growth = 100.0 * (found[-1]["value"] / found[1 if len(found) > 1 else 0]["value"] - 1.0)
    return [
        table(
            "viewer",
            "The viewer, one page",
            "what | value:.3g measured | unit | target:g | met",
            [{"what": what, "value": x, "unit": unit, **goal(x, target)} for what, x, unit, target in rows],
            f"{len(taken)} key presses on a slider; {os.cpu_count()} cores.",
        ),
        table(
            "pace",
            "Scenes in contact that play for one page",
            "what | pace:.2f s of the scene in a second | pictures:.0f pictures/s | late:.0f ms, 95 %",
            [pace(what, seconds) for what in ("airway", "bar", "pair", "draped", "wall")],
            "Chromium draws in software on the same cores.",
        ),
        table(
            "memory",
            "Memory of the server",
            "what | value:.1f MiB | pages:d pages so far",
            found,
            f"{PAGES} pages, each but the first for {STAY:g} s. Growth from the second row to the last: "
            f"{growth:+.1f} % (target: within 5 %).",
        ),
    ]


main = bench(__doc__, measure, ("--minutes", 2.0, "of motion, for memory"), ("--port", 8471, "of the server"))
