"""Examples of docstrings (>>>) as blocks of code on the site: a griffe extension of mkdocstrings."""

from __future__ import annotations

import re
from typing import Any

import griffe

_EXAMPLE = re.compile(r"(?:^|\n\n)((?:>>> .*(?:\n(?!\n).*)*))")


class Examples(griffe.Extension):
    """Fence what looks like an interpreter's session."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every object whose docstring is read."""
        if obj.docstring and ">>> " in obj.docstring.value:
            obj.docstring.value = _EXAMPLE.sub(r"\n\n```pycon\n\1\n```", obj.docstring.value)
