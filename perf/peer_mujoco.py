"""MuJoCo: its own rods (1D flexcomp), and chains of bodies with springs, on the rod of Appendix J and on the
rod that is pulled aside and let go."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

import appendix_j
import release
from appendix_j import Array, Peer, Rung, Solve, one_by_one

if TYPE_CHECKING:
    import mujoco

Kind = Literal["flex", "ball", "hinge"]
_MASS = 1.0  # kg, of the rod at rest: it scales time, and the edges of a flex are the stiffer the heavier
_RADIUS = 3e-4  # m, of a flex: only EI and GJ count, and a flexcomp wants elements longer than this
_ALSO = (
    "joints and motors, its own contact with friction between all bodies, GPU by MJX and Warp, inverse "
    "dynamics."
)


def _model(options: str, body: str, drive: str = "") -> mujoco.MjModel:
    import mujoco

    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian"/><option gravity="0 0 0" {options}><flag contact="disable"/>'
        f'</option><worldbody><site name="world"/>{body}</worldbody>{drive}</mujoco>'
    )


def _flex(n: int, of: Any, mass: float, damping: float = 0.0) -> str:
    """A rod along x with the length, EI and GJ of the module `of`, a clamped edge half behind the wall, so
    that the clamp is at the wall for a curvature that lives at the vertices."""
    h, second = of.LENGTH / (n - 0.5), 0.25 * math.pi * _RADIUS**4
    return (
        f'<flexcomp name="rod" type="grid" dim="1" count="{n + 1} 1 1" spacing="{h} 1 1" '
        f'pos="{0.5 * n * h - 0.5 * h} 0 0" radius="{_RADIUS}" mass="{mass}"><pin id="0 1"/>'
        '<edge equality="true" solref="1e-4 1" solimp="0.9999 0.9999 0.001"/>'
        f'<elasticity young="{of.BENDING / second}" shear="{of.TORSION / (2.0 * second)}" '
        f'damping="{damping}"/><contact contype="0" conaffinity="0" selfcollide="none"/></flexcomp>'
    )


# ------------------------------------------------------------ at rest


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


def _at_rest(kind: Kind, setting: Setting) -> mujoco.MjModel:
    """The clamped rod along x. Its last body has its centre of mass at the tip, where `xfrc_applied` acts."""
    flex = kind == "flex"
    body = _flex(setting.links, appendix_j, _MASS, setting.damping) if flex else _chain(kind, setting)
    return _model(f'timestep="{setting.dt}" integrator="discrete"', body)


def _chain(kind: Kind, setting: Setting) -> str:
    """Half a link clamped, whole links, half a link; a spring EI/h in each joint."""
    n, h = setting.links, appendix_j.LENGTH / setting.links
    spring = appendix_j.BENDING / h
    joint = f'<joint type="{kind}" axis="0 0 1" stiffness="{spring}" damping="{setting.damping * spring}"/>'
    body, at = "", 0.5 * h
    for link in [h] * (n - 1) + [0.5 * h]:
        mass = _MASS * link / appendix_j.LENGTH
        inertia = " ".join([str(mass * h * h / 12.0)] * 3)
        body += (
            f'<body pos="{at} 0 0">{joint}<inertial pos="{link} 0 0" mass="{mass}" diaginertia="{inertia}"/>'
        )
        at = link
    return body + "</body>" * n


@contextmanager
def _one_by_one(kind: Kind, setting: Setting) -> Iterator[Solve]:
    import mujoco

    made = _at_rest(kind, setting)
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

    made = _at_rest(kind, setting)
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
        also=f"dynamics, {_ALSO}",
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


# ------------------------------------------------------------ let go


@dataclass(frozen=True)
class _Pace:
    links: int
    ms: float
    integrator: str

    def __str__(self) -> str:
        return f"{self.links} links, {self.integrator} {self.ms:g} ms"


def _in_motion(kind: Kind, pace: _Pace) -> mujoco.MjModel:
    """The clamped rod along x, with a force along y on the site `tip` of a chain as its one actuator."""
    n, options = pace.links, f'timestep="{1e-3 * pace.ms}" integrator="{pace.integrator}"'
    if kind != "flex":
        return _model(options, *_moving_chain(kind, n))
    mass = release.DENSITY * release.LENGTH / (n - 0.5) * (n + 1)
    sensor = f'<sensor><framepos objtype="xbody" objname="rod_{n}"/></sensor>'
    made = _model(options, _flex(n, release, mass), sensor)
    _weigh(made, n)
    return made


def _weigh(made: mujoco.MjModel, n: int) -> None:
    """Half an edge's mass at the tip, where MuJoCo puts that of a whole one."""
    import mujoco

    tip = mujoco.mj_name2id(made, mujoco.mjtObj.mjOBJ_BODY, f"rod_{n}")
    made.body_mass[tip] *= 0.5
    made.body_inertia[tip] *= 0.5
    mujoco.mj_setConst(made, mujoco.MjData(made))


