"""Sliders that move a robot: as its joint states, like joint_state_publisher_gui, or by its driver."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate._util.format import did_you_mean
from zstate.clock import Clock
from zstate.driving import Commander, stop
from zstate.driving.driver_state import DriverStateListener, ReceivedState
from zstate.errors import InvalidInput, SecondWriter, ZStateError
from zstate.model.robot import POSITION_COUNTS, Joint, RobotModel
from zstate.net.session import Session
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.rate import check_rate
from zstate.se3 import quaternion_from_rpy, rpy_from_quaternion
from zstate.sources.joint_source import JointReading, SineSource

Unit = Literal["rad", "m", "rad/s", "m/s"]
Values = NDArray[np.float64]

_REACH_M = 2.0
"""Range of a coordinate without limits, each way."""
_JOIN_TIMEOUT_S = 1.0
_SEND_PERIOD_S = 0.05
_SILENT_S = 2.0
"""A driver that is silent for so long has lost its connection, or a busy machine was this busy."""

_FLOATING: tuple[tuple[str, Unit, float], ...] = (
    ("x", "m", _REACH_M),
    ("y", "m", _REACH_M),
    ("z", "m", _REACH_M),
    ("roll", "rad", math.pi),
    ("pitch", "rad", math.pi / 2),
    ("yaw", "rad", math.pi),
)
_PLANAR = (*_FLOATING[:2], _FLOATING[5])


@dataclass(frozen=True, slots=True)
class SliderSpec:
    """A value between ``lower`` and ``upper``: a joint's position, coordinate or velocity in ``unit``.

    A limit that the model lacks is half a turn each way, or 2 m.
    """

    name: str
    unit: Unit
    lower: float
    upper: float


class SliderMapping:
    """Maps slider values to joint positions; a floating joint has six sliders, three of them for its rpy."""

    def __init__(self, model: RobotModel) -> None:
        self._model = model
        specs: list[SliderSpec] = []
        plain: list[tuple[int, int]] = []
        self._floating: list[tuple[int, int]] = []
        for joint in model.driven_joints:
            row, column = len(specs), model.columns[joint.name]
            specs += _slider_specs(joint)
            if joint.type == "floating":
                self._floating.append((row, column))
            else:
                plain += [(k, column + k - row) for k in range(row, len(specs))]
        self.specs = tuple(specs)
        self.lower = np.array([spec.lower for spec in specs])
        self.upper = np.array([spec.upper for spec in specs])
        self._rows, self._columns = np.array(plain, dtype=np.intp).reshape(-1, 2).T

    def positions(self, values: Values) -> Values:
        """The positions, in the order of the model's ``joint_names``, of one value per slider."""
        positions = np.empty(self._model.position_count)
        positions[self._columns] = values[self._rows]
        for row, column in self._floating:
            x, y, z, roll, pitch, yaw = values[row : row + 6].tolist()
            positions[column : column + 7] = (x, y, z, *quaternion_from_rpy(roll, pitch, yaw))
        return positions

    def values(self, positions: Values) -> Values:
        """The slider values of ``positions``, within the limits or not."""
        values = np.empty(len(self.specs))
        values[self._rows] = positions[self._columns]
        for row, column in self._floating:
            x, y, z, qx, qy, qz, qw = positions[column : column + 7].tolist()
            values[row : row + 6] = (x, y, z, *rpy_from_quaternion((qx, qy, qz, qw)))
        return values


def _slider_specs(joint: Joint) -> list[SliderSpec]:
    parts = {"planar": _PLANAR, "floating": _FLOATING}.get(joint.type)
    if parts is not None:
        return [SliderSpec(f"{joint.name}.{part}", unit, -reach, reach) for part, unit, reach in parts]
    unit: Unit = "m" if joint.type == "prismatic" else "rad"
    reach = _REACH_M if unit == "m" else math.pi
    lower, upper = joint.limits.lower, joint.limits.upper
    if joint.type == "continuous":
        lower, upper = -math.inf, math.inf
    if not math.isfinite(lower):
        lower = -reach if not math.isfinite(upper) else upper - 2.0 * reach
    return [SliderSpec(joint.name, unit, lower, upper if math.isfinite(upper) else lower + 2.0 * reach)]


