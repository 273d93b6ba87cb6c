"""Files from anywhere: read within a size, and one sentence for whatever is wrong with one."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fastrod.errors import FastrodError

_LARGEST = 1_000_000  # bytes; a robot of five segments has two thousand
_DEEPEST = 50  # words of a dotted key


@contextmanager
def reading(
    path: Path,
    where: str,
    error: type[FastrodError],
    what: str = "cannot be read",
    *,
    most: int,
    hint: str = "",
) -> Iterator[None]:
    """Read a file of at most so many bytes in this context. Whatever a parser raises there of a file that is
    damaged, foreign or not there is one sentence: `where` names the file, `what` says what it is not, `hint`
    what to do. Raises `error`; an error of fastrod stays one of its kind."""
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may have no end
            raise ValueError("it is no file")
        if path.stat().st_size > most:
            raise ValueError(f"it has more than {most} bytes")
        yield
    except FastrodError as why:
        if where in str(why):
            raise
        raise type(why)(f"{where}: {why}") from why
    except Exception as why:  # zipfile, numpy's headers, trimesh's readers, scipy's: of any kind
        said = str(why).rstrip(".") or type(why).__name__
        reason = getattr(why, "strerror", None) or (f"it lacks {why}" if isinstance(why, KeyError) else said)
        raise error(f"{where} {what}: {reason}{hint or '.'}") from why


def read_text(path: Path, where: str, error: type[FastrodError]) -> str:
    """The text of a TOML file, with or without a byte order mark. Raises `error`; `where` names the file."""
    with reading(path, where, error, most=_LARGEST):
        text = path.read_bytes().decode("utf-8-sig")
    return text  # noqa: RET504  (to a type checker the context may swallow an error)


def parse(text: str, where: str, error: type[FastrodError], what: str) -> dict[str, Any]:
    """The tables of a TOML text. Raises `error`; `where` names the text, and `what` is what it should be."""
    if any(
        piece.count(".") > _DEEPEST and all(map(str.strip, piece.split(".")))
        for piece in re.split(r"[\n,=]", text)
    ):
        # tomllib takes a time that grows with the square of their number
        raise error(f"{where} is not a {what}: it has a key of more than {_DEEPEST} words.")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as why:
        raise error(f"{where} is not TOML: {why}.") from why
    except RecursionError as why:
        raise error(f"{where} is not a {what}: its tables stand too deep in one another.") from why
    except ValueError as why:  # of a whole number of thousands of digits
        raise error(f"{where} holds a number that nothing has: {str(why).partition(';')[0]}.") from why
