"""`refusals`: a test of many sentences, each with the call that it answers."""

from collections.abc import Callable, Mapping
from typing import Any

import pytest


def refusals(tables: Mapping[type[Exception], Mapping[str, Callable[..., Any]]]) -> pytest.MarkDecorator:
    """Parametrise a test by error, sentence (a pattern) and call; the sentence names the case."""
    return pytest.mark.parametrize(
        ("error", "sentence", "call"),
        [
            pytest.param(error, sentence, call, id=sentence[:70])
            for error, table in tables.items()
            for sentence, call in table.items()
        ],
    )
