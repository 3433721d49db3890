"""Sliders: a robot moved by hand, published at an exact rate."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from datetime import datetime

import numpy as np

from zstate._util.suggestions import did_you_mean
from zstate.clock import Clock
from zstate.closing import Closing
from zstate.errors import InvalidInput, SecondWriter
from zstate.locks import new_lock
from zstate.model.robot import RobotModel
from zstate.net.session import Session
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.rate import check_rate
from zstate.sources.sine import SineSource
from zstate.sources.source import JointReading
from zstate.view.dials import Dials, Values
from zstate.wire.keys import Stream

_JOIN_WITHIN_S = 1.0


class Sliders(Closing):
    """Publishes ``robot`` as its dials stand, and its model where nobody else does.

    It says so exactly ``rate_hz`` times a second. It begins at home: see ``home``. Where somebody else
    writes the robot's ``joint_states``, at the beginning or later, nothing is published and ``refusal``
    says who that is; ``open`` tries again. A context manager; any thread may call.
    """

    def __init__(
        self,
        session: Session,
        model: RobotModel,
        robot: str | None = None,
        *,
        rate_hz: float = 50.0,
        wires: Sequence[str] = ("native",),
        clock: Clock | None = None,
    ) -> None:
        self.model = model
        self.robot = robot or model.name
        self.dials = Dials(model)
        self.refusal = ""
        """Why nothing is published; empty while it is."""
        self._session = session
        self._wires = wires
        self._clock = clock
        self._rate_hz = check_rate(rate_hz)
        self._lock = new_lock()
        self._values = self.dials.values(model.neutral)
        self._motion: SineSource | None = None
        self._publisher: StatePublisher | None = None
        self._thread: threading.Thread | None = None
        self._closed = False
        self.open()

    def open(self) -> bool:
        """Begin to publish, unless somebody else does; whether it is published now."""
        with self._lock:
            if self._closed or self._publisher is not None:
                return self._publisher is not None
            try:
                self._publisher = self._opened()
            except SecondWriter as error:
                self.refusal = _refusal(error)
                return False
            self.refusal = ""
            self._thread = threading.Thread(
                target=self._run, args=(self._publisher,), name="zstate sliders", daemon=True
            )
            self._thread.start()
            return True

    def _opened(self) -> StatePublisher:
        try:
            return self._publishing(STREAMS)
        except SecondWriter as error:
            if error.stream == "joint_states":
                raise
        # Another program tells of the model, and waits for somebody to move its joints.
        return self._publishing(("joint_states",))

    def _publishing(self, streams: Sequence[Stream]) -> StatePublisher:
        return StatePublisher(
            self._session, self.model, self.robot, self._wires, streams=streams, clock=self._clock
        )

    def _run(self, publisher: StatePublisher) -> None:
        refusal = ""
        while True:
            try:
                publisher.run(_Readings(self, self._rate_hz), self._rate_hz)
            except _AnotherRate:
                continue
            except SecondWriter as error:
                refusal = _refusal(error)
            break
        publisher.close()
        with self._lock:
            if self._publisher is publisher:
                self._publisher, self.refusal = None, refusal

    @property
    def rate_hz(self) -> float:
        """How often it is published, exactly. Raises InvalidInput for a rate that cannot be kept."""
        return self._rate_hz

    @rate_hz.setter
    def rate_hz(self, rate_hz: float) -> None:
        self._rate_hz = check_rate(rate_hz)

    @property
    def achieved_hz(self) -> float | None:
        """What is achieved at the present rate; None while nothing is published."""
        publisher = self._publisher
        report = None if publisher is None else publisher.stats.rate
        return None if report is None else report.rate_hz

    @property
    def values(self) -> Values:
        """How the dials stand, [rad] or [m]: one number for each of ``dials.dials``."""
        return self._values.copy()

    @property
    def positions(self) -> Values:
        """The same as positions, in the order of the model's ``joint_names``."""
        return self.dials.positions(self._values)

    @property
    def mimics(self) -> dict[str, float]:
        """Where the joints are that follow others [rad] or [m]."""
        model, positions = self.model, self.positions
        followed = {
            joint.name: model.mimic_of(joint)
            for joint in model.joints
            if joint.mimic and joint.type != "fixed"
        }
        return {
            name: mimic.multiplier * float(positions[model.columns[mimic.joint]]) + mimic.offset
            for name, mimic in followed.items()
        }

    def set(self, name: str, value: float) -> None:
        """Turn the dial ``name`` to ``value`` [rad] or [m], which ends a sine.

        Raises InvalidInput for a name that is not there, and beyond the limits.
        """
        names = [dial.name for dial in self.dials.dials]
        if name not in names:
            raise InvalidInput(f"{self.robot!r} has no slider {name!r}{did_you_mean(name, names)}")
        dial = self.dials.dials[names.index(name)]
        if not dial.lower <= value <= dial.upper:
            raise InvalidInput(
                f"{name!r} takes {dial.lower:.6g} to {dial.upper:.6g} {dial.unit}, not {value:.6g}"
            )
        with self._lock:
            values = self._values.copy()
            values[names.index(name)] = value
            self._values, self._motion = values, None

    def home(self) -> None:
        """All joints to zero, or to the middle of their limits where zero is outside them."""
        self._rest_at(self.dials.values(self.model.neutral))

    def zero(self) -> None:
        """All joints to zero, or to the limit that is nearest to it."""
        self._rest_at(np.clip(0.0, self.dials.lower, self.dials.upper))

    def random(self, generator: np.random.Generator | None = None) -> None:
        """All joints to anywhere between their limits."""
        generator = generator or np.random.default_rng()
        self._rest_at(generator.uniform(self.dials.lower, self.dials.upper))

    def _rest_at(self, values: Values) -> None:
        with self._lock:
            self._values, self._motion = values, None

    @property
    def is_swinging(self) -> bool:
        """Whether every joint swings: a sine, as `zstate joints` makes one. May be set."""
        return self._motion is not None

    @is_swinging.setter
    def is_swinging(self, swings: bool) -> None:
        with self._lock:
            if swings != (self._motion is not None):
                self._motion = SineSource(self.model) if swings else None

    def read(self, stamp: int) -> JointReading:
        """How the joints are published at ``stamp`` [ns]."""
        with self._lock:
            if self._motion is None:
                return JointReading(self.dials.positions(self._values))
            reading = self._motion.read(stamp)
            self._values = self.dials.values(reading.positions)
            return reading

    def close(self) -> None:
        """Publish no more. A second call does nothing."""
        with self._lock:
            self._closed = True
            publisher, thread = self._publisher, self._thread
        if publisher is not None:
            publisher.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join(_JOIN_WITHIN_S)


class _AnotherRate(Exception):
    """The rate was changed."""


class _Readings:
    """What the sliders read, until their rate is another one."""

    def __init__(self, sliders: Sliders, rate_hz: float) -> None:
        self._sliders = sliders
        self._rate_hz = rate_hz

    def read(self, stamp: int) -> JointReading:
        if self._sliders.rate_hz != self._rate_hz:
            raise _AnotherRate
        return self._sliders.read(stamp)


def _refusal(error: SecondWriter) -> str:
    first = error.first
    since = datetime.fromtimestamp(first.since // 1_000_000_000).astimezone()
    who, what = f"{first.program}@{first.host} pid {first.pid}", f"{error.stream} of {error.robot!r}"
    return f"{who} writes {what} since {since:%Y-%m-%d %H:%M:%S}; end that first, then try again"
