"""Residence of arrays on the device: no copy of the memory is stale, and a steady step moves what it must
alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gpu.pairs import assert_same, assert_same_memory, chain, inputs, pair
from numpy.testing import assert_allclose, assert_array_equal
from rods import rod

from fastrod import Simulator
from fastrod.contact import ContactScene, sphere
from fastrod.errors import InputError
from fastrod.solver.gpu.resident import FIELDS, Resident


def test_a_steady_step_fetches_no_memory_and_sends_what_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fastrod.solver.gpu.runner._SMALL", 64)  # as if the batch were large
    sim = Simulator(rod(), n_robots=3, points_per_segment=2, outputs="tip", device="cuda")
    lengths = np.tile(rod().rest_tendon_length, (3, 1))
    sim.step(lengths)
    sim.step(1.0001 * lengths)
    fetched: list[set[str]] = []
    read = Resident.read
    monkeypatch.setattr(
        Resident, "read", lambda self, fields=FIELDS: fetched.append(set(fields)) or read(self, fields)
    )
    runner = sim._rods.passes._runner
    assert runner is not None
    sent, brought = runner.sent_bytes, runner.fetched_bytes
    sim.step(1.0002 * lengths)
    assert fetched == []
    assert runner.sent_bytes - sent == lengths.nbytes
    assert runner.fetched_bytes - brought == 3 * 8 * (3 + 9 + 1)


def test_snapshot_and_restore_bring_the_same_step_again() -> None:
    _, sim = pair(rod())
    sim.settle(**inputs(rod(), 0))
    sim.step(**inputs(rod(), 1))
    here = sim.snapshot()
    first = sim.step(**inputs(rod(), 2))
    sim.step(**inputs(rod(), 3))
    sim.restore(here)
    again = sim.step(**inputs(rod(), 2))
    assert_array_equal(again.position, first.position)
    assert_array_equal(again.residual, first.residual)


def test_restored_rows_alone_go_back() -> None:
    here, there = pair(chain())
    for sim in (here, there):
        sim.settle(**inputs(chain(), 0))
        kept = sim.snapshot()
        sim.step(**inputs(chain(), 1))
        sim.step(**inputs(chain(), 2))
        sim.restore(kept, [1])
    assert_same_memory(here, there)
    a, b = (sim.step(**inputs(chain(), 3)) for sim in (here, there))
    assert_same(a, b)
    assert b.ok.all()


def test_reset_and_replaced_rows_begin_cold() -> None:
    robots = [rod(), rod(), rod()]
    here, there = pair(robots, None)
    for sim in (here, there):
        sim.settle(**inputs(rod(), 0))
        sim.step(**inputs(rod(), 1))
        sim.replace([2], [rod(bending_stiffness=(0.004, 0.005))])
        sim.reset([0])
    for k in (1, 2):
        a, b = (sim.step(**inputs(rod(), k)) for sim in (here, there))
        assert_same(a, b)
        assert b.ok.all()


def test_a_memory_that_the_host_wrote_into_is_the_newer_one() -> None:
    here, there = pair(rod())
    for sim in (here, there):
        sim.settle(**inputs(rod(), 0))
        sim._rods.passes.memory.x[1] *= 1.001
    assert_same(*(sim.step(**inputs(rod(), 0)) for sim in (here, there)))
    assert np.abs(there.state.residual[1]) > 1e-9


def test_outputs_full_and_tip_agree() -> None:
    (_, full), (_, tip) = pair(rod()), pair(rod(), outputs="tip")
    for k in range(3):
        a, b = (sim.step(**inputs(rod(), k)) for sim in (full, tip))
    assert_allclose(b.tip_position, a.tip_position, atol=1e-15)
    assert b.position.size == 0
    assert_array_equal(a.position[:, -1], a.tip_position)


def test_rods_that_feel_contact_are_refused() -> None:
    robot = replace(rod(), segments=tuple(replace(s, body_radius=0.01) for s in rod().segments))
    scene = ContactScene(obstacles=[sphere(0.01, name="ball", position=(0.05, 0.0, 0.05))])
    with pytest.raises(InputError, match="contact was given with device 'cuda', where rods feel none"):
        Simulator(robot, contact=scene, device="cuda")
    sims = pair(robot, 1, contact=scene, feel_contact=False)
    assert_same(*(sim.settle(robot.rest_tendon_length) for sim in sims))
    assert_allclose(sims[1].clearance(), sims[0].clearance(), atol=1e-12)
