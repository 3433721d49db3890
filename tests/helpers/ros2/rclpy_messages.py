"""Conversion between JSON and the message classes of a genuine ROS 2, for the rclpy programs."""

from __future__ import annotations

import json
import sys
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any


@cache
def message_class(type_name: str) -> type:
    """The class of ``sensor_msgs/msg/JointState`` or ``sensor_msgs/JointState``."""
    parts = type_name.split("/")
    return getattr(import_module(f"{parts[0]}.msg"), parts[-1])


@cache
def type_hash(type_name: str) -> str:
    """The RIHS01 hash in the JSON file that the generators of ROS 2 install for each message."""
    package, _, name = type_name.split("/")
    description = json.loads(Path(sys.prefix, "share", package, "msg", f"{name}.json").read_text())
    return next(row["hash_string"] for row in description["type_hashes"] if row["type_name"] == type_name)


def build(kind: type, values: dict[str, Any]) -> Any:
    message = kind()
    for name, form in kind.get_fields_and_field_types().items():
        setattr(message, name, _field(form, values[name]))
    return message


def _field(form: str, value: Any) -> Any:
    if form.startswith("sequence<"):
        element = form[len("sequence<") : -1]
        return [_field(element, item) for item in value]
    return build(message_class(form), value) if "/" in form else value


def plain(message: Any) -> dict[str, Any]:
    fields = message.get_fields_and_field_types()
    return {name: _plain_field(form, getattr(message, name)) for name, form in fields.items()}


def _plain_field(form: str, value: Any) -> Any:
    if form.startswith("sequence<"):
        element = form[len("sequence<") : -1]
        return [_plain_field(element, item) for item in value]
    return plain(value) if "/" in form else value
