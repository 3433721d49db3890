from __future__ import annotations

import json
from contextlib import ExitStack

import pytest
import zenoh
from looking import RRBOT, Spawn, failure, interrupted, started
from support import until

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


def ros_node(port: int) -> zenoh.Session:
    """A session as rmw_zenoh_cpp opens it."""
    config = zenoh.Config()
    for path, value in {
        "mode": "peer",
        "connect/endpoints": [f"tcp/localhost:{port}"],
        "listen/endpoints": ["tcp/localhost:0"],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": True,
        "scouting/gossip/target": {"router": ["router", "peer"], "peer": ["router"]},
        "timestamping/enabled": True,
    }.items():
        config.insert_json5(path, json.dumps(value))
    return zenoh.open(config)


def test_ros_nodes_and_clients_hear_each_other_through_it(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = started(spawn, "router", "--ros2", "--listen", endpoint)
    assert router.line().endswith(f" listens at {endpoint}")
    heard: set[tuple[str, str]] = set()
    with ExitStack() as opened:
        sessions = {name: opened.enter_context(ros_node(free_port)) for name in ("node", "other")}
        sessions["client"] = opened.enter_context(connect(mode="client", endpoints=endpoint)).zenoh
        for name, session in sessions.items():

            def note(sample: zenoh.Sample, reader: str = name) -> None:
                heard.add((str(sample.key_expr), reader))

            session.declare_subscriber("from/**", note)

        def all_hear_all() -> bool:
            for name, session in sessions.items():
                session.put(f"from/{name}", b"something")
            return len(heard) == len(sessions) ** 2

        until(all_hear_all)
    interrupted(router)


def test_its_settings_for_ros_and_a_file_exclude_each_other(tmp_path):
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    assert "--config" in failure("router", "--ros2", "--config", str(file), code=2)
