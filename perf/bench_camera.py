"""The camera on drawn frames: errors, flips, latency, time. This file as a script; `--json` for programs,
`--quick` for a smoke run."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import report
from report import Column, Row, Section, note_progress

if TYPE_CHECKING:
    from fastrod_device.camera import Camera, Marker

SIZE, FOCAL, PICTURE = 0.015, 800.0, (640, 480)
"""Side of the marker [m], focal length [px], the camera's pictures [px]."""
ERROR_TARGETS = {0.10: 0.2e-3, 0.20: 0.9e-3, 0.40: 3e-3}
"""Root mean square error of the position [m] by distance [m]."""
LATENCY_TARGET, TIME_TARGET = 5e-3, 4e-3
"""[s]."""
TILTS = (0, 15, 30, 45, 60)
"""[deg]."""
FLIP = math.radians(5.0)
"""From here on the wrong one of both solutions counts as a flip."""
LOAD = 0.03
"""On the tip while gates are tried [kg]."""


def camera_and_marker() -> tuple[Camera, Marker]:
    """What the emulator has, with a lens that bends."""
    from fastrod_device.camera import Camera, Marker

    matrix = ((FOCAL, 0.0, 319.5), (0.0, FOCAL, 239.5), (0.0, 0.0, 1.0))
    return Camera(matrix=matrix, size=PICTURE, distortion=(-0.12, 0.05, 0.0005, -0.0003, 0.0)), Marker(
        size=SIZE, id=7
    )


def pose(
    distance: float, tilt: float, azimuth: float, roll: float, x: float = 0.0, y: float = 0.0
) -> tuple[Any, Any]:
    """Tip in front of the camera, its marker turned away by `tilt` from facing the camera's axis [rad]."""
    from fastrod.rotation import product, quaternion_from_vector

    lean = quaternion_from_vector(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
    facing = product(np.array([0.0, 1.0, 0.0, 0.0]), quaternion_from_vector(np.array([0.0, 0.0, roll])))
    return np.array([x, y, distance]), product(lean, facing)


def angle(a: Any, b: Any) -> float:
    """Between two orientations [rad]."""
    return 2.0 * math.acos(min(1.0, abs(float(a @ b))))


def errors(distance: float, tilt: float | None, n: int) -> Row:
    """Single frames at one distance; tilts up to 50 deg where none is given. The model expects the tip's
    orientation within 3 deg."""
    from fastrod.rotation import product, quaternion_from_vector
    from fastrod_device.camera import CameraFrame
    from fastrod_device.drawing import draw
    from fastrod_device.tracker import MarkerTracker

    note_progress(f"{distance} m")
    camera, marker = camera_and_marker()
    rng = np.random.default_rng(0)
    tracker, off, flags = MarkerTracker(camera, marker), [], []
    for k in range(n):
        lean = rng.uniform(0.0, math.radians(50.0)) if tilt is None else math.radians(tilt)
        position, quaternion = pose(
            distance, lean, *rng.uniform(0.0, 2.0 * np.pi, 2), *rng.uniform(-0.12, 0.12, 2) * distance
        )
        expected = position, product(quaternion, quaternion_from_vector(0.03 * rng.standard_normal(3)))
        tracker.reset()
        seen = tracker.look(
            CameraFrame(image=draw(camera, marker, position, quaternion, rng=rng), t=0.0, number=k), expected
        )
        flags.append(seen.flag)
        if seen.ok:
            off.append(seen.position - position)
    um = 1e6 * np.array(off)
    return {
        "distance": 100.0 * distance,
        "tilt": "0 to 50" if tilt is None else f"{tilt:g}",
        "frames": n,
        "ok": 100.0 * len(off) / n,
        "rms": float(np.sqrt((um**2).sum(1).mean())) / 1e3,
        "target": 1e3 * ERROR_TARGETS[distance] if tilt is None else None,
        "bias_x": float(um[:, 0].mean()),
        "bias_y": float(um[:, 1].mean()),
        "noise_xy": float(um[:, :2].std()),
        "bias_z": float(um[:, 2].mean()),
        "noise_z": float(um[:, 2].std()),
    }


def flips(distance: float, swing: float, n: int) -> Row:
    """Smooth motion through the frontal pose: OpenCV's first solution from its own corners, and the tracker
    without a model."""
    import cv2

    from fastrod.rotation import quaternion_from_matrix
    from fastrod_device.camera import CameraFrame
    from fastrod_device.drawing import draw
    from fastrod_device.tracker import MarkerTracker

    note_progress(f"flips at {distance} m")
    camera, marker = camera_and_marker()
    rng = np.random.default_rng(1)
    tracker = MarkerTracker(camera, marker)
    options = cv2.aruco.DetectorParameters()
    options.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), options)
    corners = 0.5 * SIZE * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
    before = after = seen_before = seen_after = 0
    for k in range(n):
        t = k / 15.0
        tilt, azimuth = math.radians(swing) * math.sin(1.3 * t), 0.4 + 0.5 * math.sin(0.37 * t)
        position, quaternion = pose(
            distance,
            tilt,
            azimuth,
            0.2,
            0.1 * distance * math.sin(0.9 * t),
            0.1 * distance * math.cos(0.7 * t),
        )
        image = draw(camera, marker, position, quaternion, rng=rng)
        sighting = tracker.look(CameraFrame(image=image, t=t, number=k))
        seen_after += sighting.ok
        after += sighting.ok and angle(sighting.quaternion, quaternion) > FLIP
        found, _, _ = detector.detectMarkers(image)
        if len(found):
            _, turns, _, _ = cv2.solvePnPGeneric(
                corners,
                found[0].reshape(4, 2),
                camera.intrinsics,
                camera.lens,
                flags=cv2.SOLVEPNP_IPPE_SQUARE,
            )
            seen_before += 1
            before += (
                angle(
                    quaternion_from_matrix(np.asarray(cv2.Rodrigues(turns[0])[0], dtype=np.float64)),
                    quaternion,
                )
                > FLIP
            )
    return {
        "distance": 100.0 * distance,
        "swing": swing,
        "frames": n,
        "ok": 100.0 * seen_after / n,
        "before": 100.0 * before / max(seen_before, 1),
        "after": 100.0 * after / max(seen_after, 1),
    }


