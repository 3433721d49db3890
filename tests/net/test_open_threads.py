from __future__ import annotations

import json
from pathlib import Path

import pytest
from helpers.processes import Child, until

pytestmark = pytest.mark.processes

OPENING = """
    import json, os, sys
    from zstate.net.session import connect

    options = json.loads(sys.argv[1])
    with connect(**options) as first, connect(mode="client", endpoints=sys.argv[2]) as second:
        print(json.dumps(os.environ.get("ZENOH_RUNTIME")))
        sys.stdin.readline()
"""


def threads_of(pid: int) -> dict[str, int]:
    """The number of threads in each of Zenoh's pools."""
    names = [(task / "comm").read_text() for task in Path(f"/proc/{pid}/task").iterdir()]
    return {pool: sum(name.startswith(f"{pool}-") for name in names) for pool in ("net", "tx", "rx", "acc")}


def opened(spawn, *arguments: str) -> tuple[dict[str, int], str | None]:
    child: Child = spawn(OPENING, *arguments)
    left_behind = json.loads(child.line())
    until(lambda: threads_of(child.process.pid)["tx"])  # it may only just be starting
    threads = threads_of(child.process.pid)
    child.send_line()
    assert (child.wait(), child.stderr) == (0, "")
    return threads, left_behind


def test_router_has_many_threads_and_the_environment_is_unchanged(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    threads, left_behind = opened(spawn, json.dumps({"mode": "router", "listen": endpoint}), endpoint)
    assert threads["net"] >= 128
    assert left_behind is None


def test_peer_has_few_additional_threads(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    threads, _ = opened(spawn, json.dumps({"mode": "peer", "listen": endpoint}), endpoint)
    assert 4 <= threads.pop("net") < 20  # a thread that waits for another is replaced for that time
    assert threads == {"tx": 1, "rx": 0, "acc": 0}


def test_zenoh_runtime_in_the_environment_is_used(spawn, free_port: int, monkeypatch: pytest.MonkeyPatch):
    endpoint, chosen = f"tcp/127.0.0.1:{free_port}", "(rx: (worker_threads: 3))"
    monkeypatch.setenv("ZENOH_RUNTIME", chosen)
    threads, left_behind = opened(spawn, json.dumps({"mode": "router", "listen": endpoint}), endpoint)
    assert threads["rx"] < 20
    assert threads["net"] < 20
    assert left_behind == chosen
