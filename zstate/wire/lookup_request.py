"""Lookups asked for by name: the question in a selector's parameters, a refusal in JSON.

Transforms as JSON, for whatever is not Python.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

import msgspec

import zstate.errors
from zstate.clock import check_stamp
from zstate.errors import InvalidInput, LookupFailed, MessageError, NetworkError, ZStateError
from zstate.transform import Transform
from zstate.wire.keys import MOST_OF_A_FRAME, shortened

_NAMES = ("target", "source", "at")
_FORM = "ask target=FRAME;source=FRAME, and at=NANOSECONDS for another instant than the newest"


@dataclass(frozen=True, slots=True)
class LookupRequest:
    """The pose of ``source`` in ``target`` at the stamp ``at`` [ns]; None is the newest there is."""

    target: str
    source: str
    at: int | None = None

    @classmethod
    def parse(cls, parameters: Mapping[str, str]) -> LookupRequest:
        """What the parameters of a selector ask. Raises InvalidInput naming what is wrong with them."""
        for name in parameters:
            if name not in _NAMES:
                raise InvalidInput(f"a lookup has no parameter {shortened(name)!r}; {_FORM}")
        for name in ("target", "source"):
            if not parameters.get(name):
                raise InvalidInput(f"a lookup needs the parameter {name!r}; {_FORM}")
            if len(parameters[name]) > MOST_OF_A_FRAME:
                raise InvalidInput(f"the frame {shortened(parameters[name])!r} is too long; {_FORM}")
        at = parameters.get("at")
        return cls(parameters["target"], parameters["source"], None if at is None else _stamp(at))

    def parameters(self) -> str:
        """The same as the parameters of a selector. Raises InvalidInput for what cannot stand there."""
        for frame in (self.target, self.source):
            if not frame or ";" in frame:
                raise InvalidInput(f"the frame name {frame!r} is empty or has a ';', and cannot be asked for")
        asked = f"target={self.target};source={self.source}"
        return asked if self.at is None else f"{asked};at={check_stamp(self.at)}"


def _stamp(text: str) -> int:
    digits = text.removeprefix("-")
    if not (digits.isascii() and digits.isdecimal() and len(digits) <= 19):
        raise InvalidInput(
            f"the parameter 'at' is {shortened(text)!r}, not a stamp: whole nanoseconds since 1970"
        )
    return check_stamp(int(text))


def error_to_json(error: ZStateError) -> bytes:
    """``{"error": class name, "message": text, ...}``, with every attribute of the error."""
    facts = {name: value for name, value in error.facts().items() if not name.startswith("_")}
    return msgspec.json.encode({**facts, "error": type(error).__name__, "message": str(error)})


def error_from_json(text: bytes) -> ZStateError:
    """The error that ``error_to_json`` wrote; a NetworkError with what was said for any other text."""
    try:
        facts = msgspec.json.decode(text, type=dict[str, object])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return NetworkError(f"refused, for a reason that is not JSON: {text[:200]!r}")
    kind = getattr(zstate.errors, str(facts.pop("error", "")), None)
    message = str(facts.pop("message", ""))
    if isinstance(kind, type) and issubclass(kind, ZStateError):
        # Not by the constructor, which differs from error to error.
        error = kind.__new__(kind)
        error.args = (message,)
        error.__dict__.update({name: _frozen(value) for name, value in facts.items()})
        if not issubclass(kind, LookupFailed) or _can_explain(error):
            return error
    return NetworkError(f"refused: {message}")


def _frozen(value: object) -> object:
    return tuple(cast("list[object]", value)) if isinstance(value, list) else value


def _can_explain(error: ZStateError) -> bool:
    # Their text is made of their facts, which a stranger may have left out.
    try:
        return bool(str(error))
    except Exception:  # whatever a stranger's facts lead to
        return False


Triple = tuple[float, float, float]
Quadruple = tuple[float, float, float, float]


class TransformJson(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The fields of ``Transform.to_dict``, with their types."""

    target: str
    source: str
    translation: Triple
    rotation: Quadruple
    stamp: int | None = None
    kind: Literal["static", "exact", "interpolated", "predicted"] | None = None


_DECODER = msgspec.json.Decoder(TransformJson)


def to_json(transform: Transform) -> bytes:
    """``{"target": ..., "source": ..., "translation": [x, y, z], "rotation": [x, y, z, w], ...}``."""
    return msgspec.json.encode(transform.to_dict())


def from_json(text: bytes | str) -> Transform:
    """The transform that ``to_json`` wrote. Raises MessageError naming the field at fault, InvalidInput."""
    try:
        fields = _DECODER.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"not a transform in JSON: {error}", reason="malformed") from None
    return Transform.from_dict(msgspec.structs.asdict(fields))
