"""Strategies that the fuzz tests share: settings, odd values, mutations of tables and texts, what a
sentence is."""

from __future__ import annotations

import copy
import datetime
import math
from typing import Any

import tomli_w
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from fastrod.model.robotfile import dumps, load_robot, robot_names

SLOW = [
    HealthCheck.too_slow,
    HealthCheck.filter_too_much,
    HealthCheck.data_too_large,
    HealthCheck.function_scoped_fixture,
]


def tried(times: int) -> settings:
    """The same `times` examples on every machine."""
    always: Any = {"derandomize": True, "deadline": None, "database": None, "suppress_health_check": SLOW}
    return settings(max_examples=times, **always)


LONGEST = 1500
"""Characters of a sentence that still can be read."""

ORDINARY = [0.0, -0.0, 1.0, -1.0, math.nan, math.inf, -math.inf, 5e-324, 1e-300, 1e-30, 1e-12, 1e-3, 0.5]
LARGE = [90.0, 1e3, 1e9, 1e154, 1e300, 1.7e308]
odd_numbers = st.one_of(
    st.sampled_from([*ORDINARY, *LARGE]),
    st.sampled_from([0, 1, -1, 2, 70, 10**9, 2**63, 10**25, 10**400]),
    st.floats(),
    st.floats(1e-6, 1.0),
    st.integers(-3, 12),
)
WORDS = "paper passive tendon_tension tendon_length payload 0.07 nan ß \u202e \0"
odd_words = st.one_of(
    st.sampled_from(["", " ", *WORDS.split(" "), "a\nb", "💥", "é" * 50]),
    st.text(st.characters(exclude_categories=["Cs"]), max_size=12),
)
odd_leaves = st.one_of(
    odd_numbers,
    odd_words,
    st.booleans(),
    st.sampled_from([datetime.date(2020, 1, 2), datetime.datetime(2020, 1, 2, 3, 4), datetime.time(1, 2)]),
)
odd_values = st.recursive(
    odd_leaves,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(st.sampled_from(["offset", "angle", "name", "x", "é"]), inner, max_size=3)
    ),
    max_leaves=8,
)


def is_sentence(error: BaseException) -> bool:
    """Whether this error is one line that ends, in our own words."""
    text = str(error)
    foreign = ("Traceback", "msgspec", "numpy", "ndarray", "object of type", "tuple index", "NoneType")
    if not 0 < len(text) <= LONGEST or text.rstrip()[-1] not in ".?!)":
        return False
    return not any(word in text for word in ("\n", "\r", *foreign))


def one_sentence(error: BaseException, *names: str) -> None:
    """Assert that an error is one sentence, in which these names stand."""
    assert is_sentence(error), repr(str(error))
    assert all(name in str(error) for name in names), repr(str(error))


# Robot files

SECTIONS: dict[str, Any] = {
    "base": {"position": [0.1, 0.0, 0.2], "quaternion": [1.0, 0.0, 0.0, 0.0]},
    "world": {"gravity": [0.0, 0.0, -9.81]},
    "log": {"points": [0.01, 0.05]},
    "fit": {"segment.*.bending_stiffness": {"sd": 0.3}, "tendon.1.gain": {"sd": 0.1, "shared": True}},
    "sensor": {
        "noise": 0.0003,
        "registration_sd": [0.001, 0.01],
        "marker_offset_sd": 0.002,
        "latency_sd": 0.1,
    },
    "effect": [{"name": "backlash", "half_width": 0.0002}, {"name": "payload", "mass": 0.01}],
}


