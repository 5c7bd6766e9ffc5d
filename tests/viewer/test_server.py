# SPDX-License-Identifier: Apache-2.0
"""Who is let in."""

from __future__ import annotations

import asyncio
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import InvalidStatus

from ggwarp.results.saved_run import RunError
from ggwarp.viewer.server import parse_address, reach, start_server, stop_server


@pytest.fixture(scope="module")
def url() -> Iterator[str]:
    server, address = start_server(port=0)
    yield address
    stop_server(server)


def _get(url: str, cookie: str = "") -> tuple[int, str, str]:
    request = urllib.request.Request(url, headers={"Cookie": cookie} if cookie else {})
    try:
        with urllib.request.urlopen(request, timeout=20) as answer:
            return answer.status, answer.read().decode(), answer.headers.get("Set-Cookie", "")
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), ""


def test_the_page_opens_with_its_token_alone(url):
    plain, token = url.split("?token=")
    status, text, cookie = _get(url)
    assert status == 200 and "<html" in text and "HttpOnly" in cookie and "SameSite=Strict" in cookie
    assert _get(plain, cookie.split(";")[0])[0] == 200
    for wrong in (plain, f"{plain}?token=", f"{plain}?token={token[:-1]}", f"{plain}assets/x?token=é"):
        status, text, cookie = _get(urllib.parse.quote(wrong, safe=":/?="))
        assert status == 403 and "token" in text and not cookie
    assert _get(plain, "ggwarp_x=" + token)[0] == 403


def test_so_does_its_socket(url):
    socket, token = url.replace("http", "ws").split("?token=")

    async def opens(address: str) -> bool:
        try:
            async with connect(address, subprotocols=["viser-v1.1.1"]):  # pyright: ignore[reportArgumentType]
                return True
        except InvalidStatus as error:
            assert error.response.status_code == 403
            return False

    assert asyncio.run(opens(f"{socket}?token={token}"))
    assert not asyncio.run(opens(socket))


def test_a_taken_port_gives_way(url):
    port = int(url.split(":")[2].split("/")[0])
    server, other = start_server(port=port)
    try:
        assert f":{port}/" not in other and _get(other)[0] == 200
        assert other.split("token=")[1] != url.split("token=")[1]
    finally:
        stop_server(server)


@pytest.mark.parametrize(
    ("text", "address"),
    [
        ("127.0.0.1:8080", ("127.0.0.1", 8080)),
        (":90", ("127.0.0.1", 90)),
        ("0.0.0.0", ("0.0.0.0", 8080)),
        ("[::1]:81", ("::1", 81)),
        ("0.0.0.0:0", ("0.0.0.0", 0)),
    ],
)
def test_addresses(text, address):
    assert parse_address(text, "--at") == address


@pytest.mark.parametrize("text", ["", "a b:80", "x:port", ":70000", "1:2:3"])
def test_addresses_that_are_none(text):
    with pytest.raises(RunError, match=r"--at .*: give HOST:PORT"):
        parse_address(text, "--at")


def test_an_address_of_another_machine_is_refused():
    with pytest.raises(RunError, match=r"192\.0\.2\.1:8080: cannot be listened on"):
        start_server("192.0.2.1")


def test_who_can_open_it_is_said():
    assert "this machine alone" in reach("127.0.0.1") and "whoever reaches 0.0.0.0" in reach("0.0.0.0")
