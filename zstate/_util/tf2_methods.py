"""The methods of tf2_ros.Buffer, for the errors of buffers and listeners that do not have them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from inspect import getattr_static
from typing import NoReturn, TypeVar

TF2_METHODS: Mapping[str, str] = {
    "all_frames_as_string": "frames()",
    "all_frames_as_yaml": "frames()",
    "can_transform": "can_lookup(target, source, at)",
    "can_transform_core": "can_lookup(target, source, at)",
    "can_transform_full": "can_lookup(target, source, at)",
    "get_latest_common_time": "latest(target, source)",
    "lookup_transform": "lookup(target, source, at)",
    "lookup_transform_async": "wait_async(target, source, at)",
    "lookup_transform_core": "lookup(target, source, at)",
    "lookup_transform_full": "lookup_between(target, target_at, source, source_at, fixed)",
    "set_transform": "insert(transform)",
    "set_transform_static": "insert_static(transform)",
    "transform": "lookup(target, source, at) @ points",
    "wait_for_transform": "wait(target, source, at, timeout_s)",
    "wait_for_transform_async": "wait_async(target, source, at)",
}
"""The method of ``TransformBuffer`` for one of tf2_ros.Buffer; stamps ``at`` are integers [ns].

Those of tf in ROS 1, and of C++, are the same in camelCase.
"""


_Class = TypeVar("_Class")


class _Tf2Method:
    """An attribute that raises the error for a method of tf2_ros.Buffer."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __get__(self, buffer: object, owner: type) -> NoReturn:
        raise missing_method(owner if buffer is None else buffer, self._name)


def with_tf2_methods(cls: type[_Class]) -> type[_Class]:
    """``cls``, whose missing methods of tf2_ros.Buffer raise an error with the name here.

    A ``__getattr__`` raises the same error, but makes Python 3.11 find every other attribute more slowly.
    """
    for name in TF2_METHODS:
        camel = re.sub(r"_(.)", lambda match: match[1].upper(), name)
        for spelling in (name, camel):
            setattr(cls, spelling, _Tf2Method(spelling))

    def names(self: object) -> Iterable[str]:
        found = object.__dir__(self)
        return [name for name in found if not isinstance(getattr_static(self, name, None), _Tf2Method)]

    cls.__dir__ = names
    return cls


def missing_method(owner: object, name: str, buffer: object = None) -> AttributeError:
    """The error for a ``name`` that a transform buffer does not have, or a listener that fills ``buffer``."""
    place = "" if buffer is None else "buffer."
    hint = ""
    if instead := TF2_METHODS.get(re.sub(r"(?=[A-Z])", "_", name).lower()):
        hint = f"; tf2's {name} is {place}{instead} here, with stamps in integer nanoseconds"
    elif buffer is not None and hasattr(buffer, name):
        hint = f"; it is {place}{name}"
    return AttributeError(f"{type(owner).__name__!r} object has no attribute {name!r}{hint}")
