"""Files that say where one frame is in another: what calibrations write, and what we write ourselves."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from zstate.cli.up.sections import StaticSection
from zstate.errors import ConfigError, InvalidInput, LibraryMissing
from zstate.transform import Transform

_FORMS = (
    "what easy_handeye and easy_handeye2 save, what `ros2 topic echo /tf_static` prints, or target, source, "
    "xyz and rpy_deg, rpy or quat_xyzw"
)
_SECTION_KEYS = frozenset({"target", "source", "xyz", "rpy_deg", "rpy", "quat_xyzw"})


def read_calibration(path: Path) -> tuple[Transform, ...]:
    """The edges in a YAML or JSON file. Raises ConfigError naming the file and what it lacks.

    easy_handeye's camera is placed on the effector where the eye is in the hand, else on the base.
    """
    try:
        found = tuple(_edges(_document(path)))
    except InvalidInput as error:
        raise ConfigError(f"{path}: {error}", path=str(path)) from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        lacking = f"has no {error.args[0]!r}" if isinstance(error, KeyError) else f"cannot be read: {error}"
        raise ConfigError(f"{path} {lacking}; a calibration is {_FORMS}", path=str(path)) from None
    if not found:
        raise ConfigError(f"{path} has no transform; a calibration is {_FORMS}", path=str(path))
    return found


def renamed(edge: Transform, target: str | None, source: str | None) -> Transform:
    """The same pose between frames that are called otherwise here."""
    return Transform(target or edge.target, source or edge.source, edge.translation, edge.rotation)


def _document(path: Path) -> Any:
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise InvalidInput(f"it cannot be read: {error.strerror}") from None
    if path.suffix == ".json":
        return json.loads(text)
    return _yaml_document(text)


def _yaml_document(text: str) -> Any:
    try:
        import yaml
    except ImportError:
        raise LibraryMissing(
            "calibrations in YAML need PyYAML: pip install 'zstate[yaml]'; JSON and TOML do without"
        ) from None
    try:
        # `ros2 topic echo` ends a document with a line of dashes, and nothing follows.
        return next((one for one in yaml.safe_load_all(text) if one is not None), None)
    except yaml.YAMLError as error:
        raise InvalidInput(f"it is not YAML: {' '.join(str(error).split())}") from None


def _edges(document: Any) -> Sequence[Transform]:
    if isinstance(document, list):
        return [edge for one in cast("list[Any]", document) for edge in _edges(one)]
    if not isinstance(document, dict):
        raise InvalidInput(f"it holds no transform; a calibration is {_FORMS}")
    table = cast("dict[str, Any]", document)
    for several in ("static", "transforms"):
        if several in table:
            return _edges(table[several])
    if "child_frame_id" in table:
        frame = table["header"]["frame_id"]
        return [_ros_transform(frame, table["child_frame_id"], table["transform"])]
    if "transformation" in table or "transform" in table:
        return [_handeye(table)]
    unknown = sorted(set(table) - _SECTION_KEYS)
    if unknown:
        raise InvalidInput(f"{', '.join(map(repr, unknown[:5]))} is unknown; a calibration is {_FORMS}")
    return [StaticSection(**table).transform()]


def _handeye(table: Mapping[str, Any]) -> Transform:
    # The oldest files have the parameters beside the transformation.
    parameters = table.get("parameters", table)
    in_hand = parameters.get("eye_on_hand", parameters.get("calibration_type") == "eye_in_hand")
    target = parameters["robot_effector_frame" if in_hand else "robot_base_frame"]
    source = parameters["tracking_base_frame"]
    if "transform" in table:
        return _ros_transform(target, source, table["transform"])
    pose = table["transformation"]
    return Transform(target, source, _numbers(pose, "x", "y", "z"), _numbers(pose, "qx", "qy", "qz", "qw"))


def _ros_transform(target: str, source: str, pose: Mapping[str, Any]) -> Transform:
    turn = _numbers(pose["rotation"], "x", "y", "z", "w")
    return Transform(target, source, _numbers(pose["translation"], "x", "y", "z"), turn)


def _numbers(table: Mapping[str, Any], *names: str) -> list[float]:
    return [float(table[name]) for name in names]
