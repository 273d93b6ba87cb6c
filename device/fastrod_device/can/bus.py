"""Buses by name: `INTERFACE:CHANNEL`, from a virtual one in this process to the adapter on the bench."""

from __future__ import annotations

import importlib
import logging
import threading
import time
from typing import TYPE_CHECKING, Any, final

from fastrod.errors import nearest
from fastrod_device.errors import DeviceError

if TYPE_CHECKING:
    import can

_NOTIFIER_CYCLE = 0.05  # s; how long closing may take, no more


def guest(name: str, needs: str = "the CAN bus") -> Any:
    """A module of the device's libraries, which `needs` needs.

    Raises `DeviceError` where it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise DeviceError(
            f"{needs} needs {name.split('.')[0]}: pip install 'fastrod[device]' ({error})."
        ) from error


def open_bus(name: str, bitrate: int = 1_000_000) -> can.BusABC:
    """A bus, opened.

    `socketcan:can0`, `pcan:PCAN_USBBUS1`, `kvaser:0`, ...: adapters, at `bitrate` [bit/s]. `virtual:NAME`:
    inside this process.
    `udp_multicast:239.74.163.2` or `udp_multicast:239.74.163.2:PORT`: between processes.

    Raises `DeviceError`: no such interface (with the nearest name), no channel, driver or adapter missing.
    """
    library = guest("can")
    interface, _, channel = name.partition(":") if isinstance(name, str) else ("", "", "")
    known = sorted(library.VALID_INTERFACES)
    if interface not in known:
        raise DeviceError(
            f"no CAN interface {interface!r} in the bus name {name!r}; {nearest(interface, known)}"
        )
    if not channel:
        raise DeviceError(
            f"the bus name {name!r} lacks its channel; write INTERFACE:CHANNEL, such as socketcan:can0."
        )
    options: dict[str, Any] = {"channel": channel, "bitrate": bitrate}
    if interface == "virtual":
        options = {"channel": channel}
    elif interface == "udp_multicast":
        group, _, port = channel.partition(":") if channel.count(":") == 1 else (channel, "", "")
        options = {"channel": group, "fd": False}
        if port:
            if not port.isdecimal() or not 0 < int(port) < 65536:
                raise DeviceError(
                    f"the bus name {name!r} has the port {port!r}; it must be a whole number from 1 to 65535."
                )
            options["port"] = int(port)
    elif channel.isdecimal() and interface in (
        "kvaser",
        "ixxat",
        "vector",
        "neovi",
        "systec",
        "cantact",
        "canalystii",
        "iscan",
    ):
        options["channel"] = int(channel)
    try:
        bus: can.BusABC = library.Bus(interface=interface, ignore_config=True, **options)
    except library.CanInterfaceNotImplementedError as error:
        raise DeviceError(
            f"the driver of the CAN interface {interface!r} is not installed: {_plain(error)}."
        ) from error
    except (
        library.CanError,
        OSError,
        ValueError,
        TypeError,
        NameError,
        AttributeError,
    ) as error:  # vendors' libraries raise what they like
        raise DeviceError(
            f"the bus {name!r} cannot be opened: {_plain(error)}. Is the adapter plugged in "
            "and its channel up?"
        ) from error
    return bus


def _plain(error: Exception) -> str:
    return str(error).rstrip(".")


@final
class BusLine:
    """One bus with the thread that listens to it: a canopen network whose frames are also sent raw.

    Frames that come are handed to what was subscribed at `network`. A receiver that fails does not end:
    `trouble` says why.
    """

    def __init__(self, bus: str | can.BusABC, bitrate: int = 1_000_000) -> None:
        """`bus`: a name, then opened here and shut by `close`, or a bus that stays the caller's."""
        library, canopen = guest("can"), guest("canopen")
        for name in ("can", "canopen"):
            # their complaints come as our exceptions
            logging.getLogger(name).addHandler(logging.NullHandler())
        self._own = isinstance(bus, str)
        self.bus: Any = open_bus(bus, bitrate) if isinstance(bus, str) else bus
        self.error: type[Exception] = library.CanError
        self._message: Any = library.Message
        self.trouble = ""
        multicast = "udp_multicast" in type(self.bus).__module__
        self.echoes: bool = getattr(self.bus, "receive_own_messages", multicast)
        """It hears its own frames, as udp_multicast does."""
        line = self

        class Errors(library.Listener):  # type: ignore[misc,name-defined]
            def on_message_received(self, msg: Any) -> None:
                pass

            def on_error(self, exc: Exception) -> None:
                line.trouble = f"the bus cannot be read: {exc}"
                time.sleep(_NOTIFIER_CYCLE)  # the receiver tries again at once otherwise

        self.network: Any = canopen.Network(self.bus)
        self.network.NOTIFIER_CYCLE = _NOTIFIER_CYCLE
        self.network.listeners.append(Errors())
        self.lock = self.network.send_lock = threading.RLock()
        """Held while frames are sent that belong together."""

    def start(self) -> None:
        """Begin to listen; what is to be heard is subscribed before."""
        self.network.connect()

    def send(self, cob_id: int, data: bytes) -> None:
        """One frame, now. Raises `can.CanError` where the adapter cannot."""
        message = self._message(arbitration_id=cob_id, is_extended_id=False, data=data)
        with self.lock:
            self.bus.send(message)

    def close(self) -> None:
        """Stop listening; shut the bus if it was opened here."""
        if self.network.notifier is not None:
            self.network.notifier.stop(1.0)
        if self._own:
            self.bus.shutdown()
