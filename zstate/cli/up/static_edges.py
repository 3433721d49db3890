"""Static edges of a file: their poses, from its tables or from calibration files, and their robots."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, cast

from zstate.buffer.buffer import TransformBuffer
from zstate.cli.up.cell import Cell, StaticSection, as_tuple
from zstate.cli.up.template import Located
from zstate.errors import ConfigError, InvalidInput
from zstate.transform import Transform
from zstate.wire.keys import check_robot, full_name

_FORMS = (
    "what easy_handeye and easy_handeye2 save, what `ros2 topic echo /tf_static` prints, or target, source, "
    "xyz and rpy_deg, rpy or quat_xyzw"
)
_SECTION_KEYS = frozenset({"target", "source", "xyz", "rpy_deg", "rpy", "quat_xyzw"})


@dataclass(frozen=True, slots=True)
class OwnedEdge:
    """An edge, its robot (None: unknown), and the wires to publish it on (None: those of the command)."""

    edge: Transform
    robot: str | None = None
    wires: tuple[str, ...] | None = None


def owned_edges(cell: Cell, robots: Sequence[str]) -> list[OwnedEdge]:
    """The edges of every [[static]], of the ``robots`` of the file. Raises ConfigError."""
    return [
        OwnedEdge(edge, robot, table.section.wires)
        for table in cell.static
        for edge in _table_edges(table)
        for robot in _table_robots(table, robots, edge) or (None,)
    ]


def check_edges(cell: Cell, robots: Sequence[str]) -> None:
    """Raise ConfigError if an edge has no robot, or if the edges of a robot contradict each other."""
    buffer = TransformBuffer()
    for table in cell.static:
        for edge in _table_edges(table):
            owners = _table_robots(table, robots, edge)
            if not owners:
                raise table.error(
                    f"the robot of this edge is unknown; add robot = (in this file: {_listed(robots)})"
                )
            try:
                for robot in map(check_robot, owners):
                    target, source = full_name(robot, edge.target), full_name(robot, edge.source)
                    buffer.insert_static(with_frames(edge, target, source))
            except InvalidInput as error:
                raise table.error(str(error)) from None


def with_frames(edge: Transform, target: str | None, source: str | None) -> Transform:
    """The same pose between other frames; None keeps a name."""
    return Transform(target or edge.target, source or edge.source, edge.translation, edge.rotation)


def _table_edges(table: Located[StaticSection]) -> tuple[Transform, ...]:
    section = table.section
    if section.file is None:
        return (section.transform(),)
    try:
        found = read_calibration(Path(table.resolve(section.file)))
    except ConfigError as error:
        raise table.error(str(error), "file") from None
    if len(found) > 1 and (section.target or section.source):
        raise table.error(f"{section.file!r} has {len(found)} transforms; leave out target and source")
    return tuple(with_frames(edge, section.target, section.source) for edge in found)


def _table_robots(table: Located[StaticSection], robots: Sequence[str], edge: Transform) -> tuple[str, ...]:
    patterns = as_tuple(table.section.robot)
    if not patterns:
        named = [frame.partition("/")[0] for frame in (edge.source, edge.target) if "/" in frame]
        return tuple(named[:1]) or (tuple(robots) if len(robots) == 1 else ())
    names: dict[str, None] = {}
    for pattern in patterns:
        matching = [robot for robot in robots if fnmatchcase(robot, pattern)] if "*" in pattern else [pattern]
        if not matching:
            raise table.error(f"no robot matches {pattern!r}; in this file: {_listed(robots)}", "robot")
        names |= dict.fromkeys(matching)
    return tuple(names)


def _listed(robots: Sequence[str]) -> str:
    return ", ".join(map(repr, robots)) or "none"


def read_calibration(path: Path) -> tuple[Transform, ...]:
    """The edges in a YAML or JSON file. Raises ConfigError with the file and the missing key.

    The camera of easy_handeye is placed on the effector if the eye is in the hand, else on the base.
    """
    try:
        found = tuple(_calibrated_edges(_document(path)))
    except InvalidInput as error:
        raise ConfigError(f"{path}: {error}", path=str(path)) from None
    except RecursionError:
        raise ConfigError(f"{path} cannot be read: it is nested too deeply", path=str(path)) from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        lacking = f"has no {error.args[0]!r}" if isinstance(error, KeyError) else f"cannot be read: {error}"
        raise ConfigError(f"{path} {lacking}; a calibration is {_FORMS}", path=str(path)) from None
    if not found:
        raise ConfigError(f"{path} has no transform; a calibration is {_FORMS}", path=str(path))
    return found


def _document(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InvalidInput(f"it cannot be read: {error.strerror}") from None
    if path.suffix == ".json":
        return json.loads(text)
    import yaml

    try:
        # `ros2 topic echo` ends a document with a line of dashes, after which there is nothing.
        return next((one for one in yaml.safe_load_all(text) if one is not None), None)
    except yaml.YAMLError as error:
        raise InvalidInput(f"it is not YAML: {' '.join(str(error).split())}") from None


def _calibrated_edges(document: Any) -> Sequence[Transform]:
    if isinstance(document, list):
        return [edge for one in cast("list[Any]", document) for edge in _calibrated_edges(one)]
    if not isinstance(document, dict):
        raise InvalidInput(f"it holds no transform; a calibration is {_FORMS}")
    table = cast("dict[str, Any]", document)
    for several in ("static", "transforms"):
        if several in table:
            return _calibrated_edges(table[several])
    if "child_frame_id" in table:
        return [_ros_transform(table["header"]["frame_id"], table["child_frame_id"], table["transform"])]
    if "transformation" in table or "transform" in table:
        # The oldest files have the parameters at the top level, like the transformation.
        parameters = table.get("parameters", table)
        in_hand = parameters.get("eye_on_hand", parameters.get("calibration_type") == "eye_in_hand")
        target = parameters["robot_effector_frame" if in_hand else "robot_base_frame"]
        source = parameters["tracking_base_frame"]
        if "transform" in table:
            return [_ros_transform(target, source, table["transform"])]
        pose = table["transformation"]
        xyz, rotation = _numbers(pose, "x", "y", "z"), _numbers(pose, "qx", "qy", "qz", "qw")
        return [Transform(target, source, xyz, rotation)]
    unknown = sorted(set(table) - _SECTION_KEYS)
    if unknown:
        raise InvalidInput(f"{', '.join(map(repr, unknown[:5]))} is unknown; a calibration is {_FORMS}")
    return [StaticSection(**table).transform()]


def _ros_transform(target: str, source: str, pose: Mapping[str, Any]) -> Transform:
    rotation = _numbers(pose["rotation"], "x", "y", "z", "w")
    return Transform(target, source, _numbers(pose["translation"], "x", "y", "z"), rotation)


def _numbers(table: Mapping[str, Any], *names: str) -> list[float]:
    return [float(table[name]) for name in names]
