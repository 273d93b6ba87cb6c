"""ROS 2 bags as a user's own log files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fastrod.errors import LogError
from fastrod.logs.reader import read_log
from fastrod.logs.table import read_table
from fastrod.model.robotfile import loads

rosbag2 = pytest.importorskip(
    "rosbags.rosbag2", reason="rosbags is not installed: pip install 'fastrod[ros]'"
)
EPOCH, STEP = 1_700_000_000_000_000_000, 20_000_000  # ns


def bag(folder: Path, n: int = 50) -> Path:
    """Joints at 50 Hz in degrees, a tip at 25 Hz in mm, each stamped by its header; one text."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    with rosbag2.Writer(folder, version=9) as writer:
        joints = writer.add_connection("/drives/state", "sensor_msgs/msg/JointState", typestore=store)
        tip = writer.add_connection("/tip", "geometry_msgs/msg/PointStamped", typestore=store)
        word = writer.add_connection("/note", "std_msgs/msg/String", typestore=store)

        def write(connection, at, message) -> None:
            writer.write(connection, at + 7_000_000, store.serialize_cdr(message, connection.msgtype))

        for k in range(n):
            at = EPOCH + k * STEP
            stamp = kinds["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
            header = kinds["std_msgs/msg/Header"](stamp=stamp, frame_id="")
            state = kinds["sensor_msgs/msg/JointState"]
            none = np.zeros(0)
            angles = np.array([k, -k, 0.0, 2.0])
            write(joints, at, state(header=header, name=[], position=angles, velocity=none, effort=none))
            if k % 2 == 0:
                place = kinds["geometry_msgs/msg/Point"](x=0.1 * k, y=0.0, z=70.0)
                write(tip, at, kinds["geometry_msgs/msg/PointStamped"](header=header, point=place))
        write(word, EPOCH, kinds["std_msgs/msg/String"](data="a note"))
    return folder


def test_rows_are_those_of_the_slower_topic_and_times_those_of_headers(tmp_path: Path) -> None:
    table = read_table(bag(tmp_path / "run"))
    assert [*table] == [
        "t",
        *(f"drives.state.position.{k}" for k in range(1, 5)),
        *(f"tip.point.{a}" for a in "xyz"),
    ]
    assert_allclose(table["t"], 0.04 * np.arange(25), atol=1e-12)
    assert_allclose(table["drives.state.position.2"], -2.0 * np.arange(25), atol=1e-9)
    file = next((tmp_path / "run").glob("*.db3"))
    assert_allclose(read_table(file)["tip.point.x"], table["tip.point.x"])


def test_bag_is_read_as_the_log_of_a_robot(tmp_path: Path) -> None:
    text = Path(__file__).parent.parent.joinpath("fastrod/robots/prototype.toml").read_text()
    joints = ", ".join(f'"drives.state.position.{k}"' for k in range(1, 5))
    robot = loads(
        text
        + f"""
[log]
columns.dl = [{joints}]
columns.tip = ["tip.point.x", "tip.point.y", "tip.point.z"]
units = {{ angle = "deg", tip = "mm" }}
drum_radius = 0.01
"""
    )
    log = read_log(bag(tmp_path / "run", 10), robot)
    assert_allclose(log.dl[:, 0], 0.01 * np.radians(2.0 * np.arange(5)), atol=1e-12)
    assert_allclose(log.tip_position[-1], [8e-4, 0.0, 0.07])


@pytest.mark.parametrize("content", [b"", b"rosbag2_bagfile_information: 3", b"\xff\xfe"])
def test_what_is_no_bag_is_one_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "metadata.yaml").write_bytes(content)
    with pytest.raises(LogError, match="is no ROS 2 bag"):
        read_table(tmp_path)


def test_bag_that_is_not_there_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="there is no bag"):
        read_table(tmp_path / "run.mcap")
