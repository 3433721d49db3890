"""Following robots over real sessions on loopback."""

from __future__ import annotations

import pickle
import time
from itertools import count

import numpy as np
import pytest
from helpers.processes import DEADLINE_S, Child, until
from helpers.robots import RRBOT, STAMP, UPRIGHT, assert_pose, kinematic_pose, put, wait_for_stream_readers

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.clock import ManualClock
from zstate.errors import AmbiguousFrame, InvalidInput, UnknownFrame
from zstate.model.load import load_model
from zstate.net.clock_offset import measure_offsets
from zstate.net.discovery import discover
from zstate.net.presence import announce
from zstate.net.streams import KeyPublisher
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.odometry.messages import Odometry
from zstate.sources import SineSource
from zstate.transform import Transform
from zstate.wire.messages import JointState, WriterTransforms, order_digest, to_block
from zstate.wire.native import encode, encoding_of
from zstate.wire.protocol import SerializedSample

PERIOD = 10_000_000
GRIPPER = load_model("gripper")


@pytest.mark.parametrize("model", [RRBOT, load_model("diffbot"), GRIPPER], ids=lambda model: model.name)
def test_both_follow_modes_agree_with_kinematics_at_every_stamp(sessions, model):
    writer, reader = sessions
    sine = SineSource(model)
    stamps = [STAMP + number * PERIOD for number in range(20)]
    with (
        StatePublisher(writer, model, "r1") as publisher,
        TransformListener(reader, "r1", history_on_join=False) as joints,
        TransformListener(reader, "r1", follow="tf", history_on_join=False) as transforms,
    ):
        wait_for_stream_readers(writer, "r1", "joint_states", "tf")
        for listener in (joints, transforms):
            # Who does not know yet whose time these are counts none as off the clock.
            until(lambda listener=listener: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        for stamp in stamps:
            publisher.publish(sine.read(stamp).positions, stamp=stamp)
        for listener in (joints, transforms):
            for link in model.links:
                listener.buffer.wait(model.root, link, timeout_s=DEADLINE_S)
            until(lambda listener=listener: listener.stats.received == 20)
    for stamp in stamps:
        for link in model.links:
            expected = kinematic_pose(model, sine.read(stamp).positions, model.root, link)
            for listener in (joints, transforms):
                assert_pose(listener.buffer.lookup(model.root, link, stamp), expected)
    assert joints.stats == transforms.stats
    assert (joints.stats.missed, joints.stats.late, joints.stats.refused) == (0, 0, {})


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_late_listener_has_model_and_statics_before_any_sample(sessions, follow):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1"), StaticPublisher(writer, "r1", "mount") as statics:
        statics.set(Transform("tool", "hook", (0.0, 0.0, 0.25), UPRIGHT))
        with TransformListener(reader, "r1", follow=follow) as listener:
            camera = listener.buffer.wait("hook", "camera_link", timeout_s=DEADLINE_S)
            expected = kinematic_pose(RRBOT, [0.0, 0.0], "tool", "camera_link")
            expected[2, 3] -= 0.25
            assert_pose(camera, expected)
            until(lambda: listener.robots() == ("r1",))
            assert listener.stats.received == 0


def test_frames_are_found_by_bare_and_full_names(sessions):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher, TransformListener(reader, "r1") as listener:
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.5, 0.25], stamp=STAMP)
        bare = listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        for target, source in (("r1/world", "r1/tool"), ("world", "r1/tool")):
            assert_pose(listener.buffer.lookup(target, source), bare.matrix)
        assert {frame.name for frame in listener.buffer.frames()} == {f"r1/{link}" for link in RRBOT.links}


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_bare_names_of_two_robots_of_one_model_are_ambiguous(sessions, follow):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as first,
        StatePublisher(writer, RRBOT, "r2") as second,
        TransformListener(reader, follow=follow) as listener,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        wait_for_stream_readers(writer, "r2", follow)
        first.publish([0.5, 0.25], stamp=STAMP)
        second.publish([-1.0, 2.0], stamp=STAMP + 1)
        for robot, positions in (("r1", [0.5, 0.25]), ("r2", [-1.0, 2.0])):
            pose = listener.buffer.wait(f"{robot}/world", f"{robot}/tool", timeout_s=DEADLINE_S)
            assert_pose(pose, kinematic_pose(RRBOT, positions, "world", "tool"))
        with pytest.raises(AmbiguousFrame) as caught:
            listener.buffer.lookup("world", "tool")
        assert set(caught.value.candidates) == {"r1/world", "r2/world"}
        assert listener.robots() == ("r1", "r2")


