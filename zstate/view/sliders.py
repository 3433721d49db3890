"""Sliders: a robot moved by hand, published at an exact rate.

Dials: one number for each thing that a slider moves, and what they make of a robot's positions.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.suggestions import did_you_mean
from zstate.clock import Clock
from zstate.errors import InvalidInput, SecondWriter
from zstate.model.robot import Joint, RobotModel
from zstate.net.session import Session
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.rate import check_rate
from zstate.se3 import quaternion_from_rpy, rpy_from_quaternion
from zstate.sources.joint_source import JointReading
from zstate.sources.sine import SineSource
from zstate.wire.keys import Stream

Unit = Literal["rad", "m"]
Values = NDArray[np.float64]

_REACH_M = 2.0
"""How far what has no limits may be moved, each way."""

_PLANAR: tuple[tuple[str, Unit, float], ...] = (
    ("x", "m", _REACH_M),
    ("y", "m", _REACH_M),
    ("yaw", "rad", math.pi),
)
_FLOATING: tuple[tuple[str, Unit, float], ...] = (
    ("x", "m", _REACH_M),
    ("y", "m", _REACH_M),
    ("z", "m", _REACH_M),
    ("roll", "rad", math.pi),
    ("pitch", "rad", math.pi / 2),
    ("yaw", "rad", math.pi),
)


@dataclass(frozen=True, slots=True)
class SliderSpec:
    """A number between ``lower`` and ``upper`` [rad] or [m]: a joint's, or one of several of a joint.

    Where the model states no limit it is a turn each way, or 2 m.
    """

    name: str
    unit: Unit
    lower: float
    upper: float


class SliderMapping:
    """The dials of a robot; a floating joint has six, of which three are roll, pitch and yaw."""

    def __init__(self, model: RobotModel) -> None:
        self.dials = tuple(dial for joint in model.driven_joints for dial in _dials(joint))
        self.lower = np.array([dial.lower for dial in self.dials])
        self.upper = np.array([dial.upper for dial in self.dials])
        self._model = model
        plain: list[tuple[int, int]] = []
        self._floating: list[tuple[int, int]] = []
        row = 0
        for joint in model.driven_joints:
            column, count = model.columns[joint.name], len(list(_dials(joint)))
            if joint.type == "floating":
                self._floating.append((row, column))
            else:
                plain += [(row + step, column + step) for step in range(count)]
            row += count
        self._rows, self._columns = np.array(plain, dtype=np.intp).reshape(-1, 2).T

    def positions(self, values: Values) -> Values:
        """The robot's positions, in the order of its ``joint_names``, for one value per dial."""
        positions = np.empty(self._model.position_count)
        positions[self._columns] = values[self._rows]
        for row, column in self._floating:
            x, y, z, roll, pitch, yaw = values[row : row + 6].tolist()
            positions[column : column + 7] = (x, y, z, *quaternion_from_rpy(roll, pitch, yaw))
        return positions

    def values(self, positions: Values) -> Values:
        """What the dials show of ``positions``, whether or not that is within their limits."""
        values = np.empty(len(self.dials))
        values[self._rows] = positions[self._columns]
        for row, column in self._floating:
            x, y, z, qx, qy, qz, qw = positions[column : column + 7].tolist()
            values[row : row + 6] = (x, y, z, *rpy_from_quaternion((qx, qy, qz, qw)))
        return values


def _dials(joint: Joint) -> Iterator[SliderSpec]:
    if joint.type in ("planar", "floating"):
        for part, unit, reach in _PLANAR if joint.type == "planar" else _FLOATING:
            yield SliderSpec(f"{joint.name}.{part}", unit, -reach, reach)
        return
    unit: Unit = "m" if joint.type == "prismatic" else "rad"
    reach = _REACH_M if unit == "m" else math.pi
    lower, upper = joint.limits.lower, joint.limits.upper
    if joint.type == "continuous":
        lower, upper = -math.inf, math.inf
    if not math.isfinite(lower):
        lower = -reach if not math.isfinite(upper) else upper - 2.0 * reach
    yield SliderSpec(joint.name, unit, lower, upper if math.isfinite(upper) else lower + 2.0 * reach)


_JOIN_WITHIN_S = 1.0


class SliderPublisher(Closeable):
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
        self.dials = SliderMapping(model)
        self.refusal = ""
        """Why nothing is published; empty while it is."""
        self._session = session
        self._wires = wires
        self._clock = clock
        self._rate_hz = check_rate(rate_hz)
        self._lock = fork_safe_lock()
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
            except _RateChanged:
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


class _RateChanged(Exception):
    """The rate was changed."""


class _Readings:
    """What the sliders read, until their rate is another one."""

    def __init__(self, sliders: SliderPublisher, rate_hz: float) -> None:
        self._sliders = sliders
        self._rate_hz = rate_hz

    def read(self, stamp: int) -> JointReading:
        if self._sliders.rate_hz != self._rate_hz:
            raise _RateChanged
        return self._sliders.read(stamp)


def _refusal(error: SecondWriter) -> str:
    first = error.first
    since = datetime.fromtimestamp(first.since // 1_000_000_000).astimezone()
    who, what = f"{first.program}@{first.host} pid {first.pid}", f"{error.stream} of {error.robot!r}"
    return f"{who} writes {what} since {since:%Y-%m-%d %H:%M:%S}; end that first, then try again"
