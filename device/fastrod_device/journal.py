"""`Journal`: what happened, a line each, on disk at once."""

from __future__ import annotations

import csv
import threading
from pathlib import Path
from typing import TextIO, final

from fastrod.errors import InputError


@final
class Journal:
    """Stops and what led to them as a CSV of t [s], kind and sentence; a line is the system's before `write` returns, so a killed process
    loses none. Its lines are in `lines` too."""

    def __init__(self, path: str | Path | None) -> None:
        """Append to `path`; None: to memory alone. Raises `InputError` where it cannot be written."""
        self.lines: list[tuple[float, str, str]] = []
        self._lock = threading.Lock()
        self._file: TextIO | None = None
        if path is not None:
            try:
                self._file = Path(path).open("a", encoding="utf-8", newline="", buffering=1)  # noqa: SIM115 it stays open
            except OSError as error:
                raise InputError(f"{str(path)!r} cannot be written: {error.strerror or error}.") from error

    def write(self, t: float, kind: str, sentence: str) -> None:
        """Add a line; a full disk must not keep a stop from happening, so it never raises."""
        with self._lock:
            self.lines.append((t, kind, sentence))
            if self._file is not None:
                try:
                    csv.writer(self._file, lineterminator="\n").writerow([f"{t:.4f}", kind, sentence])
                except OSError:
                    self._file = None

    def close(self) -> None:
        """Let go of the file."""
        with self._lock:
            if self._file is not None:
                self._file.close()
                self._file = None
