from __future__ import annotations

import json

import pytest
from support import Child

pytestmark = pytest.mark.processes

OPENING = """
    import json, os, sys, time
    from pathlib import Path
    from zstate.net.session import connect

    def threads():
        names = [(task / "comm").read_text() for task in Path("/proc/self/task").iterdir()]
        pools = ("net", "tx", "rx", "acc")
        return {pool: sum(name.startswith(pool + "-") for name in names) for pool in pools}

    options = json.loads(sys.argv[1])
    with connect(**options) as first, connect(mode="client", endpoints=sys.argv[2]) as second:
        deadline = time.monotonic() + 15.0
        while not threads()["tx"] and time.monotonic() < deadline:  # it may only just be starting
            time.sleep(0.001)
        print(json.dumps([threads(), os.environ.get("ZENOH_RUNTIME")]))
"""


def opened(spawn, *arguments: str) -> tuple[dict[str, int], str | None]:
    child: Child = spawn(OPENING, *arguments)
    said = json.loads(child.line())
    assert (child.wait(), child.stderr) == (0, "")
    return tuple(said)


def test_a_router_has_threads_for_many_who_vanish_and_the_environment_stays_as_it_was(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    threads, left_behind = opened(spawn, json.dumps({"mode": "router", "listen": endpoint}), endpoint)
    assert threads["net"] >= 128
    assert left_behind is None


def test_whoever_has_few_neighbours_has_few_threads_more(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    threads, _ = opened(spawn, json.dumps({"mode": "peer", "listen": endpoint}), endpoint)
    assert 4 <= threads.pop("net") < 20  # where one waits for another it is replaced meanwhile
    assert threads == {"tx": 1, "rx": 0, "acc": 0}


def test_what_the_environment_says_of_zenohs_threads_is_kept(
    spawn, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    endpoint, chosen = f"tcp/127.0.0.1:{free_port}", "(rx: (worker_threads: 3))"
    monkeypatch.setenv("ZENOH_RUNTIME", chosen)
    threads, left_behind = opened(spawn, json.dumps({"mode": "router", "listen": endpoint}), endpoint)
    assert threads["rx"] < 20
    assert threads["net"] < 20
    assert left_behind == chosen
