"""Options of a view: what is drawn of robots, and what colours mean."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, get_args

from fastrod.checks import Bound, check

ColorBy = Literal["segment", "curvature", "strain", "tension"]
Body = Literal["backbone", "skin"]
COLOR_BY: tuple[str, ...] = get_args(ColorBy)
BODIES: tuple[str, ...] = get_args(Body)
FINE = 16
"""Largest number of robots for which spacers and tendons are drawn, whatever the options say: the browser
would have too much to do."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Options of a view."""

    color_by: ColorBy = "segment"
    """`segment`; `curvature`, |u_xy| [1/m]; `strain`, body radius times |u_xy|, the largest of bending in the
    body [%]; `tension` of the tendons [N], which are then drawn on a grey body."""
    body: Body = "backbone"
    """`backbone`: slender, with spacer discs, and tendons between them; `skin`: as thick as the body is,
    tendons hidden, but with
    `color_by="tension"` drawn on it."""
    tendons: bool = True
    """Whether tendons are drawn, of up to 16 robots."""
    spacers: bool = True
    """Whether spacers are drawn, of up to 16 robots."""
    contacts: bool = True
    loads: bool = True
    frames: bool = False
    """Axes of the tip."""
    pieces: Annotated[int | None, Bound(least=1)] = None
    """Straight pieces a segment; None: 40 of up to 4 robots, 20 of up to 16, 10 of more."""

    def __post_init__(self) -> None:
        check(self)

    def pieces_of(self, n_robots: int) -> int:
        """Straight pieces a segment of so many robots."""
        return self.pieces or (40 if n_robots <= 4 else 20 if n_robots <= FINE else 10)
