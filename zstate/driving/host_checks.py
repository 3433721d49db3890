"""What a driver host checks before it opens: its arguments, and that no other host drives the robot."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from zstate.driving.driver import Driver
from zstate.driving.limits import Limits
from zstate.errors import InvalidInput, MessageError, SecondWriter
from zstate.net.latched import cached_values
from zstate.net.ownership import wait_for_discovery
from zstate.net.session import Session
from zstate.wire.identity import WriterId
from zstate.wire.keys import driver_key
from zstate.wire.messages import DriverState
from zstate.wire.native import decode

_CACHES_WITHIN_S = 0.5


def check_only_host(session: Session, robot: str) -> None:
    """Raise SecondWriter if a driver of ``robot`` is hosted already."""
    wait_for_discovery(session)
    for value in cached_values(session, driver_key(robot), _CACHES_WITHIN_S):
        with suppress(MessageError):
            other = decode(value.payload, value.encoding, DriverState)
            first = WriterId(other.program, "", 0, 0, other.session)
            raise SecondWriter(
                f"{other.program!r} already drives {', '.join(other.joint_names)} of {robot!r}; a robot has "
                "one driver host: stop the first, or give one driver all joints",
                robot=robot,
                stream="driver",
                first=first,
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
