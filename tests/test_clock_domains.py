"""Two times that say nothing of each other are kept apart; steps of a clock are followed, and named."""

from __future__ import annotations

import logging
import time

import pytest
from live import RRBOT, await_reader, settle
from support import until
from tales import START, Tale

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.domain import Domain
from zstate.clock import ManualClock, SystemClock
from zstate.clock_publisher import ClockPublisher
from zstate.errors import ClockMismatch
from zstate.following.off_clock import likely_cause
from zstate.listener import TransformListener
from zstate.net.streams import StreamPublisher
from zstate.publisher import StatePublisher
from zstate.replayer import Replayer
from zstate.simulated_clock import SimulatedClock
from zstate.wire.messages import TransformSample, order_digest, to_block
from zstate.wire.native import ENCODINGS, encode

MS = 1_000_000
SECOND = 1_000_000_000
HOUR = 3_600 * SECOND
DAY = 24 * HOUR
NOW = 1_790_000_000 * SECOND
FOLLOW = pytest.mark.parametrize("follow", ["joint_states", "tf"])


def simulated(stamp: int = 5 * SECOND) -> ManualClock:
    return ManualClock(stamp, "sim")


def test_a_description_tells_whose_time_a_robot_keeps(sessions):
    writer, _ = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as real,
        StatePublisher(writer, RRBOT, "r2", clock=simulated()) as virtual,
    ):
        assert (real.description().clock, virtual.description().clock) == ("system", "sim")


@FOLLOW
@pytest.mark.parametrize("given", [True, False], ids=["by its clock", "by the first robot"])
def test_a_robot_of_another_time_is_refused_with_both_names(sessions, caplog, follow, given):
    writer, reader = sessions
    clock = ManualClock(NOW) if given else None
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        StatePublisher(writer, RRBOT, "r1", clock=ManualClock(NOW)) as real,
        TransformListener(reader, follow=follow, clock=clock) as listener,
    ):
        until(lambda: listener.buffer.domain.of("r1") == "system")
        settle(writer, "r1", follow)
        real.publish([0.5, 0.5])
        listener.buffer.wait("r1/world", "r1/tool", timeout_s=5.0)
        with StatePublisher(writer, RRBOT, "r2", clock=simulated()) as virtual:
            until(lambda: listener.stats.refused.get("clock domain"))
            described = listener.stats.refused["clock domain"]
            settle(writer, "r2", follow)
            for _ in range(3):
                virtual.publish([0.5, 0.5])
            until(lambda: listener.stats.refused["clock domain"] == described + 3)
        assert listener.stats.received == 1
        assert not listener.buffer.can_lookup("r2/world", "r2/tool")
        assert listener.buffer.can_lookup("r1/world", "r1/tool")
    assert "'r2' keeps 'sim' time, but " in caplog.text
    assert ("the clock here tells 'system' time" if given else "'r1', which is in the same") in caplog.text
    assert caplog.text.count("clock domain") == 1


def test_two_listeners_that_fill_one_buffer_keep_one_time(sessions):
    writer, reader = sessions
    buffer = TransformBuffer()
    with (
        StatePublisher(writer, RRBOT, "r1", clock=simulated()),
        TransformListener(reader, "r1", buffer),
        TransformListener(reader, "r2", buffer) as second,
    ):
        until(lambda: buffer.domain.name == "sim")
        with StatePublisher(writer, RRBOT, "r2"):
            until(lambda: second.stats.refused == {"clock domain": 1})


