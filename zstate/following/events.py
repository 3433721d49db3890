"""Events: who begins and ceases to write what a listener hears, and how that came."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Literal

from zstate.closing import Closing
from zstate.errors import duration_text
from zstate.following.bounded import remember
from zstate.following.placements import Placements
from zstate.following.teller import Teller
from zstate.ingest.deadline import DeadlineMonitor
from zstate.locks import new_lock
from zstate.wire.keys import Stream
from zstate.wire.writer import Announced, Writer

Kind = Literal["joined", "left", "restarted", "conflict", "stale", "resumed", "cut off", "back", "set back"]

KEPT = 1024


@dataclass(frozen=True, slots=True)
class Event:
    """Something happened to the ``writer`` of a stream of ``robot``, as seen here ``at`` [ns], system time.

    - "joined": it writes from now on; "restarted": the same program on the same host did before;
    - "left": it was closed, or its process ended, while the network stands;
    - "cut off": the router through which it was heard is lost, or it had gone silent before it went: it
      may write still. "back": it is there again, the same one;
    - "stale": it is announced, but for ten of its periods (half a second at least) no sample has come:
      frozen, or its source is. "resumed": samples come again;
    - "set back": its clock went back, so that the history of the robot begins with its next sample;
    - "conflict": another one writes the same stream, or places the same frame.

    ``writer`` is None where it is not announced; ``text`` says all of it.
    """

    kind: Kind
    robot: str
    stream: Stream
    writer: Writer | None
    at: int
    text: str

    def __str__(self) -> str:
        return self.text


_Place = tuple[str, Stream, str]


class Events(Closing):
    """The events of one listener, which hears the streams ``heard`` and the samples of ``followed``.

    ``on_event`` is called with each from a thread of its own, which is there for it alone; without it
    nothing is stale, and who went silent first has "left". Any thread may note.
    """

    def __init__(
        self,
        heard: Collection[Stream],
        followed: Stream,
        shared: Collection[Stream],
        on_event: Callable[[Event], None] | None = None,
    ) -> None:
        self._heard = frozenset(heard)
        self._followed: Stream = followed
        # In ROS parts of tf are everybody's; two programs that move the same joints are not meant.
        self._alone = self._heard - (frozenset(shared) - {"joint_states"})
        self._kept: deque[Event] = deque(maxlen=KEPT)
        self._alive: dict[_Place, dict[int, Announced]] = {}
        self._former: dict[tuple[_Place, str, str], Writer] = {}
        self._gone: dict[tuple[_Place, int], None] = {}
        self._fought: dict[tuple[str, str, int, str], None] = {}
        self._placements = Placements()
        self._lock = new_lock()
        self._deadlines = DeadlineMonitor()
        self._teller = None if on_event is None else Teller(on_event, self._look)

    def recent(self) -> tuple[Event, ...]:
        """The last 1024 events, oldest first."""
        with self._lock:
            return tuple(self._kept)

    @property
    def failures(self) -> int:
        """How often ``on_event`` raised."""
        return 0 if self._teller is None else self._teller.failures

    def close(self) -> None:
        """Tell no more, also from inside ``on_event``. A second call does nothing."""
        if self._teller is not None:
            self._teller.close()

    def note_writer(self, announced: Announced, alive: bool) -> None:
        """A writer is announced, or is no more."""
        if announced.stream in self._heard:
            with self._lock:
                if alive:
                    self._come(announced)
                else:
                    self._go(announced, "left")

    def note_cut_off(self, announced: Announced) -> None:
        """A writer is not announced any more, together with the router it was heard through."""
        if announced.stream in self._heard:
            with self._lock:
                self._go(announced, "cut off")

    def note_sample(self, robot: str, session: int) -> None:
        """A sample of the followed stream has come."""
        if self._teller is not None:
            silent_s = self._deadlines.on_sample((robot, session), time.monotonic())
            if silent_s is not None:
                with self._lock:
                    self._tell_of_silence("resumed", robot, session, silent_s)

    def note_set_back(self, robot: str, session: int, text: str) -> None:
        """The clock of the writer of the followed stream was set back."""
        with self._lock:
            announced = self._alive.get((robot, self._followed, ""), {}).get(session)
            writer = None if announced is None else announced.writer
            self._add("set back", robot, self._followed, writer, text)

    def note_second_edge(self, robot: str, name: str, child: str, text: str) -> None:
        """The static edge by which the writer ``name`` places ``child`` was refused: another one does."""
        with self._lock:
            self._fight(robot, name, child, text)

    def note_statics(self, robot: str, name: str, children: frozenset[str]) -> None:
        """The frames that the static writer ``name`` of ``robot`` places now, by their full names."""
        with self._lock:
            for child, others in self._placements.replace((robot, name), children):
                who = " and ".join(f"{other!r} of {of!r}" for of, other in others)
                text = f"{name!r} of {robot!r} places {child!r}, and so does {who}"
                self._fight(robot, name, child, text)

    def _fight(self, robot: str, name: str, child: str, text: str) -> None:
        announced = next(iter(self._alive.get((robot, "tf_static", name), {}).values()), None)
        key = (robot, name, 0 if announced is None else announced.writer.session, child)
        if key not in self._fought:
            writer = None if announced is None else announced.writer
            self._add("conflict", robot, "tf_static", writer, text)
        remember(self._fought, key, None)

    def _look(self, now_s: float) -> float:
        stale, next_s = self._deadlines.expired(now_s)
        if stale:
            with self._lock:
                for (robot, session), silent_s in stale.items():
                    self._tell_of_silence("stale", robot, session, silent_s)
        return next_s

    def _come(self, announced: Announced) -> None:
        place, writer = _place(announced), announced.writer
        others = self._alive.setdefault(place, {})
        if writer.session in others:
            return
        rivals = [other.writer for other in others.values() if other.excludes(announced)]
        others[writer.session] = announced
        self._tell_of_coming(announced, is_alone=not rivals)
        if rivals and announced.stream in self._alone:
            text = f"{_who(announced)}, and so does {rivals[-1]}; readers follow whoever came last"
            self._add("conflict", announced.robot, announced.stream, writer, text)
        self._deadlines.register((announced.robot, writer.session))

    def _tell_of_coming(self, announced: Announced, *, is_alone: bool) -> None:
        place, writer = _place(announced), announced.writer
        before = self._former.get((place, writer.program, writer.host))
        if (place, writer.session) in self._gone:
            self._add("back", announced.robot, announced.stream, writer, f"{_who(announced)}: it is back")
        elif before is None or not is_alone:
            self._add("joined", announced.robot, announced.stream, writer, _who(announced))
        else:
            was = f", pid {before.pid} before" if before.pid else ""
            text = f"{_who(announced)} anew: it was restarted{was}"
            self._add("restarted", announced.robot, announced.stream, writer, text)

    def _go(self, announced: Announced, kind: Literal["left", "cut off"]) -> None:
        place, writer = _place(announced), announced.writer
        others = self._alive.get(place, {})
        if others.pop(writer.session, None) is None:
            return
        remember(self._gone, (place, writer.session), None)
        remember(self._former, (place, writer.program, writer.host), writer)
        if not others:
            del self._alive[place]
            self._placements.replace((announced.robot, announced.name), frozenset())
        was_stale = self._deadlines.unregister((announced.robot, writer.session))
        who = f"{announced.robot!r}: {writer} "
        what = _what(announced)
        if kind == "cut off":
            text = f"{who}is cut off from us: the router is lost through which its {what} came"
        elif was_stale:
            kind, text = "cut off", f"{who}went silent, and is gone: frozen, or cut off from the network"
        else:
            text = f"{who}has left: it does not write {what} any more"
        self._add(kind, announced.robot, announced.stream, writer, text)

    def _tell_of_silence(
        self, kind: Literal["stale", "resumed"], robot: str, session: int, silent_s: float
    ) -> None:
        announced = self._alive.get((robot, self._followed, ""), {}).get(session)
        if announced is None:
            return
        lasting = duration_text(round(silent_s * 1e9))
        if kind == "stale":
            text = f"for {lasting}, though it is announced: it is frozen, or given nothing new"
        else:
            text = f"for {lasting}; now samples come again"
        text = f"{robot!r}: {announced.writer} said nothing on {self._followed} {text}"
        self._add(kind, robot, self._followed, announced.writer, text)

    def _add(self, kind: Kind, robot: str, stream: Stream, writer: Writer | None, text: str) -> None:
        event = Event(kind, robot, stream, writer, time.time_ns(), text)
        self._kept.append(event)
        if self._teller is not None:
            self._teller.tell(event)


def _place(announced: Announced) -> _Place:
    return announced.robot, announced.stream, announced.name


def _what(announced: Announced) -> str:
    return f"static edges as {announced.name!r}" if announced.name else announced.stream


def _who(announced: Announced) -> str:
    return f"{announced.robot!r}: {announced.writer} writes {_what(announced)}"
