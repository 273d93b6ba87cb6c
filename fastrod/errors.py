"""Every exception that fastrod raises on purpose: what was given, what would be right, the nearest known
name."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from enum import Enum


class FastrodError(Exception):
    """Base of every error that a user can cause and correct; the command line exits with 2 on it.

    Its text is one line, whatever it quotes of a file or a library: what cannot be printed, line breaks and
    escapes too, is a space.
    """

    def __str__(self) -> str:
        return "".join(c if c.isprintable() else " " for c in str(self.args[0])) if self.args else ""


class RobotError(FastrodError, ValueError):
    """A robot description that cannot be a robot."""


class InputError(FastrodError, ValueError):
    """An actuation, a load or a pose of the wrong shape, unit or range."""


class LogError(FastrodError, ValueError):
    """A run log that cannot be read, with the row and the column named."""


class HostError(FastrodError, RuntimeError):
    """A rigid host, a body or a link that is not there, or cannot do what is asked."""


class EffectError(FastrodError, ValueError):
    """An effect that is not one, or whose parameters cannot be."""


class UnknownNameError(FastrodError, KeyError):
    """A name that is not known, answered with the near ones."""


class Problem(Enum):
    """Cause of a robot's failure in a batch, for programs: the kind of a sentence in `State.problems`."""

    BAD_INPUT = "bad_input"
    """Its input cannot be used: not finite, out of range, impossible."""
    DIVERGED = "diverged"
    """A step's pass diverged, and no shape was found on these inputs."""
    NOT_CONVERGED = "not_converged"
    """`settle` did not bring the boundary residual below its tolerance."""
    OVERLOADED = "overloaded"
    """Its loads are beyond what a rod can hold: no shape was found, or only an unstable one."""
    NEVER_SOLVED = "never_solved"
    """It was left out before its first step."""
    CONTACT_STUCK = "contact_stuck"
    """The rod still moves on its contacts, or no forces were found that hold it there."""
    CONTACT_INSIDE = "contact_inside"
    """No forces were found that push the rod out of an obstacle, or no start outside of it."""
    CONTACT_TUNNELLED = "contact_tunnelled"
    """The rod would go through an obstacle."""
    NO_CONTACT_LEFT = "no_contact_left"
    """The rod has as many contacts as it may have."""


class ProblemSentence(str):
    """A sentence that says what is wrong with a robot, and its `kind`."""

    __slots__ = ("kind",)
    kind: Problem

    def __new__(cls, sentence: str, kind: Problem) -> ProblemSentence:
        """A sentence of this kind."""
        made = super().__new__(cls, sentence)
        made.kind = kind
        return made

    def __getnewargs__(self) -> tuple[str, Problem]:  # type: ignore[override]
        """Return what `pickle` and `copy` make it from."""
        return str(self), self.kind


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of an error sentence: the nearest known name, or all of them.

    >>> nearest("lenght", ["length", "mode"])
    "did you mean 'length'?"
    """
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean {close[0]!r}?" if close else f"known: {', '.join(names) or 'none'}."


def shown(value: object, longest: int = 200) -> str:
    """Return what was given, as an error sentence quotes it: its repr, cut in the middle where it is long.

    >>> shown("a" * 30, 20)
    "'aaaaaaa ... aaaaaa'"
    """
    text = repr(value)
    half = (longest - 5) // 2
    return text if len(text) <= longest else f"{text[: longest - 5 - half]} ... {text[-half:]}"


def refuse_masked(name: str, value: object) -> None:
    """Raise `InputError` for a masked array, or a list of such, that hides entries: numpy would hand out what
    it hides."""
    import numpy as np

    for a in value if isinstance(value, (list, tuple)) else (value,):
        if isinstance(a, np.ma.MaskedArray) and (hidden := int(np.ma.getmaskarray(a).sum())):
            count = f"{hidden} of {a.size} entries"
            raise InputError(f"{name} is a masked array that hides {count}; give all, as with filled(0.0).")
