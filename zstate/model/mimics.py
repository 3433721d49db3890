"""Checks of mimic joints: each follows, perhaps through others, one joint that has a position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from zstate._util.suggestions import suggestion_text
from zstate.model.findings import Findings, quoted
from zstate.model.robot import POSITION_COUNTS, Joint

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
