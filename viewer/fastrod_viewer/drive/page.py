"""`DrivePage`: a robot that is driven by hand or by its script, recorded and exported."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import numpy as np
from numpy.typing import NDArray

from fastrod.errors import InputError
from fastrod.logs.link import Measurement, RobotLink
from fastrod.logs.recording import free_path
from fastrod.logs.runlog import RunLog
from fastrod_viewer.drive.control_panel import ControlPanel, stops
from fastrod_viewer.drive.drag_handle import DragHandle
from fastrod_viewer.drive.linked import Linked
from fastrod_viewer.drive.session import Session, ViewFrame
from fastrod_viewer.drive.teleop import Speeds, Teleop
from fastrod_viewer.export import wrap
from fastrod_viewer.page import (
    PageView,
    ViewerPage,
    facts,
    heading,
    millimetres,
    notify,
    picture,
    plain,
    save_name,
    send,
    stand_back,
)
from fastrod_viewer.picture.canvas import Canvas
from fastrod_viewer.picture.drawing import Drawing
from fastrod_viewer.picture.options import FINE, Body, ColorBy, ViewOptions
from fastrod_viewer.worlds.world import World

if TYPE_CHECKING:
    import viser

_GENTLE = 1.0 / 6.0  # of the usual speeds, among obstacles
_REAL = 0.25  # of the usual speeds, where motion may do harm
_SHOW_EVERY = 0.2  # s between two changes of figures and sliders
_WIDE = 320  # pixels of the window for a camera in hand
_LOOKS = 0.15  # s between two pictures of a camera in hand
_LONG = 1.5  # s of one step
_FARTHER = 1.35  # away from a robot beside whose picture there is one of a camera
_NOTHING = np.full((240, 320, 3), 230, dtype=np.uint8)  # before the first picture
_COMPILING = (
    "Computing … The first use of contact compiles for a minute or two, once on this machine; "
    "tight contact takes its time, too."
)
_GO_ON = "After a stop: commands are taken again, from where the robot stands."
_COLORS: dict[str, ColorBy] = {
    "segment": "segment",
    "curvature": "curvature",
    "surface strain": "strain",
    "tendon tension": "tension",
}
_OPTION_LABELS = {
    "spacers": "Spacers",
    "tendons": "Tendons",
    "contacts": "Contact forces",
    "loads": "Loads",
    "frames": "Tip frame",
}
_SPEEDS = {"real time": 1.0, "1/2": 1.0 / 2.0, "1/5": 1.0 / 5.0, "1/10": 1.0 / 10.0, "1/20": 1.0 / 20.0}
_BODIES: dict[str, Body] = {"backbone and tendons": "backbone", "skin": "skin"}


@final
class DrivePage(ViewerPage):
    """Controls on one side, the robot, a legend, and what its camera sees."""

    def __init__(
        self,
        server: viser.ViserServer,
        canvas: Canvas,
        world: World,
        *,
        folder: Path,
        replay: Callable[[RunLog, World], None],
        echo: Callable[[], float],
        may: Callable[[Any], bool],
        link: RobotLink | None = None,
        script: bool = False,
    ) -> None:
        """`folder` takes recordings; `replay` shows one; `echo` is the time that pages take to draw [s];
        `may` says of an event whether the page it comes from may act."""
        self.server, self.world, self.title, self._may = server, world, world.name, may
        self._folder, self._replay, self._echo = folder, replay, echo
        has_contact = world.rods[0].state.contacts is not None
        far = None if link is None else Linked(link)
        gentle = _GENTLE if has_contact else _REAL if link is not None and link.real else 1.0
        self.teleop = Teleop(world, Speeds().times(gentle), limits=None if far is None else far.limits)
        many = len(world.rods[0].state.ok) > FINE
        self.drawing = Drawing(
            canvas,
            world,
            ViewOptions(body="skin" if has_contact or many else "backbone"),
            measured=link is not None,
        )
        self.sight = PageView(
            self.drawing.middle, self.drawing.size * (1.0 if far is None or not far.sees else _FARTHER)
        )
        self.session = Session(world, self.teleop, draw=self._draw, link=link, script=script)
        least, most = 0.02 * world.robot.length, 0.1 * world.robot.length  # of a slim one, to be caught
        ball = min(max(1.25 * self.drawing.radius, least), most)
        middle, can = world.rods[0].place[0], self._can_drag()
        self.drag_handle = DragHandle(server, self.session, ball, middle, may=may) if can else None
        self._latency = float("nan")
        self._shown = self._looked = 0.0
        self._last: RunLog | None = None
        self._path = folder
        self._closing = False
        self._build()
        stand_back(server, self.sight)
        self._draw(ViewFrame(world, None, None, float("nan"), 1.0, ""))
        self.session.start()

    def close(self) -> None:
        """End the session, which saves what is recorded, and take controls and drawing away."""
        self._closing = True
        self.session.close()
        self.controls.close()
        if self.drag_handle is not None:
            self.drag_handle.remove()
        self.panel.remove()
        self.aside.remove()
        if self.camera is not None:
            self.camera[0].remove()
        self.drawing.canvas.clear()

    def rest(self, on: bool) -> None:
        """Pause the session, or resume it."""
        self.session.paused = on

    def tick(self) -> None:
        """Say why nothing moves while one step takes longer than `_LONG`."""
        if self.session.waiting > _LONG:
            self.figures.content = facts([("Tip", self._tip())], news=_COMPILING)

    def lost(self, client: int, left: int) -> None:
        """Release the drag handle for this client; with nobody left, every motion stops
        (`Session.nobody`)."""
        if self.drag_handle is not None:
            self.drag_handle.lost(client)
        if left == 0:
            self.session.nobody()

    def passed_on(self) -> None:
        """Stop every motion: the page that commanded it has the controls no longer."""
        self.session.teleop.hold()
        self.session.wake()

    def export(self) -> str:
        """The robot as it stands now, with its legend, time and tip; nothing moves in it."""
        serializer = self.server.get_scene_serializer()
        shown: list[tuple[str, str]] = [
            ("robot", self.world.robot.name),
            ("t", f"{self.world.t:.2f} s"),
            ("tip", self._tip()),
        ]
        return wrap(
            serializer.as_html(),
            title=self.title,
            subtitle=self.world.about,
            legend_html=self.drawing.legend,
            plot_svg=None,
            facts=shown,
            note="Drag to rotate, scroll to zoom.",
        )

    def _can_drag(self) -> bool:
        bends = self.teleop.actions is not None
        return self.world.drivable and (bends or self.world.ringing is not None)

    def _build(self) -> None:
        import viser

        gui, session = self.server.gui, self.session
        self.panel = gui.add_folder(None)
        with self.panel:
            gui.add_html(heading(plain(self.title), self.world.about, self._hint()))
            self.stop = gui.add_button(
                "STOP",
                color="red",
                icon=viser.Icon.HAND_STOP,
                hint="Everything stands still at once. Key: Esc",
            )
            self.stop.on_click(stops(session))
            self.go_on = gui.add_button(
                "Resume", color="green", icon=viser.Icon.PLAYER_PLAY, disabled=True, hint=_GO_ON
            )
            self.go_on.on_click(lambda event: session.release() if self._may(event) else None)
            # below: as it grows and shrinks, it must not move Resume to where STOP was
            self.figures = gui.add_html("")
            self.run = gui.add_button_group("Run", self._runs())
            self.run.on_click(self._run)
            if self.world.ringing is not None:
                self._slow_motion()
            tabs = gui.add_tab_group()
            drive = tabs.add_tab("Drive", viser.Icon.ADJUSTMENTS)
            loads = tabs.add_tab("Loads", viser.Icon.WEIGHT)
            self.controls = ControlPanel(self.server, session, drive, loads, may=self._may)
            with tabs.add_tab("View", viser.Icon.EYE):
                self._view()
            with tabs.add_tab("Save", viser.Icon.FILE_EXPORT):
                self._save()
            gui.add_markdown(self._keys())
        self.aside = gui.add_panel()
        with self.aside.add_tab("Legend"):
            self.legend = gui.add_html(self.drawing.legend)
        self.aside.float(x=-15, y=-15, width=230)
        self.camera: tuple[Any, Any] | None = None
        far = session.far
        seen = self._seen()
        if seen is not None or (far is not None and far.sees):
            window = gui.add_panel()
            with window.add_tab("Camera in hand" if far is None else "Camera", viser.Icon.CAMERA):
                self.camera = window, gui.add_image(fitted(_NOTHING if seen is None else seen), format="jpeg")
            window.float(x=-15, y=15, width=240 if far is None else 290)

    def _seen(self) -> NDArray[np.uint8] | None:
        far = self.session.far
        return self.world.picture() if far is None else far.picture()

    def _runs(self) -> tuple[str, ...]:
        steps = ("Step",) if self.session.link is None else ()
        return ("Resume" if self.session.paused else "Pause", *steps, "Reset")

    def _keys(self) -> str:
        keys = "<kbd>Space</kbd> pause · <kbd>Esc</kbd> stop · <kbd>R</kbd> reset"
        if self._can_drag() and self.teleop.actions is not None:
            keys = "<kbd>J</kbd> <kbd>L</kbd> <kbd>I</kbd> <kbd>K</kbd> bend · " + keys
            if len(driven := self.teleop.driven[:9]) > 1:
                keys += f" · <kbd>{driven[0] + 1}</kbd>–<kbd>{driven[-1] + 1}</kbd> segment that keys bend"
        return f"<small>{keys}</small>"

    def _hint(self) -> str:
        """Return what to try, in a sentence."""
        if self.world.ringing is not None:
            return "Pull the ball at its tip, and let go."
        if self._can_drag():
            return "Drag the ball at its tip, or move a slider."
        return "" if self.world.drivable else "It plays by itself."

    def _slow_motion(self) -> None:
        """A choice of how fast the world's time goes, beside the clock of the wall."""
        choice: Any = self.server.gui.add_dropdown(
            "Slow motion", tuple(_SPEEDS), hint="How fast the world's time goes, where the machine can."
        )

        def change(event: Any) -> None:
            if event.client_id is None:
                return
            if self._may(event):
                self.session.speed = _SPEEDS[choice.value]
            else:
                choice.value = next(name for name, speed in _SPEEDS.items() if speed == self.session.speed)

        choice.on_update(change)

    def _view(self) -> None:
        gui, options = self.server.gui, self.drawing.options
        color = gui.add_dropdown("Colour", tuple(_COLORS), initial_value="segment")
        body = gui.add_dropdown(
            "Body", tuple(_BODIES), initial_value=next(k for k, v in _BODIES.items() if v == options.body)
        )
        boxes = {
            name: gui.add_checkbox(label, getattr(options, name)) for name, label in _OPTION_LABELS.items()
        }
        trail = gui.add_checkbox("Trail of the tip", True)

        def change(_: object) -> None:
            shown = {name: bool(box.value) for name, box in boxes.items()}
            new = ViewOptions(color_by=_COLORS[color.value], body=_BODIES[body.value], **shown)
            self.session.submit(lambda: self._look(new, bool(trail.value)))

        color.on_update(change)
        body.on_update(change)
        for box in (trail, *boxes.values()):
            box.on_update(change)
        back = gui.add_button("Reset camera", color="gray")
        back.on_click(lambda _: stand_back(self.server, self.sight))

    def _look(self, options: ViewOptions, trail: bool) -> None:
        self.drawing.look(options, trail=trail)
        self.legend.content = self.drawing.legend

    def _save(self) -> None:
        import viser

        gui = self.server.gui
        self.record = gui.add_button("Record a run log", icon=viser.Icon.PLAYER_RECORD, color="red")
        self.record.on_click(self._recording)
        self.recorded = gui.add_markdown(
            "Inputs, tip and tensions at every step, as a CSV that `fastrod identify` reads."
        )
        self.again = gui.add_button("Replay the recording", color="gray", disabled=True)
        self.again.on_click(lambda event: self._play_back() if self._may(event) else None)
        page = gui.add_button(
            "Export as a web page",
            color="gray",
            hint="One HTML file; it opens without a server and without a network.",
        )
        page.on_click(lambda event: send(event.client, f"{self.title}.html", lambda: self.export().encode()))
        png = gui.add_button("Save a picture (PNG)", color="gray")
        png.on_click(lambda event: send(event.client, f"{self.title}.png", lambda: picture(event.client)))

    def _recording(self, event: Any) -> None:
        if self._may(event):
            self.session.submit(lambda: self._toggle_record(event.client))

    def _play_back(self) -> None:
        if self._last is not None:
            self._replay(self._last, self.world)

    def _toggle_record(self, client: Any) -> None:
        """In the session's thread."""
        session = self.session
        if session.recorder is None:
            self._path = free_path(self._folder / f"{self.world.robot.name}-session.csv")
            session.record(self._path)
            self.record.label = "Stop and save"
            self.recorded.content = f"Recording to `{save_name(self._path)}` …"
            return
        self.record.label = "Record a run log"
        try:
            log = session.end_recording()
        except InputError as error:
            self.recorded.content = str(error)
            notify(client, "Nothing was saved", str(error), failed=True)
            return
        if log is not None:
            self._last, self.again.disabled = log, session.link is not None
            self.recorded.content = f"Saved {len(log)} samples in `{save_name(self._path)}`."
            notify(client, "Saved", f"{len(log)} samples in {save_name(self._path)}")

    def _run(self, event: Any) -> None:
        session, what = self.session, event.target.value
        if what != "Pause" and not self._may(event):  # every page may pause
            return
        match what:
            case "Pause" | "Resume":
                session.paused = what == "Pause"
            case "Step":
                session.step()
            case "Reset":
                session.reset()
                self.session.submit(self.drawing.forget)

    def _draw(self, frame: ViewFrame) -> None:
        """In the session's thread."""
        if self._closing:
            return
        began = time.perf_counter()
        with self.server.atomic():
            self.drawing.draw(frame)
            if self.drag_handle is not None:
                self.drag_handle.follow(self.drawing.tip())
        self.server.flush()
        if frame.latency == frame.latency:
            self._latency = frame.latency + time.perf_counter() - began
        if began - self._shown > _SHOW_EVERY or frame.latency == frame.latency:
            self._shown = began
            self._show_status(frame)
        if self.camera is not None and began - self._looked > _LOOKS:
            self._looked = began
            seen = self._seen()
            if seen is not None:
                self.camera[1].image = fitted(seen)

    def _show_status(self, frame: ViewFrame) -> None:
        rows = [("Tip", self._tip())]
        session = self.session
        if frame.measured is not None and np.isfinite(frame.measured.tip_position).all():
            state = self.world.rods[0].state
            model = state.rotation[0, 0].T @ (state.tip_position[0] - state.position[0, 0])
            rows.append(("Measured tip", millimetres(frame.measured.tip_position)))
            rows.append(
                ("Measured − model", f"{1e3 * np.linalg.norm(frame.measured.tip_position - model):.2f} mm")
            )
        if session.far is not None and frame.measured is not None:
            rows += far_rows(session.far, frame.measured)
        t, ringing = self.world.t if frame.measured is None else frame.measured.t, self.world.ringing
        slower = f", {frame.pace:.0%} of real time" if frame.pace < 0.95 else ""
        rows.append(("Time", f"{t:.{1 if ringing is None else 2}f} s{slower}"))
        if ringing is not None:
            rows.append(("Rings at", f"{ringing.frequency:.3g} Hz"))
        if self._latency == self._latency:
            echo = self._echo()
            drawn = f" + {1e3 * echo:.0f} browser" if echo == echo else ""
            rows.append(("Latency", f"{1e3 * self._latency:.0f}{drawn} ms"))
        problem, news = self._state(frame)
        content = facts(rows, problem, news=news)
        if content != self.figures.content:
            self.figures.content = content
        releasing = session.releasing
        label, off = "RELEASING …" if releasing else "Resume", releasing or not session.stopped
        if self.go_on.label != label:
            self.go_on.label = label
        if self.go_on.disabled != off:  # it stays in its place: what comes and goes would slip under a click
            self.go_on.disabled = off
        options = self._runs()
        if tuple(self.run.options) != options:
            self.run.options = options
        self.controls.follow()
        if (
            self.drawing.options.color_by != "segment"
            and (legend := self.drawing.legend) != self.legend.content
        ):
            self.legend.content = legend

    def _state(self, frame: ViewFrame) -> tuple[str, str]:
        """Return what is wrong, and what is worth knowing."""
        session = self.session
        status = "" if session.far is None else session.far.status
        if session.releasing:
            return "", f"Releasing. {status}"
        if session.stopped:
            how = (
                "Resume within a second of a stop is ignored; press it again."
                if session.hasty
                else "Press the green button to resume."
            )
            return f"{status or 'Stopped.'} {how}", ""
        if session.link is not None:
            return frame.problem, status
        return frame.problem and f"{frame.problem} Reset begins anew.", ""

    def _tip(self) -> str:
        return millimetres(self.world.rods[0].state.tip_position[0])


def fitted(seen: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """(height, width, 3) a picture about as wide as its window: of a small one every pixel many times, of a
    large one not every pixel."""
    apart = max(1, seen.shape[1] // _WIDE)
    times = max(1, round(_WIDE / seen.shape[1]))
    return np.repeat(np.repeat(seen[::apart, ::apart], times, axis=0), times, axis=1)


def far_rows(far: Linked, measured: Measurement) -> list[tuple[str, str]]:
    """Return what a robot at the other end of a link reports of itself."""
    tension = far.tension(measured)
    rows = (
        [("Tendons pull", " · ".join(f"{value:.2f}" for value in tension.tolist()) + " N")]
        if np.isfinite(tension).all()
        else []
    )
    return rows + ([("Camera", camera)] if (camera := far.camera()) else [])
