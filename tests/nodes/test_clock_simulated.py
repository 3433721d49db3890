"""Simulated time: published on the network, followed by waiting clocks."""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Callable

import pytest
from helpers.processes import until
from helpers.robots import wait_for_reader

from zstate._util.bounded import MAX_ENTRIES
from zstate.clock import MONOTONIC, ManualClock
from zstate.errors import Closed, NoClock
from zstate.model.load import load_model
from zstate.net.streams import KeyPublisher
from zstate.nodes.clock import ClockPublisher, SimulatedClock
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.rate import Rate
from zstate.sources import SineSource

MS = 1_000_000
SECOND = 1_000_000_000
RRBOT = load_model("rrbot")


class Waiting:
    """A thread that waits for an instant."""

    def __init__(self, clock: SimulatedClock, stamp: int) -> None:
        self.stop = threading.Event()
        self.reached: bool | None = None
        waits = len(clock._waits)
        self._thread = threading.Thread(target=self._wait, args=(clock, stamp), daemon=True)
        self._thread.start()
        until(lambda: len(clock._waits) != waits or self.is_over)

    def _wait(self, clock: SimulatedClock, stamp: int) -> None:
        self.reached = clock.wait_until(stamp, self.stop)

    @property
    def is_over(self) -> bool:
        return not self._thread.is_alive()


def publishing(publisher: ClockPublisher, clock: SimulatedClock) -> Callable[[int], None]:
    """``publish_time(stamp)`` returns once ``clock`` has received it."""

    def publish_time(stamp: int) -> None:
        publisher.publish(stamp)
        until(lambda: clock.wait() == stamp)

    return publish_time


@pytest.mark.parametrize(
    ("wire", "key"),
    [
        ("native", "zstate/clock"),
        ("ros2:domain=7", "7/clock/rosgraph_msgs::msg::dds_::Clock_/any"),
        ("ros2dds", "clock"),
    ],
)
def test_now_is_the_newest_received_time(sessions, wire, key):
    writer, reader = sessions
    with ClockPublisher(writer, (wire,)) as publisher, SimulatedClock(reader, wire) as clock:
        wait_for_reader(writer, key)
        publish_time = publishing(publisher, clock)
        for stamp in (5 * SECOND, 5 * SECOND + 1, 3600 * SECOND):
            publish_time(stamp)
            assert clock.now() == stamp
        assert clock.domain == "sim"


def test_missing_time_raises_no_clock_after_the_timeout(sessions):
    with (
        SimulatedClock(sessions[1], timeout_s=0.05) as clock,
        pytest.raises(NoClock, match=r"no time was received on 'zstate/clock' for 0\.05 s") as caught,
    ):
        clock.now()
    assert isinstance(caught.value, TimeoutError)
    assert caught.value.waited_s == 0.05


def test_first_time_ends_the_wait(sessions):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        threading.Timer(0.02, publisher.publish, (7,)).start()
        assert clock.now() == 7


def test_wait_ends_at_its_instant_and_not_while_the_clock_is_paused(sessions):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publish_time = publishing(publisher, clock)
        publish_time(SECOND)
        early, late = Waiting(clock, 2 * SECOND), Waiting(clock, 3 * SECOND)
        for _ in range(3):
            publish_time(SECOND)
        assert early.reached is late.reached is None
        publish_time(2 * SECOND)
        until(lambda: early.reached)
        assert late.reached is None
        publish_time(3600 * SECOND)
        until(lambda: late.reached)
        assert clock.wait_until(5, threading.Event())


def test_wait_ends_at_once_when_stopped_or_the_clock_is_closed(sessions):
    with SimulatedClock(sessions[1]) as clock:
        stopped, left = Waiting(clock, SECOND), Waiting(clock, SECOND)
        stopped.stop.set()
        until(lambda: stopped.is_over)
        assert stopped.reached is False
        assert left.reached is None
        clock.close()
        until(lambda: left.is_over)
        assert left.reached is False
    assert not clock.wait_until(0, threading.Event())
    with pytest.raises(Closed, match="closed before it received a time"):
        clock.now()


