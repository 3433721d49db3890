"""The usual sample in one call of the extension: same bytes, counts, refusals and order as the slow way."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from helpers.processes import until
from helpers.robots import RRBOT, STAMP, SampleCollector, wait_for_reader

from zstate.clock import ManualClock, SystemClock
from zstate.errors import Closed, InvalidInput
from zstate.extension import kernel
from zstate.model.load import load_model
from zstate.net.session import connect
from zstate.nodes.publisher import StatePublisher
from zstate.wire.messages import JointState, order_digest
from zstate.wire.native import encode
from zstate.wire.ros2.graph import unpack_attachment

JOINTS, TF = "zstate/r1/joint_states", "zstate/r1/tf"
POSITIONS, RATES = np.array([0.1 + 0.2, -1.0 / 3.0]), np.array([5e-324, 1.5])
SLOW = dict(zip(RRBOT.joint_names, POSITIONS.tolist(), strict=True))
"""The same positions, which the extension leaves to the slow way."""
LIFT = load_model(
    '<robot name="arm"><link name="base"/><link name="tip"/>'
    '<joint name="lift" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>'
    '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>'
)

pytestmark = pytest.mark.skipif(kernel != "c", reason=f"runs on the reference: {kernel.reason}")


def is_ready(publisher: StatePublisher) -> bool:
    return publisher._publish_path is not None and publisher._publish_path.ready


def open_publisher(session: Any, model: Any = RRBOT, **options: Any) -> StatePublisher:
    """A publisher whose next samples are usual ones: without a claim, which is checked for a second."""
    publisher = StatePublisher(session, model, "r1", takeover=True, **options)
    publisher.publish([0.0] * model.position_count, stamp=STAMP)
    assert is_ready(publisher)
    return publisher


def payloads_until(tap: SampleCollector, last: bytes) -> list[bytes]:
    """The last three payloads, once ``last`` is one; the one of opening may arrive before them."""
    until(lambda: last in tap.payloads(0))
    return tap.payloads(0)[-3:]


@pytest.mark.parametrize("rates", [(None, None), (RATES, None), (None, RATES), (RATES, -RATES)])
def test_payloads_numbers_cache_and_counts_are_those_of_the_slow_way(sessions, rates: Any):
    writer, reader = sessions
    with open_publisher(writer) as publisher:
        tap = SampleCollector(reader, JOINTS)
        wait_for_reader(writer, JOINTS)
        publisher.publish(POSITIONS, *rates, stamp=STAMP + 1)
        publisher.publish(SLOW, *rates, stamp=STAMP + 2)
        publisher.publish(POSITIONS, *rates, stamp=STAMP + 3)
        digest, session = order_digest(RRBOT.joint_names), publisher._out.session_id
        blocks = [None if one is None else one.tobytes() for one in rates]
        expected = [
            encode(JointState(STAMP + seq, seq, session, digest, POSITIONS.tobytes(), *blocks))
            for seq in (1, 2, 3)
        ]
        assert payloads_until(tap, expected[-1]) == expected
        assert publisher.cache is not None
        assert [sample.payload for sample in publisher.cache.since(1)] == expected
        stats = publisher.stats
        first = publisher.cache.since(0)[0].payload
        assert (stats.sent, repr(publisher).count("4 samples")) == (4, 1)
        sizes = len(first) + sum(map(len, expected))
        assert stats.streams["native", "joint_states"] == (4, sizes, 0)
    tap.close()


@pytest.mark.parametrize("wire", ["ros2", "ros2dds"])
@pytest.mark.parametrize("rates", [(None, None), (RATES, -RATES)])
def test_ros_payloads_and_attachments_are_those_of_the_slow_way(sessions, wire: str, rates: Any):
    writer, reader = sessions
    with open_publisher(writer, wires=(wire,)) as publisher:
        stream = publisher._out.streams[wire, "joint_states"]
        encoder: Any = stream.encoder
        tap = SampleCollector(reader, encoder.key)
        wait_for_reader(writer, encoder.key)
        for seq, positions in enumerate((POSITIONS, SLOW, POSITIONS), start=1):
            publisher.publish(positions, *rates, stamp=STAMP + seq)
            assert is_ready(publisher)
        blocks = [None if one is None else one.tobytes() for one in rates]
        states = [
            JointState(STAMP + seq, seq, 1, order_digest(RRBOT.joint_names), POSITIONS.tobytes(), *blocks)
            for seq in (1, 2, 3)
        ]
        expected = [encoder.encode(state) for state in states]
        assert payloads_until(tap, expected[-1]) == expected
        attachments = [arrival.attachment for arrival in tap.arrivals[-3:]]
        if wire == "ros2":
            assert [unpack_attachment(one).seq for one in attachments] == [2, 3, 4]
            assert {unpack_attachment(one).gid for one in attachments} == {encoder._gid}
        else:
            assert attachments == [None] * 3
        with pytest.raises(InvalidInput, match="the stamp is 0"):
            publisher.publish(POSITIONS, stamp=0)
        assert (publisher.stats.sent, publisher.stats.refused) == (4, 1)
    tap.close()


def test_ros_samples_outside_limits_are_counted(sessions):
    with open_publisher(sessions[0], LIFT, wires=("ros2",)) as publisher:
        for position in (0.5, 2.5, 3.0, 1.0):
            publisher.publish(np.array([position]))
            assert is_ready(publisher)
        stats = publisher.stats
        assert (stats.outside_limits, stats.last_excess) == (2, "'lift' at 3.0 rad is outside -2 to 2")


def test_two_wires_take_the_slow_way(sessions):
    with StatePublisher(sessions[0], RRBOT, "r1", wires=("native", "ros2"), takeover=True) as publisher:
        publisher.publish(POSITIONS)
        assert publisher._publish_path is None
        assert [counts.samples for counts in publisher.stats.streams.values()] == [1, 0, 1, 0]


def test_the_default_stamp_is_the_present_time(sessions):
    with open_publisher(sessions[0]) as publisher:
        before = time.time_ns()
        publisher.publish(POSITIONS)
        assert is_ready(publisher)
        assert publisher.cache is not None
        assert before <= publisher.cache.since(1)[0].stamp <= time.time_ns()


def test_another_clock_gives_the_stamp(sessions):
    with open_publisher(sessions[0], clock=ManualClock(STAMP + 5)) as publisher:
        publisher.publish(POSITIONS)
        assert publisher.cache is not None
        assert publisher.cache.since(1)[0].stamp == STAMP + 5


class ClockAhead(SystemClock):
    def now(self) -> int:
        return super().now() + 10**12


def test_a_clock_that_adjusts_the_system_time_gives_the_stamp(sessions):
    with open_publisher(sessions[0], clock=ClockAhead()) as publisher:
        before = time.time_ns()
        publisher.publish(POSITIONS)
        assert publisher.cache is not None
        assert publisher.cache.since(1)[0].stamp >= before + 10**12


class CallingHandler(logging.Handler):
    """Calls ``function`` with each record."""

    def __init__(self, function: Callable[[], object]) -> None:
        super().__init__()
        self._function = function

    def emit(self, record: logging.LogRecord) -> None:
        self._function()


@pytest.fixture
def on_warning() -> Iterator[Callable[[Callable[[], object]], None]]:
    """``on_warning(function)``: the function is called when zstate logs a warning."""
    handlers: list[logging.Handler] = []

    def add(function: Callable[[], object]) -> None:
        handlers.append(CallingHandler(function))
        logging.getLogger("zstate").addHandler(handlers[-1])

    yield add
    for handler in handlers:
        logging.getLogger("zstate").removeHandler(handler)


def test_a_log_handler_may_publish_and_close(sessions, on_warning):
    with open_publisher(sessions[0], LIFT) as publisher:
        on_warning(lambda: (publisher.publish([0.0]), publisher.close()))
        publisher.publish([3.0])
        assert publisher.stats.sent == 3
        with pytest.raises(Closed):
            publisher.publish([0.0])


def test_a_number_is_not_used_again_after_a_log_handler_failed(sessions, on_warning):
    def fail() -> None:
        raise ZeroDivisionError

    on_warning(fail)
    with StatePublisher(sessions[0], LIFT, "r1", takeover=True) as publisher:
        with pytest.raises(ZeroDivisionError):
            publisher.publish([3.0], stamp=STAMP)
        publisher.publish([0.0], stamp=STAMP + 1)
        publisher.publish([0.0], stamp=STAMP + 2)
        assert publisher.cache is not None
        assert [sample.seq for sample in publisher.cache.since(0)] == [0, 1, 2]


@pytest.mark.parametrize(
    "arguments",
    [
        (np.array([0.0, np.nan]),),
        (np.array([np.inf, 0.0]),),
        (np.zeros(3),),
        (np.zeros((1, 2)),),
        (np.zeros(2), np.zeros(3)),
        (np.zeros(2), None, np.full(2, np.nan)),
        (np.zeros(2), None, None, 1.5),
        (np.zeros(2), None, None, 2**63),
    ],
)
def test_refusals_are_those_of_the_slow_way_and_send_nothing(sessions, arguments: tuple[Any, ...]):
    texts = []
    with open_publisher(sessions[0]) as publisher:
        for _ in ("path", "no path"):
            with pytest.raises(InvalidInput) as caught:
                publisher.publish(*arguments)
            texts.append(str(caught.value))
            publisher.publish(POSITIONS)
            publisher._publish_path = None
        assert texts[0] == texts[1] == publisher.stats.last_refusal
        assert publisher.stats.refused == 2


@pytest.mark.parametrize("with_path", [True, False])
def test_a_closed_publisher_or_session_is_refused(with_path: bool):
    with connect() as session, open_publisher(session) as publisher:
        publisher._publish_path = publisher._publish_path if with_path else None
        publisher.close()
        with pytest.raises(Closed, match="the publisher of 'r1' is closed"):
            publisher.publish(POSITIONS)
    with connect() as session, open_publisher(session) as publisher:
        publisher._publish_path = publisher._publish_path if with_path else None
        session.close()
        with pytest.raises(Closed, match="this session is closed"):
            publisher.publish(POSITIONS)
        assert publisher.stats.sent == 1


def test_a_reader_of_transforms_gets_them_from_its_first_sample_on(sessions):
    writer, reader = sessions
    with open_publisher(writer) as publisher:
        tap = SampleCollector(reader, TF)
        until(lambda: not is_ready(publisher))
        publisher.publish(POSITIONS)
        tap.payloads(1)
        assert not is_ready(publisher)
        tap.close()
        until(lambda: publisher.publish(POSITIONS) or is_ready(publisher))


def test_the_only_writer_is_ready_after_its_start_and_another_one_is_found_at_once(sessions):
    ours, theirs = sessions
    with StatePublisher(ours, RRBOT, "r1") as publisher:
        publisher.publish(POSITIONS)
        assert not is_ready(publisher)  # writers that opened at the same time may not be known yet
        until(lambda: publisher.publish(POSITIONS) or is_ready(publisher))
        with StatePublisher(theirs, RRBOT, "r1", takeover=True):
            until(lambda: not is_ready(publisher))
            publisher.publish(POSITIONS)
            assert not is_ready(publisher)
        until(lambda: publisher.publish(POSITIONS) or is_ready(publisher))


def test_samples_outside_limits_are_counted_and_the_first_is_logged(sessions, caplog):
    with open_publisher(sessions[0], LIFT) as publisher:
        for position in (0.5, 2.5, 3.0, 1.0):
            publisher.publish(np.array([position]))
            assert is_ready(publisher)
        (record,) = caplog.records
        assert "'lift' at 2.5 rad is outside -2 to 2; further" in record.getMessage()
        stats = publisher.stats
        assert (stats.outside_limits, stats.last_excess) == (2, "'lift' at 3.0 rad is outside -2 to 2")


def test_samples_of_several_threads_are_sent_in_the_order_of_their_numbers(sessions):
    writer, reader = sessions
    with open_publisher(writer) as publisher:
        tap = SampleCollector(reader, JOINTS)
        wait_for_reader(writer, JOINTS)
        publisher.publish(POSITIONS)
        forms: list[Callable[[], Any]] = [lambda: POSITIONS, lambda: SLOW]

        def send(form: Callable[[], Any]) -> None:
            for _ in range(50):
                publisher.publish(form())

        threads = [threading.Thread(target=send, args=(forms[number % 2],)) for number in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        seqs = [state.seq for state in tap.joint_states(301)]
        assert seqs == list(range(1, 302))
        assert publisher.cache is not None
        assert [sample.seq for sample in publisher.cache.since(1)] == seqs
    tap.close()


def test_closing_waits_for_the_sample_of_another_thread(sessions):
    publisher = open_publisher(sessions[0])

    def send() -> None:
        with suppress(Closed):
            while True:
                publisher.publish(POSITIONS)

    thread = threading.Thread(target=send)
    thread.start()
    until(lambda: publisher.stats.sent > 100)
    publisher.close()
    thread.join()
    assert publisher.stats.streams["native", "joint_states"].suppressed == 0
