"""`ControlPanel`: sliders, buttons and keys that drive a robot, on a page."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, final

import numpy as np

from fastrod_viewer.drive.controls import Group, drive_controls, load_controls
from fastrod_viewer.drive.session import Session
from fastrod_viewer.drive.teleop import Speeds

if TYPE_CHECKING:
    import viser

_KEY_STEP = math.radians(5.0)  # of a segment's bend, by a press
_FASTEST = 360  # °/s
_SETTLED = 0.3  # s after a change in which a control is left alone: it may be under a finger


@final
class ControlPanel:
    """Handles of one robot's controls, made inside the tabs `drive` and `loads`; they follow the goals of
    `Teleop`, whoever sets them."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        drive: Any,
        loads: Any,
        *,
        may: Callable[[Any], bool],
    ) -> None:
        """`may` says of an event whether the page it comes from may act."""
        self.server, self.session, self.teleop, self._may = server, session, session.teleop, may
        self.chosen = next(iter(self.teleop.driven), 0)
        """Segment that keys bend."""
        self._followers: list[tuple[Any, Callable[[], Any]]] = []
        self._commands: list[Any] = []
        with drive:
            self._drive()
        with loads:
            self._loads()
        self._keys()

    def follow(self) -> None:
        """Show the present goals, unless some that pages have sent are still to be taken."""
        if self.session.idle:
            for handle, value in self._followers:
                if handle.value != (now := value()):
                    self.server.get_event_loop().call_soon_threadsafe(_show, handle, now)

    def close(self) -> None:
        """Take the keys back; the tabs are removed by their owner."""
        for command in self._commands:
            command.remove()
        self._followers, self._commands = [], []

    def _drive(self) -> None:
        gui, session, teleop = self.server.gui, self.session, self.teleop
        world = session.world
        if not world.drivable:
            gui.add_markdown("This scene plays its own script; it cannot be driven by hand.")
            return
        if world.scripted and session.link is None:
            script = gui.add_checkbox(
                "Demo motion", session.scripted, hint="It moves by itself until you move it."
            )
            self._listen(script, lambda on: setattr(session, "scripted", bool(on)), take_over=False)
            self._followers.append((script, lambda: session.scripted))
        if world.host:
            frozen = gui.add_checkbox(
                "Freeze the rigid host", False, hint="Its joints hold still; only the soft robot moves."
            )
            self._listen(frozen, lambda on: teleop.freeze(bool(on)))
        if not world.robot.n_tendons:
            drag = "" if world.ringing is None else "Drag its tip and let go, or load it: tab *Loads*."
            gui.add_markdown(f"This robot has no tendons. {drag or 'Load its tip instead: tab *Loads*.'}")
        groups = drive_controls(world, teleop)
        own = [group for group in groups if group.title.startswith("Segment")]
        others = [group for group in groups if group.title and group not in own]
        for group in [group for group in groups if not group.title]:
            self._add(group)
        self._together("Each segment", own)
        if teleop.actions is not None:
            self._button("Straight pose", teleop.all_zero)
        self._together(" and ".join(group.title.lower() for group in others).capitalize(), others)
        if world.robot.n_tendons:
            most = self._fastest()
            now = min(most, max(5, 5 * round(math.degrees(self.teleop.speeds.bend) / 5)))
            speed = gui.add_slider(
                "Speed [°/s]",
                5,
                most,
                5,
                now,
                hint="Largest rate at which a segment bends; tendons and base keep in step.",
            )
            self._listen(speed, self._set_speed, take_over=False)

    def _fastest(self) -> int:
        """Return the largest speed that is offered [°/s]: a linked robot's tendons do not follow every
        one."""
        if self.teleop.actions is None or not math.isfinite(self.teleop.limits.rate):
            return _FASTEST
        return min(
            _FASTEST,
            max(10, 5 * int(math.degrees(self.teleop.limits.rate / self.teleop.actions.offset.max()) / 5)),
        )

    def _set_speed(self, degrees: float) -> None:
        usual = Speeds()
        self.teleop.speeds = usual.times(math.radians(degrees) / usual.bend)

    def _loads(self) -> None:
        if not self.session.world.loads or self.session.link is not None:
            self.server.gui.add_markdown("Loads cannot be put on this robot from here.")
            return
        world = self.session.world
        self._add(load_controls(world.robot, self.teleop, rings=world.ringing is not None))
        self._button("No loads", lambda: self.teleop.load(tip_force=np.zeros(3), payload=0.0, gravity=1.0))

    def _together(self, title: str, groups: Sequence[Group]) -> None:
        """Groups in one that is closed, where there are several: an empty box for each says nothing."""
        if len(groups) < 2:
            for group in groups:
                self._add(group)
            return
        with self.server.gui.add_folder(title, expand_by_default=False):
            for group in groups:
                self._add(group)

    def _add(self, group: Group) -> None:
        gui = self.server.gui
        with gui.add_folder(group.title or None, expand_by_default=group.open):
            for control in group.controls:
                handle = gui.add_slider(
                    control.label,
                    control.low,
                    control.high,
                    float(f"{control.step:.6g}"),
                    control.value,
                    hint=control.hint,
                )
                self._listen(handle, control.put)
                self._followers.append((handle, partial(getattr, control, "value")))

    def _button(self, label: str, do: Callable[[], None]) -> None:
        def press(event: Any) -> None:
            if self._may(event):
                self.session.take_over()
                do()

        self.server.gui.add_button(label, color="gray").on_click(self.session.in_order(press))

    def _listen(self, handle: Any, put: Callable[[Any], None], *, take_over: bool = True) -> None:
        """Call `put` with what a person changes, but not with what `follow` shows. Where the page may not
        act, the handle goes back."""
        kept = handle.value

        def change(event: Any, value: Any) -> None:
            nonlocal kept
            if not self._may(event):
                handle.value = next((value() for one, value in self._followers if one is handle), kept)
                return
            kept = value
            if take_over:
                self.session.take_over()
            put(value)

        async def changed(event: Any) -> None:
            if event.client_id is not None:
                self.session.submit(partial(change, event, event.target.value))

        handle.on_update(changed)

    def _keys(self) -> None:
        session = self.session
        self._command("Stop", "escape").on_trigger(stops(session))
        self._command("Pause or resume", "space").on_trigger(self._pause)
        self._key("Reset", "R", session.reset)
        if self.teleop.actions is None or not session.world.drivable:
            return
        # not A, D, W, S, nor arrows: with these viser flies the camera
        for name, key, axis, sign in (
            ("+x", "L", 0, 1),
            ("-x", "J", 0, -1),
            ("+y", "I", 1, 1),
            ("-y", "K", 1, -1),
        ):
            self._key(f"Bend toward {name}", key, partial(self._bend, axis, sign))
        for k in self.teleop.driven[:9]:
            self._key(f"Keys bend segment {k + 1}", str(k + 1), partial(setattr, self, "chosen", k))

    def _key(self, label: str, key: Any, do: Callable[[], None]) -> None:
        self._command(label, key).on_trigger(
            self.session.in_order(lambda event: do() if self._may(event) else None)
        )

    def _command(self, label: str, key: Any) -> Any:
        command = self.server.gui.add_command(label, hotkey=key)
        self._commands.append(command)
        return command

    def _pause(self, event: Any) -> None:
        """Pause, from any page; resume, from the page that has the controls."""
        if not self.session.paused:
            self.session.paused = True
        elif self._may(event):
            self.session.paused = False

    def _bend(self, axis: int, sign: int) -> None:
        self.session.take_over()
        bends = list(self.teleop.bent(self.chosen))
        bends[axis] += sign * _KEY_STEP
        self.teleop.bend(self.chosen, *bends)


def _show(handle: Any, value: Any) -> None:
    """In viser's loop: nothing that a page sends comes between the look and the change."""
    if time.time() - handle.update_timestamp > _SETTLED:
        handle.value = value


def stops(session: Session) -> Callable[[Any], Any]:
    """Return what a STOP calls, on every page: it runs in viser's own loop, before what is sent later and
    whatever else pages have requested."""

    async def stop(_: object) -> None:
        session.stop()

    return stop
