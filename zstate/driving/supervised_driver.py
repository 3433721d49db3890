"""The supervision of a driver: its calls, stops until they succeed, and whether its joints follow."""

from __future__ import annotations

import logging
import time

import numpy as np
from numpy.typing import NDArray

from zstate.driving.driver import Driver, Mode, Setpoint, StopMode
from zstate.driving.driver_state import Durations
from zstate.driving.limits import Limits
from zstate.driving.setpoint_limiter import Limited
from zstate.errors import InvalidInput, format_duration
from zstate.sources import JointReading

_LOG = logging.getLogger("zstate")

_TRAVEL_NS = 1_000_000_000
_TRAVEL_SHARE = 0.25
_LONGEST_GAP_NS = 300_000_000
_LAG_S = 0.1
"""Joints in mode "velocity" are compared each second; they may differ by a share of the way, and a lag.

After a longer gap between two setpoints the comparison begins again: up to that, the share and the lag
cover a device that stops by itself in the gap.
"""


class SupervisedDriver:
    """Calls the ``driver`` of ``robot``; methods return the exception of a call that failed. For one thread.

    A stop that failed is pending until a call of ``repeat_stop`` succeeds. Joints that were relaxed stay so
    until they are enabled: "hold" would give them torque again.
    """

    def __init__(self, driver: Driver, robot: str) -> None:
        self._driver = driver
        self._robot = robot
        self.modes = driver.modes
        self._is_relaxed = False
        self._pending: StopMode | None = None
        self.is_enabled = False
        """Whether setpoints may be written."""
        self.needs_stop = False
        """Whether the joints may have power, also by an ``enable`` that failed, and have not been stopped."""
        self.written = 0
        self.reading, self.writing = Durations(), Durations()

    @property
    def is_stopping(self) -> bool:
        """Whether a stop has failed and is to be repeated."""
        return self._pending is not None

    def enable(self) -> Exception | None:
        """Switch on power and brakes."""
        self.needs_stop = True
        self._is_relaxed = False
        try:
            self._driver.enable(True)
        except Exception as error:
            return error
        self.is_enabled = True
        return None

    def read(self, stamp: int) -> JointReading | Exception | None:
        """The joints at ``stamp`` [ns], None if there is nothing new, or the failure."""
        start = time.monotonic_ns()
        try:
            return self._driver.read(stamp)
        except Exception as error:
            return error
        finally:
            self.reading.add(time.monotonic_ns() - start)

    def write(self, setpoint: Setpoint) -> Exception | None:
        """Send ``setpoint`` to the hardware."""
        start = time.monotonic_ns()
        try:
            self._driver.write(setpoint)
        except Exception as error:
            return error
        finally:
            self.writing.add(time.monotonic_ns() - start)
        self.written += 1
        return None

    def stop(self, how: StopMode) -> Exception | None:
        """Stop the hardware; "relax" if the joints are relaxed already, or a stop with "relax" is pending."""
        self.is_enabled = False
        is_new = self._pending is None
        self._pending = "relax" if self._is_relaxed or self._pending == "relax" else how
        failure = self.repeat_stop()
        if is_new and failure is not None:
            text = "stop(%r) of the driver of %r failed, and is called until it succeeds: %r"
            _LOG.error(text, self._pending, self._robot, failure)
        return failure

    def repeat_stop(self) -> Exception | None:
        """Call the stop that is pending, if any."""
        if self._pending is None:
            return None
        try:
            self._driver.stop(self._pending)
        except Exception as error:
            return error
        self._is_relaxed = self._pending == "relax"
        self._pending = None
        self.needs_stop = False
        return None

    def disable(self) -> None:
        """Switch off power and brakes, before the driver is closed, whatever it raises."""
        try:
            self.repeat_stop()
        finally:
            try:
                self._driver.enable(False)
            except KeyboardInterrupt:
                raise
            except BaseException as error:  # also SystemExit, which would hide the cause of the end
                _LOG.error("enable(False) of the driver of %r failed: %r", self._robot, error)


