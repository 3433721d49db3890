"""Serialization and type hashes of a genuine ROS 2, by request (json_lines.py)."""

from __future__ import annotations

from typing import Any

from json_lines import serve
from rclpy.serialization import deserialize_message, serialize_message
from rclpy_messages import build, message_class, plain, type_hash


def serialize(type: str, message: dict[str, Any]) -> str:
    """The bytes, in hexadecimal. Their padding, and up to 8 bytes after the end, are uninitialised."""
    return serialize_message(build(message_class(type), message)).hex()


def deserialize(type: str, data: str) -> dict[str, Any]:
    return plain(deserialize_message(bytes.fromhex(data), message_class(type)))


if __name__ == "__main__":
    serve({"serialize": serialize, "deserialize": deserialize, "hash": type_hash})
