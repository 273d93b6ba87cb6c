"""Files that grow line by line while a session runs: by whole lines, at the place where they were opened."""

from __future__ import annotations

import os
from contextlib import suppress
from io import FileIO
from pathlib import Path


def append_lines(file: FileIO, lines: str) -> None:
    """Write the lines at once. Raises `OSError`: no fragment stays then, since the next write would continue
    from there."""
    data, end = lines.encode(), file.tell()
    try:
        while data:
            data = data[file.write(data) :]
    except OSError:
        with suppress(OSError):
            if file.tell() != end:
                file.seek(end)
                file.truncate()
        raise


def is_at(file: FileIO, path: Path) -> bool:
    """Return whether `path` still names the open file.

    What was removed takes lines all the same, and they are nowhere; what was renamed, or whose folder was,
    takes them where nobody looks.
    """
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except OSError:
        return False


def made_again(path: Path, lines: str) -> FileIO:
    """A new file at `path`, open at its end, that begins with `lines`; its folder is made where it is gone.

    Raises `OSError` where that fails, and where another file is there; nothing half-written stays.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("xb", buffering=0)
    try:
        append_lines(file, lines)
    except OSError:
        file.close()
        path.unlink(missing_ok=True)
        raise
    return file
