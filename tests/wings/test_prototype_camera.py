"""The prototype as a robot link: what its camera may do to it."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from benches import started

from fastrod_device.can.clock import Clock
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import load_hardware
from fastrod_device.safety import SafetyState
from fastrod_device.vision.camera import CameraFrame, Picture
from fastrod_device.vision.drawing import DrawnScene, Eye
from fastrod_device.vision.tracker import FLAGS

pytest.importorskip("canopen", reason="canopen is not installed: pip install 'fastrod[device]'")
pytest.importorskip("cv2", reason="opencv-python-headless is not installed: pip install 'fastrod[device]'")

HARDWARE = load_hardware()
BENT = np.array([-0.002, 0.001, 0.002, -0.001])


def bench(clock: Clock | None = None, *, hardware: Any = HARDWARE, **how: Any) -> Any:
    """See `benches.started`, of the prototype's own hardware."""
    return started(hardware, clock, **how)


class Attack:
    """Does nothing to frames until it is `on`; then keeps them, and changes each."""

    def __init__(self) -> None:
        self.eye = Eye(HARDWARE.camera, HARDWARE.marker, seed=1, scene=DrawnScene(blur=1.0, noise=5.0))
        self.on, self.n, self.bad, self.frames = False, 0, 0, list[CameraFrame]()

    def __call__(self, frame: CameraFrame) -> CameraFrame:
        self.frames.append(frame)
        self.n += self.on
        made = self.changed(frame) if self.on else frame
        self.bad += made is not frame
        return made

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return frame

    def old(self) -> CameraFrame:
        """Return a frame of another pose."""
        return self.frames[self.n // 2]

    def corner(self) -> Picture:
        return self.eye.draw(np.array([0.07, -0.05, -0.008]), np.array([1.0, 0.0, 0.0, 0.0]))


class Corner(Attack):
    """The marker is covered; one of its number lies in the picture's corner, 114 mm off."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(frame, image=self.corner())


class Two(Attack):
    """Both are seen."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        other = self.corner()
        return replace(frame, image=np.where(np.arange(other.shape[1]) < 180, other, frame.image))


class Alternating(Attack):
    """Every second frame is an old picture, stamped anew."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(frame, image=self.old().image) if self.n % 2 else frame


class Back(Attack):
    """Every second frame is an old one."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(self.old(), number=frame.number) if self.n % 2 else frame


class Future(Attack):
    """One frame is stamped in the future."""

    def changed(self, frame: CameraFrame) -> CameraFrame:
        return replace(frame, t=frame.t + 1e3) if self.n == 1 else frame


@pytest.mark.study
@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize(
    ("attack", "flag", "goes_on"),
    [
        (Corner, "outside the workspace", False),
        (Two, "two markers", False),
        (Alternating, "repeated", True),
        (Back, "out of order", True),
        (Future, "from the future", True),
    ],
)
def test_a_camera_that_cannot_be_believed_is_flagged_and_marker_lost_stays_armed(
    attack: type[Attack], flag: str, goes_on: bool, recorded: bool, tmp_path: Any
) -> None:
    made = attack()
    with bench(change=made) as (prototype, emulator):
        recorder = prototype.recorder_for(tmp_path / "log.csv")
        if recorded:
            recorder.start(prototype.elapsed)
            prototype.record(recorder)
        began = prototype.clock.now()
        prototype.command(BENT)
        prototype.wait(1.0)
        prototype.command(-BENT)
        prototype.wait(0.5)
        made.on = True
        with suppress(DeviceError):
            prototype.wait(2.0)
        assert (prototype.supervisor.state is not SafetyState.STOPPED) == goes_on, prototype.supervisor.status
        emulator.hidden = True
        hidden = prototype.clock.now()
        with pytest.raises(DeviceError):
            prototype.wait(1.0)
        fault = prototype.supervisor.first
        assert fault is not None
        assert (fault.kind, fault.t - hidden < HARDWARE.limits.sighting_age + 0.02) == ("marker lost", True)
        assert goes_on or f"the newest picture is flagged {flag!r}" in fault.sentence
        if not recorded:
            return
        rows = len(recorder)
        log = recorder.stop()
        flags = np.array([FLAGS[int(value)] for value in log.extra["marker_flag"]])
        assert rows == len(log) == sum(frame.t >= began for frame in made.frames)
        assert set(flags) <= {"", flag, "no marker", "ambiguous"}
        assert (flags == flag).sum() == made.bad >= (1 if attack is Future else 7)
        assert np.isnan(log.tip_position[flags != ""]).all()
        seen = np.stack([log.extra[f"seen_{axis}"] for axis in "xyz"], axis=1)
        if flag == "outside the workspace":  # what was refused is in the log
            assert np.linalg.norm(seen[flags == flag] - (0.07, -0.05, -0.008), axis=1).max() < 3e-3
        assert np.linalg.norm(log.tip_position[flags == ""], axis=1).max() < 0.0705


@pytest.mark.parametrize("raising", ["quick_stop", "close", "camera"])
def test_an_adapter_that_raises_as_it_closes_keeps_nothing_open(
    raising: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> None:
        raise ValueError("the handle\nis invalid")

    closed = []
    with bench(change=lambda frame: frame) as (prototype, _):
        assert prototype.source is not None
        shut = broken if raising == "camera" else lambda: closed.append("camera")
        monkeypatch.setattr(prototype.source, "close", shut)
        if raising != "camera":
            ends = getattr(prototype.drives, raising)
            monkeypatch.setattr(prototype.drives, raising, broken)
        prototype.close()
        sentence = "closing failed: ValueError: the handle is invalid."
        assert prototype.journal.lines[-1][1:] == ("exception", sentence)
        assert isinstance(prototype.broken, ValueError)
        assert closed == ([] if raising == "camera" else ["camera"])
        if raising != "camera":
            ends()
