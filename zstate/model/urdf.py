"""URDF text to a RobotModel, or to everything that is wrong with it.

Nothing here reads files or knows Pinocchio, whose own reader accepts detached cycles and zero axes and
says one and the same sentence about every fault it does see. Limits: 16 MiB, 2000 links, 500 joints in
a chain, 100 levels of XML, 200 velocities (mimics counted: Pinocchio's memory grows with their cube).
"""

from __future__ import annotations

from collections.abc import Sequence

from zstate.model.findings import Findings, quoted, shortened
from zstate.model.robot import VELOCITY_COUNTS, Joint, RobotModel
from zstate.model.urdf_checks import check_mimics, check_tree
from zstate.model.urdf_joint import JointReader
from zstate.model.xml import Document, Element, NumberError, read_document, read_number

MAX_LINKS = 2000
MAX_VELOCITIES = 200

_XACRO_NAMESPACES = ("www.ros.org/wiki/xacro", "ros.org/wiki/xacro", "wiki.ros.org/xacro")
_OTHER_FORMATS = {"sdf": "an SDF file", "mujoco": "a MuJoCo file", "html": "a web page"}
_SMALLER = "merge links that fixed joints join, or split the robot into several"
_ROBOT_PARTS = {"link", "joint", "group"}
# These hold <joint> and <link> elements that are not the robot's own.
_OTHER_GROUPS = {"gazebo", "transmission", "ros2_control"}


def parse_urdf(text: str | bytes, source: str) -> RobotModel:
    """The robot that URDF ``text`` describes; ``source`` names it in messages.

    Raises ModelError with all findings, by line. Warnings alone are kept in ``model.findings``.
    """
    return parse_document(read_document(text, source), source)


def parse_document(document: Document, source: str) -> RobotModel:
    """The same, of text that has been read as XML already."""
    findings, robot = Findings(source), document.root
    _check_format(findings, robot)
    _check_sizes(findings, robot)
    findings.raise_errors()  # the rest would be noise, and endless for a file without measure
    _check_names(findings, robot)
    _check_nesting(findings, robot)
    links = _read_links(findings, robot)
    joints = _read_joints(findings, robot, links)
    root = check_tree(findings, links, joints)
    check_mimics(findings, joints)
    findings.raise_errors()
    return RobotModel(
        robot.attributes["name"], root, tuple(links), tuple(joints), document.text, findings.sorted()
    )


def xacro_elements(robot: Element) -> list[Element]:
    """The elements that only xacro understands; a mere ``xmlns:xacro`` is none."""
    prefixes = {"xacro"} | {
        name.removeprefix("xmlns:")
        for name, value in robot.attributes.items()
        if name.startswith("xmlns:") and value.rstrip("#/").split("://")[-1] in _XACRO_NAMESPACES
    }
    return [element for element in robot.walk() if element.tag.partition(":")[0] in prefixes - {element.tag}]


def _check_format(findings: Findings, robot: Element) -> None:
    xacro = xacro_elements(robot)
    if xacro:
        findings.error(
            xacro[0].line,
            f"this is a xacro file; its {len(xacro)} xacro tags, such as <{xacro[0].tag}>, must be expanded",
            "pip install 'zstate[xacro]', and name the .xacro file; or xacro FILE > robot.urdf",
        )
    elif robot.tag != "robot":
        what = _OTHER_FORMATS.get(robot.tag.lower(), "not a URDF")
        message = f"the document is <{quoted(robot.tag)[1:-1]}>, not <robot>: {what}"
        findings.error(robot.line, message, 'a URDF begins with <robot name="NAME">')
    elif not robot.all("link"):
        findings.error(robot.line, "the robot has no <link>", '<link name="base_link"/>')


