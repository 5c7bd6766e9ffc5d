# SPDX-License-Identifier: Apache-2.0
"""The web server of the page: viser's, behind a door that asks for a token."""

from __future__ import annotations

import contextlib
import hmac
import http
import io
import re
import secrets
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qs, urlsplit

import viser
import websockets.asyncio.server as websocket_server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from ggwarp.results.saved_run import RunError

LOCAL = "127.0.0.1"
PORT = 8080
_EVERYWHERE = ("0.0.0.0", "::")
_MOST = 65535
_LOCK = threading.Lock()


def parse_address(text: str, option: str) -> tuple[str, int]:
    """Return the host and port of HOST:PORT, HOST or :PORT.

    Raises:
        RunError: it is none of these; ``option`` is named.
    """
    found = re.fullmatch(r"([^:\s]*|\[[0-9a-fA-F:]+\])(?::(\d{1,5}))?", text)
    if not found or not text or int(found[2] or 0) > _MOST:
        raise RunError(f"{option} {text}: give HOST:PORT, such as {LOCAL}:{PORT}")
    return found[1].strip("[]") or LOCAL, int(found[2]) if found[2] else PORT


def start_server(host: str = LOCAL, port: int = PORT) -> tuple[viser.ViserServer, str]:
    """Start a server; return it and the address of its page, which has the token that it asks for.

    A taken port gives way to the next free one; 0 is any. Without the token nobody is let in: neither another
    user of the machine or network, nor a web page that the user has open elsewhere.

    Raises:
        RunError: ``host`` is no address of this machine.
    """
    token = secrets.token_urlsafe(16)
    with _LOCK, _guarded(token) as installed:
        try:
            _check(host)
            with contextlib.redirect_stdout(io.StringIO()):  # it says where it is, without the token
                server = viser.ViserServer(host=host, port=port, label="ggwarp", verbose=False)
        except OSError as error:
            raise RunError(f"{host}:{port}: cannot be listened on ({error.strerror}); try {LOCAL}") from None
    if not installed:
        server.stop()
        raise RuntimeError("this version of viser starts its server in another way; the page has no door")
    shown = LOCAL if host in _EVERYWHERE else f"[{host}]" if ":" in host else host
    return server, f"http://{shown}:{server.get_port()}/?token={token}"


def stop_server(server: viser.ViserServer) -> None:
    """End the page."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def reach(host: str) -> str:
    """Say who can open a page that listens at ``host``."""
    if host in (LOCAL, "localhost", "::1"):
        return "this machine alone can open it, with this address"
    return f"whoever reaches {host} can open it, with this address, which is the key to it"


def _check(host: str) -> None:
    """Raise OSError where ``host`` cannot be listened on; viser would try a thousand ports."""
    family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    with socket.socket(family, kind) as one:
        one.bind(address)


@contextmanager
def _guarded(token: str) -> Iterator[list[bool]]:
    """Have the servers that are started meanwhile ask for ``token``; the list is empty where none was.

    viser has no such setting; its server is one of websockets, which asks ``process_request`` about every
    request, pages and sockets alike.
    """
    plain, installed = websocket_server.serve, []

    def serve(*args: Any, process_request: Any = None, **options: Any) -> Any:
        installed.append(True)
        return plain(*args, process_request=_door(token, process_request), **options)

    websocket_server.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
    try:
        yield installed
    finally:
        websocket_server.serve = plain  # pyright: ignore[reportAttributeAccessIssue]


def _door(token: str, inside: Callable[[Any, Request], Response | None]) -> Callable[..., Response | None]:
    """Return what lets requests through to ``inside`` that have ``token``, in address or cookie."""
    cookie = f"ggwarp_{token[:6]}={token}"

    def answer(connection: Any, request: Request) -> Response | None:
        given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
        cookies = [c.strip() for c in request.headers.get("Cookie", "").split(";")]
        fresh = hmac.compare_digest(given.encode(), token.encode())
        if not fresh and not any(hmac.compare_digest(c.encode(), cookie.encode()) for c in cookies):
            text = b"This page opens with the address that ggwarp shows, token included.\n"
            headers = Headers({"Content-Type": "text/plain", "Content-Length": str(len(text))})
            return Response(http.HTTPStatus.FORBIDDEN, "Forbidden", headers, text)
        response = inside(connection, request)
        if fresh and response is not None:
            response.headers["Set-Cookie"] = f"{cookie}; HttpOnly; SameSite=Strict; Path=/"
        return response

    return answer
