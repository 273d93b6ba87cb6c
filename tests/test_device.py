"""Which device a simulator may ask for, and that the real CUDA compiler takes the kernels."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numba
import pytest
from numba import cuda
from rods import rod

from fastrod import Simulator
from fastrod.errors import InputError, UnknownNameError
from fastrod_envs.vector import BatchEnv


def test_an_unknown_device_is_answered_with_the_near_one() -> None:
    with pytest.raises(UnknownNameError, match="no device 'coda'; did you mean 'cuda'"):
        Simulator(rod(), device="coda")
    with pytest.raises(UnknownNameError, match="no device 'GPU'; did you mean 'cuda'"):
        BatchEnv("Reach", 2, device="GPU")


def test_a_machine_without_a_gpu_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="device is 'cuda', but numba finds no CUDA GPU here; install"):
        Simulator(rod(), device="cuda")
    with pytest.raises(InputError, match="finds no CUDA GPU"):
        BatchEnv("Reach", 2, device="cuda")


def test_numbas_own_cuda_is_not_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "is_available", lambda: True)
    monkeypatch.setattr(cuda, "implementation", "Built-in")
    monkeypatch.setattr(numba.config, "ENABLE_CUDASIM", 0)
    with pytest.raises(
        InputError,
        match=r"the numba\.cuda within numba cannot compile the kernels; install "
        r".* fastrod\[cuda\]",
    ):
        Simulator(rod(), device="cuda")


def test_a_numba_without_cuda_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "numba.cuda", None)
    monkeypatch.delattr("numba.cuda", raising=False)
    with pytest.raises(
        InputError,
        match=r"numba has no numba\.cuda here; install NVIDIA's driver and "
        r"fastrod\[cuda\]",
    ):
        Simulator(rod(), device="cuda")


@pytest.mark.parametrize("name", ["TubeInsert", "Push"])
def test_tasks_with_contact_need_the_cpu(name: str) -> None:
    with pytest.raises(
        InputError, match=f"device is 'cuda'; {name} has contact or a host's bodies, which need device 'cpu'"
    ):
        BatchEnv(name, 2, device="cuda")


COMPILE = """
from types import SimpleNamespace
import numba
import numba.cuda.dispatcher
from numba import cuda
numba.cuda.dispatcher.get_current_device = lambda: SimpleNamespace(compute_capability=(9, 0))
import numpy as np
from fastrod import Simulator, load_robot
from fastrod.solver.gpu import batch
from fastrod.solver.inputs import Inputs
from fastrod.types import Response
robot = load_robot("prototype")
sim = Simulator(robot, outputs="tip")
passes = sim._rods.passes
ports, rows = sim._reader.ports(Inputs(robot.rest_tendon_length)), np.arange(1)
none = Response(np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))
shape = sim._rods.new_shape("tip", False)
held = passes.layout, passes.memory, shape, none
arguments = (rows, passes.params, ports, *held, 7, True, False, True, 1.0, 1.0)
size = batch.room(4, passes.n_x, 7, passes.n_residuals(ports))
for kernel, given in (
    (batch.pass_robots(size), arguments),
    (batch.move_to_inputs, (rows, ports, passes.params, passes.memory, passes.layout)),
    (batch.all_finite, (passes.memory.x, np.ones(1, bool))),
    (batch.put_rows, (rows, passes.memory.gain.reshape(1, -1), passes.memory.gain.reshape(1, -1))),
):
    ptx, _ = cuda.compile_ptx(kernel.py_func, tuple(numba.typeof(a) for a in given), cc=(9, 0))
    assert ".entry" in ptx and "call" not in ptx
    print(kernel.py_func.__name__)
"""


@pytest.mark.skipif(
    find_spec("numba_cuda") is None, reason="the CUDA compiler is not here: pip install fastrod[cuda]"
)
def test_the_cuda_compiler_takes_the_kernels() -> None:
    done = subprocess.run([sys.executable, "-c", COMPILE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == ["run", "_move", "_all_finite", "_put_rows"]


@pytest.mark.study
def test_the_benchmark_says_what_it_can(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1] / "perf"))
    import bench_cuda

    assert bench_cuda.main(["--quick", "--json"]) == 0
    table = json.loads(capsys.readouterr().out)["sections"]["work"]
    assert "No time was measured: device is 'cuda', but numba finds no CUDA GPU here" in table["notes"][0]
    assert [row["robot"] for row in table["rows"]] == ["prototype", "reacher"]
    assert all(row["moved_bytes"] > 500.0 and row["operations"] > 1e4 for row in table["rows"])


def test_the_second_name_is_the_same_source() -> None:
    from importlib import import_module

    import fastrod.kernels.jit
    import fastrod.kernels.rod.chunk

    twin: Any = import_module("fastrod.solver.gpu.kernels.rod.chunk")
    assert twin.__file__ == fastrod.kernels.rod.chunk.__file__
    assert twin.W == 1
    assert fastrod.kernels.rod.chunk.W == fastrod.kernels.jit.LANES
    assert twin.sh.__name__ == "fastrod.solver.gpu.kernels.rod.shape"
