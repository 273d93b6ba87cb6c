"""Columns, units and signs of a user's own log files: `[log]` of a robot file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fastrod.errors import RobotError, nearest

UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "iso": math.nan},
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254},
    "angle": {"rad": 1.0, "deg": math.pi / 180.0, "rev": 2.0 * math.pi},
    "force": {"N": 1.0, "mN": 1e-3, "kgf": 9.80665, "gf": 9.80665e-3},
    "mass": {"kg": 1.0, "g": 1e-3},
}
"""SI per unit; `iso` is a date and time of day, as in 2026-05-12T09:30:00.125."""
COLUMNS = {
    "t": "time, not decreasing within a run [s]",
    "run": "label of the run: data are held out by run",
    "session": "label of the session: zeros, registration and delay are of a session",
    "dl_1 ... dl_n": "change of each tendon's length from the straight robot, negative = pulled [m]",
    "tension_1 ... tension_n": "force on each tendon in place of its length, in mode tendon_tension [N]",
    "pos_1 ... pos_n": "measured positions of the drives, counted as dl_k [m]",
    "ext_1 ... ext_n": "change of each segment's length [m]",
    "tip_x, tip_y, tip_z": "measured tip, base frame [m]",
    "tip_qw, tip_qx, tip_qy, tip_qz": "measured orientation of the tip, base_from_tip",
    "p1_x, p1_y, p1_z ...": "measured points at the arclengths of [log] points, base frame [m]",
    "tip_fx, tip_fy, tip_fz": "known force on the tip, base frame [N]",
    "payload": "known mass at the tip [kg]",
    "base_qw, base_qx, base_qy, base_qz": "world_from_base: the direction of gravity",
}
"""Columns of a run log. Any other is kept and ignored; an empty cell drops its row from a fit."""
AXES = {"tip": "xyz", "tip_f": "xyz", "tip_q": "wxyz", "base_q": "wxyz"}
"""Groups of columns with fixed axes: `tip` stands for tip_x, tip_y, tip_z, `tip_q` for tip_qw to tip_qz."""
COUNTED = ("dl", "pos", "ext", "tension")
"""Groups of numbered columns: `dl` stands for dl_1, dl_2 and so on."""
_LENGTHS = ("dl", "pos", "ext", "tip", "points")
_SINGLE = ("t", "run", "session", "payload")
_COLUMN = re.compile(
    rf"{'|'.join(_SINGLE)}|(?:{'|'.join(COUNTED)})_\d+|tip_f?[xyz]|(?:tip|base)_q[wxyz]|p\d+_[xyz]"
)


@dataclass(frozen=True, kw_only=True)
class LogFormat:
    """Translation of a user's own log into a run log.

    A column named `columns["dl_1"]` in the file becomes
    `dl_1 = sign * (value * unit * drum_radius - offset)`.

    >>> LogFormat(columns={"t": "ms", "tip": ["X", "Y", "Z"]}, units={"time": "ms"}).sources["tip_y"]
    'Y'
    """

    columns: Mapping[str, str | tuple[str, ...]] = field(default_factory=dict)
    """Name in a run log -> name in the file: of one column (`dl_1`, `tip_x`), or of a group (`dl`, `tip`,
    `tip_q`, `p1`), whose columns are listed. A column that is not named keeps its name."""
    units: Mapping[str, str | float] = field(default_factory=dict)
    """Unit of each kind of quantity (time, length, angle, force, mass), by name or as SI per unit; of a group
    of lengths (dl, pos, ext, tip, points) apart where it differs. Left out: SI."""
    drum_radius: float | tuple[float, ...] | None = None
    """The file has angles of drums of this radius [m], one for all or one a tendon; left out: lengths."""
    sign: int | tuple[int, ...] = 1
    """-1: positive pulls, where a run log has negative = pulled; one for all or one a tendon."""
    offset: float | tuple[float, ...] = 0.0
    """Length in the file of a tendon of the straight robot at rest [m], one for all or one a tendon."""
    clock: float = 0.0
    """Time by which commands stand too late in the file, against what was measured [s]: the command at time t
    stands in the row of t + clock."""

    def __post_init__(self) -> None:
        for key, value in self.columns.items():
            object.__setattr__(self, "columns", dict(self.columns) | {key: _frozen(value)})
        for name in ("drum_radius", "sign", "offset"):
            object.__setattr__(self, name, _frozen(getattr(self, name)))
        self._check_columns()
        self._check_units()
        if any(s not in (1, -1) for s in _each(self.sign)):
            raise RobotError(f"[log] sign is {self.sign!r}; it must be 1, or -1 where positive pulls.")
        if self.drum_radius is not None and not all(1e-6 <= r <= 10.0 for r in _each(self.drum_radius)):
            raise RobotError(
                f"[log] drum_radius is {self.drum_radius!r} m; it must be positive, 10 m at most."
            )
        for name, values in (("offset", _each(self.offset)), ("clock", (self.clock,))):
            if not all(math.isfinite(v) and abs(v) <= 10.0 for v in values):
                raise RobotError(f"[log] {name} is {getattr(self, name)!r}; it must be between -10 and 10.")

    @property
    def sources(self) -> dict[str, str]:
        """Name of a column in a run log -> its name in the file."""
        made: dict[str, str] = {}
        for name, value in self.columns.items():
            made |= dict(
                zip(_members(name, value), value if isinstance(value, tuple) else (value,), strict=True)
            )
        return made

    def factor(self, column: str) -> float:
        """SI per unit of a column of the run log; nan of a date, 1 of a label or a quaternion."""
        group = column.partition("_")[0] if not column.startswith("p") or column[1].isalpha() else "points"
        if column == "t":
            kind = "time"
        elif column == "payload":
            kind = "mass"
        elif column.startswith("tip_f") or group == "tension":
            kind = "force"
        elif "_q" in column or group not in _LENGTHS:
            return 1.0
        else:
            kind = "length" if group not in ("dl", "pos") or self.drum_radius is None else "angle"
        unit = self.units.get(group, self.units.get(kind, 1.0))
        return UNITS[kind][unit] if isinstance(unit, str) else float(unit)

    def _check_columns(self) -> None:
        for name, value in self.columns.items():
            known = [
                *AXES,
                *COUNTED,
                *_SINGLE,
                "dl_1",
                "tip_x",
                "p1",
                "p1_x",
                "base_qw",
                "pos_1",
                "tension_1",
            ]
            group = name in AXES or name in COUNTED or re.fullmatch(r"p\d+", name)
            if not group and not _COLUMN.fullmatch(name):
                raise RobotError(f"[log] columns has {name!r}; {nearest(name, known)}")
            if not group and not isinstance(value, str):
                raise RobotError(f"[log] columns {name} is {list(value)!r}; it is one column: give one name.")
            if group and isinstance(value, str):
                raise RobotError(
                    f"[log] columns {name} is {value!r}; it is several columns: list the names of all."
                )
            wanted = len(AXES.get(name, "xyz"))
            if group and name not in COUNTED and len(value) != wanted:
                raise RobotError(f"[log] columns {name} lists {len(value)} names; it needs {wanted}.")
        sources = list(self.sources.values())
        if twice := [name for name in sources if sources.count(name) > 1]:
            raise RobotError(f"[log] columns names {twice[0]!r} twice; each column of a file is one thing.")

    def _check_units(self) -> None:
        for name, unit in self.units.items():
            if name not in UNITS and name not in _LENGTHS:
                raise RobotError(f"[log] units has {name!r}; {nearest(name, [*UNITS, *_LENGTHS])}")
            kind = name if name in UNITS else "length"
            known = UNITS[kind] if name not in ("dl", "pos") else UNITS["length"] | UNITS["angle"]
            if isinstance(unit, str) and unit not in known:
                raise RobotError(f"[log] units {name} is {unit!r}; {nearest(unit, known)}")
            if not isinstance(unit, str) and not 0.0 < unit < 1e9:
                raise RobotError(f"[log] units {name} is {unit!r}; give a name, or SI per unit, above 0.")


def _frozen(value: object) -> object:
    return tuple(value) if isinstance(value, list) else value


def _each(value: Any) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,)


def _members(name: str, value: str | tuple[str, ...]) -> list[str]:
    """Columns of a run log that one name of `columns` stands for."""
    if isinstance(value, str):
        return [name]
    if name in COUNTED:
        return [f"{name}_{k}" for k in range(1, len(value) + 1)]
    joint = "" if name in ("tip_f", "tip_q", "base_q") else "_"
    return [f"{name}{joint}{axis}" for axis in AXES.get(name, "xyz")]
