"""`view`: the server behind `fastrod view`, with a picker of what it shows."""

from __future__ import annotations

import contextlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any, final

from fastrod.access import Served
from fastrod.errors import FastrodError, InputError
from fastrod.loading import load_robot, with_line_density
from fastrod.logs.link import RobotLink
from fastrod.logs.runlog import RunLog
from fastrod.model.robot import Robot
from fastrod_scenes.scene import names
from fastrod_viewer.drive.page import DrivePage
from fastrod_viewer.ending import Ending
from fastrod_viewer.holder import Holder, HolderPanels
from fastrod_viewer.page import ViewerPage, is_upright, notify, plain
from fastrod_viewer.picture.canvas import Canvas
from fastrod_viewer.replay.page import ReplayPage
from fastrod_viewer.replay.playback import Playback, load
from fastrod_viewer.server import serve
from fastrod_viewer.watch import SceneWatch
from fastrod_viewer.worlds.catalogue import labels, open_world
from fastrod_viewer.worlds.simulated import FreeWorld
from fastrod_viewer.worlds.world import World

FIRST = "five_segment_reacher"
"""Shown unless something is named."""
MOST = 1024
"""Robots in a grid."""
_SOON = 0.5  # s in which a command that shows nothing says so alone
_BRAND = (37, 99, 235)


@final
class App:
    """One page at a time on one server, for every browser that is connected. `close` it, or use it as a
    context."""

    def __init__(
        self,
        *,
        host: str = "127.0.0.1",
        port: int | None = None,
        folder: Path | None = None,
        server: Served | None = None,
        say: Callable[[str], None] = lambda sentence: print(sentence, file=sys.stderr, flush=True),
    ) -> None:
        """`port` None takes the first free one from 8080 on, 0 any; `server` is one that `serve` has started
        already; `folder` takes what is recorded (default: where one stands); `say` hears what a person should
        know. Raises `InputError` where viser is missing, or the host or port cannot be had."""
        self.folder, self.say = folder or Path.cwd(), say
        self.served = server or serve(host, port)
        self.server = self.served.viser
        self.page: ViewerPage | None = None
        self._lock = threading.Lock()
        gui = self.server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, brand_color=_BRAND)
        gui.set_panel_label("fastrod")
        gui.main_panel.dock_left()
        self.canvas = Canvas(self.server)
        self.known = labels() | {DEMO_LOG: f"Log · {plain(DEMO_LOG)}"}
        """Name -> label in the picker."""
        self._current = FIRST
        self._picker: Any = None
        self.holder = Holder(lambda: self.watch.present(), changed=self._show_holder, moved=self._passed_on)
        self._panels = HolderPanels(self.server, self.holder)
        self.watch = SceneWatch(self.server, lost=self._lost, tick=self._tick)
        self.server.on_client_connect(self._came)

    def __enter__(self) -> App:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def address(self) -> str:
        """URL of the page, with the key that the page and its websocket need."""
        return self.served.address

    def open(
        self,
        what: str | Path | World | Robot | Playback,
        *,
        link: RobotLink | None = None,
        script: bool = False,
    ) -> None:
        """Show a scene or robot by name or file, a world, a robot, or a log with the predictions of models.
        With a `link`, manual commands drive that robot, and the world is its model. Raises `FastrodError`,
        and what was shown before stays."""
        with self._lock:
            new = self._found(what)
            _check_link(new, link)
            if self.page is not None:
                self.page.close()
                self.page = None
            if isinstance(new, Playback):
                self.page = ReplayPage(self.server, self.canvas, new)
            else:
                script = script or not isinstance(new, FreeWorld)
                self.page = DrivePage(
                    self.server,
                    self.canvas,
                    new,
                    folder=self.folder,
                    replay=self._replay,
                    echo=self._echo,
                    may=self._panels.may,
                    link=link,
                    script=script,
                )
            self.served.access.title = f"fastrod · {plain(self.page.title)}"
            self._show_picker(str(what) if isinstance(what, str) and not is_log(what) else self.page.title)
            self._picker.disabled = link is not None  # another scene would let go of the robot

    def wait(self) -> None:
        """Until Ctrl+C."""
        with contextlib.suppress(KeyboardInterrupt):
            self.server.sleep_forever()

    def close(self) -> None:
        """Stop what moves, save what is recorded, and end the server."""
        self.watch.close()
        with self._lock:
            if self.page is not None:
                self.page.close()
                self.page = None
        self.served.stop()

    def _found(self, what: str | Path | World | Robot | Playback) -> World | Playback:
        page = self.page
        if page is not None:
            page.rest(True)
        try:
            return found(what)
        except FastrodError:
            if page is not None:
                page.rest(False)
            raise

    def _show_picker(self, current: str) -> None:
        self._current, label = current, self.known.get(current, current)
        labels = tuple(self.known.values())
        if current not in self.known:
            labels = (label, *labels)
        if self._picker is None:
            self._picker = self.server.gui.add_dropdown("Show", labels, initial_value=label, order=-1.0)
            self._picker.on_update(self._picked)
        elif self._picker.value != label or tuple(self._picker.options) != labels:
            self._picker.options = labels
            self._picker.value = label

    def _picked(self, event: Any) -> None:
        if event.client_id is None:
            return
        label = event.target.value
        name = next((name for name, known in self.known.items() if known == label), label)
        before = self.known.get(self._current, self._current)
        if not self._panels.may(event):
            self._picker.value = before
            return
        note = event.client.add_notification(
            f"Opening {plain(name)}", "", loading=True, with_close_button=False
        )
        try:
            self.open(name)
        except FastrodError as error:
            notify(event.client, f"{plain(name)} cannot be shown", str(error), failed=True)
            self._picker.value = before
        finally:
            note.remove()

    def _replay(self, log: RunLog, world: World) -> None:
        """A recording beside the model, in a thread of its own: the session that calls this is closed by
        it."""

        def job() -> None:
            try:
                self.open(Playback.of(log, world.robot, None))
            except FastrodError as error:
                self.say(str(error))
                for client in self.server.get_clients().values():
                    notify(client, "The recording cannot be replayed", str(error), failed=True)

        threading.Thread(target=job, name="replay", daemon=True).start()

    def _came(self, client: Any) -> None:
        self._panels.show()
        if self.page is not None and is_upright(client):
            self.page.sight.show(client.camera, upright=True)

    def _echo(self) -> float:
        return self.watch.echo

    def _show_holder(self) -> None:
        self._panels.show()

    def _passed_on(self) -> None:
        page = self.page
        if page is not None:
            page.passed_on()

    def _tick(self) -> None:
        self.holder.tick()
        page = self.page
        if page is not None:
            for client in self.server.get_clients().values():
                page.sight.correct(client)
            page.tick()

    def _lost(self, client: int, left: int) -> None:
        self.holder.tick()
        self._panels.show()
        page = self.page
        if page is not None:
            page.lost(client, left)
        if left == 0:
            self.say("No page is open, or none answers; nothing is commanded until one does.")


