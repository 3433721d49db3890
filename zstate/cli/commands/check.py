"""zstate check: findings about a robot model, and its tree of links or table of joints."""

from __future__ import annotations

import math
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from zstate.cli import options
from zstate.cli.output.console import count_text, output_width, print_json, print_wrapped
from zstate.cli.output.text_layout import Guides, Table, chain_lines, first_fitting, in_columns, tree_lines
from zstate.errors import FindingLike, ModelError

if TYPE_CHECKING:
    from zstate.model.findings import Finding
    from zstate.model.robot import Joint, RobotModel

Findings = Sequence[FindingLike]

_STDIN = "standard input"
_WITHOUT_AXIS = ("fixed", "floating")
_JOINT_HEADINGS = ("joint", "type", "parent", "child", "position", "range", "velocity", "effort", "axis")


@click.command("check")
@click.argument("file", type=options.MODEL)
@options.xacro_arguments
@click.option("--fix-hints", is_flag=True, help="Print a correction below each finding.")
@click.option(
    "--joints", "joint_table", is_flag=True, help="Print the joints as a table instead of the tree."
)
@options.json_option("One JSON object.")
def check_command(
    file: str, xacro_args: dict[str, str], fix_hints: bool, joint_table: bool, as_json: bool
) -> None:
    """Check the robot model in FILE: print its findings, then its tree of links and joints.

    FILE is URDF or xacro, "-" for standard input, or a name such as "panda"; NAME:=VALUE are xacro
    arguments. Each finding has its line. Exit code 1 if the model cannot be used; warnings do not count.

    \b
    zstate check arm.urdf --fix-hints
    zstate check panda --joints                        # the order of positions, limits, axes, mimics
    zstate check arm.urdf.xacro prefix:=left_
    xacro arm.xacro | zstate check -
    """
    from zstate.model.load import load_model

    name = _STDIN if file == "-" else file
    model, findings = None, ()
    try:
        model = load_model(sys.stdin.buffer.read() if file == "-" else file, xacro_args=xacro_args)
        findings = (*model.findings, *_missing_meshes(model, file))
    except ModelError as error:
        if not error.findings:
            raise
        findings = error.findings
    if as_json:
        print_json(_facts(name, model, findings))
    else:
        print_wrapped(_report(name, model, findings, fix_hints=fix_hints, joint_table=joint_table))
    raise SystemExit(0 if model else 1)


def _missing_meshes(model: RobotModel, source: str) -> Iterator[Finding]:
    """A warning for each mesh file that cannot be found, as `zstate view` looks for them."""
    from zstate.model.findings import Finding
    from zstate.model.geometry import MeshFile, read_shapes
    from zstate.model.mesh_paths import MeshPaths, MissingFile

    # Relative paths start at the URDF file; models of the catalog have packages only.
    path = Path.cwd() / "stdin" if source == "-" else Path(source)
    paths = MeshPaths(path.parent if source == "-" or path.is_file() else None)
    lines = model.urdf.splitlines()
    shapes, _ = read_shapes(model)
    for uri in dict.fromkeys(shape.geometry.uri for shape in shapes if isinstance(shape.geometry, MeshFile)):
        found = paths.find(uri)
        if isinstance(found, MissingFile):
            line = next((number for number, text in enumerate(lines, 1) if uri in text), None)
            yield Finding(line, f"the mesh {uri!r} is missing, so it is not drawn: {found.why}", "warning")


def _report(
    name: str, model: RobotModel | None, findings: Findings, *, fix_hints: bool, joint_table: bool
) -> str:
    if model is None:
        errors = sum(finding.severity == "error" for finding in findings)
        lines = [f"{name} cannot be used ({count_text(errors, 'error')})"]
    else:
        lines = [
            f"{name}: robot {model.name!r}, {count_text(len(model.links), 'link')}, "
            f"{count_text(len(model.joints), 'joint')} ({len(model.joint_names)} driven)"
        ]
    places = ("file" if finding.line is None else f"line {finding.line}" for finding in findings)
    cells = [(place, one.severity, one.message) for place, one in zip(places, findings, strict=True)]
    for row, finding in zip(in_columns(cells), findings, strict=True):
        lines += [f"  {row}"]
        if fix_hints and finding.fix:
            lines += [f"      fix: {finding.fix}"]
    if model is not None:
        lines += _joint_lines(model) if joint_table else _link_lines(model)
    elif not fix_hints and name != _STDIN and any(finding.fix for finding in findings):
        lines += [f"`zstate check {shlex.quote(name)} --fix-hints` prints corrections"]
    return "\n".join(lines)


