"""Limits of the rod's state are reported for the robots that show them, and for no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from identification.logs import log_of, one_segment
from rods import rod

from fastrod import load_robot
from fastrod.identification.log.samples import LogSamples, sample
from fastrod.identification.report.assemble import rings, shears
from fastrod.model.robot import Lump


def moving(rate: float) -> LogSamples:
    robot = one_segment()
    return sample(log_of(robot, np.zeros((20, 4)), 1.0 / rate))


def test_a_thick_beam_shears() -> None:
    """The closed form: over bending, 3 EI / (k G A l^2) of a round rod with E = 3 G and k = 0.9 is 2.5 (r /
    l)^2; of the library 2.65."""
    robot = load_robot("ethz_beam")
    (said,) = shears(robot)
    (segment,) = robot.segments
    assert f"{robot.length / (2.0 * segment.body_radius):.1f} times as long as thick" in said
    fraction = 9.0 / (4.0 * 0.9) * (segment.body_radius / robot.length) ** 2
    reported = float(said.split("may be ")[1].split(" %")[0]) / 100.0
    assert reported == pytest.approx(fraction, rel=0.1, abs=0.006)  # reported in whole percents


def test_a_slender_weightless_rod_has_no_rings() -> None:
    slender = rod(body_radius=0.004, offset=0.003)
    assert shears(slender) + rings(slender, moving(100.0)) == []


def test_thickness_is_said_from_three_percent() -> None:
    def said(ratio: float) -> bool:
        return bool(shears(rod(body_radius=0.07 * ratio, offset=0.003)))

    assert not said(0.10)
    assert said(0.11)


def test_a_slow_heavy_robot_rings() -> None:
    """A cantilever's first frequency, 1.875^2 / 2 pi sqrt(EI / (m l^3)), m the whole mass."""
    slow = rod(body_radius=0.004, offset=0.003, line_density=2.0, length=0.3)
    (said,) = rings(slow, moving(30.0))
    expected = 1.8751**2 / (2.0 * np.pi) * np.sqrt(0.0022 / (2.0 * 0.3 * 0.3**3))
    assert f"{expected:.1f} Hz" in said
    assert "--dynamics" in said
    (said,) = rings(rod(length=0.3, lumps=(Lump(at=0.3, mass=0.2),)), moving(30.0))
    assert f"{np.sqrt(3.0 * 0.0022 / (0.2 * 0.3**3)) / (2.0 * np.pi):.1f} Hz" in said
    stiff = replace(slow, segments=tuple(replace(s, bending_stiffness=(100.0, 100.0)) for s in slow.segments))
    assert rings(stiff, moving(1000.0)) == []


def test_ringing_is_said_only_where_the_log_could_show_it() -> None:
    slow = rod(body_radius=0.004, offset=0.003, line_density=2.0, length=0.3)
    assert rings(slow, moving(0.2)) == []


def test_a_robot_of_several_segments_is_as_thick_as_its_whole_length_allows() -> None:
    short = rod(body_radius=0.01, offset=0.003)
    assert shears(short)
    assert shears(replace(short, segments=short.segments * 2)) == []
