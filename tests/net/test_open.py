"""How long a client waits for its router, and for which of several."""

from __future__ import annotations

import json
import time
from collections.abc import Callable

import pytest
import zenoh
from helpers.processes import Child, find_free_port

from zstate.errors import AccessDenied, PortBusy, Unreachable
from zstate.net.open import connect_timeout
from zstate.net.security.credentials import Credentials
from zstate.net.session import connect

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
    """Where one listens that knows no users, and so refuses whoever names one."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = spawn(ROUTER, endpoint)
    child.send_line()
    assert child.line() == "ready"
    return endpoint


def nowhere() -> str:
    return f"tcp/127.0.0.1:{find_free_port()}"


def client(endpoints: list[str], **connecting: object) -> dict[str, object]:
    """A configuration of Zenoh's own."""
    multicast = {"multicast": {"enabled": False}}
    return {"mode": "client", "connect": {"endpoints": endpoints, **connecting}, "scouting": multicast}


def test_whom_all_refuse_is_told_so_long_before_the_time_is_over(router: str):
    began = time.monotonic()
    for arguments in (
        {"mode": "client", "endpoints": router, "timeout_s": LONG_S},
        {"config": client([router], timeout_ms=60_000)},
        {"config": client([router], timeout_ms=-1)},
    ):
        with pytest.raises(AccessDenied):
            connect(**arguments, credentials=STRANGER)
    assert time.monotonic() - began < LONG_S


def test_one_that_is_not_there_yet_may_still_let_in_whom_another_refuses(router: str):
    with pytest.raises(AccessDenied, match="nothing answers at") as caught:
        connect(mode="client", endpoints=[nowhere(), router], credentials=STRANGER, timeout_s=0.2)
    assert caught.value.endpoint == router


def test_a_router_that_starts_later_is_waited_for(spawn: Callable[..., Child], free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    child = spawn(ROUTER, endpoint)
    with pytest.raises(Unreachable):
        connect(mode="client", endpoints=endpoint, timeout_s=0.1)
    child.send_line()
    with connect(mode="client", endpoints=endpoint, timeout_s=LONG_S) as session:
        assert session.zenoh.info.routers_zid()


@pytest.mark.parametrize("waiting", [{}, {"timeout_ms": 60_000}, {"timeout_ms": {"client": -1}}])
def test_of_several_endpoints_in_a_configuration_of_zenoh_a_dead_one_holds_nobody_up(
    router: str, waiting: dict[str, object]
):
    began = time.monotonic()
    with connect(client([nowhere(), router], **waiting)) as session:
        assert session.zenoh.info.routers_zid()
    assert time.monotonic() - began < LONG_S


def test_a_configuration_says_how_long_to_wait():
    def patience(**connecting: object) -> float:
        return connect_timeout(zenoh.Config.from_json5(json.dumps(client([nowhere()], **connecting))))

    assert patience() == 0.0
    assert patience(timeout_ms=2500) == 2.5
    assert patience(timeout_ms=-1) == float("inf")
    assert patience(timeout_ms={"client": 500, "peer": -1}) == 0.5
    assert patience(timeout_ms=2500, exit_on_failure=False) == 0.0


def test_a_busy_port_is_not_waited_for(router: str):
    with pytest.raises(PortBusy):
        connect(mode="router", listen=router)
