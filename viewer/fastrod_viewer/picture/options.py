"""Options of a view: what is drawn of robots, and what colours mean."""

from __future__ import annotations

from dataclasses import dataclass

from fastrod.errors import InputError, nearest

COLOR_BY: tuple[str, ...] = ("segment", "curvature", "strain", "tension")
BODIES: tuple[str, ...] = ("backbone", "skin")
FINE = 16
"""Largest number of robots for which spacers and tendons are drawn, whatever the options say: the browser
would have too much to do."""


@dataclass(frozen=True, kw_only=True)
class ViewOptions:
    """Options of a view."""

    color_by: str = "segment"
    """`segment`; `curvature`, |u_xy| [1/m]; `strain`, body radius times |u_xy|, the largest of bending in the
    body [%]; `tension` of the tendons [N], which are then drawn on a grey body."""
    body: str = "backbone"
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
    pieces: int | None = None
    """Straight pieces a segment; None: 40 of up to 4 robots, 20 of up to 16, 10 of more."""

    def __post_init__(self) -> None:
        for name, known in (("color_by", COLOR_BY), ("body", BODIES)):
            given = getattr(self, name)
            if given not in known:
                raise InputError(f"ViewOptions.{name} is {given!r}; {nearest(str(given), known)}")
        for name in ("tendons", "spacers", "contacts", "loads", "frames"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"ViewOptions.{name} is {getattr(self, name)!r}; it must be True or False.")
        if self.pieces is not None and (
            not isinstance(self.pieces, int) or isinstance(self.pieces, bool) or self.pieces < 1
        ):
            raise InputError(
                f"ViewOptions.pieces is {self.pieces!r}; it must be a whole number, at least 1, or None."
            )

    def pieces_of(self, n_robots: int) -> int:
        """Straight pieces a segment of so many robots."""
        return self.pieces or (40 if n_robots <= 4 else 20 if n_robots <= FINE else 10)