def velocity_specs(model: RobotModel) -> tuple[SliderSpec, ...]:
    """Sliders of the velocities of joints with one position, [rad/s] or [m/s], within finite limits."""
    return tuple(
        SliderSpec(joint.name, unit, -limit, limit)
        for joint in model.driven_joints
        if POSITION_COUNTS[joint.type] == 1 and math.isfinite(limit := joint.limits.velocity)
        for unit in ("m/s" if joint.type == "prismatic" else "rad/s",)
    )


class SliderPublisher(Closeable):
    """Publishes the slider values of ``robot`` ``rate_hz`` times a second.

    It publishes the model too, unless another program does, and starts at ``home``. If another program writes
    the robot's ``joint_states``, at the start or later, nothing is published and ``conflict`` names that
    program; ``open`` tries again. Any thread may call.
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
        self.mapping = SliderMapping(model)
        self.values = self.mapping.values(model.neutral)
        """The slider values, [rad] or [m], in the order of ``mapping.specs``; replaced when they change."""
        self.conflict = ""
        """Why nothing is published; empty while it is."""
        self._session = session
        self._wires = wires
        self._clock = clock
        self._rate_hz = self._kept_hz = check_rate(rate_hz)
        self._lock = fork_safe_lock()
        self._sine: SineSource | None = None
        self._publisher: StatePublisher | None = None
        self._thread: threading.Thread | None = None
        self._closed = False
        self.open()

    def open(self) -> bool:
        """Start to publish, unless another program does; whether it is published now."""
        with self._lock:
            if self._closed or self._publisher is not None:
                return self._publisher is not None
            try:
                publisher = self._publisher = self._open_publisher()
            except SecondWriter as error:
                self.conflict = _conflict_text(error)
                return False
            self.conflict = ""
            self._thread = threading.Thread(
                target=self._run, args=(publisher,), name="zstate sliders", daemon=True
            )
            self._thread.start()
            return True

    def _open_publisher(self) -> StatePublisher:
        """All streams; only joint states if another program publishes the model and waits for them."""
        options = (self._session, self.model, self.robot, self._wires)
        try:
            return StatePublisher(*options, streams=STREAMS, clock=self._clock)
        except SecondWriter as error:
            if error.stream == "joint_states":
                raise
        return StatePublisher(*options, streams=("joint_states",), clock=self._clock)

    def _run(self, publisher: StatePublisher) -> None:
        conflict = ""
        while True:
            self._kept_hz = self._rate_hz
            try:
                publisher.run(self, self._kept_hz)
            except _RateChanged:
                continue
            except SecondWriter as error:
                conflict = _conflict_text(error)
            break
        publisher.close()
        with self._lock:
            if self._publisher is publisher:
                self._publisher, self.conflict = None, conflict

    @property
    def rate_hz(self) -> float:
        """The publishing rate. May be set; raises InvalidInput for a rate that cannot be kept."""
        return self._rate_hz

    @rate_hz.setter
    def rate_hz(self, rate_hz: float) -> None:
        self._rate_hz = check_rate(rate_hz)

    @property
    def achieved_hz(self) -> float | None:
        """The rate that is achieved; None while nothing is published."""
        publisher = self._publisher
        report = None if publisher is None else publisher.stats.rate
        return None if report is None else report.rate_hz

    @property
    def positions(self) -> Values:
        """The joint positions, in the order of the model's ``joint_names``."""
        return self.mapping.positions(self.values)

    @property
    def mimics(self) -> dict[str, float]:
        """The positions of the mimic joints [rad] or [m]."""
        model, positions = self.model, self.positions
        mimics: dict[str, float] = {}
        for joint in model.joints:
            if joint.mimic and joint.type != "fixed":
                mimic = model.mimic_of(joint)
                position = float(positions[model.columns[mimic.joint]])
                mimics[joint.name] = mimic.multiplier * position + mimic.offset
        return mimics

    def set(self, name: str, value: float) -> None:
        """Set the slider ``name`` to ``value`` [rad] or [m], and stop the sine.

        Raises InvalidInput for an unknown name, and beyond the limits.
        """
        names = [spec.name for spec in self.mapping.specs]
        if name not in names:
            raise InvalidInput(f"{self.robot!r} has no slider {name!r}{did_you_mean(name, names)}")
        spec = self.mapping.specs[names.index(name)]
        if not spec.lower <= value <= spec.upper:
            raise InvalidInput(
                f"{name!r} takes {spec.lower:.6g} to {spec.upper:.6g} {spec.unit}, not {value:.6g}"
            )
        with self._lock:
            values = self.values.copy()
            values[names.index(name)] = value
            self.values, self._sine = values, None

    def home(self) -> None:
        """Set all joints to zero, or to the middle of their limits if zero is outside."""
        self._set_all(self.mapping.values(self.model.neutral))

    def zero(self) -> None:
        """Set all joints to zero, or to the nearest limit."""
        self._set_all(np.clip(0.0, self.mapping.lower, self.mapping.upper))

    def random(self, generator: np.random.Generator | None = None) -> None:
        """Set all joints to random positions within their limits."""
        generator = generator or np.random.default_rng()
        self._set_all(generator.uniform(self.mapping.lower, self.mapping.upper))

    def _set_all(self, values: Values) -> None:
        with self._lock:
            self.values, self._sine = values, None

    @property
    def sine_enabled(self) -> bool:
        """Whether every joint follows a sine, as of `zstate joints`. May be set."""
        return self._sine is not None

    @sine_enabled.setter
    def sine_enabled(self, enabled: bool) -> None:
        with self._lock:
            if enabled != (self._sine is not None):
                self._sine = SineSource(self.model) if enabled else None

    def read(self, stamp: int) -> JointReading:
        """The joint positions to publish at ``stamp`` [ns]."""
        if self._rate_hz != self._kept_hz:
            raise _RateChanged
        with self._lock:
            if self._sine is None:
                return JointReading(self.positions)
            reading = self._sine.read(stamp)
            self.values = self.mapping.values(reading.positions)
            return reading

    def close(self) -> None:
        """Stop publishing. A second call does nothing."""
        with self._lock:
            self._closed = True
            publisher, thread = self._publisher, self._thread
        if publisher is not None:
            publisher.close()
        if thread is not None and thread is not threading.current_thread():
            thread.join(_JOIN_TIMEOUT_S)


