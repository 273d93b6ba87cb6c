"""Homing: where the robot is straight and every wire pulls with its pretension; zero is there.

One wire after another is wound in until it is taut; that leaves the robot bent, as what one pulls the others feel. So all then move
together until they pull alike. By tension alone the robot stands straight no better than friction and the motors' torque let it, where
0.1 N is half a millimetre at the tip; the camera does the rest. Before it looks, the robot circles in smaller and smaller turns: friction
and backlash then forget from where they came, and zero lies in the middle of their loops.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fastrod.robot import Robot
from fastrod.types import Floats
from fastrod.wiring import wire
from fastrod_device.clock import Clock
from fastrod_device.drive import DriveBus
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import Hardware
from fastrod_device.pacer import Pacer
from fastrod_device.tracker import Sighting
from fastrod_device.units import Transmission

ZERO_SD = 2e-5
"""How sure the wires' zeros are, homed by camera: 0.1 mm at the tip, a fifth of it in the wires [m]."""
_TIGHTENED = 6.0  # s in which the wires come to one tension
_YIELD = 0.03  # of what would mend the tensions, in a cycle
_STIFFEST = 1e-4  # m/N that a wire is taken to give at least
_SMOOTH = 0.2  # of what the motors' torque says in a cycle
_UNEVEN = 0.3  # of the pretension
_ROUNDS, _LOOKING, _LEAST = 2, 1.5, 8  # times that the tip is looked at, for how long [s], sightings that it takes
_BEND, _TURNS, _TURN = 0.45, 4, 1.4  # rad at first, turns of the spiral, s each


def home(drives: DriveBus, hardware: Hardware, clock: Clock, look: Callable[[], Sighting | None] | None) -> tuple[Transmission, Robot]:
    """Do it; wires as drives with their zero, and the robot with the tensions that its wires have there.

    `look` gives the newest sighting that was not given yet; None: there is no camera, and tension alone decides. Raises `DeviceError` where
    a wire does not come to its pretension, or the marker is not seen.
    """
    transmission, n = Transmission(hardware.drives), len(hardware.drives)
    per = 1.0 / np.abs(transmission.wound(np.ones(n, dtype=np.int64)))  # counts in a metre
    drives.homing(np.abs(transmission.torque(np.full(n, hardware.pretension))), np.rint(hardware.homing_speed * per).astype(np.int64))
    pacer = Pacer(clock, hardware.rate)
    at = transmission.dl(drives.newest.position)

    def cycle(at: Floats) -> Floats:
        """(n_drives,) tensions with the wires at `at` [N]."""
        pacer.wait()
        return transmission.tension(drives.exchange(transmission.counts(at)).torque)

    at, tension = _tightened(cycle, at, hardware)
    off = np.abs(tension - hardware.pretension)
    if (off > _UNEVEN * hardware.pretension).any():
        k = int(off.argmax())
        raise DeviceError(
            f"the wire of node {hardware.drives[k].node} pulls with {tension[k]:.2f} N after homing; {hardware.pretension:g} N were asked "
            "for. Is it caught, or a direction wrong?"
        )
    if look is not None:
        at = _straightened(cycle, look, at, hardware, clock)
    return Transmission(hardware.drives, zero=transmission.counts(at)), tightened(hardware.robot, tension)


def tightened(robot: Robot, tension: Floats) -> Robot:
    """The robot whose wires pull with `tension` (n_tendons,) [N] where their change of length is zero, and whose zeros are no surer than
    homing makes them. Its pretension adds to the stiffness in torsion: a model that does not know it finds another shear modulus."""
    left = iter(tension.tolist())
    segments = tuple(
        replace(segment, tendons=tuple(replace(tendon, pretension=next(left)) for tendon in segment.tendons)) for segment in robot.segments
    )
    fit = {"tendon.*.zero": {"sd": ZERO_SD}, **robot.fit}
    return replace(robot, segments=segments, fit=fit)


