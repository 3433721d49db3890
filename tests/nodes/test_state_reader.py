"""The reader inside a listener, alone: nothing that observes it is needed for the poses in its buffer."""

from __future__ import annotations

import pytest
from helpers.processes import until
from helpers.robots import RRBOT, STAMP, wait_for_stream_readers

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.ingest.counters import Counters
from zstate.net.service_thread import ServiceThread
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.state_reader import StateReader
from zstate.wire.registry import get_wire

MS = 1_000_000


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_reader_without_diagnostics_inserts_what_a_listener_inserts(sessions, follow):
    writer, reader = sessions
    buffer, counters = TransformBuffer(), Counters()
    wire = get_wire("native")
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", follow=follow, history_on_join=False) as listener,
        ServiceThread(reader, "requests") as thread,
        StateReader(
            reader,
            ("r1",),
            wire,
            follow,
            buffer,
            thread=thread,
            counters=counters,
            history_on_join=False,
        ) as alone,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        for step in range(20):
            publisher.publish([0.01 * step, -0.02 * step], stamp=STAMP + step * MS)
        for count in (counters.stats, lambda: listener.stats):
            until(lambda count=count: count().received == 20)
        until(lambda: buffer.can_lookup("world", "tool", STAMP + 19 * MS))  # static edges come by themselves
        assert alone.ingests.robots() == listener.robots() == ("r1",)
    for step in range(20):
        stamp = STAMP + step * MS
        expected = listener.buffer.lookup("world", "tool", stamp)
        assert buffer.lookup("world", "tool", stamp).pose7.tolist() == expected.pose7.tolist()
    assert counters.stats().off_clock == 0  # which is counted by diagnostics
    assert listener.stats.off_clock > 0
