"""Columns of a recording that only a prototype has: motor currents, and how well the marker was seen."""

from __future__ import annotations

from fastrod_device.readings import Readings
from fastrod_device.vision.gates import AHEAD, ASTRAY, BACK, FROZEN, OUTSIDE, REPEATED, TOO_FAST, TWICE
from fastrod_device.vision.tracker import MarkerSighting

_REFUSED = (FROZEN, OUTSIDE, ASTRAY, TOO_FAST, TWICE, REPEATED, BACK, AHEAD)
FLAGS = ("", "no marker", "outlier", "ambiguous", *_REFUSED)
"""Flags of a sighting that may be wrong; a log has the place in this list, so new ones go to its end."""
EXTRA = ("marker_error", "marker_size", "marker_flag", "seen_x", "seen_y", "seen_z")
"""Further columns of a recording: reprojection error [px], size of the marker in the picture [px], place of
the sighting's flag in `FLAGS` (0: trusted), and where the tip was seen, trusted or not [m]; then current_1
... [A]."""


def names(n_tendons: int) -> tuple[str, ...]:
    """All of them."""
    return (*EXTRA, *(f"current_{k}" for k in range(1, n_tendons + 1)))


def values(sighting: MarkerSighting, readings: Readings | None) -> dict[str, float]:
    """Return the values of one row; currents are left out where none are known."""
    made = {
        "marker_error": sighting.error,
        "marker_size": sighting.size_px,
        "marker_flag": float(FLAGS.index(sighting.flag)),
    }
    made |= dict(zip(("seen_x", "seen_y", "seen_z"), sighting.position.tolist(), strict=True))
    return (
        made
        if readings is None
        else made | {f"current_{k}": value for k, value in enumerate(readings.current.tolist(), 1)}
    )
