"""Connection monitor: denials that are logged while sessions keep trying."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from helpers.access_routers import AccessRouters
from helpers.processes import Child, find_free_port, until

import zstate.net.connection_monitor
from zstate.net.security.credentials import Credentials
from zstate.net.session import connect

CASES: dict[str, tuple[Callable[[AccessRouters], str], Callable[[AccessRouters], Credentials | None]]] = {
    "no TLS there": (lambda fleet: fleet.tls("open"), lambda fleet: fleet.identity("r1")),
    "TLS demanded": (lambda fleet: fleet.tcp("mtls"), lambda _: None),
    "wrong CA": (
        lambda fleet: fleet.tls("mtls"),
        lambda fleet: Credentials.from_folder(fleet.strangers, "r1"),
    ),
    "our certificate expired": (lambda fleet: fleet.tls("mtls"), lambda fleet: fleet.identity("expired")),
    "their certificate expired": (lambda fleet: fleet.tls("expired"), lambda fleet: fleet.identity("r1")),
    "user or password": (
        lambda fleet: fleet.tls("mtls and users"),
        # A router sends a user only if it has a users file.
        lambda fleet: replace(fleet.identity("r1", "alice", "wander"), users=fleet.folder / "users"),
    ),
    "user demanded": (lambda fleet: fleet.tcp("users"), lambda _: None),
}


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """The monitor checks every tenth of a second."""
    monkeypatch.setattr(zstate.net.connection_monitor, "FIRST_PERIOD_S", 0.1)
    monkeypatch.setattr(zstate.net.connection_monitor, "PERIOD_S", 0.1)


def denials(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    """The reasons and texts that were logged."""
    records = [record for record in caplog.records if record.name == "zstate"]
    assert {record.levelno for record in records} <= {logging.WARNING}
    refused = [record for record in records if record.__dict__["event"] == "refused"]
    return [(record.__dict__["reason"], record.getMessage()) for record in refused]


def free_endpoint(credentials: Credentials | None) -> str:
    is_encrypted = credentials is not None and credentials.ca is not None
    return f"{'tls' if is_encrypted else 'tcp'}/127.0.0.1:{find_free_port()}"


@pytest.mark.parametrize("mode", ["peer", "router"])
@pytest.mark.parametrize("reason", CASES)
def test_refused_session_that_keeps_trying_logs_the_reason(
    fleet: AccessRouters, caplog: pytest.LogCaptureFixture, mode: str, reason: str
):
    endpoint, credentials = (choose(fleet) for choose in CASES[reason])
    where = free_endpoint(credentials)
    with connect(mode=mode, endpoints=endpoint, listen=where, credentials=credentials):
        until(lambda: denials(caplog))
    ((logged, text),) = denials(caplog)
    assert logged == reason
    assert text.startswith(f"{endpoint!r} answers and does not let this session in: ")
    assert text.endswith("; still trying")


def test_session_of_a_zenoh_configuration_logs_the_reason(
    fleet: AccessRouters, caplog: pytest.LogCaptureFixture
):
    config = {
        "mode": "router",
        "connect": {"endpoints": [fleet.tcp("users")]},
        "listen": {"endpoints": [free_endpoint(None)]},
    }
    with connect(config):
        until(lambda: denials(caplog))
    assert denials(caplog)[0][0] == "user demanded"


def test_only_refusing_endpoints_are_logged_and_once(fleet: AccessRouters, caplog: pytest.LogCaptureFixture):
    first, second = (f"tcp/127.0.0.1:{find_free_port()}" for _ in range(2))
    unused, refusing = f"tcp/127.0.0.1:{find_free_port()}", fleet.tcp("users")
    # Each connects to the other, and one link remains.
    settings = {"endpoints": [unused, second, fleet.tcp("open"), refusing], "listen": first}
    with connect(endpoints=first, listen=second), connect(**settings) as session:
        until(lambda: len(session.zenoh.info.transports()) >= 2)
        until(lambda: denials(caplog))
        with connect(endpoints=fleet.tcp("users"), listen=free_endpoint(None)):
            until(lambda: len(denials(caplog)) == 2)
    assert {text.partition(" ")[0] for _, text in denials(caplog)} == {repr(refusing)}


ROUTER = """
    import sys
    from zstate.net.security.credentials import Credentials
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1], credentials=Credentials(users=sys.argv[2])):
        print("ready")
        sys.stdin.readline()
"""


@pytest.fixture
def routers(spawn: Callable[..., Child], tmp_path: Path) -> Callable[[str, str], Child]:
    """``start(endpoint, user)``: a router in a process of its own that lets only that user in."""

    def start(endpoint: str, user: str) -> Child:
        users = tmp_path / user
        users.touch(0o600)
        users.write_text(f"{user}:wonder\n")
        child = spawn(ROUTER, endpoint, str(users))
        assert child.line() == "ready"
        return child

    return start


ALICE = Credentials(user="alice", password="wonder")


def test_client_logs_a_refusing_router_that_replaced_its_own(
    routers: Callable[[str, str], Child], caplog: pytest.LogCaptureFixture, free_port: int
):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    own = routers(endpoint, "alice")
    with connect(mode="client", endpoints=endpoint, credentials=ALICE):
        own.kill()
        routers(endpoint, "eve")
        until(lambda: denials(caplog))
    assert [reason for reason, _ in denials(caplog)] == ["user or password"]


def test_refusal_is_logged_again_after_a_link(
    routers: Callable[[str, str], Child], caplog: pytest.LogCaptureFixture, free_port: int
):
    endpoint, other = f"tcp/127.0.0.1:{free_port}", f"tcp/127.0.0.1:{find_free_port()}"
    stranger = routers(endpoint, "eve")
    with connect(endpoints=[endpoint, other], listen=free_endpoint(None), credentials=ALICE) as session:
        until(lambda: len(denials(caplog)) == 1)
        stranger.kill()
        own = routers(endpoint, "alice")
        until(session.zenoh.info.routers_zid)
        routers(other, "eve")
        until(lambda: len(denials(caplog)) == 2)  # it has checked while there was a link
        own.kill()
        routers(endpoint, "eve")
        until(lambda: len(denials(caplog)) == 3)
    assert [text.partition(" ")[0] for _, text in denials(caplog)] == [
        repr(e) for e in (endpoint, other, endpoint)
    ]


def test_a_peer_with_credentials_is_warned_at_a_router_and_a_client_is_not(
    fleet: AccessRouters, caplog: pytest.LogCaptureFixture
):
    endpoint, identity = fleet.tls("mtls"), fleet.identity("r1")
    with (
        connect(mode="client", endpoints=endpoint, credentials=identity),
        connect(endpoints=endpoint, listen=free_endpoint(identity), credentials=identity),
    ):
        until(lambda: warnings(caplog))
    ((event, text),) = warnings(caplog)
    assert event == "bypass"
    assert text.startswith(f"{endpoint!r}: this session is a peer of a router")
    assert "mode='client'" in text


def warnings(caplog: pytest.LogCaptureFixture) -> list[tuple[str, str]]:
    records = [record for record in caplog.records if record.name == "zstate"]
    return [(record.__dict__["event"], record.getMessage()) for record in records]
