"""TOML files from anywhere: read whole within a size, and one sentence for whatever is wrong with one."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from fastrod.errors import FastrodError

_LARGEST = 1_000_000  # bytes; a robot of five segments has two thousand
_DEEPEST = 50  # parts of a dotted key


def read_text(path: Path, where: str, error: type[FastrodError]) -> str:
    """The text of a TOML file, with or without a byte order mark. Raises `error`; `where` names the file."""
    try:
        if path.exists() and not path.is_file():  # a pipe or a device may have no end
            raise ValueError("it is no file")
        with path.open("rb") as file:
            content = file.read(_LARGEST + 1)
        if len(content) > _LARGEST:
            raise ValueError(f"it has more than {_LARGEST} bytes")
        return content.decode("utf-8-sig")
    except (OSError, ValueError) as why:  # ValueError: bytes that are no text, or a path that no file can have
        raise error(f"{where} cannot be read: {getattr(why, 'strerror', None) or why}.") from why


def parse(text: str, where: str, error: type[FastrodError], what: str) -> dict[str, Any]:
    """The tables of a TOML text. Raises `error`; `where` names the text, and `what` is what it should be."""
    if any(piece.count(".") > _DEEPEST and all(map(str.strip, piece.split("."))) for piece in re.split(r"[\n,=]", text)):
        # tomllib takes a time that grows with the square of their number
        raise error(f"{where} is not a {what}: it has a key of more than {_DEEPEST} parts.")
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as why:
        raise error(f"{where} is not TOML: {why}.") from why
    except RecursionError as why:
        raise error(f"{where} is not a {what}: its tables stand too deep in one another.") from why
    except ValueError as why:  # of a whole number of thousands of digits
        raise error(f"{where} holds a number that nothing has: {str(why).partition(';')[0]}.") from why
