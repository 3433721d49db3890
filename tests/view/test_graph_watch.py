"""GraphMonitor: who writes and reads what, while somebody wants to know."""

from __future__ import annotations

import os

from live import RRBOT
from support import until

from zstate.listener import TransformListener
from zstate.net.graph import GraphMonitor
from zstate.publisher import StatePublisher


def test_writers_and_readers_of_a_stream_are_seen_and_how_the_writers_do(sessions):
    with (
        GraphMonitor(sessions[1]) as watch,
        StatePublisher(sessions[0], RRBOT, "r1", program="driver") as publisher,
        TransformListener(sessions[1], "r1"),
    ):
        publisher.publish([0.0, 0.0])

        def is_seen() -> bool:
            uses = {(use.robot, use.name): use for use in watch.graph().streams}
            use = uses.get(("r1", "joint_states"))
            here = f"pid {os.getpid()}"
            return use is not None and bool(use.readers) and any(here in one for one in use.writers)

        until(is_seen)
        until(watch.states)
        (state,) = watch.states()
        assert (state.robot, state.status.program) == ("r1", "driver")
    watch.close()


def test_a_publisher_that_is_gone_says_nothing_any_more(sessions):
    with GraphMonitor(sessions[1]) as watch:
        with StatePublisher(sessions[0], RRBOT, "r1"):
            until(lambda: watch.graph().streams and watch.states())
        until(lambda: not watch.graph().streams and not watch.states())
