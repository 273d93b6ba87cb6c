"""A user's own log file as the columns of a run log, by the `[log]` of the robot file."""

from __future__ import annotations

import re

import numpy as np

from fastrod.errors import LogError, nearest
from fastrod.logs.table import Table, numbers
from fastrod.model.logformat import LogFormat
from fastrod.types import Floats


def translated(table: Table, log: LogFormat, where: str) -> Table:
    """The columns of a run log, SI, from those of a file; the table itself where the file has none of the
    columns that `[log]` names. Raises `LogError` where it has only some of them."""
    sources = log.sources
    found = [source for source in sources.values() if source in table]
    if not found:
        return table
    if missing := [source for source in sources.values() if source not in table]:
        raise LogError(
            f"{where} lacks column {missing[0]!r}, which [log] columns of the robot file names; "
            f"{nearest(missing[0], table)}"
        )
    made: Table = {name: cells for name, cells in table.items() if name not in sources.values()}
    for name, source in sources.items():
        made[name] = table[source]
    for name in list(made):
        factor = log.factor(name)
        if np.isnan(factor):
            made[name] = _dates(made, name, where)
        elif name not in ("run", "session") and (factor != 1.0 or re.fullmatch(r"(dl|pos)_\d+", name)):
            made[name] = _lengths(name, factor * numbers(made, name, where), log, where)
    return made


def _lengths(name: str, values: Floats, log: LogFormat, where: str) -> Floats:
    """A column in SI; of a tendon or its drive, as a change of length, negative = pulled."""
    group, _, number = name.partition("_")
    if group not in ("dl", "pos"):
        return values
    k = int(number) - 1

    def of(key: str) -> float:
        value = getattr(log, key)
        if not isinstance(value, tuple):
            return float(value)
        if k >= len(value):
            raise LogError(
                f"{where} has column {name}; [log] {key} of the robot file lists {len(value)} numbers."
            )
        return float(value[k])

    angular = log.drum_radius is not None
    return of("sign") * (values * (of("drum_radius") if angular else 1.0) - of("offset"))


def _dates(table: Table, name: str, where: str) -> Floats:
    """Seconds since the first row of dates and times of day."""
    cells = [str(cell).strip().removesuffix("Z") for cell in table[name]]
    try:
        stamps = np.array([cell or "NaT" for cell in cells], dtype="datetime64[ns]")
    except ValueError as error:
        raise LogError(
            f"{where}, column of {name}: {error}; units time = 'iso' takes dates such as "
            "2026-05-12T09:30:00.125."
        ) from error
    seconds = (stamps - stamps[0]) / np.timedelta64(1, "ns") * 1e-9
    return np.asarray(seconds, dtype=np.float64)