def test_closed_clock_does_not_return_the_time_at_which_it_was_closed(sessions):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publishing(publisher, clock)(5 * SECOND)
        child = os.fork()
        if child == 0:
            try:
                clock.now()
            except Closed as error:
                os._exit(0 if "open one in this process" in str(error) else 1)
            os._exit(2)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
        assert clock.now() == 5 * SECOND
        clock.close()
        for read in (clock.now, clock.wait):
            with pytest.raises(Closed, match="closed after it received 5000000000 ns"):
                read()


def test_sessions_of_earlier_publishers_are_bounded(sessions):
    """A program that may write the clock may send any number of sessions."""
    with SimulatedClock(sessions[1]) as clock:
        for number in range(2 * MAX_ENTRIES):
            assert clock._follows(number)
        assert len(clock._ended_sessions) == MAX_ENTRIES
        assert not clock._follows(2 * MAX_ENTRIES - 2)


def test_jump_back_ends_waits_and_is_logged_once(sessions, caplog):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publish_time = publishing(publisher, clock)
        with caplog.at_level(logging.WARNING, "zstate"):
            publish_time(100 * SECOND)
            waiting = Waiting(clock, 101 * SECOND)
            publish_time(100 * SECOND - 60 * MS)
            assert (waiting.reached, clock.epoch) == (None, 0)
            publish_time(10 * SECOND + 40 * MS)
            until(lambda: waiting.reached)
            publish_time(20 * SECOND)
            publish_time(10 * SECOND)
        assert clock.epoch == 2
    # From 99.94 s to 10.04 s.
    assert caplog.text.count("went back") == 1
    assert "'zstate/clock' went back by 89.9 s" in caplog.text


def test_time_that_goes_back_by_more_than_a_tenth_of_a_second_ends_waits_and_by_less_does_not(sessions):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publish_time = publishing(publisher, clock)
        publish_time(100 * SECOND)
        waiting = Waiting(clock, 101 * SECOND)
        publish_time(100 * SECOND - 100 * MS)
        assert (waiting.reached, clock.epoch) == (None, 0)
        publish_time(100 * SECOND)
        publish_time(100 * SECOND - 100 * MS - 1)
        until(lambda: waiting.reached)
        assert clock.epoch == 1


def test_newer_of_two_clock_publishers_is_followed(sessions):
    writer, reader = sessions
    with (
        ClockPublisher(writer) as first,
        ClockPublisher(writer) as second,
        SimulatedClock(reader) as clock,
    ):
        wait_for_reader(writer, "zstate/clock")
        publishing(first, clock)(SECOND)
        publishing(second, clock)(50 * SECOND)
        first.publish(2 * SECOND)
        first.publish(3 * SECOND)
        until(lambda: clock.refused == {"second clock": 2})
        assert clock.now() == 50 * SECOND


def test_older_clock_publisher_is_followed_after_two_seconds_without_the_newer_one(sessions):
    with SimulatedClock(sessions[1]) as clock:
        clock._real_time = real_time = ManualClock(domain=MONOTONIC)
        assert clock._follows(1)
        assert clock._follows(2)
        real_time.set(2 * SECOND - 1)
        assert not clock._follows(1)
        real_time.set(2 * SECOND)
        assert clock._follows(1)


def test_invalid_clock_message_is_counted_and_changes_nothing(sessions):
    writer, reader = sessions
    with (
        ClockPublisher(writer) as publisher,
        KeyPublisher(writer, "zstate/clock", "text/plain") as stranger,
        SimulatedClock(reader) as clock,
    ):
        wait_for_reader(writer, "zstate/clock")
        publishing(publisher, clock)(SECOND)
        stranger.put(b"noon")
        until(lambda: clock.refused == {"foreign": 1})
        assert clock.now() == SECOND


