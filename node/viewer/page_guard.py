"""The page's server: viser on 127.0.0.1, with a guard before it.

A browser lets every web site connect to servers on this machine, so a local address alone protects nothing. Each
request, HTTP or WebSocket, is checked before viser sees it:

- Host must name this machine, at any port (a tunnel may have another). Any other name may be a web site's name that
  resolves to this machine (DNS rebinding).
- Origin, which a browser sends with every WebSocket, must be the page's own. Other programs send none and are
  admitted.
- With a token, the path must begin with it: other users of this machine do not know it.

The page itself must not load anything from other sites, connect to them, or be framed by them. Without that, viser's
client would open any server that a link names in `?websocket=`, with this page's rights.
"""

import asyncio
import contextlib
import errno
import hmac
import http
import io
import logging
import re
import secrets
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from typing import Any

import viser
import websockets.asyncio.server as ws
from websockets.http11 import Request, Response

HOST = "127.0.0.1"
CLIENTS = 16  # at once; each is sent the whole scene
MAX_MESSAGE = 1 << 20  # bytes, from a client
OPEN_TIMEOUT_S = 5.0  # for a request to be complete
HEADERS = {
    "Content-Security-Policy": "default-src 'self' data: blob: 'unsafe-inline' 'wasm-unsafe-eval';"
    " frame-ancestors 'none'; form-action 'none'; base-uri 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",  # the address has the token in it
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}
_NAMES = re.compile(r"(127\.0\.0\.1|localhost)(:\d{1,5})?", re.ASCII)
_STARTING = threading.Lock()
_SERVE = ws.serve
_LOG = logging.getLogger(__name__)

Handler = Callable[[ws.ServerConnection], Awaitable[None]]


class GuardedServer(viser.ViserServer):
    """viser on exactly one port of 127.0.0.1, without its tunnel to a public server, which any client could ask for."""

    def __init__(self, port: int, token: bool = False) -> None:
        """Serve on `port`, 0 for a free one; with `token`, at an address that nobody guesses.

        Raises OSError or ValueError in one line if `port` cannot be had.
        """
        _check_port(port)
        guard = _Guard(secrets.token_urlsafe(16) if token else None)
        with guard.in_place(), _quiet():
            super().__init__(host=HOST, port=port, verbose=False)
        self.path = "" if guard.token is None else f"/{guard.token}/"
        if not guard.used:
            self.stop()
            raise RuntimeError(f"viser {viser.__version__} starts its server in a way that cannot be guarded")

    @property
    def address(self) -> str:
        """The page's URL."""
        return f"http://{HOST}:{self.get_port()}{self.path}"

    def stop(self) -> None:
        """End the server."""
        with _quiet():
            super().stop()

    def request_share_url(self, verbose: bool = True) -> str | None:
        """No."""
        return None


class _Guard:
    """Stands between `websockets` and viser's handlers."""

    def __init__(self, token: str | None) -> None:
        self.token = token
        self.used = False

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """While this lasts, a server that is started is guarded. viser takes no options for its server."""
        with _STARTING:
            ws.serve = self._serve  # type: ignore[assignment,misc]
            try:
                yield
            finally:
                ws.serve = _SERVE  # type: ignore[misc]

    def _serve(self, handler: Handler, *address: Any, **options: Any) -> ws.serve:
        """`websockets.asyncio.server.serve` with this guard; runs in the server's event loop."""
        self.used = True
        respond = options.get("process_request")
        options |= {
            "process_request": lambda connection, request: self._process(respond, connection, request),
            "max_size": MAX_MESSAGE,
            "open_timeout": OPEN_TIMEOUT_S,
            "logger": logging.Logger(
                __name__, logging.CRITICAL
            ),  # garbage from a stranger is not an error of this program
        }
        asyncio.get_running_loop().set_exception_handler(_drop)  # of tasks that handle a client's messages
        return _SERVE(self._handler(handler), *address, **options)

    def _handler(self, handler: Handler) -> Handler:
        async def handle(connection: ws.ServerConnection) -> None:
            if connection.subprotocol != f"viser-v{viser.__version__}":  # a page that an older version left open
                return await connection.close(1002, f"another version than {viser.__version__}; load the page again")
            try:
                await handler(connection)
            except Exception as error:  # viser raises various types for an invalid message
                _LOG.debug("a client is dropped: %r", error)
                await connection.close(1007, "no message of this page")

        return handle

    def _process(self, respond: Any, connection: ws.ServerConnection, request: Request) -> Response | None:
        """The answer to a request; None opens a WebSocket."""
        path = self._admitted(request)
        if path is None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "refused; open the address that farside printed\n")
        response: Response | None = respond(connection, replace(request, path=path)) if respond is not None else None
        if response is None and len(connection.server.connections) >= CLIENTS:
            return connection.respond(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients; close a page\n")
        if response is not None:
            for name, value in HEADERS.items():
                response.headers[name] = value
        return response

    def _admitted(self, request: Request) -> str | None:
        """The path behind the token, or None for a request that is refused."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not _NAMES.fullmatch(hosts[0].lower()):
            return None
        if origins and [origin.lower() for origin in origins] != [f"http://{hosts[0].lower()}"]:
            return None
        if self.token is None:
            return request.path
        prefix, _, rest = re.split(r"[?#]", request.path, maxsplit=1)[0].removeprefix("/").partition("/")
        return f"/{rest}" if hmac.compare_digest(_bytes(prefix), _bytes(self.token)) else None


def _bytes(text: str) -> bytes:
    return text.encode("ascii", "surrogateescape")  # as a request's path is decoded


def _drop(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Log an error caused by a client's message at debug level, without a traceback."""
    _LOG.debug("%s: %r", context["message"], context.get("exception"))


def _check_port(port: int) -> None:
    """Raises OSError or ValueError for an unusable port. viser alone would take the next free one instead."""
    if not 0 <= port <= 65535:
        raise ValueError(f"port {port} does not exist; give one of 0 to 65535")
    try:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, port))
    except OSError as error:
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be opened ({error.strerror})"
        raise OSError(f"port {port} of {HOST} {reason}; give another, or 0 for a free one") from None


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """viser prints panels when it starts and stops."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