def test_listener_of_one_robot_receives_nothing_of_another(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as mine,
        StatePublisher(writer, RRBOT, "r2") as other,
        TransformListener(reader, "r1") as listener,
    ):
        wait_for_stream_readers(writer, "r1")
        other.publish([0.0, 0.0])
        mine.publish([0.0, 0.0])
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert listener.robots() == ("r1",)
        assert all(frame.name.startswith("r1/") for frame in listener.buffer.frames())


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_listener_of_several_robots_receives_exactly_these(sessions, follow):
    writer, reader = sessions
    names = ["r1", "r2", "r3"]
    with (
        StatePublisher(writer, RRBOT, "r1") as first,
        StatePublisher(writer, RRBOT, "r2") as other,
        TransformListener(reader, ["r1", "r3"], follow=follow) as listener,
        StatePublisher(writer, RRBOT, "r3") as later,  # joins after the listener
        TransformListener(reader, follow=follow) as everything,
    ):
        until(lambda: {event.robot for event in listener.events()} == {"r1", "r3"})
        stamps = iter(range(STAMP, STAMP + 10_000 * PERIOD, PERIOD))

        def all_received_twenty() -> bool:
            stamp = next(stamps)
            for publisher in (first, other, later):
                publisher.publish([0.1, 0.2], stamp=stamp)
            counts = [everything.stats_of(name).received for name in names]
            return min(*counts, *(listener.stats_of(name).received for name in ("r1", "r3"))) >= 20

        until(all_received_twenty)
        assert listener.stats_of("r2").received == 0
        assert listener.robots() == ("r1", "r3")
        for name in ("r1", "r3"):
            assert_pose(
                listener.buffer.lookup(f"{name}/world", f"{name}/camera_link"),
                kinematic_pose(RRBOT, [0.1, 0.2], "world", "camera_link"),
            )
        later.close()
        until(lambda: any(event.kind == "left" and event.robot == "r3" for event in listener.events()))


def test_listener_of_several_robots_gets_the_samples_that_each_cached(sessions):
    writer, reader = sessions
    now = time.time_ns()
    with StatePublisher(writer, RRBOT, "r1") as first, StatePublisher(writer, RRBOT, "r2") as second:
        for publisher in (first, second):
            publisher.publish([0.1, 0.2], stamp=now)
        with TransformListener(reader, ("r1", "r2")) as listener:
            for name in ("r1", "r2"):
                listener.buffer.wait(f"{name}/world", f"{name}/camera_link", timeout_s=DEADLINE_S)
                assert listener.buffer.latest(f"{name}/world", f"{name}/camera_link") == now


def test_sequence_of_one_robot_is_that_robot(sessions):
    with TransformListener(sessions[1], ["r1"]) as listener:
        assert listener.robot == "r1"
    with TransformListener(sessions[1], ["r1"], wire="ros2") as listener:
        assert listener.robot == "r1"


@pytest.mark.parametrize(
    ("robots", "wire", "problem"),
    [
        ([], "native", "empty"),
        (["r1", "*"], "native", r"'\*' is in a sequence"),
        (["r1", "r2", "r1"], "native", "has 'r1' more than once"),
        (["r1", "a/b"], "native", "'a/b' contains '/'"),
        (["r1", ""], "native", "is empty"),
        (["r1", None], "native", "robot name is text; got None"),
        (None, "native", "robot name is text; got None"),
        (["r1", "r2"], "ros2", "share topics"),
    ],
)
def test_unusable_sequences_of_robots_are_refused(sessions, robots, wire, problem):
    with pytest.raises(InvalidInput, match=problem):
        TransformListener(sessions[1], robots, wire=wire)


