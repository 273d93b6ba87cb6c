"""`Renderer`: pictures of a task, by its host or drawn from its `Backdrop`, or a page of viser."""

from __future__ import annotations

from typing import final

import numpy as np

from fastrod.errors import InputError
from fastrod_envs.page import EnvPage
from fastrod_envs.painter import paint
from fastrod_envs.task import Task

MODES = ("rgb_array", "viser")
WIDTH, HEIGHT = 480, 360
"""Size of a picture [pixels]."""


@final
class Renderer:
    """Draws what `render_mode` asks for."""

    def __init__(self, mode: str | None) -> None:
        """Raises `InputError` for a mode that is not there."""
        if mode is not None and mode not in MODES:
            raise InputError(f"render_mode is {mode!r}; it must be None, {' or '.join(map(repr, MODES))}.")
        self._mode = mode
        self._page: EnvPage | None = None

    def render(self, task: Task) -> tuple[np.ndarray, ...] | None:
        """With rgb_array a picture (360, 480, 3) uint8 of every environment: N of them cost N times 15 to 40
        ms. With viser the page shows the first 16 now, and None is returned, as it is without a mode. Raises
        `InputError` where viser is missing, or no port is free."""
        if self._mode == "rgb_array":
            return tuple(_picture(task, i) for i in range(task.n_envs))
        if self._mode == "viser":
            if self._page is None:
                self._page = EnvPage(task)
            else:
                self._page.update(task)
        return None

    def close(self) -> None:
        """Stop the page, if there is one."""
        if self._page is not None:
            self._page.close()
            self._page = None


def _picture(task: Task, i: int) -> np.ndarray:
    taken = task.picture(i, WIDTH, HEIGHT)
    return paint(task.backdrop(i), WIDTH, HEIGHT) if taken is None else taken
