"""Events when writers and routers die, freeze and return: real processes, real signals."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress

import pytest
from helpers.processes import Child, repeated, until, without_pauses
from helpers.robots import RRBOT

from zstate.ingest.diagnostics import WriterEvent
from zstate.net.session import Session, connect
from zstate.nodes.listener import TransformListener
from zstate.nodes.publisher import StatePublisher
from zstate.nodes.transform_publisher import TransformPublisher
from zstate.transform import Transform

Spawn = Callable[..., Child]

WRITER = """
    import sys
    from zstate import SineSource, StatePublisher, connect, load_model
    model = load_model("rrbot")
    how = {"mode": "client", "endpoints": sys.argv[1]} if len(sys.argv) > 1 else {}
    with connect(**how) as session, StatePublisher(session, model, "r1", program="driver") as publisher:
        publisher.run(SineSource(model), 100.0)
"""

ROUTER = """
    import sys
    from zstate.net.session import connect
    with connect(mode="router", listen=sys.argv[1]):
        print("up")
        sys.stdin.readline()
"""


class EventCollector:
    """Collects the joint-state events of a listener."""

    def __init__(self, session: Session) -> None:
        self.events: list[WriterEvent] = []
        self.listener = TransformListener(session, "r1", on_event=self._add)

    def _add(self, event: WriterEvent) -> None:
        if event.stream == "joint_states":
            self.events.append(event)

    @property
    def kinds(self) -> tuple[str, ...]:
        """The kinds of the events, without pauses."""
        return tuple(without_pauses(event.kind for event in self.events))

    def await_kinds(self, *kinds: str) -> WriterEvent:
        """The last event, once exactly these kinds were reported."""
        with suppress(AssertionError):  # the next one shows the kinds
            until(lambda: len(self.kinds) >= len(kinds))
        assert self.kinds == kinds
        return self.events[-1]

    def freeze(self, writer: Child) -> None:
        """Freeze a writer that publishes, once its period is known, also if its first samples were late."""
        self.await_samples(50)
        writer.freeze()

    def await_samples(self, count: int = 3) -> None:
        received = self.listener.stats.received
        until(lambda: self.listener.stats.received >= received + count)


@pytest.fixture
def collector() -> Iterator[EventCollector]:
    with connect() as session:
        collector = EventCollector(session)
        with collector.listener:
            yield collector


def test_killed_writer_has_left_and_is_restarted(collector, spawn):
    first = spawn(WRITER)
    collector.await_samples()
    joined = collector.await_kinds("joined")
    assert joined.writer.pid == first.process.pid
    first.kill()
    left = collector.await_kinds("joined", "left")
    assert left.writer == joined.writer
    second = spawn(WRITER)
    restarted = collector.await_kinds("joined", "left", "restarted")
    assert restarted.writer.pid == second.process.pid
    assert f"pid {first.process.pid} before" in restarted.text
    collector.await_samples()
    assert tuple(collector.events) == tuple(
        event for event in collector.listener.events() if event.stream == "joint_states"
    )


def test_frozen_writer_is_stale_then_resumed(collector, spawn):
    writer = spawn(WRITER)
    collector.freeze(writer)
    stale = collector.await_kinds("joined", "stale")
    assert "driver@" in stale.text
    assert stale.writer.pid == writer.process.pid
    after = len(collector.events)
    writer.process.send_signal(signal.SIGCONT)
    until(lambda: len(collector.events) > after)
    assert collector.events[after].kind == "resumed"
    collector.await_samples()


def test_frozen_writer_of_transforms_is_stale_on_its_own_stream(sessions):
    writer, reader = sessions
    events: list[WriterEvent] = []
    with (
        StatePublisher(writer, RRBOT, "r1") as wheels,
        TransformPublisher(writer, "r1", "odometry") as odometry,
        TransformListener(reader, "r1", on_event=events.append),
        repeated(lambda: wheels.publish([0.0, 0.0])),
    ):
        edge = Transform("odom", "world", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))

        def of_odometry() -> list[str]:
            return [event.kind for event in events if event.stream == "transforms"]

        with repeated(lambda: odometry.publish([edge])):
            until(lambda: of_odometry() == ["joined"])
            until(lambda: odometry.stats.sent > 10)
        until(lambda: of_odometry() == ["joined", "stale"])
        assert "published nothing on transforms" in events[-1].text
        until(lambda: odometry.publish([edge]) or of_odometry() == ["joined", "stale", "resumed"])
    assert not any(event.kind == "stale" and event.stream != "transforms" for event in events)


def test_writer_frozen_for_longer_than_its_lease_is_cut_off_then_back(collector, spawn):
    writer = spawn(WRITER)
    collector.freeze(writer)
    cut_off = collector.await_kinds("joined", "stale", "cut off")
    assert "fell silent" in cut_off.text
    writer.process.send_signal(signal.SIGCONT)
    back = collector.await_kinds("joined", "stale", "cut off", "back")
    assert back.writer.pid == writer.process.pid
    collector.await_samples()


def test_writer_disconnects_and_reconnects_with_its_router(spawn: Spawn, free_port: int):
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = spawn(ROUTER, endpoint)
    router.line()
    with connect(mode="client", endpoints=endpoint) as session:
        collector = EventCollector(session)
        with collector.listener:
            writer = spawn(WRITER, endpoint)
            collector.await_samples()
            router.kill()
            cut_off = collector.await_kinds("joined", "cut off")
            assert "is cut off: the router" in cut_off.text
            spawn(ROUTER, endpoint).line()
            back = collector.await_kinds("joined", "cut off", "back")
            assert back.writer == cut_off.writer
            collector.await_samples()
            writer.kill()
            collector.await_kinds("joined", "cut off", "back", "left")


def test_blocking_or_raising_callback_delays_no_sample(sessions, monkeypatch):
    monkeypatch.setattr("threading.excepthook", lambda _: None)
    called, go_on = threading.Event(), threading.Event()

    def wrong(_: WriterEvent) -> None:
        called.set()
        go_on.wait(10.0)
        raise ValueError("not mine")

    with (
        TransformListener(sessions[1], "r1", on_event=wrong) as listener,
        StatePublisher(sessions[0], RRBOT, "r1") as publisher,
    ):
        assert called.wait(10.0)
        until(lambda: publisher.publish([0.0, 0.0]) or listener.stats.received > 10)
        assert not go_on.is_set()
        go_on.set()
    assert listener.events()


def test_listener_without_on_event_has_no_thread_and_keeps_events(sessions):
    names = lambda: [thread.name for thread in threading.enumerate()]  # noqa: E731
    with TransformListener(sessions[1], "r1") as listener:
        assert "zstate events" not in names()
        with StatePublisher(sessions[0], RRBOT, "r1", streams=["joint_states"]):
            until(lambda: [event.kind for event in listener.events()] == ["joined"])
        until(lambda: [event.kind for event in listener.events()] == ["joined", "left"])
    with TransformListener(sessions[1], "r1", on_event=lambda _: None):
        assert names().count("zstate events") == 1
    assert "zstate events" not in names()
