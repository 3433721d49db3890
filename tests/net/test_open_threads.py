from __future__ import annotations

import json
import os
import signal
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest
from helpers.processes import DEADLINE_S, Child, until

from zstate.net.session import connect
from zstate.net.streams import KeyPublisher, StreamSubscriber
from zstate.streams import BULK_BYTES

pytestmark = pytest.mark.processes

ROUTER = """
    import json, sys
    from zstate.net.config import SETTINGS
    from zstate.net.session import connect

    SETTINGS.update(json.loads(sys.argv[2]))
    with connect(mode="router", listen=sys.argv[1]):
        print("up")
        sys.stdin.readline()
"""

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


def opened(spawn, *arguments: str, least: int = 0) -> tuple[dict[str, int], str | None]:
    """The threads once there are ``least`` of net and rx, and the environment that opening leaves behind."""
    child: Child = spawn(OPENING, *arguments)
    left_behind = json.loads(child.line())

    def have_started(threads: dict[str, int]) -> bool:
        return threads["tx"] > 0 and min(threads["net"], threads["rx"]) >= least

    until(lambda: have_started(threads_of(child.process.pid)))
    threads = threads_of(child.process.pid)
    child.send_line()
    assert (child.wait(), child.stderr) == (0, "")
    return threads, left_behind


def test_router_has_many_threads_and_the_environment_is_unchanged(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = json.dumps({"mode": "router", "listen": endpoint})
    _, left_behind = opened(spawn, router, endpoint, least=128)
    assert left_behind is None


FROZEN_READER = """
    import sys
    from zstate.net.session import connect
    from zstate.net.streams import StreamSubscriber

    with (
        connect(mode="client", endpoints=sys.argv[1]) as session,
        StreamSubscriber(session, "bulk", lambda samples: print("received"), is_bulk=True),
    ):
        print("ready")
        sys.stdin.readline()
"""


def test_router_that_waits_for_a_frozen_reader_of_clouds_serves_all_others(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    longest = {"transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments": 10**9}
    router = spawn(ROUTER, endpoint, json.dumps(longest))
    router.line()
    reader = spawn(FROZEN_READER, endpoint)
    reader.line()
    received = threading.Event()
    with (
        ExitStack() as opened,
        connect(mode="client", endpoints=endpoint) as robot,
        connect(mode="client", endpoints=endpoint) as other,
        KeyPublisher(robot, "state", "") as state,
        StreamSubscriber(other, "state", lambda _: received.set()),
    ):
        cameras = [
            KeyPublisher(
                opened.enter_context(connect(mode="client", endpoints=endpoint)), "bulk", "", is_bulk=True
            )
            for _ in range(5)
        ]
        until(lambda: state.has_readers and all(camera.has_readers for camera in cameras))
        os.kill(reader.process.pid, signal.SIGSTOP)
        for _ in range(5):  # more than sockets hold: the router waits for 1000 s
            cameras[0].put(bytes(BULK_BYTES // 4))
        for camera in cameras:
            camera.put(b"picture")  # waits as well, in one more thread of the router
            received.clear()
            state.put(b"sample")
            assert received.wait(DEADLINE_S)
    reader.kill()
    router.kill()


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
