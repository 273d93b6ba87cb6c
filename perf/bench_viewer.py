"""The viewer in a real browser: answer to a slider, load of the server, start, memory: `fastrod bench
viewer`, or this file as a script.

Needs Debian's chromium and playwright. `--minutes` of motion with pages that come and go, for memory (10 for
the whole check).
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from report import Column, Row, Section, command, note_progress

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
PAGES = 5
"""That come and go."""
STAY = 12.0
"""Of a page [s]."""


def _missing() -> str:
    try:
        import playwright  # noqa: F401
        import psutil  # noqa: F401
        import viser  # noqa: F401
    except ImportError as error:
        return f"{error.name} is not installed; pip install 'fastrod[test]' brings it"
    return "" if shutil.which("chromium") else "chromium is not installed (apt-get install chromium)"


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium."""
    from playwright.sync_api import sync_playwright
    from windows import ARGUMENTS

    with sync_playwright() as driver:
        found = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        yield found
        found.close()


@contextmanager
def serving(*words: str, port: int) -> Iterator[tuple[Any, str]]:
    """`fastrod view` in a process of its own, and the address that it would open a browser with."""
    import psutil

    with subprocess.Popen(
        [sys.executable, "-m", "fastrod.commands.cli", "view", *words, "--port", str(port)],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env={**os.environ, "BROWSER": "echo"},  # prints the address when a browser is opened
    ) as process:
        try:
            assert process.stdout is not None
            yield psutil.Process(process.pid), process.stdout.readline().strip()
        finally:
            process.terminate()
            process.communicate(timeout=20)


