"""`perf/contact_scenes.py`, which is no package."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def scenes(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "perf"))
    import contact_scenes

    return contact_scenes
