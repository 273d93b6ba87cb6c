"""The paper's class on fastrod's model: bad input gets one sentence, and leaves nothing behind."""

import math
from typing import Any

import pytest
from refusals import refusals

from fastrod.errors import HostError, InputError
from fastrod.hosts import SoftManiSim

pytest.importorskip("pybullet", reason="pybullet is not installed: pip install 'fastrod[hosts]'")


@pytest.fixture(scope="module")
def one() -> SoftManiSim:
    return SoftManiSim(number_of_sphere=6)


def moved(*given: Any, **base: Any) -> Any:
    return lambda s: s.move_robot_ori(*given, **base)


def cube(*turn_and_size: Any, **options: Any) -> Any:
    return lambda s: s.add_a_cube([0, 0, 0], *turn_and_size, **options)


def made(**options: Any) -> Any:
    return lambda s: SoftManiSim(s.bullet, **options)


BAD_INPUT = {
    "action is .* it must be 9 numbers": moved([0.0] * 8),
    "action is .* must be finite": lambda s: s.calc_tip_pos([math.nan] * 9),
    "displacements of segment 1 .* at most 0.02356 m": moved([0, 0.03, 0] * 3),
    "extension of segment 3 is 0.2 m; its range is": moved([0] * 6 + [0.2, 0, 0]),
    "base_pos is .* it must be 3 numbers": moved(base_pos=[0, 0]),
    "base_orin is .* norm 1.41421; it must be 1, as x y z w": lambda s: s.calc_tip_pos(
        base_orin=[1, 1, 0, 0]
    ),
    "create_robot.. first puts it": lambda s: (s.move_robot_ori(), s.move_robot_ori(base_pos=[1e3, 0, 0])),
    "^.*must be a fraction from 0": lambda s: s.set_grasp_width(-0.1),
    "must be a fraction from 0": lambda s: s.set_grasp_width(math.nan),
    "three edge lengths must be positive": cube(size=[0.1, 0.1, 0]),
    "ori is .* The size comes third": cube([0.3, 0.03, 0.03]),
    "ori is .* norm 0; it must be 1": cube(ori=[0, 0, 0, 0]),
    "mass is -1 kg; it must be a number, zero or positive": cube(mass=-1),
    "sec is -1.0 s; it must be a number, zero or positive": lambda s: s.wait(-1.0),
    "sec is nan s; it must be a number, zero or positive": lambda s: s.wait(math.nan),
    "number_of_sphere is 1; it must be a whole number, at least 2": made(number_of_sphere=1),
    "body_sphere_radius is 0.0 m; it must be a number, positive": made(body_sphere_radius=0.0),
}
NOT_THERE = {
    "no body 999": lambda s: s.is_robot_in_contact(999),
    "^.*no body 999": lambda s: s.is_tip_in_contact(999),
    "max_grasp_width is -1.0 m": made(max_grasp_width=-1.0),
    "PyBullet has no world 1023": lambda s: SoftManiSim(1023),
}


@refusals({InputError: BAD_INPUT, HostError: NOT_THERE})
def test_bad_input_gets_one_sentence(one, error, sentence, call):
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
