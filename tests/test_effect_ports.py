"""Ports beside lengths and loads: an effect on them is what a user would give."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from rods import bend, rod

from fastrod import Robot, Simulator
from fastrod.effects import base
from fastrod.effects.base import Parameter, Seam, Static, effect
from fastrod.effects.ports import EffectPorts
from fastrod.rotation import product, quaternion_from_vector
from fastrod.types import Floats


class SheathLoss(Static):
    """Tensions reach the rod less the friction of a sheath.

    Equation: T -> T exp(-m)
    Source: capstan equation
    Residual signature: in proportion to the tension
    """

    seam = Seam.ACTUATION
    parameters = (Parameter("wrap", "", bounds=(0.0, 2.0), typical=0.2),)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.tension *= np.exp(-values)


class Loosening(Static):
    """Tendons lose pretension.

    Equation: T0 -> T0 - t
    Source: none
    Residual signature: stiffness in torsion
    """

    seam = Seam.ACTUATION
    parameters = (Parameter("lost", "N", bounds=(0.0, 2.0), typical=0.2),)

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        ports.pretension -= values


class Mount(Static):
    """The mount gives under what the rod's base pulled at it in the last step.

    Equation: base moves by c W
    Source: linear spring
    Residual signature: in proportion to the load
    """

    seam = Seam.LOAD
    parameters = (Parameter("shift", "m/N", bounds=(0.0, 1.0), typical=1e-3), Parameter("turn", "rad/(N m)"))

    def apply(self, values: Floats, memory: Floats, ports: EffectPorts, state: Any, dt: float) -> None:
        if state is not None:
            wrench = np.nan_to_num(state.base_wrench)
            ports.move_base(values[:, :1] * wrench[:, :3], values[:, 1:] * wrench[:, 3:])


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    base.load_library()
    for kind in (SheathLoss, Loosening, Mount):
        effect(kind)
    yield
    for name in ("sheath_loss", "loosening", "mount"):
        base.unregister(name)


def having(robot: Robot, **table: Any) -> Robot:
    return replace(robot, effects=(table,))


def same(one: Any, two: Any, atol: float = 0.0) -> None:
    for name in ("position", "rotation", "tension", "base_wrench"):
        assert_allclose(getattr(one, name), getattr(two, name), rtol=0.0, atol=atol, err_msg=name)


TENSION = np.array([1.0, 0.4, 0.2, 0.9])


def test_tensions_reach_the_rod_as_an_effect_leaves_them() -> None:
    robot = rod("tendon_tension")
    lossy = Simulator(having(robot, name="sheath_loss", wrap=0.5), n_robots=2)
    plain = Simulator(robot, n_robots=2)
    same(lossy.settle(tension=TENSION), plain.settle(tension=np.exp(-0.5) * TENSION))
    scale = np.append(np.full(4, np.exp(-0.5)), 1.0)  # tensions, then the extension
    assert_allclose(lossy.jacobian(), scale * plain.jacobian(), rtol=1e-6, atol=1e-7)
    neutral = Simulator(having(robot, name="sheath_loss"), n_robots=2)
    state, there = neutral.settle(tension=TENSION), plain.settle(tension=TENSION)
    same(state, there)
    assert_array_equal(neutral.jacobian(), plain.jacobian())


def test_a_bad_tension_spoils_one_robot() -> None:
    robot = rod("tendon_tension")
    sim, plain = Simulator(having(robot, name="sheath_loss"), n_robots=3), Simulator(robot, n_robots=3)
    given = np.tile(TENSION, (3, 1))
    given[1, 2] = np.inf
    assert sim.settle(tension=given).ok.tolist() == [True, False, True]
    plain.settle(tension=given)
    assert_array_equal(sim.jacobian()[[0, 2]], plain.jacobian()[[0, 2]])


def test_pretension_is_what_an_effect_leaves_of_it() -> None:
    def tight(tension: float) -> Robot:
        (segment,) = rod(compliance=1e-4).segments
        tendons = tuple(replace(tendon, pretension=tension) for tendon in segment.tendons)
        return Robot(name="tight", segments=(replace(segment, tendons=tendons),))

    lengths, moment = bend(tight(1.0), 0.4, 0.2), (0.0, 0.0, 1e-3)
    one = Simulator(having(tight(2.0), name="loosening", lost=1.5)).settle(lengths, tip_moment=moment)
    two = Simulator(tight(0.5)).settle(lengths, tip_moment=moment)
    same(one, two)
    assert np.abs(one.tension - Simulator(tight(2.0)).settle(lengths, tip_moment=moment).tension).min() > 1.0
    same(
        Simulator(having(tight(2.0), name="loosening")).settle(lengths, tip_moment=moment),
        Simulator(tight(2.0)).settle(lengths, tip_moment=moment),
    )


def test_a_mount_that_gives_is_a_base_that_moves() -> None:
    robot = rod()
    lengths, force = bend(robot, 0.5, -0.3), np.array([0.2, 0.1, -0.1])
    soft = Simulator(having(robot, name="mount", shift=1e-3, turn=0.5), dt=0.01)
    plain = Simulator(robot, dt=0.01)
    first = soft.settle(lengths, tip_force=force)
    same(first, plain.settle(lengths, tip_force=force))  # before it was pulled at, it gives nothing
    wrench = first.base_wrench[0]
    rotated = product(quaternion_from_vector(0.5 * wrench[3:]), np.eye(4)[0])
    pose = np.concatenate([1e-3 * wrench[:3], rotated])
    then = soft.settle(lengths, tip_force=force)
    same(then, plain.settle(lengths, tip_force=force, base_pose=pose), 1e-12)
    assert_allclose(then.position[0, 0], pose[:3], atol=1e-15)
    # a camera on the base goes with it
    assert_allclose(soft.measure().tip_position, plain.measure().tip_position, atol=1e-12)
    stiff, twin = (Simulator(r, dt=0.01) for r in (having(robot, name="mount"), robot))
    for _ in range(2):
        same(stiff.settle(lengths, tip_force=force), twin.settle(lengths, tip_force=force))
