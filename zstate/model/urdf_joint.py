"""Reader of one <joint> element, which reports all of its faults."""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import suppress
from typing import Final

from zstate._util.format import suggestion_text
from zstate.model.findings import Findings, quoted, shortened
from zstate.model.robot import POSITION_COUNTS, DeclaredLimits, Joint, JointType, Mimic, Pose7, Vector3
from zstate.model.xml import Element, NumberError, read_number, read_numbers
from zstate.se3 import quaternion_from_rpy

_ZERO: Final = (0.0, 0.0, 0.0)
_X: Final = (1.0, 0.0, 0.0)
_Z: Final = (0.0, 0.0, 1.0)
_SMALLEST_AXIS = 1e-6
_AXIS_TOLERANCE = 1e-3  # files round axes to three or four digits, which deserves no warning
_SOME_AXIS = '<axis xyz="0 0 1"/>: what it turns about, or slides along'
_SOME_LIMITS = {
    "revolute": '<limit lower="-3.14" upper="3.14" effort="10" velocity="1"/> in rad, or type="continuous"',
    "prismatic": '<limit lower="0" upper="0.1" effort="10" velocity="1"/> in m',
}
_ONCE = ("parent", "child", "origin", "axis", "limit", "mimic")


def read_joint(element: Element, links: Collection[str], findings: Findings) -> Joint:
    """The joint that ``element`` describes; faults go to ``findings``.

    Its parent and child must be among ``links``. A joint with faults is returned as well, with neutral
    values in place of wrong ones and "" for an unknown parent or child, so that the checks of the tree can
    skip them.
    """
    return _JointReader(element, links, findings).read()


