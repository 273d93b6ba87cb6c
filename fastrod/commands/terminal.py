"""Ends of commands, and what they show while they work."""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import util
from pathlib import Path
from typing import ParamSpec, TypeVar

from fastrod.errors import FastrodError, InputError

DONE, FAILED, WRONG_INPUT = 0, 1, 2
BASE_FIT = "base fit: "
"""Beginning of the sentence that `identify` prints once its base model is fitted."""
_PATIENCE = 10.0  # s without a line
Progress = Callable[[str, int, int], None]
"""Takes what is done, how much of it, of how much."""
_Given = ParamSpec("_Given")
_Answer = TypeVar("_Answer")


class FailedError(Exception):
    """Error of work that failed although its input was right."""


def refuse(sentence: str, code: int = WRONG_INPUT) -> int:
    """Print `sentence` on stderr, in one line whatever names it quotes; the exit code `code`."""
    print(" ".join(sentence.split()), file=sys.stderr)
    return code


def needing(
    command: str, extra: str, *modules: str
) -> Callable[[Callable[_Given, _Answer]], Callable[_Given, _Answer]]:
    """Decorate the function of a command that stands on packages of an extra: `InputError` without them."""

    def decorate(function: Callable[_Given, _Answer]) -> Callable[_Given, _Answer]:
        @functools.wraps(function)
        def checked(*words: _Given.args, **options: _Given.kwargs) -> _Answer:
            need(command, extra, *modules)
            return function(*words, **options)

        return checked

    return decorate


def need(command: str, extra: str, *modules: str) -> None:
    """Raises `InputError` where what a command stands on is not installed."""
    for module in modules:
        if util.find_spec(module) is None:
            raise InputError(
                f"fastrod {command} needs {module.replace('_', '-')}: pip install 'fastrod[{extra}]'."
            )


def print_written(paths: Iterable[Path]) -> None:
    """Name each file that was written, in a line that no terminal breaks."""
    from rich.console import Console

    for path in paths:
        Console().print(f"wrote {path}", soft_wrap=True, highlight=False, markup=False)


@contextmanager
def folder(out: Path | None) -> Iterator[None]:
    """Make the folder of what is about to be computed before rather than after; gone again where nothing
    comes of it."""
    from fastrod.logs.folder import make_folder

    fresh = out is not None and not out.exists()
    if out is not None:
        make_folder(out)
    try:
        yield
    except FastrodError:
        if out is not None and fresh:
            out.rmdir()
        raise


@contextmanager
def progress() -> Iterator[Progress | None]:
    """A bar on stderr, or None where stderr is no terminal. A line of figures stays."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress as Bar

    with Bar(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=None)

        def draw(what: str, done: int, total: int) -> None:
            if what.startswith(BASE_FIT):
                bar.console.print(what, highlight=False)
            bar.update(task, description=what, completed=done, total=total)

        yield draw


def lines() -> Progress:
    """The same for a stderr that is no terminal: a line every ten seconds, for work that may take minutes."""
    begun = said = time.monotonic()

    def line(what: str, done: int, total: int) -> None:
        nonlocal said
        now = time.monotonic()
        if now - said > _PATIENCE or (what.startswith(BASE_FIT) and now - begun > _PATIENCE):
            said = now
            print(f"{now - begun:.0f} s, {done} of {total}: {what}", file=sys.stderr, flush=True)

    return line
