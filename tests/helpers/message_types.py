"""The types of all messages of zstate on the native wire."""

import importlib

from zstate.driving.messages import MotionOutcome
from zstate.message import Message
from zstate.wire.messages import Sample

_PARTS = {Sample, MotionOutcome}
"""Not sent by themselves."""


def _types_of(module: str) -> list[type[Message]]:
    values = vars(importlib.import_module(module)).values()
    return [
        kind
        for kind in values
        if isinstance(kind, type) and issubclass(kind, Message) and kind.__module__ == module
    ]


MESSAGE_TYPES = tuple(
    kind
    for folder in ("wire", "driving", "odometry", "scans")
    for kind in _types_of(f"zstate.{folder}.messages")
    if kind not in _PARTS
)
