"""Samples: how the samples of one stream of one robot come in, whatever they say."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from zstate.closing import Closing
from zstate.errors import MessageError
from zstate.model.coordinates import coordinate_names
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.net.streams import StreamSubscriber
from zstate.wire.keys import Stream
from zstate.wire.messages import JointState, Sample, from_block, order_digest
from zstate.wire.protocol import SerializedSample, Wire


class Samples(Closing):
    """Counts samples, with when they came and what they are stamped; durations in nanoseconds."""

    def __init__(
        self,
        session: Session,
        robot: str,
        stream: Stream,
        wire: Wire,
        on_change: Callable[[], object] = lambda: None,
    ) -> None:
        self.count = 0
        self.last_stamp: int | None = None
        self.delays: tuple[int, int] = (0, 0)
        """From the stamp to the arrival here: the least and the greatest there was."""
        self.stands_still = True
        """Whether all have the same stamp."""
        self.session: int | None = None
        """Of the writer of the newest."""
        self.ranges = Ranges()
        """Of the joint positions."""
        self._came: tuple[int, int] = (0, 0)
        self._robot, self._wire, self._on_change = robot, wire, on_change
        self._stream: Stream = stream
        self._subscriber = StreamSubscriber(session, wire.expression(robot, stream), self._take)

    def close(self) -> None:
        self._subscriber.close()

    @property
    def rate_hz(self) -> float | None:
        """Samples a second, as they come; None for fewer than two."""
        first, last = self._came
        return (self.count - 1) * 1e9 / (last - first) if last > first else None

    @property
    def silent_ns(self) -> int:
        """How long there has been none."""
        return time.monotonic_ns() - self._came[1]

    def _take(self, arrivals: list[SerializedSample]) -> None:
        for arrival in arrivals:
            with suppress(MessageError):  # the listener beside this counts and names them
                for sample in self._wire.decode(self._stream, arrival, self._robot):
                    assert isinstance(sample, Sample)
                    self._note(sample)
        self._on_change()

    def _note(self, sample: Sample) -> None:
        came, delay = time.monotonic_ns(), time.time_ns() - sample.stamp
        least, greatest = self.delays if self.count else (delay, delay)
        self.delays = min(least, delay), max(greatest, delay)
        self._came = self._came[0] if self.count else came, came
        self.stands_still = self.stands_still and self.last_stamp in (None, sample.stamp)
        self.last_stamp, self.session = sample.stamp, sample.session
        self.count += 1
        if isinstance(sample, JointState):
            self.ranges.add(sample)


class Ranges:
    """The least and greatest positions of the samples of one writer."""

    def __init__(self) -> None:
        self._kind: object = None
        self._names: tuple[str, ...] | None = None
        self._order = b""
        self._extremes = np.empty((2, 0))

    def add(self, state: JointState) -> None:
        """Include the positions of ``state``; those of another writer or joint order replace all before."""
        positions = from_block(state.positions)
        kind = (state.session, state.order, positions.size)
        if kind != self._kind:
            self._kind, self._names, self._order = kind, state.names, state.order
            self._extremes = np.stack((positions, positions))
        np.fmin(self._extremes[0], positions, out=self._extremes[0])
        np.fmax(self._extremes[1], positions, out=self._extremes[1])

    def positions(self, model: RobotModel) -> NDArray[np.float64]:
        """Two position vectors of ``model``, the least and the greatest; NaN for what the samples lack."""
        wanted = coordinate_names(model)
        names = self._names
        if names is None:
            names = wanted if self._order == order_digest(model.joint_names) else ()
        places = {name: column for column, name in enumerate(names)}
        found = np.full((2, len(wanted)), np.nan)
        for column, name in enumerate(wanted):
            if name in places:
                found[:, column] = self._extremes[:, places[name]]
        return found
