"""MuJoCo on the rod of Appendix J: its own rods (1D flexcomp), and chains of bodies with springs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np

from appendix_j import BENDING, LENGTH, TORSION, Array, Peer, Rung, Solve, one_by_one

if TYPE_CHECKING:
    import mujoco

Kind = Literal["flex", "ball", "hinge"]
_MASS = 1.0  # kg: it scales time, and the edges of a flex are the stiffer the heavier
_RADIUS = 3e-4  # m: only EI and GJ count, and a flexcomp wants elements longer than this


@dataclass(frozen=True)
class Setting:
    """Steps so long that the implicit integrator is close to Newton's method, and as many as bring the rod to
    rest."""

    links: int
    dt: float  # s; the first mode has 8.7 rad/s
    steps: int
    damping: float = 0.0  # s, of stiffness (Rayleigh)

    def __str__(self) -> str:
        return f"{self.links} links, {self.steps} steps of {self.dt:g} s"


def model(kind: Kind, setting: Setting) -> mujoco.MjModel:
    """The clamped rod along x. Its last body has its centre of mass at the tip, where `xfrc_applied` acts."""
    import mujoco

    body = _flex(setting) if kind == "flex" else _chain(kind, setting)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option timestep="{setting.dt}" integrator="discrete" '
        f'gravity="0 0 0"><flag contact="disable"/></option><worldbody>{body}</worldbody></mujoco>'
    )


def _flex(setting: Setting) -> str:
    """A clamped edge half behind the wall, so that the clamp is at the wall for a curvature that lives at the
    vertices."""
    n, h, second = setting.links, LENGTH / (setting.links - 0.5), 0.25 * math.pi * _RADIUS**4
    return (
        f'<flexcomp name="rod" type="grid" dim="1" count="{n + 1} 1 1" spacing="{h} 1 1" '
        f'pos="{0.5 * n * h - 0.5 * h} 0 0" radius="{_RADIUS}" mass="{_MASS}"><pin id="0 1"/>'
        '<edge equality="true" solref="1e-4 1" solimp="0.9999 0.9999 0.001"/>'
        f'<elasticity young="{BENDING / second}" shear="{TORSION / (2.0 * second)}" '
        f'damping="{setting.damping}"/><contact contype="0" conaffinity="0" selfcollide="none"/></flexcomp>'
    )


def _chain(kind: Kind, setting: Setting) -> str:
    """Half a link clamped, whole links, half a link; a spring EI/h in each joint."""
    n, h = setting.links, LENGTH / setting.links
    spring = BENDING / h
    joint = f'<joint type="{kind}" axis="0 0 1" stiffness="{spring}" damping="{setting.damping * spring}"/>'
    body, at = "", 0.5 * h
    for link in [h] * (n - 1) + [0.5 * h]:
        mass = _MASS * link / LENGTH
        inertia = " ".join([str(mass * h * h / 12.0)] * 3)
        body += (
            f'<body pos="{at} 0 0">{joint}<inertial pos="{link} 0 0" mass="{mass}" diaginertia="{inertia}"/>'
        )
        at = link
    return body + "</body>" * n


@contextmanager
def _one_by_one(kind: Kind, setting: Setting) -> Iterator[Solve]:
    import mujoco

    made = model(kind, setting)
    data, tip = mujoco.MjData(made), _tip(kind, made)

    def rest(across: float) -> Array:
        mujoco.mj_resetData(made, data)
        data.xfrc_applied[tip, 1] = across
        mujoco.mj_step(made, data, nstep=setting.steps)
        mujoco.mj_kinematics(made, data)
        return np.array(data.xipos[tip, 1::-1])

    yield one_by_one(rest)


@contextmanager
def _together(kind: Kind, setting: Setting) -> Iterator[Solve]:
    import mujoco
    from mujoco.batch import Batch

    made = model(kind, setting)
    tip = _tip(kind, made)
    batches: dict[int, Batch] = {}

    def solve(force: Array) -> Array:
        batch = batches.setdefault(len(force), Batch(made, len(force), nthread=1))
        batch.reset()
        applied, position = batch.bind("xfrc_applied"), batch.bind("xipos")
        applied[:, tip, 1] = force
        batch.step(nstep=setting.steps, stage=mujoco.mjtStage.mjSTAGE_POS.value)
        return np.array(position[:, tip, 1::-1])

    yield solve


def _tip(kind: Kind, made: mujoco.MjModel) -> int:
    """Index of the body at the tip; the bodies of a flex that twist come after those of its vertices."""
    import mujoco

    if kind != "flex":
        return int(made.nbody) - 1
    names = (mujoco.mj_id2name(made, mujoco.mjtObj.mjOBJ_BODY, i) or "" for i in range(made.nbody))
    vertices = {i: name[4:] for i, name in enumerate(names) if name[:4] == "rod_" and name[4:].isdecimal()}
    return max(vertices, key=lambda i: int(vertices[i]))


_FLEX = ((3, 0.2, 8, 0.1), (6, 0.2, 8, 0.1), (8, 0.2, 10, 0.1), (12, 0.1, 16, 0.2), (16, 0.05, 30, 0.2))
_LONG = ((24, 0.03, 45, 0.2), (32, 0.02, 70, 0.2))


def _peer(name: str, kind: Kind, most: int, same: str) -> Peer:
    links = [Setting(n, 1.0, 6 + n // 16) for n in (2, 4, 8, 16, 32, 64, 128) if n <= most]
    return Peer(
        name=f"MuJoCo {name}",
        modules=("mujoco",),
        same=same,
        also="dynamics, joints and motors, its own contact with friction between all bodies, GPU by MJX and "
        "Warp, inverse dynamics.",
        rungs=[
            Rung(str(one), partial(_one_by_one, kind, one), partial(_together, kind, one))
            for one in links or [Setting(*words) for words in (*_FLEX, *_LONG)]
        ],
    )


FLEX = _peer(
    "rod (flexcomp)",
    "flex",
    0,
    "a discrete elastic rod with EI and GJ as they are, begun half an edge before the wall; its edges "
    "are held by constraints that give a little, the less the shorter the step; brought to rest by long "
    "implicit steps (integrator discrete).",
)
BALLS = _peer(
    "chain, ball joints",
    "ball",
    64,
    "links with a spring EI/h in each ball joint, half a link at both ends. Twist gets EI too, for a "
    "ball has one stiffness: it is not loaded here.",
)
HINGES = _peer(
    "chain, hinges",
    "hinge",
    128,
    "the same chain with hinges across the plane of the load: a plane rod, and the plane is given to it.",
)
