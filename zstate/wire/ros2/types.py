"""The ROS 2 message types of a robot's state: their names, their fields, and the hash of these."""

from __future__ import annotations

import json
from collections.abc import Iterator
from hashlib import sha256
from typing import Any, NamedTuple

# Package/Type to its fields, as (type, name) in the notation of .msg files.
_FIELDS: dict[str, tuple[tuple[str, str], ...]] = {
    "builtin_interfaces/Time": (("int32", "sec"), ("uint32", "nanosec")),
    "std_msgs/Header": (("builtin_interfaces/Time", "stamp"), ("string", "frame_id")),
    "std_msgs/String": (("string", "data"),),
    "rosgraph_msgs/Clock": (("builtin_interfaces/Time", "clock"),),
    "sensor_msgs/JointState": (
        ("std_msgs/Header", "header"),
        ("string[]", "name"),
        ("float64[]", "position"),
        ("float64[]", "velocity"),
        ("float64[]", "effort"),
    ),
    "geometry_msgs/Vector3": (("float64", "x"), ("float64", "y"), ("float64", "z")),
    "geometry_msgs/Quaternion": (("float64", "x"), ("float64", "y"), ("float64", "z"), ("float64", "w")),
    "geometry_msgs/Transform": (
        ("geometry_msgs/Vector3", "translation"),
        ("geometry_msgs/Quaternion", "rotation"),
    ),
    "geometry_msgs/TransformStamped": (
        ("std_msgs/Header", "header"),
        ("string", "child_frame_id"),
        ("geometry_msgs/Transform", "transform"),
    ),
    "tf2_msgs/TFMessage": (("geometry_msgs/TransformStamped[]", "transforms"),),
}
# The numbers of type_description_interfaces/FieldType.
_NESTED, _UNBOUNDED_SEQUENCE = 1, 144
_PRIMITIVES = {"int32": 6, "uint32": 7, "float64": 11, "string": 17}

_SEPARATOR = "=" * 80


class RosType(NamedTuple):
    """A message type by all the names it goes by.

    ``name`` is the one people use, ``dds`` the one in key expressions, ``hash`` tells one version of
    its fields from another (RIHS01), ``definition`` says the fields themselves, as .msg files joined
    in the way of the schema encoding "ros2msg".
    """

    name: str
    dds: str
    hash: str
    definition: str


def _ros_type(short: str) -> RosType:
    package, kind = short.split("/")
    return RosType(_full(short), f"{package}::msg::dds_::{kind}_", _hash(short), _definition(short))


def _full(short: str) -> str:
    return short.replace("/", "/msg/")


def _with_parts(short: str) -> Iterator[str]:
    """A type and, each after the one that needs it, the types of its fields; some more than once."""
    yield short
    for kind, _ in _FIELDS[short]:
        if (part := kind.removesuffix("[]")) in _FIELDS:
            yield from _with_parts(part)


def _hash(short: str) -> str:
    """The SHA-256 of the fields in the one spelling of JSON that REP-2016 prescribes."""
    parts = sorted(set(_with_parts(short)) - {short})
    described = {
        "type_description": _description(short),
        "referenced_type_descriptions": [_description(part) for part in parts],
    }
    return f"RIHS01_{sha256(json.dumps(described).encode()).hexdigest()}"


def _description(short: str) -> dict[str, Any]:
    fields = [{"name": name, "type": _field_type(kind)} for kind, name in _FIELDS[short]]
    return {"type_name": _full(short), "fields": fields}


def _field_type(kind: str) -> dict[str, Any]:
    item = kind.removesuffix("[]")
    return {
        "type_id": _PRIMITIVES.get(item, _NESTED) + (_UNBOUNDED_SEQUENCE if item != kind else 0),
        "capacity": 0,
        "string_capacity": 0,
        "nested_type_name": _full(item) if item in _FIELDS else "",
    }


def _definition(short: str) -> str:
    first, *parts = (
        f"MSG: {part}\n" + "".join(f"{kind} {name}\n" for kind, name in _FIELDS[part])
        for part in dict.fromkeys(_with_parts(short))
    )
    _, _, fields = first.partition("\n")
    return f"{_SEPARATOR}\n".join([fields, *parts])


JOINT_STATE = _ros_type("sensor_msgs/JointState")
TF_MESSAGE = _ros_type("tf2_msgs/TFMessage")
STRING = _ros_type("std_msgs/String")
CLOCK = _ros_type("rosgraph_msgs/Clock")