def _check_sizes(findings: Findings, robot: Element) -> None:
    links, joints = robot.all("link"), robot.all("joint")
    if len(links) > MAX_LINKS:
        findings.error(None, f"the robot has {len(links)} links; the limit is {MAX_LINKS}", _SMALLER)
    elif len(joints) > MAX_LINKS:
        findings.error(None, f"the robot has {len(joints)} joints; the limit is {MAX_LINKS}", _SMALLER)
    counts = {str(kind): count for kind, count in VELOCITY_COUNTS.items()}
    velocities = sum(counts.get(joint.attributes.get("type", ""), 0) for joint in joints)
    if velocities > MAX_VELOCITIES:
        message = f"the robot has {velocities} velocities; the limit is {MAX_VELOCITIES}"
        findings.error(None, message, _SMALLER)


def _check_names(findings: Findings, robot: Element) -> None:
    _check_name(findings, robot)
    for tag in ("link", "joint"):
        first: dict[str, Element] = {}
        for element in robot.all(tag):
            name = _check_name(findings, element)
            earlier = first.setdefault(name, element)
            if name.strip() and earlier is not element:
                message = f"a second {tag} {quoted(name)}; the first is in line {earlier.line}"
                findings.error(
                    element.line, message, f'<{tag} name="{shortened(name)}_2">, or delete one of them'
                )


def _check_name(findings: Findings, element: Element) -> str:
    name = element.attributes.get("name", "")
    if not name.strip():
        given = "a name that is empty" if "name" in element.attributes else 'no name="..."'
        findings.error(element.line, f"<{element.tag}> has {given}", f'<{element.tag} name="NAME">')
    elif not name.isprintable():
        message = f"{element.tag} {quoted(name)} has control characters or line ends in its name"
        findings.error(element.line, message, f'<{element.tag} name="NAME">')
    elif name.startswith("/"):
        bare = name.lstrip("/")
        message = f"{element.tag} {quoted(name)} begins with a slash; write {quoted(bare)}"
        findings.error(element.line, message, f'<{element.tag} name="{shortened(bare)}">')
    elif "${" in name or "$(" in name:
        message = f"{element.tag} {quoted(name)} is a xacro expression, not a name"
        findings.error(element.line, message, "expand the file: pip install 'zstate[xacro]', name it .xacro")
    return name


def _check_nesting(findings: Findings, robot: Element) -> None:
    for again in robot.all("robot"):
        message = f"a second <robot>; the first begins in line {robot.line}"
        findings.error(again.line, message, "delete this tag and its end, and leave what is between")
    for part in robot.children:
        if part.tag in _OTHER_GROUPS:
            continue
        for lost in _parts_below(part):
            where = f"inside <{part.tag}> (line {part.line})"
            fix = f"</{part.tag}> before it, and delete the </{part.tag}> that comes later"
            if part.tag in _ROBOT_PARTS:
                message = f"<{lost.tag}> stands {where}; it must be directly in <robot>"
                findings.error(lost.line, message, fix)
            else:
                message = f"<{lost.tag}> stands {where}, so it is no part of the robot"
                findings.warning(lost.line, message, fix)


def _parts_below(element: Element) -> list[Element]:
    """Links and joints that look like the robot's own but stand below ``element``."""
    return [
        below
        for child in element.children
        for below in child.walk()
        if (below.tag == "link" and "name" in below.attributes)
        or (below.tag == "joint" and "type" in below.attributes)
    ]


def _read_links(findings: Findings, robot: Element) -> dict[str, int]:
    links: dict[str, int] = {}
    for element in robot.all("link"):
        name = element.attributes.get("name", "")
        links.setdefault(name, element.line)
        for inertial in element.all("inertial"):
            for mass in inertial.all("mass"):
                _check_mass(findings, name, mass)
    links.pop("", None)
    return links


def _check_mass(findings: Findings, link: str, mass: Element) -> None:
    try:
        value = read_number(mass.attributes.get("value", ""))
    except NumberError as fault:
        findings.warning(mass.line, f"link {quoted(link)}: mass: {fault}", '<mass value="1.0"/> in kg')
        return
    if value < 0.0:
        message = f"link {quoted(link)} has the negative mass {value:g} kg"
        findings.warning(mass.line, message, f'<mass value="{-value:g}"/>')


def _read_joints(findings: Findings, robot: Element, links: dict[str, int]) -> Sequence[Joint]:
    reader = JointReader(findings, links)
    return [reader.read(element) for element in robot.all("joint")]
