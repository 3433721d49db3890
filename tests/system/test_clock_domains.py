"""Clock domains are kept apart; steps of a clock are followed and logged."""

from __future__ import annotations

import logging
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import pytest
from helpers.processes import DEADLINE_S, until
from helpers.recording_builder import START, RecordingBuilder
from helpers.robots import RRBOT, wait_for_reader, wait_for_stream_readers

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.clock import ManualClock, SystemClock
from zstate.errors import ClockMismatch, InvalidInput
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.stamp_checks import StampCheck, likely_cause
from zstate.net.streams import KeyPublisher
from zstate.nodes.clock import ClockPublisher, SimulatedClock
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.static_publisher import StaticPublisher
from zstate.recording.player import Player
from zstate.transform import Transform
from zstate.wire.messages import JointState, RobotDescription, TransformSample, order_digest, to_block
from zstate.wire.native import encode, encoding_of

MS = 1_000_000
SECOND = 1_000_000_000
HOUR = 3_600 * SECOND
DAY = 24 * HOUR
NOW = 1_790_000_000 * SECOND
FOLLOW = pytest.mark.parametrize("follow", ["joint_states", "tf"])


def simulated(stamp: int = 5 * SECOND) -> ManualClock:
    return ManualClock(stamp, "sim")


def test_description_names_the_clock_domain(sessions):
    writer, _ = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as real,
        StatePublisher(writer, RRBOT, "r2", clock=simulated()) as virtual,
    ):
        assert (real.description().clock, virtual.description().clock) == ("system", "sim")


@FOLLOW
@pytest.mark.parametrize("given", ["system", "sim", None])
def test_robots_of_two_clocks_share_a_buffer_and_a_path_across_them_raises_clock_mismatch(
    sessions, follow, given
):
    writer, reader = sessions
    clock = None if given is None else ManualClock(NOW, given)
    with (
        StatePublisher(writer, RRBOT, "r2", clock=simulated()) as virtual,
        StatePublisher(writer, RRBOT, "r1", clock=ManualClock(NOW)) as real,
        StaticPublisher(writer, "cell") as cell,
        TransformListener(reader, follow=follow, clock=clock) as listener,
    ):
        buffer = listener.buffer
        for robot in ("r1", "r2"):
            cell.set(Transform("cell/map", f"{robot}/world", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]))
            wait_for_stream_readers(writer, robot, follow)
        domain_of = feed_of(buffer).domain.domain_of
        until(lambda: (domain_of("r1"), domain_of("r2")) == ("system", "sim"))
        for robot in (virtual, real):
            robot.publish([0.5, 0.5])
        assert buffer.wait("map", "r1/tool", timeout_s=DEADLINE_S).stamp == NOW
        assert buffer.wait("map", "r2/tool", timeout_s=DEADLINE_S).stamp == 5 * SECOND
        with pytest.raises(ClockMismatch) as caught:
            buffer.lookup("r1/tool", "r2/tool")
        assert listener.stats.refused == {}
    error = caught.value
    assert (error.robots, error.domains) == (("r1", "r2"), ("system", "sim"))
    assert [child for _, child in error.edges] == ["r1/upper", "r2/upper"]
    assert "of robot 'r1' is stamped in 'system' time, but" in str(error)
    assert "start both robots with one clock" in str(error)


def two_clocks() -> TransformBuffer:
    """A buffer with r1 on the system clock and r2 on a simulated one, joined by a static edge."""
    buffer = TransformBuffer()
    for robot, domain, stamp in (("r1", "system", NOW), ("r2", "sim", 5 * SECOND)):
        track = buffer.add_robot(RRBOT, robot)
        feed_of(buffer).set_domain(robot, domain)
        for number in range(2):
            buffer.insert_joints(track, stamp + number * MS, [0.5, 0.5])
    buffer.insert_static(Transform("r1/world", "r2/world", [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]))
    return buffer


