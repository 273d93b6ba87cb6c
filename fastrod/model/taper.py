"""Segments that taper, and tendons on a cone, as chains of short pieces that are even."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from fastrod.errors import RobotError

PIECES = 10
"""Pieces of a segment that tapers, or that a tendon on a cone crosses. A cone of 2.4 : 1 then gives 1.3 % too
much to a force on its tip; the error falls with the square of their number."""

_THINNEST, _LONGEST = 1e-6, 10.0  # m


def in_pieces(tables: Sequence[Any], where: str) -> list[Any]:
    """The `[[segment]]` tables of a robot file; one whose `body_radius` lists two numbers, at its base and at
    its end, or with a tendon on a cone, as pieces of its length.

    A tendon's `offset` lists one number for each segment that it crosses; or, on a cone, one more: at the
    base of the first and at the end of each. Raises `RobotError` for lists of other lengths.
    """
    n = len(tables)
    tendons = [_tendons(table) for table in tables]
    split = {k for k in range(n) if isinstance(_of(tables[k], "body_radius"), list)}
    for k in range(n):
        if any(_on_cone(tendon, k + 1) for tendon in tendons[k]):
            split |= set(range(k + 1))
    if not split:
        return list(tables)
    for k in sorted(split):
        _check(tables[k], f"{where}: segment {k + 1}")
    counts = [PIECES if k in split else 1 for k in range(n)]
    made: list[Any] = []
    for k, table in enumerate(tables):
        radii = [_of(each, "body_radius") for each in tables[: k + 1]]
        moved = [_along(tendon, counts[: k + 1], radii, f"{where}: segment {k + 1}") for tendon in tendons[k]]
        pieces = list(_pieces(table, counts[k]))
        if moved:
            pieces[-1] = {key: value for key, value in pieces[-1].items() if key != "mode"}
            pieces[-1] |= {"tendons": moved} | ({"mode": table["mode"]} if "mode" in table else {})
        made += pieces
    return made


def _check(table: Any, where: str) -> None:
    """Refuse what cannot be divided among pieces; all else is looked at where a segment is made."""
    if not isinstance(table, Mapping):
        raise RobotError(f"{where} is {table!r}; it must be a table.")
    if isinstance(radius := _of(table, "body_radius"), list):
        if "youngs_modulus" not in table:
            raise RobotError(f"{where} tapers, its body_radius has two numbers, and lacks youngs_modulus.")
        if len(radius) != 2 or not all(_is_number(r) and r >= _THINNEST for r in radius):
            raise RobotError(f"{where}: body_radius is {radius!r}; give one number, or base and end [m].")
    extension, lumps = table.get("extension", []), table.get("lumps", [])
    if not isinstance(extension, list) or not all(map(_is_number, extension)):
        raise RobotError(f"{where}: extension is {extension!r}; give two numbers, smallest and largest [m].")
    if not isinstance(lumps, list) or not all(_is_number(_of(lump, "at")) for lump in lumps):
        raise RobotError(f"{where}: lumps must be a list of tables, [ {{at = ..., mass = ...}}, ... ].")


def _is_number(value: Any) -> bool:
    """A length or a place that a robot may have [m]."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= _LONGEST


def _of(table: Any, key: str) -> Any:
    return table.get(key) if isinstance(table, Mapping) else None


def _tendons(table: Any) -> list[Any]:
    given = _of(table, "tendons")
    return given if isinstance(given, list) else []


def _on_cone(tendon: Any, n_crossed: int) -> bool:
    offset = _of(tendon, "offset")
    return isinstance(offset, list) and len(offset) == n_crossed + 1


def _pieces(table: Mapping[str, Any], n: int) -> Iterator[dict[str, Any]]:
    """A segment's pieces, without tendons."""
    if n == 1:
        yield dict(table) if isinstance(table, Mapping) else table
        return
    radius, length = table.get("body_radius"), table.get("length")
    if not _is_number(length):
        length = None
    kept = {key: value for key, value in table.items() if key not in ("tendons", "mode", "lumps")}
    for first, last in pairwise(_edges(radius, n)):
        piece = {**kept, "mode": "passive"}
        if length is not None:  # any other is refused where a segment is made
            piece["length"] = length * (last - first)
            lumps = [
                {**lump, "at": max(lump["at"] - first * length, 0.0)}
                for lump in table.get("lumps", [])
                if first * length <= lump["at"] < last * length or (last == 1.0 and lump["at"] >= length)
            ]
            piece |= {"lumps": lumps} if lumps else {}
        if isinstance(radius, list):
            piece["body_radius"] = [radius[0] + (radius[1] - radius[0]) * at for at in (first, last)]
        if "extension" in table:
            piece["extension"] = [each * (last - first) for each in table["extension"]]
        yield piece


def _edges(radius: Any, n: int) -> list[float]:
    """Return where the pieces of a segment begin and end, of its length: of a cone each is as many times
    as thin as the one before, so that none is much softer at its end than at its base."""
    if not isinstance(radius, list) or math.isclose(*radius):
        return [i / n for i in range(n + 1)]
    ratio = radius[1] / radius[0]
    return [(ratio ** (i / n) - 1.0) / (ratio - 1.0) for i in range(n)] + [1.0]


def _along(tendon: Any, counts: Sequence[int], radii: Sequence[Any], where: str) -> Any:
    """A tendon's table with an offset and an angle for each piece that it crosses."""
    if not isinstance(tendon, Mapping):
        return tendon
    made = dict(tendon)
    for key in ("offset", "angle"):
        if not isinstance(value := made.get(key), list):
            continue
        if key == "offset" and _on_cone(tendon, len(counts)):
            if not all(map(_is_number, value)):
                raise RobotError(f"{where}: a tendon's offset is {value!r}; give numbers [m].")
            made[key] = [
                a + (b - a) * _middle(radius, first, last)
                for a, b, n, radius in zip(value[:-1], value[1:], counts, radii, strict=True)
                for first, last in pairwise(_edges(radius, n))
            ]
        elif len(value) == len(counts):
            made[key] = [each for each, n in zip(value, counts, strict=True) for _ in range(n)]
        else:
            raise RobotError(
                f"{where}: a tendon's {key} lists {len(value)} numbers; give one, one for each of the "
                f"{len(counts)} segments that it crosses, base first, or of an offset one more, on a cone."
            )
    return made


def _middle(radius: Any, first: float, last: float) -> float:
    """Return where between two places of a segment a tendon on a cone has the offset that bends it as far
    as the piece bends: the mean of its place weighed with the softness radius^-4, by Simpson's rule."""
    middle = 0.5 * (first + last)
    if not isinstance(radius, list):
        return middle
    a, b, c = ((radius[0] + (radius[1] - radius[0]) * at) ** -4.0 for at in (first, middle, last))
    return float((a * first + 4.0 * b * middle + c * last) / (a + 4.0 * b + c))
