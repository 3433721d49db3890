"""Reader of the limits that a URDF states for commands alone.

These are the soft limits of a joint's <safety_controller>, and ``min`` and ``max`` of the command interfaces
that a <ros2_control> has for it. An interface or joint with <limits enable="false"/> is left out, as in
ros2_control. Velocities, accelerations and efforts are limited both ways, by the smaller number.
"""

from __future__ import annotations

import math
from collections import defaultdict

from zstate.model.findings import Findings, quoted
from zstate.model.robot import DeclaredLimits
from zstate.model.xml import Element, NumberError, read_number

NOT_LIMITING = "which does not limit its commands"
"""In each finding of this module."""

_RATES = ("velocity", "effort", "acceleration")


def read_command_limits(robot: Element, findings: Findings) -> dict[str, DeclaredLimits]:
    """Limits by the name of the joint; what cannot be read is a warning of ``findings``."""
    found: defaultdict[str, DeclaredLimits] = defaultdict(DeclaredLimits)
    reader = _Reader(findings)
    for joint in robot.all("joint"):
        name = joint.attributes.get("name", "")
        for element in joint.all("safety_controller"):
            found[name] = found[name].narrowed(reader.soft_limits(name, element))
    for group in robot.all("ros2_control"):
        for joint in group.all("joint"):
            name = joint.attributes.get("name", "")
            for element in () if _is_disabled(joint) else joint.all("command_interface"):
                if not _is_disabled(element):
                    found[name] = found[name].narrowed(reader.interface_limits(name, element))
    return dict(found)


def _is_disabled(element: Element) -> bool:
    return any(one.attributes.get("enable", "").lower() == "false" for one in element.all("limits"))


class _Reader:
    def __init__(self, findings: Findings) -> None:
        self._findings = findings

    def soft_limits(self, joint: str, element: Element) -> DeclaredLimits:
        lower, upper = (
            self._number(joint, element, name, element.attributes.get(name))
            for name in ("soft_lower_limit", "soft_upper_limit")
        )
        return self._range(joint, element, lower, upper)

    def interface_limits(self, joint: str, element: Element) -> DeclaredLimits:
        kind = element.attributes.get("name", "")
        texts = {param.attributes.get("name", ""): param.text for param in element.all("param")}
        least, most = (self._number(joint, element, name, texts.get(name)) for name in ("min", "max"))
        if kind == "position":
            return self._range(joint, element, least, most)
        if kind not in _RATES or (least is None and most is None):
            return DeclaredLimits()
        at_most = min(abs(number) for number in (least, most) if number is not None)
        if at_most == 0.0 or (least or 0.0) > 0.0 or (most or 0.0) < 0.0:
            self._warn(joint, element, f"a {kind} from {_text(least)} to {_text(most)}")
            return DeclaredLimits()
        return DeclaredLimits(**{kind: at_most})

    def _range(
        self, joint: str, element: Element, lower: float | None, upper: float | None
    ) -> DeclaredLimits:
        range_ = DeclaredLimits(-math.inf if lower is None else lower, math.inf if upper is None else upper)
        if range_.lower < range_.upper:
            return range_
        self._warn(joint, element, f"positions from {_text(lower)} to {_text(upper)}")
        return DeclaredLimits()

    def _number(self, joint: str, element: Element, name: str, text: str | None) -> float | None:
        """The number ``text`` of the parameter ``name``; None without one."""
        try:
            return None if text is None else read_number(text)
        except NumberError as fault:
            self._warn(joint, element, f"{name}: {fault}")
            return None

    def _warn(self, joint: str, element: Element, problem: str) -> None:
        text = f"joint {quoted(joint)}: its <{element.tag}> has {problem}, {NOT_LIMITING}"
        self._findings.warning(element.line, text)


def _text(number: float | None) -> str:
    return "nothing" if number is None else f"{number:g}"
