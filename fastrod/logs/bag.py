"""ROS 2 bags as tables: every number of every message, at the times of one topic."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from fastrod.errors import LogError
from fastrod.types import Floats

_MOST = 5_000_000  # messages
_SLOW = 4  # times fewer messages than the fastest topic: rows are no more those of a topic that is slower


def read_bag(path: Path, most_bytes: int) -> dict[str, Floats]:
    """The numbers of a bag, a folder with metadata.yaml or one of its files: `t` [s], and columns such as
    `tip_pose.pose.position.x` or `joint_states.position.1`, counted from 1.

    Times are those of the messages' headers, or when the bag took them in. Rows are those of the slowest
    topic that has a quarter of the messages of the fastest, so that no measurement is made up; of the others
    the values between two messages are interpolated. Raises `LogError` for what is no bag, without numbers or
    too large.
    """
    try:
        highlevel, typesys = import_module("rosbags.highlevel"), import_module("rosbags.typesys")
    except ImportError as error:
        raise LogError(
            "a ROS 2 bag needs the package rosbags, which is not installed; pip install 'fastrod[ros]' "
            "brings it."
        ) from error
    if not path.exists():
        raise LogError(f"there is no bag {str(path)!r}.")
    folder = path if path.is_dir() else path.parent
    if sum(file.stat().st_size for file in folder.iterdir() if file.is_file()) > most_bytes:
        raise LogError(f"{path.name} has more than {most_bytes} bytes; cut it in parts.")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    found: dict[str, list[tuple[int, dict[str, float]]]] = {}
    try:
        with highlevel.AnyReader([folder], default_typestore=store) as reader:
            if reader.message_count > _MOST:
                raise LogError(f"{path.name} has {reader.message_count} messages; a log may have {_MOST}.")
            for connection, received, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                stamp = getattr(getattr(message, "header", None), "stamp", None)
                at = received if stamp is None else stamp.sec * 10**9 + stamp.nanosec
                values = dict(_numbers(message, connection.topic.strip("/").replace("/", ".")))
                found.setdefault(connection.topic, []).append((at, values))
    except LogError:
        raise
    except Exception as error:  # of a damaged bag its reader raises anything
        why = " ".join(str(error).split()).rstrip(".") or type(error).__name__
        raise LogError(f"{path.name} is no ROS 2 bag: {why}.") from error
    topics = {topic: rows for topic, rows in found.items() if any(values for _, values in rows)}
    if not topics:
        raise LogError(f"{path.name} has no message with a number.")
    most = max(map(len, topics.values()))
    slowest = min((rows for rows in topics.values() if _SLOW * len(rows) >= most), key=len)
    stamps = np.unique([at for at, _ in slowest])
    times = 1e-9 * (stamps - stamps[0])
    table: dict[str, Floats] = {"t": times}
    for rows in topics.values():
        rows.sort(key=lambda row: row[0])
        at = 1e-9 * np.array([stamp - int(stamps[0]) for stamp, _ in rows])
        for name in rows[0][1]:
            column = np.array([values.get(name, np.nan) for _, values in rows])
            table[name] = np.interp(times, at, column, left=np.nan, right=np.nan)
    return table


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    """Every number in a message, by the names that lead to it; without its header."""
    fields = getattr(value, "__dataclass_fields__", None)
    if fields:
        for key in fields:
            if key != "header" and not key.startswith("__"):
                yield from _numbers(getattr(value, key), f"{name}.{key}")
    elif isinstance(value, (list, np.ndarray)):
        for k, each in enumerate(value, 1):
            yield from _numbers(each, f"{name}.{k}")
    elif isinstance(value, (bool, int, float, np.number)):
        yield name, float(value)
