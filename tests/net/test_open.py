"""Connection retries of clients with one or several routers."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import pytest
import zenoh
from helpers.processes import Child, find_free_port

from zstate.errors import AccessDenied, PortBusy, Unreachable
from zstate.net.security.credentials import Credentials
from zstate.net.session import connect
from zstate.net.user_config import connect_timeout

LONG_S = 60.0

ROUTER = """
    import sys
    from zstate.net.session import connect
    sys.stdin.readline()
    with connect(mode="router", listen=sys.argv[1]):
        print("ready")
        sys.stdin.readline()
"""
STRANGER = Credentials(user="eve", password="wonder")


@pytest.fixture
def router(spawn: Callable[..., Child], free_port: int) -> str:
    """Endpoint of a router without users, which refuses every user name."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = spawn(ROUTER, endpoint)
    child.send_line()
    assert child.line() == "ready"
    return endpoint


def nowhere() -> str:
    return f"tcp/127.0.0.1:{find_free_port()}"


def client(endpoints: list[str], **connecting: object) -> dict[str, object]:
    """A Zenoh configuration."""
    multicast = {"multicast": {"enabled": False}}
    return {"mode": "client", "connect": {"endpoints": endpoints, **connecting}, "scouting": multicast}


def test_refusal_by_all_endpoints_raises_before_the_timeout(router: str):
    began = time.monotonic()
    for arguments in (
        {"mode": "client", "endpoints": router, "timeout_s": LONG_S},
        {"config": client([router], timeout_ms=60_000)},
        {"config": client([router], timeout_ms=-1)},
    ):
        with pytest.raises(AccessDenied):
            connect(**arguments, credentials=STRANGER)
    assert time.monotonic() - began < LONG_S


def test_endpoint_that_is_not_up_yet_may_accept_after_a_refusal(router: str):
    with pytest.raises(AccessDenied, match="nothing answers at") as caught:
        connect(mode="client", endpoints=[nowhere(), router], credentials=STRANGER, timeout_s=0.2)
    assert caught.value.endpoint == router


def test_connect_waits_for_a_router_that_starts_later(spawn: Callable[..., Child], free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = spawn(ROUTER, endpoint)
    with pytest.raises(Unreachable):
        connect(mode="client", endpoints=endpoint, timeout_s=0.1)
    child.send_line()
    with connect(mode="client", endpoints=endpoint, timeout_s=LONG_S) as session:
        assert session.zenoh.info.routers_zid()


@pytest.mark.parametrize("waiting", [{}, {"timeout_ms": 60_000}, {"timeout_ms": {"client": -1}}])
def test_dead_endpoint_in_a_zenoh_configuration_causes_no_delay(router: str, waiting: dict[str, object]):
    began = time.monotonic()
    with connect(client([nowhere(), router], **waiting)) as session:
        assert session.zenoh.info.routers_zid()
    assert time.monotonic() - began < LONG_S


def test_connect_timeout_is_read_from_the_configuration():
    def timeout_of(**connecting: object) -> float:
        return connect_timeout(zenoh.Config.from_json5(json.dumps(client([nowhere()], **connecting))))

    assert timeout_of() == 0.0
    assert timeout_of(timeout_ms=2500) == 2.5
    assert timeout_of(timeout_ms=-1) == float("inf")
    assert timeout_of(timeout_ms={"client": 500, "peer": -1}) == 0.5
    assert timeout_of(timeout_ms=2500, exit_on_failure=False) == 0.0


def test_busy_port_raises_at_once(router: str):
    with pytest.raises(PortBusy):
        connect(mode="router", listen=router)
