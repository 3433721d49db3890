"""Reasons of denied connections, with real routers in a process of their own."""

from __future__ import annotations

import socket

import pytest
from helpers.access_routers import ROUTERS_PROGRAM, AccessRouters

from zstate.errors import AccessDenied, Unreachable
from zstate.net.security.credentials import Credentials
from zstate.net.session import connect


def denied(endpoint: str, credentials: Credentials | None) -> tuple[str, str]:
    """The reason and the text."""
    with pytest.raises(AccessDenied) as caught:
        connect(mode="client", endpoints=endpoint, credentials=credentials, timeout_s=0.2)
    assert caught.value.endpoint == endpoint
    assert str(caught.value).startswith(f"{endpoint!r} answers and does not let this session in: ")
    return caught.value.reason, str(caught.value)


def accepts(endpoint: str, credentials: Credentials | None) -> bool:
    with connect(mode="client", endpoints=endpoint, credentials=credentials) as session:
        return bool(list(session.zenoh.info.routers_zid()))


def test_valid_credentials_are_accepted(fleet: AccessRouters):
    assert accepts(fleet.tls("mtls"), fleet.identity("r1"))
    assert accepts(fleet.tls("mtls", "localhost"), fleet.identity("r1"))
    assert accepts(fleet.tcp("users"), Credentials(user="alice", password="wonder"))
    assert accepts(fleet.tcp("users"), Credentials(user="bob", password="build:it"))
    assert accepts(fleet.tls("mtls and users"), fleet.identity("r1", "alice", "wonder"))


def test_plain_tcp_towards_tls(fleet: AccessRouters):
    reason, text = denied(fleet.tcp("mtls"), None)
    assert reason == "TLS demanded"
    assert "write 'tls/'" in text
    assert "--certs" in text


def test_tls_towards_plain_tcp(fleet: AccessRouters):
    reason, text = denied(fleet.tls("open"), fleet.identity("r1"))
    assert reason == "no TLS there"
    assert "zstate router --certs" in text


def test_a_router_of_another_authority(fleet: AccessRouters):
    reason, text = denied(fleet.tls("mtls"), Credentials.from_folder(fleet.strangers, "r1"))
    assert reason == "wrong CA"
    assert f"not signed by '{fleet.strangers / 'ca.pem'}'" in text


def test_tls_without_a_configured_authority(fleet: AccessRouters):
    reason, text = denied(fleet.tls("mtls"), None)
    assert reason == "wrong CA"
    assert "--certs DIR" in text


def test_a_certificate_of_another_authority(fleet: AccessRouters):
    stranger = Credentials(
        ca=fleet.folder / "ca.pem", certificate=fleet.strangers / "r1.pem", key=fleet.strangers / "r1.key"
    )
    reason, text = denied(fleet.tls("mtls"), stranger)
    assert reason == "our certificate refused"
    assert f"refuses '{fleet.strangers / 'r1.pem'}'" in text


def test_no_certificate(fleet: AccessRouters):
    reason, text = denied(fleet.tls("mtls"), Credentials(ca=fleet.folder / "ca.pem"))
    assert reason == "certificate demanded"
    assert "--identity NAME" in text


@pytest.mark.parametrize("name", ["expired", "early"])
def test_certificate_outside_its_validity(fleet: AccessRouters, name: str):
    reason, text = denied(fleet.tls("mtls"), fleet.identity(name))
    assert reason == "our certificate expired"
    assert f"'{fleet.folder / name}.pem' has expired, or is not valid yet" in text
    assert "clocks" in text


@pytest.mark.parametrize(
    ("kind", "expected", "hint"),
    [
        ("expired", "their certificate expired", "renew it there"),
        ("early", "their certificate not yet valid", "clock behind"),
    ],
)
def test_router_certificate_outside_its_validity(fleet: AccessRouters, kind: str, expected: str, hint: str):
    reason, text = denied(fleet.tls(kind), fleet.identity("r1"))
    assert reason == expected
    assert hint in text


@pytest.mark.parametrize(("user", "password"), [("eve", "wonder"), ("alice", "wander")])
@pytest.mark.parametrize("kind", ["users", "mtls and users"])
def test_a_wrong_user_or_password(fleet: AccessRouters, kind: str, user: str, password: str):
    plain = kind == "users"
    given = Credentials(user=user, password=password) if plain else fleet.identity("r1", user, password)
    reason, text = denied(fleet.tcp(kind) if plain else fleet.tls(kind), given)
    assert reason == "user or password"
    assert f"the user {user!r} or the password" in text
    assert password not in text