def test_two_listeners_fill_one_given_buffer(sessions):
    writer, reader = sessions
    buffer = TransformBuffer(history_s=3.0, clock=ManualClock(5))
    buffer.insert_static(Transform("hall", "r1/world", (1.0, 0.0, 0.0), UPRIGHT))
    buffer.insert_static(Transform("hall", "r2/mount", (0.0, 2.0, 0.0), UPRIGHT))
    with (
        StatePublisher(writer, RRBOT, "r1"),
        StatePublisher(writer, GRIPPER, "r2"),
        TransformListener(reader, "r1", buffer) as one,
        TransformListener(reader, "r2", buffer, follow="tf") as other,
    ):
        assert one.buffer is other.buffer is buffer
        palm_from_base = buffer.wait("base", "palm", timeout_s=DEADLINE_S)
        # mount_to_palm is 0.01 above; base is at world.
        assert np.allclose(palm_from_base.translation, [-1.0, 2.0, 0.01], rtol=0, atol=1e-12)


def test_history_and_clock_configure_the_listeners_own_buffer(sessions):
    clock = ManualClock(5)
    with TransformListener(sessions[1], "r1", history_s=2.5, clock=clock) as listener:
        assert (listener.buffer.history_s, listener.buffer.clock) == (2.5, clock)


def test_invalid_follow_and_placers_are_refused(sessions):
    with pytest.raises(InvalidInput, match="follow is 'joint_states' or 'tf', not 'joints'"):
        TransformListener(sessions[0], "r1", follow="joints")
    with pytest.raises(InvalidInput, match="no wire 'dds'"):
        TransformListener(sessions[0], "r1", wire="dds")
    with pytest.raises(InvalidInput, match="robot name 'a/b'"):
        TransformListener(sessions[0], "a/b")
    with pytest.raises(InvalidInput, match="history_s"):
        TransformListener(sessions[0], "r1", history_s=0.0)
    with pytest.raises(
        InvalidInput, match=r"placers is a collection of robot names, for instance \['site'\]"
    ):
        TransformListener(sessions[0], "r1", placers="site")
    with pytest.raises(InvalidInput, match="robot name is text; got None"):
        TransformListener(sessions[0], "r1", placers=["site", None])
    with pytest.raises(InvalidInput, match="robot name 'a/b'"):
        TransformListener(sessions[0], "r1", placers=["a/b"])
    with pytest.raises(InvalidInput, match="placers need the native wire"):
        TransformListener(sessions[0], "r1", placers=["site"], wire="ros2")


def test_close_ends_reception_and_may_be_repeated(sessions):
    writer, reader = sessions
    listener = TransformListener(reader, "r1")
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_stream_readers(writer, "r1")
        publisher.publish([0.0, 0.0], stamp=STAMP)
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        listener.close()
        listener.close()
        with KeyPublisher(writer, "zstate/r1/joint_states", "") as probe:
            until(lambda: not probe.has_readers)
        assert listener.buffer.latest("world", "tool") == STAMP


READER = """
    import sys
    from zstate import TransformListener, connect
    with connect() as session, TransformListener(session, "r1", follow=sys.argv[1]) as listener:
        print("ready")
        print(listener.buffer.wait("world", "tool", timeout_s=15.0).stamp)
        print(sorted({"pinocchio", "viser", "mcap", "click", "rich"} & set(sys.modules)))
"""


@pytest.mark.parametrize("follow", ["joint_states", "tf"])
def test_listener_imports_neither_pinocchio_nor_the_view(sessions, spawn, follow):
    reader: Child = spawn(READER, follow, is_forked=False)
    assert reader.line() == "ready"
    writer = sessions[0]
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_stream_readers(writer, "r1", follow)
        stamp = time.time_ns()
        publisher.publish([0.0, 0.0], stamp=stamp)
        assert reader.line() == str(stamp)
        assert reader.line() == "[]"
    assert (reader.wait(), reader.stderr) == (0, "")