def test_a_robot_that_is_alone_may_change_its_time(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1") as listener:
        with StatePublisher(writer, RRBOT, "r1") as real:
            settle(writer, "r1")
            real.publish([0.5, 0.5])
            listener.buffer.wait("world", "tool", timeout_s=5.0)
        with StatePublisher(writer, RRBOT, "r1", clock=simulated()) as virtual:
            until(lambda: listener.buffer.domain.name == "sim")
            settle(writer, "r1")
            virtual.publish([0.5, 0.5])
            until(lambda: listener.buffer.latest("world", "tool") == 5 * SECOND)
        assert listener.stats.refused == {}


def test_a_robot_that_comes_back_with_the_right_time_is_followed(sessions):
    writer, reader = sessions
    with TransformListener(reader, "r1", clock=ManualClock(NOW)) as listener:
        with StatePublisher(writer, RRBOT, "r1", clock=simulated()):
            until(lambda: listener.stats.refused == {"clock domain": 1})
        with StatePublisher(writer, RRBOT, "r1", clock=ManualClock(NOW)) as real:
            until(lambda: listener.buffer.domain.of("r1") == "system")
            settle(writer, "r1")
            real.publish([0.5, 0.5])
            assert listener.buffer.wait("world", "tool", timeout_s=5.0).stamp == NOW


def test_an_age_by_another_time_is_an_error_with_both_names(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1", clock=simulated()) as virtual,
        TransformListener(reader, "r1") as listener,
    ):
        settle(writer, "r1")
        virtual.publish([0.5, 0.5])
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        until(lambda: listener.buffer.domain.name == "sim")
        with pytest.raises(ClockMismatch, match="'sim' time and the clock tells 'system' time") as caught:
            listener.buffer.lookup("world", "tool", max_age_s=1.0)
        assert caught.value.domains == ("sim", "system")
        listener.buffer.use_clock(simulated(6 * SECOND))
        assert listener.buffer.lookup("world", "tool", max_age_s=1.0).stamp == 5 * SECOND


def test_a_buffer_of_one_time_takes_no_listener_of_another(sessions):
    buffer = TransformBuffer(clock=ManualClock(NOW))
    with pytest.raises(ClockMismatch, match="give the buffer, or the listener, a clock of 'system' time"):
        TransformListener(sessions[0], "r1", buffer, clock=simulated())


@FOLLOW
def test_85_us_back_are_a_sorted_sample_and_nothing_else(sessions, caplog, follow):
    writer, reader = sessions
    clock = ManualClock(NOW)
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        StatePublisher(writer, RRBOT, "r1", clock=clock) as publisher,
        TransformListener(reader, "r1", follow=follow, clock=ManualClock(NOW)) as listener,
    ):
        settle(writer, "r1", follow)
        stamps = [NOW, NOW + MS, NOW + MS - 85_000, NOW + MS - 85_000 + MS]
        for number, stamp in enumerate(stamps):
            clock.set(stamp)
            publisher.publish([0.1 * number, 0.0])
        until(lambda: listener.stats.received == 4)
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        for stamp in stamps:
            assert listener.buffer.lookup("world", "tool", stamp).kind == "exact"
        stats = listener.stats
        assert (stats.late, stats.refused, stats.off_clock) == (0, {}, 0)
    assert caplog.text == ""


@FOLLOW
def test_an_hour_ahead_and_back_is_named_and_followed_and_touches_no_other_robot(sessions, caplog, follow):
    writer, reader = sessions
    clock = ManualClock(NOW)
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        StatePublisher(writer, RRBOT, "r1", clock=clock) as stepping,
        StatePublisher(writer, RRBOT, "r2", clock=ManualClock(NOW)) as steady,
        TransformListener(reader, follow=follow, clock=ManualClock(NOW)) as listener,
    ):
        settle(writer, "r1", follow)
        settle(writer, "r2", follow)
        buffer = listener.buffer

        def publish(stamp: int) -> None:
            before = listener.stats
            clock.set(stamp)
            stepping.publish([0.5, 0.5])
            until(lambda: listener.stats.received + listener.stats.late > before.received + before.late)

        steady.publish([0.5, 0.5])
        until(lambda: listener.stats.received == 1)
        publish(NOW)
        until(lambda: buffer.domain.of("r1") == "system")
        buffer.wait("r1/world", "r1/tool", timeout_s=5.0)
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
def test_a_simulation_that_begins_again_soon_is_a_new_epoch_at_its_second_sample(sessions, follow):
    writer, reader = sessions
    clock = simulated(0)
    with (
        StatePublisher(writer, RRBOT, "r1", clock=clock) as publisher,
        TransformListener(reader, "r1", follow=follow, history_s=10.0) as listener,
    ):
        until(lambda: listener.buffer.domain.name == "sim")
        settle(writer, "r1", follow)
        # Eight seconds, well inside of the history, then the start again.
        for stamp in (0, 4 * SECOND, 8 * SECOND, 0, 10 * MS):
            clock.set(stamp)
            publisher.publish([0.5, 0.5])
        until(lambda: listener.stats.received == 5)
        listener.buffer.wait("world", "tool", timeout_s=5.0)
        assert listener.buffer.latest("world", "tool") == 10 * MS
        assert not listener.buffer.can_lookup("world", "tool", 4 * SECOND)


