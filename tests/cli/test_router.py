from __future__ import annotations

import pytest
from looking import RRBOT, Spawn, failure, interrupted, started

from zstate import TransformListener, connect

pytestmark = pytest.mark.processes


def test_clients_meet_at_it(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = started(spawn, "router", "--listen", endpoint)
    assert router.line().endswith(f" listens at {endpoint}")
    client = ("--mode", "client", "--connect", endpoint)
    started(spawn, "publish", RRBOT, "--source", "sine", *client).line()
    with (
        connect(mode="client", endpoints=endpoint) as session,
        TransformListener(session, "rrbot") as listener,
    ):
        assert listener.buffer.wait("base", "lower", timeout_s=10.0).kind == "exact"
    interrupted(router)


def test_a_busy_port_is_told_at_once(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    started(spawn, "router", "--listen", endpoint).line()
    assert f"somebody listens at '{endpoint}' already" in failure("router", "--listen", endpoint)
