"""Serve the page on this machine and nowhere else."""

import asyncio
import contextlib
import logging
import secrets
import signal
import socket
from collections.abc import Callable

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import BaseServer
from bokeh.settings import settings
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop

from autotune.errors import UsageError

from .host_check import LOOPBACK, Door, own_hosts
from .page import build_page
from .source import Exploration
from .target import Target

_LONGEST_MESSAGE_BYTES = 1_000_000


def serve(exploration: Exploration, target: Target, *, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page until the process is interrupted; `ready` is told its address once it answers.

    `port` 0 takes a free one. Only this machine reaches the server; the address holds a secret, so that another user of
    the machine does not find the page, and a page of another origin cannot open its connection. Scripts come from the
    installed package. From the interrupt on nothing is written to `target`, and a save under way is not waited for.
    Raises UsageError for a port that is taken, KeyboardInterrupt for an interrupt before the page is there.
    """
    # Whatever the environment says: nothing is fetched from elsewhere.
    settings.resources = "server"
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # A foreign page that was refused is nothing to tell, least of all with advice for another command.
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

    application = Door(
        {"/": Application(FunctionHandler(fill))},
        prefix=secret,
        extra_websocket_origins=sorted(hosts),
        websocket_max_message_size_bytes=_LONGEST_MESSAGE_BYTES,
    )
    application.hosts = hosts
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
