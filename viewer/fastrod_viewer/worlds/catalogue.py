"""The worlds that there are by name: shipped robots, scenes, and robot files. Nothing heavy is imported
before a world is opened."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fastrod.errors import UnknownNameError, nearest
from fastrod.model.robot import Robot
from fastrod.model.robotfile import load_robot, robot_names
from fastrod_scenes.scene import HostedScene, MujocoScene, RodScene, load, names
from fastrod_viewer.page import plain
from fastrod_viewer.worlds.robots import about

if TYPE_CHECKING:
    from fastrod_viewer.worlds.world import World

ROD_SCENES: Mapping[str, str] = {
    "airway": "A thin robot is fed into a forked airway and steered into the left bronchus, its twin into "
    "the right one.",
    "bar": "A thin robot winds itself around a bar of 30 mm and holds it.",
    "draped": "A cylinder rises under a heavy, sagging rod, which drapes itself over it.",
    "grid": "Sixty-four five-segment reachers sway in waves, each with a phase of its own, in one simulator.",
    "insertion": "A soft, bent tip is pushed through a ribbed tube: every rib holds it until it jumps over.",
    "pair": "A rod bends onto another that crosses it, and the two press on each other.",
    "wall": "The prototype's tendons press its tip against a wall, and it slides along it.",
}
"""Scenes without a host, and what they are about: each scene's own sentence, here without importing it."""
HOSTED_SCENES: Mapping[str, str] = {
    "catch": "A soft robot that hangs from a post catches a thrown cube: its hook closes and holds it.",
    "dual_arm": "A UR5 carries two soft robots that move in opposite phase, and feels the sum of both.",
    "explore": "A soft robot on a UR5 enters a box and, the UR5 held still, looks at each of its eight "
    "corners.",
    "neck_look": "A Unitree A1 bends its four-segment neck over the wall of a box and looks into every "
    "corner of it.",
    "neck_push": "A Unitree A1 swings its three-segment neck as sin(w t) and pushes a cube over the floor, "
    "which its legs feel.",
    "pick_gripper": "A soft robot on a UR5 takes a cube from a table with two fingers, carries it sideways "
    "and puts it on a spot.",
    "pick_suction": "A soft robot on a UR5 takes a cube from a table by suction, carries it sideways and "
    "puts it on a spot.",
    "track_circle": "The tip of a soft robot on a UR5 follows a circle.",
    "track_figure_eight": "The tip of a soft robot on a UR5 follows a figure eight.",
    "track_helix": "The tip of a soft robot on a UR5 follows a helix.",
    "track_square": "The tip of a soft robot on a UR5 follows a square.",
    "track_square_helix": "The tip of a soft robot on a UR5 follows a helix with the corners of a square.",
}
"""Scenes in a PyBullet world (`pip install fastrod[hosts]`), likewise."""
MUJOCO_SCENES: Mapping[str, str] = {
    "ur5_mujoco": "A UR5 in MuJoCo carries a soft robot that bends and presses a sprung plate aside, and "
    "feels the spring in its joints.",
    "whip": "A UR5 in MuJoCo cracks a soft robot of five segments like a whip: its joints feel the rod's "
    "inertia.",
}
"""Scenes in a MuJoCo model (`pip install fastrod[mujoco]`), likewise."""


def catalogue() -> dict[str, str]:
    """Name -> one sentence on it, for `open_world`: robots first, then scenes of rods alone, then those with
    a host."""
    return {
        **{name: about(load_robot(name)) for name in robot_names()},
        **ROD_SCENES,
        **HOSTED_SCENES,
        **MUJOCO_SCENES,
    }


def labels() -> dict[str, str]:
    """Name -> label in a picker, in the order of `catalogue`: the group, then a plain name.

    >>> labels()["airway"], labels()["tdcr_a"]
    ('Contact · Airway', 'Robot · TDCR A')
    """
    groups = {"Robot": robot_names(), "Contact": ROD_SCENES, "Rigid host": {**HOSTED_SCENES, **MUJOCO_SCENES}}
    return {name: f"{group} · {plain(name)}" for group, members in groups.items() for name in members}


def open_world(name: str | Path | Robot) -> World:
    """The world of a scene's name; or a robot free in space, of a shipped name, of the path of a .toml, or as
    it is.

    Raises `UnknownNameError` with the nearest name, `RobotError` for a file that is no robot, `HostError`
    where a scene needs PyBullet or MuJoCo and it is not installed.
    """
    from fastrod_viewer.worlds.simulated import FreeWorld, SceneWorld

    if isinstance(name, Robot):
        return FreeWorld(name)
    text = str(name)
    if text in names():
        scene = load(text)
        if isinstance(scene, RodScene):
            return SceneWorld(scene)
        if isinstance(scene, MujocoScene):
            from fastrod_viewer.worlds.hosted import MujocoView

            return MujocoView(scene)
        assert isinstance(scene, HostedScene)
        from fastrod_viewer.worlds.hosted import HostedView

        return HostedView(scene)
    if text not in robot_names() and not text.endswith(".toml"):
        raise UnknownNameError(
            f"no scene and no robot {text!r}; {nearest(text, catalogue())} A robot file's path ends in .toml."
        )
    return FreeWorld(load_robot(name))