def latency(rate: float, delay: float, seeds: int) -> Row:
    """Four wires that bend a 70 mm arc for 20 s, its tip seen late, with 0.3 mm of noise and one frame in ten
    lost."""
    from fastrod_device.latency import estimate_latency

    note_progress(f"latency {delay} s")
    t, seen = np.arange(0.0, 20.0, 0.01), np.arange(0.003, 20.0, 1.0 / rate)
    off, spread = [], []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        f, phase = rng.uniform(0.1, 0.8, 4), rng.uniform(0.0, 2.0 * np.pi, 4)
        wave = 0.003 * np.sin(2.0 * np.pi * f[:, None] * t + phase[:, None])
        x, y = wave[0] + 0.5 * wave[1], wave[2] + 0.5 * wave[3]
        a, b = (np.interp(seen - delay, t, w) / 0.008 for w in (x, y))
        bend = np.hypot(a, b) + 1e-9
        across = 0.07 * (1.0 - np.cos(bend)) / bend**2
        tip = np.stack(
            [across * a, across * b, 0.07 * np.sin(bend) / bend], axis=1
        ) + 3e-4 * rng.standard_normal((len(seen), 3))
        tip[rng.random(len(seen)) < 0.1] = np.nan
        found = estimate_latency(t, np.stack([x, y, -x, -y], axis=1), seen, tip)
        off.append(found.delay - delay)
        spread.append(found.stderr)
    ms = 1e3 * np.array(off)
    return {
        "rate": rate,
        "delay": 1e3 * delay,
        "seeds": seeds,
        "mean": float(ms.mean()),
        "rms": float(np.sqrt((ms**2).mean())),
        "largest": float(np.abs(ms).max()),
        "target": 1e3 * LATENCY_TARGET,
        "stderr": float(1e3 * np.mean(spread)),
    }


