import re
import threading
import time
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import pytest
import zenoh
from helpers.processes import DEADLINE_S, Child, until
from helpers.robots import wait_for_reader

from zstate.errors import Closed, InvalidInput
from zstate.net.latched import LatchedPublisher, LatchedSubscriber
from zstate.net.session import connect
from zstate.net.streams import KeyPublisher
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


class Values:
    """The current values by key, and every received sample."""

    def __init__(self, session) -> None:
        self.values: dict[str, bytes] = {}
        self.received: list[tuple[str, bytes, str]] = []
        self.subscriber = LatchedSubscriber(session, ALL, self._on_value)

    def _on_value(self, arrival: SerializedSample) -> None:
        if arrival.payload:
            self.values[arrival.key] = arrival.payload
        else:
            self.values.pop(arrival.key, None)
        self.received.append((arrival.key, arrival.payload, arrival.encoding))


@pytest.mark.parametrize("is_large", [False, True])
def test_late_joiner_receives_the_current_value_once(is_large: bool):
    with connect() as writer, LatchedPublisher(writer, key("a"), ENCODING, is_large=is_large) as value:
        value.set(b"old")
        value.set(b"new")
        with connect() as reader:
            values = Values(reader)
            until(lambda: values.values)
            assert values.received == [(key("a"), b"new", ENCODING)]


@pytest.mark.parametrize("is_large", [False, True])
def test_change_reaches_all_subscribers(is_large: bool):
    with connect() as writer, connect() as reader, connect() as other:
        early = Values(reader)
        with LatchedPublisher(writer, key("a"), ENCODING, is_large=is_large) as value:
            value.set(b"1")
            until(lambda: early.values == {key("a"): b"1"})
            late = Values(other)
            until(lambda: late.values == {key("a"): b"1"})
            value.set(b"2")
            for values in (early, late):
                until(lambda values=values: values.values == {key("a"): b"2"})


def test_cached_value_does_not_overtake_the_live_ones_before_it():
    is_busy, may_go_on = threading.Event(), threading.Event()
    received: list[bytes] = []

    def collect(arrival: SerializedSample) -> None:
        if arrival.payload == b"slow":
            is_busy.set()
            may_go_on.wait(10.0)
        received.append(arrival.payload)

    with connect() as writer, connect() as reader, LatchedPublisher(writer, key("slow"), ENCODING) as slow:
        slow.set(b"slow")
        with LatchedSubscriber(reader, ALL, collect), LatchedPublisher(writer, key("a"), ENCODING) as value:
            others = Values(reader)
            assert is_busy.wait(10.0)
            value.set(b"1")
            value.set(b"2")
            until(lambda: others.values.get(key("a")) == b"2")
            may_go_on.set()
            until(lambda: b"2" in received)
            assert received == [b"slow", b"1", b"2"]


def test_a_cached_value_that_comes_late_does_not_undo_its_withdrawal():
    cached, withdrawn = (
        zenoh.Timestamp(datetime.fromtimestamp(second, UTC), b"publisher") for second in (1, 2)
    )
    with connect() as writer, connect() as reader:
        token = f"{key('a')}/@adv/pub/{writer.zid}/uhlc/7"
        requests: zenoh.Queryable = writer.zenoh.declare_queryable(token, zenoh.handlers.FifoChannel(8))
        announced = writer.zenoh.liveliness().declare_token(token)
        values = Values(reader)
        pending: list[zenoh.Query] = []
        until(lambda: pending.extend(iter(requests.try_recv, None)) or pending)
        wait_for_reader(writer, key("a"))
        writer.zenoh.delete(key("a"), timestamp=withdrawn)
        until(lambda: values.received == [(key("a"), b"", "zenoh/bytes")])
        with pending[0] as received:
            received.reply(key("a"), b"value", timestamp=cached)
        with LatchedPublisher(writer, key("b"), ENCODING) as value:
            value.set(b"1")
            until(lambda: values.values == {key("b"): b"1"})
        assert len(values.received) == 2
        del announced


def test_late_joiner_receives_the_value_of_every_matching_writer():
    with connect() as first, connect() as second, connect() as reader:
        writers = [
            LatchedPublisher(session, key(f"{session.zid}_{index}"), ENCODING)
            for session in (first, second)
            for index in range(5)
        ]
        for number, writer in enumerate(writers):
            writer.set(b"%d" % number)
        values = Values(reader)
        until(lambda: sorted(values.values.values()) == [b"%d" % number for number in range(10)])


@pytest.mark.parametrize("is_large", [False, True])
def test_withdrawn_value_is_removed_and_not_sent_to_late_joiners(is_large: bool):
    with (
        connect() as writer,
        connect() as reader,
        connect() as other,
        LatchedPublisher(writer, key("a"), ENCODING, is_large=is_large) as value,
        LatchedPublisher(writer, key("b"), ENCODING) as witness,
    ):
        early = Values(reader)
        value.set(b"1")
        until(lambda: early.values)
        value.withdraw()
        until(lambda: not early.values)
        witness.set(b"2")
        late = Values(other)
        until(lambda: late.values)
        assert late.values == {key("b"): b"2"}
        assert (key("a"), b"1", ENCODING) not in late.received
        value.set(b"3")
        until(lambda: late.values.get(key("a")) == b"3")


