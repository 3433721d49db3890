"""FoxgloveServer: frames as foxglove-sdk's server sends them, access checks, and slow clients."""

from __future__ import annotations

import json
import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.client import HTTPConnection
from typing import Any

import foxglove
import pytest
from foxglove.websocket import Capability
from helpers.foxglove_client import FoxgloveClient
from helpers.processes import until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from zstate.errors import InvalidInput
from zstate.foxglove.server import FoxgloveServer, ServedChannel, ServedMessage, _Client
from zstate.wire.ros2.types import STRING, TF_MESSAGE

TF = ServedChannel(1, "/tf", TF_MESSAGE)
TEXT = ServedChannel(2, "/text", STRING)


def frames(url: str, requests: list[dict[str, Any]], count: int) -> list[Any]:
    """The first ``count`` frames of a server that is sent these requests; JSON is parsed."""
    with connect(url, subprotocols=["foxglove.sdk.v1"], compression=None) as websocket:
        for request in requests:
            websocket.send(json.dumps(request))
        received = [websocket.recv(5.0) for _ in range(count)]
    return [json.loads(frame) if isinstance(frame, str) else frame for frame in received]


@contextmanager
def sdk_server() -> Iterator[tuple[str, foxglove.Channel]]:
    """foxglove-sdk's server with the channel TF, and the parameter "a"."""

    class Listener:
        def on_subscribe(self, client: Any, channel: Any) -> None:
            sent.log(b"payload", log_time=7)
            server.broadcast_time(9)

        def on_get_parameters(
            self, client: Any, names: list[str], request_id: str | None = None
        ) -> list[Any]:
            return [foxglove.websocket.Parameter("a", value="text")]

    context = foxglove.Context()
    schema = foxglove.Schema(name=TF_MESSAGE.name, encoding="ros2msg", data=TF_MESSAGE.definition.encode())
    capabilities = [Capability.Parameters, Capability.Time]
    server = foxglove.start_server(
        name="zstate", port=0, capabilities=capabilities, server_listener=Listener(), context=context
    )
    sent = foxglove.Channel(TF.topic, schema=schema, message_encoding="cdr", context=context)
    try:
        yield f"ws://127.0.0.1:{server.port}", sent
    finally:
        server.stop()


def test_frames_are_those_of_the_sdk():
    get = {"op": "getParameters", "parameterNames": [], "id": "all"}

    def subscribe(number: int) -> dict[str, Any]:
        return {"op": "subscribe", "subscriptions": [{"id": 42, "channelId": number}]}

    with sdk_server() as (url, channel):
        expected = frames(url, [get, subscribe(channel.id())], 5)
    # Its server sends what it was asked for before or after what it advertises.
    (advertised,) = [one for one in expected if isinstance(one, dict) and "channels" in one]
    advertised["channels"][0]["id"] = TF.number
    with FoxgloveServer(port=0) as server:
        server.set_time(8)
        server.set_parameter("a", "text")
        server.advertise(TF)

        def on_readers() -> None:
            server.send([ServedMessage(TF.number, b"payload", 7)])
            until(lambda: server.stats.sent)
            server.set_time(9)

        server.on_readers = lambda: server._loop.run_in_executor(None, on_readers)
        found = frames(server.url, [get, subscribe(TF.number)], 5)
    differing = {"metadata": None, "sessionId": None}
    found[0], expected[0] = found[0] | differing, expected[0] | differing
    found[0]["capabilities"].sort()
    expected[0]["capabilities"].sort()

    def in_one_order(received: list[Any]) -> list[Any]:
        return sorted(received, key=str)

    assert in_one_order(found) == in_one_order(expected)


@pytest.fixture
def server() -> Iterator[FoxgloveServer]:
    with FoxgloveServer(port=0) as opened:
        opened.advertise(TF)
        opened.advertise(TEXT)
        yield opened