class _RateChanged(Exception):
    """Ends the loop of the publisher, to start it with another rate."""


def _conflict_text(error: SecondWriter) -> str:
    first = error.first
    since = datetime.fromtimestamp(first.since // 1_000_000_000).astimezone()
    program = f"{first.program}@{first.host} pid {first.pid}"
    return (
        f"{program} has written {error.stream} of {error.robot!r} since {since:%Y-%m-%d %H:%M:%S}; "
        "stop it, then try again"
    )


@dataclass(eq=False)
class _Control:
    """The time from taking control by the browser ``client`` to its end.

    Commands are sent every ``period_s`` [s]. ``stops`` are those that were latched before.
    """

    client: int
    commander: Commander
    period_s: float
    driver_session: int
    stops: set[tuple[int, int]]
    targets: dict[str, float] = field(default_factory=dict[str, float])
    ended: threading.Event = field(default_factory=threading.Event)


class SliderCommander(Closeable):
    """Sends slider values to the driver of ``robot`` while one browser has control of it.

    Browsers have numbers, as in viser. Control begins with ``take_control``, and nothing is sent until that
    browser calls ``set``: from then on that joint's position is sent, again and again, and no other's. A
    driver that takes no positions, such as that of wheels, is sent velocities instead.
    Control ends with ``release_control`` or ``stop``, which are open to every browser, and by itself once
    ``is_answering(client)`` is False, if the driver is stopped, ends, restarts or is silent, or a command
    cannot be sent; ``problem`` is why. However it ends, the driver brakes, and holds the joints once the last
    command has expired. Any thread may call. Not a safety-rated channel.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        states: DriverStateListener,
        is_answering: Callable[[int], bool],
    ) -> None:
        self.robot = robot
        self.problem = ""
        """Why control has ended, or could not be taken or a stop not be confirmed; else empty."""
        self._session = session
        self._states = states
        self._is_answering = is_answering
        self._lock = fork_safe_lock()
        self._control: _Control | None = None
        self._thread: threading.Thread | None = None
        self._closed = False
        self._stopper = ThreadPoolExecutor(1, "zstate stop button")
        self._stop_is_queued = False

    @property
    def has_control(self) -> bool:
        """Whether moved sliders command the driver."""
        control = self._control
        return control is not None and not control.ended.is_set()

    @property
    def targets(self) -> dict[str, float]:
        """The positions [rad] or [m], or the velocities, that are sent, by joint."""
        control = self._control
        return {} if control is None or control.ended.is_set() else control.targets

    def take_control(self, client: int) -> bool:
        """Become the robot's commander for ``client``; whether it has control now. Waits up to some seconds.

        Does nothing while another browser has control.
        """
        with self._lock:
            if self.has_control or self._closed:
                return self._control_of(client) is not None
            self._join()
            self.problem = ""
            try:
                control = self._control = self._open_control(client)
            except ZStateError as error:
                self.problem = str(error)
                return False
            self._thread = threading.Thread(
                target=self._run, args=(control,), name="zstate slider commands", daemon=True
            )
            self._thread.start()
            return True

    def _control_of(self, client: int) -> _Control | None:
        """The control that ``client`` has now."""
        control = self._control
        has_control = control is not None and control.client == client and not control.ended.is_set()
        return control if has_control else None

    def _open_control(self, client: int) -> _Control:
        with ExitStack() as opening:
            commander = opening.enter_context(Commander(self._session, self.robot, program="zstate view"))
            state = commander.wait_for_driver()
            opening.pop_all()
        period_s = min(_SEND_PERIOD_S, 0.25e-9 * state.ttl)
        return _Control(client, commander, period_s, state.session, set(state.stops))

    def set(self, client: int, name: str, value: float) -> None:
        """Send ``value`` of the joint ``name`` from now on: its position [rad] or [m], or its velocity.

        Does nothing unless ``client`` has control, and while the driver is stopped.
        """
        control, received = self._control_of(client), self._states.get(self.robot)
        if control is not None and received is not None and received.state.state != "stopped":
            control.targets = {**control.targets, name: value}

    def release_control(self) -> None:
        """Send no more. Does not wait for the driver."""
        control = self._control
        if control is not None and not control.ended.is_set():
            self.problem = ""
            control.ended.set()

    def stop(self) -> None:
        """End control, and stop the driver until ``release_stops``. Waits up to a second for its reply."""
        self.release_control()
        self.problem = ""
        try:
            stop(self._session, self.robot, "the stop button of a page of zstate view")
        except ZStateError as error:
            self.problem = str(error)

    def request_stop(self) -> None:
        """``stop`` in a thread of its own, which nothing else delays; one thread calls this.

        Requests while a stop is under way are one more stop, after it.
        """
        self.release_control()
        if not self._stop_is_queued and not self._closed:
            self._stop_is_queued = True
            self._stopper.submit(self._stop_once)

    def _stop_once(self) -> None:
        self._stop_is_queued = False
        self.stop()

    def release_stops(self, client: int) -> None:
        """Release the stops of the driver. Nothing moves by that. Waits up to some seconds.

        Does nothing unless ``client`` has control.
        """
        control = self._control_of(client)
        if control is not None:
            try:
                control.commander.release()
            except ZStateError as error:
                self.problem = str(error)

    def close(self) -> None:
        """End control. A second call does nothing."""
        self.release_control()
        with self._lock:
            self._closed = True
            self._join()
        self._stopper.shutdown(wait=False)

    def _join(self) -> None:
        if self._thread is not None:
            self._thread.join(_JOIN_TIMEOUT_S)

    def _run(self, control: _Control) -> None:
        with control.commander:
            try:
                while not control.ended.is_set():
                    problem = self._send(control)
                    if problem:
                        self.problem = f"control has ended: {problem}"
                        control.ended.set()
                    control.ended.wait(control.period_s)
            except Exception as error:  # whatever fails here, the page must not show that it is in control
                self.problem = f"control has ended: {type(error).__name__}: {error}"
            finally:
                control.ended.set()

    def _send(self, control: _Control) -> str:
        """Send the targets, if browser and driver are as when control began. Returns why control ends."""
        if not self._is_answering(control.client):
            return "the browser that had taken control has left the page or does not answer"
        received = self._states.get(self.robot)
        problem = _problem_of(received, control)
        if problem or received is None or received.state.state == "stopped" or not control.targets:
            return problem
        try:
            if "position" in received.state.modes:
                control.commander.send(control.targets)
            else:
                control.commander.send(velocities=control.targets)
        except ZStateError as error:
            return str(error)
        return ""


def _problem_of(received: ReceivedState | None, control: _Control) -> str:
    """Why the driver must not be commanded any more; empty if it may."""
    if received is None or received.age_s > _SILENT_S:
        return "the driver has published no state for a while"
    state = received.state
    if state.session != control.driver_session:
        return "the driver has restarted"
    has_new_stop = not control.stops.issuperset(state.stops)
    return str(received) if has_new_stop or state.state in ("off", "fault") else ""
