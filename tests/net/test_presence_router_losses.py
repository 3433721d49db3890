"""A lost router, told from writers that left it."""

from __future__ import annotations

from helpers.processes import until

from zstate.net.presence import RouterLossDetector, announce, watch
from zstate.net.session import connect
from zstate.wire.identity import WriterId
from zstate.wire.keys import writer_key

TOKEN = writer_key("r1", "joint_states", WriterId("driver", "jetson", 412, 5, 7).identity)

ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("up")
        sys.stdin.readline()
"""


def test_a_writer_that_leaves_is_told_from_a_router_that_is_lost(spawn, free_port):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = spawn(ROUTER, endpoint)
    router.line()
    heard: list[str] = []
    with (
        connect(mode="client", endpoints=endpoint) as theirs,
        connect(mode="client", endpoints=endpoint) as ours,
        watch(
            ours,
            "*",
            lambda _, alive: heard.append("there" if alive else "gone"),
            on_cut_off=lambda _: heard.append("cut off"),
        ),
    ):
        with announce(theirs, TOKEN):
            until(lambda: heard == ["there"])
        until(lambda: heard == ["there", "gone"])
        with announce(theirs, TOKEN):
            until(lambda: heard == ["there", "gone", "there"])
            router.kill()
            until(lambda: len(heard) == 4)
    assert heard[-1] == "cut off"


def test_among_peers_no_router_is_lost(sessions):
    ours, theirs = sessions
    with RouterLossDetector(ours) as losses:
        theirs.close()
        assert not losses.lost_recently()
