"""A robot as a chain of joints with tendons for MuJoCo: `fastrod export ROBOT --mjcf FILE`.

Each segment is cut into equal pieces with a joint in the middle of each, whose stiffness is that of the
piece: EI/h, GJ/h and, where the backbone stretches, EA/h. Tendons run through sites where pieces meet. Each
drive is an actuator on its tendon, a spring of the tendon's compliance towards the commanded length.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise
from xml.sax.saxutils import quoteattr

import numpy as np

from fastrod.errors import InputError
from fastrod.model.robot import Robot, Segment
from fastrod.types import Floats

_FEW, _MANY = 16, 24
# pieces of a segment, for two segments at most and for more: of five segments, whose tendons push and cross
# all, the tip was 13 % off with 16
TIMESTEP = 5e-4
"""s"""
_STIFF = 100.0  # of a segment's own stiffness, seen by its tendon: a stiffer one needs a shorter time step
_PHASE = 0.4  # rad, by which the fastest mode of tendon and joints moves in a time step
_DAMPED = 0.7  # of critical, of the joints
_LIGHT = 1e-4  # kg of a piece of a weightless body, which does not weigh
_BEND = 0.7  # rad, of a segment at most in a command that is compared
_SECONDS, _STILL = 12.0, 1e-4  # at most until the chain is at rest; rad/s and m/s, then


def pieces_of(robot: Robot) -> int:
    """Pieces of a segment that keep the tip within a per cent of the length at rest."""
    return _FEW if robot.n_segments < 3 else _MANY


def mjcf(robot: Robot, *, pieces: int | None = None, comment: str = "") -> str:
    """The MJCF of `robot`: one control per tendon, its absolute length [m] as fastrod has it, and a site
    `tip`. Raises `InputError` for a robot that is not driven by tendon lengths.

    It leaves out shear, effects and extension: use it for contact and control in MuJoCo's world, and fastrod
    for what the rod does.
    """
    if {segment.mode for segment in robot.segments} - {"passive"} != {"tendon_length"}:
        raise InputError(f"robot {robot.name!r} is not driven by tendon lengths; no MJCF is written of it.")
    pieces = pieces or pieces_of(robot)
    kp, armature = _drives(robot, pieces)
    base = f'pos="{_numbers(robot.base_position)}" quat="{_numbers(robot.base_quaternion)}"'
    lines = [
        f"<mujoco model={quoteattr(robot.name)}>",
        *(f"  <!-- {line} -->" for line in comment.replace("--", "- -").splitlines()),
        '  <compiler angle="radian" autolimits="true"/>',
        f'  <option timestep="{TIMESTEP:g}" integrator="implicitfast" gravity="{_numbers(robot.gravity)}"/>',
        "  <worldbody>",
        f'    <body name="base" {base}>',
        *_chain(robot, pieces, armature),
        "    </body>",
        "  </worldbody>",
        "  <tendon>",
    ]
    for k in range(robot.n_tendons):
        sites = "".join(f'<site site="{name}"/>' for name in _path(robot, pieces, k))
        lines.append(f'    <spatial name="tendon_{k + 1}" width="0.0005">{sites}</spatial>')
    lines += ["  </tendon>", "  <actuator>"]
    extra = _jumps(robot)
    for k, tendon in enumerate(robot.tendons):
        bias = kp[k] * extra[k] - tendon.pretension
        limits = ' forcerange="-1e9 0"' if tendon.unilateral else ""
        lines.append(
            f'    <general name="length_{k + 1}" tendon="tendon_{k + 1}" gainprm="{kp[k]:.9g}" '
            f'biastype="affine" biasprm="{bias:.9g} {-kp[k]:.9g} 0"{limits}/>'
        )
    return "\n".join([*lines, "  </actuator>", "</mujoco>", ""])


def static_error(robot: Robot, *, pieces: int | None = None, count: int = 10, seed: int = 0) -> float:
    """Largest distance between the tips of the chain in MuJoCo and of the rod, both at rest, over `count`
    random commands, in lengths of the robot. Raises `InputError` where MuJoCo is not installed."""
    from dataclasses import replace

    from fastrod.model.routing import route
    from fastrod.simulator import Simulator

    try:
        import mujoco
    except ImportError as error:
        raise InputError("the static error needs mujoco: pip install 'fastrod[mujoco]'.") from error
    model = mujoco.MjModel.from_xml_string(mjcf(robot, pieces=pieces))
    data, site = mujoco.MjData(model), model.site("tip").id
    rng = np.random.default_rng(seed)
    bends = rng.uniform(-_BEND, _BEND, (count, robot.n_segments, 2)) / math.sqrt(2.0)
    lengths = robot.rest_tendon_length + route(robot).tendon_change(bends)
    rods = Simulator(replace(robot, effects=()), n_robots=count).settle(lengths)
    worst = 0.0
    for length, tip in zip(lengths, rods.tip_position, strict=True):
        data.ctrl[:] = length
        for k in range(int(_SECONDS / TIMESTEP)):
            mujoco.mj_step(model, data)
            if k % 200 == 199 and np.abs(data.qvel).max() < _STILL:
                break
        worst = max(worst, float(np.linalg.norm(data.site_xpos[site] - tip)))
    return worst / robot.length


def _drives(robot: Robot, pieces: int) -> tuple[list[float], list[list[float]]]:
    """Stiffness of each drive [N/m], and the armature of each segment's joints [kg m^2], with which the
    fastest mode is slow enough for the time step."""
    kp, coupled = [], np.zeros(robot.n_segments)
    for tendon, end in zip(robot.tendons, robot.tendon_segment, strict=True):
        crossed = [math.hypot(*place) for place in tendon.position(int(end) + 1)]
        own = min(
            max(segment.bending_stiffness) / (segment.length * offset**2)
            for segment, offset in zip(robot.segments, crossed, strict=False)
        )
        kp.append(min(1.0 / max(tendon.compliance, 1e-9), _STIFF * own))
        coupled[: int(end) + 1] += kp[-1] * np.array(crossed) ** 2
    armature = [[max(float(c) * pieces * robot.n_segments * (TIMESTEP / _PHASE) ** 2, 1e-9)] for c in coupled]
    return kp, armature


def _chain(robot: Robot, pieces: int, armature: list[list[float]]) -> Iterator[str]:
    """Nested bodies, one for each joint, with a site at each place where tendons pass."""
    depth, sites = 0, _sites(robot, pieces)
    yield from _site_lines(sites[0], 6)
    for k, segment in enumerate(robot.segments):
        h = segment.length / pieces
        for i in range(pieces):
            # from the joint before: half a piece of this segment, and half of what lies before it
            before = h if i else 0.5 * h + (0.5 * robot.segments[k - 1].length / pieces if k else 0.0)
            pad = 6 + 2 * depth
            weightless = "" if segment.line_density > 0.0 else ' gravcomp="1"'
            yield f'{" " * pad}<body pos="0 0 {before:.9g}"{weightless}>'
            yield from _joints(segment, h, armature[k][0], pad + 2)
            yield from _mass(robot, k, i, h, pad + 2)
            yield from _site_lines(
                [(name, x, y, 0.5 * h) for name, x, y, _ in sites[k * pieces + i + 1]], pad + 2
            )
            depth += 1
    end = 0.5 * robot.segments[-1].length / pieces
    yield f'{" " * (6 + 2 * depth)}<site name="tip" pos="0 0 {end:.9g}" size="0.001"/>'
    for d in range(depth, 0, -1):
        yield f"{' ' * (4 + 2 * d)}</body>"


def _joints(segment: Segment, h: float, armature: float, pad: int) -> Iterator[str]:
    """Hinges about d1, d2 and d3, and a slide along d3 where the backbone stretches."""
    stiff = [*segment.bending_stiffness, segment.torsional_stiffness]
    for axis, stiffness, rest in zip(np.eye(3, dtype=int), stiff, segment.precurvature, strict=True):
        k = stiffness / h
        damping = max(2.0 * _DAMPED * math.sqrt(k * armature), k * segment.damping_time)
        yield (
            f'{" " * pad}<joint type="hinge" axis="{_numbers(axis)}" stiffness="{k:.9g}" '
            f'springref="{rest * h:.9g}" damping="{damping:.6g}" armature="{armature:.6g}"/>'
        )
    if math.isfinite(segment.axial_stiffness):
        k = segment.axial_stiffness / h
        heavy = k * (TIMESTEP / _PHASE) ** 2 * round(segment.length / h)
        yield (
            f'{" " * pad}<joint type="slide" axis="0 0 1" stiffness="{k:.9g}" '
            f'damping="{2.0 * _DAMPED * math.sqrt(k * heavy):.6g}" armature="{heavy:.6g}"/>'
        )


def _mass(robot: Robot, k: int, i: int, h: float, pad: int) -> Iterator[str]:
    """A capsule from half a piece before its joint to half a piece beyond, and the lumps there."""
    segment = robot.segments[k]
    weighs = segment.line_density > 0.0
    mass = segment.line_density * h if weighs else _LIGHT
    radius = segment.body_radius or 1.1 * max((float(np.max(t.offset)) for t in segment.tendons), default=h)
    if not weighs:
        yield f'{" " * pad}<inertial pos="0 0 0" mass="{mass:g}" diaginertia="1e-9 1e-9 1e-9"/>'
    yield (
        f'{" " * pad}<geom type="cylinder" fromto="0 0 {-0.5 * h:.9g} 0 0 {0.5 * h:.9g}" size="{radius:.6g}" '
        f'mass="{mass if weighs else 0.0:.9g}" contype="1" conaffinity="2"/>'
    )
    for lump in segment.lumps:
        if i == min(int(lump.at / h), round(segment.length / h) - 1):
            at = lump.at - (i + 0.5) * h
            yield (
                f'{" " * pad}<geom type="sphere" pos="0 0 {at:.9g}" size="{0.5 * radius:.6g}" '
                f'mass="{lump.mass:.9g}" contype="0" conaffinity="0"/>'
            )


def _sites(robot: Robot, pieces: int) -> list[list[tuple[str, float, float, float]]]:
    """Name and place of the sites at each end of a piece, base first."""
    made: list[list[tuple[str, float, float, float]]] = [[] for _ in range(robot.n_segments * pieces + 1)]
    for n, (tendon, end) in enumerate(zip(robot.tendons, robot.tendon_segment, strict=True)):
        for k, (x, y) in enumerate(tendon.position(int(end) + 1)):
            for i in range(pieces + 1):
                made[k * pieces + i].append((f"t{n + 1}_{k + 1}_{i}", x, y, 0.0))
    return made


def _path(robot: Robot, pieces: int, n: int) -> list[str]:
    """Names of the sites along a tendon, base first."""
    end = int(robot.tendon_segment[n])
    return [f"t{n + 1}_{k + 1}_{i}" for k in range(end + 1) for i in range(pieces + 1)]


def _site_lines(sites: list[tuple[str, float, float, float]], pad: int) -> Iterator[str]:
    for name, x, y, z in sites:
        yield f'{" " * pad}<site name="{name}" pos="{x:.9g} {y:.9g} {z:.9g}" size="0.0003"/>'


def _jumps(robot: Robot) -> list[float]:
    """Return what a tendon's path has between segments in which it lies elsewhere, which fastrod does not
    count [m]."""
    made = []
    for tendon, end in zip(robot.tendons, robot.tendon_segment, strict=True):
        places = tendon.position(int(end) + 1)
        made.append(sum(math.dist(a, b) for a, b in pairwise(places)))
    return made


def _numbers(values: Floats | tuple[float, ...]) -> str:
    return " ".join(f"{float(v):.9g}" for v in values)
