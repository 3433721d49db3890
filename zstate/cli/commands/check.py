"""zstate check: what is right and wrong with a robot model."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import count_text, say, say_json
from zstate.cli.layout import in_columns, tree_lines
from zstate.errors import Found, ModelError

if TYPE_CHECKING:
    from zstate.model.robot import Joint, RobotModel


@click.command("check")
@click.argument("file")
@click.option("--json", "as_json", is_flag=True, help="One JSON object.")
def check_command(file: str, as_json: bool) -> None:
    """Say what is right and wrong with the robot model in FILE.

    FILE is URDF or xacro, "-" for standard input, or a name such as "panda". Prints every finding with
    its line, then the tree of links and joints. Exit code 1 when the model cannot be used; warnings do
    not count.
    """
    from zstate.model.catalog import load_model

    name = "standard input" if file == "-" else file
    model, findings = None, ()
    try:
        model = load_model(sys.stdin.buffer.read() if file == "-" else file)
        findings = model.findings
    except ModelError as error:
        if not error.findings:
            raise
        findings = error.findings
    if as_json:
        say_json(_facts(name, model, findings))
    else:
        say(_report(name, model, findings))
    raise SystemExit(0 if model else 1)


def _report(name: str, model: RobotModel | None, findings: Sequence[Found]) -> str:
    lines = [_headline(name, model, findings)]
    lines += [f"  {row}" for row in in_columns([_finding_row(finding) for finding in findings])]
    if model is not None:
        lines += in_columns(_link_rows(model))
    return "\n".join(lines)


def _headline(name: str, model: RobotModel | None, findings: Sequence[Found]) -> str:
    if model is None:
        errors = sum(finding.severity == "error" for finding in findings)
        return f"{name} cannot be used ({count_text(errors, 'error')})"
    return (
        f"{name}: robot {model.name!r}, {count_text(len(model.links), 'link')}, "
        f"{count_text(len(model.joints), 'joint')} ({len(model.joint_names)} driven)"
    )


def _finding_row(finding: Found) -> tuple[str, str, str]:
    where = "file" if finding.line is None else f"line {finding.line}"
    return where, finding.severity, finding.message


def _link_rows(model: RobotModel) -> list[tuple[str, str, str, str]]:
    joints = {joint.child: joint for joint in model.joints}
    children: dict[str, list[str]] = {}
    for joint in model.joints:
        children.setdefault(joint.parent, []).append(joint.child)
    return [
        (guide + link, *_joint_cells(joints.get(link))) for guide, link in tree_lines(model.root, children)
    ]


def _joint_cells(joint: Joint | None) -> tuple[str, str, str]:
    if joint is None:
        return "", "", ""
    return joint.name, joint.type, _mimic_text(joint) or _limits_text(joint)


def _mimic_text(joint: Joint) -> str:
    if joint.mimic is None:
        return ""
    offset = f" {joint.mimic.offset:+g}" if joint.mimic.offset else ""
    return f"{joint.mimic.multiplier:g} * {joint.mimic.joint}{offset}"


def _limits_text(joint: Joint) -> str:
    if joint.type not in ("revolute", "prismatic"):
        return ""
    unit = "rad" if joint.type == "revolute" else "m"
    return f"{joint.limits.lower:g} to {joint.limits.upper:g} {unit}"


def _facts(name: str, model: RobotModel | None, findings: Sequence[Found]) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "source": name,
        "usable": model is not None,
        "findings": [
            {"line": finding.line, "severity": finding.severity, "message": finding.message}
            for finding in findings
        ],
    }
    if model is not None:
        facts |= {"robot": model.name, "digest": model.digest, "root": model.root, "links": model.links}
        facts["joints"] = [_joint_facts(joint) for joint in model.joints]
    return facts


def _joint_facts(joint: Joint) -> dict[str, Any]:
    limits = joint.limits
    facts: dict[str, Any] = {
        "name": joint.name,
        "type": joint.type,
        "parent": joint.parent,
        "child": joint.child,
        "line": joint.line,
        "lower": _finite(limits.lower),
        "upper": _finite(limits.upper),
    }
    if joint.mimic is not None:
        mimic = joint.mimic
        facts["mimic"] = {"joint": mimic.joint, "multiplier": mimic.multiplier, "offset": mimic.offset}
    return facts


def _finite(limit: float) -> float | None:
    """JSON has no infinity; a limit that is not stated is null."""
    return limit if math.isfinite(limit) else None
