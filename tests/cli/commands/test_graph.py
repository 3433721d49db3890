from __future__ import annotations

import json
import os
import socket
from xml.etree import ElementTree

from helpers.cli_runner import failure, published_robot, run_cli
from helpers.processes import until

from zstate import StaticPublisher, TransformListener, connect, discover
from zstate.cli.commands.graph import graph_drawing, graph_text
from zstate.cli.output.drawing import dot, mermaid, svg
from zstate.driving import Commander
from zstate.net.graph import Graph, StreamUse
from zstate.net.presence import announce, local_writer
from zstate.wire.keys import READER_TOKEN

DRIVER, PUBLISH, VIEWER = "driver@jetson pid 4", "zstate-publish@nuc pid 5", "viewer@desk pid 6"

GRAPH = Graph(
    (
        StreamUse("arm", "joint_states", (DRIVER,), (PUBLISH,), 500.0),
        StreamUse("arm", "robot_description", (PUBLISH,), (VIEWER,)),
        StreamUse("arm", "tf_static", (PUBLISH,), (VIEWER,)),
        StreamUse("base", "joint_states", (), (VIEWER,)),
    )
)


def test_streams_with_equal_writers_and_readers_are_grouped():
    assert graph_text(GRAPH).splitlines() == [
        "arm: joint_states (500.0 Hz)",
        "  written by  driver@jetson pid 4",
        "  read by     zstate-publish@nuc pid 5",
        "arm: robot_description, tf_static",
        "  written by  zstate-publish@nuc pid 5",
        "  read by     viewer@desk pid 6",
        "base: joint_states",
        "  written by  none",
        "  read by     viewer@desk pid 6",
    ]


def test_drawings_have_nodes_for_programs_and_stream_groups_and_edges_for_uses():
    root = ElementTree.fromstring(svg(graph_drawing(GRAPH), "A & B"))
    name = "{http://www.w3.org/2000/svg}"
    texts = [element.text for element in root.iter(f"{name}text")]
    assert {"A & B", "driver", "jetson pid 4", "joint_states (500.0 Hz)", "tf_static"} <= set(texts)
    assert len(list(root.iter(f"{name}rect"))) == 1 + 3 + 3  # paper, bundles, programs
    assert len(list(root.iter(f"{name}path"))) == 2 * 5  # each with its arrow's head
    assert sum(" -> " in line for line in dot(graph_drawing(GRAPH)).splitlines()) == 5
    assert sum(" --> " in line for line in mermaid(graph_drawing(GRAPH)).splitlines()) == 5


def test_writers_and_readers_of_a_robot_are_seen_with_rates():
    here = f"@{socket.gethostname()} pid {os.getpid()}"
    with published_robot(), connect() as session, TransformListener(session, "rrbot", follow="tf"):
        until(lambda: discover(session))
        facts = json.loads(run_cli("graph", "--json").stdout)
    streams = {one["stream"]: one for one in facts["streams"]}
    assert set(streams) == {"joint_states", "robot_description", "tf", "tf_static"}
    assert streams["joint_states"]["readers"] == []
    assert streams["tf"]["readers"][0].endswith(here)
    assert all(one["writers"][0].endswith(here) for one in streams.values())
    assert all(streams[name]["rate_hz"] > 0.0 for name in ("joint_states", "tf"))


def test_stream_with_readers_but_no_writer_is_marked():
    identity = local_writer(7, "zstate-publish").identity
    with connect() as session, announce(session, READER_TOKEN.key("rrbot", "joint_states", identity)):
        lines = run_cli("graph").stdout.splitlines()
    assert lines[:2] == ["rrbot: joint_states", "  written by  none"]
    assert lines[2].startswith("  read by     zstate-publish@")


def test_reader_of_all_robots_appears_at_each_and_static_writers_have_names():
    with (
        connect() as session,
        StaticPublisher(session, "left", "mount"),
        published_robot("right"),
        TransformListener(session),
    ):
        text = run_cli("graph").stdout
    assert "left: tf_static/mount" in text
    assert text.count("read by     none") == 1  # the transforms of the right one


def test_unknown_robot_is_an_error_but_an_empty_network_is_not():
    with published_robot():
        assert "did you mean 'rrbot'?" in failure("graph", "rbot")
    ended = run_cli("graph")
    assert (ended.code, ended.stdout) == (0, "")
    assert "no robot is announced" in ended.stderr


def test_on_ros_side_topics_have_the_nodes_at_their_ends(ros_router: str):
    with published_robot(wire="ros2", router=ros_router):
        text = run_cli("graph").stdout
    assert text.splitlines()[0] == "/joint_states, /robot_description, /tf, /tf_static"
    assert text.count("written by  /") == 1
    assert text.count("read by     none") == 1


def test_commands_go_from_the_commander_to_the_driver(sessions, host_driver):
    host_driver()
    with Commander(sessions[1], "arm", program="teleop"):
        text = run_cli("graph", "arm").stdout
    place = f"{socket.gethostname()} pid {os.getpid()}"
    assert f"arm: joint_commands\n  written by  teleop@{place}\n  read by     driver@{place}\n" in text, text
