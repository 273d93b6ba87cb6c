"""Errors of devices, as exceptions of fastrod."""

from __future__ import annotations

from fastrod.errors import FastrodError, InputError


class DeviceError(FastrodError, RuntimeError):
    """A drive, a bus or a camera that is not there, does not answer, or cannot do what is asked."""


class CalibrationError(FastrodError, ValueError):
    """Views that do not determine a camera or where it stands."""


class RefusedError(InputError):
    """A command that was refused before it reached the bus: beyond a limit, not finite, too late, or to a
    robot that is stopped."""
