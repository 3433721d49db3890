"""Names of tf2, and of other folders of zstate, for the errors of attributes that do not exist."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

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