@pytest.mark.parametrize(
    "ask",
    [
        lambda b: b.lookup("r1/tool", "r2/tool"),
        lambda b: b.lookup("r1/tool", "r2/tool", NOW),
        lambda b: b.lookup_many("r1/tool", "r2/tool", [NOW]),
        lambda b: b.place([[0, 0, 0]], NOW, "r2/tool", "r1/tool"),
        lambda b: b.lookup_between("r1/tool", NOW, "r2/tool", 5 * SECOND, "r1/world"),
        lambda b: b.twist("r1/tool", "r2/tool"),
        lambda b: b.plan("r1/tool", "r2/tool"),
        lambda b: b.latest("r1/tool", "r2/tool"),
        lambda b: b.wait("r1/tool", "r2/tool", timeout_s=0.01),
    ],
    ids=["newest", "lookup", "lookup_many", "place", "lookup_between", "twist", "plan", "latest", "wait"],
)
def test_every_lookup_across_two_clocks_is_refused(ask):
    buffer = two_clocks()
    with pytest.raises(ClockMismatch):
        ask(buffer)
    assert isinstance(buffer.explain("r1/tool", "r2/tool"), ClockMismatch)
    assert not buffer.can_lookup("r1/tool", "r2/tool")
    assert buffer.can_lookup("r1/tool", "r2/world", NOW)


@pytest.mark.parametrize(("given", "expected"), [(None, "sim"), ("system", "system")])
def test_path_domain_is_that_of_its_moving_edges(given, expected):
    buffer = two_clocks()
    for robot in ("r2", "r1"):
        feed_of(buffer).domain.join(robot)
    feed_of(buffer).domain.given = given
    start = {"sim": 5 * SECOND, "system": NOW}[expected]
    assert buffer.span() == (start, start + MS)


def test_cached_path_is_recompiled_after_a_domain_change():
    buffer = two_clocks()
    feed_of(buffer).set_domain("r2", "system")
    buffer.lookup_many("r1/tool", "r2/tool", [NOW])
    plan = buffer.plan("r1/tool", "r2/tool")
    feed_of(buffer).set_domain("r2", "sim")
    with pytest.raises(ClockMismatch):
        buffer.lookup_many("r1/tool", "r2/tool", [NOW])
    with pytest.raises(ClockMismatch):
        plan.at(NOW)


def test_wait_across_two_clocks_ends_when_one_robot_changes_its_clock():
    buffer = two_clocks()
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(buffer.wait, "r1/tool", "r2/tool", NOW, 10.0)
        until(lambda: len(buffer._waiters))
        feed_of(buffer).set_domain("r2", "system")
        buffer.insert_joints(feed_of(buffer).tree_snapshot().robots["r2"], NOW, [0.5, 0.5])
        assert waiting.result(10.0).stamp == NOW


def test_edges_placed_in_frames_of_another_robot_keep_the_clock_of_their_writer():
    buffer = TransformBuffer()
    feed_of(buffer).set_domain("fleet", "sim")
    feed_of(buffer).set_domain("r1", "system")
    feed_of(buffer).domain.assign("fleet", ["r1/odom"])
    turn = [0.0, 0.0, 0.0, 1.0]
    buffer.insert(Transform("fleet/map", "r1/odom", [0.0, 0.0, 0.0], turn, NOW))
    buffer.insert(Transform("r1/odom", "r1/base", [0.0, 0.0, 0.0], turn, NOW))
    with pytest.raises(ClockMismatch) as caught:
        buffer.lookup("fleet/map", "r1/base")
    assert caught.value.robots == ("fleet", "r1")