def test_no_user_at_a_router_that_requires_one(fleet: AccessRouters):
    reason, text = denied(fleet.tcp("users"), None)
    assert reason == "user demanded"
    assert "ZSTATE_PASSWORD" in text


def test_user_at_a_router_without_users(fleet: AccessRouters):
    reason, text = denied(fleet.tcp("open"), Credentials(user="alice", password="wonder"))
    assert reason == "user or password"
    assert "a router without one refuses every session with a user" in text


def test_a_router_at_a_host_that_is_not_in_its_certificate(fleet: AccessRouters, spawn, free_port: int):
    endpoint = f"tls/127.0.0.2:{free_port}"
    spawn(ROUTERS_PROGRAM, str(fleet.folder), endpoint).line()
    reason, text = denied(endpoint, fleet.identity("r1"))
    assert reason == "name mismatch"
    assert "--host 127.0.0.2" in text


def test_zenoh_configuration_with_the_wrong_authority_has_the_same_error(fleet: AccessRouters):
    config = {
        "mode": "client",
        "connect": {"endpoints": [fleet.tls("mtls")], "timeout_ms": 200, "exit_on_failure": True},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": {"tls": {"root_ca_certificate": str(fleet.strangers / "ca.pem")}}},
    }
    with pytest.raises(AccessDenied) as caught:
        connect(config)
    assert caught.value.reason == "wrong CA"


def test_free_port_is_unreachable_and_the_refusing_endpoint_of_two_is_reported(
    fleet: AccessRouters, free_port: int
):
    unused = f"tls/127.0.0.1:{free_port}"
    with pytest.raises(Unreachable, match="nothing answers"):
        connect(mode="client", endpoints=unused, credentials=fleet.identity("r1"), timeout_s=0.2)
    with pytest.raises(AccessDenied) as caught:
        both = [unused, fleet.tls("mtls")]
        connect(mode="client", endpoints=both, credentials=fleet.identity("expired"), timeout_s=0.2)
    assert caught.value.endpoint == fleet.tls("mtls")
    assert f"nothing answers at '{unused}'" in str(caught.value)


def test_listener_without_replies_is_not_reported_as_one_without_tls(
    fleet: AccessRouters, monkeypatch: pytest.MonkeyPatch
):
    """Like the kernel, which accepts connections for a stopped router process."""
    monkeypatch.setattr("zstate.net.security.connection_check._DENIAL_TIMEOUT_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        for endpoint, credentials in (
            (f"tls/127.0.0.1:{port}", fleet.identity("r1")),
            (f"tcp/127.0.0.1:{port}", None),
        ):
            with pytest.raises(Unreachable, match="accepted and nothing is answered") as caught:
                connect(mode="client", endpoints=endpoint, credentials=credentials, timeout_s=0.2)
            assert caught.value.endpoints == (endpoint,)


def test_router_busy_with_failed_handshakes_is_not_reported_as_denial(
    fleet: AccessRouters, spawn, free_port: int
):
    """Zenoh pauses its accepting for 0.1 s after each handshake that failed."""
    endpoint = f"tls/127.0.0.1:{free_port}"
    assert spawn(ROUTERS_PROGRAM, str(fleet.folder), endpoint).line() == "ready"
    with connect(mode="client", endpoints=endpoint, credentials=fleet.identity("r1")) as session:
        for idle in [socket.create_connection(("127.0.0.1", free_port)) for _ in range(80)]:
            idle.close()
        with pytest.raises(Unreachable, match="busy with other connections that never complete"):
            connect(mode="client", endpoints=endpoint, credentials=fleet.identity("r1"), timeout_s=0.2)
        assert list(session.zenoh.info.routers_zid())


def test_idle_connections_do_not_block_a_client_of_a_router_with_users(
    fleet: AccessRouters, spawn, free_port: int
):
    """With Zenoh's default settings a hundred idle connections block it for ten seconds."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    code = """
        import sys
        from zstate.fleet.router_config import RouterConfig
        from zstate.net.security.credentials import Credentials
        from zstate.net.session import connect
        with connect(RouterConfig((sys.argv[1],), credentials=Credentials(users=sys.argv[2])).settings()):
            print("ready")
            sys.stdin.readline()
    """
    assert spawn(code, endpoint, str(fleet.folder / "users")).line() == "ready"
    idle = [socket.create_connection(("127.0.0.1", free_port)) for _ in range(300)]
    try:
        assert accepts(endpoint, Credentials(user="alice", password="wonder"))
    finally:
        for connection in idle:
            connection.close()