def gates(kind: str, seeds: Sequence[int], moves: int) -> Row:
    """An honest marker against the gates: an emulator with a sealed effect, driven to random bends at the
    full rate, with a load for the second half."""
    from fastrod.model.routing import route
    from fastrod_device.columns import FLAGS
    from fastrod_device.errors import RefusedError
    from fastrod_device.gates import ASTRAY, OUTSIDE, TOO_FAST
    from fastrod_device.hardware import load_hardware
    from fastrod_device.tracker import MarkerSighting
    from fastrod_device.workbench import emulated

    note_progress(f"gates, {kind}")
    hardware = load_hardware()
    wiring, length = route(hardware.robot), hardware.robot.length
    most = hardware.limits.curvature * length
    flags, off, far, high = dict.fromkeys(FLAGS, 0), [0.0], [0.0], [length]
    for seed in seeds:
        rng = np.random.default_rng(seed)
        with emulated(hardware, seed=seed, effect=kind, home=False) as bench:
            prototype = bench.prototype
            look = prototype.tracker.look

            def watched(frame: Any, expected: Any = None, *, now: float, look: Any = look) -> MarkerSighting:
                seen: MarkerSighting = look(frame, expected, now=now)
                flags[seen.flag] += 1
                if seen.flag in ("", OUTSIDE, ASTRAY, TOO_FAST):
                    far.append(float(np.linalg.norm(seen.position)))
                    high.append(float(seen.position[2]))
                    if expected is not None:
                        off.append(float(np.linalg.norm(seen.position - expected[0])))
                return seen

            prototype.tracker.look = watched  # type: ignore[method-assign]
            for move in range(moves):
                if move == moves // 2:
                    with prototype.resting():
                        bench.hands.hang(LOAD)
                    prototype.payload = LOAD
                while True:
                    dl = wiring.tendon_change(rng.uniform(-most, most, (hardware.robot.n_segments, 2)))
                    try:
                        prototype.supervisor.within(dl)
                        break
                    except RefusedError:
                        continue
                for _ in range(10):
                    prototype.command(dl)
                    prototype.wait(0.1)
    refused = sum(flags[flag] for flag in (OUTSIDE, ASTRAY, TOO_FAST))
    return {
        "kind": kind,
        "seeds": len(seeds),
        "frames": sum(flags.values()),
        "refused": refused,
        "off": 1e3 * max(off),
        "part": max(off) / length,
        "far": max(far) / length,
        "high": 1e3 * min(high),
    }


def times(distance: float, repeats: int) -> Row:
    """Median wall time of a frame."""
    from fastrod_device.camera import CameraFrame
    from fastrod_device.drawing import draw
    from fastrod_device.tracker import MarkerTracker

    note_progress(f"times at {distance} m")
    camera, marker = camera_and_marker()
    rng = np.random.default_rng(0)
    tracker = MarkerTracker(camera, marker)
    there = pose(distance, 0.4, 0.3, 0.5)
    drawn, looked = [], []
    for k in range(repeats):
        seconds, image = report.seconds(lambda: draw(camera, marker, *there, rng=rng))
        frame = CameraFrame(image=image, t=k / 15.0, number=k)
        drawn.append(seconds)
        looked.append(report.seconds(lambda frame=frame: tracker.look(frame))[0])  # type: ignore[misc]
    return {
        "distance": 100.0 * distance,
        "look": 1e3 * float(np.median(looked)),
        "best": 1e3 * min(looked),
        "target": 1e3 * TIME_TARGET,
        "draw": 1e3 * float(np.median(drawn)),
    }


