"""Commands to the program that owns a robot's hardware, within limits. Not a safety-rated channel."""

from typing import TYPE_CHECKING

from zstate._util.lazy_names import lazy_names

if TYPE_CHECKING:
    from zstate.driving.commander import Commander
    from zstate.driving.driver import Calibration, Driver, Setpoint
    from zstate.driving.driver_state import DriverReport
    from zstate.driving.errors import DriverFault, MotionRefused, MotionTimeout
    from zstate.driving.host import DriverHost
    from zstate.driving.limits import Limits
    from zstate.driving.motion import Motion, Outcome
    from zstate.driving.setpoint_limiter import SetpointLimiter
    from zstate.driving.simulated_driver import SimulatedDriver
    from zstate.driving.stops import stop

__all__ = [
    "Calibration",
    "Commander",
    "Driver",
    "DriverFault",
    "DriverHost",
    "DriverReport",
    "Limits",
    "Motion",
    "MotionRefused",
    "MotionTimeout",
    "Outcome",
    "Setpoint",
    "SetpointLimiter",
    "SimulatedDriver",
    "stop",
]

_HOMES = {
    "Calibration": "driver",
    "Commander": "commander",
    "Driver": "driver",
    "DriverFault": "errors",
    "DriverHost": "host",
    "DriverReport": "driver_state",
    "Limits": "limits",
    "Motion": "motion",
    "MotionRefused": "errors",
    "MotionTimeout": "errors",
    "Outcome": "motion",
    "Setpoint": "driver",
    "SetpointLimiter": "setpoint_limiter",
    "SimulatedDriver": "simulated_driver",
    "stop": "stops",
}

if not TYPE_CHECKING:  # type checkers would take any name for one of the package
    __getattr__ = lazy_names(__name__, _HOMES)


def __dir__() -> list[str]:
    return __all__
