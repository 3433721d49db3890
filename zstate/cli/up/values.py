"""Values with names in them: ``${NAME}`` of a file's parameters and of the environment, and conditions."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from typing import Any, cast

from zstate._util.suggestions import did_you_mean
from zstate.errors import InvalidInput

_REFERENCE = re.compile(r"\$?\$\{(?P<name>[^{}:]*)(?::-(?P<default>[^{}]*))?\}")
_YES = ("true", "yes", "on", "1")
_NO = ("false", "no", "off", "0", "")


class Scope:
    """What ``${NAME}`` stands for: ``names``, and what the environment has besides."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self.names = dict(names)

    def with_names(self, names: Mapping[str, Any]) -> Scope:
        """The same, and these."""
        return Scope({**self.names, **names})

    def filled(self, value: Any) -> Any:
        """``value`` with what its names stand for; one that is nothing but a name keeps that one's type.

        ``${NAME:-DEFAULT}`` is DEFAULT where NAME is nothing or empty, ``$${`` is ``${``. Raises
        InvalidInput for a name that stands for nothing.
        """
        if isinstance(value, dict):
            return {key: self.filled(inner) for key, inner in cast("dict[str, Any]", value).items()}
        if isinstance(value, list):
            return [self.filled(inner) for inner in cast("list[Any]", value)]
        if not isinstance(value, str):
            return value
        whole = _REFERENCE.fullmatch(value)
        if whole is not None and not value.startswith("$$"):
            return self._meaning(whole)
        return _REFERENCE.sub(self._text, value)

    def _text(self, reference: re.Match[str]) -> str:
        if reference[0].startswith("$$"):
            return reference[0][1:]
        value = self._meaning(reference)
        if isinstance(value, bool):
            return str(value).lower()
        if not isinstance(value, str | int | float):
            raise InvalidInput(f"${{{reference['name']}}} is {value!r}, which cannot be a part of a text")
        return str(value)

    def _meaning(self, reference: re.Match[str]) -> Any:
        name, default = reference["name"].strip(), reference["default"]
        value = self.names.get(name, os.environ.get(name))
        if default is not None and value in (None, ""):
            return default
        if value is None:
            raise InvalidInput(
                f"${{{name}}} is neither a parameter nor set in the environment"
                f"{did_you_mean(name, self.names)}; ${{{name}:-DEFAULT}} would have a default"
            )
        return value


def holds(condition: object) -> bool:
    """Whether a ``when`` is met: true or false, or ``A == B`` or ``A != B`` of texts. Raises InvalidInput."""
    if isinstance(condition, bool):
        return condition
    text = str(condition).strip()
    for sign, is_wanted in (("==", True), ("!=", False)):
        left, found, right = text.partition(sign)
        if found:
            return (_bare(left) == _bare(right)) is is_wanted
    if text.lower() not in _YES + _NO:
        raise InvalidInput(f"{text!r} is neither true nor false; write one of these, 'A == B' or 'A != B'")
    return text.lower() in _YES


def _bare(text: str) -> str:
    return text.strip().strip("'\"")
