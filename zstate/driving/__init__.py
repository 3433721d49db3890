"""Commands to the program that owns a robot's hardware, within limits. Not a safety-rated channel."""

from zstate.driving.commander import Commander
from zstate.driving.driver import Calibration, Driver, Setpoint
from zstate.driving.driver_state import DriverReport
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
    "DriverHost",
    "DriverReport",
    "Limits",
    "Motion",
    "Outcome",
    "Setpoint",
    "SetpointLimiter",
    "SimulatedDriver",
    "stop",
]
