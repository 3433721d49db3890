"""Events of the writers that a listener follows: they join, leave, restart, conflict, fall silent."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from typing import Generic, Literal, TypeVar

from zstate._util.bounded import MAX_ENTRIES, BoundedDict
from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe, fork_safe_lock
from zstate.errors import InsertRefused, format_duration
from zstate.ingest.deadline import DeadlineMonitor
from zstate.ingest.diagnostics import Kind, WriterEvent
from zstate.ingest.frame_ownership import EdgeSource
from zstate.stream_registry import edge_streams
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId

KEPT = 1024

_QUEUE_SIZE = 1024
_MIN_TICK_S = 0.02
_MAX_TICK_S = 0.5
_CLOSES_WITHIN_S = 0.8

T = TypeVar("T")


StaticWriter = tuple[str, str]
"""A robot, and the name under which some of its static edges are published."""


class StaticEdgeOwners:
    """The child frames of each static writer, and the other writers of the same frames."""

    def __init__(self) -> None:
        self._children: dict[StaticWriter, frozenset[str]] = {}
        self._writers: dict[str, set[StaticWriter]] = {}

    def replace(self, writer: StaticWriter, children: frozenset[str]) -> list[tuple[str, list[StaticWriter]]]:
        """Set the frames that ``writer`` places; returns those that others place, too, with these writers."""
        for child in self._children.pop(writer, frozenset()) - children:
            self._writers[child].discard(writer)
            if not self._writers[child]:
                del self._writers[child]
        for child in children:
            self._writers.setdefault(child, set()).add(writer)
        if children:
            self._children[writer] = children
            while len(self._children) > MAX_ENTRIES:
                self.replace(next(iter(self._children)), frozenset())
        others = [(child, sorted(self._writers[child] - {writer})) for child in sorted(children)]
        return [(child, writers) for child, writers in others if writers]


class CallbackThread(Closeable, Generic[T]):
    """Calls ``callback`` from a thread of its own, so that a slow one delays nothing else.

    Every submitted item is passed on, in order. Drops the oldest of more than 1024.

    ``tick(now)`` is called from the same thread at least every half second; it returns its next due time,
    both by ``time.monotonic`` [s]. An exception of ``callback`` is counted in ``failures``; the first also
    goes to ``threading.excepthook``.
    """

    def __init__(self, callback: Callable[[T], None], tick: Callable[[float], float]) -> None:
        self.failures = 0
        self._callback = callback
        self._tick = tick
        self._queue: deque[T] = deque(maxlen=_QUEUE_SIZE)
        self._wake = fork_safe(threading.Condition())
        self._is_open = True
        self._thread = threading.Thread(target=self._run, name="zstate events", daemon=True)
        self._thread.start()

    def submit(self, item: T) -> None:
        """Queue ``item`` for the callback. Does not block."""
        with self._wake:
            self._queue.append(item)
            self._wake.notify_all()

    def close(self) -> None:
        """Stop within a second, also from inside ``callback``. A second call does nothing."""
        with self._wake:
            self._is_open = False
            self._wake.notify_all()
        if threading.current_thread() is not self._thread:
            self._thread.join(_CLOSES_WITHIN_S)

    def _run(self) -> None:
        while self._is_open:
            # Outside the lock, because ``tick`` may submit items itself.
            wait_s = self._tick(time.monotonic()) - time.monotonic()
            with self._wake:
                if not self._queue and self._is_open:
                    self._wake.wait(min(max(wait_s, _MIN_TICK_S), _MAX_TICK_S))
                items = list(self._queue)
                self._queue.clear()
            for item in items:
                if not self._is_open:
                    return
                try:
                    self._callback(item)
                except Exception:
                    self.failures += 1
                    if self.failures == 1:
                        threading.excepthook(threading.ExceptHookArgs((*sys.exc_info(), self._thread)))


_StreamKey = tuple[str, StreamName, str]


class EventLog(Closeable):
    """The events of one listener, which receives ``streams`` and inserts the samples of ``followed``.

    ``on_event`` is called with each event on a thread of its own. Without it there are no "stale" events, and
    a writer that falls silent before it disappears has "left". Any thread may call the methods.
    """

    def __init__(
        self,
        streams: Collection[StreamName],
        followed: StreamName,
        shared: Collection[StreamName],
        on_event: Callable[[WriterEvent], None] | None = None,
    ) -> None:
        self._streams = frozenset(streams)
        self._followed: StreamName = followed
        # In ROS many programs publish parts of tf, and several may publish a robot's joints.
        self._exclusive = self._streams - {"joint_states", *shared} if shared else self._streams
        self._events: deque[WriterEvent] = deque(maxlen=KEPT)
        self._alive: dict[_StreamKey, dict[int, Announcement]] = {}
        self._former: BoundedDict[tuple[_StreamKey, str, str], WriterId] = BoundedDict()
        self._gone: BoundedDict[tuple[_StreamKey, int], None] = BoundedDict()
        self._conflicts: BoundedDict[tuple[str, str, int, str], None] = BoundedDict()
        self._owners = StaticEdgeOwners()
        self._lock = fork_safe_lock()
        self._deadlines = DeadlineMonitor()
        self._thread = None if on_event is None else CallbackThread(on_event, self._check_deadlines)

    def recent(self) -> tuple[WriterEvent, ...]:
        """The last 1024 events, oldest first."""
        with self._lock:
            return tuple(self._events)

    @property
    def failures(self) -> int:
        """How often ``on_event`` raised."""
        return 0 if self._thread is None else self._thread.failures

    def close(self) -> None:
        """Stop calling ``on_event``, also from inside it. A second call does nothing."""
        if self._thread is not None:
            self._thread.close()

    def set_thinned(self, periods_s: Mapping[str, float]) -> None:
        """Set the periods at which sites let samples pass, by robot: "stale" follows from them."""
        self._deadlines.thinned_s = periods_s

    def on_writer(self, announced: Announcement, alive: bool) -> None:
        """Add the event of a writer that is announced, or is not any more."""
        if announced.stream in self._streams:
            with self._lock:
                if alive:
                    self._on_joined(announced)
                else:
                    self._on_left(announced, "left")

    def on_cut_off(self, announced: Announcement) -> None:
        """Add the event of a writer that disappeared together with the router that connected it."""
        if announced.stream in self._streams:
            with self._lock:
                self._on_left(announced, "cut off")

    def on_sample(self, robot: str, session: int) -> None:
        """Record the arrival of a sample."""
        if self._thread is not None:
            silent_s = self._deadlines.on_sample((robot, session), time.monotonic())
            if silent_s is not None:
                with self._lock:
                    self._add_silence("resumed", robot, session, silent_s)

    def add_set_back(self, robot: str, session: int, text: str) -> None:
        """Add the event of a writer whose clock was set back."""
        with self._lock:
            announced = self._sample_writer(robot, session)
            writer = None if announced is None else announced.writer
            stream = self._followed if announced is None else announced.stream
            self._add("set back", robot, stream, writer, text)

    def add_second_edge(self, stream: StreamName, source: EdgeSource, refusal: InsertRefused) -> None:
        """Add the conflict of a refused edge of ``source`` on ``stream``: its child has another owner."""
        child, text = refusal.edge[1], str(refusal)
        with self._lock:
            if stream == "tf_static":
                self._add_static_conflict(source.robot, source.name, child, text)
                return
            announced = self._sample_writer(source.robot, source.session)
            key = (source.robot, "", source.session, child)
            if announced is None:
                self._add_conflict(key, stream, None, text)
            else:
                self._add_conflict(key, announced.stream, announced.writer, text)

    def set_static_children(self, robot: str, name: str, children: frozenset[str]) -> None:
        """Set the full names of the frames that the static writer ``name`` of ``robot`` places now."""
        with self._lock:
            for child, others in self._owners.replace((robot, name), children):
                owners = " and ".join(f"{other!r} of {of!r}" for of, other in others)
                text = f"{name!r} of {robot!r} places {child!r}, and so does {owners}"
                self._add_static_conflict(robot, name, child, text)

    def _add_static_conflict(self, robot: str, name: str, child: str, text: str) -> None:
        announced = next(iter(self._alive.get((robot, "tf_static", name), {}).values()), None)
        writer = None if announced is None else announced.writer
        key = (robot, name, 0 if writer is None else writer.session, child)
        self._add_conflict(key, "tf_static", writer, text)

    def _add_conflict(
        self, key: tuple[str, str, int, str], stream: StreamName, writer: WriterId | None, text: str
    ) -> None:
        """Add a conflict, once for each robot, writer name, session and child in ``key``."""
        if key not in self._conflicts:
            self._add("conflict", key[0], stream, writer, text)
        self._conflicts[key] = None

    def _check_deadlines(self, now_s: float) -> float:
        stale, next_s = self._deadlines.expired(now_s)
        with self._lock:
            for (robot, session), silent_s in stale.items():
                self._add_silence("stale", robot, session, silent_s)
        return next_s

    def _on_joined(self, announced: Announcement) -> None:
        key, writer = _stream_key(announced), announced.writer
        others = self._alive.setdefault(key, {})
        if writer.session in others:
            return
        rivals = [other.writer for other in others.values() if other.conflicts_with(announced)]
        others[writer.session] = announced
        text = f"{announced.robot!r}: {writer} writes {_what(announced)}"
        before = self._former.get((key, writer.program, writer.host))
        if (key, writer.session) in self._gone:
            self._add("back", announced.robot, announced.stream, writer, f"{text}: it is back")
        elif before is None or rivals:
            self._add("joined", announced.robot, announced.stream, writer, text)
        else:
            was = f", pid {before.pid} before" if before.pid else ""
            restarted = f"{text} again: it was restarted{was}"
            self._add("restarted", announced.robot, announced.stream, writer, restarted)
        if rivals and announced.stream in self._exclusive:
            text = f"{text}, and so does {rivals[-1]}; listeners use the newest writer"
            self._add("conflict", announced.robot, announced.stream, writer, text)
        self._deadlines.register((announced.robot, writer.session))

    def _on_left(self, announced: Announcement, kind: Literal["left", "cut off"]) -> None:
        key, writer = _stream_key(announced), announced.writer
        others = self._alive.get(key, {})
        if others.pop(writer.session, None) is None:
            return
        self._gone[key, writer.session] = None
        self._former[key, writer.program, writer.host] = writer
        if not others:
            del self._alive[key]
        if not others and announced.stream == "tf_static":
            self._owners.replace((announced.robot, announced.name), frozenset())
        was_stale = self._deadlines.unregister((announced.robot, writer.session))
        what = _what(announced)
        if kind == "cut off":
            text = f"is cut off: the router that carried its {what} is lost"
        elif was_stale:
            kind, text = "cut off", "fell silent and is gone: it froze, or was cut off from the network"
        else:
            text = f"has left: it does not write {what} any more"
        self._add(kind, announced.robot, announced.stream, writer, f"{announced.robot!r}: {writer} {text}")

    def _add_silence(
        self, kind: Literal["stale", "resumed"], robot: str, session: int, silent_s: float
    ) -> None:
        announced = self._sample_writer(robot, session)
        if announced is None:
            return
        lasting = format_duration(round(silent_s * 1e9))
        if kind == "stale":
            link = ", or the link of its site is down" if robot in self._deadlines.thinned_s else ""
            text = f"for {lasting}, though it is announced: it is frozen, or its source is{link}"
        else:
            text = f"for {lasting}; samples come again"
        text = f"{robot!r}: {announced.writer} published nothing on {announced.stream} {text}"
        self._add(kind, robot, announced.stream, announced.writer, text)

    def _sample_writer(self, robot: str, session: int) -> Announcement | None:
        """The announced writer of samples with this session, of the followed stream or of a named one."""
        announced = self._alive.get((robot, self._followed, ""), {}).get(session)
        if announced is None:
            for (owner, stream, _), writers in self._alive.items():
                has_samples = stream in (*edge_streams(), "partial_joint_states")
                if owner == robot and has_samples and session in writers:
                    return writers[session]
        return announced

    def _add(self, kind: Kind, robot: str, stream: StreamName, writer: WriterId | None, text: str) -> None:
        event = WriterEvent(kind, robot, stream, writer, time.time_ns(), text)
        self._events.append(event)
        if self._thread is not None:
            self._thread.submit(event)


def _stream_key(announced: Announcement) -> _StreamKey:
    return announced.robot, announced.stream, announced.name


def _what(announced: Announcement) -> str:
    if not announced.name:
        return announced.stream
    kind = "static edges" if announced.stream == "tf_static" else announced.stream.replace("_", " ")
    return f"{kind} as {announced.name!r}"
