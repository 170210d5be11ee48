"""The web server of the page, which serves this machine alone unless it is told otherwise."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
from typing import Any
from urllib.parse import urlsplit

from viser import ViserServer
from websockets.asyncio.server import ServerConnection
from websockets.datastructures import Headers

_OF_THIS_MACHINE = ("127.0.0.1", "localhost", "::1")
# Of WebSocket (RFC 6455): the other side is not allowed to.
_POLICY_VIOLATION = 1008


class PageServer(ViserServer):
    """A server of viser that no other page of the web can talk to through the user's browser.

    Args:
        host: that it listens on.
        port: the first that is tried; 0 for any.
    """

    def __init__(self, host: str, port: int) -> None:
        # Connections that browsers open ahead and never use would leave traces.
        logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
        # It prints a banner.
        with contextlib.redirect_stdout(io.StringIO()):
            super().__init__(host, port, label="gsfeatloc view", verbose=False)
        self._only_here = host in _OF_THIS_MACHINE
        # viser looks at no origin. Before a message of the client is taken:
        self._websock_server.on_client_connect(self._refuse_foreign)
        self.gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to publish the page on a server elsewhere, which any client could ask for otherwise."""
        return None

    async def _refuse_foreign(self, client: Any) -> None:
        connection: ServerConnection = self._websock_server._live_connections[client.client_id]
        if connection.request is None or not is_own_page(connection.request.headers, self._only_here):
            await connection.close(_POLICY_VIOLATION, "this page is not of this server")


def check_host(host: str) -> None:
    """Raise ValueError where this machine has no such address: viser would say so in a thread, and wait for ever."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.bind(address)
    except OSError as error:
        raise ValueError(f"{host}: this machine cannot listen there: {error.strerror}") from error


def is_own_page(headers: Headers, only_here: bool) -> bool:
    """Return whether a request comes from a page of this server, or from no browser, which names no origin.

    Args:
        headers: of the request.
        only_here: whether the server is for this machine alone, so that no other name can be its own.
    """
    host, origin = headers.get("Host", ""), headers.get("Origin")
    if only_here and urlsplit(f"//{host}").hostname not in _OF_THIS_MACHINE:
        return False
    return origin is None or urlsplit(origin).netloc == host