def reached(page: Any, address: str, ready: Callable[[], bool], seconds: float = 120.0) -> None:
    """Load a page as soon as somebody serves it, and wait until it is ready."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        try:
            page.goto(address, timeout=30_000)
            break
        except Exception:  # nobody listens yet
            time.sleep(0.02)
    while not ready():
        if time.monotonic() > end:
            raise RuntimeError(f"{address} was not ready after {seconds:g} s")
        page.wait_for_timeout(10)


def answers(presses: int) -> list[float]:
    """From a key on a slider to the change of the simulator's state, each [s]; browser and server in one
    machine, one page."""
    from windows import Window

    from fastrod_viewer.app import App
    from fastrod_viewer.drive_page import DrivePage

    taken: list[float] = []
    with browser() as chromium, App(port=0, say=lambda _: None) as app:
        app.open("five_segment_reacher")
        window = Window(chromium)
        window.go(app.address)
        page = app.page
        assert isinstance(page, DrivePage)
        world = page.world
        thumb = window.slider("All bend x [°]")
        thumb.focus()
        changed = threading.Event()
        moved_at = [0.0]
        closing = threading.Event()

        def watch() -> None:
            last = world.rods[0].state
            while not closing.is_set():
                state = world.rods[0].state
                if state is not last:
                    moved = float(np.linalg.norm(state.tip_position[0] - last.tip_position[0]))
                    last = state
                    if moved > 1e-6 and not changed.is_set():
                        moved_at[0] = time.perf_counter()
                        changed.set()
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


def load(what: str, seconds: float, port: int) -> Row:
    """Share of a core that the server takes while its script plays for one page."""
    from windows import Window

    note_progress(f"load, {what}")
    with browser() as chromium, serving(what, "--play", port=port) as (process, address):
        window = Window(chromium)
        reached(window.page, address, lambda: window.page.get_by_role("button", name="STOP").count() > 0)
        time.sleep(4.0)
        before, began = process.cpu_times(), time.perf_counter()
        time.sleep(seconds)
        after, taken = process.cpu_times(), time.perf_counter() - began
        window.close()
    return {"what": what, "value": 100.0 * (after.user + after.system - before.user - before.system) / taken}


def start(port: int) -> float:
    """From the command to a page with its controls [s], kernels from the cache, the browser open."""
    from windows import Window

    note_progress("start")
    with browser() as chromium:
        window = Window(chromium)
        began = time.perf_counter()
        with serving("five_segment_reacher", port=port) as (_, address):
            reached(
                window.page,
                address,
                lambda: (
                    window.page.get_by_role("button", name="STOP").count() > 0
                    and window.page.locator("canvas").count() > 0
                ),
            )
            taken = time.perf_counter() - began
        window.close()
    return taken


def memory(minutes: float, port: int) -> list[Row]:
    """Resident memory of the server while its script plays and five pages come and go."""
    from windows import Window

    rows: list[Row] = []
    with browser() as chromium, serving("five_segment_reacher", "--play", port=port) as (process, address):
        first = Window(chromium)
        reached(first.page, address, lambda: first.page.get_by_role("button", name="STOP").count() > 0)
        windows = [first]
        began = time.monotonic()
        next_row = 0.0
        turn = 0
        while (gone := time.monotonic() - began) < 60.0 * minutes + 1.0:
            if len(windows) >= PAGES:
                windows.pop(0).close()
            window = Window(chromium, 640, 400)
            window.page.goto(address)
            windows.append(window)
            turn += 1
            if gone >= next_row:
                note_progress(f"memory, minute {gone / 60.0:.1f}")
                rows.append(
                    {
                        "what": f"after {gone / 60.0:.1f} min",
                        "value": process.memory_info().rss / 2**20,
                        "pages": turn,
                    }
                )
                next_row += 60.0
            time.sleep(STAY / PAGES)
        rows.append(
            {"what": f"after {minutes:g} min", "value": process.memory_info().rss / 2**20, "pages": turn}
        )
        for window in windows:
            window.close()
    return rows


def measure(options: argparse.Namespace) -> list[Section]:
    """All tables."""
    if why := _missing():
        raise SystemExit(f"bench viewer needs a browser: {why}.")
    columns = [
        Column("what", "what"),
        Column("value", "measured", ".3g"),
        Column("unit", "unit"),
        Column("target", "target", "g"),
        Column("met", "met"),
    ]
    port = options.port
    note_progress("answer to a slider")
    taken = 1e3 * np.array(answers(6 if options.quick else 60))
    rows: list[Row] = [
        _row("slider to server state, median", float(np.median(taken)), "ms", 80.0),
        _row("slider to server state, 95 %", float(np.quantile(taken, 0.95)), "ms", 150.0),
        _row("page ready from `fastrod view`", start(port), "s", 5.0),
    ]
    seconds = 3.0 if options.quick else 20.0
    for what, target, words in (
        ("five_segment_reacher", 10.0, "one five-segment robot"),
        ("grid", 60.0, "64 five-segment robots"),
    ):
        rows.append(
            _row(
                f"server, {words} at 30 Hz", float(load(what, seconds, port)["value"]), "% of a core", target
            )
        )
    sections = [
        Section(
            "viewer",
            "The viewer, one page",
            columns,
            rows,
            [
                f"{len(taken)} key presses on a slider. Chromium draws in software beside the server, on "
                f"{os.cpu_count()} cores."
            ],
        )
    ]
    minutes = 0.2 if options.quick else options.minutes
    found = memory(minutes, port)
    settled = [float(row["value"]) for row in found[1:]] or [float(found[0]["value"])]
    growth = 100.0 * (settled[-1] / settled[0] - 1.0)
    notes = [
        f"{PAGES} pages of {STAY:g} s each, one opened every {STAY / PAGES:g} s.",
        f"Growth from the second row to the last: {growth:+.1f} % (target: within 5 %).",
    ]
    sections.append(
        Section(
            "memory",
            "Memory of the server",
            [Column("what", "what"), Column("value", "MiB", ".1f"), Column("pages", "pages so far", "d")],
            found,
            notes,
        )
    )
    return sections


def _row(what: str, value: float, unit: str, target: float) -> Row:
    return {"what": what, "value": value, "unit": unit, "target": target, "met": value <= target}


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print; the exit code."""
    parser = argparse.ArgumentParser(prog="bench_viewer", description=__doc__)
    parser.add_argument("--minutes", type=float, default=2.0, help="of motion, for memory (default: 2)")
    parser.add_argument("--port", type=int, default=8471)
    return command(parser, argv, measure)


if __name__ == "__main__":
    sys.exit(main())