@pytest.mark.parametrize("speed", [0.5, 1.0, 10.0])
def test_rate_has_its_number_of_ticks_per_simulated_second_at_any_speed(sessions, speed):
    """The time is published a hundred times per real second, so one step is ``speed`` times 10 ms."""
    writer, reader = sessions
    step, start, seconds, rate_hz = round(speed * 10 * MS), 5 * SECOND, 2, 250.0
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publish_time = publishing(publisher, clock)
        publish_time(start)
        ticks: list[int] = []
        rate = Rate(rate_hz, clock, threading.Event(), float(seconds))
        counting = threading.Thread(target=lambda: ticks.extend(rate), daemon=True)
        counting.start()
        for stamp in range(start, start + seconds * SECOND + 1, step):
            publisher.publish(stamp)
            # No machine is so slow that a simulation is half a second ahead of it.
            until(lambda stamp=stamp: ticks and ticks[-1] > stamp - SECOND // 2)
        counting.join(10.0)
    assert ticks == [start + round(tick * SECOND / rate_hz) for tick in range(round(seconds * rate_hz))]
    assert rate.report().skipped == 0
    assert rate.report().rate_hz == pytest.approx(rate_hz, rel=1e-9)


def test_rate_follows_a_time_that_goes_back_during_a_wait(sessions):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publish_time = publishing(publisher, clock)
        publish_time(100 * SECOND)
        ticks: list[int] = []
        counting = threading.Thread(
            target=lambda: ticks.extend(Rate(10.0, clock, threading.Event(), 0.5)), daemon=True
        )
        counting.start()
        until(lambda: len(ticks) == 1 and clock._waits)
        publish_time(40 * SECOND)
        until(lambda: len(ticks) == 2)
        publish_time(40 * SECOND + 300 * MS)
        counting.join(10.0)
    assert ticks == [100 * SECOND, *(40 * SECOND + n * 100 * MS for n in range(4))]


def test_jump_ahead_causes_no_burst(sessions):
    writer, reader = sessions
    with ClockPublisher(writer) as publisher, SimulatedClock(reader) as clock:
        wait_for_reader(writer, "zstate/clock")
        publish_time = publishing(publisher, clock)
        publish_time(0)
        ticks: list[int] = []
        rate = Rate(10.0, clock, threading.Event(), 60.0)
        counting = threading.Thread(target=lambda: ticks.extend(rate), daemon=True)
        counting.start()
        until(lambda: len(ticks) == 1)
        publish_time(59 * SECOND + 900 * MS)
        counting.join(10.0)
    assert ticks == [0, 59 * SECOND + 900 * MS]
    assert rate.report().skipped == 600 - 2


def test_publisher_and_a_listener_on_simulated_time_agree(sessions):
    writer, reader = sessions
    with (
        ClockPublisher(writer) as publisher,
        SimulatedClock(writer) as writer_clock,
        SimulatedClock(reader) as reader_clock,
        StatePublisher(writer, RRBOT, "r1", clock=writer_clock) as robot,
        TransformListener(reader, "r1", clock=reader_clock) as listener,
    ):
        assert robot.description().clock == "sim"
        wait_for_reader(writer, "zstate/clock")
        wait_for_reader(writer, "zstate/r1/joint_states")
        publish_time = publishing(publisher, writer_clock)
        publish_time(SECOND)
        running = threading.Thread(
            target=lambda: robot.run(SineSource(RRBOT), 100.0, seconds=1.0), daemon=True
        )
        running.start()
        until(lambda: robot.stats.sent)  # at the newest published instant
        for n in range(1, 101):
            publish_time(SECOND + n * 10 * MS)
        running.join(10.0)
        until(lambda: listener.stats.received == 100)
        assert listener.buffer.latest("world", "tool") == SECOND + 990 * MS
        # Ten milliseconds old by the simulated time, independent of the system clock.
        until(lambda: reader_clock.now() == 2 * SECOND)
        assert listener.buffer.lookup("world", "tool", max_age_s=0.5).stamp == SECOND + 990 * MS
        assert (listener.stats.refused, listener.stats.off_clock) == ({}, 0)
