"""The calls of a host to its driver: timed, failures returned, and stops repeated until they succeed."""

from __future__ import annotations

import logging
import time

from zstate.driving.driver import Driver, Setpoint, StopMode
from zstate.driving.driver_state import Durations
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
        self._pending = "relax" if self._is_relaxed or self._pending == "relax" else how
        return self.repeat_stop()

    def repeat_stop(self) -> Exception | None:
        """Call the stop that is pending, if any."""
        if self._pending is None:
            return None
        try:
            self._driver.stop(self._pending)
        except Exception as error:
            _LOG.error("stop(%r) of the driver of %r failed: %r", self._pending, self._robot, error)
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
