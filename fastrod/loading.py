"""Robot files with their effects checked: what `fastrod.load_robot` is."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from fastrod.errors import EffectError, UnknownNameError, shown
from fastrod.model import robotfile
from fastrod.model.robot import Robot


def load_robot(source: str | Path) -> Robot:
    """The robot of a shipped name, or of a path to a .toml, with every [[effect]] known and its parameters
    within their bounds.

    Raises `UnknownNameError` for a name or an effect that is not there, `RobotError` for a file that is not a
    robot, `EffectError` for an effect's parameter that cannot be.
    """
    robot = robotfile.load_robot(source)
    if robot.effects:
        check_effects(robot, f"robot file {shown(str(source))}")
    return robot


def robot_of(given: Robot | str | Path) -> Robot:
    """A robot, or the one of a shipped name or of a path to a .toml. Raises what `load_robot` does."""
    return given if isinstance(given, Robot) else load_robot(given)


def with_line_density(robot: Robot, density: float | None) -> Robot:
    """The robot with this mass per length [kg/m] in all its segments, or as it is for None; lumps stay.

    Raises `RobotError` for a density that cannot be.
    """
    if density is None:
        return robot
    segments = tuple(replace(segment, line_density=density) for segment in robot.segments)
    return replace(robot, segments=segments)


def check_effects(robot: Robot, where: str) -> None:
    """Look up the effects of `robot` in the library; `where` names it in errors. Raises `UnknownNameError`,
    `EffectError`."""
    from fastrod.effects.base import read_values

    # the library imports numba, which a robot without effects does not need
    from fastrod.effects.pipeline import named_effects
    from fastrod.model.routing import route

    try:
        tables = named_effects(robot)
    except (EffectError, UnknownNameError) as error:
        raise type(error)(f"{where}: {error}") from error
    wiring = route(robot)
    for name, table in tables.items():
        read_values(name, table, wiring, where)
