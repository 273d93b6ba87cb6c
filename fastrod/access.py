"""`Access`: the check of who may load a page that viser serves, and open its websocket."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gzip
import html
import io
import ipaddress
import logging
import re
import secrets
import socket
import sys
import tempfile
import threading
import warnings
import webbrowser
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from fastrod.errors import InputError

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import ServerConnection
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

    Answer = Callable[[ServerConnection, Request], Response | None]

MOST_PAGES = 32
"""Open at once on one server: as many as viser has threads for what they send."""
_LOCAL = ("127.0.0.1", "localhost", "[::1]")
_PORT, _TRIES = 8080, 20  # the first that is tried, and how many after it
_HTTP_PORT = 80  # a browser leaves it out of Host and Origin
_NO_KEY = "This address lacks the key to the page: open the address that was printed in the terminal."
_WRONG_HOST = (
    "This page is not served under this name or port: open the address that was printed in the terminal, "
    "and through a tunnel forward the same port."
)
_WRONG_ORIGIN = "Another site requests this page: open the address that was printed in the terminal."
_FULL = f"{MOST_PAGES} pages are open, which is the most: close one and load this again."
_SENSELESS = "A page sent a message that makes no sense; it is ignored, and so are further ones."
_KINDS = 20  # of sentences about pages: a page that sends nonsense for hours fills no terminal
_patching = threading.Lock()


@final
class Access:
    """The key of one server, and the check of every request against it.

    Loopback keeps no web page out: a websocket has no same-origin rule, so whatever page a browser shows may
    open one to this machine, and a stranger's name may resolve to 127.0.0.1 (DNS rebinding). A request is
    answered only where its path begins with the key, its Host is an address that is served, and its Origin,
    where a browser gives one, is that same address. The key is in the path and no cookie: browsers send
    cookies to every port.
    """

    def __init__(self, host: str) -> None:
        """`host` as the server is bound to it."""
        self.key = secrets.token_urlsafe()
        """First element of the path; new with every server."""
        name = socket.gethostname() if _every(host) else host  # `elsewhere` prints it without a route
        self.title = ""
        """Title of the page, in the browser's tab; empty: viser's own."""
        self._names = (f"[{name}]" if ":" in name else name.lower(),)

    def refusal(self, path: str, headers: Headers, arrived: tuple[str, int]) -> str | None:
        """Return one sentence that says why this request is refused, or None; `arrived` is the address and
        port of this machine that it came to."""
        address, port = arrived
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or hosts[0].lower() not in self._served(address, port):
            return _WRONG_HOST
        if origins and origins != [f"http://{hosts[0].lower()}"]:
            return _WRONG_ORIGIN
        given = "".join(path.partition("?")[0].split("/")[1:2]).encode("utf-8", "surrogateescape")
        if not secrets.compare_digest(given, self.key.encode()):
            return _NO_KEY
        return None

    def _served(self, address: str, port: int) -> set[str]:
        """Return the valid values of Host: this machine's names for itself, the name that was bound, the
        address of the connection."""
        names = {*_LOCAL, *self._names, f"[{address}]" if ":" in address else address}
        return {f"{name}:{port}" for name in names} | (names if port == _HTTP_PORT else set())

    def guard(self, plain: Answer) -> Answer:
        """Return a check of every request before `plain`, viser's own answer, sees it without its key."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        def answer(connection: ServerConnection, request: Request) -> Response | None:
            status, arrived = HTTPStatus.FORBIDDEN, connection.local_address[:2]
            why = self.refusal(request.path, request.headers, arrived)
            if why is None and len(connection.server.connections) >= MOST_PAGES:
                status, why = HTTPStatus.SERVICE_UNAVAILABLE, _FULL
            if why is not None:
                body = f"<!doctype html><title>Refused</title><p>{why}</p>\n".encode()
                kind = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(body))}
                return Response(status, status.phrase, Headers(kind), body)
            without = request.path.removeprefix(f"/{self.key}") or "/"
            response = plain(connection, replace(request, path=without))
            if response is not None:
                _set_title(response, self.title)
                response.headers["Referrer-Policy"] = (
                    "no-referrer"  # a link must not reveal the page's address
                )
                response.headers["X-Frame-Options"] = "DENY"
            return response

        return answer


