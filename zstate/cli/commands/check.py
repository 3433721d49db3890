"""zstate check: what is right and wrong with a robot model."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import click

from zstate.cli.console import count_text, output_width, say_fitted, say_json
from zstate.cli.options import json_option, xacro_arguments
from zstate.cli.output.text_layout import Guides, Table, chain_lines, first_fitting, in_columns, tree_lines
from zstate.errors import Found, ModelError

if TYPE_CHECKING:
    from zstate.model.robot import Joint, RobotModel

_STDIN = "standard input"
_WITHOUT_AXIS = ("fixed", "floating")
_LINK_HEADINGS = ("link", "joint", "type", "range")
_JOINT_HEADINGS = ("joint", "type", "parent", "child", "position", "range", "velocity", "effort", "axis")


@click.command("check")
@click.argument("file")
@xacro_arguments
@click.option("--fix-hints", is_flag=True, help="Below each finding, what to write instead.")
@click.option("--joints", "joint_table", is_flag=True, help="The joints as a table, instead of the tree.")
@json_option("One JSON object.")
def check_command(
    file: str, xacro_args: dict[str, str], fix_hints: bool, joint_table: bool, as_json: bool
) -> None:
    """Say what is right and wrong with the robot model in FILE.

    FILE is URDF or xacro, "-" for standard input, or a name such as "panda"; NAME:=VALUE are
    xacro arguments. Prints every finding with
    its line, then the tree of links and joints. Exit code 1 when the model cannot be used; warnings do
    not count.

    \b
    zstate check arm.urdf --fix-hints
    zstate check panda --joints                        # the order of positions, limits, axes, mimics
    zstate check arm.urdf.xacro prefix:=left_
    xacro arm.xacro | zstate check -
    """
    from zstate.model.catalog import load_model

    name = _STDIN if file == "-" else file
    model, findings = None, ()
    try:
        model = load_model(sys.stdin.buffer.read() if file == "-" else file, xacro_args=xacro_args)
        findings = model.findings
    except ModelError as error:
        if not error.findings:
            raise
        findings = error.findings
    if as_json:
        say_json(_facts(name, model, findings))
    else:
        say_fitted(_report(name, model, findings, fix_hints=fix_hints, joint_table=joint_table))
    raise SystemExit(0 if model else 1)


def _report(
    name: str, model: RobotModel | None, findings: Sequence[Found], *, fix_hints: bool, joint_table: bool
) -> str:
    lines = [_headline(name, model, findings)]
    rows = in_columns([_finding_row(finding) for finding in findings])
    for row, finding in zip(rows, findings, strict=True):
        lines += [f"  {row}"]
        if fix_hints and finding.fix:
            lines += [f"      fix: {finding.fix}"]
    if model is not None:
        lines += _joint_lines(model) if joint_table else _link_lines(model)
    elif not fix_hints and any(finding.fix for finding in findings):
        lines += (
            [f"`zstate check {shlex.quote(name)} --fix-hints` says what to write instead"]
            if name != _STDIN
            else []
        )
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


def _joint_lines(model: RobotModel) -> list[str]:
    optional = ("axis", "effort", "velocity", "parent", "type")
    return Table(_JOINT_HEADINGS, _joint_rows(model), optional).lines(output_width())


def _link_lines(model: RobotModel) -> list[str]:
    tables = (
        Table(_LINK_HEADINGS, _link_rows(model, tree_lines), headed=False),
        Table(_LINK_HEADINGS, _link_rows(model, chain_lines), ("type", "joint"), headed=False),
    )
    return first_fitting(tables, output_width())


def _link_rows(model: RobotModel, guides: Guides) -> list[tuple[str, str, str, str]]:
    joints = {joint.child: joint for joint in model.joints}
    children: dict[str, list[str]] = {}
    for joint in model.joints:
        children.setdefault(joint.parent, []).append(joint.child)
    return [(guide + link, *_joint_cells(joints.get(link))) for guide, link in guides(model.root, children)]


def _joint_rows(model: RobotModel) -> list[tuple[str, ...]]:
    """Each joint with its place among the positions; those that do not move of their own have none."""
    places = _places(model)
    return [
        (
            *(joint.name, joint.type, joint.parent, joint.child, places.get(joint.name, "-")),
            _mimic_text(joint) or _limits_text(joint) or "-",
            *(f"{limit:g}" if math.isfinite(limit) else "-" for limit in _greatest(joint)),
            " ".join(f"{part:g}" for part in joint.axis) if joint.type not in _WITHOUT_AXIS else "-",
        )
        for joint in model.joints
    ]


def _places(model: RobotModel) -> dict[str, str]:
    """Which of the positions are a joint's own: "3", or "0..6"."""
    from zstate.model.robot import POSITION_COUNTS

    counts = {joint.name: POSITION_COUNTS[joint.type] for joint in model.joints}
    places: dict[str, str] = {}
    first = 0
    for name in model.joint_names:
        last = first + counts[name] - 1
        places[name] = f"{first}" if first == last else f"{first}..{last}"
        first = last + 1
    return places


def _greatest(joint: Joint) -> tuple[float, float]:
    return (joint.limits.velocity, joint.limits.effort) if joint.type != "fixed" else (math.inf, math.inf)


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
            {
                "line": finding.line,
                "severity": finding.severity,
                "message": finding.message,
                "fix": finding.fix,
            }
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
