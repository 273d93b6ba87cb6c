"""PyBullet worlds: one client each, several in one process."""

from __future__ import annotations

import functools
import os
import sys
import weakref
from collections.abc import Callable
from contextlib import suppress
from types import ModuleType
from typing import Any

import numpy as np

from fastrod.checks import Bound, check_number
from fastrod.errors import HostError, InputError, nearest
from fastrod.types import Floats


def pybullet() -> Any:
    """The module, imported on first use; `HostError` says how to get it."""
    try:
        import pybullet as module
    except ImportError as error:
        raise HostError("PyBullet is not installed; pip install 'fastrod[hosts]' brings it.") from error
    return module


class Connection:
    """A connection to PyBullet. The number of one that has ended goes to another world in time: whoever had
    it before is to get no answer."""

    def __init__(self, number: int, client: Any = None) -> None:
        if number in _KNOWN:
            _KNOWN[number].lose()
        self.number, self.client = number, client
        self.handle = number
        """physicsClientId; -1, which no world has, once this one has ended."""
        self.own: weakref.finalize[[int], Connection] | None = None
        """For a world of ours, what ends it."""
        _KNOWN[number] = self

    @classmethod
    def of(cls, number: int, client: Any) -> Connection:
        """The connection that has this number now."""
        known = _KNOWN.get(number)
        if known is None or known.handle < 0:
            return cls(number, client)
        another = client is not None and client is not known.client
        return cls(number, client) if another and (known.client or known.own) else known

    def lose(self) -> None:
        """It has ended."""
        self.handle = -1
        if self.own is not None:
            self.own.detach()


_KNOWN: weakref.WeakValueDictionary[int, Connection] = weakref.WeakValueDictionary()
"""Connections by their numbers."""


class Bullet:
    """One PyBullet world: every function of the module, called with this world's physicsClientId.

    Takes what a user has: a client's number, the module itself, a `BulletClient`, another `Bullet`.
    `HostError` where no world answers, be it that its number has been given to another one since.
    """

    def __init__(self, bullet: Any) -> None:
        client = None if isinstance(bullet, (int, ModuleType, Bullet)) else bullet
        if isinstance(bullet, ModuleType) and bullet.__name__ == "pybullet":
            bullet = 0
        number = bullet.number if isinstance(bullet, Bullet) else getattr(bullet, "_client", bullet)
        if isinstance(number, bool) or not isinstance(number, int):
            raise HostError(
                f"bullet is {bullet!r}; give a physicsClientId, the pybullet module or a "
                "BulletClient that is connected."
            )
        self.number: int = number
        """physicsClientId."""
        self.connection: Connection = (
            bullet.connection if isinstance(bullet, Bullet) else Connection.of(number, client)
        )
        if not self.isConnected():
            raise HostError(
                f"PyBullet has no world {number}; connect first, for example with fastrod.hosts.connect()."
            )

    def __getattr__(self, name: str) -> Any:
        module = pybullet()
        try:
            value = getattr(module, name)
        except AttributeError:
            raise AttributeError(f"PyBullet has no {name!r}; {nearest(name, dir(module))}") from None
        if callable(value):
            value = _bound(self.connection, value, module)
        self.__dict__[name] = value  # read once
        return value

    def disconnect(self) -> None:
        """End this world. `HostError` where it has ended before."""
        client_ends = getattr(self.connection.client, "disconnect", None)  # a client forgets its number, too
        (client_ends or _bound(self.connection, pybullet().disconnect, pybullet()))()
        self.connection.lose()

    @property
    def dt(self) -> float:
        """Time step of this world [s]."""
        return float(self.getPhysicsEngineParameters()["fixedTimeStep"])

    @property
    def gravity(self) -> Floats:
        """(3,) of this world [m/s^2]."""
        now = self.getPhysicsEngineParameters()
        return np.array([now[f"gravityAcceleration{axis}"] for axis in "XYZ"])

    def check(self, body: int, link: int = -1) -> None:
        """`HostError` where this world has no such body, or the body no such link."""
        known = {self.getBodyUniqueId(i) for i in range(self.getNumBodies())}
        if body not in known:
            raise HostError(f"this PyBullet world has no body {body!r}; it has {sorted(known) or 'none'}.")
        if not -1 <= link < (n := self.getNumJoints(body)):
            others = f"links are numbered from 0 to {n - 1}" if n else "it has no others"
            raise HostError(f"body {body} has no link {link!r}; -1 is its base, {others}.")

    def link_named(self, body: int, name: str) -> int:
        """Number of the link of this name; `HostError` with the nearest one."""
        self.check(body)
        names = {self.getJointInfo(body, j)[12].decode(): j for j in range(self.getNumJoints(body))}
        names[self.getBodyInfo(body)[0].decode()] = -1
        if name not in names:
            raise HostError(f"body {body} has no link {name!r}; {nearest(name, names)}")
        return names[name]


def connect(
    *, gui: bool = False, dt: float = 0.005, gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)
) -> Bullet:
    """A new, empty world with time step `dt` [s] and `gravity` [m/s^2]; headless unless `gui`. It ends with
    the last `Bullet`, base or rod that refers to it.

    `HostError` for a GUI without a display: PyBullet itself would end the process. `InputError` on wrong
    numbers.
    """
    module = pybullet()
    check_number("dt", dt, Bound(above=0.0, below=1.0, unit="s"))
    if np.shape(gravity) != (3,) or not np.isfinite(gravity).all():
        raise InputError(
            f"gravity is {gravity!r}; give three numbers, world [m/s^2], for example (0, 0, -9.81)."
        )
    if gui and sys.platform.startswith("linux") and not os.environ.get("DISPLAY"):
        raise HostError(
            "PyBullet's GUI needs a display, and DISPLAY is not set; leave gui=False "
            "(headless), or start an X server."
        )
    number = module.connect(module.GUI if gui else module.DIRECT)
    if number < 0:
        raise HostError("PyBullet opened no world; a GUI can be open only once in a process.")
    connection = Connection(number)
    # who has no `Bullet` of it can ask it nothing, and it holds 30 MB
    connection.own = weakref.finalize(connection, _end, number)
    connection.own.atexit = False
    world = Bullet(number)
    world.setGravity(*gravity)
    world.setTimeStep(dt)
    return world


def _end(number: int) -> None:
    module = pybullet()
    with suppress(module.error):  # who disconnected it did not tell us
        module.disconnect(physicsClientId=number)


def _bound(connection: Connection, function: Callable[..., Any], module: Any) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(*args: Any, **options: Any) -> Any:
        try:
            return function(*args, physicsClientId=connection.handle, **options)
        except module.error as what:
            if not module.isConnected(physicsClientId=connection.handle):
                raise HostError(f"PyBullet's world {connection.number} has been disconnected.") from what
            raise HostError(
                f"PyBullet refused {function.__name__}: {str(what).rstrip('.')}; is the body still in the "
                "world?"
            ) from what

    return call
