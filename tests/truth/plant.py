"""A plant: the real robot with an undeclared effect inside. numpy and scipy only, nothing shared with the
package under test.

It plays one or two push-pull segments and writes the log a camera would: tendons -> transmission -> rod ->
camera. Every effect is in another functional form than the obvious one (two creep times, sums of plays,
half-cosine precurvature, ...), so a library that fits it has understood the effect and not recognised its own
code. The rod is the principle of virtual work on Legendre curvatures, batched.

    seal = draw(7, "friction")                          # what is hidden, and how large
    y = measure(designed_inputs(np.random.default_rng(7)), seal)

`python tests/truth/plant.py [segments]` prints how far each effect moves the tip.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from plant_rod import EI, GJ, GRAVITY, LENGTH, NODES, OFFSET, Array, Rod, angles, pairs, routing, tendons
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.signal import bilinear, lfilter, lfilter_zi
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import expit

Size = Literal["small", "typical", "large"] | float

_LIBRARY = """
gravity payload tip_force friction backlash slack tendon_stretch coupling drum_gain encoder_offset
routing_angle creep precurvature stiffness_taper stiffness_anisotropy stiffening axial_compression
plastic_set time_drift temperature latency second_order_lag frame_misalignment marker_offset camera_scale lens
"""
LIBRARY = tuple(_LIBRARY.split())
OUTSIDE = ("bump", "sway", "ripple", "contact", "slip", "magnet")
"""Seals outside the library: the verdict on these is "not in the library"."""


@dataclass(frozen=True)
class Inputs:
    """Commands of the robot and its known surroundings, a row per sample."""

    t: Array
    """(n,) [s], increasing."""
    dl: Array
    """(n, n_tendons) commanded change of length [m]; tendon i at 90 i deg, distal ones at 45 + 90 i deg."""
    payload: Array
    """(n,) known mass at the tip [kg]."""
    base_quaternion: Array
    """(n, 4) world_from_base, w x y z."""

    @property
    def segments(self) -> int:
        return int(self.dl.shape[1] // 4)


@dataclass(frozen=True)
class Seal:
    """Effects hidden in the plant; open it only to judge a verdict."""

    effects: dict[str, dict[str, Any]]
    """Name -> parameters in SI units and radians."""
    seed: int
    """Seed of the draw; the noise follows from it too."""


# ---------------------------------------------------------------- draws


def draw(
    seed: int, effect: str | Sequence[str] = "any", *, segments: int = 1, size: Size = "typical"
) -> Seal:
    """Effects with parameters from the catalogue's ranges.

    - `effect`: a name, several, "none", "any" (one of LIBRARY) or "outside" (one of OUTSIDE).
    - `size`: where in the range the amplitude falls, or a factor on a typical draw (0.15: a small
      disturbance, perhaps below the range).
    """
    choice = np.random.default_rng([seed, 0])
    if effect == "any":
        effect = str(choice.choice(library(segments)))
    elif effect == "outside":
        effect = str(choice.choice(OUTSIDE))
    names = [] if effect == "none" else [effect] if isinstance(effect, str) else list(effect)
    return Seal({name: _parameters(name, _generator(seed, name), segments, size) for name in names}, seed)


def draw_pair(seed: int, *, segments: int = 1) -> Seal:
    """Two different effects of the library, both of typical size."""
    names = np.random.default_rng([seed, 2]).choice(library(segments), 2, replace=False)
    return draw(seed, [str(name) for name in names], segments=segments)


def draw_many(seed: int, inputs: Inputs) -> Seal:
    """One dominant effect, and eight others that each move the tip by 0.1 to 0.2 of what it does."""
    rng = np.random.default_rng([seed, 3])
    segments = inputs.segments
    names = [str(name) for name in rng.choice(library(segments), 9, replace=False)]
    straight = pose(inputs, Seal({}, seed))[0]

    def moves(effects: dict[str, dict[str, Any]]) -> float:
        return float(np.sqrt(np.mean((pose(inputs, Seal(effects, seed))[0] - straight) ** 2)))

    effects = draw(seed, names[0], segments=segments).effects
    dominant = moves(effects)
    for name in names[1:]:
        share = float(rng.uniform(0.1, 0.2))
        factor = share * dominant / max(moves(draw(seed, name, segments=segments).effects), 1e-9)
        effects = effects | draw(seed, name, segments=segments, size=min(factor, 2.0)).effects
    return Seal(effects, seed)


def library(segments: int) -> tuple[str, ...]:
    """The effects that a robot of so many segments can have."""
    return LIBRARY if segments > 1 else tuple(name for name in LIBRARY if name != "coupling")


def _generator(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def _parameters(name: str, rng: np.random.Generator, segments: int, size: Size) -> dict[str, Any]:
    """One effect's numbers; `amount` is what `size` scales. The longer robot's typical is lower."""
    as_ever = name in ("stiffness_anisotropy", "time_drift", "lens", "bump", "sway")
    typical = (0.35, 0.85) if segments == 1 or as_ever else (0.05, 0.4)
    spans = {"small": (0.0, 0.35), "large": (0.85, 1.0)}
    span = spans.get(size, typical) if isinstance(size, str) else typical
    fraction, factor = rng.uniform(*span), 1.0 if isinstance(size, str) else size
    n_pairs, reach = 2 * segments, 0.03 if segments == 1 else 0.09

    def amount(low: float, high: float, power: float = 1.0) -> float:
        """The higher the power, the nearer to the low end: where the high end would drown all else."""
        return float(factor * (low + fraction**power * (high - low)))

    def signs(n: int = n_pairs) -> Array:
        return rng.choice([-1.0, 1.0], n)

    def direction(flat: float = 1.0) -> Array:
        v = rng.normal(size=3) * [1.0, 1.0, flat]
        return np.asarray(v / np.linalg.norm(v))

    def log(low: float, high: float) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    uniform, degree = rng.uniform, np.pi / 180.0
    match name:
        case "gravity":  # N/m, relative slope of the density along the robot
            return {"weight": amount(2.0, 6.0), "slope": uniform(-0.15, 0.15)}
        case "payload":  # kg, its centre beyond the tip
            return {"mass": amount(0.005, 0.030), "lever": uniform(0.0, 0.004)}
        case "tip_force":
            return {"force": amount(0.05, 0.3) * direction(0.3)}
        case "friction":  # bend lost [rad], growth [1/rad], radii [rad] of the plays and their shares
            n = int(rng.integers(3, 6))
            radii = np.sort(uniform(2.0, 15.0, n)) * degree
            loss = {"loss": amount(1.0, 6.0, 1.5) * degree, "growth": uniform(0.3, 0.8)}
            return loss | {"radii": radii, "shares": rng.dirichlet(np.full(n, 4.0))}
        case "backlash":  # m of wire
            return {"half_width": amount(1e-4, 4e-4) * uniform(0.88, 1.12, n_pairs)}
        case "slack":  # m of wire
            return {"half_width": amount(1.0, 5.0) * degree * OFFSET * uniform(0.88, 1.12, n_pairs)}
        case "tendon_stretch":
            return {"gain_loss": amount(0.03, 0.26, 1.5)}
        # share of the neighbour's bend: proximal into distal, distal into proximal; turned by an angle
        case "coupling" if segments > 1:
            leak = amount(0.02, 0.20) * signs(1)[0] * np.array([1.0, uniform(0.0, 0.4)])
            return {"leak": leak, "turn": uniform(-12.0, 12.0) * degree}
        case "drum_gain":
            return {"gain": amount(0.02, 0.05) * uniform(0.85, 1.0, n_pairs) * signs()}
        case "encoder_offset":  # rad of bend
            return {"offset": amount(0.5, 3.0) * degree * uniform(0.7, 1.0, n_pairs) * signs()}
        case "routing_angle":
            return {"angle": amount(1.0, 5.0) * degree * uniform(0.6, 1.0, n_pairs) * signs()}
        case "creep":
            split = uniform(0.35, 0.65)
            share = amount(0.03, 0.15) * np.array([split, 1.0 - split])
            return {"share": share, "tau": np.array([log(1.0, 5.0), log(10.0, 60.0)])}
        case "precurvature":  # 1/m, half a cosine along each segment
            angle = uniform(0.0, 2.0 * np.pi, segments)
            return {"mode": amount(0.5, 3.0) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)}
        case "stiffness_taper":  # EI exp(rate (1 - 2 s / l))
            return {"rate": amount(0.15, 0.5) * signs(1)[0]}
        case "stiffness_anisotropy":  # EI exp(+-epsilon) along axes that are turned a little
            return {"epsilon": amount(0.05, 0.3) * signs(1)[0], "turn": uniform(-8.0, 8.0) * degree}
        case "stiffening":  # 1/rad^2, rad where it saturates
            return {"cubic": amount(0.05, 0.2), "saturation": uniform(1.0, 1.5)}
        case "axial_compression":  # 1/rad, 1/rad
            return {"rate": amount(0.01, 0.03), "growth": uniform(0.1, 0.3)}
        case "plastic_set":  # share of what is bent beyond the yield [rad]
            return {"share": amount(0.02, 0.15), "yield": uniform(0.5, 0.6)}
        case "time_drift":  # m at the end of the log; share of a parabola
            return {"drift": amount(1e-3, 3e-3) * direction(), "curve": uniform(-0.5, 0.5)}
        case "temperature":  # gain when warm, s
            return {"gain": amount(0.03, 0.10) * signs(1)[0], "tau": log(40.0, 200.0)}
        case "latency":  # s, s per s
            return {"delay": amount(0.03, 0.2, 3.0), "skew": uniform(-1e-4, 1e-4)}
        case "second_order_lag":  # Hz of each pair, damping ratio; `amount` sets the period
            frequency = 1.0 / amount(1.0 / 3.0, 1.0, 3.0) * uniform(0.9, 1.1, n_pairs)
            return {"frequency": frequency, "damping": uniform(0.15, 0.5)}
        case "frame_misalignment":  # rotation vector [rad], m
            turn = amount(0.5, 3.0) * degree * direction()
            return {"turn": turn, "shift": amount(5e-4, 5e-3) * direction()}
        case "marker_offset":  # m in the tip's frame
            return {"offset": amount(2e-3, 2e-2, 3.0) * direction()}
        case "camera_scale":  # across and along the axis of view
            return {"scale": amount(0.005, 0.02) * signs(1)[0] * np.array([1.0, 1.0, uniform(0.7, 1.3)])}
        case "lens":  # relative at the edge of the workspace; m; m
            edge = amount(0.002, 0.01) * signs(1)[0]
            return {"edge": edge, "radius": reach, "centre": uniform(-0.2, 0.2, 2) * reach}
        case "bump":  # m, share of the log
            return {"shift": amount(5e-4, 3e-3) * direction(), "at": uniform(0.25, 0.75)}
        case "sway":  # m, Hz, rad
            sway = amount(3e-4, 2e-3) * direction()
            return {"sway": sway, "frequency": log(0.2, 2.0), "phase": uniform(0.0, 2.0 * np.pi)}
        case "ripple":  # m of wire; m; turns of the motor per turn of the drum; rad
            ripple = {"amplitude": amount(1e-4, 3e-4), "drum_radius": uniform(4e-3, 8e-3)}
            return ripple | {"gear": float(rng.integers(4, 9)), "phase": uniform(0.0, 2.0 * np.pi, n_pairs)}
        case "contact":  # a plane: base frame, m, N/m
            plane = {"normal": direction(0.0), "distance": uniform(0.35, 0.55) * reach}
            return plane | {"stiffness": amount(20.0, 100.0) / segments}
        case "slip":  # m of wire, share of the log
            jump = amount(1e-4, 4e-4) * signs(1)[0] * (np.arange(n_pairs) == rng.integers(n_pairs))
            return {"jump": jump, "at": uniform(0.2, 0.7)}
        case "magnet":  # m in the base frame; N at `distance`; it falls with 1 / (d^2 + core^2)
            where, far = uniform(0.0, 2.0 * np.pi), uniform(1.6, 1.9) * reach
            height = uniform(0.7, 1.0) * segments * LENGTH
            place = np.array([far * np.cos(where), far * np.sin(where), height])
            force = amount(0.06, 0.16) / segments
            return {"place": place, "force": force, "distance": reach, "core": 0.35 * reach}
    names = ", ".join(library(segments) + OUTSIDE)
    raise ValueError(
        f"no effect of a robot of {segments} segment(s) is called {name!r}; the names are {names}"
    )


# ---------------------------------------------------------------- the log


def measure(inputs: Inputs, seal: Seal, noise: float = 3e-4, *, outliers: float = 0.0) -> Array:
    """Tip positions in the base frame (n, 3) [m] as a camera reports them.

    - `noise` [m]: standard deviation per axis. `outliers`: share of samples thrown off by 5 to 20 mm.
    """
    rng = np.random.default_rng([seal.seed, 1])
    seen, _ = pose(inputs, seal)
    seen = seen + noise * rng.normal(size=seen.shape)
    wrong = rng.random(len(seen)) < outliers
    far = rng.normal(size=seen.shape)
    far *= rng.uniform(5e-3, 2e-2, (len(seen), 1)) / np.linalg.norm(far, axis=1, keepdims=True)
    return np.where(wrong[:, None], seen + far, seen)


def pose(inputs: Inputs, seal: Seal) -> tuple[Array, Array]:
    """The same without noise: positions (n, 3) [m] and rotations base_from_tip (n, 3, 3)."""
    rod = _hidden_rod(inputs.segments, seal.effects)
    dl, bend = _transmission(inputs, seal.effects)
    down = Rotation.from_quat(inputs.base_quaternion[:, [1, 2, 3, 0]]).inv().apply([0.0, 0.0, -GRAVITY])
    position, rotation = _loaded(rod, dl, bend, inputs.payload[:, None], down, seal.effects)
    return _camera(inputs.t, position, rotation, seal.effects)


def _transmission(inputs: Inputs, effects: dict[str, dict[str, Any]]) -> tuple[Array, Array]:
    """Lengths that reach the rod (n, tendons) [m] and the bend they ask for (n, segments, 2) [rad].

    Pairs p [m] (half the difference of two opposite tendons) carry the effects; what the two tendons share
    stays as commanded.
    """
    t, segments = inputs.t, inputs.segments
    p = pairs(inputs.dl)
    common = inputs.dl - tendons(p)
    share = (t - t[0]) / (t[-1] - t[0])
    to_pairs = routing(segments)
    to_bend = np.linalg.inv(to_pairs)
    if e := effects.get("drum_gain"):  # layers of wire: the radius grows a little with the wire that is wound
        p = p * (1.0 + e["gain"] * (1.0 + 0.1 * np.tanh(np.abs(p) / 5e-3)))
    if e := effects.get("encoder_offset"):
        p = p + OFFSET * e["offset"]
    if e := effects.get("ripple"):
        p = p + e["amplitude"] * np.sin(e["gear"] * p / e["drum_radius"] + e["phase"])
    if e := effects.get("slip"):
        p = p + e["jump"] * (share > e["at"])[:, None]
    if e := effects.get("temperature"):
        p = p * (1.0 + e["gain"] * (1.0 - np.exp(-(((t - t[0]) / e["tau"]) ** 0.9))))[:, None]
    if e := effects.get("backlash"):  # three widths together round the corners
        p = np.mean([_play(p, e["half_width"] * k) for k in (0.85, 1.0, 1.15)], axis=0)
    if e := effects.get("friction"):
        plays = zip(e["shares"], OFFSET * e["radii"], strict=True)
        spring = sum(w * (p - _play(p, r)) / r for w, r in plays)
        bends = np.linalg.norm((p @ to_bend.T).reshape(len(t), segments, 2), axis=2)
        along = bends.sum(axis=1, keepdims=True)
        p = p - OFFSET * e["loss"] * (1.0 + e["growth"] * along) * spring
    if e := effects.get("slack"):
        p = p - e["half_width"] * np.tanh(p / e["half_width"])
    if e := effects.get("creep"):
        p = p - sum(c * (p - _lag(t, p, tau)) for c, tau in zip(e["share"], e["tau"], strict=True))
    if e := effects.get("second_order_lag"):
        each = zip(p.T, e["frequency"], strict=True)
        p = np.stack([_ringing(t, x, f, e["damping"]) for x, f in each], axis=1)
    bend = (p @ to_bend.T).reshape(len(t), segments, 2)
    if (e := effects.get("coupling")) and segments > 1:
        cos, sin = np.cos(e["turn"]), np.sin(e["turn"])
        leaked = 1.4 * np.tanh(bend[:, ::-1] / 1.4) @ np.array([[cos, sin], [-sin, cos]])
        bend = bend + e["leak"][::-1, None] * leaked
    if e := effects.get("plastic_set"):
        bend = bend + e["share"] * _yielding(bend, e["yield"])
    if e := effects.get("stiffening"):
        size = np.linalg.norm(bend, axis=2, keepdims=True)
        bend = bend * (1.0 - e["cubic"] * (e["saturation"] * np.tanh(size / e["saturation"])) ** 2)
    return common + tendons(bend.reshape(len(t), -1) @ to_pairs.T), bend


def _play(x: Array, radius: float | Array) -> Array:
    """The play operator: what a shaft in a slot of this half width passes on; it starts in the middle."""
    out = np.empty_like(x)
    state = x[0].copy()
    for k, row in enumerate(x):
        state = np.minimum(np.maximum(state, row - radius), row + radius)
        out[k] = state
    return out


def _yielding(bend: Array, limit: float) -> Array:
    """A play in the plane of bending, with a round yield surface (n, segments, 2) [rad]."""
    out = np.empty_like(bend)
    state = np.zeros_like(bend[0])
    for k, row in enumerate(bend):
        beyond = row - state
        size = np.linalg.norm(beyond, axis=-1, keepdims=True)
        state = state + beyond * np.maximum(0.0, 1.0 - limit / np.maximum(size, 1e-12))
        out[k] = state
    return out


def _lag(t: Array, x: Array, tau: float) -> Array:
    """First order, exact where x is linear between the samples; at rest with x[0] before."""
    out = x.copy()
    for k, h in enumerate(np.diff(t)):
        keep = np.exp(-h / tau)
        slope = (x[k + 1] - x[k]) * tau / h
        out[k + 1] = x[k + 1] - slope + keep * (out[k] - x[k] + slope)
    return out


def _ringing(t: Array, x: Array, frequency: float, damping: float) -> Array:
    """Second order at 2 ms steps, at rest with x[0] before."""
    fine = np.arange(t[0], t[-1] + 2e-3, 2e-3)
    period = 1.0 / (2.0 * np.pi * frequency)
    top, bottom = bilinear([1.0], [period**2, 2.0 * damping * period, 1.0], 500.0)
    drive = np.interp(fine, t, x)
    answer, _ = lfilter(top, bottom, drive, zi=lfilter_zi(top, bottom) * drive[0])
    return np.asarray(np.interp(t, fine, answer))


def _camera(
    t: Array, position: Array, rotation: Array, effects: dict[str, dict[str, Any]]
) -> tuple[Array, Array]:
    turn = Rotation.from_matrix(rotation)
    share = (t - t[0]) / (t[-1] - t[0])
    if e := effects.get("marker_offset"):
        position = position + turn.apply(e["offset"])
    if e := effects.get("latency"):
        late = np.clip(t - e["delay"] - e["skew"] * (t - t[0]), t[0], t[-1])
        position, turn = PchipInterpolator(t, position)(late), Slerp(t, turn)(late)
    if e := effects.get("lens"):  # division model about a centre that is not the axis
        flat = position[:, :2] - e["centre"]
        seen = flat / (1.0 - e["edge"] * np.sum(flat**2, axis=1, keepdims=True) / e["radius"] ** 2)
        position = np.concatenate([seen + e["centre"], position[:, 2:]], axis=1)
    if e := effects.get("camera_scale"):
        position = position * (1.0 + e["scale"])
    if e := effects.get("frame_misalignment"):
        frame = Rotation.from_rotvec(e["turn"])
        position, turn = frame.apply(position) + e["shift"], frame * turn
    if e := effects.get("time_drift"):
        position = position + (share + e["curve"] * share * (1.0 - share))[:, None] * e["drift"]
    if e := effects.get("bump"):
        position = position + (share > e["at"])[:, None] * e["shift"]
    if e := effects.get("sway"):
        position = position + np.sin(2.0 * np.pi * e["frequency"] * t + e["phase"])[:, None] * e["sway"]
    return position, turn.as_matrix()


def _hidden_rod(segments: int, effects: dict[str, dict[str, Any]]) -> Rod:
    rod = Rod(segments)
    if e := effects.get("tendon_stretch"):  # the share lost is rho / (1 + rho), with rho = k_b c / (2 d^2)
        rho = e["gain_loss"] / (1.0 - e["gain_loss"])
        rod = replace(rod, compliance=2.0 * OFFSET**2 * rho * LENGTH / EI)
    if e := effects.get("routing_angle"):  # opposite tendons turn together: otherwise they would lock
        turned = np.repeat(e["angle"].reshape(-1, 1, 2), 2, axis=1).reshape(-1)
        rod = replace(rod, angle=angles(segments) + turned)
    if e := effects.get("gravity"):
        along = (np.arange(segments)[:, None] + NODES).reshape(-1) / segments
        rod = replace(rod, density=e["weight"] / GRAVITY * (1.0 + e["slope"] * (1.0 - 2.0 * along)))
    if e := effects.get("precurvature"):
        mode = np.concatenate([e["mode"], np.zeros((segments, 1))], axis=1)
        rod = replace(rod, precurvature=(np.cos(np.pi * NODES)[:, None] * mode[:, None]).reshape(-1, 3))
    stiffness = np.diag([EI, EI, GJ])
    if e := effects.get("stiffness_anisotropy"):
        axes = Rotation.from_rotvec([0.0, 0.0, e["turn"]]).as_matrix()
        stiffness = axes @ np.diag([EI * np.exp(e["epsilon"]), EI * np.exp(-e["epsilon"]), GJ]) @ axes.T
    e = effects.get("stiffness_taper")
    taper = np.exp(e["rate"] * (1.0 - 2.0 * NODES)) if e else np.ones(len(NODES))
    return replace(rod, stiffness=np.tile(taper, segments)[:, None, None] * stiffness)


def _loaded(
    rod: Rod, dl: Array, bend: Array, payload: Array, down: Array, effects: dict[str, dict[str, Any]]
) -> tuple[Array, Array]:
    """Tip positions (n, 3) [m] and rotations (n, 3, 3) with the known payload (n, 1) [kg] and the hidden
    loads."""
    push, lever = np.zeros_like(down), 0.0
    if e := effects.get("payload"):
        payload, lever = payload + e["mass"], e["lever"]
    if e := effects.get("tip_force"):
        push = push + e["force"]
    squeeze = np.ones((len(dl), rod.segments, 1))
    if e := effects.get("axial_compression"):  # every piece of the backbone is shorter by the same share
        size = np.linalg.norm(bend, axis=2, keepdims=True)
        squeeze = 1.0 - e["rate"] * size * (1.0 + e["growth"] * size)
    magnet, plane = effects.get("magnet"), effects.get("contact")

    def field(tip: Array) -> tuple[Array, Array]:
        force, change = np.zeros_like(tip), np.zeros((len(tip), 3, 3))
        if magnet:
            gap = magnet["place"] - tip
            far = np.linalg.norm(gap, axis=1)[:, None, None]
            towards = gap[:, :, None] / far
            core = magnet["core"] ** 2
            pull = magnet["force"] * (magnet["distance"] ** 2 + core) / (far**2 + core)
            force = force + (pull * towards)[..., 0]
            along = towards * np.swapaxes(towards, 1, 2)
            change = change + pull * (2.0 * far / (far**2 + core) * along - (np.eye(3) - along) / far)
        if plane:  # one-sided, its edge rounded over 0.2 mm
            soft, normal = 2e-4, plane["normal"]
            depth = (tip @ normal - plane["distance"]) / soft
            force = force - plane["stiffness"] * soft * np.logaddexp(0.0, depth)[:, None] * normal
            change = change - (plane["stiffness"] * expit(depth))[:, None, None] * np.outer(normal, normal)
        return force, change

    felt = field if magnet or plane else None
    chords, turn = rod.rest(dl, push, down, payload=payload, lever=lever, field=felt)
    return np.sum(squeeze * chords, axis=1), turn


# ---------------------------------------------------------------- inputs of our own


def arc_lengths(bend: Array) -> Array:
    """Commands (n, tendons) [m] of bends (n, segments, 2) [rad]."""
    return tendons(bend.reshape(len(bend), -1) @ routing(bend.shape[1]).T)


def designed_inputs(rng: np.random.Generator, segments: int = 1) -> Inputs:
    """150 s at 15 Hz that separate effects: rest; four blocks of triangles, circles, holds and random motion,
    in the orientations A-B-B-A and with a known load off, on, off, on; rest; the first 20 s again."""
    t, block = np.arange(2250) / 15.0, 26.5
    bend = np.zeros((len(t), segments, 2))
    payload, side = np.zeros(len(t)), np.zeros(len(t), dtype=bool)
    # more twists the long robot until it snaps over
    mass = rng.uniform(0.05, 0.1) if segments == 1 else rng.uniform(0.02, 0.04)
    peaks = np.array([0.0, 0.9, -0.9, 0.55, -0.55, 0.25, -0.25, 0.0])
    times = 5.0 * np.append(0.0, np.cumsum(np.abs(np.diff(peaks)))) / np.abs(np.diff(peaks)).sum()
    for k in range(4):
        start = 12.0 + k * block
        now = (t >= start) & (t < start + block)
        x = t[now] - start
        payload[now], side[now] = mass * (k % 2), k in (1, 2)
        mine = np.zeros((len(x), segments, 2))
        mine[:, k % segments, (k // segments) % 2] = np.interp(x, times, peaks)
        turns, radius = (0.5, 0.75) if k % 2 else (-1.0, 0.6)
        for s in range(segments):
            phase = 2.0 * np.pi * (turns * (1.0 + s) * (x - 5.5) / 2.5 + 0.2 * k)
            ramp = np.interp(x, [5.0, 5.5, 8.0, 8.5], [0.0, radius, radius, 0.0])
            mine[:, s] += ramp[:, None] * np.stack([np.cos(phase), np.sin(phase)], axis=1)
            for j in range(3):
                if segments > 1 and j < 2 and j != s:  # each alone, then both
                    continue
                angle, size = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.45, 0.9)
                ramp = np.interp(x, 8.5 + 4.0 * j + np.array([0.0, 0.25, 3.75, 4.0]), [0.0, size, size, 0.0])
                mine[:, s] += ramp[:, None] * np.array([np.cos(angle), np.sin(angle)])
            mine[:, s] += _wander(rng, x - 20.6, 5.9, 0.5, 0.8)
        bend[now] = mine
    again = t >= 130.0
    bend[again] = bend[: again.sum()]
    payload[again], side[again] = payload[: again.sum()], side[: again.sum()]
    upright, turned = np.eye(4)[0], np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    return Inputs(t, arc_lengths(bend), payload, np.where(side[:, None], turned, upright))


def operator_inputs(rng: np.random.Generator, segments: int = 1, seconds: float = 150.0) -> Inputs:
    """Return what an operator does by hand at 15 Hz: smooth wandering with a few holds, one orientation,
    no load."""
    t = np.arange(int(15.0 * seconds)) / 15.0
    clock = np.where((t % 37.0) > 34.0, 0.0, 1.0).cumsum() / 15.0  # it stands still in a hold
    bend = np.stack([_wander(rng, clock, clock[-1] + 1.0, 2.2, 0.8) for _ in range(segments)], axis=1)
    return Inputs(t, arc_lengths(bend), np.zeros(len(t)), np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1)))


def _wander(rng: np.random.Generator, x: Array, seconds: float, every: float, reach: float) -> Array:
    """Random points of the disc, joined smoothly; zero at both ends and outside (n, 2) [rad]."""
    n = max(int(seconds / every), 4)
    angle, size = rng.uniform(0.0, 2.0 * np.pi, n + 1), reach * np.sqrt(rng.uniform(0.0, 1.0, n + 1))
    size[[0, -1]] = 0.0
    points = size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    path = CubicSpline(np.linspace(0.0, seconds, n + 1), points, bc_type="clamped")
    return np.where(((x > 0.0) & (x < seconds))[:, None], path(np.clip(x, 0.0, seconds)), 0.0)


def main() -> None:
    """Print how far each effect moves the tip on the designed log (rms over the samples, mm)."""
    segments = int(sys.argv[1]) if len(sys.argv) > 1 else 1
    logs = [designed_inputs(np.random.default_rng(seed), segments) for seed in range(3)]
    bare = [pose(log, draw(0, "none"))[0] for log in logs]
    print(f"{segments} segment(s)          seed 0   seed 1   seed 2   rms tip change [mm]")
    for name in library(segments) + OUTSIDE:
        size = []
        for seed, log in enumerate(logs):
            moved = pose(log, draw(seed, name, segments=segments))[0] - bare[seed]
            size.append(1e3 * float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))))
        print(f"{name:22s}" + "".join(f"{s:9.2f}" for s in size), flush=True)


if __name__ == "__main__":
    main()