def test_stamps_far_off_are_used_counted_and_named_once_for_each_writer(sessions, caplog):
    writer, reader = sessions
    with (
        caplog.at_level(logging.WARNING, "zstate"),
        TransformListener(reader, "r1") as listener,
    ):
        for start in (1, 2):
            with StatePublisher(writer, RRBOT, "r1", program="driver") as publisher:
                # Its model, and so whose time it keeps, and its name.
                until(lambda: any("driver@" in (one.writer or "") for one in listener.buffer.frames()))
                settle(writer, "r1")
                for number in range(5):
                    publisher.publish([0.5, 0.5], stamp=(time.time_ns() + number) // SECOND)
                until(lambda start=start: listener.stats.off_clock == 5 * start)
        assert listener.stats.received == 10
        assert listener.stats.late == 0
    assert caplog.text.count("the writer gives seconds where nanoseconds are meant") == 2
    assert "samples of 'r1', which driver@" in caplog.text


def test_a_minute_off_is_not_far_and_a_little_more_is(sessions):
    writer, reader = sessions
    with (
        StatePublisher(writer, RRBOT, "r1") as publisher,
        TransformListener(reader, "r1", clock=ManualClock(NOW)) as listener,
    ):
        until(lambda: listener.buffer.domain.of("r1") == "system")
        settle(writer, "r1")
        for stamp in (NOW - 60 * SECOND, NOW + 60 * SECOND):
            publisher.publish([0.5, 0.5], stamp=stamp)
        until(lambda: listener.stats.received + listener.stats.late == 2)
        assert listener.stats.off_clock == 0
        for stamp in (NOW - 60 * SECOND - 1, NOW + 60 * SECOND + 1):
            publisher.publish([0.5, 0.5], stamp=stamp)
        until(lambda: listener.stats.off_clock == 2)


def test_of_a_robot_that_is_never_described_named_transforms_are_looked_at_too(sessions):
    writer, reader = sessions
    edges = (("base", "hand"),)
    pose = to_block([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    with (
        StreamPublisher(writer, "zstate/r1/tf", ENCODINGS[TransformSample]) as stranger,
        TransformListener(reader, "r1", follow="tf") as listener,
    ):
        until(lambda: stranger.has_readers)
        stranger.put(encode(TransformSample(5, 0, 9, order_digest(edges), pose, edges)))
        until(lambda: listener.stats.off_clock == 1)
        assert listener.buffer.lookup("base", "hand").stamp == 5


def test_simulated_time_is_never_far_off(sessions):
    writer, reader = sessions
    with (
        ClockPublisher(writer) as told,
        SimulatedClock(reader) as clock,
        StatePublisher(writer, RRBOT, "r1", clock=simulated()) as publisher,
        TransformListener(reader, "r1", clock=clock) as listener,
    ):
        await_reader(writer, "zstate/clock")
        settle(writer, "r1")
        told.publish(HOUR)
        publisher.publish([0.5, 0.5])
        until(lambda: listener.stats.received == 1)
        assert listener.stats.off_clock == 0


def test_a_replay_keeps_a_time_of_its_own(sessions, tmp_path):
    writer, reader = sessions
    with Tale(tmp_path / "run.mcap", "arm") as tale:
        tale.describe("arm")
        for number in range(10):
            tale.joints("arm", START + number * 10 * MS, [0.1 * number, 0.0])
        tale.edges("cart", START + 20 * MS, {("floor", "cart"): [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]})
    with (
        StatePublisher(writer, RRBOT, "r1"),
        TransformListener(reader, "*", clock=SystemClock()) as real,
        TransformListener(reader, "arm") as replayed,
        Replayer(writer, tmp_path / "run.mcap", rate=0.5) as replayer,
    ):
        until(lambda: real.buffer.domain.of("r1") == "system")
        replayer.run()
        until(lambda: "clock domain" in real.stats.refused)
        until(lambda: replayed.buffer.domain.name == "sim")
        assert not real.buffer.can_lookup("arm/world", "arm/tool")


def test_whose_time_it_is_may_stay_open():
    domain = Domain()
    assert domain.objection("ros", "") == ""
    assert (domain.name, domain.of("ros"), domain.of("nobody")) == (None, "", None)
    assert domain.objection("r1", "sim") == ""
    assert domain.objection("ros", "") == ""
    assert domain.objection("r2", "system").startswith(
        "'r2' keeps 'system' time, but 'r1', which is in the same buffer, keeps 'sim' time"
    )
    assert (domain.name, domain.of("r2")) == ("sim", None)


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
def test_the_likely_cause_is_told_by_the_size(stamp, cause):
    assert cause in likely_cause(stamp, NOW)
