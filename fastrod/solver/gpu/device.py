"""Whether there is a GPU to work on."""

from __future__ import annotations

from typing import Any, Literal, TypeAlias, cast

import numba

from fastrod.errors import InputError, UnknownNameError, nearest

Device: TypeAlias = Literal["cpu", "cuda"]
_config: Any = numba.config
DEVICES = ("cpu", "cuda")
_HELP = "install NVIDIA's driver and fastrod[cuda], or leave device='cpu'."


def checked_name(name: object) -> Device:
    """The device of this name. Raises `UnknownNameError` with the nearest."""
    if not isinstance(name, str) or name not in DEVICES:
        raise UnknownNameError(
            f"no device {name!r}; {nearest(str(name).lower().replace('gpu', 'cuda'), DEVICES)}"
        )
    return cast(Device, name)


def checked(name: object) -> Device:
    """The device of this name, which is there. Raises `UnknownNameError`, and `InputError` where there is no
    GPU."""
    device = checked_name(name)
    if device == "cuda":
        try:
            from numba import cuda as found
        except ImportError as error:
            raise InputError(f"device is 'cuda', but numba has no numba.cuda here; {_HELP}") from error
        cuda: Any = found
        if not cuda.is_available():
            raise InputError(f"device is 'cuda', but numba finds no CUDA GPU here; {_HELP}")
        if cuda.implementation == "Built-in" and not _config.ENABLE_CUDASIM:
            raise InputError(
                f"device is 'cuda', but the numba.cuda within numba cannot compile the kernels; {_HELP}"
            )
    return device