def test_default_domain_is_that_of_most_robots_with_samples(sessions):
    writer, reader = sessions
    names = {"v1": simulated(), "r1": ManualClock(NOW), "r2": ManualClock(NOW), "v2": simulated()}
    with ExitStack() as opened:
        robots = {
            name: opened.enter_context(StatePublisher(writer, RRBOT, name, clock=clock))
            for name, clock in names.items()
        }
        listener = opened.enter_context(TransformListener(reader))
        domain = feed_of(listener.buffer).domain
        for name in names:
            wait_for_stream_readers(writer, name)
            until(lambda name=name: domain.domain_of(name) is not None)
        assert domain.name is None
        for name, expected in (("v1", "sim"), ("r1", "sim"), ("r2", "system"), ("v2", "system")):
            before = listener.stats.received
            robots[name].publish([0.5, 0.5])
            until(lambda before=before: listener.stats.received > before)
            if name != "v2":
                assert domain.name == expected
        # A robot that has left does not count.
        robots["r1"].close()
        until(lambda: domain.name == "sim")
        assert domain.domain_of("r1") == "system"


def test_robot_may_change_its_clock(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", clock=ManualClock(NOW)) as listener:
        with StatePublisher(writer, RRBOT, "r1") as real:
            wait_for_stream_readers(writer, "r1")
            real.publish([0.5, 0.5])
            listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        with StatePublisher(writer, RRBOT, "r1", clock=simulated()) as virtual:
            wait_for_stream_readers(writer, "r1")
            virtual.publish([0.5, 0.5])
            until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "sim")
            until(lambda: listener.buffer.latest("world", "tool") == 5 * SECOND)
        assert listener.stats.refused == {}


@FOLLOW
def test_age_limit_of_another_clock_is_an_error_naming_both(sessions, follow):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1", clock=simulated()) as virtual,
        TransformListener(reader, "r1", follow=follow) as listener,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        virtual.publish([0.5, 0.5])
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "sim")
        for timeout_s in (0.0, 60.0):  # the given clock does not change, so waiting is no use
            with pytest.raises(ClockMismatch, match="max_age_s is measured by a clock of 'system'") as caught:
                listener.buffer.lookup("world", "tool", max_age_s=1.0, timeout_s=timeout_s)
        assert (caught.value.domains, caught.value.robots) == (("sim", "system"), ("r1",))
        assert not isinstance(caught.value, TimeoutError)
        feed_of(listener.buffer).use_clock(simulated(6 * SECOND))
        assert listener.buffer.lookup("world", "tool", max_age_s=1.0).stamp == 5 * SECOND


def test_buffer_refuses_a_listener_with_another_clock(sessions):
    buffer = TransformBuffer(clock=ManualClock(NOW))
    with pytest.raises(InvalidInput, match="given a clock of 'system' time, and now one of 'sim' time"):
        TransformListener(sessions[0], "r1", buffer, clock=simulated())


@FOLLOW
def test_sample_85_us_back_is_sorted_in_without_a_restart(sessions, caplog, follow):
    writer, reader = sessions
    clock = ManualClock(NOW)
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        StatePublisher(writer, RRBOT, "r1", clock=clock) as publisher,
        TransformListener(reader, "r1", follow=follow, clock=ManualClock(NOW)) as listener,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        stamps = [NOW, NOW + MS, NOW + MS - 85_000, NOW + MS - 85_000 + MS]
        for number, stamp in enumerate(stamps):
            clock.set(stamp)
            publisher.publish([0.1 * number, 0.0])
        until(lambda: listener.stats.received == 4)
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        for stamp in stamps:
            assert listener.buffer.lookup("world", "tool", stamp).kind == "exact"
        stats = listener.stats
        assert (stats.late, stats.refused, stats.off_clock) == (0, {}, 0)
    assert caplog.text == ""