def _set_title(response: Response, title: str) -> None:
    """Give a page that viser serves another title, where it is a page."""
    packed = response.headers.get("Content-Encoding", "") == "gzip"
    if not title or not response.headers.get("Content-Type", "").startswith("text/html"):
        return
    body = gzip.decompress(response.body) if packed else response.body
    new = f"<title>{html.escape(title)}</title>".encode()
    body = re.sub(rb"<title>[^<]*</title>", lambda _: new, body, count=1)
    response.body = gzip.compress(body) if packed else body
    del response.headers["Content-Length"]
    response.headers["Content-Length"] = str(len(response.body))


@final
class Ignored:
    """Says on stderr, once for each kind, that what a page sent came to nothing, in place of a traceback each
    time."""

    def __init__(self) -> None:
        self._said: set[str] = set()

    def __call__(self, error: object = None, sentence: str = _SENSELESS) -> None:
        """Mention it; `error` goes to the debug log."""
        cause = error if isinstance(error, BaseException) else None
        logging.getLogger(__name__).debug(sentence, exc_info=cause)
        if sentence not in self._said and len(self._said) < _KINDS:
            self._said.add(sentence)
            print(sentence, file=sys.stderr, flush=True)

    def failed(self, error: Exception) -> None:
        """Mention that a page's request could not be done."""
        why = " ".join(str(error).split())
        self(error, f"A page's request failed, and is left undone: {type(error).__name__}, {why}")

    def of_loop(self, _: object, context: dict[str, Any]) -> None:
        """Hear an event loop's complaint."""
        self(context.get("exception"))


@final
@dataclass(frozen=True, kw_only=True)
class Served:
    """A viser server that answers only those who have its address."""

    viser: viser.ViserServer
    host: str
    """That it is bound to."""
    access: Access
    """Whose key is the first element of every path."""
    ignored: Ignored
    """Hears of messages that make no sense."""
    _closing: contextlib.ExitStack = field(default_factory=contextlib.ExitStack, init=False, repr=False)

    @property
    def key(self) -> str:
        """First element of every path."""
        return self.access.key

    @property
    def address(self) -> str:
        """Address of the page, key included: http://127.0.0.1:8080/KEY/ for instance."""
        return self.at("localhost" if _every(self.host) else self.host)

    def at(self, host: str) -> str:
        """Return the address under which `host`, a name or an address of this machine, serves the page."""
        return f"http://{f'[{host}]' if ':' in host else host}:{self.viser.get_port()}/{self.key}/"

    @property
    def elsewhere(self) -> str:
        """Address of the page for other machines; empty where this machine alone gets to it."""
        if is_loopback(self.host):
            return ""
        return self.at(_outward(self.host) if _every(self.host) else self.host)

    def open_browser(self) -> None:
        """Open the page by a file that leads to it and that this user alone can read: other users of this
        machine can read a command line, so the key must not be on the browser's."""
        with contextlib.suppress(OSError):  # the address is printed, too
            with tempfile.NamedTemporaryFile("w", prefix="fastrod-", suffix=".html", delete=False) as file:
                self._closing.callback(Path(file.name).unlink, missing_ok=True)
                file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={self.address}">\n')
            webbrowser.open(Path(file.name).as_uri())

    def stop(self) -> None:
        """End it, and remove what `open_browser` has written."""
        self._closing.close()
        with contextlib.redirect_stdout(io.StringIO()):  # it says goodbye
            self.viser.stop()


