"""`Journal`: what happened, a line each, on disk at once; `Trace`: where the wires were lately, for frames that come late."""

from __future__ import annotations

import csv
import threading
from collections import deque
from pathlib import Path
from typing import TextIO, final

import numpy as np

from fastrod.errors import InputError
from fastrod.types import Floats


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


@final
class Trace:
    """What encoders said and what was told, of the newest cycles. Its caller has a lock."""

    def __init__(self, n_wires: int, n_cycles: int) -> None:
        """Empty."""
        self._nowhere: Floats = np.full(n_wires, np.nan)
        self._past: deque[tuple[float, Floats, Floats]] = deque(maxlen=n_cycles)

    def add(self, t: float, dl: Floats, told: Floats) -> None:
        """(n_wires,) by the encoders at `t` [s], and the set-points then [m]."""
        self._past.append((t, dl, told))

    def clear(self) -> None:
        """Forget all of it."""
        self._past.clear()

    def at(self, t: float) -> tuple[Floats, Floats]:
        """(n_wires,) and (n_wires,) [m] at `t` [s], by a straight line between two cycles; nan where nothing is known."""
        past = self._past
        if not past:
            return self._nowhere, self._nowhere
        k = next((k for k in range(len(past) - 1, -1, -1) if past[k][0] <= t), 0)
        if k == len(past) - 1 or t <= past[0][0]:
            return past[k][1], past[k][2]
        (t0, dl0, told0), (t1, dl1, told1) = past[k], past[k + 1]
        part = (t - t0) / (t1 - t0)
        return dl0 + part * (dl1 - dl0), told0 + part * (told1 - told0)
