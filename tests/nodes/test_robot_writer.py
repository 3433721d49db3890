"""One writer under all publishers: what it opens it closes, and a sample goes out on all wires or on none."""

from __future__ import annotations

import pytest
from helpers.processes import until
from helpers.robots import STAMP
from helpers.tokens import current_tokens

from zstate.clock import SIMULATED, Clock, ManualClock, SystemClock
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.net.clock_offset import measure_offsets
from zstate.net.session import Session
from zstate.nodes.robot_writer import RobotWriter
from zstate.wire.keys import WRITER_TOKEN
from zstate.wire.messages import JointState, order_digest, to_block

NAMES = ("lift",)


def state(out: RobotWriter, stamp: int) -> JointState:
    """The next sample of ``out``, of one joint."""
    return JointState(stamp, out.seq, out.session_id, order_digest(NAMES), to_block([0.5]), names=NAMES)


def opened(session: Session, *wires: str) -> RobotWriter:
    """A writer of the stream ``joint_states``, which has a cache."""
    out = RobotWriter(session, "r1", wires)
    with out.opening():
        out.own([out.announcement("joint_states")])
        for wire in out.open_wires():
            out.open_stream(wire, "joint_states")
        out.open_cache(10.0, 1)
        out.serve_history("joint_states")
    return out


def test_what_was_open_is_closed_if_opening_fails(sessions):
    writer, reader = sessions
    out = RobotWriter(writer, "r1", ("native",))
    with pytest.raises(ZeroDivisionError), out.opening():
        out.own([out.announcement("joint_states")])
        out.open_wires()
        out.open_stream("native", "joint_states")
        until(lambda: current_tokens(reader, WRITER_TOKEN.expression("r1"), 1.0))
        raise ZeroDivisionError
    until(lambda: not current_tokens(reader, WRITER_TOKEN.expression("r1"), 1.0))
    opened(writer, "native").close()


def test_a_sample_that_one_wire_cannot_represent_is_neither_sent_nor_cached_nor_counted(sessions):
    with opened(sessions[0], "native", "ros2") as out:
        with pytest.raises(InvalidInput, match="the stamp is 0"), out.lock:
            out.check()
            out.send(state(out, 0))
        assert out.cache is not None
        assert (out.seq, out.cache.since(0)) == (0, [])
        assert {writer.sent[0] for writer in out.streams.values()} == {0}
        with out.lock:
            out.check()
            out.send(state(out, STAMP))
        assert (out.seq, [sample.seq for sample in out.cache.since(0)]) == (1, [0])
        assert {writer.sent[0] for writer in out.streams.values()} == {1}


def test_without_the_native_wire_nothing_is_owned_cached_or_answered(sessions):
    with opened(sessions[0], "ros2") as out, opened(sessions[0], "ros2"):
        assert (out.claim, out.cache) == (None, None)
        out.check()


@pytest.mark.parametrize(("clock", "replies"), [(SystemClock(), 1), (ManualClock(domain=SIMULATED), 0)])
def test_readers_can_measure_the_clock_unless_it_is_simulated(sessions, clock: Clock, replies: int):
    writer, reader = sessions
    with RobotWriter(writer, "r1", ("native",), clock=clock) as out:
        out.own([])
        if replies:
            until(lambda: len(measure_offsets(reader, "r1")) == replies)
        assert len(measure_offsets(reader, "r1")) == replies


def test_a_second_writer_closes_all_and_is_raised_again(sessions):
    with opened(sessions[0], "native") as out:
        error = SecondWriter("another", robot="r1", stream="joint_states", first=out.identity)

        def refuse() -> None:
            raise error

        out.checks.append(refuse)
        with pytest.raises(SecondWriter):
            out.check()
        out.checks.clear()
        with pytest.raises(SecondWriter, match="another"):
            out.check()
        opened(sessions[0], "native").close()  # its claim has been released


def test_a_closed_writer_names_what_it_belongs_to(sessions):
    out = opened(sessions[0], "native")
    out.title = "the arm's publisher"
    out.close()
    out.close()
    with pytest.raises(Closed, match="the arm's publisher is closed"):
        out.check()
