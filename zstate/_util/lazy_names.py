"""Names of modules that are loaded at their first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(package: str, homes: Mapping[str, str]) -> Callable[[str], object]:
    """The ``__getattr__`` of ``package``, whose names are in its modules ``homes``."""

    def load(name: str) -> object:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value: object = getattr(import_module(f"{package}.{homes[name]}"), name)
        setattr(sys.modules[package], name, value)
        return value

    return load


def loaded(reference: str) -> Any:
    """What the object reference ``"module:name"`` leads to; its module is imported if it is not yet."""
    module, _, name = reference.partition(":")
    return getattr(import_module(module), name)
