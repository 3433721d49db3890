import pytest
from helpers.processes import Child, until

from zstate.errors import Closed, InvalidInput
from zstate.net.latched import LatchedPublisher, LatchedSubscriber
from zstate.net.session import connect
from zstate.wire.protocol import SerializedSample

ENCODING = "zstate/StaticTransforms;v=1"
ALL = "zstate/*/tf_static/*"

WRITER = """
    import sys
    from zstate.net.latched import LatchedPublisher
    from zstate.net.session import connect
    key = "zstate/r/tf_static/" + sys.argv[1]
    with connect(**eval(sys.argv[2])) as session:
        with LatchedPublisher(session, key, "zstate/StaticTransforms;v=1") as value:
            value.set(sys.argv[1].encode())
            print("set")
            sys.stdin.readline()
"""


def key(writer: str) -> str:
    return f"zstate/r/tf_static/{writer}"


class Inbox:
    """The present values by key, and everything that was heard."""

    def __init__(self, session) -> None:
        self.values: dict[str, bytes] = {}
        self.heard: list[tuple[str, bytes, str]] = []
        self.subscriber = LatchedSubscriber(session, ALL, self._hear)

    def _hear(self, arrival: SerializedSample) -> None:
        if arrival.payload:
            self.values[arrival.key] = arrival.payload
        else:
            self.values.pop(arrival.key, None)
        self.heard.append((arrival.key, arrival.payload, arrival.encoding))


def test_who_joins_late_receives_the_present_value_once():
    with connect() as writer, LatchedPublisher(writer, key("a"), ENCODING) as value:
        value.set(b"old")
        value.set(b"new")
        with connect() as reader:
            inbox = Inbox(reader)
            until(lambda: inbox.values)
            assert inbox.heard == [(key("a"), b"new", ENCODING)]


def test_a_change_reaches_everybody():
    with connect() as writer, connect() as reader, connect() as other:
        early = Inbox(reader)
        with LatchedPublisher(writer, key("a"), ENCODING) as value:
            value.set(b"1")
            until(lambda: early.values == {key("a"): b"1"})
            late = Inbox(other)
            until(lambda: late.values == {key("a"): b"1"})
            value.set(b"2")
            for inbox in (early, late):
                until(lambda inbox=inbox: inbox.values == {key("a"): b"2"})


def test_every_writer_under_one_expression_is_remembered():
    with connect() as first, connect() as second, connect() as reader:
        writers = [
            LatchedPublisher(session, key(f"{session.zid}_{index}"), ENCODING)
            for session in (first, second)
            for index in range(5)
        ]
        for number, writer in enumerate(writers):
            writer.set(b"%d" % number)
        inbox = Inbox(reader)
        until(lambda: sorted(inbox.values.values()) == [b"%d" % number for number in range(10)])


def test_a_withdrawn_value_is_taken_back_and_not_live_for_who_joins_late():
    with (
        connect() as writer,
        connect() as reader,
        connect() as other,
        LatchedPublisher(writer, key("a"), ENCODING) as value,
        LatchedPublisher(writer, key("b"), ENCODING) as witness,
    ):
        early = Inbox(reader)
        value.set(b"1")
        until(lambda: early.values)
        value.withdraw()
        until(lambda: not early.values)
        witness.set(b"2")
        late = Inbox(other)
        until(lambda: late.values)
        assert late.values == {key("b"): b"2"}
        assert (key("a"), b"1", ENCODING) not in late.heard
        value.set(b"3")
        until(lambda: late.values.get(key("a")) == b"3")


def test_a_killed_writers_value_is_gone_for_later_joiners_and_stays_with_those_who_have_it(spawn):
    with connect() as reader, connect() as other:
        killed: Child = spawn(WRITER, "killed", "{}")
        alive: Child = spawn(WRITER, "alive", "{}")
        early = Inbox(reader)
        until(lambda: len(early.values) == 2)
        killed.kill()
        until(lambda: len(list(other.zenoh.info.peers_zid())) <= 3)  # lobby, reader, alive
        late = Inbox(other)
        until(lambda: late.values)
        assert late.values == {key("alive"): b"alive"}
        assert set(early.values) == {key("alive"), key("killed")}
        alive.send_line()
        assert alive.wait() == 0
        assert alive.stderr == ""


def test_a_restarted_writers_value_is_heard_again(spawn):
    with connect() as reader:
        inbox = Inbox(reader)
        first: Child = spawn(WRITER, "a", "{}")
        until(lambda: len(inbox.heard) == 1)
        first.kill()
        spawn(WRITER, "a", "{}")
        until(lambda: len(inbox.heard) == 2)
        assert inbox.heard[0] == inbox.heard[1] == (key("a"), b"a", ENCODING)


def test_late_join_works_through_a_router(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(mode="router", listen=endpoint):
        writer: Child = spawn(WRITER, "a", repr({"mode": "client", "endpoints": endpoint}))
        writer.line()
        with connect(mode="client", endpoints=endpoint) as reader:
            inbox = Inbox(reader)
            until(lambda: inbox.values == {key("a"): b"a"})


def test_setting_after_close_says_so():
    with connect() as session:
        value = LatchedPublisher(session, key("a"), ENCODING)
        value.close()
        value.close()
        for use in (lambda: value.set(b"1"), value.withdraw):
            with pytest.raises(Closed, match="tf_static/a"):
                use()


def test_an_empty_value_is_refused_because_it_means_withdrawn():
    with (
        connect() as session,
        LatchedPublisher(session, key("a"), ENCODING) as value,
        pytest.raises(InvalidInput, match="withdraw"),
    ):
        value.set(b"")