def serve_guarded(host: str, port: int, *, label: str | None = None) -> Served:
    """Start a viser server whose page and websocket need the key in its address. Raises `InputError` where
    viser is missing, or serves in a way that cannot be guarded."""
    try:
        import viser
        from viser import _messages
        from websockets.asyncio import server as web
    except ImportError as error:
        raise InputError("viser is not installed; pip install 'fastrod[viewer]' brings it.") from error
    access, ignored, plain, guarded = Access(host), Ignored(), web.serve, threading.Event()

    def serve(*arguments: Any, process_request: Any, **options: Any) -> Any:
        asyncio.get_running_loop().set_exception_handler(ignored.of_loop)
        answer = access.guard(process_request)
        guarded.set()
        return plain(*arguments, process_request=answer, logger=_silent(ignored), **options)

    warnings.filterwarnings("ignore", r"\[viser\] .* does not match annotation")  # of what a page has sent
    # viser offers no place for a check, so that it finds this one where it looks for websockets' own server
    with _patching, contextlib.redirect_stdout(io.StringIO()):  # it greets with a box
        setattr(web, "serve", serve)  # noqa: B010 - mypy forbids assigning to a class
        try:
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        finally:
            setattr(web, "serve", plain)  # noqa: B010
    served = Served(viser=server, host=host, access=access, ignored=ignored)
    if not guarded.is_set():
        served.stop()
        found = viser.__version__
        why = "serves pages in a way that cannot be guarded"
        raise InputError(f"viser {found} {why}; pip install 'viser==1.1.1'.")
    for kind in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):  # no page opens a tunnel
        server._websock_server.unregister_handler(kind)
    return served


def free_port(host: str, port: int | None) -> int:
    """`port` if it is free, or for None the first free one from 8080 on. Raises `InputError`, one sentence,
    where there is none."""
    if port is not None and not 0 <= port < 65536:
        raise InputError(f"port is {port}; it must be between 1 and 65535, or 0 for any that is free.")
    for candidate in range(_PORT, _PORT + _TRIES) if port is None else [port]:
        if _free(host, candidate):
            return candidate
    if port is None:
        raise InputError(
            f"ports {_PORT} to {_PORT + _TRIES - 1} are all in use on {host}; free one, or name another."
        )
    other = next((p for p in range(port + 1, min(port + 1 + _TRIES, 65536)) if _free(host, p)), None)
    raise InputError(
        f"port {port} is in use on {host}; "
        + (f"{other} is free: --port {other}." if other else "name another with --port.")
    )


def _free(host: str, port: int) -> bool:
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
    except OSError as error:
        raise InputError(
            f"host {host!r} is not an address of this machine; 127.0.0.1 is, and 0.0.0.0 stands for all of "
            "its addresses."
        ) from error
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise InputError(
                    f"host {host!r} is not an address of this machine; 127.0.0.1 is, and 0.0.0.0 stands for "
                    "all of its addresses."
                ) from error
            return False
    return True


def is_loopback(host: str) -> bool:
    """Return whether only this machine gets to it."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _every(host: str) -> bool:
    """It stands for all addresses of this machine."""
    return host in ("0.0.0.0", "::")


def _outward(host: str) -> str:
    """Return the address of this machine that others see, or its name where it has no route to them."""
    family, away = (socket.AF_INET6, "2001:db8::1") if ":" in host else (socket.AF_INET, "192.0.2.1")
    with socket.socket(family, socket.SOCK_DGRAM) as probe, contextlib.suppress(OSError):
        probe.connect((away, 9))  # sends nothing; both addresses are for documents only
        return str(probe.getsockname()[0])
    return socket.gethostname()


@final
class _Failures(logging.Handler):
    """Handler of what websockets logs; it reports to `ignored` messages that ended their own connection."""

    def __init__(self, ignored: Ignored) -> None:
        super().__init__(logging.ERROR)
        self._ignored = ignored

    def emit(self, record: logging.LogRecord) -> None:
        if record.exc_info and record.getMessage() == "connection handler failed":
            self._ignored(record.exc_info[1])


def _silent(ignored: Ignored) -> logging.Logger:
    """Return a logger that prints nothing: requests hold the key, and strangers could fill a terminal."""
    logger = logging.Logger("fastrod.access", level=logging.ERROR)  # on its own, below no other
    logger.addHandler(_Failures(ignored))
    return logger