def softness(robot: Robot) -> Floats:
    """(n_tendons, n_tendons) change of wire length by tension [m/N], straight and unloaded: what the wires give and the body bends."""
    wiring = wire(robot)
    body = np.repeat([segment.length / min(segment.bending_stiffness) for segment in robot.segments], 2)
    own = np.array([max(tendon.compliance, _STIFFEST) for segment in robot.segments for tendon in segment.tendons])
    return np.asarray(np.diag(own) + (wiring.arms * body) @ wiring.arms.T)


def lean(robot: Robot, tip: Floats) -> Floats:
    """(n_tendons,) wire lengths [m] that bend a straight robot so that its tip (3,) is beside the axis by as much as this one; the least
    bends that do it."""
    wiring = wire(robot)
    beyond = np.cumsum(wiring.length[::-1])[::-1] - 0.5 * wiring.length  # from the middle of a segment to the tip
    by_bend = np.zeros((2, 2 * robot.n_segments))
    by_bend[0, 1::2], by_bend[1, 0::2] = beyond, -beyond
    bend = np.linalg.pinv(by_bend) @ tip[:2]
    return wiring.wires(bend.reshape(robot.n_segments, 2))


def _tightened(cycle: Callable[[Floats], Floats], at: Floats, hardware: Hardware) -> tuple[Floats, Floats]:
    """(n_drives,) where the wires pull alike [m], and their tensions there [N]."""
    tension, give = cycle(at), softness(hardware.robot)
    for _ in range(round(_TIGHTENED * hardware.rate)):
        step = _YIELD * (give @ (tension - hardware.pretension))
        at = at + step * min(1.0, hardware.homing_speed / hardware.rate / max(np.abs(step).max(), 1e-12))
        tension = tension + _SMOOTH * (cycle(at) - tension)
    return at, tension


def _straightened(
    cycle: Callable[[Floats], Floats], look: Callable[[], Sighting | None], at: Floats, hardware: Hardware, clock: Clock
) -> Floats:
    """(n_drives,) where the wires are when the tip is seen on the axis [m]."""
    for _ in range(_ROUNDS):
        for away in _spiral(hardware):
            cycle(at + away)
        seen, end = [], clock.now() + _LOOKING
        while clock.now() < end:
            cycle(at)
            sighting = look()
            if sighting is not None and sighting.ok and sighting.t > end - _LOOKING:
                seen.append(sighting.position)
        if len(seen) < _LEAST:
            raise DeviceError(f"the camera saw the marker {len(seen)} times in {_LOOKING:g} s of homing; it must see it {_LEAST} times.")
        way = -lean(hardware.robot, np.mean(seen, axis=0))
        steps = max(round(np.abs(way).max() / hardware.homing_speed * hardware.rate), round(0.5 * hardware.rate))
        for _ in range(steps):
            at = at + way / steps
            cycle(at)
    return at


def _spiral(hardware: Hardware) -> Floats:
    """(n, n_tendons) wire lengths [m] of a bend that circles and shrinks to nothing, all segments alike, at half of the rate at most."""
    wiring, limits = wire(hardware.robot), hardware.limits
    n = round(_TURNS * _TURN * hardware.rate)
    angle = 2.0 * np.pi * _TURNS * np.arange(1, n + 1) / n
    bend = np.sin(np.pi * np.arange(1, n + 1) / n) ** 0.25 * (1.0 - np.arange(1, n + 1) / n)
    way = np.stack([bend * np.cos(angle), bend * np.sin(angle)], axis=1)
    dl = wiring.wires(np.repeat(way[:, None], wiring.n_segments, axis=1))
    quickest = float(np.abs(np.diff(dl, axis=0, prepend=0.0)).max()) * hardware.rate
    return _BEND * dl * min(1.0, 0.5 * limits.rate / (_BEND * quickest), 0.5 * limits.displacement / (_BEND * float(np.abs(dl).max())))
