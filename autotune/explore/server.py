"""Serve the page on this machine and nowhere else."""

import asyncio
import contextlib
import logging
import secrets
import signal
import socket
import time
from collections.abc import Callable
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.protocol import Protocol
from bokeh.server.connection import ServerConnection
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.views.ws import WSHandler
from bokeh.settings import settings
from bokeh.util.token import check_token_signature, get_session_id, get_token_payload
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.web import ErrorHandler, OutputTransform

from autotune.errors import UsageError

from .page import build_page
from .saving import Target
from .source import Exploration

LOOPBACK = "127.0.0.1"
_NAMES = (LOOPBACK, "localhost")
_HTTP_PORT = 80
_FORBIDDEN = 403
_LONGEST_MESSAGE_BYTES = 1_000_000
# The engine of the figures compiles its own code, and sets styles of its own; all else comes from this server.
_POLICY = (
    "default-src 'none'",
    "connect-src 'self'",
    "style-src 'self' 'unsafe-inline'",
    "script-src 'self' 'unsafe-inline' 'unsafe-eval'",
    "img-src 'self' data: blob:",
    "font-src 'self' data:",
    "base-uri 'none'",
    "form-action 'none'",
    "frame-ancestors 'none'",
)
SECURITY_HEADERS = {
    "Content-Security-Policy": "; ".join(_POLICY),
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
"""Headers of every answer: load from here only, be shown in no frame, and send nobody the address."""


def serve(exploration: Exploration, target: Target, *, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page until the process is interrupted; `ready` receives its address once it answers.

    `port` 0 takes a free one. Only this machine reaches the server; the address holds a secret, so that another user of
    the machine does not find the page, and a page of another origin cannot open its connection. Scripts come from the
    installed package. From the interrupt on nothing is written to `target`, and a save under way is not waited for.
    Raises UsageError for a port that is taken, KeyboardInterrupt for an interrupt before the page is there.
    """
    # Whatever the environment says: nothing is fetched from elsewhere.
    settings.resources = "server"
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # A foreign page that was refused needs no message, least of all with advice for another command.
    logging.getLogger("bokeh.server.views.ws").setLevel(logging.CRITICAL)
    asyncio.run(_serve(exploration, target, port, ready))


async def _serve(exploration: Exploration, target: Target, port: int, ready: Callable[[str], None]) -> None:
    ended = _watch_signals(target)
    listening = _listen(port)
    bound = listening.getsockname()[1]
    hosts = own_hosts(bound)
    # Else a variable of the environment would decide whose pages may connect.
    settings.allowed_ws_origin = sorted(hosts)
    secret = secrets.token_urlsafe(12)

    def fill(document: Document) -> None:
        build_page(exploration, target, document)

    application = HostCheckedApplication(
        {"/": Application(FunctionHandler(fill))},
        prefix=secret,
        extra_websocket_origins=sorted(hosts),
        websocket_max_message_size_bytes=_LONGEST_MESSAGE_BYTES,
    )
    application.hosts = hosts
    application.add_transform(SecurityHeaders)
    http = HTTPServer(application)
    http.add_socket(listening)
    server = BaseServer(IOLoop.current(), application, http)
    server.start()
    try:
        if ended.is_set():
            raise KeyboardInterrupt
        ready(f"http://{LOOPBACK}:{bound}/{secret}/")
        await ended.wait()
    finally:
        target.end()
        # What was under way to a visitor ends here, and that is no fault.
        logging.getLogger("tornado").setLevel(logging.CRITICAL)
        server.stop()
        await http.close_all_connections()


def _watch_signals(target: Target) -> asyncio.Event:
    """Return an event that an interrupt sets; from then on nothing is written."""
    ended = asyncio.Event()

    def end() -> None:
        target.end()
        ended.set()

    for kind in (signal.SIGINT, signal.SIGTERM):
        # Where the loop cannot watch signals, the interrupt arrives as the exception that it is.
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(kind, end)
    return ended


def _listen(port: int) -> socket.socket:
    try:
        listening = socket.create_server((LOOPBACK, port))
    except OSError as error:
        raise UsageError(
            f"Port {port} cannot be used: {error.strerror or error}; name another one with --port."
        ) from error
    listening.setblocking(False)
    return listening


def own_hosts(port: int) -> frozenset[str]:
    """Return what a browser of this machine calls the server in its Host and Origin headers."""
    hosts = {f"{name}:{port}" for name in _NAMES}
    return frozenset(hosts | set(_NAMES) if port == _HTTP_PORT else hosts)


class SecurityHeaders(OutputTransform):
    """Adds `SECURITY_HEADERS` to every answer, refusals included."""

    def transform_first_chunk(
        self, status_code: int, headers: HTTPHeaders, chunk: bytes, finishing: bool
    ) -> tuple[int, HTTPHeaders, bytes]:
        """Return the answer with the headers."""
        for name, value in SECURITY_HEADERS.items():
            headers[name] = value
        return super().transform_first_chunk(status_code, headers, chunk, finishing)


class HostCheckedApplication(BokehTornado):
    """The application, which refuses requests to another host name than one of `hosts`.

    A foreign page whose name resolves to this machine (DNS rebinding) has the origin that it names: only the Host
    header differs from that of our own page.
    """

    hosts: frozenset[str] = frozenset()

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """Return what answers a request: 403 for one that is not for us, or for a connection that is not our page's."""
        is_ours = request.headers.get("Host", "").lower() in self.hosts
        if is_ours and (not request.path.endswith("/ws") or _is_from_page(request)):
            return super().find_handler(request, **kwargs)
        return self.get_handler_delegate(request, ErrorHandler, {"status_code": _FORBIDDEN})

    def new_connection(self, protocol: Protocol, socket: WSHandler, *more: Any) -> ServerConnection:
        """Return the connection of a page, whose small messages do not wait for the answer to the last one (Nagle)."""
        # A page that has gone again has none to set.
        if socket.ws_connection is not None:
            socket.set_nodelay(True)
        return super().new_connection(protocol, socket, *more)


def _is_from_page(request: HTTPServerRequest) -> bool:
    """Whether a connection has what the page was given: asked here, since the library raises where it is missing."""
    offered = [each.strip() for each in request.headers.get("Sec-WebSocket-Protocol", "").split(",")]
    if len(offered) != 2 or offered[0] != "bokeh":
        return False
    try:
        whole = check_token_signature(offered[1]) and bool(get_session_id(offered[1]))
        return whole and time.time() < float(get_token_payload(offered[1])["session_expiry"])
    except Exception:  # noqa: BLE001 - whatever is wrong with a token that anybody may have made up
        return False
