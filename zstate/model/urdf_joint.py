"""Reader of one <joint> element, which reports all of its faults."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from typing import Final

from zstate._util.format import suggestion_text
from zstate.model.findings import Findings, quoted, shortened
from zstate.model.robot import POSITION_COUNTS, Joint, JointType, Limits, Mimic
from zstate.model.xml import Element, NumberError, read_number, read_numbers
from zstate.se3 import quaternion_from_rpy

Pose7 = tuple[float, float, float, float, float, float, float]
Vector3 = tuple[float, float, float]

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


class JointReader:
    """Reads joints whose parents and children must be among ``links``.

    A joint with faults is returned as well, with neutral values in place of wrong ones and "" for an
    unknown parent or child, so that the checks of the tree can skip them.
    """

    def __init__(self, findings: Findings, links: Iterable[str]) -> None:
        self._findings = findings
        self._links = dict.fromkeys(links)

    def read(self, element: Element) -> Joint:
        """The joint that ``element`` describes; faults go to the findings."""
        name = element.attributes.get("name", "")
        label = f"joint {quoted(name)}"
        for tag in _ONCE:
            for again in element.all(tag)[1:]:
                message = f"{label} has more than one <{tag}>"
                self._findings.error(again.line, message, f"delete this <{tag}>, or the one above")
        kind = self._type(element, label)
        return Joint(
            name=name,
            type=kind,
            parent=self._link_name(element, label, "parent"),
            child=self._link_name(element, label, "child"),
            origin=self._origin(element, label),
            axis=self._axis(element, label, kind),
            limits=self._limits(element, label, kind),
            mimic=self._mimic(element, label, kind),
            line=element.line,
        )

    def _type(self, element: Element, label: str) -> JointType:
        text = element.attributes.get("type")
        for kind in POSITION_COUNTS:
            if text == kind:
                return kind
        choices = f"; one of {', '.join(POSITION_COUNTS)}"
        if text is None:
            near, message = None, f"{label} has no type{choices}"
        else:
            near = self._findings.did_you_mean(text, POSITION_COUNTS)
            message = f"{label} has the unknown type {quoted(text)}{suggestion_text(near) or choices}"
        self._findings.error(element.line, message, f'type="{near or "revolute"}"')
        return "fixed"

    def _link_name(self, element: Element, label: str, tag: str) -> str:
        """The link in <parent> or <child>, or "" if there is no link of that name."""
        ends = element.all(tag)
        if not ends:
            fix = f'<{tag} link="{self._example_link}"/> inside the joint'
            self._findings.error(element.line, f'{label} has no <{tag} link="..."/>', fix)
            return ""
        link = ends[0].attributes.get("link")
        if link is None:
            message = f'{label}: its <{tag}> names no link; write <{tag} link="..."/>'
            self._findings.error(ends[0].line, message, f'<{tag} link="{self._example_link}"/>')
            return ""
        if link not in self._links:
            near = self._findings.did_you_mean(link, self._links)
            message = f"{label}: its {tag} {quoted(link)} is not a link{suggestion_text(near)}"
            fix = f'<{tag} link="{near}"/>' if near else f'<link name="{shortened(link)}"/> in <robot>'
            self._findings.error(ends[0].line, message, fix)
            return ""
        return link

    @property
    def _example_link(self) -> str:
        """The only link, or a placeholder."""
        return next(iter(self._links)) if len(self._links) == 1 else "LINK"

    def _origin(self, element: Element, label: str) -> Pose7:
        origins = element.all("origin")
        if not origins:
            return (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
        if "quat_xyzw" in origins[0].attributes:
            message = f"{label}: origin quat_xyzw is not read; write rpy"
            self._findings.error(origins[0].line, message, '<origin xyz="X Y Z" rpy="R P Y"/> in rad')
        x, y, z = self._vector(origins[0], label, "xyz")
        return (x, y, z, *quaternion_from_rpy(*self._vector(origins[0], label, "rpy")))

    def _axis(self, element: Element, label: str, kind: JointType) -> Vector3:
        axes = element.all("axis")
        default = _Z if kind == "planar" else _X
        # Exporters write an axis of zeros for joints without one.
        if not axes or kind in {"fixed", "floating"}:
            return default
        if "xyz" not in axes[0].attributes:
            self._findings.error(axes[0].line, f"{label}: its <axis> has no xyz", _SOME_AXIS)
            return default
        x, y, z = self._vector(axes[0], label, "xyz", default)
        length = math.hypot(x, y, z)
        if length < _SMALLEST_AXIS:
            message = f"{label} has the axis {_text(x, y, z)}, which has no direction"
            self._findings.error(axes[0].line, message, _SOME_AXIS)
            return default
        axis = (x / length, y / length, z / length)
        if abs(length - 1.0) > _AXIS_TOLERANCE:
            message = (
                f"{label} has the axis {_text(x, y, z)} of length {length:.4g}; it is made a unit vector"
            )
            fix = f'<axis xyz="{" ".join(f"{part:.6g}" for part in axis)}"/>'
            self._findings.warning(axes[0].line, message, fix)
        if kind == "planar" and math.dist(axis, _Z) > _AXIS_TOLERANCE:
            self._findings.error(
                axes[0].line,
                f"{label} is planar about the axis {_text(*axis)}; planar joints move in the x-y plane of "
                "their own frame and turn about +z: turn its origin instead",
                '<axis xyz="0 0 1"/>, and <origin rpy="R P Y"/> that turns the joint',
            )
        return axis

    def _limits(self, element: Element, label: str, kind: JointType) -> Limits:
        limits = element.all("limit")
        if not limits:
            if kind in {"revolute", "prismatic"}:
                message = f'{label} is {kind} and has no <limit lower="..." upper="..."/>'
                self._findings.error(element.line, message, _SOME_LIMITS[kind])
            return Limits()
        limit = limits[0]
        lower, upper, velocity, effort = (
            self._number(limit, label, name) for name in ("lower", "upper", "velocity", "effort")
        )
        if kind == "fixed":
            return Limits()
        if kind == "continuous" and (lower, upper) != (None, None):
            message = f"{label} is continuous, so its lower and upper limits are not used"
            self._findings.warning(limit.line, message, 'delete lower and upper, or type="revolute"')
        if kind in {"revolute", "prismatic"}:
            lower, upper = lower or 0.0, upper or 0.0
            if lower > upper:
                message = f"{label} has its limits reversed: lower {lower:g}, upper {upper:g}"
                self._findings.error(limit.line, message, f'<limit lower="{upper:g}" upper="{lower:g}"/>')
        else:
            lower, upper = -math.inf, math.inf
        velocity = math.inf if velocity is None else velocity
        return Limits(lower, upper, velocity, math.inf if effort is None else effort)

    def _mimic(self, element: Element, label: str, kind: JointType) -> Mimic | None:
        mimics = element.all("mimic")
        if not mimics:
            return None
        if "joint" not in mimics[0].attributes:
            fix = '<mimic joint="JOINT" multiplier="1" offset="0"/>'
            self._findings.error(mimics[0].line, f'{label}: its <mimic> names no joint="..."', fix)
            return None
        if kind in {"floating", "planar"}:
            message = f"{label} is {kind} and cannot mimic: a mimic is one number"
            self._findings.error(mimics[0].line, message, "delete the <mimic>")
        multiplier = self._number(mimics[0], label, "multiplier")
        offset = self._number(mimics[0], label, "offset")
        if kind == "fixed":
            fix = "delete the <mimic>, or give the joint a type that moves"
            self._findings.warning(mimics[0].line, f"{label} is fixed, so its <mimic> is not used", fix)
            return None
        return Mimic(mimics[0].attributes["joint"], 1.0 if multiplier is None else multiplier, offset or 0.0)

    def _vector(self, element: Element, label: str, name: str, default: Vector3 = (0.0, 0.0, 0.0)) -> Vector3:
        text = element.attributes.get(name)
        if text is None:
            return default
        try:
            x, y, z = read_numbers(text, 3)
        except NumberError as fault:
            self._report(element, label, name, fault, _as_numbers(text, 3))
            return default
        return x, y, z

    def _number(self, element: Element, label: str, name: str) -> float | None:
        """The number in that attribute; None if it is missing or unreadable."""
        text = element.attributes.get(name)
        if text is None:
            return None
        try:
            return read_number(text)
        except NumberError as fault:
            self._report(element, label, name, fault, _as_numbers(text, 1))
            return None

    def _report(self, element: Element, label: str, name: str, fault: NumberError, fix: str) -> None:
        self._findings.error(element.line, f"{label}: {element.tag} {name}: {fault}", f'{name}="{fix}"')


def _as_numbers(text: str, count: int) -> str:
    """``text`` as ``count`` numbers if a comma is its only fault; else zeros."""
    for guess in (text.replace(",", "."), text.replace(",", " ")):
        with suppress(NumberError):
            return " ".join(f"{number:g}" for number in read_numbers(guess, count))
    return " ".join(["0.0"] * count)


def _text(*numbers: float) -> str:
    return f"'{' '.join(f'{number:g}' for number in numbers)}'"
