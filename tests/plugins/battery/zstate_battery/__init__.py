"""A package that adds a stream and a command to zstate."""

from zstate.plugins import Plugin
from zstate.streams import StampedMessage, Stream


class Battery(StampedMessage, frozen=True, array_like=True, gc=False):
    """The state of a battery."""

    voltage: float  # [V]
    charge: float  # 0 to 1


BATTERY = Stream("battery", Battery, named=True, summary="voltage and charge of a battery")
PLUGIN = Plugin(
    "battery",
    streams=(BATTERY,),
    commands={"battery": "zstate_battery.cli:battery_command"},
    checks="zstate_battery.checks:BatteryChecks",
)
