"""Identification sweeps: robots with a sealed effect, their logs simulated and identified, and the seal
opened last."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import FastrodError, InputError
from fastrod.generation.columns import Column
from fastrod.generation.draws import named, robot_of, with_effects
from fastrod.model.robot import Robot

_POINTS = 8  # steps of a segment of the sealed robot; identification has six
_TOLERANCE = 1e-8  # m


@final
@dataclass(frozen=True, kw_only=True)
class Sweep:
    """Row i has effect i modulo their number, with values drawn anew. The log is that of `fastrod excite`,
    simulated at rest row by row, with noise on the tip; the model is the one that is identified, so that what
    is missed is missed for want of information."""

    robot: str = field(repr=False)
    """A robot file's text; what is identified is this robot."""
    effects: tuple[str, ...] = ("backlash",)
    """Sealed in turn."""
    noise: float = 3e-4
    """Standard deviation of each coordinate of the measured tip [m]."""
    rate: float = 15.0
    """Samples a second."""
    bend: float = 0.9
    """Largest bend of a segment [rad]."""

    def __post_init__(self) -> None:
        check_number("noise", self.noise, Bound(least=0.0, most=1.0, unit="m"))
        check_number("rate", self.rate, Bound(least=0.1, most=1e4, unit="Hz"))
        check_number("bend", self.bend, Bound(above=0.0, most=3.0, unit="rad"))
        if not self.effects:
            raise InputError("a sweep has no effects; name one, such as backlash.")
        object.__setattr__(self, "effects", named(self.effects))
        robot = robot_of(self.robot)
        if not robot.n_tendons:
            raise InputError(f"robot {robot.name!r} has no tendons; there is nothing to excite.")
        if robot.effects:
            raise InputError(
                f"robot {robot.name!r} has effects already; a sweep seals its own into a plain robot."
            )

    @property
    def index(self) -> str:
        """Rows are counted."""
        return "row"

    @property
    def usual(self) -> int:
        """Rows of a shard."""
        return 4

    def make(self, first: int, count: int, seed: Sequence[int]) -> list[Column]:
        """A row for each sealed robot; those of one effect are one batch."""
        from fastrod.identification.attribution import identify
        from fastrod.identification.excite import excitation

        rng = np.random.default_rng(seed)
        plain = robot_of(self.robot)
        log = excitation(plain, rate=self.rate, bend=self.bend).log
        effects = [self.effects[row % len(self.effects)] for row in range(first, first + count)]
        sealed = [with_effects(plain, [effect], rng) for effect in effects]
        noise = self.noise * rng.normal(size=(count, len(log), 3))
        tips = np.empty((count, len(log), 3))
        for effect in dict.fromkeys(effects):
            which = [i for i, name in enumerate(effects) if name == effect]
            tips[which] = _simulated([sealed[i][0] for i in which], log, 1.0 / self.rate)
        rows: list[dict[str, Any]] = []
        for i, effect in enumerate(effects):
            row: dict[str, Any] = {"effect": effect, "sealed": json.dumps(sealed[i][1]), "problem": ""}
            try:
                result = identify(replace(log, tip_position=tips[i] + noise[i]), plain, threads=1)
            except FastrodError as error:
                rows.append({**row, **_NOTHING, "problem": str(error)})
                continue
            fitted = {
                f"{one.name}.{name}": estimate.value
                for one in result.effects
                for name, estimate in one.parameters.items()
            }
            rows.append(
                {
                    **row,
                    "verdict": str(result.verdict),
                    "named": " ".join(one.name for one in result.effects),
                    "first": bool(result.effects) and result.effects[0].name == effect,
                    "found": json.dumps(fitted),
                    "floor": float(result.noise.floor),
                    "before": result.test.before,
                    "after": result.test.after,
                }
            )
        columns = [Column("row", np.arange(first, first + count), "", "counts over the whole data set")]
        for name, (unit, about) in _ABOUT.items():
            cells = [row[name] for row in rows]
            columns.append(Column(name, cells if isinstance(cells[0], str) else np.array(cells), unit, about))
        return columns

    def failed(self, columns: Sequence[Column]) -> int:
        """Rows whose log could not be identified."""
        return sum(
            sum(bool(cell) for cell in column.values) for column in columns if column.name == "problem"
        )


_NOTHING: dict[str, Any] = {
    "verdict": "",
    "named": "",
    "first": False,
    "found": "{}",
    "floor": float("nan"),
    "before": float("nan"),
    "after": float("nan"),
}
_ABOUT = {
    "effect": ("", "the sealed one"),
    "sealed": ("", "its values, JSON, effect.parameter in its unit"),
    "verdict": ("", "as in report.json"),
    "named": ("", "effects that were named, first to last"),
    "first": ("", "the sealed effect was named first"),
    "found": ("", "fitted values, JSON, effect.parameter in its unit"),
    "floor": ("m", "noise of the log, as found"),
    "before": ("m", "held-out error of the base model, rms"),
    "after": ("m", "held-out error with what was found, rms"),
    "problem": ("", "why the log was not identified; empty where it was"),
}


def _simulated(robots: list[Robot], log: Any, dt: float) -> np.ndarray:
    """(n_robots, n_rows, 3) measured tips of robots that follow a log at rest, effects with a memory
    included."""
    from fastrod.identification.log.inputs import inputs
    from fastrod.simulator import Simulator

    simulator = Simulator(robots, dt=dt, points_per_segment=_POINTS, outputs="tip", threads=1)
    given = inputs(log, robots[0])
    tips = np.full((len(robots), len(log), 3), np.nan)
    for i in range(len(log)):
        state = simulator.settle(**{name: values[i] for name, values in given.items()}, tolerance=_TOLERANCE)
        tips[:, i] = np.where(state.ok[:, None], simulator.measure().tip_position, np.nan)
    return tips
