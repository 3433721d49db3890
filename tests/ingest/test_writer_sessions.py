"""Which session of a stream counts, and what its description says."""

from __future__ import annotations

from zstate.clock import ManualClock
from zstate.ingest.writer_sessions import SILENT_NS, SessionDescriptions, WriterSessions
from zstate.wire.messages import RobotDescription


def replaced(first: int, second: int, clock: ManualClock | None = None) -> WriterSessions:
    sessions = WriterSessions(clock or ManualClock())
    for session in (first, second):
        assert sessions.accept(session, None)
        sessions.replace(session)
    return sessions


def test_replaced_session_counts_again_once_the_current_one_has_left():
    sessions = replaced(1, 2)
    assert not sessions.accept(1, None)
    assert not sessions.leave(1)
    assert not sessions.accept(1, None)
    assert sessions.leave(2)
    assert (sessions.current, sessions.departed) == (2, 2)  # its last samples may be on the way
    assert sessions.accept(1, None)
    sessions.announce(2, "it is back")
    assert sessions.departed is None


def test_announced_session_replaces_a_silent_stranger_after_two_seconds():
    clock = ManualClock()
    sessions = replaced(1, 2, clock)
    sessions.announce(1, "arm.py")
    for next_seq in (5, 6):  # a sample has arrived in between
        assert not sessions.accept(1, next_seq)
        clock.set(clock.now() + SILENT_NS - 1)
        assert not sessions.accept(1, next_seq)
    clock.set(clock.now() + 1)
    assert sessions.accept(1, 6)


def test_no_session_replaces_an_announced_one_by_waiting():
    clock = ManualClock()
    sessions = replaced(1, 2, clock)
    for session in (1, 2):
        sessions.announce(session, f"arm {session}")
    assert not sessions.accept(1, 5)
    clock.set(10 * SILENT_NS)
    assert not sessions.accept(1, 5)


def description(session: int, clock: str) -> RobotDescription:
    return RobotDescription(session, "<robot/>", "digest", (), (), clock)


def test_domain_of_a_session_is_that_of_its_own_description_or_of_the_last():
    descriptions = SessionDescriptions()
    assert descriptions.domain(1) is None
    descriptions.add(description(1, "system"))
    descriptions.add(description(2, "sim"))
    assert [descriptions.domain(session) for session in (1, 2, 3, None)] == ["system", "sim", "sim", "sim"]


def test_descriptions_of_the_last_four_sessions_are_kept():
    descriptions = SessionDescriptions()
    for session in (1, 2, 3, 4, 1, 5):
        descriptions.add(description(session, "system"))
    assert [session for session in range(6) if descriptions.of(session)] == [1, 3, 4, 5]


def test_robots_of_one_model_keep_its_text_once():
    kept = []
    for session in (1, 2):  # each of a robot of its own, with a text of its own
        descriptions = SessionDescriptions()
        descriptions.add(RobotDescription(session, "".join(["<robot", "/>"]), "digest", (), ()))
        kept.append(descriptions.of(session))
    assert kept[0].urdf is kept[1].urdf
    assert [one.session for one in kept] == [1, 2]
