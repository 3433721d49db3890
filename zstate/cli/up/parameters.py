"""The parameters of a file of `zstate up`: what it says, unless the command line says otherwise."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from typing import Any

from zstate._util.suggestions import did_you_mean
from zstate.cli.up.toml_file import TomlFile
from zstate.cli.up.values import Scope
from zstate.errors import ConfigError, InvalidInput

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


def parsed_settings(texts: Sequence[str]) -> dict[str, str]:
    """``KEY=VALUE`` of a command line. Raises InvalidInput."""
    settings: dict[str, str] = {}
    for text in texts:
        key, sign, value = text.partition("=")
        if not sign or not key.strip():
            raise InvalidInput(f"{text!r} is not a parameter; write KEY=VALUE, such as speed=2")
        if key.endswith(":"):
            raise InvalidInput(f"{text!r} is written as for ROS; here it is {key[:-1]}={value}")
        settings[key.strip()] = value
    return settings


def parameter_scope(files: Sequence[TomlFile], settings: Mapping[str, str]) -> Scope:
    """What the parameters of ``files`` stand for, the last one's before the others'.

    A setting must be of the kind that its parameter has in the file. Raises ConfigError.
    """
    declared: dict[str, tuple[TomlFile, Any]] = {
        name: (file, value) for file in files for name, value in file.tables.get("parameters", {}).items()
    }
    for name in settings:
        if name not in declared:
            known = ", ".join(declared) or "none"
            raise ConfigError(
                f"{files[-1].shown} has no parameter {name!r}{did_you_mean(name, declared)}; "
                f"its [parameters]: {known}",
                path=f"parameters.{name}",
            )
    scope = Scope({})
    for name, (file, value) in declared.items():
        try:
            meant = _of_kind(value, settings[name]) if name in settings else scope.filled(value)
        except InvalidInput as error:
            raise file.error(f"parameters.{name}", str(error)) from None
        scope = scope.with_names({name: meant})
    return scope


def _of_kind(value: object, text: str) -> Any:
    """What ``text`` says, of the kind that ``value`` is."""
    if isinstance(value, str):
        return text
    try:
        meant = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        meant = None
    kinds = (int, float) if type(value) in (int, float) else (type(value),)
    if type(meant) not in kinds:
        raise InvalidInput(f"it is {value!r} in the file, and {text!r} is nothing of that kind")
    return meant
