import sys

import pytest
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import Closed, InsertRefused, InvalidInput
from zstate.net.discovery import discover
from zstate.net.session import connect
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.transform import Transform

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def edge(parent: str, child: str, x: float = 0.0) -> Transform:
    return Transform(parent, child, (x, 0.0, 0.0), UPRIGHT)


def x_of(buffer: TransformBuffer, target: str, source: str) -> float | None:
    reason = buffer.explain(target, source)
    return None if reason is not None else buffer.lookup(target, source).translation[0]


def test_late_listener_gets_all_edges_of_all_writers(sessions):
    writer, reader = sessions
    with (
        StaticPublisher(writer, "r1", "mount") as mount,
        StaticPublisher(writer, "r1", "room") as room,
        TransformListener(writer, "r1") as early,
    ):
        mount.set(edge("tool", "camera", 1.0))
        mount.set(edge("camera", "lens", 2.0))
        room.set(edge("map", "tool", 4.0))
        assert early.buffer.wait("map", "lens", timeout_s=DEADLINE_S).translation[0] == 7.0
        with TransformListener(reader, "r1") as late:
            assert late.buffer.wait("map", "lens", timeout_s=DEADLINE_S).translation[0] == 7.0
            writers = {frame.name: frame.writer for frame in late.buffer.frames() if frame.parent}
    assert writers == {"r1/camera": "mount", "r1/lens": "mount", "r1/tool": "room"}


def test_edges_are_published_on_several_wires_at_once(sessions):
    writer, reader = sessions
    with (
        StaticPublisher(writer, "r1", "mount", ("native", "ros2")) as statics,
        TransformListener(reader, "r1") as here,
        TransformListener(reader, "r1", wire="ros2") as there,
    ):
        statics.set(edge("tool", "camera", 1.0))
        for listener in (here, there):
            assert listener.buffer.wait("tool", "camera", timeout_s=DEADLINE_S).translation[0] == 1.0


def test_update_reaches_every_listener_and_keeps_the_other_edges(sessions):
    writer, reader = sessions
    with (
        StaticPublisher(writer, "r1", "mount") as statics,
        TransformListener(writer, "r1") as one,
        TransformListener(reader, "r1") as other,
    ):
        statics.set(edge("tool", "camera", 1.0))
        statics.set(edge("tool", "laser", 5.0))
        for listener in (one, other):
            listener.buffer.wait("tool", "laser", timeout_s=DEADLINE_S)
        statics.set(edge("tool", "camera", 2.0))
        for listener in (one, other):
            until(lambda listener=listener: x_of(listener.buffer, "tool", "camera") == 2.0)
            assert x_of(listener.buffer, "tool", "laser") == 5.0


