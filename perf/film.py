"""The README's moving picture: scenes of the viewer, drawn by a browser, frame by frame.

python perf/film.py viewer/film.gif              needs Debian's chromium, playwright and Pillow
python perf/film.py FILE.gif --scene airway:4    other scenes, each with the seconds that it is shown for, how
near, how fast
"""

from __future__ import annotations

import argparse
import io
import shutil
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))

SCENES = ("grid:3:0.6:1", "airway:3.6:0.78:0.5", "pick_gripper:4:0.6:2")
RATE = 12.0  # frames a second
SIZE = 640, 360


def frames(browser: Any, scene: str, seconds: float, closer: float, speed: float) -> Iterator[Any]:
    """Pictures (Pillow) of a scene's script, from its first step on."""
    from PIL import Image
    from windows import Window

    from fastrod_viewer.app import found
    from fastrod_viewer.canvas import Canvas
    from fastrod_viewer.drawing import Drawing
    from fastrod_viewer.options import FINE, ViewOptions
    from fastrod_viewer.page import PageView, stand_back
    from fastrod_viewer.server import serve
    from fastrod_viewer.session import ViewFrame

    world = found(scene)
    server = serve(port=0)
    window = Window(browser, *SIZE)
    try:
        many = len(world.rods[0].state.ok) > FINE
        drawing = Drawing(
            Canvas(server),
            world,
            ViewOptions(body="skin" if many or world.rods[0].state.contacts is not None else "backbone"),
        )
        sight = PageView(drawing.middle, closer * drawing.size)
        window.go(f"http://127.0.0.1:{server.get_port()}")
        window.close_toast()
        window.page.add_style_tag(
            content=".mantine-Paper-root, .mantine-Notifications-root { display: none !important; }"
        )
        window.until(lambda: bool(server.get_clients()))
        stand_back(server, sight)
        window.page.wait_for_timeout(2000)
        steps = max(1, round(speed / RATE / world.dt))
        for _ in range(round(seconds * RATE)):
            for _ in range(steps):
                world.play()
            drawing.draw(ViewFrame(world, None, None, float("nan"), 1.0, ""))
            server.flush()
            window.page.wait_for_timeout(250)
            yield Image.open(io.BytesIO(window.page.locator("canvas").first.screenshot())).convert("RGB")
    finally:
        window.close()
        world.close()
        server.stop()


def reduced(shots: Sequence[Any]) -> list[Any]:
    """In one palette: colours must not change from frame to frame."""
    from PIL import Image

    sheet = Image.new("RGB", (SIZE[0], 8 * SIZE[1]))
    for k in range(8):
        sheet.paste(shots[k * (len(shots) - 1) // 7], (0, k * SIZE[1]))
    palette = sheet.quantize(255, method=Image.Quantize.MAXCOVERAGE)
    return [shot.quantize(palette=palette, dither=Image.Dither.NONE) for shot in shots]


def main(argv: Sequence[str] | None = None) -> int:
    """Film and write; the exit code."""
    parser = argparse.ArgumentParser(
        prog="film", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, metavar="FILE.gif")
    parser.add_argument(
        "--scene",
        action="append",
        metavar="NAME[:SECONDS[:NEARNESS[:SPEED]]]",
        help=f"again for more; default {' '.join(SCENES)}",
    )
    options = parser.parse_args(argv)
    from playwright.sync_api import sync_playwright
    from windows import ARGUMENTS

    few: list[Any] = []
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        for scene in options.scene or SCENES:
            name, *numbers = scene.split(":")
            seconds, closer, speed = (*map(float, numbers), *(3.0, 0.8, 1.0)[len(numbers) :])
            few += reduced(list(frames(browser, name, seconds, closer, speed)))
        browser.close()
    few[0].save(
        options.out,
        save_all=True,
        append_images=few[1:],
        duration=round(1000.0 / RATE),
        loop=0,
        optimize=True,
    )
    print(f"wrote {options.out}: {len(few)} frames, {options.out.stat().st_size / 1e6:.1f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
