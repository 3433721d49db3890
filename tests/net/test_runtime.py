from __future__ import annotations

import json

import pytest
from support import Child

OPENING = """
    import json, os, sys
    from pathlib import Path
    from zstate.net.session import connect

    def receiving():
        names = [(task / "comm").read_text() for task in Path("/proc/self/task").iterdir()]
        return sum(name.startswith("rx-") for name in names)

    options = json.loads(sys.argv[1])
    with connect(**options) as first, connect(mode="client", endpoints=sys.argv[2]) as second:
        print(json.dumps([receiving(), os.environ.get("ZENOH_RUNTIME")]))
"""


def opened(spawn, *arguments: str) -> tuple[int, str | None]:
    child: Child = spawn(OPENING, *arguments)
    said = json.loads(child.line())
    assert (child.wait(), child.stderr) == (0, "")
    return tuple(said)


@pytest.mark.processes
def test_a_router_receives_with_many_threads_and_the_environment_stays_as_it_was(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    threads, left_behind = opened(spawn, json.dumps({"mode": "router", "listen": endpoint}), endpoint)
    assert threads >= 128
    assert left_behind is None


@pytest.mark.processes
def test_what_the_environment_says_of_zenohs_threads_is_kept(
    spawn, free_port: int, monkeypatch: pytest.MonkeyPatch
):
    endpoint, chosen = f"tcp/127.0.0.1:{free_port}", "(rx: (worker_threads: 3))"
    monkeypatch.setenv("ZENOH_RUNTIME", chosen)
    threads, left_behind = opened(spawn, json.dumps({"mode": "router", "listen": endpoint}), endpoint)
    assert threads < 20
    assert left_behind == chosen
