"""The types of all messages of zstate on the native wire."""

import importlib

from zstate.message import Message
from zstate.plugins import built_in_plugins

_PARTS = {"Sample", "MotionOutcome"}
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
    for folder in ("wire", *(plugin.name for plugin in built_in_plugins() if plugin.streams))
    for kind in _types_of(f"zstate.{folder}.messages")
    if kind.__name__ not in _PARTS
)
