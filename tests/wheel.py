"""Source files of the wheel."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]
WINGS = ("device/fastrod_device", "gym_envs/fastrod_envs", "scenes/fastrod_scenes", "viewer/fastrod_viewer")
PACKAGES = ("fastrod", *WINGS)
"""The wheel."""


def sources(*paths: str) -> list[Path]:
    """Python files at these files and below these folders."""
    found = ([ROOT / path] if path.endswith(".py") else (ROOT / path).rglob("*.py") for path in paths)
    return sorted(file for files in found for file in files)
