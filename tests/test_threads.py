"""Threads do not fight: BLAS has one while fastrod works, and no thread spins while it waits."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from threadpoolctl import ThreadpoolController, threadpool_limits

import fastrod
from fastrod.kernels.batch import pass_robots
from fastrod.solver import boundary
from fastrod.threads import FEW, one_blas_thread
from fastrod_envs.vector import BatchEnv

BLAS = [lib for lib in ThreadpoolController().lib_controllers if lib.user_api == "blas"]


def counts() -> list[int]:
    return [lib.num_threads for lib in BLAS]


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    """Set two threads, as on a machine with two cores, whatever this one has."""
    with threadpool_limits(2, "blas"):
        yield


def test_blas_has_one_thread_inside_and_its_own_after() -> None:
    @one_blas_thread
    def inner() -> list[int]:
        return counts()

    @one_blas_thread
    def outer(fail: bool) -> list[int]:
        within = [*inner(), *counts()]  # held on by the outer call once the inner one is left
        if fail:
            raise ZeroDivisionError
        return within

    assert outer(False) == [1] * 2 * len(BLAS)
    assert counts() == [2] * len(BLAS)
    with pytest.raises(ZeroDivisionError):
        outer(True)
    assert counts() == [2] * len(BLAS)


@pytest.mark.parametrize("more", [0, 1])
def test_a_simulator_and_an_environment_hold_it(more: int) -> None:
    """Not a simulator of a few robots: its products are too small for several threads."""
    robot, env, seen = fastrod.load_robot("prototype"), BatchEnv("Reach", FEW + 1), list[list[int]]()
    sim = fastrod.Simulator(robot, FEW + more, points_per_segment=2)
    for target, name in ((sim._rods.passes, "run"), (env.task, "act")):
        inner = getattr(target, name)
        setattr(target, name, lambda *a, inner=inner, **k: (seen.append(counts()), inner(*a, **k))[1])
    sim.step(robot.rest_tendon_length)
    assert {n for each in seen for n in each} == {2 - more}
    seen.clear()
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))
    assert {n for each in seen for n in each} == {1}
    assert counts() == [2] * len(BLAS)


@pytest.mark.skipif(sys.platform != "linux", reason="the variable is printed by GNU's OpenMP")
def test_threads_of_the_kernels_sleep_while_they_wait() -> None:
    script = "import os, fastrod.kernels.jit; print(os.environ.get('OMP_WAIT_POLICY'))"
    kept = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=kept | {"OMP_DISPLAY_ENV": "true"},
        check=True,
        capture_output=True,
        text=True,
    )
    assert "OMP_WAIT_POLICY = 'PASSIVE'" in done.stderr
    assert done.stdout == "None\n"  # a user's other programs are left alone


@pytest.mark.study
def test_no_kernel_writes_what_two_of_its_arrays_reach() -> None:
    """Or `noalias` would be wrong; of the watched calls one does so on purpose."""
    script = [sys.executable, str(Path(__file__).with_name("overlap.py"))]
    plain = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    done = subprocess.run(script, env=plain, check=True, capture_output=True, text=True)
    ran, found = done.stdout.split(" ", 1)
    assert int(ran) > 190
    assert found == "['__main__.shift(to: Any, by: Any) -> None']\n"


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="this machine has one core")
def test_the_loop_over_threads_refuses_what_its_kernel_was_not_compiled_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It calls by address: an array of another layout would be read as what it is not."""
    robot, taken = fastrod.load_robot("prototype"), list[tuple[Any, ...]]()
    monkeypatch.setattr(boundary, "pass_robots", lambda *given: (taken.append(given), pass_robots(*given)))
    fastrod.Simulator(robot, 128, points_per_segment=2, threads=2).step(robot.rest_tendon_length)
    n_tasks, run, *others = taken[-1]
    assert n_tasks == 2
    with pytest.raises(TypeError):
        pass_robots(2, run._replace(robots=np.arange(256)[::2]), *others)
