"""`Runner`: passes on the GPU, for the arrays that `BoundarySolver` has on the host."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import cuda

from fastrod.kernels.rod.gather import Mode
from fastrod.solver.gpu.batch import all_finite, launch, move_to_inputs, pass_robots, room
from fastrod.solver.gpu.resident import Resident, fill
from fastrod.types import Flags, Floats, Ints, Layout, Params, Ports, Response, RodShape

_cuda: Any = cuda
# bytes: an array up to here is compared with what the device has, a larger one is the same if it is the same
# object
_SMALL = 4096
_BY_PREDICTION = ("x", "move", "defect", "length_before", "force_before")
_BY_UPDATE = ("x", "covariance", "gain", "defect", "length_before", "force_before")


class Runner:
    """Buffers on the device besides the memory: robots and ports as they were last given, and what the last
    passes wrote.

    Robots and ports are replaced, never changed in place; so an array that is the same object is not sent
    again.
    """

    def __init__(self) -> None:
        self._sent: dict[str, tuple[Any, Any]] = {}
        self._written: RodShape | None = None
        self._out: dict[str, Any] = {}
        self._touched: Flags | None = None
        self.sent_bytes = 0
        """Copied to the device so far."""
        self.fetched_bytes = 0
        """Copied back so far, the memory aside."""

    def run(
        self,
        rows: Ints,
        params: Params,
        ports: Ports,
        layout: Layout,
        memory: Resident,
        shape: RodShape,
        response: Response,
        mode: Mode,
    ) -> None:
        """One forward pass of these robots. What it writes of `shape` stays on the device until `collect`;
        `response` comes back."""
        there = memory.there()
        into = self._bind(shape, rows)
        answer: Any = (
            Response(*(_cuda.to_device(np.ascontiguousarray(a)) for a in response))
            if len(response.tip)
            else _NO_RESPONSE
        )
        n_e = len(layout.row_tendon) + (0 if layout.paper else 3) + (3 if len(ports.follower_force) else 0)
        kernel = pass_robots(room(len(layout.tendon_segment), there.x.shape[1], mode.n_col, n_e))
        given = self._all("params", params), self._all("ports", ports), self._all("layout", layout)
        launch(
            kernel,
            len(rows),
            self._send("rows", rows),
            *given,
            there,
            into,
            self._all("response", answer),
            mode,
        )
        written = {
            "curvature_guess",
            *(_BY_PREDICTION if mode.predict else ()),
            *(_BY_UPDATE if mode.update else ()),
        }
        memory.written_there(written)
        if len(response.tip):
            for host, device in zip(response, answer, strict=True):
                device.copy_to_host(host)

    def move_to_inputs(
        self, rows: Ints, params: Params, ports: Ports, layout: Layout, memory: Resident
    ) -> None:
        """`predict` of these robots, without a pass."""
        there = memory.there()
        arguments = (
            self._send("rows", rows),
            self._all("ports", ports),
            self._all("params", params),
            there,
            self._all("layout", layout),
        )
        launch(move_to_inputs, len(rows), *arguments)
        memory.written_there(_BY_PREDICTION)

    def finite(self, memory: Resident) -> Flags:
        """(n_robots,) the boundary is one."""
        x = memory.there().x
        found = _cuda.device_array(x.shape[0], np.bool_)
        launch(all_finite, x.shape[0], x, found)
        flags: Flags = found.copy_to_host()
        return flags

    def collect(self, shape: RodShape, only: str | None = None) -> None:
        """Bring what passes wrote into `shape`, or one field of it, to the host; rows that no pass wrote stay
        as they are there."""
        if self._written is not shape or self._touched is None:
            return
        every = bool(self._touched.all())
        for name in RodShape._fields if only is None else (only,):
            host: Floats = getattr(shape, name)
            if not host.size:
                continue
            self.fetched_bytes += host.nbytes
            if every and host.flags.c_contiguous:
                self._out[name].copy_to_host(host)
            else:
                host[self._touched] = self._out[name].copy_to_host()[self._touched]

    def _bind(self, shape: RodShape, rows: Ints) -> RodShape:
        """Room on the device for what passes write into this shape: that of the last one, where the sizes
        agree."""
        if self._written is not shape:
            for name, host in shape._asdict().items():
                if name not in self._out or self._out[name].shape != host.shape:
                    self._out[name] = _cuda.device_array(host.shape, np.float64)
            self._written, self._touched = shape, np.zeros(len(shape.residual), bool)
        if self._touched is not None:
            self._touched[rows] = True
        return RodShape(**self._out)

    def _all(self, group: str, arrays: Any) -> Any:
        return type(arrays)(*(self._send(f"{group}.{name}", a) for name, a in arrays._asdict().items()))

    def _send(self, key: str, array: Any) -> Any:
        """The array on the device, sent if what is there is another."""
        if not isinstance(array, np.ndarray):
            return array
        before, device = self._sent.get(key, (None, None))
        small = array.nbytes <= _SMALL
        if before is not None and (
            np.array_equal(before, array) and before.dtype == array.dtype if small else before is array
        ):
            return device
        if device is not None and device.shape == array.shape and device.dtype == array.dtype and array.size:
            fill(device, array)
        else:
            device = _cuda.to_device(np.ascontiguousarray(array))
        self.sent_bytes += array.nbytes
        self._sent[key] = (array.copy() if small else array, device)
        return device


_NO_RESPONSE = Response(np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty((0, 0)))
