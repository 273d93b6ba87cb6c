"""The paper's class on fastrod's model: bad input gets one sentence, and leaves nothing behind."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from fastrod.errors import HostError, InputError
from fastrod.hosts import SoftManiSim

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")

WRONG: list[tuple[str, Callable[[SoftManiSim], Any], type[Exception], str]] = [
    ("length", lambda s: s.move_robot_ori([0.0] * 8), InputError, "action is .* it must be 9 numbers"),
    ("nan", lambda s: s.calc_tip_pos([math.nan] * 9), InputError, "action is .* must be finite"),
    (
        "bend",
        lambda s: s.move_robot_ori([0, 0.03, 0] * 3),
        InputError,
        "displacements of segment 1 .* at most 0.02356 m",
    ),
    (
        "extension",
        lambda s: s.move_robot_ori([0] * 6 + [0.2, 0, 0]),
        InputError,
        "extension of segment 3 is 0.2 m; its range is",
    ),
    ("base", lambda s: s.move_robot_ori(base_pos=[0, 0]), InputError, "base_pos is .* it must be 3 numbers"),
    (
        "turn",
        lambda s: s.calc_tip_pos(base_orin=[1, 1, 0, 0]),
        InputError,
        "base_orin is .* norm 1.41421; it must be 1, as x y z w",
    ),
    (
        "far",
        lambda s: (s.move_robot_ori(), s.move_robot_ori(base_pos=[1e3, 0, 0])),
        InputError,
        "create_robot.. first puts it",
    ),
    ("body", lambda s: s.is_robot_in_contact(999), HostError, "no body 999"),
    ("tip body", lambda s: s.is_tip_in_contact(999), HostError, "no body 999"),
    ("width", lambda s: s.set_grasp_width(-0.1), InputError, "must be a fraction from 0"),
    ("width nan", lambda s: s.set_grasp_width(math.nan), InputError, "must be a fraction from 0"),
    (
        "cube",
        lambda s: s.add_a_cube([0, 0, 0], size=[0.1, 0.1, 0]),
        InputError,
        "three edge lengths must be positive",
    ),
    (
        "cube size in the place of its turn",
        lambda s: s.add_a_cube([0, 0, 0], [0.3, 0.03, 0.03]),
        InputError,
        "ori is .* The size comes third",
    ),
    (
        "cube turn",
        lambda s: s.add_a_cube([0, 0, 0], ori=[0, 0, 0, 0]),
        InputError,
        "ori is .* norm 0; it must be 1",
    ),
    (
        "mass",
        lambda s: s.add_a_cube([0, 0, 0], mass=-1),
        InputError,
        "mass is -1 kg; it must be zero or positive",
    ),
    ("wait", lambda s: s.wait(-1.0), InputError, "sec is -1.0; it must be a time"),
    ("wait nan", lambda s: s.wait(math.nan), InputError, "sec is nan; it must be a time"),
    (
        "points",
        lambda s: SoftManiSim(s.bullet, number_of_sphere=1),
        InputError,
        "number_of_sphere is 1; it must be a whole number, at least 2",
    ),
    (
        "radius",
        lambda s: SoftManiSim(s.bullet, body_sphere_radius=0.0),
        InputError,
        "body_sphere_radius is 0.0 m; it must be positive",
    ),
    (
        "fingers",
        lambda s: SoftManiSim(s.bullet, max_grasp_width=-1.0),
        HostError,
        "max_grasp_width is -1.0 m",
    ),
    ("no world", lambda s: SoftManiSim(1023), HostError, "PyBullet has no world 1023"),
]


@pytest.fixture(scope="module")
def one() -> Iterator[SoftManiSim]:
    sim = SoftManiSim(number_of_sphere=6)
    yield sim
    sim.close()


@pytest.mark.parametrize(("call", "error", "sentence"), [w[1:] for w in WRONG], ids=[w[0] for w in WRONG])
def test_bad_input_gets_one_sentence(one, call, error, sentence):
    count = one.bullet.getNumBodies() - (one._marker is not None)
    with pytest.raises(error, match=sentence) as caught:
        call(one)
    assert "\n" not in str(caught.value)
    assert one.bullet.getNumBodies() - (one._marker is not None) == count


def test_a_gui_needs_a_display(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(HostError, match="GUI needs a display"):
        SoftManiSim(gui=True)


def test_a_robot_without_fingers_has_no_grasp_width() -> None:
    sim = SoftManiSim(max_grasp_width=0.0, number_of_sphere=4)
    with pytest.raises(HostError, match="no fingers"):
        sim.set_grasp_width(1.0)
    sim.close()
    assert not sim.bullet.isConnected()
