"""Robot models for rigid hosts that ship with the scenes."""

from importlib.resources import files


def ur5_path() -> str:
    """Path of the UR5's URDF: joints `shoulder_pan_joint` to `wrist_3_joint`, tip link `tool0` with z out of
    the flange.

    Its frames, zero pose and values are stated in the file's first comment, with their source.

    >>> ur5_path().endswith("ur5.urdf")
    True
    """
    return str(files("fastrod_scenes.robots").joinpath("ur5.urdf"))
