"""Serve the page on this machine and nowhere else."""

import asyncio
import contextlib
import logging
import secrets
import signal
import socket
from collections.abc import Callable
from pathlib import Path

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.settings import settings
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop

from autotune.errors import UsageError

from .page import build_page
from .source import Exploration

LOOPBACK = "127.0.0.1"
_LONGEST_MESSAGE_BYTES = 1_000_000


def serve(exploration: Exploration, out: Path, *, port: int, ready: Callable[[str], None]) -> None:
    """Serve the page until the process is interrupted; `ready` is told its address once it answers.

    `port` 0 takes a free one. Only this machine reaches the server; the address holds a secret, so that another user of
    the machine does not find the page, and a page of another origin cannot open its connection. Scripts come from the
    installed package. Raises UsageError for a port that is taken.
    """
    # Whatever the environment says: nothing is fetched from elsewhere.
    settings.resources = "server"
    for name in ("bokeh", "tornado"):
        logging.getLogger(name).setLevel(logging.ERROR)
    # A foreign page that was refused is nothing to tell, least of all with advice for another command.
    logging.getLogger("bokeh.server.views.ws").setLevel(logging.CRITICAL)
    asyncio.run(_serve(exploration, out, port, ready))


async def _serve(exploration: Exploration, out: Path, port: int, ready: Callable[[str], None]) -> None:
    try:
        listening = socket.create_server((LOOPBACK, port))
    except OSError as error:
        raise UsageError(
            f"Port {port} cannot be used: {error.strerror or error}; name another one with --port."
        ) from error
    listening.setblocking(False)
    bound = listening.getsockname()[1]
    secret = secrets.token_urlsafe(12)

    def fill(document: Document) -> None:
        build_page(exploration, out, document)

    application = BokehTornado(
        {"/": Application(FunctionHandler(fill))},
        prefix=secret,
        extra_websocket_origins=[f"{LOOPBACK}:{bound}"],
        websocket_max_message_size_bytes=_LONGEST_MESSAGE_BYTES,
    )
    http = HTTPServer(application)
    http.add_socket(listening)
    server = BaseServer(IOLoop.current(), application, http)
    server.start()
    ended = asyncio.Event()
    for kind in (signal.SIGINT, signal.SIGTERM):
        # Where the loop cannot watch signals, the interrupt arrives as the exception that it is.
        with contextlib.suppress(NotImplementedError):
            asyncio.get_running_loop().add_signal_handler(kind, ended.set)
    try:
        ready(f"http://{LOOPBACK}:{bound}/{secret}/")
        await ended.wait()
    finally:
        # What was under way to a visitor ends here, and that is no fault.
        logging.getLogger("tornado").setLevel(logging.CRITICAL)
        server.stop()
        await http.close_all_connections()
