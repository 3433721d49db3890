"""Names of tf2, and of other folders of zstate, for the errors of attributes that do not exist."""

from __future__ import annotations

import ast
import pkgutil
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

TF2_CLASSES: Mapping[str, str] = {
    "Buffer": "TransformBuffer",
    "BufferCore": "TransformBuffer",
    "ConnectivityException": "Disconnected",
    "ExtrapolationException": "InFuture or zstate.InPast",
    "InvalidArgumentException": "InvalidInput",
    "LookupException": "UnknownFrame",
    "StaticTransformBroadcaster": "StaticPublisher",
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
    "wait_for_transform_async": "wait_async(target, source, at)",
}
"""The method of ``TransformBuffer`` for one of tf2_ros.Buffer; stamps ``at`` are integers [ns]."""


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


def missing_method(owner: object, name: str) -> AttributeError:
    """The error for a ``name`` that a transform buffer does not have."""
    instead = TF2_METHODS.get(name)
    hint = f"; tf2's {name} is {instead} here, with stamps in integer nanoseconds" if instead else ""
    return AttributeError(f"{type(owner).__name__!r} object has no attribute {name!r}{hint}")


def _module_of(package: str, folder: Path, name: str) -> str:
    """The module of ``package`` that exports ``name``, without loading it; empty without one."""
    if name.startswith("_"):
        return ""
    if hasattr(import_module(f"{package}.errors"), name):
        return f"{package}.errors"
    for module in pkgutil.iter_modules([str(folder)]):
        source = folder / module.name / "__init__.py"
        if module.ispkg and source.exists() and name in _exports(source):
            return f"{package}.{module.name}"
    return ""


def _exports(source: Path) -> Sequence[str]:
    """The names in ``__all__`` of a module."""
    for statement in ast.parse(source.read_text(encoding="utf-8")).body:
        if isinstance(statement, ast.Assign) and ast.unparse(statement.targets[0]) == "__all__":
            return ast.literal_eval(statement.value)
    return ()
