"""Sampler: how often the writers of streams say something, heard for a short time or for long."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Collection
from contextlib import ExitStack
from typing import TYPE_CHECKING, NamedTuple

from zstate._util.bounded_dict import BoundedDict
from zstate.closing import Closing
from zstate.errors import InvalidInput, MessageError
from zstate.net.streams import StreamSubscriber
from zstate.net.wires import wire_named
from zstate.wire.keys import Stream
from zstate.wire.messages import Sample

if TYPE_CHECKING:
    from zstate.net.session import Session
    from zstate.wire.protocol import SerializedSample

# Enough for a steady number, few enough to notice a change.
_KEPT = 200
_WINDOW_NS = 2_000_000_000
_ENOUGH_NS = 200_000_000
_LOOK_EVERY_S = 0.02


class Source(NamedTuple):
    """One writer of one stream, as its samples tell of it."""

    robot: str
    stream: Stream
    session: int


class Pulse(NamedTuple):
    """How often somebody says something, and how long ago the last time was [ns]; None for not known."""

    rate_hz: float | None
    silent_ns: int


class _Heard(NamedTuple):
    came: int
    stamp: int
    seq: int


class Sampler(Closing):
    """Hears streams of the native wire and measures the writers. What it cannot read it passes over."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._wire = wire_named("native")
        self._heard: BoundedDict[Source, deque[_Heard]] = BoundedDict()
        self._opened = ExitStack()

    def hear(self, stream: Stream, robot: str = "*") -> None:
        """Listen to ``stream`` of ``robot``, or of all of them, from now on."""

        def take(arrivals: list[SerializedSample]) -> None:
            came = time.monotonic_ns()
            for arrival in arrivals:
                self._take(stream, arrival, came)

        key = self._wire.expression(robot, stream)
        self._opened.enter_context(StreamSubscriber(self._session, key, take))

    def _take(self, stream: Stream, arrival: SerializedSample, came: int) -> None:
        try:
            robot = self._wire.robot_of(arrival.key)
            samples = self._wire.decode(stream, arrival, robot)
        except (InvalidInput, MessageError):
            return
        for sample in samples:
            if isinstance(sample, Sample):
                source = Source(robot, stream, sample.session)
                heard = self._heard.get(source)
                if heard is None:
                    heard = deque[_Heard](maxlen=_KEPT)
                    self._heard[source] = heard
                heard.append(_Heard(came, sample.stamp, sample.seq))

    def wait(self, sources: Collection[Source], timeout_s: float) -> None:
        """Until there is enough of each, or for ``timeout_s``."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline and not all(map(self._is_enough, sources)):
            time.sleep(_LOOK_EVERY_S)

    def _is_enough(self, source: Source) -> bool:
        heard = self._heard.get(source)
        return heard is not None and heard[-1].came - heard[0].came >= _ENOUGH_NS

    def pulse(self, source: Source) -> Pulse | None:
        """What is known of ``source`` now; None when nothing was heard."""
        kept = self._heard.get(source)
        if not kept:
            return None
        heard, now = list(kept), time.monotonic_ns()
        silent_ns = now - heard[-1].came
        recent = [one for one in heard if now - one.came < _WINDOW_NS]
        return Pulse(_rate_hz(recent), silent_ns)

    def close(self) -> None:
        """Listen no more. A second call does nothing."""
        self._opened.close()


def _rate_hz(heard: list[_Heard]) -> float | None:
    """By their own stamps and numbers: what waits for a busy machine comes in bursts."""
    if len(heard) < 2:
        return None
    first, last = heard[0], heard[-1]
    passed_ns = last.stamp - first.stamp
    return (last.seq - first.seq) * 1e9 / passed_ns if passed_ns > 0 and last.seq > first.seq else None
