"""`ReplayPage`: a measured log beside what one model or two say to the same inputs, with a time slider."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, final

import numpy as np

from fastrod.errors import FastrodError
from fastrod.types import Floats
from fastrod_viewer.export import wrap
from fastrod_viewer.page import ViewerPage, facts, heading, notify, picture, plain, send, stand_back
from fastrod_viewer.picture.canvas import Canvas
from fastrod_viewer.picture.palette import MEASURED, css
from fastrod_viewer.replay.drawing import BOTH, ReplayDrawing
from fastrod_viewer.replay.playback import Playback, identify
from fastrod_viewer.replay.residual_plot import AFTER, BEFORE, curves, svg

if TYPE_CHECKING:
    import viser

_RATE = 30.0
_SHOW_EVERY = 0.15  # s between two changes of slider and plot
_HELD = 0.3  # s after a person has moved the slider, in which it is left alone
_FAR = 30  # frames: a longer jump is no motion, and leaves no trail
_SPEEDS = {"¼ ×": 0.25, "1 ×": 1.0, "4 ×": 4.0, "16 ×": 16.0}
_FACTORS = ("1", "2", "5", "10", "20", "50")
_SEEN = 0.15  # of the robot's length: the usual residual is drawn about so long
_EXPORTED = 240  # frames of an exported page
_FIND = "Find the missing effect"
_ABOUT = "A measured log beside the prediction of the model; the arrow is the residual at the tip."
_HINT = "Move the time, or choose another model."


@final
class ReplayPage(ViewerPage):
    """The robot as models have it, the measured tip, the residual as an arrow and over time, and a switch
    between the models."""

    def __init__(self, server: viser.ViserServer, canvas: Canvas, playback: Playback) -> None:
        self.server, self.canvas = server, canvas
        self.title = playback.log.name
        self.frame = -1
        """That is shown."""
        self._lock = threading.RLock()
        self._closed, self._wake = threading.Event(), threading.Event()
        self._speed, self._playing = 1.0, True
        self._scrubbed = self._shown = 0.0
        self._made: list[Any] = []
        self._take(playback)
        self._thread = threading.Thread(target=self._run, name=f"replay {self.title}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread that plays, and clear the canvas."""
        self._closed.set()
        self._wake.set()
        self._thread.join(timeout=10.0)
        with self._lock:
            self._clear()

    def rest(self, on: bool) -> None:
        """It computes next to nothing."""

    def tick(self) -> None:
        """Do nothing."""

    def lost(self, client: int, left: int) -> None:
        """With nobody left it plays no further."""
        del client
        if left == 0:
            self._playing = False

    def passed_on(self) -> None:
        """It drives nothing."""

    def export(self) -> str:
        """With the motion in it, in at most 240 frames."""
        playback = self.playback
        n = len(playback.frames)
        frames = np.unique(np.linspace(0, n - 1, min(_EXPORTED, n)).round().astype(int))
        pause = float(np.clip(playback.duration / max(len(frames) - 1, 1), 1.0 / _RATE, 0.2))
        with self._lock:
            self.drawing.forget()
            self._draw(int(frames[0]))
            serializer = self.server.get_scene_serializer()
            for frame in frames:
                self.drawing.forget()  # between frames far apart a trail is a zigzag
                self._draw(int(frame))
                serializer.insert_sleep(pause)
            html = serializer.as_html()
            self.frame = -1
        rows = [
            ("samples", str(len(playback.log))),
            *((track.label, f"{1e3 * track.rms:.3f} mm rms") for track in playback.tracks),
        ]
        faster = playback.duration / max(pause * (len(frames) - 1), 1e-9)
        if faster > 1.1:
            rows.append(("shown", f"{faster:.1f} times as fast"))
        found = playback.findings
        if found is not None:
            rows.append(("verdict", found.verdict.replace("_", " ")))
        return wrap(
            html,
            title=self.title,
            subtitle="Measured beside predicted",
            legend_html=self.drawing.legend,
            plot_svg=svg(playback),
            facts=rows,
            note=found.summary if found is not None else "",
        )

    def _take(self, playback: Playback) -> None:
        """Show this playback from now on."""
        with self._lock:
            self._clear()
            self.playback = playback
            self.drawing = ReplayDrawing(self.canvas, playback)
            self.sight = self.drawing.sight
            self.choice = playback.tracks[-1].label
            """Label of the model that is shown, or `both`."""
            usual = max(playback.tracks[-1].rms, 1e-9)
            self._magnify = min(
                _FACTORS, key=lambda f: abs(np.log(float(f) * usual / (_SEEN * self.drawing.length)))
            )
            self._time, self.frame = 0.0, -1
            self._build()
            stand_back(self.server, self.sight)
            self._draw(0)

    def _clear(self) -> None:
        for handle in self._made:
            handle.remove()
        self._made = []
        self.canvas.clear()

    def _build(self) -> None:
        gui, playback = self.server.gui, self.playback
        panel, aside, below = gui.add_folder(None), gui.add_panel(), gui.add_panel()
        with panel:
            gui.add_html(heading(plain(self.title), _ABOUT, _HINT))
            self.figures = gui.add_html("")
            duration = max(playback.duration, 1e-3)
            step = float(f"{max(duration / 2000.0, 1e-3):.1g}")
            self.slider: Any = gui.add_slider(
                "Time [s]", 0.0, float(np.ceil(duration / step) * step), step, 0.0
            )
            self.slider.on_update(self._scrub)
            self.play = gui.add_button("Pause", icon=_icon(True), hint="Key: space")
            self.play.on_click(lambda _: self._toggle())
            gui.add_dropdown("Speed", tuple(_SPEEDS), initial_value="1 ×").on_update(
                lambda e: self._set(speed=_SPEEDS[e.target.value])
            )
            labels = tuple(track.label for track in playback.tracks)
            options = (*labels, BOTH) if len(labels) > 1 else labels
            gui.add_dropdown("Model", options, initial_value=self.choice).on_update(
                lambda e: self._set(choice=e.target.value)
            )
            hint = "The arrow from the predicted to the measured tip is drawn so many times longer."
            magnify = gui.add_dropdown("Residual ×", _FACTORS, initial_value=self._magnify, hint=hint)
            magnify.on_update(lambda e: self._set(magnify=e.target.value))
            if playback.findings is None:
                self.find = gui.add_button(
                    _FIND, color="teal", hint="As `fastrod identify` does, on this log: seconds to minutes."
                )
                self.find.on_click(lambda event: self._identify(event.client))
            gui.add_html(self._verdict())
            page = gui.add_button(
                "Export as a web page", color="gray", hint="One HTML file with the motion in it."
            )
            page.on_click(
                lambda event: send(event.client, f"{self.title}.html", lambda: self.export().encode())
            )
            png = gui.add_button("Save a picture (PNG)", color="gray")
            png.on_click(lambda event: send(event.client, f"{self.title}.png", lambda: picture(event.client)))
        with aside.add_tab("Legend"):
            gui.add_html(self.drawing.legend)
        aside.float(x=-15, y=15, width=240)
        self._curves = curves(playback)
        with below.add_tab("Residual [mm]"):
            self.plot: Any = self._add_plot()
        below.float(x=15, y=-15, width=760)
        key = gui.add_command("Play, or pause", hotkey="space")
        key.on_trigger(lambda _: self._toggle())
        self._made = [panel, aside, below, key]

    def _add_plot(self) -> Any:
        from viser import uplot

        lines, tracks = self._curves, self.playback.tracks
        colors = (BEFORE, AFTER)
        dot: Any = {"show": True, "size": 9, "fill": css(MEASURED)}
        series = [
            uplot.Series(label="t [s]"),
            *(
                uplot.Series(label=track.label, stroke=color, width=1.5)
                for track, color in zip(tracks, colors, strict=False)
            ),
            uplot.Series(label="now", stroke=css(MEASURED), points=dot),
        ]
        most = max(
            float(np.nanmax(line, initial=1e-9)) for line in (lines.before, lines.after) if line is not None
        )
        scales = {"x": uplot.Scale(time=False), "y": uplot.Scale(range=(0.0, 1.08 * most))}
        axes = (uplot.Axis(label="time [s]"), uplot.Axis(label="mm"))
        legend = uplot.Legend(live=False)  # names and colours; a value only where the mouse is says nothing
        return self.server.gui.add_uplot(
            self._plotted(0), tuple(series), axes=axes, scales=scales, legend=legend, height=170
        )

    def _plotted(self, frame: int) -> tuple[Floats, ...]:
        """The curves, and a dot where the clock is."""
        lines = self._curves
        chosen = (
            lines.before if lines.after is None or self.choice == self.playback.before.label else lines.after
        )
        now = np.full(len(lines.time), np.nan)
        k = min(int(np.searchsorted(lines.time, self.playback.frame_time[frame])), len(now) - 1)
        now[k] = chosen[k]
        return (
            (lines.time, lines.before, now)
            if lines.after is None
            else (lines.time, lines.before, lines.after, now)
        )

    def _verdict(self) -> str:
        found = self.playback.findings
        if found is None:
            return ""
        before, after = (1e3 * v for v in found.held_out_rms)
        named = ", ".join(name.replace("_", " ") for name in found.effects) or "none"
        rows = [
            ("Verdict", found.verdict.replace("_", " ")),
            ("Effects", named),
            ("Held out", f"{before:.3f} → {after:.3f} mm rms"),
        ]
        return facts(rows)

    async def _scrub(self, event: Any) -> None:  # in viser's loop, before the clock moves the slider again
        if event.client_id is not None:
            self._scrubbed, self._playing, self._time = time.perf_counter(), False, float(event.target.value)
            self._wake.set()

    def _toggle(self) -> None:
        if not self._playing and self._time >= self.playback.duration:
            self._time = 0.0
        self._playing = not self._playing
        self._wake.set()

    def _set(
        self, *, speed: float | None = None, choice: str | None = None, magnify: str | None = None
    ) -> None:
        self._speed = speed or self._speed
        self.choice = choice or self.choice
        self._magnify = magnify or self._magnify
        self.frame = -1
        self._wake.set()

    def _identify(self, client: Any) -> None:
        button = self.find
        button.disabled, button.label = True, "Looking …"

        def progress(what: str, done: int, total: int) -> None:
            button.label = f"{what}: {done} of {total}" if total else what

        try:
            made = identify(self.playback, progress=progress)
        except FastrodError as error:
            notify(client, "Nothing could be found", str(error), failed=True)
            button.disabled, button.label = False, _FIND
            return
        if not self._closed.is_set():
            self._take(made)

    def _run(self) -> None:
        before = time.perf_counter()
        while not self._closed.is_set():
            self._wake.wait(1.0 / _RATE if self._playing else 0.5)
            self._wake.clear()
            now = time.perf_counter()
            if self._playing:
                self._time += self._speed * (now - before)
                if self._time > self.playback.duration:
                    self._time, self._playing = self.playback.duration, False
            before = now
            with self._lock:
                if not self._closed.is_set():
                    self._show(now)

    def _show(self, now: float) -> None:
        label = "Pause" if self._playing else "Play" if self._time < self.playback.duration else "Play again"
        if self.play.label != label:
            self.play.label, self.play.icon = label, _icon(self._playing)
        frame = self.playback.at(self._time)
        if frame == self.frame:
            return
        if not 0 <= frame - self.frame <= _FAR:
            self.drawing.forget()
        self._draw(frame)
        self.frame = frame
        if self._playing and now - self._shown < _SHOW_EVERY:
            return
        self._shown = now
        playback, row = self.playback, self.playback.frames[frame]
        rows = [("Time", f"{self._time:.2f} s of {playback.duration:.1f} s")]
        if run := playback.run_at(frame):
            rows.append(("Run", run))
        names = ("Residual before", "Residual after") if playback.after is not None else ("Residual",)
        rows += [
            (name, f"{1e3 * track.residual[row]:.2f} mm, rms {1e3 * track.rms:.2f}")
            for name, track in zip(names, playback.tracks, strict=True)
        ]
        self.figures.content = facts(rows)
        self.plot.data = self._plotted(frame)
        if self._playing and now - self._scrubbed > _HELD:
            self.slider.value = min(self._time, self.slider.max)

    def _draw(self, frame: int) -> None:
        with self.server.atomic():
            self.drawing.draw(frame, self.choice, float(self._magnify))
        self.server.flush()


def _icon(playing: bool) -> Any:
    """Return the icon of the button that pauses or plays."""
    import viser

    return viser.Icon.PLAYER_PAUSE if playing else viser.Icon.PLAYER_PLAY