class FollowingCheck:
    """Compares setpoints of the joints of ``limits`` with readings; instants are monotonic [ns].

    A joint in mode "position" may be ``most`` [rad] or [m] from its setpoint, and a reading ``oldest_ns``
    old. A joint in mode "velocity" moves each second as far as its setpoints, give or take ``most``, a
    quarter of the way, and 0.1 s of the highest speed, for its lag: without power it does not. Raises
    InvalidInput unless ``most`` is above zero.
    """

    def __init__(self, limits: Limits, most: float, oldest_ns: int) -> None:
        if not most > 0.0:
            raise InvalidInput(f"following_error is a distance above zero, not {most!r}")
        self._limits = limits
        self.most = most
        self.oldest_ns = oldest_ns
        self._setpoint: Limited | None = None
        self._written_at = 0
        self._travel: _Travel | None = None
        """The travel of the joints in mode "velocity" since the last comparison."""

    def written(self, setpoint: Limited, now: int) -> None:
        """``setpoint`` has been written at ``now``."""
        before, elapsed = self._setpoint, now - self._written_at
        if before is None or elapsed > _LONGEST_GAP_NS:
            self._travel = None  # devices stop by themselves in a pause, or move on
        elif self._travel is not None:
            self._travel.add(before, setpoint, elapsed * 1e-9)
        self._setpoint, self._written_at = setpoint, now

    def stopped(self) -> None:
        """The joints are not commanded any more."""
        self._setpoint = self._travel = None

    def deviation(self, measured: NDArray[np.float64], measured_at: int, now: int) -> str:
        """Why the joints, which were ``measured`` last, do not follow; empty if they do."""
        setpoint = self._setpoint
        if setpoint is None:
            return ""
        if now - measured_at > self.oldest_ns:
            return f"there is no new reading of the joints for {format_duration(now - measured_at)}"
        if measured_at < self._written_at:
            return ""
        errors = measured - setpoint.positions
        if self._travel is not None or setpoint.modes.count("position") < len(setpoint.modes):
            errors[[mode != "position" for mode in setpoint.modes]] = 0.0
            if text := self._travel_text(setpoint, measured, now):
                return text
        # Where the norm is within the limit, so is each joint; in a third of the time.
        return "" if errors @ errors <= self.most**2 else self._distance_text(np.abs(errors))

    def _distance_text(self, errors: NDArray[np.float64]) -> str:
        """Which joint is too far from its setpoint, if any."""
        row = int(errors.argmax())
        if errors[row] <= self.most:
            return ""
        name, unit = self._limits.joint_names[row], self._limits.units[row]
        return (
            f"{name!r} is {errors[row]:.3g} {unit} from its setpoint, more than "
            f"following_error={self.most:g}; does it have power, and is it free to move?"
        )

    def _travel_text(self, setpoint: Limited, measured: NDArray[np.float64], now: int) -> str:
        """Why a joint does not follow that has been in mode "velocity", once a second."""
        if now - self._written_at > _LONGEST_GAP_NS:
            self._travel = None
        travel = self._travel
        if travel is None or now - travel.since > _TRAVEL_NS:
            self._travel = _Travel(now, measured, setpoint) if "velocity" in setpoint.modes else None
        if travel is None or now - travel.since <= _TRAVEL_NS:
            return ""
        moved = measured - travel.start
        allowed = self.most + _TRAVEL_SHARE * travel.path + _LAG_S * travel.fastest
        errors = np.abs(moved - travel.commanded) - allowed
        errors[travel.excluded] = 0.0
        row = int(errors.argmax())
        if errors[row] <= 0.0:
            return ""
        name, unit = self._limits.joint_names[row], self._limits.units[row]
        return (
            f"{name!r} has moved by {moved[row]:.3g} {unit} in {format_duration(now - travel.since)}, where "
            f"its velocities add up to {travel.commanded[row]:.3g}; does it have power, is it free to move, "
            "and do its encoder and its motor turn the same way?"
        )


class _Travel:
    """What setpoints add up to since the instant ``since``, at the measured ``start``.

    It goes on when joints change their modes: a change each second would end every comparison.
    """

    def __init__(self, since: int, start: NDArray[np.float64], setpoint: Limited) -> None:
        self.since, self.start = since, start
        self.commanded = np.zeros(len(start))
        self.path = np.zeros(len(start))
        self.fastest = np.zeros(len(start))
        self._turned = _in_mode(setpoint, "velocity")
        self._pushed = _in_mode(setpoint, "effort")

    @property
    def excluded(self) -> NDArray[np.bool_]:
        """The joints that were in mode "effort", or never in mode "velocity": (n,)."""
        return self._pushed | ~self._turned

    def add(self, before: Limited, after: Limited, dt_s: float) -> None:
        """``after`` has been written ``dt_s`` [s] after ``before``."""
        self._turned |= _in_mode(after, "velocity")
        self._pushed |= _in_mode(after, "effort")
        is_placed = _in_mode(before, "position") & _in_mode(after, "position")
        steps = np.where(is_placed, after.positions - before.positions, before.velocities * dt_s)
        self.commanded += steps
        self.path += np.abs(steps)
        np.maximum(self.fastest, np.abs(before.velocities), out=self.fastest)


def _in_mode(setpoint: Limited, mode: Mode) -> NDArray[np.bool_]:
    """Which joints are in ``mode``: (n,)."""
    return np.array([one == mode for one in setpoint.modes])


def check_arguments(
    driver: Driver,
    limits: Limits,
    names: tuple[str, ...],
    *,
    on_silence: str,
    faults_allowed: int,
    ros2_mode: Mode | None,
) -> None:
    """Raise InvalidInput with all problems."""
    problems: list[str] = []
    known = {"position", "velocity", "effort"}
    if not driver.modes or not known.issuperset(driver.modes):
        problems.append(f"the modes of the driver are some of {sorted(known)}, not {sorted(driver.modes)}")
    if ros2_mode is not None and ros2_mode not in driver.modes:
        problems.append(f"ros2_mode={ros2_mode!r} is none of the driver's modes, {sorted(driver.modes)}")
    if limits.joint_names != names:
        problems.append(f"the limits are of {limits.joint_names}, the driver's joints are {names}")
    if on_silence not in ("hold", "relax"):
        problems.append(f"on_silence is 'hold' or 'relax', not {on_silence!r}")
    if unbounded := [name for name, at_most in zip(names, limits.velocity, strict=True) if at_most == np.inf]:
        problems.append(
            f"the velocity of {', '.join(map(repr, unbounded))} has no limit, so that one setpoint could be "
            "the whole way: pass limits=Limits.of(model, velocity=...)"
        )
    if faults_allowed < 1:
        problems.append(f"faults_allowed is at least 1, not {faults_allowed}")
    if problems:
        raise InvalidInput("; ".join(problems))