@pytest.mark.parametrize(("size", "kept"), [(100, 1024), (2**20, 32)], ids=["1024", "32 MiB"])
def test_the_queue_of_a_client_has_1024_messages_and_32_mib_at_most(
    server: FoxgloveServer, size: int, kept: int
):
    with connect(server.url, subprotocols=["foxglove.sdk.v1"]) as websocket:
        client = _Client(websocket)  # of which nothing is sent
        for stamp in range(kept):
            client.put(ServedMessage(TF.number, bytes(size), stamp))
        assert client.dropped == 0
        client.put(ServedMessage(TF.number, b"1", kept))
        assert client.dropped == 1


def test_states_are_sent_before_clouds_and_no_cloud_drops_one(server: FoxgloveServer):
    with connect(server.url, subprotocols=["foxglove.sdk.v1"]) as websocket:
        client = _Client(websocket)  # of which nothing is sent
        client.subscriptions = {TF.number: 7, TEXT.number: 8}
        for stamp in range(1024):
            client.put(ServedMessage(TEXT.number, bytes(2**16), stamp, is_bulk=True))
            client.put(ServedMessage(TF.number, b"pose", stamp))
        kept = 2**25 // 2**16
        assert client.dropped == 1024 - kept
        sent = [client._next_frame() for _ in range(2048)]
    found = [struct.unpack_from("<BIQ", frame)[1:] for frame in sent if isinstance(frame, bytes)]
    assert found == [
        *((7, stamp) for stamp in range(1024)),
        *((8, stamp) for stamp in range(1024 - kept, 1024)),
    ]


def test_a_cloud_that_is_larger_than_the_queue_is_sent(server: FoxgloveServer):
    with FoxgloveClient(server.url) as client:
        client.subscribe("/tf")
        client.drain()
        server.send([ServedMessage(TF.number, bytes(40 * 2**20), 1)])
        client.until(lambda: client.frames.get("/tf"))
    assert [len(payload) for _, payload in client.frames["/tf"]] == [40 * 2**20]


def test_a_slow_client_loses_its_oldest_messages_and_delays_no_other(server: FoxgloveServer):
    payload, total = bytes(40_000), 3 * 1024
    # A client that does not read: its socket has room for a few hundred of these messages.
    with FoxgloveClient(server.url) as fast, FoxgloveClient(server.url, max_queue=1) as slow:
        for client in (fast, slow):
            client.subscribe("/tf", "/text")
            client.drain()
        for k in range(total):
            server.send([ServedMessage(TF.number, payload, k)])
            if k % 128 == 127:
                server.send([ServedMessage(TEXT.number, b"%d" % k, k, key="latched")])
                fast.until(lambda k=k: len(fast.frames.get("/tf", ())) == k + 1)
        assert [stamp for stamp, _ in fast.frames["/tf"]] == list(range(total))
        dropped = server.stats.dropped
        assert dropped > total - 2 * 1024
        slow.until(lambda: slow.frames.get("/tf", [(0, b"")])[-1][0] == total - 1)
        assert len(slow.frames["/tf"]) == total - dropped
        assert slow.frames["/text"][-1][1] == b"%d" % (total - 1)
        assert any("too slowly" in one["message"] for one in slow.statuses)


@pytest.mark.parametrize(
    ("request_", "text"),
    [
        ("no JSON", "an invalid request"),
        ("[]", "a request is a JSON object"),
        (b"\x01", "a request is a JSON object"),
        ('{"op": "advertise", "channels": []}', "the operation 'advertise' is not supported"),
        ('{"op": "subscribe"}', "an invalid request: KeyError('subscriptions')"),
        ('{"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 99}]}', "there is no channel 99"),
        ('{"op": "subscribe", "subscriptions": [{"id": -1, "channelId": 1}]}', "an invalid request"),
        ('{"op": "setParameters", "parameters": [{"name": "a", "value": 1}]}', "not set here"),
        ('{"op": "subscribe", "subscriptions": [{"id": 1e999, "channelId": 1}]}', "an invalid request"),
        ("[" * 100_000, "an invalid request"),
    ],
)
def test_invalid_requests_are_answered_and_the_connection_stays(
    server: FoxgloveServer, request_: str | bytes, text: str
):
    with FoxgloveClient(server.url) as client:
        client.websocket.send(request_)
        client.until(lambda: client.statuses)
        assert text in client.statuses[0]["message"]
        client.subscribe("/tf")
        client.drain()
        assert server.is_read(TF.number)
    until(lambda: not server.is_read(TF.number))


