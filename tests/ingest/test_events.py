"""What becomes of writers, from what is announced of them."""

from __future__ import annotations

import re
import time

import pytest
from helpers.processes import until

from zstate._util.bounded import MAX_ENTRIES
from zstate.errors import InsertRefused
from zstate.ingest.deadline import FLOOR_S
from zstate.ingest.diagnostics import WriterEvent
from zstate.ingest.events import EventLog, StaticEdgeOwners
from zstate.ingest.frame_ownership import EdgeSource
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId

SUBSCRIBED: tuple[StreamName, ...] = ("robot_description", "tf_static", "joint_states", "transforms")
ROS_SHARED: tuple[StreamName, ...] = ("tf", "tf_static")
DRIVER = WriterId("driver", "jetson", 412, 5, 7)
RESTARTED = WriterId("driver", "jetson", 413, 6, 8)
REFUSAL = InsertRefused("refused", reason="second writer", edge=("r1/tool", "r1/camera"))
OTHER = WriterId("simulator", "laptop", 9, 6, 9)


def announced(writer: WriterId = DRIVER, stream: StreamName = "joint_states", name: str = "") -> Announcement:
    return Announcement("r1", stream, writer, name)


def quiet() -> EventLog:
    return EventLog(SUBSCRIBED, "joint_states", ())


def kinds(events: EventLog) -> list[str]:
    return [event.kind for event in events.recent()]


def test_writer_joins_and_leaves():
    before = time.time_ns()
    with quiet() as events:
        events.on_writer(announced(), alive=True)
        events.on_writer(announced(), alive=True)  # as after a token was received twice
        events.on_writer(announced(), alive=False)
        events.on_writer(announced(), alive=False)
        joined, left = events.recent()
    assert (joined.kind, left.kind) == ("joined", "left")
    assert (joined.robot, joined.stream, joined.writer) == ("r1", "joint_states", DRIVER)
    assert before <= joined.at <= left.at <= time.time_ns()
    assert str(joined) == joined.text == "'r1': driver@jetson pid 412 writes joint_states"
    assert "has left" in left.text


def test_same_program_on_the_same_host_is_restarted_and_another_one_joined():
    with quiet() as events:
        for writer in (DRIVER, RESTARTED, OTHER):
            events.on_writer(announced(writer), alive=True)
            events.on_writer(announced(writer), alive=False)
        assert kinds(events) == ["joined", "left", "restarted", "left", "joined", "left"]
        assert "pid 412 before" in events.recent()[2].text


@pytest.mark.parametrize("loss", ["cut off", "left"])
def test_same_writer_that_returns_is_back(loss):
    with quiet() as events:
        events.on_writer(announced(), alive=True)
        if loss == "cut off":
            events.on_cut_off(announced())
        else:
            events.on_writer(announced(), alive=False)
        events.on_writer(announced(), alive=True)
        assert kinds(events) == ["joined", loss, "back"]


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (announced(), announced(OTHER)),
        (announced(DRIVER, "tf_static", "mount"), announced(OTHER, "tf_static", "mount")),
    ],
)
def test_two_writers_of_one_stream_are_a_conflict_of_the_later_one(one, other):
    with quiet() as events:
        events.on_writer(one, alive=True)
        events.on_writer(other, alive=True)
        assert kinds(events) == ["joined", "joined", "conflict"]
        conflict = events.recent()[-1]
    assert conflict.writer == OTHER
    assert "simulator@laptop pid 9" in conflict.text
    assert "driver@jetson pid 412" in conflict.text


@pytest.mark.parametrize(
    "other",
    [
        announced(OTHER, "tf_static", "room"),
        announced(OTHER, "robot_description"),
        announced(OTHER, "tf_static"),
    ],
)
def test_writers_of_different_streams_do_not_conflict(other):
    with quiet() as events:
        events.on_writer(announced(DRIVER, "tf_static", "mount"), alive=True)
        events.on_writer(announced(), alive=True)
        events.on_writer(other, alive=True)
        assert "conflict" not in kinds(events)


@pytest.mark.parametrize("stream", ["tf", "tf_static", "joint_states"])
def test_ros_nodes_that_share_topics_do_not_conflict(stream):
    with EventLog((*SUBSCRIBED, "tf"), "joint_states", ROS_SHARED) as events:
        for writer in (DRIVER, OTHER):
            events.on_writer(announced(writer, stream), alive=True)
        assert "conflict" not in kinds(events)


def test_two_static_writers_that_place_one_frame_conflict_once():
    with quiet() as events:
        events.on_writer(announced(DRIVER, "tf_static", "mount"), alive=True)
        events.on_writer(announced(OTHER, "tf_static", "room"), alive=True)
        events.set_static_children("r1", "mount", frozenset({"r1/camera", "r1/laser"}))
        for _ in range(50):
            events.set_static_children("r1", "room", frozenset({"r1/camera"}))
            events.add_second_edge("tf_static", EdgeSource("r1", "room"), REFUSAL)
        assert kinds(events) == ["joined", "joined", "conflict"]
        conflict = events.recent()[-1]
    assert (conflict.writer, conflict.stream) == (OTHER, "tf_static")
    assert conflict.text == "'room' of 'r1' places 'r1/camera', and so does 'mount' of 'r1'"


def test_second_writer_of_a_moving_edge_conflicts_once_and_its_stream_is_transforms():
    with quiet() as events:
        events.on_writer(announced(DRIVER, "transforms", "odometry"), alive=True)
        events.on_writer(announced(OTHER, "transforms", "lidar"), alive=True)
        for _ in range(50):
            events.add_second_edge("transforms", EdgeSource("r1", "any text", OTHER.session), REFUSAL)
        conflicts = [event for event in events.recent() if event.kind == "conflict"]
    assert [(one.writer, one.stream, one.text) for one in conflicts] == [(OTHER, "transforms", str(REFUSAL))]