def _moving_chain(kind: Kind, n: int) -> tuple[str, str]:
    """Half a link clamped, whole links, half a link; a spring EI/h in each joint."""
    h = release.LENGTH / n
    joint = f'<joint type="{kind}" axis="0 0 1" stiffness="{release.BENDING / h}"/>'
    body, at = "", 0.5 * h
    for link in [h] * (n - 1) + [0.5 * h]:
        mass = release.DENSITY * link
        rotary = 0.25 * release.RADIUS**2
        inertia = f"{mass * link * link / 12.0} " + 2 * f"{mass * (link * link / 12.0 + rotary)} "
        body += f'<body pos="{at} 0 0">{joint}<inertial pos="{0.5 * link} 0 0" mass="{mass}" '
        body += f'diaginertia="{inertia}"/>'
        at = link
    body += f'<site name="tip" pos="{at} 0 0"/>' + "</body>" * n
    drive = '<actuator><general site="tip" refsite="world" gear="0 1 0 0 0 0"/></actuator>'
    return body, drive + '<sensor><framepos objtype="site" objname="tip"/></sensor>'


@contextmanager
def _swing(kind: Kind, pace: _Pace) -> Iterator[Solve]:
    """Whole motions in MuJoCo's own loop (`rollout`), any number of rods in one call; the force of a step is
    that at its middle."""
    import mujoco
    from mujoco import rollout

    made = _in_motion(kind, pace)
    data = mujoco.MjData(made)
    state = np.empty(mujoco.mj_stateSize(made, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(made, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    every = round(release.EVERY / made.opt.timestep)
    # a sensor shows the state before its step
    steps = np.arange(every * len(release.TIMES) + 1)
    pull = np.array([release.pull((k + 0.5) * made.opt.timestep) for k in steps])
    spec, size, place = mujoco.mjtState.mjSTATE_CTRL, 1, 0
    if kind == "flex":
        spec, size = mujoco.mjtState.mjSTATE_XFRC_APPLIED, 6 * made.nbody
        place = 6 * mujoco.mj_name2id(made, mujoco.mjtObj.mjOBJ_BODY, f"rod_{pace.links}") + 1

    def solve(force: Array) -> Array:
        control = np.zeros((len(force), len(pull), size))
        control[:, :, place] = force[:, None] * pull
        given: Any = np.tile(state, (len(force), 1))
        _, sensed = rollout.rollout(made, [data], given, control, control_spec=int(spec))
        return np.asarray(sensed[:, every::every, 1::-1])

    yield solve


def _released(name: str, kind: Kind, same: str, integrator: str, *pairs: tuple[int, float]) -> Peer:
    paces = [_Pace(links, ms, integrator) for links, ms in pairs]
    rungs = [Rung(str(one), *2 * (partial(_swing, kind, one),)) for one in paces]
    return Peer(f"MuJoCo {name}", ("mujoco",), same, _ALSO, rungs)


_STABLE = ((4, 1.0), (6, 0.5), (8, 0.25), (12, 0.125), (16, 0.0625))
FLEX_RELEASED = _released(
    "rod (flexcomp)",
    "flex",
    "a discrete elastic rod with EI and GJ as they are, begun half an edge before the wall, half an edge's "
    "mass at its tip; no rotary inertia; its edges are held by constraints that give a little, and its "
    "integrator (discrete) is implicit and of first order, so that the step must be short.",
    "discrete",
    (8, 1.0),
    (8, 0.25),
    (12, 0.1),
    (16, 0.05),
)
BALLS_RELEASED = _released(
    "chain, ball joints",
    "ball",
    "links with a spring EI/h in each ball joint, half a link at both ends, by Runge-Kutta: the implicit "
    "ones damp what is not damped; in steps near the longest that are stable. Twist, which nothing loads, "
    "gets EI too, for a ball has one stiffness, and inertia for long steps.",
    "RK4",
    *_STABLE,
)
HINGES_RELEASED = _released(
    "chain, hinges",
    "hinge",
    "the same chain with hinges across the plane of the load: a plane rod, and the plane is given to it.",
    "RK4",
    *_STABLE,
    (24, 0.03125),
)
