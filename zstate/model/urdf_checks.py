"""Checks of links and joints as a tree: one root, one parent each, no cycle, not too deep.

Checks of mimic joints: each follows, perhaps through others, one joint that has a position.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from zstate._util.suggestions import suggestion_text
from zstate.model.findings import Findings, quoted, shortened
from zstate.model.robot import POSITION_COUNTS, Joint

MAX_DEPTH = 500
_MOST_NAMED = 8


def check_tree(findings: Findings, links: Mapping[str, int], joints: Sequence[Joint]) -> str:
    """The root link. Faults go to the findings; the answer counts only where there is none.

    ``links`` gives the line of each link; a joint's parent or child that is no link is "".
    """
    _check_ends(findings, joints)
    whole = [joint for joint in joints if joint.parent and joint.child and joint.parent != joint.child]
    _check_pairs(findings, whole)
    _check_parents(findings, whole)
    _check_cycles(findings, links, whole)
    root = _check_roots(findings, links, joints)
    _check_depth(findings, root, whole)
    return root


def _check_ends(findings: Findings, joints: Sequence[Joint]) -> None:
    for joint in joints:
        if joint.parent and joint.parent == joint.child:
            message = f"joint {quoted(joint.name)} joins link {quoted(joint.child)} to itself"
            findings.error(joint.line, message, '<child link="LINK"/> with another link')


def _check_pairs(findings: Findings, joints: Sequence[Joint]) -> None:
    first: dict[tuple[str, str], Joint] = {}
    for joint in joints:
        earlier = first.setdefault((joint.parent, joint.child), joint)
        if earlier is not joint:
            findings.error(
                joint.line,
                f"joints {quoted(earlier.name)} (line {earlier.line}) and {quoted(joint.name)} "
                f"(line {joint.line}) join the same links {quoted(joint.parent)} and {quoted(joint.child)}",
                "delete one of them, or put a link between two joints that both move",
            )


def _check_parents(findings: Findings, joints: Sequence[Joint]) -> None:
    parents: dict[str, dict[str, Joint]] = {}
    for joint in joints:
        parents.setdefault(joint.child, {}).setdefault(joint.parent, joint)
    for child, by_parent in parents.items():
        if len(by_parent) > 1:
            count = "two" if len(by_parent) == 2 else str(len(by_parent))
            named = [f"{quoted(parent)} (line {joint.line})" for parent, joint in by_parent.items()]
            line = list(by_parent.values())[1].line
            fix = "keep one of these joints; where a mechanism is a loop, leave it open there"
            findings.error(line, f"link {quoted(child)} has {count} parents: {_and(named)}", fix)


def _check_cycles(findings: Findings, links: Mapping[str, int], joints: Sequence[Joint]) -> None:
    below: dict[str, list[Joint]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint)
    done: set[str] = set()
    for link in links:
        for cycle, closing in _cycles_below(link, below, done):
            named = " -> ".join(quoted(name) for name in _middle_cut([*cycle, cycle[0]]))
            message = f"the links {named} form a cycle, closed by joint {quoted(closing.name)}"
            fix = f"delete joint {quoted(closing.name)}, or give it another child"
            findings.error(closing.line, message, fix)


def _cycles_below(
    start: str, below: Mapping[str, Sequence[Joint]], done: set[str]
) -> list[tuple[list[str], Joint]]:
    """The cycles met on a walk down from ``start``, each with the joint that closes it."""
    cycles: list[tuple[list[str], Joint]] = []
    path = [] if start in done else [start]
    open_joints = [iter(below.get(start, ()))]
    while path:
        joint = next(open_joints[-1], None)
        if joint is None:
            done.add(path.pop())
            open_joints.pop()
        elif joint.child in path:
            cycles.append((path[path.index(joint.child) :], joint))
        elif joint.child not in done:
            path.append(joint.child)
            open_joints.append(iter(below.get(joint.child, ())))
    return cycles


def _check_roots(findings: Findings, links: Mapping[str, int], joints: Sequence[Joint]) -> str:
    children = {joint.child for joint in joints}
    roots = [link for link in links if link not in children]
    # A joint whose child is misspelt leaves a link alone: that is one fault, already named.
    if len(roots) > 1 and "" not in children:
        named = _and(_middle_cut([f"{quoted(root)} (line {links[root]})" for root in roots]))
        count = "two" if len(roots) == 2 else str(len(roots))
        message = f"{count} links have no parent: {named}; a robot has one root: add a joint between them"
        parent, child = map(shortened, roots[:2])
        ends = f'<parent link="{parent}"/><child link="{child}"/>'
        fix = f'<joint name="{parent}_to_{child}" type="fixed">{ends}</joint>'
        findings.error(links[roots[1]], message, fix)
    return roots[0] if roots else ""


def _check_depth(findings: Findings, root: str, joints: Sequence[Joint]) -> None:
    below: dict[str, list[str]] = {}
    for joint in joints:
        below.setdefault(joint.parent, []).append(joint.child)
    levels = [[root]]
    seen = {root}
    while levels[-1]:
        children = dict.fromkeys(child for link in levels[-1] for child in below.get(link, ()))
        levels.append([child for child in children if child not in seen])
        seen.update(children)
    depth = len(levels) - 2
    if depth > MAX_DEPTH:
        deepest = quoted(levels[depth][0])
        message = f"link {deepest} lies {depth} joints below the root; the limit is {MAX_DEPTH}"
        findings.error(None, message, "merge links that fixed joints join")


def _middle_cut(names: Sequence[str]) -> list[str]:
    if len(names) <= _MOST_NAMED:
        return list(names)
    return [*names[: _MOST_NAMED // 2], "...", *names[-_MOST_NAMED // 2 :]]


def _and(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


MAX_CHAIN = 100

_FOLLOW = '<mimic joint="JOINT"/> with a joint that leads'


def check_mimics(findings: Findings, joints: Sequence[Joint]) -> None:
    """Masters exist, are one number each, and chains of mimics end and are at most 100 long."""
    by_name = {joint.name: joint for joint in joints}
    for joint in joints:
        if joint.mimic is not None:
            _check_master(findings, joint, joint.mimic.joint, by_name)
    _check_chains(findings, by_name)


def _check_master(findings: Findings, joint: Joint, name: str, by_name: Mapping[str, Joint]) -> None:
    label = f"joint {quoted(joint.name)} mimics"
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


def _check_chains(findings: Findings, by_name: Mapping[str, Joint]) -> None:
    lengths: dict[str, int] = {}
    for joint in by_name.values():
        chain: list[str] = []
        at: Joint | None = joint
        while at is not None and at.mimic is not None and at.name not in lengths:
            if at.name in chain:
                _report_cycle(findings, by_name, chain[chain.index(at.name) :])
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


def _report_cycle(findings: Findings, by_name: Mapping[str, Joint], cycle: Sequence[str]) -> None:
    if len(cycle) > 1:  # a joint that mimics itself is named by itself
        named = " -> ".join(quoted(name) for name in [*cycle, cycle[0]])
        message = f"the mimics {named} form a cycle, so no joint leads"
        fix = f"delete the <mimic> of one of them, such as {quoted(cycle[0])}, which then leads"
        findings.error(by_name[cycle[-1]].line, message, fix)
