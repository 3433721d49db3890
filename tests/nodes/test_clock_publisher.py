"""Simulated time on the network."""

from __future__ import annotations

import pytest
from helpers.robots import SampleCollector, wait_for_reader

from zstate.errors import Closed, InvalidInput
from zstate.nodes.clock import ClockPublisher
from zstate.wire.messages import ClockMessage
from zstate.wire.native import decode, encoding_of
from zstate.wire.ros2.cdr import decode_clock

ROS = "ros2:domain=7,namespace=*,frame_prefix=*/"


def test_time_is_published_on_both_wires(sessions):
    writer, reader = sessions
    native, ros = SampleCollector(reader, "zstate/clock"), SampleCollector(reader, "7/clock/**")
    with ClockPublisher(writer, ("native", ROS)) as clock:
        wait_for_reader(writer, "zstate/clock")
        wait_for_reader(writer, "7/clock/x/y")
        for stamp in (0, 5, 1_700_000_000_000_000_001):
            clock.publish(stamp)
        received = [
            decode(payload, encoding_of(ClockMessage), ClockMessage) for payload in native.payloads(3)
        ]
        assert [clock.stamp for clock in received] == [0, 5, 1_700_000_000_000_000_001]
        assert [clock.seq for clock in received] == [0, 1, 2]
        assert len({clock.session for clock in received}) == 1
        assert [decode_clock(payload) for payload in ros.payloads(3)] == [clock.stamp for clock in received]


def test_new_clock_publisher_has_a_new_session(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/clock")
    wait_for_reader(writer, "zstate/clock")
    for _ in range(2):
        with ClockPublisher(writer) as clock:
            clock.publish(1)
    received = [decode(payload, encoding_of(ClockMessage), ClockMessage) for payload in tap.payloads(2)]
    assert received[0].session != received[1].session


def test_invalid_time_is_refused_and_not_counted(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, "zstate/clock")
    with ClockPublisher(writer, ("native", ROS)) as clock:
        wait_for_reader(writer, "zstate/clock")
        for wrong in (0.5, 2**62):
            with pytest.raises(InvalidInput):
                clock.publish(wrong)
        clock.publish(3)
        (received,) = (
            decode(payload, encoding_of(ClockMessage), ClockMessage) for payload in tap.payloads(1)
        )
        assert (received.stamp, received.seq) == (3, 0)


def test_closed_clock_publisher_raises_closed(sessions):
    clock = ClockPublisher(sessions[0])
    clock.close()
    clock.close()
    with pytest.raises(Closed):
        clock.publish(1)
