"""Names of tf2, and of other folders of zstate, for the errors of attributes that do not exist."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from inspect import getattr_static
from pathlib import Path
from typing import NoReturn, TypeVar

TF2_CLASSES: Mapping[str, str] = {
    "Buffer": "TransformBuffer",
    "BufferClient": "TransformListener",
    "BufferCore": "TransformBuffer",
    "BufferInterface": "TransformBuffer",
    "ConnectivityException": "Disconnected",
    "ExtrapolationException": "InFuture or zstate.InPast",
    "InvalidArgumentException": "InvalidInput",
    "LookupException": "UnknownFrame",
    "MessageFilter": "TransformBuffer.join",
    "StaticTransformBroadcaster": "StaticPublisher",
    "TimeoutException": "LookupFailed",
    "TransformBroadcaster": "TransformPublisher",
    "TransformException": "LookupFailed",
    "TransformStamped": "Transform",
}
"""The class of zstate for one of tf2_ros, tf2 or geometry_msgs."""

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

    A ``__getattr__`` says the same, but makes Python 3.11 find every other attribute more slowly.
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


def missing_name(package: str, folder: Path, name: str) -> AttributeError:
    """The error for a ``name`` that ``package``, in ``folder``, does not export, with where it is.

    Python itself adds the most similar name of the module.
    """
    hint = ""
    if name in TF2_CLASSES:
        hint = f"; tf2's {name} is {package}.{TF2_CLASSES[name]} here"
    elif module := _module_of(package, folder, name):
        hint = f"; it is {module}.{name}"
    return AttributeError(f"module {package!r} has no attribute {name!r}{hint}")


def missing_method(owner: object, name: str, buffer: object = None) -> AttributeError:
    """The error for a ``name`` that a transform buffer does not have, or a listener that fills ``buffer``."""
    place = "" if buffer is None else "buffer."
    hint = ""
    if instead := TF2_METHODS.get(re.sub(r"(?=[A-Z])", "_", name).lower()):
        hint = f"; tf2's {name} is {place}{instead} here, with stamps in integer nanoseconds"
    elif buffer is not None and hasattr(buffer, name):
        hint = f"; it is {place}{name}"
    return AttributeError(f"{type(owner).__name__!r} object has no attribute {name!r}{hint}")


def _module_of(package: str, folder: Path, name: str) -> str:
    """The module of ``package`` that exports ``name``, without loading it; empty without one."""
    import pkgutil  # noqa: PLC0415 - for mistakes alone
    from importlib import import_module  # noqa: PLC0415

    if name.startswith("_"):
        return ""
    if hasattr(import_module(f"{package}.errors"), name):
        return f"{package}.errors"
    for module in pkgutil.iter_modules([str(folder)]):
        source = folder / (f"{module.name}/__init__.py" if module.ispkg else f"{module.name}.py")
        if source.exists() and name in _exports(source):
            return f"{package}.{module.name}"
    return ""


def _exports(source: Path) -> Sequence[str]:
    """The names in ``__all__`` of a module."""
    import ast  # noqa: PLC0415 - for mistakes alone

    for statement in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__all__":
            return ast.literal_eval(statement.value)
    return ()
