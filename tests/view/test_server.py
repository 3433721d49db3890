"""ViewServer: its address, its access checks, and its ports."""

from __future__ import annotations

import os
import socket
import threading
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

import pytest

pytest.importorskip("viser")

import viser
from helpers.processes import find_free_port, until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from zstate.errors import InvalidInput
from zstate.view.server import ScreenshotFailed, ViewServer, save_screenshot

PROTOCOL = [Subprotocol(f"viser-v{viser.__version__}")]


def status(url: str, headers: Mapping[str, str] | None = None) -> int:
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=dict(headers or {}))) as answer:
            return answer.status
    except urllib.error.HTTPError as error:
        return error.code


def listens(host: str, port: int) -> bool:
    with socket.socket() as probe:
        probe.settimeout(1.0)
        return probe.connect_ex((host, port)) == 0


def another_address() -> str | None:
    """An address of this machine that is not loopback."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return None
        return probe.getsockname()[0]


def test_server_listens_on_loopback_by_default():
    with ViewServer(port=0) as page:
        assert page.url == f"http://127.0.0.1:{page.port}"
        assert status(page.url) == 200
        assert status(page.url, {"Host": "evil.example"}) == 403
        address = another_address()
        assert address is None or not listens(address, page.port)
    assert not listens("127.0.0.1", page.port)


def test_websocket_passes_the_same_access_check():
    with ViewServer(port=0) as page:
        address = f"ws://127.0.0.1:{page.port}"
        with connect(address, subprotocols=PROTOCOL, compression=None) as socket:
            assert socket.recv(timeout=10)
        with pytest.raises(InvalidStatus) as caught:
            connect(address, subprotocols=PROTOCOL, origin="https://evil.example")
        assert caught.value.response.status_code == 403


def raw_status(port: int, *headers: str) -> int:
    """The status of the response to a request with only these headers."""
    with socket.create_connection(("127.0.0.1", port), timeout=10.0) as connection:
        lines = ["GET / HTTP/1.1", *headers, "", ""]
        connection.sendall("\r\n".join(lines).encode())
        return int(connection.makefile("rb").readline().split()[1])


WEBSOCKET = (
    "Connection: Upgrade",
    "Upgrade: websocket",
    "Sec-WebSocket-Version: 13",
    "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==",
    f"Sec-WebSocket-Protocol: {PROTOCOL[0]}",
)


@pytest.mark.parametrize("upgrade", [(), WEBSOCKET])
def test_names_that_resolve_to_loopback_are_refused_and_no_request_raises(upgrade):
    with ViewServer(port=0) as page:
        here, evil = (f"{name}:{page.port}" for name in ("127.0.0.1", "127.0.0.1.evil.example"))
        expected = 101 if upgrade else 200
        assert raw_status(page.port, f"Host: {here}", f"Origin: http://{here}", *upgrade) == expected
        assert raw_status(page.port, f"Host: {evil}", f"Origin: http://{evil}", *upgrade) == 403
        assert raw_status(page.port, f"Host: {here}", f"Host: {evil}", *upgrade) == 400
        assert raw_status(page.port, f"Host: {here}", f"Host: {here}", *upgrade) == 400
        assert raw_status(page.port, "Host: [::1", *upgrade) == 403
        assert raw_status(page.port, *upgrade) == 403


def test_beyond_loopback_page_and_websocket_need_the_token():
    with ViewServer("0.0.0.0", 0) as page:
        here = f"127.0.0.1:{page.port}"
        assert page.access.token is not None
        assert page.url.endswith(f":{page.port}/?token={page.access.token}")
        assert status(f"http://{here}") == 401
        assert status(f"http://{here}/?token={page.access.token}") == 200
        with pytest.raises(InvalidStatus) as caught:
            connect(f"ws://{here}", subprotocols=PROTOCOL)
        assert caught.value.response.status_code == 401
        cookie = {"Cookie": f"zstate_view_{page.port}={page.access.token}"}
        with connect(f"ws://{here}", subprotocols=PROTOCOL, additional_headers=cookie) as socket:
            assert socket.recv(timeout=10)


def test_browser_that_is_cut_off_is_noticed_while_another_answers():
    with ViewServer(port=0) as page:
        address = f"ws://127.0.0.1:{page.port}"
        with connect(address, subprotocols=PROTOCOL, compression=None, max_queue=None):
            until(lambda: page.is_answering(0))
            with socket.create_connection(("127.0.0.1", page.port), timeout=10.0) as cut_off:
                host = f"Host: 127.0.0.1:{page.port}"
                cut_off.sendall("\r\n".join(["GET / HTTP/1.1", host, *WEBSOCKET, "", ""]).encode())
                until(lambda: page.is_answering(1))
                until(lambda: not page.is_answering(1))
            until(lambda: page.is_answering(0))
        until(lambda: not page.is_answering(0))


def test_server_closes_while_a_browser_does_not_respond():
    page = ViewServer(port=0)
    with socket.create_connection(("127.0.0.1", page.port), timeout=10.0) as vanished:
        host = f"Host: 127.0.0.1:{page.port}"
        vanished.sendall("\r\n".join(["GET / HTTP/1.1", host, *WEBSOCKET, "", ""]).encode())
        assert vanished.recv(1).startswith(b"H")
        page.close()
        assert vanished.fileno() >= 0, "the browser has not closed its end"


def test_server_closes_while_a_browser_has_sent_nothing():
    before = set(threading.enumerate())
    page = ViewServer(port=0)
    with socket.create_connection(("127.0.0.1", page.port), timeout=10.0):
        page.close()
        assert set(threading.enumerate()) == before


def test_taken_port_is_an_error_and_the_default_is_the_next_free_one():
    with ViewServer(port=find_free_port()) as first:
        with pytest.raises(InvalidInput, match=f"port {first.port} is taken"):
            ViewServer(port=first.port)
        with ViewServer() as second, ViewServer() as third:
            assert len({first.port, second.port, third.port}) == 3
            assert [status(page.url) for page in (second, third)] == [200, 200]


@pytest.mark.parametrize(("host", "port"), [("nowhere.invalid", 0), ("127.0.0.1", 99999)])
def test_unusable_host_or_port_raises_invalid_input(host: str, port: int):
    with pytest.raises(InvalidInput, match="cannot listen"):
        ViewServer(host, port)


def test_share_url_is_never_requested():
    with ViewServer(port=0) as page:
        assert page.server.request_share_url() is None


def test_server_prints_nothing(capsys: pytest.CaptureFixture[str]):
    with ViewServer(port=0) as page:
        until(lambda: listens("127.0.0.1", page.port))
    output = capsys.readouterr()
    assert "viser" not in output.out + output.err


def test_a_browser_that_a_script_has_started_ends_with_the_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """As Debian's chromium-headless-shell, which does not become the browser but starts it."""
    script, alive, started = tmp_path / "chromium-headless-shell", tmp_path / "alive", tmp_path / "started"
    script.write_text(
        f"#!/bin/sh\n(touch {started}; exec sleep 600) >{alive} &\nuntil [ -e {started} ]; do :; done\n"
    )
    script.chmod(0o755)
    os.mkfifo(alive)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    reader = os.open(alive, os.O_RDONLY | os.O_NONBLOCK)

    def has_ended() -> bool:
        """At the end of the pipe, which only the browser has open."""
        try:
            return os.read(reader, 1) == b""
        except BlockingIOError:
            return False

    try:
        with ViewServer(port=0) as page, pytest.raises(ScreenshotFailed, match="did not open the page"):
            save_screenshot(page, tmp_path / "a.png", width=8, height=8, hold=lambda _: False)
        assert started.exists()
        until(has_ended)
    finally:
        os.close(reader)