def test_killed_writers_value_stays_with_subscribers_and_is_not_sent_to_late_joiners(spawn):
    with connect() as reader, connect() as other:
        killed: Child = spawn(WRITER, "killed", "{}")
        alive: Child = spawn(WRITER, "alive", "{}")
        early = Values(reader)
        until(lambda: len(early.values) == 2)
        killed.kill()
        until(lambda: len(list(other.zenoh.info.peers_zid())) <= 3)  # rendezvous peer, reader, alive
        late = Values(other)
        until(lambda: late.values)
        assert late.values == {key("alive"): b"alive"}
        assert set(early.values) == {key("alive"), key("killed")}
        alive.send_line()
        assert alive.wait() == 0
        assert alive.stderr == ""


def test_restarted_writers_value_is_received_again(spawn):
    with connect() as reader:
        values = Values(reader)
        first: Child = spawn(WRITER, "a", "{}")
        until(lambda: len(values.received) == 1)
        first.kill()
        spawn(WRITER, "a", "{}")
        until(lambda: len(values.received) == 2)
        assert values.received[0] == values.received[1] == (key("a"), b"a", ENCODING)


def test_late_join_works_through_a_router(spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    with connect(mode="router", listen=endpoint):
        writer: Child = spawn(WRITER, "a", repr({"mode": "client", "endpoints": endpoint}))
        writer.line()
        with connect(mode="client", endpoints=endpoint) as reader:
            values = Values(reader)
            until(lambda: values.values == {key("a"): b"a"})


def test_values_of_many_publishers_are_requested_a_few_at_a_time(free_port: int):
    endpoint, robots = f"tcp/127.0.0.1:{free_port}", 40
    with (
        connect(mode="router", listen=endpoint),
        connect(mode="client", endpoints=endpoint) as writer,
        connect(mode="client", endpoints=endpoint) as reader,
    ):
        caches = writer.zenoh.declare_queryable(
            "zstate/*/tf_static/*/@adv/**", zenoh.handlers.FifoChannel(2 * robots)
        )
        tokens = [
            writer.zenoh.liveliness().declare_token(f"zstate/r{number}/tf_static/a/@adv/pub/{writer.zid}/7/_")
            for number in range(robots)
        ]
        values = Values(reader)
        pending: list[zenoh.Query] = []

        def has_requests() -> bool:
            pending.extend(iter(caches.try_recv, None))
            return bool(pending)

        for _ in range(robots):
            until(has_requests)
            assert len(pending) <= 8
            with pending.pop(0) as received:
                received.reply(str(received.key_expr).partition("/@adv")[0], b"value")
        until(lambda: len(values.values) == robots)
        assert len(tokens) == robots


def test_value_that_does_not_arrive_is_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("zstate.net.latched._TIMEOUTS_S", (0.1, 0.2, 0.3))
    with connect() as writer, connect() as reader:
        token = f"{key('a')}/@adv/pub/{writer.zid}/7/_"
        requests: zenoh.Queryable = writer.zenoh.declare_queryable(token, zenoh.handlers.FifoChannel(8))
        announced = writer.zenoh.liveliness().declare_token(token)
        values = Values(reader)
        until(lambda: key("a") in caplog.text)
        assert not values.received
        assert "3 requests, the last of 0.3 s" in caplog.text
        del requests, announced


def test_a_value_for_which_a_slow_link_needs_longer_than_the_first_request_waits_is_received(
    monkeypatch: pytest.MonkeyPatch,
):
    first_s = 0.1
    monkeypatch.setattr("zstate.net.latched._TIMEOUTS_S", (first_s, DEADLINE_S))
    with connect() as writer, connect() as reader:
        token = f"{key('a')}/@adv/pub/{writer.zid}/7/_"
        requests: zenoh.Queryable = writer.zenoh.declare_queryable(token, zenoh.handlers.FifoChannel(8))
        announced = writer.zenoh.liveliness().declare_token(token)
        values = Values(reader)
        pending: list[zenoh.Query] = []
        until(lambda: pending.extend(iter(requests.try_recv, None)) or len(pending) == 2)
        came = time.monotonic()
        until(lambda: time.monotonic() - came > 2.0 * first_s)
        with pending[1] as second:
            second.reply(key("a"), b"value")
        until(lambda: values.values == {key("a"): b"value"})
        del announced


def test_large_values_reach_advanced_subscribers_of_zenoh_once_as_those_of_ros_nodes():
    received: list[tuple[int, bytes]] = []
    history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1)
    recovery = zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True)
    with connect() as writer, connect() as reader:

        def subscriber(number: int) -> object:
            handler = zenoh.handlers.Callback(
                lambda sample: received.append((number, sample.payload.to_bytes())), indirect=False
            )
            return zenoh.ext.declare_advanced_subscriber(
                reader.zenoh, key("*"), handler, history=history, recovery=recovery
            )

        subscribers = [subscriber(1)]
        wait_for_reader(writer, key("a"))
        with (
            LatchedPublisher(writer, key("a"), ENCODING, is_large=True) as first,
            LatchedPublisher(writer, key("b"), ENCODING, is_large=True) as second,
        ):
            first.set(b"a1")
            second.set(b"b")
            first.set(b"a2")
            until(lambda: len(received) == 3)
            subscribers.append(subscriber(2))
            until(lambda: len(received) == 5)
            first.set(b"a3")
            until(lambda: len(received) == 7)
        assert [payload for number, payload in received if number == 1] == [b"a1", b"b", b"a2", b"a3"]
        assert sorted(payload for number, payload in received if number == 2) == [b"a2", b"a3", b"b"]
        del subscribers


