"""`RawPage`: a page of the viewer without a browser, which sends what a page of viser sends, or anything."""

import sys
import threading
import time
from collections.abc import Callable, Iterable
from http.client import HTTPConnection
from typing import Any
from urllib.parse import urlsplit

import msgspec.msgpack
import viser
import zstandard
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from fastrod_viewer.app import App

DRIVE = [sys.executable, "-m", "fastrod.commands.cli", "drive", "--emulate", "--seed", "3"]
DRIVE += ["--no-home", "--no-open", "--port", "0"]
"""The command that drives the emulated prototype and prints the address of its page."""
CAMERA = _messages.ViewerCameraMessage(
    wxyz=(1.0, 0.0, 0.0, 0.0),
    position=(1.0, 0.0, 0.0),
    fov=0.75,
    near=0.01,
    far=10.0,
    image_height=600,
    image_width=800,
    look_at=(0.0, 0.0, 0.0),
    up_direction=(0.0, 0.0, 1.0),
)
PROTOCOL = f"viser-v{viser.__version__}"
HANDSHAKE = {
    "Upgrade": "websocket",
    "Connection": "Upgrade",
    "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
    "Sec-WebSocket-Version": "13",
    "Sec-WebSocket-Protocol": PROTOCOL,
}


def websocket(address: str) -> ClientConnection:
    """Open the websocket of a page."""
    at = address.replace("http", "ws", 1).rstrip("/")
    return connect(at, subprotocols=[Subprotocol(PROTOCOL)], max_size=None)


def request(address: str, path: str, headers: Iterable[tuple[str, ...]]) -> tuple[HTTPConnection, int, str]:
    """Send one request exactly as it is given: the open connection, the status, and the text of the answer
    unless it is a websocket."""
    at = urlsplit(address)
    assert at.hostname is not None
    connection = HTTPConnection(at.hostname, at.port, timeout=60.0)
    connection.putrequest("GET", path, skip_host=True, skip_accept_encoding=True)
    for name, value in headers:
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    return connection, answer.status, "" if answer.status == 101 else answer.read().decode()


class RawPage:
    """A websocket that answers when it is asked for a sign of life, like a page in a browser."""

    def __init__(self, app: App) -> None:
        before = set(app.server.get_clients())
        self.app = app
        self.socket = websocket(app.address)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()
        self.send(CAMERA)
        assert until(lambda: set(app.server.get_clients()) > before)
        (self.number,) = set(app.server.get_clients()) - before

    def send(self, message: Any) -> None:
        """A message of viser's, or bytes or text as they are."""
        ready = isinstance(message, (bytes, str))
        self.socket.send(message if ready else msgspec.msgpack.encode(message.as_serializable_dict()))

    def put(self, handle: Any, value: Any) -> None:
        """Move a control, or press a button."""
        self.send(_messages.GuiUpdateMessage(handle._impl.uuid, {"value": value}))

    def press(self, handle: Any) -> None:
        self.put(handle, True)

    def key(self, label: str) -> None:
        """Press a key that stands for a command."""
        known = self.app.server.gui._command_handle_from_uuid
        (uuid,) = (uuid for uuid, command in known.items() if command.label == label)
        self.send(_messages.CommandTriggerMessage(uuid))

    def own(self, label: str) -> Any:
        """A button that this page alone has."""
        handles = self.app.server.get_clients()[self.number].gui._gui_input_handle_from_uuid.values()
        return next(handle for handle in handles if handle.label == label)

    def close(self) -> None:
        self.socket.close()

    def _read(self) -> None:
        try:
            for raw in self.socket:
                assert isinstance(raw, bytes)
                size, packed = (int.from_bytes(raw[k : k + 8], "little") for k in (0, 8))
                inner = zstandard.ZstdDecompressor().decompress(raw[16 : 16 + packed], max_output_size=size)
                for message in msgspec.msgpack.decode(inner)["messages"]:
                    if message["type"] == "LocalStorageGetItemRequestMessage":
                        uuid = message["request_uuid"]
                        self.send(_messages.LocalStorageGetItemResponseMessage(None, None, uuid))
        except ConnectionClosed:
            return


def until(holds: Callable[[], bool], seconds: float = 60.0) -> bool:
    """Wait until something holds; whether it does."""
    end = time.monotonic() + seconds
    while not holds() and time.monotonic() < end:
        time.sleep(0.01)
    return holds()


def slider(app: App, label: str) -> Any:
    """A control of the page, by its label."""
    handles = app.server.gui._gui_input_handle_from_uuid.values()
    return next(handle for handle in handles if handle.label == label)
