"""Faults of Zenoh and CPython that zstate works around: each test fails once its fault is mended.

Then the code under the comment "delete when fixed" can go, with the test. An error's texts are in
test_zenoh_texts.py.
"""

from __future__ import annotations

import asyncio
import gc
import inspect
import json
import math
import signal
import socket
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path

import pytest
import zenoh
from helpers.processes import Child, find_free_port, until

NEVER_S = 2.0
"""A program that has not gone on after this time hangs; it takes a hundredth of that."""


def configuration(settings: Mapping[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {"scouting/multicast/enabled": False, **settings}.items():
        config.insert_json5(key, json.dumps(value))
    return config


def hangs(child: Child) -> bool:
    """Whether a child that has printed "begin" prints nothing more."""
    assert child.line() == "begin"
    try:
        child.line(NEVER_S)
    except AssertionError:
        return True
    return False


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_queries_wait_for_a_closed_session_that_had_an_equal_queryable(mode: str, free_port: int) -> None:
    """Session.on_queryable_end."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    hub_mode = "router" if mode == "client" else "peer"
    settings = {"mode": mode, "connect/endpoints": [endpoint]}
    if mode == "peer":
        settings["listen/endpoints"] = ["tcp/127.0.0.1:0"]
    with (
        zenoh.open(configuration({"mode": hub_mode, "listen/endpoints": [endpoint]})) as hub,
        zenoh.open(configuration(settings)) as other,
    ):
        first = zenoh.open(configuration(settings))
        queryables = [
            one.declare_queryable("key", lambda query: query.reply("key", b"")) for one in (first, other)
        ]

        every = {"target": zenoh.QueryTarget.ALL, "consolidation": zenoh.ConsolidationMode.NONE}
        until(lambda: len(list(hub.get("key", **every))) == len(queryables))
        queryables[0].undeclare()
        first.close()
        until(lambda: len(list(hub.info.transports())) == 1)
        # Zenoh's error at a timeout is a reply.
        assert [reply.ok is None for reply in hub.get("key", timeout=0.5)] == [False, True]


@pytest.mark.long
def test_a_channel_full_of_own_replies_blocks_the_session(spawn) -> None:
    """net.queryable._NEVER_FULL."""
    code = """
        import sys, zenoh
        session = zenoh.open(zenoh.Config.from_json5('{scouting: {multicast: {enabled: false}}}'))
        tokens = [session.liveliness().declare_token(f"token/{number}") for number in range(300)]
        print("begin", flush=True)
        print(len(list(session.liveliness().get("token/*"))), flush=True)
    """
    assert hangs(spawn(code))


@pytest.mark.parametrize("timeout_s", [math.inf, 1e300])
def test_long_timeouts_are_negative(timeout_s: float) -> None:
    """net.queryable._LONGEST_TIMEOUT_S."""
    with zenoh.open(configuration({})) as session, pytest.raises(ValueError, match="negative timeout"):
        session.get("key", timeout=timeout_s)


def test_a_client_spends_its_timeout_on_its_first_endpoint(free_port: int) -> None:
    """net.user_config.connect_timeout."""
    endpoints = [f"tcp/127.0.0.1:{find_free_port()}", f"tcp/127.0.0.1:{free_port}"]
    client = {"mode": "client", "connect/endpoints": endpoints}
    with zenoh.open(configuration({"mode": "router", "listen/endpoints": endpoints[1:]})):
        zenoh.open(configuration(client | {"connect/timeout_ms": 0})).close()
        with pytest.raises(zenoh.ZError, match="Unable to connect"):
            zenoh.open(configuration(client | {"connect/timeout_ms": 300}))


@pytest.mark.long
def test_closing_a_session_in_a_forked_child_hangs(spawn) -> None:
    """net.at_exit.leak."""
    code = """
        import os, signal, sys, zenoh
        session = zenoh.open(zenoh.Config.from_json5('{scouting: {multicast: {enabled: false}}}'))
        child = os.fork()
        if child == 0:
            print("begin", flush=True)
            session.close()
            print("closed", flush=True)
        else:
            sys.stdin.readline()
            os.kill(child, signal.SIGKILL)
        os._exit(0)
    """
    parent = spawn(code)
    assert hangs(parent)
    parent.send_line()
    parent.wait()


@pytest.mark.skipif(sys.version_info >= (3, 14), reason="python/cpython#87135 is mended in 3.14")
def test_a_thread_that_receives_aborts_the_interpreter_at_exit(spawn) -> None:
    """net.at_exit, its exit thread."""
    code = """
        import threading, zenoh
        session = zenoh.open(zenoh.Config.from_json5('{scouting: {multicast: {enabled: false}}}'))
        subscriber = session.declare_subscriber("key", zenoh.handlers.RingChannel(10))
        received = threading.Event()

        def receive():
            while True:
                subscriber.recv()
                received.set()

        def publish():
            while True:
                session.put("key", b"")

        threading.Thread(target=receive, daemon=True).start()
        threading.Thread(target=publish, daemon=True).start()
        received.wait()
    """
    children = (spawn(code, is_forked=False) for _ in range(100))  # most of them abort
    assert any(child.wait() == -signal.SIGABRT for child in children)


def test_an_open_session_cannot_be_made_to_connect() -> None:
    """net.rendezvous.RendezvousRegistration, its temporary peer."""
    names = {*dir(zenoh.Session), *dir(zenoh.SessionInfo)}
    assert not [name for name in names if "connect" in name]


def test_channels_have_no_receive_with_a_timeout() -> None:
    """net.presence._POLL_S."""
    assert list(inspect.signature(zenoh.Subscriber.recv).parameters) == ["self"]


def test_the_stub_has_a_matching_status_for_a_bool() -> None:
    """net.rendezvous.RendezvousRegistration.is_registered."""
    stub = Path(zenoh.__file__).with_name("__init__.pyi").read_text()
    assert "def matching_status(self) -> bool" in stub
    with zenoh.open(configuration({})) as session:
        assert isinstance(session.declare_publisher("key").matching_status, zenoh.MatchingStatus)


async def accept_and_close(turns: int) -> None:
    """Close a server some turns of the event loop after a client has connected."""
    server = await asyncio.start_server(lambda reader, writer: writer.close(), "127.0.0.1", 0)
    with socket.create_connection(server.sockets[0].getsockname()):
        for _ in range(turns):
            await asyncio.sleep(0)
        server.close()
        await asyncio.sleep(0.01)


def test_asyncio_leaves_a_connection_open_that_it_accepts_while_it_closes() -> None:
    """web_access.end_openings."""
    unclosed: list[str] = []
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        patch.setattr(sys, "unraisablehook", lambda raised: unclosed.append(str(raised.exc_value)))
        for turns in range(6):
            asyncio.run(accept_and_close(turns))
            gc.collect()
    assert any("unclosed transport" in text for text in unclosed)
