"""Routers that are lost, or do not reply, distinguished from writers that left."""

from __future__ import annotations

import os
import signal

import pytest
from helpers.processes import until

from zstate.errors import Unreachable
from zstate.net.discovery import discover
from zstate.net.presence import WriterWatch, announce
from zstate.net.router_losses import RouterLossDetector
from zstate.net.session import connect
from zstate.wire.identity import WriterId
from zstate.wire.keys import WRITER_TOKEN

TOKEN = WRITER_TOKEN.key("r1", "joint_states", WriterId("driver", "jetson", 412, 5, 7).identity)

ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("up")
        sys.stdin.readline()
"""


def test_leaving_writer_is_distinguished_from_a_lost_router(spawn, free_port):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = spawn(ROUTER, endpoint)
    router.line()
    changes: list[str] = []
    with (
        connect(mode="client", endpoints=endpoint) as theirs,
        connect(mode="client", endpoints=endpoint) as ours,
        RouterLossDetector(ours) as losses,
        WriterWatch(
            ours,
            "*",
            lambda _, alive: changes.append("there" if alive else "gone"),
            before_losses=lambda: changes.append("cut off" if losses.lost_recently() else "left"),
        ),
    ):
        with announce(theirs, TOKEN):
            until(lambda: changes == ["there"])
        until(lambda: changes == ["there", "left", "gone"])
        with announce(theirs, TOKEN):
            until(lambda: changes == ["there", "left", "gone", "there"])
            router.kill()
            until(lambda: len(changes) == 6)
    assert changes[-2:] == ["cut off", "gone"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_losses_are_reported_though_the_call_before_them_fails(sessions):
    ours, theirs = sessions
    changes: list[bool] = []

    def fail() -> None:
        raise OSError("no events")

    with WriterWatch(ours, "*", lambda _, alive: changes.append(alive), before_losses=fail) as watch:
        with announce(theirs, TOKEN):
            until(lambda: changes == [True])
        until(lambda: changes == [True, False])
        until(lambda: watch.failures == 1)


def test_peers_lose_no_router(sessions):
    ours, theirs = sessions
    with RouterLossDetector(ours) as losses:
        theirs.close()
        assert not losses.lost_recently()


def test_discovery_without_the_whole_reply_is_an_error(spawn, free_port, monkeypatch: pytest.MonkeyPatch):
    """The router answers no more: that is not a network without robots."""
    monkeypatch.setattr("zstate.net.discovery.ALL_TOKENS_WITHIN_S", 0.2)
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = spawn(ROUTER, endpoint)
    router.line()
    with (
        connect(mode="client", endpoints=endpoint) as theirs,
        connect(mode="client", endpoints=endpoint) as ours,
        announce(theirs, TOKEN),
    ):
        assert [robot.name for robot in discover(ours)] == ["r1"]
        router.freeze()
        with pytest.raises(Unreachable, match=r"discovery is incomplete: [01] announcements in 0.3 s"):
            discover(ours, 0.3)
        os.kill(router.process.pid, signal.SIGCONT)
        assert [robot.name for robot in discover(ours)] == ["r1"]