class _JointReader:
    def __init__(self, element: Element, links: Collection[str], findings: Findings) -> None:
        self._element = element
        self._links = links
        self._findings = findings
        self._name = element.attributes.get("name", "")

    def read(self) -> Joint:
        for tag in _ONCE:
            for again in self._element.all(tag)[1:]:
                self._error(again, f" has more than one <{tag}>", f"delete this <{tag}>, or the one above")
        kind = self._type()
        return Joint(
            name=self._name,
            type=kind,
            parent=self._link_name("parent"),
            child=self._link_name("child"),
            origin=self._origin(),
            axis=self._axis(kind),
            limits=self._limits(kind),
            mimic=self._mimic(kind),
            line=self._element.line,
        )

    def _type(self) -> JointType:
        text = self._element.attributes.get("type")
        for kind in POSITION_COUNTS:
            if text == kind:
                return kind
        choices = f"; one of {', '.join(POSITION_COUNTS)}"
        if text is None:
            near, problem = None, f" has no type{choices}"
        else:
            near = self._findings.did_you_mean(text, POSITION_COUNTS)
            problem = f" has the unknown type {quoted(text)}{suggestion_text(near) or choices}"
        self._error(self._element, problem, f'type="{near or "revolute"}"')
        return "fixed"

    def _link_name(self, tag: str) -> str:
        """The link in <parent> or <child>, or "" if there is no link of that name."""
        end = self._first(tag)
        link = None if end is None else end.attributes.get("link")
        fix = f'<{tag} link="{next(iter(self._links)) if len(self._links) == 1 else "LINK"}"/>'
        if end is None:
            self._error(self._element, f' has no <{tag} link="..."/>', f"{fix} inside the joint")
        elif link is None:
            self._error(end, f': its <{tag}> names no link; write <{tag} link="..."/>', fix)
        elif link not in self._links:
            near = self._findings.did_you_mean(link, self._links)
            fix = f'<{tag} link="{near}"/>' if near else f'<link name="{shortened(link)}"/> in <robot>'
            self._error(end, f": its {tag} {quoted(link)} is not a link{suggestion_text(near)}", fix)
        else:
            return link
        return ""

    def _origin(self) -> Pose7:
        origin = self._first("origin")
        if origin is None:
            return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        if "quat_xyzw" in origin.attributes:
            fix = '<origin xyz="X Y Z" rpy="R P Y"/> in rad'
            self._error(origin, ": origin quat_xyzw is not read; write rpy", fix)
        x, y, z = self._numbers(origin, "xyz", 3) or _ZERO
        roll, pitch, yaw = self._numbers(origin, "rpy", 3) or _ZERO
        return (x, y, z, *quaternion_from_rpy(roll, pitch, yaw))

    def _axis(self, kind: JointType) -> Vector3:
        element = self._first("axis")
        default = _Z if kind == "planar" else _X
        # Exporters write an axis of zeros for joints without one.
        if element is None or kind in {"fixed", "floating"}:
            return default
        if "xyz" not in element.attributes:
            self._error(element, ": its <axis> has no xyz", _SOME_AXIS)
            return default
        x, y, z = self._numbers(element, "xyz", 3) or default
        length = math.hypot(x, y, z)
        if length < _SMALLEST_AXIS:
            self._error(element, f" has the axis {_text(x, y, z)}, which has no direction", _SOME_AXIS)
            return default
        axis = (x / length, y / length, z / length)
        if abs(length - 1.0) > _AXIS_TOLERANCE:
            problem = f" has the axis {_text(x, y, z)} of length {length:.4g}; it is made a unit vector"
            self._warning(element, problem, f'<axis xyz="{" ".join(f"{part:.6g}" for part in axis)}"/>')
        if kind == "planar" and math.dist(axis, _Z) > _AXIS_TOLERANCE:
            self._error(
                element,
                f" is planar about the axis {_text(*axis)}; planar joints move in the x-y plane of "
                "their own frame and turn about +z: turn its origin instead",
                '<axis xyz="0 0 1"/>, and <origin rpy="R P Y"/> that turns the joint',
            )
        return axis

    def _limits(self, kind: JointType) -> DeclaredLimits:
        limit = self._first("limit")
        if limit is None:
            if kind in {"revolute", "prismatic"}:
                problem = f' is {kind} and has no <limit lower="..." upper="..."/>'
                self._error(self._element, problem, _SOME_LIMITS[kind])
            return DeclaredLimits()
        lower, upper, velocity, effort = (
            (self._numbers(limit, name, 1) or (None,))[0] for name in ("lower", "upper", "velocity", "effort")
        )
        if kind == "fixed":
            return DeclaredLimits()
        if kind == "continuous" and (lower, upper) != (None, None):
            problem = " is continuous, so its lower and upper limits are not used"
            self._warning(limit, problem, 'delete lower and upper, or type="revolute"')
        if kind in {"revolute", "prismatic"}:
            lower, upper = lower or 0.0, upper or 0.0
            if lower > upper:
                problem = f" has its limits reversed: lower {lower:g}, upper {upper:g}"
                self._error(limit, problem, f'<limit lower="{upper:g}" upper="{lower:g}"/>')
        else:
            lower, upper = -math.inf, math.inf
        velocity = math.inf if velocity is None else velocity
        return DeclaredLimits(lower, upper, velocity, math.inf if effort is None else effort)

    def _mimic(self, kind: JointType) -> Mimic | None:
        mimic = self._first("mimic")
        if mimic is None:
            return None
        if "joint" not in mimic.attributes:
            fix = '<mimic joint="JOINT" multiplier="1" offset="0"/>'
            self._error(mimic, ': its <mimic> names no joint="..."', fix)
            return None
        if kind in {"floating", "planar"}:
            problem = f" is {kind} and cannot mimic: a mimic is one number"
            self._error(mimic, problem, "delete the <mimic>")
        (multiplier,) = self._numbers(mimic, "multiplier", 1) or (1.0,)
        (offset,) = self._numbers(mimic, "offset", 1) or (0.0,)
        if kind == "fixed":
            fix = "delete the <mimic>, or give the joint a type that moves"
            self._warning(mimic, " is fixed, so its <mimic> is not used", fix)
            return None
        return Mimic(mimic.attributes["joint"], multiplier, offset)

    def _first(self, tag: str) -> Element | None:
        return next(iter(self._element.all(tag)), None)

    def _numbers(self, element: Element, name: str, count: int) -> tuple[float, ...] | None:
        """The numbers in that attribute; None if it is missing or unreadable."""
        text = element.attributes.get(name)
        if text is None:
            return None
        try:
            return (read_number(text),) if count == 1 else read_numbers(text, count)
        except NumberError as fault:
            fix = f'{name}="{_as_numbers(text, count)}"'
            self._error(element, f": {element.tag} {name}: {fault}", fix)
            return None

    def _error(self, element: Element, problem: str, fix: str) -> None:
        self._findings.error(element.line, f"joint {quoted(self._name)}{problem}", fix)

    def _warning(self, element: Element, problem: str, fix: str) -> None:
        self._findings.warning(element.line, f"joint {quoted(self._name)}{problem}", fix)


def _as_numbers(text: str, count: int) -> str:
    """``text`` as ``count`` numbers if a comma is its only fault; else zeros."""
    for guess in (text.replace(",", "."), text.replace(",", " ")):
        with suppress(NumberError):
            return " ".join(f"{number:g}" for number in read_numbers(guess, count))
    return " ".join(["0.0"] * count)


def _text(*numbers: float) -> str:
    return f"'{' '.join(f'{number:g}' for number in numbers)}'"
