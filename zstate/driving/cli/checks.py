"""What doctor checks of drivers: whether they work, who commands them, and how old the commands are."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from zstate.cli.doctor.check import Check, broken, ok, skipped, warning
from zstate.cli.doctor.plugin_checks import PluginChecks, ProbedRobot
from zstate.cli.output.console import count_text
from zstate.driving.driver_state import DriverStateListener, ReceivedState
from zstate.driving.messages import DriverState
from zstate.errors import format_duration
from zstate.net.discovery import RobotInfo
from zstate.net.session import Session
from zstate.wire.identity import WriterId
from zstate.wire.keys import ANY

_MAX_SKIPPED = 0.01
"""The greatest ratio of the skipped to the due ticks of a driver's loop."""


class DriverChecks(PluginChecks):
    """Those of the drivers of ``robots``; nothing for a robot without a driver and a commander."""

    def __init__(
        self, session: Session, robots: Sequence[RobotInfo], wire: str, on_change: Callable[[], object]
    ) -> None:
        super().__init__(session, robots, wire, on_change)
        robot = robots[0].name if len(robots) == 1 else ANY
        # Other wires carry no states of drivers.
        self._drivers = DriverStateListener(session, robot) if wire == "native" else None

    def close(self) -> None:
        if self._drivers is not None:
            self._drivers.close()

    def checks(self, probe: ProbedRobot) -> Iterator[Check]:
        robot, commanders = probe.info.name, probe.writers("joint_commands")
        received = None if self._drivers is None else self._drivers.get(robot)
        if received is None:
            if commanders:
                text = f"{commanders[-1]} commands {robot!r}, which has no driver that publishes its state"
                yield broken("driver", text, "zstate ls  # start the program with its DriverHost")
            return
        yield _driver_check(robot, received)
        if received.is_live and received.state.state not in ("off", "fault"):
            yield _commander_check(robot, received.state, commanders)
            yield _commands_check(received.state)


def _driver_check(robot: str, received: ReceivedState) -> Check:
    """Whether the driver can be commanded, and its loop keeps its rate."""
    state, monitor = received.state, f"zstate monitor --robots --robot {robot}"
    text = f"{state.program}: {received}"
    if state.state == "stopped":
        return broken("driver", text, f"zstate stop {robot} --release  # when it may move again")
    if state.state == "fault":
        return broken("driver", text, f"zstate ls  # restart {state.program}, then release the stop")
    if state.state == "off" or not received.is_live:
        return broken("driver", text, f"zstate ls  # shows whether {state.program} runs")
    text += f"; its loop runs at {state.rate_hz:.1f} Hz"
    if state.faults:
        text += f"; {count_text(state.faults, 'call')} of the driver failed, the first is in its log"
        return warning("driver", text, monitor)
    if state.skipped > _MAX_SKIPPED * (state.ticks + state.skipped):
        due = state.ticks + state.skipped
        text += f", and skipped {state.skipped} of {due} ticks: the driver or the machine is too slow for it"
        return warning("driver", text, monitor)
    return ok("driver", text)


def _commander_check(robot: str, state: DriverState, commanders: Sequence[WriterId]) -> Check:
    """Which program commands the driver, and whether its commands can be used."""
    text = f"none: no program commands {robot!r}"
    if commanders:
        text = f"{commanders[-1]}, which has sent no command yet"
        if state.commander == str(commanders[-1]):
            text = state.commander
    if state.refused:
        refused = ", ".join(f"{reason} {count}" for reason, count in state.refused.items())
        text += f"; commands were refused ({refused}), the newest: {state.last_refusal}"
        return warning("commander", text, f"zstate monitor --robots --robot {robot}")
    return ok("commander", text)


def _commands_check(state: DriverState) -> Check:
    """Whether commands arrive before the last one expires, and in time."""
    if state.transit_excess is not None and state.transit_excess > state.ttl // 2:
        waited, ttl = format_duration(state.transit_excess), format_duration(state.ttl)
        text = f"the newest waited for {waited} on its way, where commands are valid for {ttl} at most"
        return warning("commands", f"{text}: the link is too slow for them", "zstate monitor --robots")
    if state.command_age is None:
        return skipped("commands", "the driver has accepted none yet")
    age, ttl = format_duration(state.command_age), format_duration(state.ttl)
    text = f"the newest is {age} old, valid for {ttl} at most"
    if state.state == "holding":
        text += ": the joints are held until the next"
    return ok("commands", text)
