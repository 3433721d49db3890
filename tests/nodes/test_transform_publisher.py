"""TransformPublisher: moving edges of several writers, beside a robot's joint states."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from itertools import count

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, find_free_port, until
from helpers.robots import RRBOT, wait_for_reader
from helpers.tokens import current_tokens

from zstate.clock import ManualClock
from zstate.errors import Closed, InsertRefused, InvalidInput, SecondWriter
from zstate.net.discovery import discover
from zstate.net.presence import announce
from zstate.net.session import connect
from zstate.net.status_monitor import StatusSubscriber
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.transform import Transform
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import WRITER_TOKEN
from zstate.wire.messages import Status, WriterTransforms, order_digest, to_block
from zstate.wire.native import encode, encoding_of
from zstate.wire.protocol import SerializedSample

MS = 1_000_000
SECOND = 1_000_000_000


def pose(parent: str, child: str, x: float = 0.0, stamp: int | None = None) -> Transform:
    return Transform(parent, child, (x, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), stamp)


def test_odometry_moves_the_joints_of_a_robot(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    with (
        StatePublisher(writer, RRBOT, "r1") as wheels,
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformListener(reader, "r1") as listener,
    ):
        for step in range(3):
            wheels.publish([0.0, 0.0], stamp=stamp + step * 20 * MS)
            odometry.publish([pose("odom", "world", float(step))], stamp + step * 20 * MS)
        found = listener.buffer.wait("odom", "base", stamp + 30 * MS, timeout_s=DEADLINE_S)
        base = listener.buffer.lookup("world", "base", stamp + 30 * MS)
        assert found.translation - base.translation == pytest.approx([1.5, 0.0, 0.0])
        assert found.kind == "interpolated"


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_listeners_receive_transforms_whatever_they_follow(sessions, follow):
    writer, reader = sessions
    with (
        TransformPublisher(writer, "r1", "tracker") as tracker,
        TransformListener(reader, "*", follow=follow) as listener,
    ):
        tracker.publish([pose("map", "ball", 2.0)])
        assert listener.buffer.wait("map", "ball", timeout_s=DEADLINE_S).translation[0] == 2.0
        assert listener.robots() == ("r1",)


def test_late_listener_gets_the_samples_of_the_last_seconds(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    with TransformPublisher(writer, "r1", "tracker") as tracker:
        for step in range(300):  # more than a page
            tracker.publish([pose("map", "ball", float(step))], stamp + step * MS)
        with TransformListener(reader, "r1") as late:
            until(lambda: late.stats.recalled + late.stats.received == 300)
            poses, valid = late.buffer.lookup_many("map", "ball", stamp + MS * np.arange(300))
    assert valid.all()
    assert poses[:, 0].tolist() == [float(step) for step in range(300)]


def test_stamp_is_that_of_the_transforms_or_now(sessions):
    writer, reader = sessions
    with (
        TransformPublisher(writer, "r1", "tracker", clock=ManualClock(7 * SECOND)) as tracker,
        TransformListener(reader, "r1", history_s=1000.0) as listener,
    ):
        wait_for_reader(writer, "zstate/r1/transforms/tracker")
        tracker.publish([pose("map", "ball", 1.0)])
        tracker.publish([pose("map", "ball", 2.0, 9 * SECOND)])
        tracker.publish([pose("map", "ball", 3.0, 9 * SECOND)], 8 * SECOND)
        until(lambda: [frame.count for frame in listener.buffer.frames() if frame.parent] == [3])
        found = [listener.buffer.lookup("map", "ball", second * SECOND) for second in (7, 8, 9)]
    assert [transform.translation[0] for transform in found] == [1.0, 3.0, 2.0]


def test_two_writers_of_one_robot_publish_different_edges(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    with (
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformPublisher(reader, "r1", "localisation") as localisation,
        TransformListener(reader, "r1") as listener,
    ):
        odometry.publish([pose("odom", "base_link", 1.0)], stamp)
        localisation.publish([pose("map", "odom", 10.0)], stamp)
        assert listener.buffer.wait("map", "base_link", timeout_s=DEADLINE_S).translation[0] == 11.0
        writers = {
            name for info in discover(reader) for stream, name in info.writers if stream == "transforms"
        }
    assert len(writers) == 2


def test_second_writer_of_an_edge_is_refused_and_the_first_named(sessions):
    first_session, second_session = sessions
    with (
        TransformPublisher(first_session, "r1", "odometry", program="wheels.py") as first,
        TransformPublisher(second_session, "r1", "visual") as second,
        StaticPublisher(second_session, "r1", "mount") as statics,
    ):
        first.publish([pose("odom", "base_link")])
        until(lambda: current_tokens(second_session, "zstate/r1/@edge/**", 1.0))
        for publish in (second.publish, lambda edges: statics.set(edges[0])):
            for parent in ("odom", "map"):
                with pytest.raises(
                    SecondWriter, match=r"wheels\.py.* places 'r1/base_link' on 'r1/odom'"
                ) as raised:
                    publish([pose(parent, "base_link")])
                assert raised.value.first is not None
                assert (raised.value.first.program, raised.value.stream) == ("wheels.py", "transforms")
        second.publish([pose("odom", "camera")])  # its other edges are not affected
        assert second.stats.sent == 1


def test_edge_is_free_once_its_writer_is_closed(sessions):
    first_session, second_session = sessions
    stamp = time.time_ns()
    with TransformListener(second_session, "r1") as listener:
        with TransformPublisher(first_session, "r1", "odometry") as first:
            first.publish([pose("odom", "base_link", 1.0)], stamp)
            listener.buffer.wait("odom", "base_link", timeout_s=DEADLINE_S)
        until(lambda: not discover(second_session))
        with TransformPublisher(second_session, "r1", "visual") as second:
            second.publish([pose("odom", "base_link", 2.0)], stamp + SECOND)
            listener.buffer.wait("odom", "base_link", stamp + SECOND, timeout_s=DEADLINE_S)
        assert listener.stats.refused == {}


def test_static_edge_is_not_moved_by_another_writer(sessions):
    first_session, second_session = sessions
    with (
        StaticPublisher(first_session, "r1", "mount") as statics,
        TransformPublisher(second_session, "r1", "tracker") as tracker,
    ):
        statics.set(pose("tool", "camera"))
        until(lambda: current_tokens(second_session, "zstate/r1/@writer/$*tf_static$*/*", 1.0))
        with pytest.raises(SecondWriter, match="'mount' of 'r1'"):
            tracker.publish([pose("tool", "camera")])


def test_two_writers_of_one_name_are_refused(sessions):
    first_session, second_session = sessions
    with TransformPublisher(first_session, "r1", "odometry"):
        until(lambda: current_tokens(second_session, "zstate/r1/@writer/**", 1.0))
        with pytest.raises(SecondWriter, match=r"transforms of 'r1' under the name 'odometry'.*another name"):
            TransformPublisher(second_session, "r1", "odometry")


def test_of_two_writers_that_start_an_edge_at_once_one_is_refused(sessions):
    with (
        TransformPublisher(sessions[0], "r1", "one") as one,
        TransformPublisher(sessions[1], "r1", "other") as other,
        ThreadPoolExecutor(2) as threads,
    ):
        futures = [threads.submit(writer.publish, [pose("odom", "base_link")]) for writer in (one, other)]
        errors = [future.exception(timeout=DEADLINE_S) for future in futures]
    assert sorted(type(error).__name__ for error in errors) == ["NoneType", "SecondWriter"]


@pytest.mark.parametrize("later_publishes_first", [True, False])
def test_later_writer_of_an_edge_ends_when_two_networks_are_joined(later_publishes_first):
    endpoints = [f"tcp/127.0.0.1:{find_free_port()}" for _ in range(2)]
    edges = [pose("odom", "base_link")]
    with ExitStack() as opened:
        ours, theirs = (opened.enter_context(connect(listen=endpoint)) for endpoint in endpoints)
        first = opened.enter_context(TransformPublisher(ours, "r1", "wheels", program="wheels.py"))
        second = opened.enter_context(TransformPublisher(theirs, "r1", "visual"))
        for publisher in (first, second):
            publisher.publish(edges)
        opened.enter_context(connect(endpoints=endpoints))
        for session in (ours, theirs):
            until(lambda s=session: len(current_tokens(s, "zstate/*/@edge/**", 1.0)) == 2)
        if not later_publishes_first:
            first.publish(edges)
        second.publish(edges)  # a token alone displaces no writer
        with pytest.raises(SecondWriter, match=r"wheels\.py.* places 'r1/base_link' on 'r1/odom'") as raised:
            until(lambda: first.publish(edges) or second.publish(edges))
        assert raised.value.edge == ("r1/odom", "r1/base_link")
        until(lambda: len(current_tokens(ours, "zstate/*/@edge/**", 1.0)) == 1)
        with pytest.raises(SecondWriter):
            second.publish([pose("map", "ball")])
        first.publish(edges)


def test_token_of_an_earlier_writer_ends_none_that_publishes_an_edge(sessions):
    ours, theirs = sessions
    stranger = Announcement("r1", "transforms", WriterId("stranger", "laptop", 9, 1, 99), "stranger")
    with (
        TransformPublisher(ours, "r1", "wheels") as wheels,
        KeyPublisher(theirs, "zstate/r1/transforms/stranger", encoding_of(WriterTransforms)) as stream,
    ):
        wheels.publish([pose("odom", "base_link")])
        with announce(theirs, WRITER_TOKEN.key("r1", "transforms", stranger.identity)):
            until(lambda: len(current_tokens(ours, "zstate/r1/@writer/*/*", 1.0)) == 2)

            def publish_both(child: str, seconds: float) -> bool:
                deadline = time.monotonic() + seconds
                while time.monotonic() < deadline:
                    names = (("odom", child),)
                    stream.put(
                        encode(WriterTransforms(1, 0, 99, order_digest(names), to_block(np.eye(7)[6]), names))
                    )
                    wheels.publish([pose("odom", "base_link")])
                return True

            assert publish_both("another", 0.3)
            with pytest.raises(SecondWriter) as raised:
                publish_both("base_link", DEADLINE_S)
    assert raised.value.first == stranger.writer


def test_link_of_an_announced_model_is_refused(sessions):
    writer, reader = sessions
    child = RRBOT.joints[1].child
    with StatePublisher(writer, RRBOT, "r1"), TransformPublisher(reader, "r1", "tracker") as tracker:
        until(lambda: len(discover(reader)) == 1)
        with pytest.raises(InsertRefused, match="by the model of 'r1'"):
            tracker.publish([pose("odom", child)])
        assert (tracker.stats.sent, tracker.stats.refused) == (0, 1)


@pytest.mark.parametrize(
    ("transforms", "match"),
    [
        ([], "at least one; got no transform"),
        ([("odom", "base"), ("map", "base")], "one transform for each of its children"),
        ([("odom", "odom")], "itself"),
        ([("a", "b"), ("b", "a")], "loop"),
    ],
)
def test_bad_sample_is_refused_and_counted(sessions, transforms, match):
    with TransformPublisher(sessions[0], "r1", "tracker") as tracker:
        with pytest.raises(InvalidInput, match=match):
            tracker.publish([pose(*edge) for edge in transforms])
        assert (tracker.stats.sent, tracker.stats.refused) == (0, 1)
        tracker.publish([pose("odom", "base")])  # nothing of the refused sample is left


def test_transforms_of_several_instants_are_refused(sessions):
    with (
        TransformPublisher(sessions[0], "r1", "tracker") as tracker,
        pytest.raises(InvalidInput, match="have one stamp; got 1, 2"),
    ):
        tracker.publish([pose("map", "a", stamp=1), pose("map", "b", stamp=2)])


def test_closed_publisher_raises_closed(sessions):
    tracker = TransformPublisher(sessions[0], "r1", "tracker")
    tracker.close()
    tracker.close()
    with pytest.raises(Closed, match="'tracker'"):
        tracker.publish([pose("map", "ball")])


class Circle:
    """A source that has nothing new at every fourth instant."""

    def __init__(self) -> None:
        self.reads = 0

    def read(self, stamp: int) -> list[Transform] | None:
        self.reads += 1
        return None if self.reads % 4 == 0 else [pose("odom", "base_link", float(self.reads))]


def test_run_publishes_a_source_at_an_exact_rate(sessions):
    writer, reader = sessions
    with (
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformListener(reader, "r1") as listener,
    ):
        report = odometry.run(Circle(), 200.0, seconds=0.2)
        assert report.ticks + report.skipped == 40
        assert odometry.stats.sent == report.ticks - report.ticks // 4
        until(
            lambda: (
                [frame.count for frame in listener.buffer.frames() if frame.parent] == [odometry.stats.sent]
            )
        )


def test_status_reports_the_rate(sessions):
    writer, reader = sessions
    received: list[tuple[str, Status]] = []
    with (
        StatusSubscriber(reader, "r1", lambda robot, status: received.append((robot, status))),
        TransformPublisher(writer, "r1", "odometry", program="wheels.py") as odometry,
    ):
        odometry.publish([pose("odom", "base_link")])
        until(lambda: len(received) > 0)
    robot, status = received[0]
    assert (robot, status.program, status.sent, status.level) == ("r1", "wheels.py", 1, "ok")


def test_events_name_the_writer_and_its_edges(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        with TransformPublisher(writer, "r1", "odometry"):
            until(lambda: len(listener.events()) == 1)
        until(lambda: len(listener.events()) == 2)
        events = [(event.kind, event.stream) for event in listener.events()]
        assert events == [("joined", "transforms"), ("left", "transforms")]
        assert "writes transforms as 'odometry'" in listener.events()[0].text


def test_samples_are_numbered_without_gaps(sessions):
    writer, reader = sessions
    with (
        TransformPublisher(writer, "r1", "tracker") as tracker,
        TransformListener(reader, "r1") as listener,
    ):
        stamp = time.time_ns()
        for step in range(50):
            tracker.publish([pose("map", "ball")], stamp + step)
        until(lambda: listener.stats.received + listener.stats.recalled >= 50)
        assert (listener.stats.missed, listener.stats.dropped) == (0, 0)


def test_covariance_comes_back_from_lookups_of_its_edge(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    first, last = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.diag([3.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    first[0, 1] = first[1, 0] = 0.5
    with (
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformListener(reader, "r1") as listener,
    ):
        for at, covariance in ((stamp, first), (stamp + 2 * MS, last)):
            moved = pose("odom", "base_link").with_covariance(covariance)
            odometry.publish([moved, pose("base_link", "wheel")], at)
        buffer = listener.buffer
        buffer.wait("odom", "wheel", stamp + 2 * MS, timeout_s=DEADLINE_S)
        assert np.array_equal(buffer.lookup("odom", "base_link", stamp).covariance, first)
        between = buffer.lookup("odom", "base_link", stamp + MS)
        assert np.allclose(between.covariance, (first + last) / 2)
        assert (between.kind, buffer.lookup("base_link", "wheel", stamp).covariance) == ("interpolated", None)
        assert buffer.lookup("odom", "wheel", stamp).covariance is None


def test_samples_that_arrive_after_their_writer_left_join_its_history(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    edges, key = (("odom", "base_link"),), "zstate/r1/transforms/odometry"
    with TransformListener(reader, "r1") as listener:

        def counts() -> list[int]:
            return [frame.count for frame in listener.buffer.frames() if frame.parent]

        with TransformPublisher(writer, "r1", "odometry") as odometry:
            for step in range(2):
                odometry.publish([pose("odom", "base_link")], stamp + step)
            until(lambda: counts() == [2])
            session = odometry._out.session_id
        until(lambda: [event.kind for event in listener.events()] == ["joined", "left"])
        late = WriterTransforms(stamp + 2, 2, session, order_digest(edges), to_block(np.eye(7)[6]), edges)
        with KeyPublisher(writer, key, encoding_of(WriterTransforms)) as stream:
            wait_for_reader(writer, key)
            stream.put(encode(late))
            until(lambda: counts() == [3])
        assert listener.robots() == ("r1",)


def test_unannounced_writers_are_bounded_and_leave_no_edges(sessions):
    """A hostile writer makes up a session for each sample."""
    with TransformListener(sessions[0], "r1") as listener:
        transforms = listener._reader.ingests.streams["transforms"]
        stamp = time.time_ns()
        for session in range(300):
            edges = (("odom", f"frame{session}"),)
            sample = WriterTransforms(stamp, 0, session, order_digest(edges), to_block(np.eye(7)[6]), edges)
            encoding = encoding_of(WriterTransforms)
            arrival = SerializedSample("zstate/r1/transforms/thief", encode(sample), encoding)
            listener._reader._on_samples(transforms, [arrival])
        moving = [frame.name for frame in listener.buffer.frames() if frame.parent]
        assert listener.stats.refused == {"too many writers": 44}
    assert len(transforms.all()) == 256
    assert moving == [f"r1/frame{session}" for session in range(44, 300)]


def test_edges_of_writers_that_have_left_stay(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        for number in range(3):
            with TransformPublisher(writer, "r1", f"writer{number}") as publisher:
                publisher.publish([pose("odom", f"frame{number}")])
                listener.buffer.wait("odom", f"frame{number}", timeout_s=DEADLINE_S)
            left = 2 * (number + 1)  # each has joined and left
            until(lambda left=left: len(listener.events()) == left)
        assert all(listener.buffer.can_lookup("odom", f"frame{number}") for number in range(3))


def test_samples_lost_in_a_full_ring_are_counted_and_the_others_inserted(
    sessions, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("zstate.net.streams.WILDCARD_CAPACITY", 64)
    writer, reader = sessions
    stamp, is_inserting, goes_on = time.time_ns(), threading.Event(), threading.Event()
    with (
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformListener(reader, "r1", history_on_join=False) as listener,
    ):
        insert = listener.buffer.insert_many

        def slowly(*arguments: object, **options: object) -> bool:
            is_inserting.set()
            goes_on.wait(DEADLINE_S)
            return insert(*arguments, **options)

        monkeypatch.setattr(listener.buffer, "insert_many", slowly)
        steps = count()

        def move() -> None:
            step = next(steps)
            odometry.publish([pose("odom", "base_link", float(step))], stamp + step * MS)

        wait_for_reader(writer, "zstate/r1/transforms/odometry")
        move()
        assert is_inserting.wait(DEADLINE_S)  # samples before the first one received are not counted
        for _ in range(500):
            move()
        goes_on.set()

        def are_all_counted() -> bool:
            stats = listener.stats
            if stats.dropped and stats.received + stats.dropped + stats.missed == odometry.stats.sent:
                return True
            move()  # shows whether the last samples were lost
            return False

        until(are_all_counted)
        for at in range(0, 500, 7):  # the motion is linear: a gap changes no pose
            found = listener.buffer.lookup("odom", "base_link", stamp + at * MS)
            assert found.translation[0] == pytest.approx(at)


def test_writer_with_a_clock_set_back_restarts_only_its_own_edges(sessions):
    writer, reader = sessions
    now = time.time_ns()
    with (
        TransformPublisher(writer, "r1", "wheels") as wheels,
        TransformPublisher(writer, "r1", "tracker") as tracker,
        TransformListener(reader, "r1") as listener,
    ):

        def counts() -> dict[str, int]:
            return {frame.name: frame.count for frame in listener.buffer.frames() if frame.parent}

        for step in range(5):
            wheels.publish([pose("odom", "base_link")], now + step * MS)
            tracker.publish([pose("map", "ball")], now + step * MS)
        until(lambda: counts() == {"r1/base_link": 5, "r1/ball": 5})
        for step in range(3):  # the first late sample may have a wrong stamp; the second begins a new epoch
            wheels.publish([pose("odom", "base_link")], now - 3600 * SECOND + step * MS)
        until(lambda: counts() == {"r1/base_link": 2, "r1/ball": 5})
        until(lambda: "set back" in [event.kind for event in listener.events()])
        (event,) = [event for event in listener.events() if event.kind == "set back"]
        assert (event.stream, event.writer and event.writer.session) == ("transforms", wheels._out.session_id)


def test_publish_from_many_threads_numbers_the_samples_and_close_ends_them(sessions):
    writer, reader = sessions
    stamp = time.time_ns()
    odometry = TransformPublisher(writer, "r1", "odometry")

    sent = [0] * 4

    def publish(number: int) -> None:
        with suppress(Closed):
            for sent[number] in count():
                odometry.publish([pose("odom", f"wheel{number}")], stamp + sent[number] * MS)

    with TransformListener(reader, "r1") as listener, ThreadPoolExecutor(4) as threads:
        published = [threads.submit(publish, number) for number in range(4)]
        until(lambda: odometry.stats.sent >= 400)
        odometry.close()
        for future in published:
            future.result(timeout=DEADLINE_S)
        assert odometry.stats.sent == sum(sent)
        until(lambda: listener.stats.received > 0)
        assert (listener.stats.refused, listener.stats.late) == ({}, 0)


@pytest.mark.parametrize("transforms", [pose("odom", "base_link"), [("odom", "base_link")], "odom", None])
def test_anything_but_a_list_of_transforms_is_refused(sessions, transforms):
    with TransformPublisher(sessions[0], "r1", "tracker") as tracker:
        with pytest.raises(InvalidInput, match="publish takes a list of Transforms; got"):
            tracker.publish(transforms)
        assert (tracker.stats.sent, tracker.stats.refused) == (0, 1)