@FOLLOW
def test_clock_an_hour_ahead_and_back_is_logged_and_followed_without_effect_on_other_robots(
    sessions, caplog, follow
):
    writer, reader = sessions
    clock = ManualClock(NOW)
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        StatePublisher(writer, RRBOT, "r1", clock=clock) as stepping,
        StatePublisher(writer, RRBOT, "r2", clock=ManualClock(NOW)) as steady,
        TransformListener(reader, follow=follow, clock=ManualClock(NOW)) as listener,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        wait_for_stream_readers(writer, "r2", follow)
        buffer = listener.buffer

        def publish(stamp: int) -> None:
            before = listener.stats
            clock.set(stamp)
            stepping.publish([0.5, 0.5])
            until(lambda: listener.stats.received + listener.stats.late > before.received + before.late)

        steady.publish([0.5, 0.5])
        until(lambda: listener.stats.received == 1)
        publish(NOW)
        until(lambda: feed_of(buffer).domain.domain_of("r1") == "system")
        buffer.wait("r1/world", "r1/tool", timeout_s=DEADLINE_S)
        publish(NOW + HOUR)
        publish(NOW + HOUR + MS)
        assert buffer.latest("r1/world", "r1/tool") == NOW + HOUR + MS
        assert buffer.can_lookup("r1/world", "r1/tool", NOW + HOUR)
        until(lambda: (listener.stats.off_clock, listener.stats.late) == (2, 0))
        publish(NOW + 2 * MS)
        assert buffer.latest("r1/world", "r1/tool") == NOW + HOUR + MS
        publish(NOW + 3 * MS)
        assert buffer.latest("r1/world", "r1/tool") == NOW + 3 * MS
        publish(NOW + 4 * MS)
        assert (listener.stats.off_clock, listener.stats.late) == (2, 1)
        assert buffer.latest("r2/world", "r2/tool") == NOW
    assert caplog.text.count("3600.0 s after this machine's time") == 1
    assert "whole hours: the writer takes its local time for UTC" in caplog.text
    assert caplog.text.count("the clock of 'r1' went back by 3600.0 s: its history") == 1
    assert "'r2'" not in caplog.text


@FOLLOW
def test_clock_set_back_by_less_than_the_history_starts_a_new_history_of_that_robot(sessions, caplog, follow):
    writer, reader = sessions
    clock = ManualClock(NOW - 10 * MS)
    with ExitStack() as opened:
        opened.enter_context(caplog.at_level(logging.WARNING, "zstate"))
        stepping = opened.enter_context(StatePublisher(writer, RRBOT, "r1", clock=clock))
        steady = opened.enter_context(StatePublisher(writer, RRBOT, "r2", clock=ManualClock(NOW)))
        stepping.publish([0.0, 0.0])
        listener = opened.enter_context(
            TransformListener(reader, follow=follow, clock=ManualClock(NOW), history_s=10.0)
        )
        buffer = listener.buffer
        wait_for_stream_readers(writer, "r1", follow)
        wait_for_stream_readers(writer, "r2", follow)
        until(lambda: listener.stats_of("r1").recalled == 1)  # the writer's history has arrived
        steady.publish([0.5, 0.5])
        for number, stamp in enumerate((0, 10, 20, 30, -5_000, -4_990, -4_980)):
            clock.set(NOW + stamp * MS)
            stepping.publish([0.1 * number, 0.0])
        until(lambda: listener.stats.received == 8)
        buffer.wait("r1/world", "r1/tool", timeout_s=DEADLINE_S)
        assert buffer.latest("r1/world", "r1/tool") == NOW - 4_980 * MS
        assert not buffer.can_lookup("r1/world", "r1/tool", NOW)
        assert buffer.can_lookup("r2/world", "r2/tool", NOW)
        until(lambda: [one.robot for one in listener.events() if one.kind == "set back"] == ["r1"])
        until(lambda: "the clock of 'r1' went back by 5.0 s: its history restarts" in caplog.text)
    assert caplog.text.count("the clock of 'r1' went back by 5.0 s: its history restarts") == 1
    assert "'r2'" not in caplog.text