DEMO_LOG = "demo_log"
"""The log that ships with the package, in the picker."""


def found(
    what: str | Path | World | Robot | Playback, robot: str | Path | None = None, n_robots: int = 1
) -> World | Playback:
    """Return what a page shows: the log or world that a name or a path stands for, or what was given; `robot`
    is a log's, `n_robots` of a robot stand in a grid. Raises `FastrodError`, one sentence, where there is
    none."""
    if isinstance(what, (World, Playback)):
        return what
    if _drawn(n_robots) != 1:
        if not isinstance(what, Robot) and str(what) in names():
            raise InputError(
                f"{str(what)!r} is a scene, which has its own robots; several in a grid can be "
                "had of a robot."
            )
        return FreeWorld(what if isinstance(what, Robot) else load_robot(what), n_robots)
    if str(what) == DEMO_LOG:
        return demo_log()
    if not isinstance(what, Robot) and is_log(what):
        return load(what, robot)
    if robot is not None:
        raise InputError(f"--robot goes with a run log; {str(what)!r} is none.")
    return open_world(what)


def found_in_motion(
    what: str | Path | World | Robot | Playback,
    n_robots: int = 1,
    *,
    line_density: float | None = None,
    dt: float | None = None,
) -> FreeWorld:
    """Return the world of a robot that has inertia, a name, a path or itself, with `line_density` [kg/m] in
    place of its own, and a time step `dt` [s]. Raises `FastrodError`, one sentence, where it has no mass or
    is no robot."""
    named = isinstance(what, (str, Path)) and str(what) != DEMO_LOG and not is_log(what)
    if not isinstance(what, Robot) and (not named or str(what) in names()):
        raise InputError(f"{_title(what)!r} is no robot, and --dynamics goes with one, such as ethz_beam.")
    robot = what if isinstance(what, Robot) else load_robot(str(what))
    return FreeWorld(with_line_density(robot, line_density), _drawn(n_robots), dt, dynamics=True)


