"""The supervision of a driver: its calls, stops until they succeed, and whether its joints follow."""

from __future__ import annotations

import logging
import time

import numpy as np
from numpy.typing import NDArray

from zstate.driving.driver import Driver, Setpoint, StopMode
from zstate.driving.driver_state import Durations
from zstate.driving.limits import Limits
from zstate.errors import InvalidInput, format_duration
from zstate.sources import JointReading

_LOG = logging.getLogger("zstate")


class SupervisedDriver:
    """Calls the ``driver`` of ``robot``; methods return the exception of a call that failed. For one thread.

    A stop that failed is pending until a call of ``repeat_stop`` succeeds. Joints that were relaxed stay so
    until they are enabled: "hold" would give them torque again.
    """

    def __init__(self, driver: Driver, robot: str) -> None:
        self._driver = driver
        self._robot = robot
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
        """Switch off power and brakes, before the driver is closed."""
        self.repeat_stop()
        try:
            self._driver.enable(False)
        except Exception as error:
            _LOG.error("enable(False) of the driver of %r failed: %r", self._robot, error)


class FollowingCheck:
    """Compares setpoints of the joints of ``limits`` with readings; instants are monotonic [ns].

    A joint may be ``most`` [rad] or [m] from its setpoint, and a reading ``oldest_ns`` old. Raises
    InvalidInput unless ``most`` is above zero.
    """

    def __init__(self, limits: Limits, most: float, oldest_ns: int) -> None:
        if not most > 0.0:
            raise InvalidInput(f"following_error is a distance above zero, not {most!r}")
        self._limits = limits
        self._most = most
        self._oldest_ns = oldest_ns
        self._setpoint: NDArray[np.float64] | None = None
        self._written_at = 0

    def written(self, positions: NDArray[np.float64], now: int) -> None:
        """``positions``, (n,), have been written at ``now``."""
        self._setpoint, self._written_at = positions, now

    def stopped(self) -> None:
        """The joints are not commanded any more."""
        self._setpoint = None

    def deviation(self, measured: NDArray[np.float64], measured_at: int, now: int) -> str:
        """Why the joints, which were ``measured`` last, do not follow; empty if they do."""
        if self._setpoint is None:
            return ""
        if now - measured_at > self._oldest_ns:
            return f"there is no new reading of the joints for {format_duration(now - measured_at)}"
        if measured_at < self._written_at:
            return ""
        errors = np.abs(measured - self._setpoint)
        row = int(errors.argmax())
        if errors[row] <= self._most:
            return ""
        name, unit = self._limits.joint_names[row], self._limits.units[row]
        return (
            f"{name!r} is {errors[row]:.3g} {unit} from its setpoint, more than "
            f"following_error={self._most:g}; has it power, and is it free to move?"
        )


def check_arguments(
    driver: Driver, limits: Limits, names: tuple[str, ...], on_silence: str, faults_allowed: int
) -> None:
    """Raise InvalidInput with all problems."""
    problems: list[str] = []
    if "position" not in driver.modes:
        problems.append(f"the driver takes setpoints of {', '.join(sorted(driver.modes))}, not of positions")
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