def joint_ingest(history_s: float = 10.0) -> tuple[TransformBuffer, JointStateIngest]:
    buffer = TransformBuffer(history_s)
    ingest = JointStateIngest("r1", FrameOwnership(buffer, Counters()))
    ingest.describe(RobotDescription(1, RRBOT.urdf, RRBOT.digest, RRBOT.joint_names, ()))
    return buffer, ingest


def insert_samples(ingest: JointStateIngest, *samples: tuple[int, int]) -> None:
    """Inserts samples with these sequence numbers and stamps [ms after NOW]."""
    for seq, stamp in samples:
        order = order_digest(RRBOT.joint_names)
        ingest.insert_sample(
            JointState(NOW + stamp * MS, seq, 1, order, to_block([0.1, 0.2])), overflowed=False
        )


def test_reordered_samples_are_sorted_in():
    buffer, ingest = joint_ingest()
    insert_samples(ingest, (0, 0), (1, 1_000), (5, 5_000), (2, 2_000), (3, 3_000), (4, 4_000), (6, 6_000))
    for stamp in range(0, 7_000, 1_000):
        assert buffer.lookup("world", "tool", NOW + stamp * MS).kind == "exact"


def test_one_wrong_stamp_does_not_restart_a_history():
    buffer, ingest = joint_ingest()
    insert_samples(ingest, (0, 0), (1, 10), (2, -5_000), (3, 20), (4, 30))
    assert buffer.can_lookup("world", "tool", NOW)
    assert buffer.latest("world", "tool") == NOW + 30 * MS


def test_clock_set_back_is_detected_if_samples_are_lost_at_that_moment():
    buffer, ingest = joint_ingest()
    insert_samples(ingest, (0, 0), (1, 10), (9, -5_000), (10, -4_990))
    assert buffer.latest("world", "tool") == NOW - 4_990 * MS
    assert not buffer.can_lookup("world", "tool", NOW)


@FOLLOW
def test_restarted_simulation_is_a_new_epoch_at_its_second_sample(sessions, follow):
    writer, reader = sessions
    clock = simulated(0)
    with (
        StatePublisher(writer, RRBOT, "r1", clock=clock) as publisher,
        TransformListener(reader, "r1", follow=follow, history_on_join=False) as listener,
    ):
        wait_for_stream_readers(writer, "r1", follow)
        # Eight seconds, less than the history, then a restart.
        for stamp in (0, 4 * SECOND, 8 * SECOND, 0, 10 * MS):
            clock.set(stamp)
            publisher.publish([0.5, 0.5])
        until(lambda: listener.stats.received == 5)
        listener.buffer.wait("world", "tool", timeout_s=DEADLINE_S)
        assert listener.buffer.latest("world", "tool") == 10 * MS
        assert not listener.buffer.can_lookup("world", "tool", 4 * SECOND)