@pytest.mark.parametrize("is_large", [False, True])
def test_a_plain_client_of_zenoh_reads_a_value_by_the_rules_of_the_wire_specification(is_large: bool):
    with connect() as writer, LatchedPublisher(writer, key("a"), ENCODING, is_large=is_large) as value:
        value.set(b"1")
        with connect() as session:
            client = session.zenoh

            def cached(selector: str) -> list[tuple[str, bytes, str]]:
                replies = client.get(f"{selector}?_max=1", accept_replies=zenoh.ReplyKeyExpr.ANY)
                found = [reply.ok for reply in replies if reply.ok is not None]
                return [(str(one.key_expr), one.payload.to_bytes(), str(one.encoding)) for one in found]

            tokens: list[str] = []
            while not tokens:
                replies = client.liveliness().get(f"{ALL}/@adv/pub/**")
                tokens = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
            (token,) = tokens
            form = r"/@adv/pub/[0-9a-f]+/" + (r"uhlc/\d+" if is_large else r"\d+/_")
            assert re.fullmatch(re.escape(key("a")) + form, token)
            assert cached(token) == cached(f"{key('a')}/@adv/**") == [(key("a"), b"1", ENCODING)]
            value.withdraw()
            assert [payload for _, payload, _ in cached(token)] == [b""]


def test_values_and_samples_are_sent_as_the_wire_specification_lists():
    page = (Path(__file__).parents[2] / "docs" / "wire.md").read_text().partition("\n## Delivery\n")[2]
    page = page.partition("\n## ")[0]
    with connect() as writer, connect() as reader, ExitStack() as opened:
        received: dict[str, zenoh.Sample] = {}
        opened.enter_context(
            reader.zenoh.declare_subscriber("k/*", lambda one: received.update({str(one.key_expr): one}))
        )
        samples = [
            opened.enter_context(KeyPublisher(writer, "k/stream", ENCODING)),
            opened.enter_context(KeyPublisher(writer, "k/bulk", ENCODING, is_bulk=True)),
        ]
        values = [
            opened.enter_context(LatchedPublisher(writer, "k/value", ENCODING)),
            opened.enter_context(LatchedPublisher(writer, "k/large", ENCODING, is_large=True)),
            opened.enter_context(LatchedPublisher(writer, "k/urgent", ENCODING, urgent=True)),
        ]
        until(lambda: all(sample.has_readers for sample in samples))
        for sample in samples:
            sample.put(b"1")
        for value in values:
            value.set(b"1")
        until(lambda: len(received) == 5)
        for name, row in (
            ("stream", "all streams but those of bulk data, `status`, `release`"),
            ("bulk", "streams of bulk data: `cloud`, `image`"),
            ("value", "`robot_description`, `tf_static`, `map`, `camera_info`, `driver`"),
            ("large", "`robot_description`, `tf_static`, `map`, `camera_info`, `driver`"),
            ("urgent", "`stop`, `relax`"),
        ):
            one = received[f"k/{name}"]
            priority, congestion = (
                str(value).partition(".")[2].lower().replace("_", " ")
                for value in (one.priority, one.congestion_control)
            )
            express = "yes" if one.express else "no"
            (delivery,) = re.findall(rf"^\| {re.escape(row)} \| (.*) \|$", page, re.MULTILINE)
            assert re.sub(r" \(\d\)", "", delivery) == f"{priority} | {congestion} | {express}"


@pytest.mark.parametrize("is_large", [False, True])
def test_set_after_close_raises_closed(is_large: bool):
    with connect() as session:
        value = LatchedPublisher(session, key("a"), ENCODING, is_large=is_large)
        value.close()
        value.close()
        for use in (lambda: value.set(b"1"), value.withdraw):
            with pytest.raises(Closed, match="tf_static/a"):
                use()


def test_empty_value_is_refused_because_it_means_withdrawn():
    with (
        connect() as session,
        LatchedPublisher(session, key("a"), ENCODING) as value,
        pytest.raises(InvalidInput, match="withdraw"),
    ):
        value.set(b"")