def test_gaps_in_a_batch_that_filled_the_ring_count_as_dropped(sessions, monkeypatch: pytest.MonkeyPatch):
    def receive(*seqs: int) -> None:
        states = [JointState(STAMP + seq, seq, 9, order_digest(RRBOT.joint_names), b"") for seq in seqs]
        key, encoding = "zstate/r1/joint_states", encoding_of(JointState)
        samples = [SerializedSample(key, encode(state), encoding) for state in states]
        listener._reader._on_samples(listener._reader.ingests.followed, samples)

    with TransformListener(sessions[0], "r1") as listener:
        monkeypatch.setattr(listener._reader.ingests.followed, "capacity", 3)
        receive(0)
        receive(2, 5, 6)  # a full ring goes on losing its oldest while it is emptied
        receive(8)
        assert (listener.stats.dropped, listener.stats.missed) == (3, 1)


def test_a_full_ring_counts_the_next_gap_of_writers_that_have_left_or_never_announced_themselves(
    sessions, monkeypatch: pytest.MonkeyPatch
):
    stranger, departed, announced, other = range(7, 11)

    def receive(*samples: tuple[int, int]) -> None:
        """Samples by session and sequence number, which arrive together."""
        arrived: list[SerializedSample] = []
        for session, seq in samples:
            edges = (("world", f"frame_{session}"),)
            pose = to_block([0.0, 0.0, 0.0, *UPRIGHT])
            message = WriterTransforms(STAMP + seq, seq, session, order_digest(edges), pose, edges)
            key = f"zstate/r1/transforms/writer_{session}"
            arrived.append(SerializedSample(key, encode(message), encoding_of(WriterTransforms)))
        listener._reader._on_samples(streams, arrived)

    with TransformListener(sessions[0], "r1") as listener:
        streams = listener._reader.ingests.streams["transforms"]
        for session in (departed, announced):
            streams.announce("r1", session, f"writer_{session}")
        receive((stranger, 0), (departed, 0), (announced, 0), (other, 0))
        streams.writer_left("r1", departed)
        monkeypatch.setattr(streams, "capacity", 3)
        receive((other, 1), (other, 2), (other, 3))
        for gap, counts in ((10, (9 * 3, 0)), (20, (9 * 3, 9 * 3))):
            for session in (stranger, departed, announced):
                receive((session, gap))
            assert (listener.stats.dropped, listener.stats.missed) == counts


def test_key_without_a_robot_is_foreign_and_loses_no_sample(sessions):
    writer, reader = sessions
    strange = ("zstate/*/joint_states", "zstate/r$*/joint_states", "zstate/a b/joint_states")
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "*", history_on_join=False) as listener,
    ):
        wait_for_stream_readers(writer, "r1")
        for number in range(50):
            for key in strange:
                state = JointState(STAMP + number, number, 99, order_digest(RRBOT.joint_names), bytes(16))
                put(writer, key, encode(state), encoding_of(JointState))
            publisher.publish([0.0, 0.0])
        put(writer, "zstate/*/robot_description", b"noise")
        put(writer, "zstate/*/tf_static/mount", b"noise")
        put(writer, "zstate/r1/tf_static/*", b"noise")
        until(lambda: listener.stats.refused.get("foreign", 0) >= 50 * len(strange) + 3)
        until(lambda: listener.stats.received == 50)
        assert listener.robots() == ("r1",)


@pytest.mark.parametrize("robot", ["*", "r1"])
def test_invalid_token_hides_no_other(sessions, robot):
    writer, reader = sessions
    broken = ["p,h," + "1" * 5000 + ",1,1", "p,h,1," + "1" * 30 + ",1", "p,h,1,1," + "1" * 21]
    keys = [
        f"zstate/{name}/@writer/joint_states/{identity}" for name in ("r1", "evil") for identity in broken
    ]
    tokens = [
        writer.zenoh.liveliness().declare_token(key) for key in (*keys, "zstate/a b/@writer/tf/p,h,1,1,1")
    ]
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, robot) as listener,
    ):
        publisher.publish([0.0, 0.0])
        listener.buffer.wait("r1/world", "r1/tool", timeout_s=DEADLINE_S)
        until(lambda: len([event for event in listener.events() if event.kind == "joined"]) == 3)
        assert [info.name for info in discover(reader)] == ["r1"]
        assert measure_offsets(reader, "*")
    for token in tokens:
        token.undeclare()