def _link_lines(model: RobotModel) -> list[str]:
    """The tree of links, each with the joint that leads to it."""
    joints = {joint.child: joint for joint in model.joints}
    children: dict[str, list[str]] = {}
    for joint in model.joints:
        children.setdefault(joint.parent, []).append(joint.child)

    def rows(guides: Guides) -> list[tuple[str, ...]]:
        (_, root), *links = guides(model.root, children)
        found: list[tuple[str, ...]] = [(root, "", "", "")]
        for guide, link in links:
            joint = joints[link]
            found.append((guide + link, joint.name, joint.type, _range_text(joint)))
        return found

    headings = ("link", "joint", "type", "range")
    tables = (
        Table(headings, rows(tree_lines), headed=False),
        Table(headings, rows(chain_lines), optional=("type", "joint"), headed=False),
    )
    return first_fitting(tables, output_width())


def _joint_lines(model: RobotModel) -> list[str]:
    """Each joint with its indices in the positions, "3" or "0..6"; "-" if it is not driven."""
    from zstate.model.robot import POSITION_COUNTS

    by_name = {joint.name: joint for joint in model.joints}
    indices: dict[str, str] = {}
    first = 0
    for name in model.joint_names:
        last = first + POSITION_COUNTS[by_name[name].type] - 1
        indices[name] = f"{first}" if first == last else f"{first}..{last}"
        first = last + 1
    rows = [
        (
            *(joint.name, joint.type, joint.parent, joint.child, indices.get(joint.name, "-")),
            _range_text(joint) or "-",
            *(
                f"{limit:g}" if joint.type != "fixed" and math.isfinite(limit) else "-"
                for limit in (joint.limits.velocity, joint.limits.effort)
            ),
            " ".join(f"{part:g}" for part in joint.axis) if joint.type not in _WITHOUT_AXIS else "-",
        )
        for joint in model.joints
    ]
    optional = ("axis", "effort", "velocity", "parent", "type")
    return Table(_JOINT_HEADINGS, rows, optional).lines(output_width())


def _range_text(joint: Joint) -> str:
    """The mimic rule or the limits; empty for a joint without either."""
    if joint.mimic is not None:
        offset = f" {joint.mimic.offset:+g}" if joint.mimic.offset else ""
        return f"{joint.mimic.multiplier:g} * {joint.mimic.joint}{offset}"
    unit = {"revolute": "rad", "prismatic": "m"}.get(joint.type)
    return f"{joint.limits.lower:g} to {joint.limits.upper:g} {unit}" if unit else ""


def _facts(name: str, model: RobotModel | None, findings: Findings) -> dict[str, Any]:
    def joint_facts(joint: Joint) -> dict[str, Any]:
        lower, upper = joint.limits.lower, joint.limits.upper
        facts: dict[str, Any] = {
            **{key: getattr(joint, key) for key in ("name", "type", "parent", "child", "line")},
            # JSON has no infinity; a missing limit is null.
            "lower": lower if math.isfinite(lower) else None,
            "upper": upper if math.isfinite(upper) else None,
        }
        return facts if joint.mimic is None else {**facts, "mimic": asdict(joint.mimic)}

    keys = ("line", "severity", "message", "fix")
    facts: dict[str, Any] = {
        "source": name,
        "usable": model is not None,
        "findings": [{key: getattr(one, key) for key in keys} for one in findings],
    }
    if model is not None:
        facts |= {"robot": model.name, "digest": model.digest, "root": model.root, "links": model.links}
        facts["joints"] = [joint_facts(joint) for joint in model.joints]
    return facts
