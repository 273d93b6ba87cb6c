"""Homing: where the robot is straight and every tendon pulls with its pretension; zero is there.

One tendon after another is wound in until it is taut; that leaves the robot bent, as what one pulls the
others feel. So all then move together until they pull alike. By tension alone the robot stands straight no
better than friction and the motors' torque let it, where 0.1 N is half a millimetre at the tip; the camera
does the rest. Before it looks, the robot circles in smaller and smaller turns: friction and backlash then
forget from where they came, and zero lies in the middle of their loops.

The supervisor does not watch yet, so every cycle is looked at here, and what is wrong stops the drives at
once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fastrod.model.robot import Robot
from fastrod.model.routing import route
from fastrod.types import Floats
from fastrod_device.can.clock import Clock
from fastrod_device.can.faultcodes import ENABLED, in_words, state_in_words
from fastrod_device.can.pacer import Pacer
from fastrod_device.drives import Drives
from fastrod_device.errors import DeviceError
from fastrod_device.hardware import Hardware
from fastrod_device.readings import DriveFeedback
from fastrod_device.units import Transmission
from fastrod_device.vision.tracker import MarkerSighting

ZERO_SD = 2e-5
"""Standard deviation of the tendons' zeros after homing by camera: 0.1 mm at the tip, a fifth of it in the
tendons [m]."""
_TIGHTENED = 6.0  # s in which the tendons come to one tension
_YIELD = 0.03  # of what would correct the tensions, in a cycle
_STIFFEST = 1e-4  # m/N that a tendon is taken to give at least
_SMOOTH = 0.2  # of what the motors' torque says in a cycle
_UNEVEN = 0.3  # of the pretension
# times that the tip is looked at, for how long [s], sightings that it takes
_ROUNDS, _LOOKING, _LEAST = 2, 1.5, 8
_FAR, _NEAR = 1e-3, 5e-5  # m of tendon: a greater correction means a wrong camera, a smaller one is none
_MEASURED = 0.3  # s for which the tensions are taken in the end
_BEHIND = 0.25  # of the limits' following error, for a drive that hardly moves; at the full rate all of it
_OLD = 5  # cycles without a drive's process data
_PULL, _LEAST_PULL = 5.0, 3.0  # pretensions, N: no tendon pulls more while it is homed
_BEND, _REVOLUTIONS, _REVOLUTION = 0.45, 4, 1.4  # rad at first, turns of the spiral, s each


def home(
    drives: Drives, hardware: Hardware, clock: Clock, look: Callable[[], MarkerSighting | None] | None
) -> tuple[Transmission, Robot]:
    """Do it; tendons as drives with their zero, and the robot with the tensions that its tendons have there.

    `look` gives the newest sighting that was not given yet; None: there is no camera, and tension alone
    decides. Raises `DeviceError`, with the drives stopped, where one of them does not do as it is commanded,
    a tendon does not come to its pretension or pulls far more, the marker is not seen, or it is seen where
    the robot cannot be.
    """
    transmission, n = Transmission(hardware.drives), len(hardware.drives)
    per = 1.0 / np.abs(transmission.wound(np.ones(n, dtype=np.int64)))  # counts in a metre
    drives.homing(
        np.abs(transmission.torque(np.full(n, hardware.pretension))),
        np.rint(hardware.homing_speed * per).astype(np.int64),
    )
    pacer, last, speed = Pacer(clock, hardware.rate), transmission.dl(drives.newest.position), 0.0

    def cycle(at: Floats) -> Floats:
        """(n_drives,) tensions with the tendons at `at` [N]."""
        nonlocal last, speed
        pacer.wait()
        feedback = drives.exchange(transmission.counts(at))
        # a drive lags by a moment
        speed, last = max(0.5 * speed, float(np.abs(at - last).max()) * hardware.rate), at
        if wrong := trouble(feedback, hardware, speed=speed):
            why = f" ({drives.stop_reason})" if drives.stop_reason else ""
            raise DeviceError(f"{wrong}{why}; homing was stopped.")
        return transmission.tension(feedback.torque)

    try:
        at = _tightened(cycle, last, hardware)
        tension = _measured(cycle, at, hardware)
        off = np.abs(tension - hardware.pretension)
        if (off > _UNEVEN * hardware.pretension).any():
            k = int(off.argmax())
            raise DeviceError(
                f"the tendon of node {hardware.drives[k].node} pulls with {tension[k]:.2f} N after homing; "
                f"{hardware.pretension:g} N were "
                "asked for. Is it caught, or a direction wrong?"
            )
        if look is not None:
            at = _straightened(cycle, look, at, hardware, clock)
            tension = _measured(cycle, at, hardware)
            if (tension <= 0.0).any():
                k = int(tension.argmin())
                raise DeviceError(
                    f"the tendon of node {hardware.drives[k].node} is slack where the camera sees the robot "
                    f"straight ({tension[k]:.2f} N). "
                    "Is the camera registered? `fastrod camera register` does it."
                )
    except BaseException:
        drives.quick_stop("homing did not end")
        raise
    return Transmission(hardware.drives, zero=transmission.counts(at)), tightened(hardware.robot, tension)


def trouble(feedback: DriveFeedback, hardware: Hardware, *, speed: float = 0.0) -> str:
    """Return what is wrong with drives that are homed: one sentence without its full stop, of the first that
    is found; empty where all is well.

    `speed` of the quickest tendon [m/s]: a drive that moves may be further behind where it was commanded to
    be.
    """
    nodes = [spec.node for spec in hardware.drives]
    if feedback.lost:
        return f"the bus carries nothing: {feedback.lost.rstrip('.')}"
    if feedback.foreign_syncs:
        return "another node sends SYNC; the controller alone may"
    for message in feedback.emergencies:
        if message.code & 0xFF00:  # 00xx: an error is gone
            return f"the drive at node {nodes[message.drive]} sent an emergency: {in_words(message.code)}"
    oldest = max(_OLD / hardware.rate, hardware.limits.feedback_age)
    transmission, limits = Transmission(hardware.drives), hardware.limits
    tension = transmission.tension(feedback.torque)
    behind = np.abs(transmission.wound(feedback.following_error))
    late = limits.following_error * min(1.0, _BEHIND + speed / limits.rate)
    most = min(hardware.limits.tension, max(_PULL * hardware.pretension, _LEAST_PULL))
    for k, node in enumerate(nodes):
        if not feedback.age[k] <= oldest:
            return (
                f"the drive at node {node} was last heard {1e3 * feedback.age[k]:.0f} ms ago; "
                f"{1e3 * oldest:.0f} ms are allowed"
            )
        if (state := state_in_words(int(feedback.statusword[k]))) != ENABLED:
            return (
                f"the drive at node {node} went to the state {state!r} (statusword "
                f"0x{int(feedback.statusword[k]):04X})"
            )
    k, b = int(np.abs(tension).argmax()), int(behind.argmax())
    slow = f"the drive at node {nodes[b]} is {1e3 * behind[b]:.2g} mm from where it was commanded to be"
    if behind[b] > late:
        return f"{slow}; {1e3 * late:.2g} mm are allowed"
    if abs(tension[k]) > most:
        also = f", and {slow}" if behind[b] > _BEHIND * limits.following_error else ""
        return f"the tendon of node {nodes[k]} pulls with {tension[k]:.2f} N; {most:g} N are allowed{also}"
    return ""


def tightened(robot: Robot, tension: Floats) -> Robot:
    """The robot whose tendons pull with `tension` (n_tendons,) [N] where their change of length is zero, and
    whose zeros are no surer than homing makes them. Its pretension adds to the stiffness in torsion: a model
    that does not know it finds another shear modulus."""
    left = iter(tension.tolist())
    segments = tuple(
        replace(segment, tendons=tuple(replace(tendon, pretension=next(left)) for tendon in segment.tendons))
        for segment in robot.segments
    )
    fit = {"tendon.*.zero": {"sd": ZERO_SD}, **robot.fit}
    return replace(robot, segments=segments, fit=fit)


def softness(robot: Robot) -> Floats:
    """(n_tendons, n_tendons) change of tendon length by tension [m/N], straight and unloaded: what the
    tendons give and the body bends."""
    routing = route(robot)
    body = np.repeat([segment.length / min(segment.bending_stiffness) for segment in robot.segments], 2)
    own = np.array(
        [max(tendon.compliance, _STIFFEST) for segment in robot.segments for tendon in segment.tendons]
    )
    return np.asarray(np.diag(own) + (routing.arms * body) @ routing.arms.T)


def lean(robot: Robot, tip: Floats) -> Floats:
    """(n_tendons,) tendon lengths [m] that bend a straight robot so that its tip (3,) is beside the axis by
    as much as this one; the least bends that do it."""
    routing = route(robot)
    # from the middle of a segment to the tip
    beyond = np.cumsum(routing.length[::-1])[::-1] - 0.5 * routing.length
    by_bend = np.zeros((2, 2 * robot.n_segments))
    by_bend[0, 1::2], by_bend[1, 0::2] = beyond, -beyond
    bend = np.linalg.pinv(by_bend) @ tip[:2]
    return routing.tendon_change(bend.reshape(robot.n_segments, 2))


def _tightened(cycle: Callable[[Floats], Floats], at: Floats, hardware: Hardware) -> Floats:
    """(n_drives,) where the tendons pull alike [m]."""
    tension, give = cycle(at), softness(hardware.robot)
    for _ in range(round(_TIGHTENED * hardware.rate)):
        step = _YIELD * (give @ (tension - hardware.pretension))
        at = at + step * min(1.0, hardware.homing_speed / hardware.rate / max(np.abs(step).max(), 1e-12))
        tension = tension + _SMOOTH * (cycle(at) - tension)
    return at


def _measured(cycle: Callable[[Floats], Floats], at: Floats, hardware: Hardware) -> Floats:
    """(n_drives,) tensions of tendons that are held [N], a mean of some cycles."""
    return np.asarray(np.mean([cycle(at) for _ in range(round(_MEASURED * hardware.rate))], axis=0))


def _straightened(
    cycle: Callable[[Floats], Floats],
    look: Callable[[], MarkerSighting | None],
    at: Floats,
    hardware: Hardware,
    clock: Clock,
) -> Floats:
    """(n_drives,) where the tendons are when the tip is seen on the axis [m]. Raises `DeviceError` where the
    camera cannot be believed."""
    before = np.inf
    for _ in range(_ROUNDS):
        for away in _spiral(hardware):
            cycle(at + away)
        seen, flags, end = [], Counter[str](), clock.now() + _LOOKING
        while clock.now() < end:
            cycle(at)
            sighting = look()
            if sighting is not None and sighting.t > end - _LOOKING:
                flags[sighting.flag] += 1
                if sighting.ok:
                    seen.append(sighting.position)
        if len(seen) < _LEAST:
            del flags[""]
            why = "".join(f"; {n} pictures are flagged {flag!r}" for flag, n in flags.most_common(1))
            times = f"{len(seen)} times in {_LOOKING:g} s of homing"
            raise DeviceError(f"the camera saw the marker {times}; it must see it {_LEAST} times{why}.")
        tip = np.mean(seen, axis=0)
        shift = -lean(hardware.robot, tip)
        far = float(np.abs(shift).max())
        if far > _FAR or (far > _NEAR and far >= before):
            why = (
                f"by {1e3 * _FAR:g} mm at most"
                if far > _FAR
                else (f"and {1e3 * before:.2f} mm before did not bring it nearer")
            )
            raise DeviceError(
                f"the tip is seen {1e3 * float(np.hypot(tip[0], tip[1])):.2g} mm beside the axis; "
                f"the tendons would move by {1e3 * far:.2f} "
                f"mm, {why}; is the camera registered? `fastrod camera register` does it."
            )
        before = far
        steps = max(round(far / hardware.homing_speed * hardware.rate), round(0.5 * hardware.rate))
        for _ in range(steps):
            at = at + shift / steps
            cycle(at)
    return at


def _spiral(hardware: Hardware) -> Floats:
    """(n, n_tendons) tendon lengths [m] of a bend that circles and shrinks to nothing, all segments alike, at
    half of the rate at most."""
    routing, limits = route(hardware.robot), hardware.limits
    n = round(_REVOLUTIONS * _REVOLUTION * hardware.rate)
    angle = 2.0 * np.pi * _REVOLUTIONS * np.arange(1, n + 1) / n
    bend = np.sin(np.pi * np.arange(1, n + 1) / n) ** 0.25 * (1.0 - np.arange(1, n + 1) / n)
    shift = np.stack([bend * np.cos(angle), bend * np.sin(angle)], axis=1)
    dl = routing.tendon_change(np.repeat(shift[:, None], routing.n_segments, axis=1))
    quickest = float(np.abs(np.diff(dl, axis=0, prepend=0.0)).max()) * hardware.rate
    return (
        _BEND
        * dl
        * min(
            1.0,
            0.5 * limits.rate / (_BEND * quickest),
            0.5 * limits.displacement / (_BEND * float(np.abs(dl).max())),
        )
    )
