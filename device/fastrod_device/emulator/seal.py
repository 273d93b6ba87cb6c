"""Effects that are hidden in the emulated robot: drawn from a seed, and shut until the judge opens it."""

from __future__ import annotations

import math
import secrets
from typing import NoReturn, final

import numpy as np

from fastrod.errors import InputError, UnknownNameError, nearest
from fastrod_device.emulator.plant_rod import EI, GJ, LENGTH, OFFSET

KINDS = ("backlash", "friction", "tendon_stretch", "creep", "gravity", "latency")
"""One of them comes out of a draw."""
NAMES = (*KINDS, "none", "outside")
"""Names of the seals that can be requested; "outside" is something that no library of effects has."""
_DEGREE = math.pi / 180.0


@final
class Seal:
    """A closed envelope: which effect the emulated robot has, and its numbers.

    >>> seal(1)
    sealed
    """

    __slots__ = ("__inside", "__stiffness")

    def __init__(
        self, inside: dict[str, dict[str, float]], stiffness: tuple[float, float] = (EI, GJ)
    ) -> None:
        """`inside`: effect name -> number name -> value in SI units and radians; empty for a robot without
        effect. `stiffness`: of the body in bending and torsion [N m^2]."""
        self.__inside = {name: dict(numbers) for name, numbers in inside.items()}
        self.__stiffness = stiffness

    def __repr__(self) -> str:
        return "sealed"

    def __reduce__(self) -> NoReturn:
        raise InputError("a seal cannot be copied into a file; keep its seed.")

    def open(self) -> dict[str, dict[str, float]]:
        """Effect name -> number name -> value, SI units and radians. For the judge, when the verdict is
        in."""
        return {name: dict(numbers) for name, numbers in self.__inside.items()}

    def stiffness(self) -> tuple[float, float]:
        """Stiffness of the body in bending and torsion [N m^2]: no effect, but a number that nobody
        measured."""
        return self.__stiffness


def seal(seed: int | None = None, effect: str | None = None, *, scatter: float = 0.0) -> Seal:
    """One dominant effect of KINDS with its numbers, drawn from `seed`; None: from the system's entropy.

    - `effect`: one of NAMES instead of a drawn one.
    - `scatter`: how far the body's stiffnesses may lie from nominal, as a part of it.

    Raises `UnknownNameError` for another name, and `InputError` where the seed is not a whole number from 0.
    """
    if seed is None:
        seed = secrets.randbits(63)
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InputError(f"seed is {seed!r}; it must be a whole number from 0, or None.")
    if effect is not None and effect not in NAMES:
        raise UnknownNameError(f"no effect {effect!r} can be sealed; {nearest(str(effect), NAMES)}")
    name = str(np.random.default_rng([int(seed), 0]).choice(KINDS)) if effect is None else effect
    rng = np.random.default_rng([int(seed), 1 + NAMES.index(name)])
    off = scatter * np.random.default_rng([int(seed), 1 + len(NAMES)]).uniform(-1.0, 1.0, 2)
    stiffness = EI * (1.0 + float(off[0])), GJ * (1.0 + float(off[1]))
    if name == "none":
        return Seal({}, stiffness)
    if name == "outside":
        name = str(rng.choice(["ripple", "bump"]))
    return Seal({name: _numbers(name, rng)}, stiffness)


def _numbers(name: str, rng: np.random.Generator) -> dict[str, float]:
    """An effect's numbers, in the sizes of small plastic robots."""

    def uniform(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def log(low: float, high: float) -> float:
        return math.exp(uniform(math.log(low), math.log(high)))

    def phase() -> float:
        return uniform(0.0, 2.0 * math.pi)

    match name:
        case "backlash":  # m of tendon; how sharp the corners of the gap are
            return {"half_width": uniform(1.5e-4, 4e-4), "sharpness": uniform(8.0, 14.0)}
        # bend lost when straight [rad], its growth [1/rad], travel until it slides [rad], share of the quick
        # part
        case "friction":
            loss = {"loss": uniform(1.5, 4.5) * _DEGREE, "growth": uniform(0.2, 0.5)}
            return loss | {
                "quick": uniform(1.5, 3.0) * _DEGREE,
                "late": uniform(4.0, 9.0) * _DEGREE,
                "share": uniform(0.4, 0.7),
            }
        # m/N beyond the tendons' own; share that goes as strands settle; N; what a small bend loses
        case "tendon_stretch":
            lost = uniform(0.06, 0.20)
            compliance = 2.0 * OFFSET**2 * LENGTH / EI * lost / (1.0 - lost)
            return {
                "compliance": compliance,
                "settling": uniform(0.15, 0.35),
                "knee": uniform(1.0, 2.5),
                "gain_loss": lost,
            }
        case "creep":  # shares, s, rate of quickening with the strain [1/m]
            whole, split = uniform(0.06, 0.12), uniform(0.35, 0.65)
            creep_sizes = {
                "share": whole * split,
                "time_constant": log(1.0, 5.0),
                "slow_share": whole * (1.0 - split),
            }
            return creep_sizes | {"slow_time_constant": log(10.0, 60.0), "activation": uniform(60.0, 160.0)}
        case "gravity":  # N/m, and how it is spread
            return {"weight": uniform(3.0, 6.0), "slope": uniform(-0.15, 0.15), "bulge": uniform(-0.25, 0.25)}
        case "latency":  # s; share by which it wanders, s, rad
            return {
                "delay": log(0.04, 0.15),
                "wander": uniform(0.01, 0.04),
                "period": uniform(15.0, 50.0),
                "phase": phase(),
            }
        case "ripple":  # m of tendon once in a drum's turn and once in a tooth; m; teeth
            sizes = {"amplitude": uniform(1e-4, 2.5e-4), "tooth_amplitude": uniform(0.8e-4, 1.6e-4)}
            drum = {"drum_radius": uniform(4e-3, 8e-3), "teeth": float(rng.integers(9, 20))}
            return sizes | drum | {f"phase_{k}": phase() for k in range(4)}
        case _:  # bump: m along x, y, z, rad about x, y, z, s after the first moment
            away, about = rng.normal(size=3), rng.normal(size=3)
            away *= uniform(1e-3, 3e-3) / np.linalg.norm(away)
            about *= uniform(0.3, 1.2) * _DEGREE / np.linalg.norm(about)
            numbers = dict(
                zip(
                    ("x", "y", "z", "about_x", "about_y", "about_z"),
                    [*away.tolist(), *about.tolist()],
                    strict=True,
                )
            )
            return numbers | {"at": uniform(40.0, 110.0)}