def test_departed_transform_writer_leaves_static_edges_of_its_name():
    with quiet() as events:
        for stream in ("tf_static", "transforms"):
            events.on_writer(announced(DRIVER, stream, "mount"), alive=True)
        events.set_static_children("r1", "mount", frozenset({"r1/camera"}))
        events.on_writer(announced(DRIVER, "transforms", "mount"), alive=False)
        events.set_static_children("r1", "room", frozenset({"r1/camera"}))
        assert "conflict" in kinds(events)


def test_departed_static_writer_conflicts_with_none():
    with quiet() as events:
        events.on_writer(announced(DRIVER, "tf_static", "mount"), alive=True)
        events.set_static_children("r1", "mount", frozenset({"r1/camera"}))
        events.on_writer(announced(DRIVER, "tf_static", "mount"), alive=False)
        events.set_static_children("r1", "room", frozenset({"r1/camera"}))
        assert "conflict" not in kinds(events)


def test_streams_that_are_not_subscribed_have_no_events():
    with quiet() as events:
        events.on_writer(announced(stream="tf"), alive=True)
        events.on_writer(announced(stream="tf"), alive=False)
        events.on_cut_off(announced(stream="tf"))
        assert events.recent() == ()


def silence_s(event: WriterEvent) -> float:
    """How long the writer was silent, as the text of its event says."""
    found = re.search(r"published nothing on joint_states for ([\d.]+) (ms|s)[,;]", event.text)
    assert found is not None, event.text
    return float(found[1]) * {"ms": 1e-3, "s": 1.0}[found[2]]


def test_silence_is_reported_to_on_event_and_then_the_writer_is_cut_off():
    reported: list[WriterEvent] = []
    started_s = time.monotonic()
    with EventLog(SUBSCRIBED, "joint_states", (), reported.append) as events:
        for stream in ("joint_states", "robot_description"):
            events.on_writer(announced(stream=stream), alive=True)
        for _ in range(3):
            events.on_sample("r1", DRIVER.session)
        until(lambda: [event.kind for event in reported] == ["joined", "joined", "stale"])
        rounding_s = 0.05
        stale_s, elapsed_s = silence_s(reported[-1]), time.monotonic() - started_s
        assert FLOOR_S <= stale_s <= elapsed_s + rounding_s
        events.on_sample("r1", DRIVER.session)
        until(lambda: reported[-1].kind == "resumed")
        assert stale_s <= silence_s(reported[-1]) <= time.monotonic() - started_s + rounding_s
        until(lambda: reported[-1].kind == "stale")
        for stream in ("robot_description", "joint_states"):
            events.on_writer(announced(stream=stream), alive=False)
        until(lambda: len(reported) == 7)
    assert [event.kind for event in reported[-2:]] == ["cut off", "cut off"]
    assert tuple(reported) == events.recent()


def test_writer_without_samples_is_never_stale():
    reported: list[WriterEvent] = []
    with EventLog(SUBSCRIBED, "joint_states", (), reported.append) as events:
        for session in (7, 8):
            events.on_writer(announced(WriterId("driver", f"host {session}", 1, 5, session)), alive=True)
        for _ in range(2):
            events.on_sample("r1", 7)
        until(lambda: reported[-1:] and reported[-1].kind == "stale")
        assert [event.kind for event in reported] == ["joined", "joined", "conflict", "stale"]
        assert reported[-1].writer.session == 7  # type: ignore[union-attr]


def test_exceptions_of_the_callback_are_counted_and_stop_nothing(monkeypatch):
    monkeypatch.setattr("threading.excepthook", lambda _: None)

    def wrong(event: WriterEvent) -> None:
        raise ValueError(event.text)

    with EventLog(SUBSCRIBED, "joint_states", (), wrong) as events:
        events.on_writer(announced(), alive=True)
        events.on_writer(announced(), alive=False)
        until(lambda: events.failures == 2)
    assert kinds(events) == ["joined", "left"]


def test_memory_is_bounded_for_any_number_of_writers():
    with quiet() as events:
        for session in range(2 * MAX_ENTRIES):
            one = announced(
                WriterId("driver", f"host {session}", 1, 5, session), "tf_static", f"mount {session}"
            )
            events.on_writer(one, alive=True)
            events.set_static_children("r1", one.name, frozenset({"r1/camera"}))
            events.on_writer(one, alive=False)
        assert len(events.recent()) == 1024
        sizes = {name: len(value) for name, value in vars(events).items() if isinstance(value, dict)}
    assert sizes == {"_alive": 0, "_former": MAX_ENTRIES, "_gone": MAX_ENTRIES, "_conflicts": 0}


MOUNT, ROOM = ("r1", "mount"), ("r2", "room")


def test_other_writer_of_a_frame_is_returned_until_it_withdraws():
    owners = StaticEdgeOwners()
    assert owners.replace(MOUNT, frozenset({"r1/a", "r1/b"})) == []
    assert owners.replace(ROOM, frozenset({"r1/c", "r1/b"})) == [("r1/b", [MOUNT])]
    assert owners.replace(MOUNT, frozenset({"r1/b"})) == [("r1/b", [ROOM])]
    assert owners.replace(ROOM, frozenset()) == []
    assert owners.replace(MOUNT, frozenset({"r1/a", "r1/b", "r1/c"})) == []
