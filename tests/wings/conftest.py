"""Close after a test what it opened."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Any]]:
    """Takes a world, an environment, or whatever can be closed, gives it back, and closes it in the end."""
    with ExitStack() as stack:
        yield lambda thing: stack.enter_context(closing(thing))
