"""Rods in contact as plain numbers, by name, and as robots of the package, which is held against them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from contact_energy import Minimum, minimise
from contact_shapes import obstacle
from scipy.spatial.transform import Rotation

from fastrod import Robot, Segment, Tendon

_PROTOTYPE: dict[str, Any] = {
    "length": [0.07],
    "K": [[0.0022, 0.0022, 0.001]],
    "compliance": 1e-5,
    "pretension": 0.0,
    "tip_force": [0.0, 0.0, 0.0],
    "line_force": [0.0, 0.0, 0.0],
    "base_rotation": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
}


def ring(n: int, offset: float, first: float = 0.0) -> list[list[float]]:
    """n tendons at `offset` [m] around the rod, from the angle `first` [rad]."""
    angle = first + 2.0 * np.pi * np.arange(n) / n
    return (offset * np.stack([np.cos(angle), np.sin(angle)], axis=1)).tolist()


def bent(
    length: Sequence[float],
    offsets: list[list[list[float]]],
    kappa_x: Sequence[float],
    kappa_y: Sequence[float],
) -> list[float]:
    """Tendon lengths [m] that bend segment k toward +x and +y by kappa_x[k], kappa_y[k] [1/m] in the mean."""
    places = np.asarray(offsets, dtype=float)
    pulled = places[..., 0] * np.asarray(kappa_x)[:, None] + places[..., 1] * np.asarray(kappa_y)[:, None]
    return np.nansum(np.asarray(length)[:, None] * (1.0 - pulled), axis=0).tolist()


def cases() -> dict[str, dict[str, Any]]:
    """Rods in contact, by name: the arguments of `minimise`, the obstacle as a dict with its kind."""
    four = [ring(4, 0.0075)]
    away = [[float("nan")] * 2] * 4
    pair = [ring(4, 0.0075) + ring(4, 0.0075, np.pi / 4.0), away + ring(4, 0.0075, np.pi / 4.0)]

    def one(kappa_x: float, kappa_y: float, rho: float, kind: str, **obstacle: Any) -> dict[str, Any]:
        bends = {"offsets": four, "tendon_length": bent([0.07], four, [kappa_x], [kappa_y])}
        return {**_PROTOTYPE, **bends, "obstacle": {"kind": kind, **obstacle}, "rho": rho}

    def cylinder(point: list[float], radius: float) -> dict[str, Any]:
        return {"point": point, "axis": [0.0, 1.0, 0.0], "radius": radius}

    wall = {"point": [0.012, 0.0, 0.0], "normal": [-1.0, 0.0, 0.0]}
    ball = {"centre": [0.028, 0.006, 0.055], "radius": 0.015}
    edge = {"centre": [0.0245, 0.0, 0.018], "half": [0.02, 0.03, 0.018]}
    return {
        "wall": one(12.0, 0.0, 0.0, "half_space", **wall),
        "wall_radius": one(8.0, 0.0, 0.005, "half_space", **wall),
        "bar": one(10.0, 1.0, 0.003, "cylinder", **cylinder([0.0155, 0.0, 0.04], 0.008)),
        "sphere": one(9.0, 4.0, 0.003, "sphere", **ball) | {"tip_force": [0.1, -0.15, -0.05]},
        "box_edge": one(12.0, 1.0, 0.002, "box", **edge),
        "heavy": {
            **_PROTOTYPE,
            "length": [0.3],
            "K": [[0.02, 0.02, 0.015]],
            "offsets": None,
            "tendon_length": [],
            "line_force": [0.0, 0.0, -3.0],
            "base_rotation": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]],
            "obstacle": {"kind": "cylinder", **cylinder([0.15, 0.0, -0.04], 0.03)},
            "rho": 0.004,
        },
        "two_segments": {
            **_PROTOTYPE,
            "length": [0.07, 0.07],
            "K": 2 * _PROTOTYPE["K"],
            "offsets": pair,
            "tendon_length": bent([0.07, 0.07], pair, [4.0, 5.0], [3.0, -2.0]),
            "line_force": [0.0, 0.0, -0.3],
            "obstacle": {"kind": "half_space", "point": [0.03, 0.0, 0.12], "normal": [-1.0, 0.2, -0.2]},
            "rho": 0.003,
        },
        "tube": one(13.0, 1.0, 0.003, "tube", point=[0.006, 0.0, 0.0], axis=[0.0, 0.0, 1.0], radius=0.01),
    }


def solve(case: dict[str, Any], **options: Any) -> Minimum:
    """`minimise` of one of `cases`."""
    return minimise(**{**case, "obstacle": obstacle(case["obstacle"])}, **options)


def robot_of(case: dict[str, Any]) -> Robot:
    """The package's words for one of `cases`."""
    n = len(case["length"])
    offsets = np.zeros((n, 0, 2)) if case["offsets"] is None else np.asarray(case["offsets"], dtype=float)
    crossed = (~np.isnan(offsets[..., 0])).sum(axis=0)
    segments = []
    for k, (length, (x, y, z)) in enumerate(zip(case["length"], case["K"], strict=True)):
        tendons = tuple(
            Tendon(
                offset=tuple(map(float, np.hypot(*offsets[: k + 1, t].T))),
                angle=tuple(map(float, np.arctan2(*offsets[: k + 1, t, ::-1].T))),
                compliance=case["compliance"],
                pretension=case["pretension"],
            )
            for t in np.flatnonzero(crossed == k + 1)
        )
        mode = "tendon_length" if tendons else "passive"
        stiffness = {"bending_stiffness": (x, y), "torsional_stiffness": z}
        segments.append(Segment(length=length, **stiffness, tendons=tendons, mode=mode))
    base = Rotation.from_matrix(case["base_rotation"]).as_quat(scalar_first=True)
    return Robot(name="case", segments=tuple(segments), base_quaternion=tuple(map(float, base)))
