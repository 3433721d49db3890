from __future__ import annotations

from pathlib import Path

import pytest
from helpers.access_routers import AccessRouters
from helpers.processes import Child, until

from zstate.errors import ConfigError, PortBusy, Unreachable
from zstate.net.config import implied_mode
from zstate.net.session import connect
from zstate.net.streams import StreamPublisher, StreamSubscriber

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


def test_a_program_that_says_nothing_joins_where_the_environment_says(spawn, router, monkeypatch):
    child: Child = spawn(ROUTER, router)
    assert child.line() == "ready"
    monkeypatch.setenv("ZSTATE_CONNECT", f" {router} ")  # and so is a client
    with (
        connect() as said,
        connect(mode="client", endpoints=router) as given,
        StreamPublisher(given, "somewhere", "") as writer,
        StreamSubscriber(said, "somewhere", lambda _: None),
    ):
        until(lambda: writer.has_readers)


@pytest.mark.parametrize("given", [{"mode": "peer"}, {"config": {}}, {"listen": "tcp/127.0.0.1:0"}])
def test_whoever_says_anything_is_not_sent_elsewhere(monkeypatch: pytest.MonkeyPatch, given):
    monkeypatch.setenv("ZSTATE_MODE", "client")  # without a place to connect to: an error if it were read
    with connect(**given):
        pass


def test_empty_variables_say_nothing(monkeypatch: pytest.MonkeyPatch):
    for variable in ("ZSTATE_MODE", "ZSTATE_CONNECT", "ZSTATE_LISTEN", "ZSTATE_CONFIG"):
        monkeypatch.setenv(variable, "")
    with (
        connect() as one,
        connect() as other,
        StreamPublisher(one, "here", "") as writer,
        StreamSubscriber(other, "here", lambda _: None),
    ):
        until(lambda: writer.has_readers)


@pytest.mark.parametrize(
    ("variables", "told"),
    [
        ({"ZSTATE_MODE": "broker"}, "ZSTATE_MODE in the environment: 'broker' is not a mode; the modes are"),
        ({"ZSTATE_MODE": "client"}, "ZSTATE_MODE is 'client', and ZSTATE_CONNECT does not say where"),
        (
            {"ZSTATE_CONNECT": "tcp/here:1 router"},
            "ZSTATE_CONNECT in the environment: 'router' is not an end",
        ),
        ({"ZSTATE_LISTEN": "localhost:1"}, "ZSTATE_LISTEN in the environment: 'localhost:1' is not .* 'tcp/"),
        ({"ZSTATE_MODE": "loopback", "ZSTATE_LISTEN": "tcp/0.0.0.0:1"}, "ZSTATE_LISTEN .* leaves this host"),
        ({"ZSTATE_CONNECT": "tls/here:1", "ZSTATE_CERTS": "x"}, "ZSTATE_CERTS .* without ZSTATE_IDENTITY"),
        ({"ZSTATE_CONNECT": "tls/here:1", "ZSTATE_IDENTITY": "x"}, "ZSTATE_IDENTITY .* without ZSTATE_CERTS"),
        (
            {"ZSTATE_CONNECT": "tcp/here:1", "ZSTATE_USER": "eve"},
            "'eve' .*ZSTATE_USER.* into ZSTATE_PASSWORD,",
        ),
    ],
)
def test_what_cannot_be_used_is_told_with_the_variable_it_comes_from(
    monkeypatch: pytest.MonkeyPatch, variables: dict[str, str], told: str
):
    for variable, value in variables.items():
        monkeypatch.setenv(variable, value)
    with pytest.raises(ConfigError, match=told) as caught:
        connect()
    assert caught.value.path in variables or caught.value.path == "ZSTATE_PASSWORD"


def test_a_place_where_nobody_answers_or_somebody_listens_is_told_with_its_variable(
    spawn, router: str, monkeypatch: pytest.MonkeyPatch
):
    with monkeypatch.context() as variables:
        variables.setenv("ZSTATE_CONNECT", router)
        with pytest.raises(Unreachable, match="ZSTATE_CONNECT in the environment says where") as caught:
            connect(timeout_s=0.2)
        assert caught.value.endpoints == (router,)
    spawn(ROUTER, router).line()
    monkeypatch.setenv("ZSTATE_LISTEN", router)
    with pytest.raises(PortBusy, match="ZSTATE_LISTEN in the environment says where"):
        connect()


def test_who_a_program_is_comes_with_where_it_joins(
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
    with pytest.raises(ConfigError, match="nothing in its first line"):
        connect()


def test_only_a_place_to_connect_to_means_a_router():
    assert implied_mode(("tcp/a:1",), (), None) == "client"
    assert implied_mode(("tcp/a:1",), ("tcp/b:1",), None) == "peer"
    assert implied_mode(("tcp/a:1",), (), "file.json5") == "peer"
    assert implied_mode((), (), None) == "peer"
