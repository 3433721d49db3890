from __future__ import annotations

from pathlib import Path

import pytest
from helpers.access_routers import AccessRouters
from helpers.processes import Child, until

from zstate.errors import ConfigError, PortBusy, Unreachable
from zstate.net.environment import implied_mode
from zstate.net.session import connect
from zstate.net.streams import KeyPublisher, StreamSubscriber

ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("ready")
        sys.stdin.readline()
"""


@pytest.fixture
def router(free_port: int) -> str:
    return f"tcp/127.0.0.1:{free_port}"


def test_connect_without_arguments_reads_the_environment(spawn, router, monkeypatch):
    child: Child = spawn(ROUTER, router)
    assert child.line() == "ready"
    monkeypatch.setenv("ZSTATE_CONNECT", f" {router} ")  # without a mode: a client
    with (
        connect() as session,
        connect(mode="client", endpoints=router) as given,
        KeyPublisher(given, "somewhere", "") as writer,
        StreamSubscriber(session, "somewhere", lambda _: None),
    ):
        until(lambda: writer.has_readers)


@pytest.mark.parametrize("given", [{"mode": "peer"}, {"config": {}}, {"listen": "tcp/127.0.0.1:0"}])
def test_any_argument_overrides_the_environment(monkeypatch: pytest.MonkeyPatch, given):
    monkeypatch.setenv("ZSTATE_MODE", "client")  # without endpoints: an error if it were read
    with connect(**given):
        pass


def test_empty_variables_are_ignored(monkeypatch: pytest.MonkeyPatch):
    for variable in ("ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"):
        monkeypatch.setenv(variable, "")
    with (
        connect() as one,
        connect() as other,
        KeyPublisher(one, "here", "") as writer,
        StreamSubscriber(other, "here", lambda _: None),
    ):
        until(lambda: writer.has_readers)


@pytest.mark.parametrize(
    ("variables", "path", "expected"),
    [
        (
            {"ZSTATE_MODE": "broker"},
            "ZSTATE_MODE",
            "ZSTATE_MODE in the environment: 'broker' is not a mode; the modes are",
        ),
        (
            {"ZSTATE_MODE": "client"},
            "ZSTATE_MODE",
            "ZSTATE_MODE is 'client' and ZSTATE_CONNECT is not set",
        ),
        (
            {"ZSTATE_CONNECT": "tcp/here:1 router"},
            "ZSTATE_CONNECT",
            "ZSTATE_CONNECT in the environment: 'router' is not an end",
        ),
        (
            {"ZSTATE_LISTEN": "localhost:1"},
            "ZSTATE_LISTEN",
            "ZSTATE_LISTEN in the environment: 'localhost:1' is not .* 'tcp/",
        ),
        (
            {"ZSTATE_MODE": "loopback", "ZSTATE_LISTEN": "tcp/0.0.0.0:1"},
            "ZSTATE_LISTEN",
            "ZSTATE_LISTEN .* leaves this host",
        ),
        (
            {"ZSTATE_CONNECT": "tls/here:1", "ZSTATE_CERTS": "x"},
            "ZSTATE_CERTS",
            "ZSTATE_CERTS is set but ZSTATE_IDENTITY is not",
        ),
        (
            {"ZSTATE_CONNECT": "tls/here:1", "ZSTATE_IDENTITY": "x"},
            "ZSTATE_IDENTITY",
            "ZSTATE_IDENTITY is set but ZSTATE_CERTS is not",
        ),
        (
            {"ZSTATE_CONNECT": "tcp/here:1", "ZSTATE_USER": "eve"},
            "ZSTATE_PASSWORD",
            "'eve' .*ZSTATE_USER.* into ZSTATE_PASSWORD,",
        ),
    ],
)
def test_error_names_the_invalid_variable(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], path: str, expected: str
):
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    with pytest.raises(ConfigError, match=expected) as caught:
        connect()
    assert caught.value.path == path


def test_unreachable_and_busy_endpoint_errors_name_their_variable(
    spawn, router: str, monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as variables:
        variables.setenv("ZSTATE_CONNECT", router)
        with pytest.raises(
            Unreachable, match="the endpoint is from ZSTATE_CONNECT in the environment"
        ) as caught:
            connect(timeout_s=0.2)
        assert caught.value.endpoints == (router,)
    spawn(ROUTER, router).line()
    monkeypatch.setenv("ZSTATE_LISTEN", router)
    with pytest.raises(PortBusy, match="the endpoint is from ZSTATE_LISTEN in the environment"):
        connect()


def test_credentials_are_read_with_the_endpoint(
    fleet: AccessRouters, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("ZSTATE_CONNECT", fleet.tls("mtls and users"))
    monkeypatch.setenv("ZSTATE_CERTS", str(fleet.folder))
    monkeypatch.setenv("ZSTATE_IDENTITY", "r1")
    monkeypatch.setenv("ZSTATE_USER", "alice")
    password = tmp_path / "password"
    password.touch(0o600)
    password.write_text("wonder\n")
    monkeypatch.setenv("ZSTATE_PASSWORD_FILE", str(password))
    connect().close()
    password.write_text("\n")
    with pytest.raises(ConfigError, match="the first line of the password file"):
        connect()


def test_only_connect_endpoints_imply_a_client():
    assert implied_mode(("tcp/a:1",), (), None) == "client"
    assert implied_mode(("tcp/a:1",), ("tcp/b:1",), None) == "peer"
    assert implied_mode(("tcp/a:1",), (), "file.json5") == "peer"
    assert implied_mode((), (), None) == "peer"