def test_stamps_far_off_are_used_counted_and_logged_once_per_program(sessions, caplog):
    writer, reader = sessions
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        TransformListener(reader, "r1") as listener,
    ):
        for start in (1, 2):
            with StatePublisher(writer, RRBOT, "r1", program="driver") as publisher:
                # The listener has the description, which has the clock, and the name of this writer.
                until(lambda: any("driver@" in (one.writer or "") for one in listener.buffer.frames()))
                session = publisher.description().session
                until(lambda session=session: ("r1", session) in listener._reader.ingests.writers)
                wait_for_stream_readers(writer, "r1")
                for number in range(5):
                    publisher.publish([0.5, 0.5], stamp=(time.time_ns() + number) // SECOND)
                until(lambda start=start: listener.stats.off_clock == 5 * start)
        assert listener.stats.received == 10
        assert listener.stats.late == 0
    assert caplog.text.count("the writer gives seconds where nanoseconds are meant") == 1
    assert "samples of 'r1', which driver@" in caplog.text


def test_writer_restarting_with_each_sample_is_logged_once(caplog):
    buffer, counters = TransformBuffer(clock=ManualClock(NOW)), Counters()
    feed_of(buffer).set_domain("r1", "system")
    off_clock = StampCheck(buffer, counters, is_described=True)
    with caplog.at_level(logging.WARNING, "zstate"):
        for session in range(100):
            off_clock.check("r1", f"driver@host pid {session}", JointState(5, 0, session, b"", b""))
    assert counters.stats().off_clock == 100
    assert len(caplog.records) == 1


def test_stamp_check_threshold_is_one_minute(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", clock=ManualClock(NOW)) as listener,
    ):
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        wait_for_stream_readers(writer, "r1")
        for stamp in (NOW - 60 * SECOND, NOW + 60 * SECOND):
            publisher.publish([0.5, 0.5], stamp=stamp)
        until(lambda: listener.stats.received + listener.stats.late == 2)
        assert listener.stats.off_clock == 0
        for stamp in (NOW - 60 * SECOND - 1, NOW + 60 * SECOND + 1):
            publisher.publish([0.5, 0.5], stamp=stamp)
        until(lambda: listener.stats.off_clock == 2)


def test_stamps_of_transforms_are_checked_without_a_description(sessions):
    writer, reader = sessions
    edges = (("base", "hand"),)
    pose = to_block([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    with (
        KeyPublisher(writer, "zstate/r1/tf", encoding_of(TransformSample)) as publisher,
        TransformListener(reader, "r1", follow="tf") as listener,
    ):
        until(lambda: publisher.has_readers)
        publisher.put(encode(TransformSample(5, 0, 9, order_digest(edges), pose, edges)))
        until(lambda: listener.stats.off_clock == 1)
        assert listener.buffer.lookup("base", "hand").stamp == 5


def test_simulated_time_is_never_far_off(sessions):
    writer, reader = sessions
    with (
        ClockPublisher(writer) as clock_publisher,
        SimulatedClock(reader) as clock,
        StatePublisher(writer, RRBOT, "r1", clock=simulated()) as publisher,
        TransformListener(reader, "r1", clock=clock) as listener,
    ):
        wait_for_reader(writer, "zstate/clock")
        wait_for_stream_readers(writer, "r1")
        clock_publisher.publish(HOUR)
        publisher.publish([0.5, 0.5])
        until(lambda: listener.stats.received == 1)
        assert listener.stats.off_clock == 0


def test_replay_has_its_own_clock_domain(sessions, tmp_path):
    writer, reader = sessions
    with RecordingBuilder(tmp_path / "run.mcap", "arm") as builder:
        builder.describe("arm")
        for number in range(10):
            builder.joints("arm", START + number * 10 * MS, [0.1 * number, 0.0])
        builder.edges("cart", START + 20 * MS, {("floor", "cart"): [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]})
    with (
        StatePublisher(writer, RRBOT, "r1"),
        TransformListener(reader, "*", clock=SystemClock()) as listener,
        Player(writer, tmp_path / "run.mcap", rate=0.5) as replayer,
    ):
        until(lambda: feed_of(listener.buffer).domain.domain_of("r1") == "system")
        replayer.run()
        until(lambda: feed_of(listener.buffer).domain.domain_of("arm") == "sim")
        assert listener.buffer.can_lookup("arm/world", "arm/tool")


@pytest.mark.parametrize(
    ("stamp", "cause"),
    [
        (NOW // SECOND, "gives seconds where nanoseconds"),
        (NOW // MS, "gives milliseconds where nanoseconds"),
        (NOW // 1_000, "gives microseconds where nanoseconds"),
        (0, "1970"),
        (300 * DAY, "1970"),
        (NOW - 2 * HOUR, "whole hours"),
        (NOW + 5 * HOUR + HOUR // 2 - SECOND, "whole hours"),
        (NOW - 37 * DAY, "never set"),
        (NOW + 700 * SECOND, "never set"),
    ],
)
def test_likely_cause_depends_on_the_size_of_the_offset(stamp, cause):
    assert cause in likely_cause(stamp, NOW)
