"""MuJoCo on the rod that is pulled aside and let go: its own rods (1D flexcomp), and chains of bodies with
springs."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import release
from appendix_j import Array, Peer, Rung, Solve
from release import BENDING, DENSITY, LENGTH, RADIUS, TIMES, TORSION

if TYPE_CHECKING:
    import mujoco

Kind = Literal["flex", "ball", "hinge"]


@dataclass(frozen=True)
class Setting:
    links: int
    ms: float
    integrator: str

    def __str__(self) -> str:
        return f"{self.links} links, {self.integrator} {self.ms:g} ms"


def model(kind: Kind, setting: Setting) -> mujoco.MjModel:
    """The clamped rod along x, with a force along y on the site `tip` as its one actuator."""
    import mujoco

    body, drive = _flex(setting.links) if kind == "flex" else _chain(kind, setting.links)
    made = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option timestep="{1e-3 * setting.ms}" gravity="0 0 0" '
        f'integrator="{setting.integrator}"><flag contact="disable"/></option><worldbody><site name="world"/>'
        f"{body}</worldbody>{drive}</mujoco>"
    )
    if kind == "flex":
        _weigh(made, setting.links)
    return made


def _flex(n: int) -> tuple[str, str]:
    """A clamped edge half behind the wall (`peer_mujoco`)."""
    h, radius = LENGTH / (n - 0.5), 3e-4
    second = 0.25 * math.pi * radius**4
    body = (
        f'<flexcomp name="rod" type="grid" dim="1" count="{n + 1} 1 1" spacing="{h} 1 1" '
        f'pos="{0.5 * n * h - 0.5 * h} 0 0" radius="{radius}" mass="{DENSITY * h * (n + 1)}"><pin id="0 1"/>'
        '<edge equality="true" solref="1e-4 1" solimp="0.9999 0.9999 0.001"/>'
        f'<elasticity young="{BENDING / second}" shear="{TORSION / (2.0 * second)}" damping="0"/>'
        '<contact contype="0" conaffinity="0" selfcollide="none"/></flexcomp>'
    )
    return body, f'<sensor><framepos objtype="xbody" objname="rod_{n}"/></sensor>'


def _weigh(made: mujoco.MjModel, n: int) -> None:
    """Half an edge's mass at the tip, where MuJoCo puts that of a whole one."""
    import mujoco

    tip = mujoco.mj_name2id(made, mujoco.mjtObj.mjOBJ_BODY, f"rod_{n}")
    made.body_mass[tip] *= 0.5
    made.body_inertia[tip] *= 0.5
    mujoco.mj_setConst(made, mujoco.MjData(made))


def _chain(kind: Kind, n: int) -> tuple[str, str]:
    """Half a link clamped, whole links, half a link; a spring EI/h in each joint."""
    h = LENGTH / n
    joint = f'<joint type="{kind}" axis="0 0 1" stiffness="{BENDING / h}"/>'
    body, at = "", 0.5 * h
    for link in [h] * (n - 1) + [0.5 * h]:
        mass = DENSITY * link
        rotary = 0.25 * RADIUS**2
        inertia = f"{mass * link * link / 12.0} " + 2 * f"{mass * (link * link / 12.0 + rotary)} "
        body += f'<body pos="{at} 0 0">{joint}<inertial pos="{0.5 * link} 0 0" mass="{mass}" '
        body += f'diaginertia="{inertia}"/>'
        at = link
    body += f'<site name="tip" pos="{at} 0 0"/>' + "</body>" * n
    drive = '<actuator><general site="tip" refsite="world" gear="0 1 0 0 0 0"/></actuator>'
    return body, drive + '<sensor><framepos objtype="site" objname="tip"/></sensor>'


@contextmanager
def _swing(kind: Kind, setting: Setting) -> Iterator[Solve]:
    """Whole motions in MuJoCo's own loop (`rollout`), any number of rods in one call; the force of a step is
    that at its middle."""
    import mujoco
    from mujoco import rollout

    made = model(kind, setting)
    data = mujoco.MjData(made)
    state = np.empty(mujoco.mj_stateSize(made, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(made, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    every = round(release.EVERY / made.opt.timestep)
    # a sensor shows the state before its step
    steps = np.arange(every * len(TIMES) + 1)
    pull = np.array([release.pull((k + 0.5) * made.opt.timestep) for k in steps])
    spec, size, place = mujoco.mjtState.mjSTATE_CTRL, 1, 0
    if kind == "flex":
        spec, size = mujoco.mjtState.mjSTATE_XFRC_APPLIED, 6 * made.nbody
        place = 6 * mujoco.mj_name2id(made, mujoco.mjtObj.mjOBJ_BODY, f"rod_{setting.links}") + 1

    def solve(force: Array) -> Array:
        control = np.zeros((len(force), len(pull), size))
        control[:, :, place] = force[:, None] * pull
        given: Any = np.tile(state, (len(force), 1))
        _, sensed = rollout.rollout(made, [data], given, control, control_spec=int(spec))
        return np.asarray(sensed[:, every::every, 1::-1])

    yield solve


def _peer(name: str, kind: Kind, same: str, *settings: Setting) -> Peer:
    return Peer(
        name=f"MuJoCo {name}",
        modules=("mujoco",),
        same=same,
        also="joints and motors, its own contact with friction between all bodies, GPU by MJX and Warp, "
        "inverse dynamics.",
        rungs=[Rung(str(one), *2 * (partial(_swing, kind, one),)) for one in settings],
    )


def _each(integrator: str, *pairs: tuple[int, float]) -> list[Setting]:
    return [Setting(links, ms, integrator) for links, ms in pairs]


FLEX = _peer(
    "rod (flexcomp)",
    "flex",
    "a discrete elastic rod with EI and GJ as they are, begun half an edge before the wall, half an edge's "
    "mass at its tip; no rotary inertia; its edges are held by constraints that give a little, and its "
    "integrator (discrete) is implicit and of first order, so that the step must be short.",
    *_each("discrete", (8, 1.0), (8, 0.25), (12, 0.1), (16, 0.05)),
)
BALLS = _peer(
    "chain, ball joints",
    "ball",
    "links with a spring EI/h in each ball joint, half a link at both ends, by Runge-Kutta: the implicit "
    "ones damp what is not damped; in steps near the longest that are stable. Twist, which nothing loads, "
    "gets EI too, for a ball has one stiffness, and inertia for long steps.",
    *_each("RK4", (4, 1.0), (6, 0.5), (8, 0.25), (12, 0.125), (16, 0.0625)),
)
HINGES = _peer(
    "chain, hinges",
    "hinge",
    "the same chain with hinges across the plane of the load: a plane rod, and the plane is given to it.",
    *_each("RK4", (4, 1.0), (6, 0.5), (8, 0.25), (12, 0.125), (16, 0.0625), (24, 0.03125)),
)