def test_withdraw_removes_one_edge_and_close_the_rest(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        buffer = listener.buffer
        with StaticPublisher(writer, "r1", "mount") as statics:
            statics.set(edge("tool", "camera", 1.0))
            statics.set(edge("tool", "laser", 5.0))
            buffer.wait("tool", "laser", timeout_s=DEADLINE_S)
            statics.withdraw("camera")
            until(lambda: x_of(buffer, "tool", "camera") is None)
            assert x_of(buffer, "tool", "laser") == 5.0
        until(lambda: x_of(buffer, "tool", "laser") is None)


def test_closing_one_writer_leaves_the_other_ones_edges(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener, StaticPublisher(writer, "r1", "room") as room:
        with StaticPublisher(writer, "r1", "mount") as mount:
            mount.set(edge("tool", "camera", 1.0))
            room.set(edge("map", "tool", 4.0))
            listener.buffer.wait("map", "camera", timeout_s=DEADLINE_S)
        until(lambda: x_of(listener.buffer, "tool", "camera") is None)
        assert x_of(listener.buffer, "map", "tool") == 4.0


def test_edge_taken_over_by_another_writer_stays_when_the_first_one_closes(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "r1") as listener,
        StaticPublisher(writer, "r1", "new", takeover=True) as new,
    ):
        with StaticPublisher(writer, "r1", "old") as old:
            old.set(edge("tool", "camera", 1.0))
            old.set(edge("tool", "laser", 1.0))
            listener.buffer.wait("tool", "laser", timeout_s=DEADLINE_S)
            new.set(edge("tool", "camera", 2.0))
            until(lambda: x_of(listener.buffer, "tool", "camera") == 2.0)
        until(lambda: x_of(listener.buffer, "tool", "laser") is None)
        assert x_of(listener.buffer, "tool", "camera") == 2.0


def test_child_can_be_reparented_only_after_it_was_withdrawn(sessions):
    writer, reader = sessions
    with StaticPublisher(writer, "r1", "mount") as statics, TransformListener(reader, "r1") as listener:
        statics.set(edge("tool", "camera", 1.0))
        listener.buffer.wait("tool", "camera", timeout_s=DEADLINE_S)
        with pytest.raises(InsertRefused, match="'r1/camera' has the parent 'r1/tool'") as caught:
            statics.set(edge("base", "camera", 2.0))
        assert caught.value.reason == "second parent"
        statics.withdraw("camera")
        statics.set(edge("base", "camera", 2.0))
        assert listener.buffer.wait("base", "camera", timeout_s=DEADLINE_S).translation[0] == 2.0
        assert x_of(listener.buffer, "tool", "camera") is None
        assert listener.stats.refused == {}


@pytest.mark.parametrize(
    ("parent", "child", "reason"),
    [("camera", "camera", "self edge"), ("camera", "tool", "loop"), ("r1/camera", "tool", "loop")],
)
def test_edge_that_listeners_would_refuse_raises_in_set(sessions, parent, child, reason):
    with StaticPublisher(sessions[0], "r1", "mount") as statics:
        statics.set(edge("tool", "camera"))
        with pytest.raises(InsertRefused) as caught:
            statics.set(edge(parent, child))
        assert caught.value.reason == reason


@pytest.mark.parametrize(
    ("parent", "child", "reason"),
    [
        ("tool", "world", "loop"),
        ("plate", "world", "loop"),
        ("base", "lower", "second parent"),
        ("upper", "lower", "second writer"),
        ("map", "tool", "second parent"),
        ("r2/base", "r2/camera", "foreign frame"),
        ("r2/base", "fleet/map", ""),
        ("map", "r2/world", ""),
        ("map", "world", ""),
    ],
)
def test_edge_that_every_listener_would_refuse_raises_in_set(sessions, parent, child, reason):
    with (
        StatePublisher(sessions[1], RRBOT, "r1"),
        StatePublisher(sessions[1], RRBOT, "r2"),
        StaticPublisher(sessions[1], "r1", "plate") as plate,
        StaticPublisher(sessions[0], "r1", "mount") as statics,
        TransformListener(sessions[1]) as listener,
    ):
        plate.set(edge("tool", "plate"))
        until(lambda: len(discover(sessions[0])) == 2)
        full = [name if "/" in name else f"r1/{name}" for name in (parent, child)]
        if reason:
            with pytest.raises(InsertRefused) as caught:
                statics.set(edge(parent, child))
            assert caught.value.reason == reason
            assert caught.value.edge == tuple(full)
        else:
            statics.set(edge(parent, child))
            assert listener.buffer.wait(*full, timeout_s=DEADLINE_S).kind == "static"
            assert listener.stats.refused == {}


def test_edge_of_another_robot_does_not_exclude_the_own_writer(sessions):
    with (
        StaticPublisher(sessions[0], "r2", "thief") as thief,
        StaticPublisher(sessions[1], "r1", "mount") as mount,
        TransformListener(sessions[1]) as listener,
    ):
        thief.set(edge("r2/map", "r1/camera", 9.0))
        listener.buffer.wait("r2/map", "r1/camera", timeout_s=DEADLINE_S)
        mount.set(edge("base", "camera", 1.0))
        assert listener.buffer.wait("r1/base", "r1/camera", timeout_s=DEADLINE_S).translation[0] == 1.0
        assert not listener.buffer.can_lookup("r2/map", "r1/camera")
        until(lambda: listener.stats.refused == {"foreign frame": 1})
        mount.withdraw("camera")
        assert listener.buffer.wait("r2/map", "r1/camera", timeout_s=DEADLINE_S).translation[0] == 9.0


def test_map_shared_by_two_robots_is_an_unowned_frame(sessions):
    with (
        StatePublisher(sessions[0], RRBOT, "a") as one,
        StatePublisher(sessions[1], RRBOT, "b") as other,
        StaticPublisher(sessions[0], "a") as statics_of_a,
        StaticPublisher(sessions[1], "b") as statics_of_b,
        TransformListener(sessions[0]) as everything,
        TransformListener(sessions[1], "a") as only_a,
    ):
        statics_of_a.set(edge("fleet/map", "a/world"))
        statics_of_b.set(edge("fleet/map", "b/world", 2.0))

        def publish() -> bool:
            one.publish([0.0, 0.0])
            other.publish([0.0, 0.0])
            return x_of(everything.buffer, "a/tool", "b/tool") is not None

        until(publish)
        assert x_of(everything.buffer, "a/tool", "b/tool") == pytest.approx(2.0)
        until(lambda: one.publish([0.0, 0.0]) or x_of(only_a.buffer, "fleet/map", "tool") is not None)
        assert everything.stats.refused == only_a.stats.refused == {}


@pytest.mark.parametrize("name", ["/camera", "camera/", ""])
def test_invalid_frame_name_is_refused_and_earlier_edges_stay(sessions, name: str):
    writer, reader = sessions
    with StaticPublisher(writer, "r1", "mount") as statics, TransformListener(reader, "r1") as listener:
        statics.set(edge("tool", "camera"))
        with pytest.raises(InvalidInput, match="frame name"):
            statics.set(Transform("tool", name, (0.0, 0.0, 0.0), UPRIGHT))
        statics.set(edge("tool", "laser"))
        listener.buffer.wait("camera", "laser", timeout_s=DEADLINE_S)


def test_model_writer_name_is_reserved_and_an_invalid_one_refused(sessions):
    with pytest.raises(InvalidInput, match="belongs to the robot's own model"):
        StaticPublisher(sessions[0], "r1", "robot_description")
    for name in ("a/b", "a b", "", "@x"):
        with pytest.raises(InvalidInput, match="writer name"):
            StaticPublisher(sessions[0], "r1", name)
    with pytest.raises(InvalidInput, match="robot name"):
        StaticPublisher(sessions[0], "r/1")
    with pytest.raises(InvalidInput, match="no wire 'dds'"):
        StaticPublisher(sessions[0], "r1", wires="dds")
    assert discover(sessions[1], timeout_s=0.3) == ()


def test_withdraw_of_an_unknown_edge_lists_the_edges_of_the_writer(sessions):
    with StaticPublisher(sessions[0], "r1", "mount") as statics:
        with pytest.raises(InvalidInput, match="its edges: none"):
            statics.withdraw("camera")
        statics.set(edge("tool", "camera"))
        with pytest.raises(InvalidInput, match=r"'laser' is not placed .* 'mount'; its edges: 'r1/camera'"):
            statics.withdraw("laser")


@pytest.mark.parametrize("name", [None, 5, "", "/tool", ["tool"]], ids=repr)
def test_invalid_frame_name_is_refused_by_static_publisher(sessions, name):
    with StaticPublisher(sessions[0], "r1", "mount") as statics:
        statics.set(edge("tool", "camera", 1.0))
        with pytest.raises(InvalidInput, match="frame name"):
            statics.withdraw(name)
        with pytest.raises(InvalidInput, match="frame name"):
            statics.set(edge("tool", name, 1.0))


def test_full_names_join_two_robots_in_one_buffer(sessions):
    writer, reader = sessions
    with (
        StaticPublisher(writer, "fleet", "site") as site,
        StaticPublisher(writer, "r1", "mount") as first,
        StaticPublisher(writer, "r2", "mount") as second,
        TransformListener(reader) as listener,
    ):
        site.set(edge("map", "r1/odom", 1.0))
        site.set(edge("fleet/map", "r2/odom", 10.0))
        first.set(edge("odom", "base", 2.0))
        second.set(edge("odom", "base", 20.0))
        buffer = listener.buffer
        assert buffer.wait("map", "r1/base", timeout_s=DEADLINE_S).translation[0] == 3.0
        assert buffer.wait("fleet/map", "r2/base", timeout_s=DEADLINE_S).translation[0] == 30.0
        assert buffer.lookup("r1/base", "r2/base").translation[0] == 27.0
        assert listener.robots() == ("fleet", "r1", "r2")


def test_publishers_without_a_name_coexist_in_one_process(sessions, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "argv", ["/home/me/my camera.py"])
    writer, reader = sessions
    with (
        StaticPublisher(writer, "r1") as one,
        StaticPublisher(writer, "r1") as other,
        TransformListener(reader, "r1") as listener,
    ):
        assert one.writer != other.writer
        assert one.writer.startswith("my%20camera.")
        one.set(edge("tool", "camera", 1.0))
        other.set(edge("tool", "laser", 5.0))
        assert listener.buffer.wait("camera", "laser", timeout_s=DEADLINE_S).translation[0] == 4.0


def test_closed_static_publisher_raises_closed_and_closes_twice(sessions):
    statics = StaticPublisher(sessions[0], "r1", "mount")
    statics.set(edge("tool", "camera"))
    statics.close()
    statics.close()
    for use in (lambda: statics.set(edge("tool", "camera")), lambda: statics.withdraw("camera")):
        with pytest.raises(Closed, match="'mount' is closed"):
            use()


def test_static_publisher_may_outlive_its_session():
    with connect() as session:
        statics = StaticPublisher(session, "r1", "mount")
        statics.set(edge("tool", "camera"))
    with pytest.raises(Closed, match="session is closed"):
        statics.set(edge("tool", "laser"))
    statics.close()
