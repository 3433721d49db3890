"""The graph of writers and readers, and the monitor that keeps it up to date."""

from __future__ import annotations

import os

from helpers.processes import until
from helpers.robots import RRBOT

from zstate.net.discovery import RobotInfo
from zstate.net.graph import GraphMonitor, StreamUse, build_graph
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import ANY


def test_monitor_shows_writers_readers_and_the_status_of_writers(sessions):
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


def test_status_of_a_closed_publisher_disappears(sessions):
    with GraphMonitor(sessions[1]) as watch:
        with StatePublisher(sessions[0], RRBOT, "r1"):
            until(lambda: watch.graph().streams and watch.states())
        until(lambda: not watch.graph().streams and not watch.states())


DRIVER, MOUNT, VIEWER = (
    WriterId(name, "", 0, 0, number) for number, name in enumerate(("driver", "mount", "view"))
)


def test_readers_of_all_robots_read_each_stream_and_static_edges_have_the_names_of_their_writers():
    statics = (("tf_static", "left", MOUNT), ("tf_static", "right", MOUNT))
    arm = RobotInfo("arm", (("joint_states", DRIVER), ("tf_static", MOUNT)), statics)
    readers = [Announcement(ANY, "joint_states", VIEWER), Announcement("base", "tf", VIEWER)]
    graph = build_graph([arm], readers, lambda robot, stream, writer: 500.0 if writer == DRIVER else None)
    assert graph.streams == (
        StreamUse("arm", "joint_states", ("driver",), ("view",), 500.0),
        StreamUse("arm", "tf_static/left", ("mount",), ()),
        StreamUse("arm", "tf_static/right", ("mount",), ()),
        StreamUse("base", "tf", (), ("view",)),
    )
    assert [len(group.streams) for group in graph.groups] == [1, 2, 1]


def test_without_writers_a_reader_of_all_robots_is_in_the_graph():
    graph = build_graph([], [Announcement(ANY, "tf", VIEWER)])
    assert graph.streams == (StreamUse(ANY, "tf", (), ("view",)),)


def test_the_monitor_shows_no_stream_of_all_robots(sessions):
    with (
        GraphMonitor(sessions[1]) as monitor,
        TransformListener(sessions[0]),
        TransformListener(sessions[0], "r1"),
    ):
        until(lambda: monitor.graph().streams)
        assert {stream.robot for stream in monitor.graph().streams} == {"r1"}
