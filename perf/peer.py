"""What the benchmark knows of a peer: the same rod under the same forces, at settings from coarse to fine."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TypeAlias

from appendix_j import Array

Solve: TypeAlias = Callable[[Array], Array]
"""Tips at rest (n, 2) across and along the straight rod [m] under tip forces (n,) across it [N]."""
Build: TypeAlias = Callable[[], AbstractContextManager[Solve]]
"""Make everything that does not depend on the force; what it holds is given back at the end."""


@dataclass(frozen=True)
class Rung:
    """One setting of a peer."""

    label: str
    build: Build
    """Solves the forces one after the other, each from the straight rod unless the peer says otherwise."""
    together: Build | None = None
    """Solves all forces in one call, where the peer has such a thing of its own."""


@dataclass(frozen=True)
class Peer:
    """One way to the tip of the rod."""

    name: str
    modules: Sequence[str]
    """What must be importable."""
    packages: Sequence[str]
    """Distributions whose versions are stated."""
    same: str
    """What was done so that it solves the same problem, and what could not be matched."""
    also: str
    """What it does that fastrod does not."""
    rungs: Callable[[], Sequence[Rung]]
    """From coarse to fine."""
    family: str = field(default="")
    """Peers of one family share a colour in the plot."""

    def missing(self) -> str | None:
        """A sentence where the peer cannot run here."""
        absent = [name for name in self.modules if importlib.util.find_spec(name) is None]
        if not absent:
            return None
        return (
            f"{self.name} is left out: {' and '.join(absent)} is not installed (pip install -e '.[peers]')."
        )

    def versions(self) -> str:
        return ", ".join(f"{name} {version(name)}" for name in self.packages)
