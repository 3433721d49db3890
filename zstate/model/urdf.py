"""Parser of URDF text: returns a RobotModel or reports all faults with their lines.

It reads no files and does not use Pinocchio, whose own reader accepts detached cycles and zero axes and
has one message for all faults. DeclaredLimits: 16 MiB, 2000 links, 500 joints in a chain, 100 levels of XML,
100 mimics in a chain, 200 velocities (mimics counted: Pinocchio's memory grows with their cube).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

from zstate._util.format import suggestion_text
from zstate.model.command_limits import read_command_limits
from zstate.model.findings import Findings, quoted, shortened
from zstate.model.robot import POSITION_COUNTS, VELOCITY_COUNTS, DeclaredLimits, Joint, RobotModel
from zstate.model.urdf_joint import read_joint
from zstate.model.xml import Document, Element, NumberError, read_document, read_number

MAX_LINKS = 2000
MAX_VELOCITIES = 200
MAX_DEPTH = 500
MAX_CHAIN = 100

_XACRO_NAMESPACES = ("www.ros.org/wiki/xacro", "ros.org/wiki/xacro", "wiki.ros.org/xacro")
_OTHER_FORMATS = {"sdf": "an SDF file", "mujoco": "a MuJoCo file", "html": "a web page"}
_SMALLER = "merge links that fixed joints join, or split the robot into several"
_FOLLOW = '<mimic joint="JOINT"/> with a joint that leads'
_MOST_NAMED = 8
_ROBOT_PARTS = {"link", "joint", "group"}
# These hold <joint> and <link> elements that are not the robot's own.
_OTHER_GROUPS = {"gazebo", "transmission", "ros2_control"}


def parse_urdf(text: str, source: str) -> RobotModel:
    """The robot that URDF ``text`` describes; ``source`` names it in messages.

    Raises ModelError with all findings, by line. Warnings alone are kept in ``model.findings``.
    """
    return parse_document(read_document(text, source), source)


def parse_document(document: Document, source: str) -> RobotModel:
    """Same as ``parse_urdf``, for text that is parsed as XML already."""
    findings, robot = Findings(source), document.root
    _check_format(findings, robot)
    _check_sizes(findings, robot)
    findings.raise_errors()  # the other checks would add noise, without end for a huge file
    _check_names(findings, robot)
    _check_nesting(findings, robot)
    links = _read_links(findings, robot)
    commands = read_command_limits(robot, findings)
    joints = [read_joint(element, links, findings) for element in robot.all("joint")]
    joints = [replace(joint, command_limits=commands.get(joint.name, DeclaredLimits())) for joint in joints]
    root = _check_tree(findings, links, joints)
    _check_mimics(findings, joints)
    findings.raise_errors()
    return RobotModel(
        robot.attributes["name"], root, tuple(links), tuple(joints), document.text, findings.sorted()
    )


def xacro_elements(robot: Element) -> list[Element]:
    """The elements of xacro; ``xmlns:xacro`` alone is none."""
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
        kind = _OTHER_FORMATS.get(robot.tag.lower(), "not a URDF")
        message = f"the document is <{quoted(robot.tag)[1:-1]}>, not <robot>: {kind}"
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
        fault = "a name that is empty" if "name" in element.attributes else 'no name="..."'
        findings.error(element.line, f"<{element.tag}> has {fault}", f'<{element.tag} name="NAME">')
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
        for below in (below for child in part.children for below in child.walk()):
            attribute = {"link": "name", "joint": "type"}.get(below.tag)
            if attribute is None or attribute not in below.attributes:
                continue
            where = f"<{below.tag}> is inside <{part.tag}> (line {part.line})"
            fix = f"</{part.tag}> before it, and delete the </{part.tag}> that comes later"
            if part.tag in _ROBOT_PARTS:
                findings.error(below.line, f"{where}; it must be directly in <robot>", fix)
            else:
                findings.warning(below.line, f"{where}, so it is no part of the robot", fix)


def _read_links(findings: Findings, robot: Element) -> dict[str, int]:
    links: dict[str, int] = {}
    for element in robot.all("link"):
        name = element.attributes.get("name", "")
        links.setdefault(name, element.line)
        for mass in (mass for inertial in element.all("inertial") for mass in inertial.all("mass")):
            try:
                value = read_number(mass.attributes.get("value", ""))
            except NumberError as fault:
                message = f"link {quoted(name)}: mass: {fault}"
                findings.warning(mass.line, message, '<mass value="1.0"/> in kg')
                continue
            if value < 0.0:
                message = f"link {quoted(name)} has the negative mass {value:g} kg"
                findings.warning(mass.line, message, f'<mass value="{-value:g}"/>')
    links.pop("", None)
    return links


def _check_tree(findings: Findings, links: Mapping[str, int], joints: Sequence[Joint]) -> str:
    """The root link, valid if there is no fault: one root, one parent per link, no cycle, not too deep.

    ``links`` has the line of each link; an unknown parent or child of a joint is "".
    """
    for joint in joints:
        if joint.parent and joint.parent == joint.child:
            message = f"joint {quoted(joint.name)} joins link {quoted(joint.child)} to itself"
            findings.error(joint.line, message, '<child link="LINK"/> with another link')
    whole = [joint for joint in joints if joint.parent and joint.child and joint.parent != joint.child]
    below: dict[str, list[Joint]] = defaultdict(list)
    for joint in whole:
        below[joint.parent].append(joint)
    _check_parents(findings, whole)
    _check_cycles(findings, links, below)
    root = _check_roots(findings, links, joints)
    _check_depth(findings, root, below)
    return root


def _check_parents(findings: Findings, joints: Sequence[Joint]) -> None:
    parents: dict[str, dict[str, Joint]] = defaultdict(dict)
    for joint in joints:
        earlier = parents[joint.child].setdefault(joint.parent, joint)
        if earlier is not joint:
            findings.error(
                joint.line,
                f"joints {quoted(earlier.name)} (line {earlier.line}) and {quoted(joint.name)} "
                f"(line {joint.line}) join the same links {quoted(joint.parent)} and {quoted(joint.child)}",
                "delete one of them, or put a link between two joints that both move",
            )
    for child, by_parent in parents.items():
        if len(by_parent) > 1:
            count = "two" if len(by_parent) == 2 else str(len(by_parent))
            named = [f"{quoted(parent)} (line {joint.line})" for parent, joint in by_parent.items()]
            line = list(by_parent.values())[1].line
            fix = "keep one of these joints; if the mechanism is a loop, leave it open there"
            findings.error(line, f"link {quoted(child)} has {count} parents: {_and(named)}", fix)


def _check_cycles(findings: Findings, links: Iterable[str], below: Mapping[str, Sequence[Joint]]) -> None:
    done: set[str] = set()
    for start in links:
        path = [] if start in done else [start]
        open_joints = [iter(below.get(start, ()))]
        while path:
            joint = next(open_joints[-1], None)
            if joint is None:
                done.add(path.pop())
                open_joints.pop()
            elif joint.child in path:
                cycle = [*path[path.index(joint.child) :], joint.child]
                named = " -> ".join(quoted(name) for name in _middle_cut(cycle))
                message = f"the links {named} form a cycle, closed by joint {quoted(joint.name)}"
                fix = f"delete joint {quoted(joint.name)}, or give it another child"
                findings.error(joint.line, message, fix)
            elif joint.child not in done:
                path.append(joint.child)
                open_joints.append(iter(below.get(joint.child, ())))


def _check_roots(findings: Findings, links: Mapping[str, int], joints: Sequence[Joint]) -> str:
    children = {joint.child for joint in joints}
    roots = [link for link in links if link not in children]
    # A joint whose child is misspelt leaves a link alone, which is reported already.
    if len(roots) > 1 and "" not in children:
        named = _and(_middle_cut([f"{quoted(root)} (line {links[root]})" for root in roots]))
        count = "two" if len(roots) == 2 else str(len(roots))
        message = f"{count} links have no parent: {named}; a robot has one root: add a joint between them"
        parent, child = map(shortened, roots[:2])
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        fix = f'<joint name="{parent}_to_{child}" type="fixed">{ends}</joint>'
        findings.error(links[roots[1]], message, fix)
    return roots[0] if roots else ""


def _check_depth(findings: Findings, root: str, below: Mapping[str, Sequence[Joint]]) -> None:
    depths = {root: 0}
    queue = [root]
    for link in queue:
        for joint in below.get(link, ()):
            if joint.child not in depths:
                depths[joint.child] = depths[link] + 1
                queue.append(joint.child)
    deepest = max(depths, key=depths.__getitem__)
    if depths[deepest] > MAX_DEPTH:
        message = (
            f"link {quoted(deepest)} lies {depths[deepest]} joints below the root; the limit is {MAX_DEPTH}"
        )
        findings.error(None, message, "merge links that fixed joints join")


def _middle_cut(names: Sequence[str]) -> list[str]:
    if len(names) <= _MOST_NAMED:
        return list(names)
    return [*names[: _MOST_NAMED // 2], "...", *names[-_MOST_NAMED // 2 :]]


def _and(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def _check_mimics(findings: Findings, joints: Sequence[Joint]) -> None:
    """Each master exists and has one position; chains of mimics end and are at most 100 long."""
    by_name = {joint.name: joint for joint in joints}
    for joint in joints:
        if joint.mimic is None:
            continue
        label, name = f"joint {quoted(joint.name)} mimics", joint.mimic.joint
        master = by_name.get(name)
        if master is None:
            near = findings.did_you_mean(name, (other for other in by_name if other != joint.name))
            fix = _FOLLOW if near is None else f'<mimic joint="{near}"/>'
            message = f"{label} {quoted(name)}, which does not exist{suggestion_text(near)}"
            findings.error(joint.line, message, fix)
        elif master is joint:
            findings.error(joint.line, f"{label} itself", _FOLLOW)
        elif POSITION_COUNTS[master.type] != 1:
            findings.error(
                joint.line,
                f"{label} {quoted(name)} (line {master.line}), which is {master.type}; a mimic follows a "
                "revolute, continuous or prismatic joint",
                _FOLLOW,
            )
    _check_chains(findings, by_name)


def _check_chains(findings: Findings, by_name: Mapping[str, Joint]) -> None:
    lengths: dict[str, int] = {}
    for joint in by_name.values():
        chain: list[str] = []
        at: Joint | None = joint
        while at is not None and at.mimic is not None and at.name not in lengths:
            if at.name in chain:
                cycle = chain[chain.index(at.name) :]
                if len(cycle) > 1:  # a joint that mimics itself is reported as such
                    named = " -> ".join(quoted(name) for name in [*cycle, cycle[0]])
                    message = f"the mimics {named} form a cycle, so no joint leads"
                    fix = f"delete the <mimic> of one of them, such as {quoted(cycle[0])}, which then leads"
                    findings.error(by_name[cycle[-1]].line, message, fix)
                break
            chain.append(at.name)
            at = by_name.get(at.mimic.joint)
        length = lengths.get(at.name, 0) if at is not None else 0
        for name in reversed(chain):
            length += 1
            lengths[name] = length
            if length == MAX_CHAIN + 1:
                message = f"joint {quoted(name)} ends a chain of {length} mimics; the limit is {MAX_CHAIN}"
                fix = "let it follow the joint that leads, with the products of the multipliers"
                findings.error(by_name[name].line, message, fix)
