"""Numbers as a URDF writes them: plain decimals, the same for every reader whatever its language."""

from __future__ import annotations

import math
import re

from zstate.model.findings import quoted

_DECIMAL = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
_BLANKS = re.compile(r"[ \t\r\n]+")


class NumberFault(ValueError):
    """Text that is not the number or numbers it should be."""


def read_numbers(text: str, count: int) -> tuple[float, ...]:
    """``count`` finite numbers separated by blanks. Raises NumberFault saying which is wrong."""
    _refuse_expression(text)
    tokens = [token for token in _BLANKS.split(text) if token]
    if len(tokens) != count:
        commas = "; separate them by blanks, not commas" if "," in text else ""
        raise NumberFault(f"{quoted(text)} has {len(tokens)} of {count} number{'s'[: count - 1]}{commas}")
    return tuple(read_number(token) for token in tokens)


def read_number(text: str) -> float:
    """One finite number. Raises NumberFault."""
    _refuse_expression(text)
    token = text.strip(" \t\r\n")
    if not _DECIMAL.fullmatch(token):
        raise NumberFault(_complaint(token))
    value = float(token)
    if not math.isfinite(value):
        raise NumberFault(f"{quoted(token)} is too large to be a number here")
    return value


def _refuse_expression(text: str) -> None:
    if "${" in text or "$(" in text:
        raise NumberFault(f"{quoted(text.strip())} is a xacro expression, not a number")


def _complaint(token: str) -> str:
    if not token:
        return "an empty text is not a number"
    if _DECIMAL.fullmatch(token.replace(",", ".")):
        return f"{quoted(token)} has a decimal comma; write {quoted(token.replace(',', '.'))}"
    try:
        value = float(token)
    except ValueError:
        return f"{quoted(token)} is not a number"
    if not math.isfinite(value):
        return f"{quoted(token)} is not a finite number"
    return f"{quoted(token)} is a number to Python only; write {value!r}"
