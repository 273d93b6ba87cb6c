"""Bounds that fields declare: a value within passes, one beyond gives one sentence that names the field, the
value and what would be right."""

from __future__ import annotations

import ast
import importlib
import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
from wheel import PACKAGES, ROOT, sources

from fastrod.checks import Bound, Declared, check, check_number, declared_by
from fastrod.contact import ContactScene
from fastrod.errors import FastrodError, InputError
from fastrod.model.robot import Lump, Robot, Segment, Tendon
from fastrod.solver.options import Modal, Observer


@dataclass(frozen=True, kw_only=True)
class Lens:
    angle: Annotated[float, Bound(above=0.0, below=180.0, unit="deg")] = 45.0
    rows: Annotated[int | None, Bound(least=1)] = None
    far: Annotated[float, Bound(above=0.0, most=2.0, unit="m", hint="Was it given in mm?")] = 1.0
    round: bool = True
    kind: Literal["pinhole", "fisheye"] = "pinhole"
    name: str = "any"

    def __post_init__(self) -> None:
        check(self)


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"angle": 180.0}, "Lens.angle is 180.0 deg; it must be a number between 0 and 180 deg."),
        ({"angle": True}, "Lens.angle is True deg; it must be a number between 0 and 180 deg."),
        ({"rows": 0}, "Lens.rows is 0; it must be a whole number, at least 1, or None."),
        ({"rows": 1.5}, "Lens.rows is 1.5; it must be a whole number, at least 1, or None."),
        ({"far": 900}, "Lens.far is 900 m; it must be a number between 0 and 2 m. Was it given in mm?"),
        ({"round": 1}, "Lens.round is 1; it must be True or False."),
        ({"kind": "pinhoel"}, "Lens.kind is 'pinhoel'; did you mean 'pinhole'?"),
        ({"kind": 3}, "Lens.kind is 3; it must be 'pinhole' or 'fisheye'."),
    ],
)
def test_a_sentence_has_value_unit_bound_and_hint(given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError) as caught:
        Lens(**given)
    assert str(caught.value) == sentence


def test_none_text_and_numbers_within_are_taken() -> None:
    assert Lens(rows=None, name="", angle=1, far=1e-9).angle == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, 10**400, -1.0, 0.0, "1", None, [1.0]])
def test_no_number_is_no_positive_number(value: Any) -> None:
    with pytest.raises(InputError, match=r"^dt is .*; it must be a number, positive and finite\.$"):
        check_number("dt", value)


def declaring() -> list[type]:
    """Every dataclass of the wheel that checks its own fields."""
    found = []
    for file in sources(*PACKAGES):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            calls = (call for call in ast.walk(node) if isinstance(call, ast.Call))
            names = {call.func.id for call in calls if isinstance(call.func, ast.Name)}
            if isinstance(node, ast.ClassDef) and "check" in names:
                found.append(getattr(importlib.import_module(module_of(file)), node.name))
    return found


def module_of(file: Path) -> str:
    """Return the dotted name of a file of the wheel."""
    parts = file.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts if parts[0] == "fastrod" else parts[1:])


def beyond(declared: Declared) -> list[Any]:
    """Return values that are none of these."""
    if declared.numbers:
        n = declared.numbers
        alone = beyond(declared._replace(numbers=0))
        return [0.5, (), (0.5,) * (n + 1), *((0.5,) * (n - 1) + (one,) for one in alone)]
    wrong: list[Any] = [object(), [], "?"]
    if declared.kind in (int, float):
        low, high = declared.bound.least, declared.bound.most
        wrong += [math.nan, True, *(x for x in (math.nextafter(low, -math.inf),) if math.isfinite(low))]
        wrong += [math.nextafter(high, math.inf)] if math.isfinite(high) else []
        wrong += [x for x in (declared.bound.above, declared.bound.below) if math.isfinite(x)]
    return wrong if declared.optional else [*wrong, None]


ROD = Segment(length=0.1, bending_stiffness=(1.0, 1.0), torsional_stiffness=1.0, mode="passive")
NAMED = Lump(at=0.0, mass=0.0), Tendon(offset=0.01, angle=0.0), ROD, Robot(name="one", segments=(ROD,))
LACKING: dict[type, Any] = {type(one): one for one in NAMED}
DECLARING = [cls for cls in declaring() if cls in LACKING or all(hasattr(cls, f.name) for f in fields(cls))]


def test_there_are_some() -> None:
    assert {Observer, Modal} < set(DECLARING)
    assert set(LACKING) | {ContactScene} < set(DECLARING)
    assert len(DECLARING) > 14


@pytest.mark.parametrize("cls", DECLARING, ids=lambda cls: cls.__name__)
def test_every_declared_bound_is_kept(cls: Any) -> None:
    usual = LACKING.get(cls) or cls()
    for name, declared in declared_by(cls).items():
        for value in beyond(declared):
            with pytest.raises(FastrodError, match=name) as caught:
                replace(usual, **{name: value})
            assert len(str(caught.value)) < 400