@st.composite
def good_tables(draw: st.DrawFn) -> dict[str, Any]:
    """Tables of robots that are: shipped ones, with further sections, and made-up ones."""
    import tomllib

    if draw(st.booleans()):
        table = tomllib.loads(dumps(load_robot(draw(st.sampled_from(robot_names())))))
    else:
        table = {"name": draw(odd_words), "segment": []}
        paper = draw(st.booleans())
        for _ in range(draw(st.integers(1, 3))):
            mode = "paper" if paper else draw(st.sampled_from(["tendon_length", "tendon_tension", "passive"]))
            segment: dict[str, Any] = {
                "length": draw(st.floats(0.03, 0.3)),
                "bending_stiffness": draw(st.lists(st.floats(1e-4, 1.0), min_size=2, max_size=2)),
                "torsional_stiffness": draw(st.floats(1e-4, 1.0)),
                "extension": [draw(st.floats(-0.02, 0.0)), draw(st.floats(0.0, 0.1))],
                "precurvature": draw(st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3)),
                "line_density": draw(st.floats(0.0, 0.1)),
                "mode": mode,
            }
            if mode != "passive":
                place = {"offset": st.floats(0.002, 0.02), "angle": st.floats(0.0, 6.28)}
                more = {"compliance": st.floats(0.0, 1e-3), "pretension": st.floats(0.0, 5.0)}
                tendon = st.fixed_dictionaries(place, optional=more | {"unilateral": st.booleans()})
                segment["tendons"] = draw(st.lists(tendon, min_size=1, max_size=4))
            table["segment"].append(segment)
    for name in draw(st.lists(st.sampled_from(sorted(SECTIONS)), unique=True, max_size=3)):
        table[name] = copy.deepcopy(SECTIONS[name])
    return table


def _places(node: Any) -> list[tuple[Any, Any]]:
    """Every (container, key) below a node."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [place for key, value in items for place in [(node, key), *_places(value)]]


KEYS = "name segment lenght length tendons offset mode youngs_modulus second_moment gravity points sd"

keys = st.sampled_from([*KEYS.split(), "", "é", "half_width"]) | odd_words
CHANGES = "put put number number drop add rename wrap empty twice"


@st.composite
def mutated_tables(draw: st.DrawFn) -> dict[str, Any]:
    """A robot's tables with up to three things changed."""
    table = draw(good_tables())
    for _ in range(draw(st.integers(0, 3))):
        places = _places(table)
        if not places:
            break
        node, key = places[draw(st.integers(0, len(places) - 1))]
        match draw(st.sampled_from(CHANGES.split())):
            case "put":
                node[key] = draw(odd_values)
            case "number":
                node[key] = draw(odd_numbers)
            case "drop":
                del node[key]
            case "add" if isinstance(node, dict):
                node[draw(keys)] = draw(odd_values)
            case "rename" if isinstance(node, dict):
                node[draw(keys)] = node.pop(key)
            case "wrap":
                node[key] = [node[key]]
            case "empty":
                node[key] = draw(st.sampled_from([[], {}, ""]))
            case "twice" if isinstance(node, list):
                node.append(copy.deepcopy(node[key]))
            case _:
                pass
    return table


def written(table: dict[str, Any]) -> str:
    """The TOML text of a table."""
    return tomli_w.dumps(table)


ODD_BYTES = [b'"""', b"[[", b"]", b"\r\n", b"\xef\xbb\xbf", b"=", b"nan", b"-inf", b",", b'"']


@st.composite
def broken_texts(draw: st.DrawFn, text: str) -> bytes:
    """A text cut, doubled, with bytes put in and taken out."""
    raw = text.encode()
    for _ in range(draw(st.integers(1, 3))):
        start, end = sorted((draw(st.integers(0, len(raw))), draw(st.integers(0, len(raw)))))
        match draw(st.sampled_from(["cut", "without", "double", "insert", "byte"])):
            case "cut":
                raw = raw[:end]
            case "without":
                raw = raw[:start] + raw[min(end, start + 40) :]
            case "double":
                raw = raw[:end] + raw[start:]
            case "insert":
                raw = raw[:start] + draw(st.binary(max_size=8) | st.sampled_from(ODD_BYTES)) + raw[start:]
            case "byte" if raw:
                at = min(start, len(raw) - 1)
                raw = raw[:at] + bytes([draw(st.integers(0, 255))]) + raw[at + 1 :]
            case _:
                pass
    return raw