def test_pages_of_other_sites_are_refused_with_a_reason_for_the_user():
    events: list[str] = []
    with FoxgloveServer(port=0, origins=["http://lichtblick.lan"], on_event=events.append) as server:
        for origin in ("https://app.foxglove.dev", "file://", "http://lichtblick.lan", None):
            with FoxgloveClient(server.url, subprotocol="foxglove.websocket.v1", origin=origin):
                pass
        with pytest.raises(InvalidStatus) as refused:
            FoxgloveClient(server.url, origin="https://evil.example")
        assert refused.value.response.status_code == 403
        with pytest.raises(InvalidStatus) as refused:
            FoxgloveClient(server.url, subprotocol="other")
        assert refused.value.response.status_code == 400
        page = HTTPConnection("127.0.0.1", server.port)
        page.request("GET", "/")
        answer = page.getresponse()
        assert (answer.status, server.url in answer.read().decode()) == (426, True)
        page.close()
        until(lambda: any("refused" in event for event in events))
    (refusal,) = [event for event in events if "refused" in event]
    assert "a page of 'https://evil.example' may not use `zstate foxglove`; --allow-origin" in refusal


@pytest.mark.parametrize(
    "names", [["x" * 100_000], [str(number) for number in range(5000)]], ids=["long name", "many names"]
)
def test_what_a_client_watches_is_bounded(server: FoxgloveServer, names: list[str]):
    with FoxgloveClient(server.url) as client:
        client.request("subscribeParameterUpdates", parameterNames=["a"])
        client.request("subscribeParameterUpdates", parameterNames=names)
        client.until(lambda: client.statuses)
        assert "a client may watch 4096 parameters" in client.statuses[0]["message"]
        (served,) = server._clients.values()
        assert served.watched == {"a"}
        server.set_parameter("a", "text")
        client.until(lambda: client.parameters == {"a": "text"})


def test_clients_beyond_the_limit_are_refused_until_one_leaves(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("zstate.foxglove.server._MAX_CLIENTS", 2)
    events: list[str] = []
    with FoxgloveServer(port=0, on_event=events.append) as server:
        with FoxgloveClient(server.url), FoxgloveClient(server.url):
            for _ in range(2):
                with pytest.raises(InvalidStatus) as refused:
                    FoxgloveClient(server.url)
                assert refused.value.response.status_code == 503
        until(lambda: server.stats.clients == 0)
        with FoxgloveClient(server.url):
            pass
    assert sum("2 clients are connected, which is the limit" in event for event in events) == 1


def test_beyond_loopback_clients_need_the_token():
    with FoxgloveServer("0.0.0.0", 0) as server:
        here = f"ws://127.0.0.1:{server.port}"
        assert server.url.endswith(f"/?token={server.access.token}")
        with pytest.raises(InvalidStatus) as refused:
            FoxgloveClient(here)
        assert refused.value.response.status_code == 401
        with FoxgloveClient(f"{here}/?token={server.access.token}") as client:
            assert client.infos[0]["name"] == "zstate"


def test_a_taken_port_and_an_unusable_host_are_refused():
    with FoxgloveServer(port=0) as server, pytest.raises(InvalidInput, match=f"port {server.port} is taken"):
        FoxgloveServer(port=server.port)
    with pytest.raises(InvalidInput, match=r"cannot listen at '192\.0\.2\.1'"):
        FoxgloveServer("192.0.2.1", 0)


def test_server_closes_while_a_client_has_sent_nothing():
    before = set(threading.enumerate())
    server = FoxgloveServer(port=0)
    with socket.create_connection(("127.0.0.1", server.port), timeout=10.0):
        server.close()
        assert set(threading.enumerate()) == before