def test_lookup_of_a_robot_that_is_not_announced_names_it_and_the_one_that_is(sessions):
    writer, reader = sessions
    with TransformListener(reader, "myrm") as listener:
        with pytest.raises(UnknownFrame, match="robot 'myrm' is not announced \\(announced: no robot\\)"):
            listener.buffer.lookup("world", "tool")
        with StatePublisher(writer, RRBOT, "myarm", streams=["joint_states"]):
            until(lambda: discover(reader))
            with pytest.raises(UnknownFrame) as raised:
                listener.buffer.lookup("world", "tool")
            hint = "robot 'myrm' is not announced; did you mean 'myarm'? (announced: myarm)"
            assert str(raised.value).endswith(f"this buffer has received no frame yet; {hint}")
            assert pickle.loads(pickle.dumps(raised.value)).hint == hint


def test_lookup_of_a_robot_that_the_listener_does_not_receive_names_those_that_it_does(sessions):
    writer, reader = sessions
    with (
        TransformListener(reader, "myarm") as listener,
        StatePublisher(writer, RRBOT, "myarm") as publisher,
        StatePublisher(writer, RRBOT, "other"),
    ):
        publisher.publish([0.0, 0.0])
        listener.buffer.lookup("myarm/world", "tool", timeout_s=DEADLINE_S)
        with pytest.raises(UnknownFrame, match="; this listener receives 'myarm' alone; ") as raised:
            listener.buffer.lookup("world", "gripper_of_other")
        assert pickle.loads(pickle.dumps(raised.value)).hint == "this listener receives 'myarm' alone"


@pytest.mark.parametrize("robot", ["*", "myarm"])
def test_lookup_before_the_first_frame_of_an_announced_robot_names_the_robot(sessions, robot):
    writer, reader = sessions
    with (
        TransformListener(reader, robot) as listener,
        StatePublisher(writer, RRBOT, "myarm", streams=["joint_states"]),
    ):
        until(listener.events)
        with pytest.raises(UnknownFrame, match="myarm is announced, but no frame of it has arrived"):
            listener.buffer.lookup("world", "tool")
    with pytest.raises(UnknownFrame, match="is a publisher running"):
        listener.buffer.lookup("world", "tool")


@pytest.mark.parametrize("stream", ["transforms", "odometry"])
def test_writer_whose_token_has_no_name_is_announced(sessions, monkeypatch: pytest.MonkeyPatch, stream):
    raised: list[object] = []
    monkeypatch.setattr("threading.excepthook", raised.append)
    writer, reader = sessions
    edges = (("odom", "base_link"),)
    body = 5, order_digest(edges), to_block((*[0.0] * 6, 1.0)), edges

    def named() -> bool:
        seq = next(seqs)
        if stream == "transforms":
            publisher.put(encode(WriterTransforms(1 + seq, seq, *body)))
        else:
            publisher.put(encode(Odometry(1 + seq, seq, *body, twist=to_block([0.0] * 6))))
        return [frame.writer for frame in listener.buffer.frames() if frame.parent] == ["p@h pid 1"]

    seqs = count()
    encoding = encoding_of(WriterTransforms if stream == "transforms" else Odometry)
    with (
        announce(writer, f"zstate/r1/@writer/{stream}/p,h,1,1,5"),
        TransformListener(reader, "r1") as listener,
        KeyPublisher(writer, f"zstate/r1/{stream}/any", encoding) as publisher,
    ):
        until(named)
    assert raised == []


def test_observers_are_called_after_each_processed_batch(sessions):
    writer, reader = sessions
    seen: list[int] = []
    with TransformListener(reader, "r1", history_on_join=False) as listener:
        listener.add_observer(lambda: seen.append(listener.stats.received))
        with StatePublisher(writer, RRBOT, "r1") as publisher:
            wait_for_stream_readers(writer, "r1", "joint_states")
            publisher.publish(np.zeros(2), stamp=STAMP)
            until(lambda: 1 in seen)
