"""Run logs as a data set of LeRobot, version 2.1: an episode for each run, at an even rate.

Format: huggingface/lerobot, `LeRobotDataset`, codebase version v2.1.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import LogError
from fastrod.logs.folder import make_folder
from fastrod.logs.runlog import RunLog
from fastrod.logs.table import arrow
from fastrod.types import Floats

_CHUNK = 1000  # episodes in a folder
_LEAST = 2  # rows of an episode


def write_lerobot(log: RunLog, folder: str | Path, *, robot: str, fps: int, task: str) -> tuple[int, int]:
    """Write a data set into a new or empty `folder`; its episodes and frames.

    An action is what drives the tendons, lengths against the straight robot [m] or forces [N]; a state is the
    measured tip, its orientation and further points, where the log has them [m]. Both are interpolated at
    `fps`. Rows that miss one are left out before. Raises `LogError` where nothing is left, where the folder
    holds something, or pyarrow is not installed.
    """
    check_number("fps", fps, Bound(least=1, most=1000), whole=True, error=LogError)
    target = Path(folder)
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise LogError(f"{str(folder)!r} holds something already; give a new folder.")
    state, names = _state(log)
    action = {"action": [f"tendon_{k}" for k in range(1, log.commands.shape[1] + 1)]}
    whole = log.measured & np.isfinite(state).all(axis=1)
    episodes = []
    for label in log.runs:
        rows = np.flatnonzero((log.run == label) & whole)
        rows = rows[np.diff(log.t[rows], prepend=-np.inf) > 0.0]
        if len(rows) >= _LEAST:
            t = np.arange(0.0, log.t[rows[-1]] - log.t[rows[0]] + 1e-9, 1.0 / fps)
            episodes.append(
                [t, *(_at(log.t[rows] - log.t[rows[0]], t, a[rows]) for a in (state, log.commands))]
            )
    if not episodes:
        raise LogError(f"log {log.name!r} has no run with {_LEAST} rows in which inputs and tip are there.")
    arrow("pyarrow")  # before anything is written
    target = make_folder(target)
    (target / "meta").mkdir()
    counts = [len(t) for t, _, _ in episodes]
    for k, (t, seen, driven) in enumerate(episodes):
        place = target / f"data/chunk-{k // _CHUNK:03d}"
        place.mkdir(parents=True, exist_ok=True)
        _write_episode(place / f"episode_{k:06d}.parquet", k, sum(counts[:k]), t, seen, driven)
    features = {
        **{
            name: {"dtype": "float32", "shape": [len(of)], "names": of}
            for name, of in ({"observation.state": names} | action).items()
        },
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        **{
            name: {"dtype": "int64", "shape": [1], "names": None}
            for name in ("frame_index", "episode_index", "index", "task_index")
        },
    }
    info = {
        "codebase_version": "v2.1",
        "robot_type": robot,
        "total_episodes": len(counts),
        "total_frames": sum(counts),
        "total_tasks": 1,
        "total_videos": 0,
        "total_chunks": 1 + (len(counts) - 1) // _CHUNK,
        "chunks_size": _CHUNK,
        "fps": fps,
        "splits": {"train": f"0:{len(counts)}"},
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": None,
        "features": features,
    }
    (target / "meta/info.json").write_text(json.dumps(info, indent=4), encoding="utf-8")
    _lines(target / "meta/tasks.jsonl", [{"task_index": 0, "task": task}])
    own = [{"episode_index": k, "tasks": [task], "length": n} for k, n in enumerate(counts)]
    _lines(target / "meta/episodes.jsonl", own)
    stats = [
        {"episode_index": k, "stats": {"observation.state": _stats(seen), "action": _stats(driven)}}
        for k, (_, seen, driven) in enumerate(episodes)
    ]
    _lines(target / "meta/episodes_stats.jsonl", stats)
    return len(counts), sum(counts)


def _state(log: RunLog) -> tuple[Floats, list[str]]:
    """(n, k) what was measured, and its names."""
    points = log.points if log.points is not None else np.zeros((len(log), 0, 3))
    blocks = [log.tip_position, points.reshape(len(log), -1)]
    names = [f"tip_{axis}" for axis in "xyz"]
    names += [f"p{k + 1}_{axis}" for k in range(points.shape[1]) for axis in "xyz"]
    if log.tip_quaternion is not None:
        blocks.append(log.tip_quaternion)
        names += [f"tip_q{axis}" for axis in "wxyz"]
    return np.concatenate(blocks, axis=1), names


def _at(known: Floats, t: Floats, values: Floats) -> Floats:
    columns = [np.interp(t, known, column) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.zeros((len(t), 0))


def _write_episode(path: Path, number: int, first: int, t: Floats, seen: Floats, driven: Floats) -> None:
    pyarrow, n = arrow("pyarrow"), len(t)
    vectors = pyarrow.list_(pyarrow.float32())
    columns = {
        "observation.state": pyarrow.array(seen.astype(np.float32).tolist(), vectors),
        "action": pyarrow.array(driven.astype(np.float32).tolist(), vectors),
        "timestamp": pyarrow.array(t.astype(np.float32)),
        "frame_index": pyarrow.array(np.arange(n)),
        "episode_index": pyarrow.array(np.full(n, number)),
        "index": pyarrow.array(first + np.arange(n)),
        "task_index": pyarrow.array(np.zeros(n, np.int64)),
    }
    arrow("pyarrow.parquet").write_table(pyarrow.table(columns), path)


def _stats(values: Floats) -> dict[str, Any]:
    kinds = (("min", np.min), ("max", np.max), ("mean", np.mean), ("std", np.std))
    return {name: of(values, axis=0).tolist() for name, of in kinds} | {"count": [len(values)]}


def _lines(path: Path, each: list[dict[str, Any]]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in each), encoding="utf-8")
