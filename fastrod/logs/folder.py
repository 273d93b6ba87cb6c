"""The folder into which a command writes."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryFile

from fastrod.errors import InputError


def make_folder(path: str | Path) -> Path:
    """The folder at `path`, made where it is not there. Raises `InputError` where it cannot be made or
    written into."""
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=folder):
            pass
    except OSError as error:
        why = "it is a file" if folder.is_file() else error.strerror or str(error)
        raise InputError(f"folder {str(folder)!r} cannot be written: {why}.") from error
    return folder