def _title(what: object) -> str:
    return what.name if isinstance(what, World) else "a log" if isinstance(what, Playback) else str(what)


def _drawn(n_robots: int) -> int:
    """So many robots. Raises `InputError` where a browser would not draw them."""
    if n_robots > MOST:
        raise InputError(f"n_robots is {n_robots}; a browser draws up to {MOST}.")
    return n_robots


def _check_link(shown: World | Playback, link: RobotLink | None) -> None:
    if link is None:
        return
    if isinstance(shown, World) and shown.ringing is not None:
        raise InputError(f"a robot link goes with a world without inertia; {shown.name!r} rings by itself.")
    if isinstance(shown, Playback):
        raise InputError("a robot link goes with a world, which is its model; a log has none.")
    ours, theirs = shown.robot, link.robot
    if (ours.n_tendons, ours.n_segments) != (theirs.n_tendons, theirs.n_segments):
        raise InputError(
            f"the link's robot {theirs.name!r} has {theirs.n_segments} segments and {theirs.n_tendons} "
            f"tendons, its model {ours.name!r} "
            f"{ours.n_segments} and {ours.n_tendons}; give the model of the robot that is driven."
        )


def demo_log() -> Playback:
    """The log that ships with the package, beside the prototype."""
    from importlib.resources import as_file, files

    with as_file(files("fastrod") / "data" / "demo_log.csv") as path:
        return load(path, "prototype")


def is_log(what: str | Path) -> bool:
    """It names a file that is not a robot's."""
    suffix = Path(what).suffix
    return suffix in (".csv", ".parquet") or (suffix != ".toml" and Path(what).is_file())


def view(
    what: str | Path | World | Robot | Playback = FIRST,
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    open_browser: bool = True,
    robot: str | Path | None = None,
    n_robots: int = 1,
    link: RobotLink | None = None,
    script: bool = False,
    server: Served | None = None,
    dynamics: bool = False,
    line_density: float | None = None,
    dt: float | None = None,
) -> None:
    """Show something in the browser until Ctrl+C: a scene or robot by name, a robot's file, a log with what
    models say to it.

    With `dynamics` a robot has inertia and rings (`found_in_motion`), by its own masses or `line_density`
    [kg/m], in steps of `dt` [s]. `server` is one that `serve` has started. SIGTERM ends it as Ctrl+C does:
    robots are stopped, recordings saved. Raises `FastrodError`, one sentence, for what cannot be shown.
    """
    if not dynamics and not (line_density is None and dt is None):
        given = "--dt" if line_density is None else "--line-density"
        raise InputError(f"{given} goes with --dynamics: without, nothing has inertia.")
    if dynamics and robot is not None:
        raise InputError("--robot goes with a run log, and --dynamics with a robot; give one of them.")
    with Ending(), App(host=host, port=port, server=server) as app:
        line = f"{_title(what)}: {app.address} (Ctrl+C ends it)"
        address = threading.Timer(_SOON, print, (line,), {"flush": True})
        address.start()  # a first world compiles for half a minute
        try:
            shown = (
                found_in_motion(what, n_robots, line_density=line_density, dt=dt)
                if dynamics
                else found(what, robot, n_robots)
            )
        except BaseException:
            address.cancel()
            raise
        address.join()
        if open_browser:
            app.served.open_browser()
        app.open(shown, link=link, script=script)
        if app.served.elsewhere:
            app.say(
                f"Other machines can open this page, too, at {app.served.elsewhere} and whoever has this "
                "address can drive: it is the key, nobody gets in without it, and it travels unencrypted."
            )
        app.wait()
