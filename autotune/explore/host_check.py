"""Who is let in: requests that name this server as their host, and connections that the page itself opens."""

import time
from typing import Any

from bokeh.server.tornado import BokehTornado
from bokeh.util.token import check_token_signature, get_session_id, get_token_payload
from tornado.httputil import HTTPServerRequest
from tornado.web import ErrorHandler

LOOPBACK = "127.0.0.1"
_NAMES = (LOOPBACK, "localhost")
_HTTP_PORT = 80
_FORBIDDEN = 403


def own_hosts(port: int) -> frozenset[str]:
    """Return what a browser of this machine calls the server in its Host and Origin headers."""
    hosts = {f"{name}:{port}" for name in _NAMES}
    return frozenset(hosts | set(_NAMES) if port == _HTTP_PORT else hosts)


class Door(BokehTornado):
    """The application, which refuses whoever calls it by another name than one of `hosts`.

    A page from elsewhere whose name leads to this machine (DNS rebinding) is of the origin that it names, and nothing
    but the Host header tells it from our own page.
    """

    hosts: frozenset[str] = frozenset()

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """Return what answers a request: 403 for one that is not for us, or for a connection that is not our page's."""
        is_ours = request.headers.get("Host", "").lower() in self.hosts
        if is_ours and (not request.path.endswith("/ws") or _is_from_page(request)):
            return super().find_handler(request, **kwargs)
        return self.get_handler_delegate(request, ErrorHandler, {"status_code": _FORBIDDEN})


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
