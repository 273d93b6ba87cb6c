"""`Journal`: what happened, a line each, on disk at once."""

from __future__ import annotations

import csv
import ctypes
import io
import os
import sys
import threading
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import final

from fastrod.errors import InputError
from fastrod.logs.linefile import append_lines, is_at, made_again

_ROOM = 65536
"""Bytes that are always free for what comes next: some hundred lines."""
_BLOCK = 4096  # bytes of a spare file that are given up for a line
_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE: blocks beyond the file's end, which no reader sees


@final
class Journal:
    """Stops and what led to them as a CSV of t [s], kind and sentence; a line is the system's before `write`
    returns, so a killed process loses none. Its lines are in `lines` too.

    Room on the disk is reserved at the start, so the line that says that the disk is full has its place:
    behind the file's end where the system can (Linux), else by a spare file PATH.spare, which gives up a
    block for each line that does not fit. A journal that was removed or renamed is written again, with all
    lines of this session.
    """

    def __init__(self, path: str | Path | None) -> None:
        """Append to `path`; None: to memory alone. Raises `InputError` where it cannot be written."""
        self.lines: list[tuple[float, str, str]] = []
        self._lock = threading.Lock()
        self._path = None if path is None else Path(path)
        self._file: FileIO | None = None
        self._spare: FileIO | None = None
        self._missing = 0
        """Newest lines that are not in the file."""
        if self._path is not None:
            try:
                self._file = self._path.open("ab", buffering=0)  # it stays open
                if not _reserved(self._file, _ROOM):
                    self._spare = self._spare_path().open("wb", buffering=0)
                    append_lines(self._spare, "\0" * _ROOM)
            except OSError as error:
                self.close()
                with suppress(OSError):
                    if self._path.stat().st_size == 0:
                        self._path.unlink()
                raise InputError(f"{str(path)!r} cannot be written: {error.strerror or error}.") from error

    def write(self, t: float, kind: str, sentence: str) -> None:
        """Add a line; a full disk must not keep a stop from happening, so it never raises."""
        with self._lock:
            self.lines.append((t, kind, sentence))
            if self._file is None or self._path is None:
                return
            self._missing += 1
            try:
                if not is_at(self._file, self._path):
                    self._open_again(self._path)
                self._append("".join(_line(*line) for line in self.lines[len(self.lines) - self._missing :]))
                self._missing = 0
                if self._spare is None:
                    _reserved(self._file, _ROOM)
            except OSError:
                return  # written with the next one, if there is room then

    def close(self) -> None:
        """Let go of the file, and of the room that it did not need."""
        with self._lock:
            if self._file is not None:
                with suppress(OSError):
                    self._file.truncate()
                self._file.close()
                self._file = None
            if self._spare is not None:
                self._spare.close()
                with suppress(OSError):
                    self._spare_path().unlink()
                self._spare = None

    def _open_again(self, path: Path) -> None:
        """Add to whatever an editor has put there; what is gone is written again."""
        assert self._file is not None
        if path.exists():
            file = path.open("ab", buffering=0)
        else:
            file, self._missing = made_again(path, ""), len(self.lines)
        self._file.close()
        self._file = file

    def _spare_path(self) -> Path:
        assert self._path is not None
        return self._path.with_name(self._path.name + ".spare")

    def _append(self, text: str) -> None:
        """Append a line; where it does not fit, the spare file gives up a block, and another if someone
        else was quicker."""
        assert self._file is not None
        while True:
            try:
                return append_lines(self._file, text)
            except OSError:
                left = 0 if self._spare is None else self._spare.tell()
                if self._spare is None or not left:
                    raise
                self._spare.seek(max(left - _BLOCK, 0))
                self._spare.truncate()


def _line(t: float, kind: str, sentence: str) -> str:
    made = io.StringIO()
    csv.writer(made, lineterminator="\n").writerow([f"{t:.4f}", kind, sentence])
    return made.getvalue()


def _reserved(file: FileIO, room: int) -> bool:
    """Whether the file's next `room` bytes have their place on the disk now; its size stays.

    Not every system, nor every file system, can do that.
    """
    if not sys.platform.startswith("linux"):
        return False
    fallocate = getattr(ctypes.CDLL(None), "fallocate64", None)
    if fallocate is None:
        return False
    offset = ctypes.c_int64(os.fstat(file.fileno()).st_size)
    return int(fallocate(file.fileno(), _KEEP_SIZE, offset, ctypes.c_int64(room))) == 0