def measure(options: argparse.Namespace) -> Sequence[Section]:
    """All tables."""
    import cv2

    cv2.setNumThreads(1)
    n, many, seeds = (8, 15, 2) if options.quick else (200, 450, 20)
    look = [
        Column("distance", "distance\ncm", ".0f"),
        Column("tilt", "tilt\ndeg"),
        Column("frames", "frames"),
        Column("ok", "trusted\n%", ".1f"),
    ]
    look += [Column("rms", "rms error\nmm", ".4f"), Column("target", "target\nmm", ".1f")]
    look += [Column(f"bias_{a}", f"mean {a}\num", ".1f") for a in "xyz"]
    look += [Column("noise_xy", "noise x, y\num", ".1f"), Column("noise_z", "noise z\num", ".1f")]
    rows = [errors(distance, None, n) for distance in ERROR_TARGETS]
    rows += [errors(distance, tilt, n) for distance in (0.10, 0.20) for tilt in TILTS]
    turned = [
        Column("distance", "distance\ncm", ".0f"),
        Column("swing", "swing\n+- deg", ".0f"),
        Column("frames", "frames"),
    ]
    turned += [
        Column("ok", "trusted\n%", ".1f"),
        Column("before", "flips, first of IPPE\n%", ".1f"),
        Column("after", "flips, tracker\n%", ".2f"),
    ]
    late = [
        Column("rate", "rate\nHz", ".0f"),
        Column("delay", "delay\nms", ".0f"),
        Column("seeds", "seeds"),
        Column("mean", "mean error\nms", ".2f"),
    ]
    late += [
        Column("rms", "rms error\nms", ".2f"),
        Column("largest", "largest\nms", ".2f"),
        Column("target", "target\nms", ".0f"),
    ]
    late += [Column("stderr", "standard error\nms", ".2f")]
    took = [
        Column("distance", "distance\ncm", ".0f"),
        Column("look", "look\nms", ".2f"),
        Column("best", "look, best\nms", ".2f"),
    ]
    took += [Column("target", "target\nms", ".0f"), Column("draw", "drawing\nms", ".2f")]
    allowed = [
        Column("kind", "sealed"),
        Column("seeds", "seeds", "d"),
        Column("frames", "frames", "d"),
        Column("refused", "refused", "d"),
        Column("off", "off the model\nworst, mm", ".1f"),
        Column("part", "off the model\nof the length", ".2f"),
        Column("far", "from the base\nof the length", ".3f"),
        Column("high", "least height\nmm", ".1f"),
    ]
    kinds = ("none", "backlash", "friction", "tendon_stretch", "creep", "gravity", "outside", "latency")
    tried = [(kind, range(1, 8 if kind == "latency" else 3), 16) for kind in kinds]
    tried = [("none", range(1, 2), 4)] if options.quick else tried
    note = (
        f"A marker of {1e3 * SIZE:.0f} mm, f = {FOCAL:.0f} px, pictures of {PICTURE[0]} x {PICTURE[1]}; "
        "blur 0.7 px, noise 2 grey levels."
    )
    return [
        Section(
            "errors",
            "Position from one frame",
            look,
            rows,
            [note, "Bias and noise over random azimuth, roll and place; x, y across, z depth."],
        ),
        Section(
            "flips",
            "The wrong of both poses, along smooth motion",
            turned,
            [flips(d, s, many) for d in ERROR_TARGETS for s in (12.0, 40.0)],
        ),
        Section(
            "latency",
            "Latency",
            late,
            [latency(rate, delay, seeds) for rate in (15.0, 30.0) for delay in (0.03, 0.15)],
        ),
        Section("gates", "An honest marker against the gates", allowed, [gates(*row) for row in tried]),
        Section(
            "times", "Time, one thread", took, [times(distance, max(n, 20)) for distance in ERROR_TARGETS]
        ),
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    return report.command(argparse.ArgumentParser(prog="bench_camera", description=__doc__), argv, measure)


if __name__ == "__main__":
    sys.exit(main())
