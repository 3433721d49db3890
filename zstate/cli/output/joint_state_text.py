"""Joint states and transforms as documents, and documents as YAML, CSV or a single field."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable
from math import isnan
from threading import Event
from typing import TYPE_CHECKING, Any, TypeAlias, cast

from zstate._util.closeable import Closeable
from zstate._util.format import did_you_mean
from zstate.cli.output.console import print_status
from zstate.clock import wait_interruptible
from zstate.errors import InvalidInput, ModelError
from zstate.model.urdf import parse_urdf
from zstate.net.subscription import Received, subscribe
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    TransformSample,
    from_block,
    order_digest,
    poses_from_block,
)
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session

Numbers: TypeAlias = "dict[str, float | list[float]] | list[float]"
Document: TypeAlias = "dict[str, int | Numbers | dict[str, dict[str, list[float]]]]"

_BLOCKS = ("positions", "velocities", "efforts")
# A description arrives within milliseconds if the robot publishes one.
_DESCRIPTION_WITHIN_S = 1.0
# Keys that YAML reads as text without quotes.
_PLAIN = re.compile(r"[A-Za-z_][\w./-]*", re.ASCII)
_YAML_CONSTANTS = {"true", "false", "yes", "no", "on", "off", "null", "y", "n"}
_ALWAYS_NEW = {"stamp", "seq"}


class JointStateFormatter:
    """Formats joint states as documents.

    A document has "stamp" [ns], "seq", and those of "positions", "velocities" and "efforts" that were
    sent, by joint name; a joint with several numbers has a list. Unknown names leave plain lists.
    """

    def __init__(self) -> None:
        self.model: RobotModel | None = None
        """The model of the newest description, or None if its URDF cannot be parsed."""
        self._names: tuple[str, ...] = ()
        self._order = b""

    def set_description(self, description: RobotDescription) -> None:
        """Use the joint names of ``description``."""
        self._names = description.joint_names
        self._order = order_digest(self._names)
        try:
            # Plain URDF only: input from the network opens no files and runs no xacro.
            self.model = parse_urdf(description.urdf, "its URDF")
        except ModelError:
            self.model = None  # the names suffice for joints with one number

    def has_names(self, state: JointState) -> bool:
        """Whether the joint names of ``state`` are known."""
        return state.names is not None or state.order == self._order

    def document(self, state: JointState) -> Document:
        """``state`` as a document."""
        document: Document = {"stamp": state.stamp, "seq": state.seq}
        for name in _BLOCKS:
            block = cast("bytes | None", getattr(state, name))
            if block is not None:
                document[name] = self._by_joint(state, name, from_block(block).tolist())
        return document

    def _by_joint(self, state: JointState, block: str, numbers: list[float]) -> Numbers:
        names = state.names if state.names is not None else self._names if self.has_names(state) else ()
        if len(names) == len(numbers):
            return dict(zip(names, numbers, strict=True))
        model = self.model
        if state.names is not None or model is None or model.joint_names != names:
            return numbers
        is_position = block == "positions"
        count = model.position_count if is_position else model.velocity_count
        if len(numbers) != count:
            return numbers
        starts = model.columns if is_position else model.velocity_columns
        ends = [*list(starts.values())[1:], count]
        return {
            name: numbers[start] if end - start == 1 else numbers[start:end]
            for (name, start), end in zip(starts.items(), ends, strict=True)
        }


class DescribedJointStates(JointStateFormatter, Closeable):
    """Formats the joint states of ``robot`` with the joint names of its published description."""

    def __init__(self, session: Session, robot: str, wire: str = "native") -> None:
        super().__init__()
        self._robot = robot
        self._described = Event()
        self._warned = False
        self._subscriber = subscribe(
            session,
            get_wire(wire),
            robot,
            "robot_description",
            self._on_descriptions,
            on_error=lambda _, text: print_status(text),
        )

    def close(self) -> None:
        self._subscriber.close()

    def document(self, state: JointState) -> Document:
        """``state`` as a document. Waits up to 1 s for the description if the names are unknown, once."""
        if not self.has_names(state) and not self._warned:
            wait_interruptible(self._described, _DESCRIPTION_WITHIN_S)
            if not self.has_names(state):
                self._warned = True
                reason = "is for another model" if self._described.is_set() else "is missing"
                print_status(
                    f"the description of {self._robot!r} {reason}, so its joints are shown without names; "
                    f"`zstate publish {self._robot}` publishes it"
                )
        return super().document(state)

    def _on_descriptions(self, received: list[Received]) -> None:
        for _, _, description in received:
            assert isinstance(description, RobotDescription)
            self.set_description(description)
            self._described.set()


def transforms_document(sample: TransformSample, robot: str) -> Document:
    """``sample`` as a document: "stamp" [ns], "seq", and "transforms", poses by "parent -> child"."""
    poses = poses_from_block(sample.poses).tolist()
    edges = zip(sample.edges or (), poses, strict=False)
    transforms = {
        f"{parent} -> {child}": {"translation": pose[:3], "rotation": pose[3:]}
        for (parent, child), pose in edges
    }
    return {"stamp": sample.stamp, "seq": sample.seq, "transforms": transforms}


def yaml_text(value: Any, indent: str = "") -> str:
    """Mappings, lists of numbers and numbers as YAML, without a final line end."""
    if not isinstance(value, dict):
        return json.dumps(value)
    lines: list[str] = []
    for key, inner in cast("dict[str, Any]", value).items():
        is_plain = _PLAIN.fullmatch(key) and key.lower() not in _YAML_CONSTANTS
        is_block = isinstance(inner, dict) and inner != {}
        text = f"\n{yaml_text(inner, indent + '  ')}" if is_block else f" {json.dumps(inner)}"
        lines.append(f"{indent}{key if is_plain else json.dumps(key)}:{text}")
    return "\n".join(lines)


def flatten(value: Any, name: str = "") -> dict[str, int | float | str]:
    """The numbers and texts of a document, or of a part of one, by dotted names such as "positions.elbow"."""
    if isinstance(value, dict):
        items = list(cast("dict[str, Any]", value).items())
    elif isinstance(value, list):
        items = [(str(index), inner) for index, inner in enumerate(cast("list[Any]", value))]
    else:
        return {name: value}
    numbers: dict[str, int | float | str] = {}
    for key, inner in items:
        numbers |= flatten(inner, f"{name}.{key}" if name else key)
    return numbers


class ChangeFilter:
    """Filters documents, or parts of them, that differ from the last accepted one by more than ``by``."""

    def __init__(self, by: float = 0.0) -> None:
        self._by = by
        self._last: dict[str, int | float | str] | None = None

    def accepts(self, value: Any) -> bool:
        """Whether ``value`` has changed; the stamp and sequence number of a whole document do not count."""
        numbers, last = flatten(value), self._last
        if numbers.keys() >= _ALWAYS_NEW:
            numbers = {name: number for name, number in numbers.items() if name not in _ALWAYS_NEW}
        if last is not None and last.keys() == numbers.keys():
            pairs = [(last[name], number) for name, number in numbers.items()]
            # NaN, which ROS drivers send for a quantity they do not measure, differs from any number.
            if not any(self._differ(old, new) for old, new in pairs):
                return False
        self._last = numbers
        return True

    def _differ(self, old: float | str, new: float | str) -> bool:
        if isinstance(old, str) or isinstance(new, str):  # the frame of a scan or a map
            return old != new
        return abs(new - old) > self._by or isnan(new) != isnan(old)


class CsvFormatter:
    """Formats documents as CSV lines; a header line comes first and after every change of the names."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def lines(self, value: Any, name: str) -> list[str]:
        """The lines for one document, or for its part ``name``."""
        numbers = flatten(value, name)
        header = [] if list(numbers) == self._names else [_csv_line(numbers)]
        self._names = list(numbers)
        return [*header, _csv_line(numbers.values())]


def _csv_line(cells: Iterable[Any]) -> str:
    line = io.StringIO()
    csv.writer(line, lineterminator="").writerow(cells)
    return line.getvalue()


def select_field(document: Document, field: str) -> Any:
    """The part of a document named "stamp", "positions" or "positions.elbow"; "elbow" means the position.

    Raises InvalidInput with the list of fields if there is no such field.
    """
    fields: dict[str, Any] = dict(document)
    for block, numbers in document.items():
        if isinstance(numbers, dict):
            fields |= {f"{block}.{joint}": value for joint, value in numbers.items()}
    for name in (field, f"positions.{field}"):
        if name in fields:
            return fields[name]
    joints = list(dict.fromkeys(name.partition(".")[2] for name in fields if "." in name))
    hint = did_you_mean(field, [*fields, *joints])
    raise InvalidInput(
        f"a joint state of this robot has no field {field!r}{hint} (fields: {', '.join(document)}; "
        f"joints: {', '.join(joints) or 'without names'})"
    )
