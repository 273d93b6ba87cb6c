"""`Emulator`: the prototype without hardware; the same protocols through the same libraries, and a plant
behind them that nothing reads.

Drives on a CAN bus (`nodes`), a camera whose frames are drawn (`drawing`), tendons that are slack until the
robot is homed, and a sealed plant (`plant`). Hands that hang a load and turn the base are methods; so are
faults.
"""

from __future__ import annotations

import threading
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, final

import numpy as np

from fastrod.rotation import quaternion_from_matrix
from fastrod.types import Floats
from fastrod_device.can.clock import Clock
from fastrod_device.drives import emulated_drives
from fastrod_device.emulator.plant import Plant
from fastrod_device.emulator.plant_rod import COMPLIANCE
from fastrod_device.emulator.seal import Seal
from fastrod_device.hardware import Hardware
from fastrod_device.vision.camera import CameraFrame
from fastrod_device.vision.drawing import DrawnScene, Eye

if TYPE_CHECKING:
    from can import BusABC

_SHAKE = 1e-4  # m per axis, of the marker against the camera: a bench is not still
_SCENE = DrawnScene(blur=1.0, noise=5.0)
_COVERING = 1.0  # s for which hands that hang a load cover the marker
_SLACK = 1e-3  # m, of a tendon before it is homed, at most
_KEPT = 8  # frames that nobody has fetched


@final
class Emulator:
    """Drives, tendons, plant and camera. It is the `Tendons` of its drives and the `FrameSource` of whoever
    looks."""

    def __init__(
        self,
        hardware: Hardware,
        bus: str | BusABC,
        *,
        clock: Clock,
        seal: Seal,
        seed: int = 0,
        taut: bool = False,
        eds: str | Path | None = None,
    ) -> None:
        """On `bus` ("virtual:NAME", say), behind the effects of `seal`; `seed` draws slack and noise.

        `taut`: the tendons have their pretension at power-on, as if somebody had homed them. `eds`: the file
        that lists the drives' objects, by default an EPOS4's. Raises `DeviceError` for the bus or the file.
        """
        self.hardware, self.clock = hardware, clock
        self.seal, self.plant = seal, Plant(seal)
        rng = np.random.default_rng(seed)
        n = len(hardware.drives)
        self._slack = rng.uniform(0.1, 1.0, n) * (0.0 if taut else _SLACK)
        self._taut = taut
        self._lock = threading.Lock()
        self._rng = rng
        self._eye = Eye(hardware.camera, hardware.marker, seed=seed, scene=_SCENE)
        self._due: deque[tuple[int, float, Floats, Floats]] = deque(maxlen=_KEPT)
        self._number, self._next = 0, 0.0
        self._last: CameraFrame | None = None
        self._covered = -np.inf
        self.frozen = self.hidden = False
        """The camera repeats its last frame; the marker is covered."""
        self.drives = emulated_drives(hardware, bus, clock=clock, tendons=self, eds=eds)

    def move(self, t: float, pulled: Floats) -> Floats:
        """Tendons wound by (n_drives,) [m] since power-on: their tensions [N]. The rod stands straight until
        every tendon is taut."""
        with self._lock:
            taken_up = pulled - self._slack
            if not self._taut:
                self._taut = bool((taken_up > -1e-6).all())
                self.plant.advance(t, np.zeros(len(pulled)))
                self._expose(t)
                return np.asarray(np.maximum(taken_up, 0.0) / COMPLIANCE)
            self.plant.advance(t, -taken_up)
            self._expose(t)
            return self.plant.tension()

    def _expose(self, t: float) -> None:
        """Keep the poses of the frames whose time has come."""
        period = 1.0 / self.hardware.camera.rate
        if t < self._next:
            return
        self._next = max(self._next + period, t)
        self._number += 1
        position, rotation = self.plant.tip_seen(t)
        position = position + _SHAKE * self._rng.normal(size=3)
        self._due.append((self._number, t, position, quaternion_from_matrix(rotation[None])[0]))

    def read(self) -> CameraFrame | None:
        """The newest frame that has arrived and was not read yet; drawn now, stamped with the time of its
        exposure."""
        arrived = self.clock.now() - self.hardware.camera.latency
        found = None
        with self._lock:
            while self._due and self._due[0][1] <= arrived:
                found = self._due.popleft()
        if found is None:
            return None
        number, t, position, quaternion = found
        if self.frozen and self._last is not None:
            self._last = CameraFrame(image=self._last.image, t=t, number=number)
        else:
            self._last = CameraFrame(
                image=self._eye.draw(position, quaternion, marker=not self.hidden and t >= self._covered),
                t=t,
                number=number,
            )
        return self._last

    def hang(self, mass: float) -> None:
        """Hang a known load [kg] on the tip."""
        with self._lock:
            self.plant.hang(mass)
            self._covered = self.clock.now() + _COVERING

    def rotate(self, quaternion: Floats) -> None:
        """Turn the whole bench to the quaternion world_from_base (4,) w x y z; hands cover the marker
        meanwhile."""
        with self._lock:
            self.plant.rotate(quaternion)
            self._covered = self.clock.now() + _COVERING

    def close(self) -> None:
        """Switch it off."""
        self.drives.close()
