"""Lookup requests over the network: selector parameters, and transforms and errors as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, cast

import msgspec

import zstate.errors
from zstate.clock import check_stamp
from zstate.errors import InvalidInput, LookupFailed, MessageError, NetworkError, ZStateError
from zstate.transform import Transform
from zstate.wire.keys import MAX_FRAME_NAME_LENGTH, shortened

_NAMES = ("target", "source", "at")
_FORM = "write target=FRAME;source=FRAME, and at=NANOSECONDS for an instant other than the newest"


@dataclass(frozen=True, slots=True)
class LookupRequest:
    """The pose of ``source`` in ``target`` at the stamp ``at`` [ns]; None is the newest."""

    target: str
    source: str
    at: int | None = None

    @classmethod
    def parse(cls, parameters: Mapping[str, str]) -> LookupRequest:
        """The request in the parameters of a selector. Raises InvalidInput with the parameter at fault."""
        for name in parameters:
            if name not in _NAMES and not name.startswith("_"):  # those are Zenoh's, such as _anyke
                raise InvalidInput(f"a lookup has no parameter {shortened(name)!r}; {_FORM}")
        for name in ("target", "source"):
            if not parameters.get(name):
                raise InvalidInput(f"a lookup needs the parameter {name!r}; {_FORM}")
            if len(parameters[name]) > MAX_FRAME_NAME_LENGTH:
                raise InvalidInput(f"the frame {shortened(parameters[name])!r} is too long; {_FORM}")
        at = parameters.get("at")
        if at is None:
            return cls(parameters["target"], parameters["source"])
        digits = at.removeprefix("-")
        if not (digits.isascii() and digits.isdecimal() and len(digits) <= 19):
            raise InvalidInput(
                f"the parameter 'at' is {shortened(at)!r}, not a stamp: whole nanoseconds since 1970"
            )
        return cls(parameters["target"], parameters["source"], check_stamp(int(at)))

    def parameters(self) -> str:
        """The request as parameters of a selector. Raises InvalidInput for frames that cannot be in one."""
        for frame in (self.target, self.source):
            if not frame or ";" in frame:
                raise InvalidInput(f"the frame name {frame!r} is empty or has a ';', and cannot be looked up")
        text = f"target={self.target};source={self.source}"
        return text if self.at is None else f"{text};at={check_stamp(self.at)}"


def error_to_json(error: ZStateError) -> bytes:
    """``{"error": class name, "message": text, ...}``, with every attribute of the error."""
    facts = {name: value for name, value in error.facts().items() if not name.startswith("_")}
    return msgspec.json.encode({**facts, "error": type(error).__name__, "message": str(error)})


def error_from_json(text: bytes) -> ZStateError:
    """The error that ``error_to_json`` wrote; a NetworkError that quotes any other text."""
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
        for name, value in facts.items():
            error.__dict__[name] = tuple(cast("list[object]", value)) if isinstance(value, list) else value
        if not issubclass(kind, LookupFailed):
            return error
        try:  # the text is made of the facts, which another program may have left out
            if str(error):
                return error
        except Exception:  # any error that foreign facts lead to
            pass
    return NetworkError(f"refused: {message}")


class TransformJson(msgspec.Struct, frozen=True):
    """The fields of ``Transform.to_dict``, with their types. Further ones, of later versions, are ignored."""

    target: str
    source: str
    translation: tuple[float, float, float]
    rotation: tuple[float, float, float, float]
    stamp: int | None = None
    kind: Literal["static", "exact", "interpolated", "predicted"] | None = None
    covariance: list[list[float]] | None = None


_DECODER = msgspec.json.Decoder(TransformJson)


def to_json(transform: Transform) -> bytes:
    """``{"target": ..., "source": ..., "translation": [x, y, z], "rotation": [x, y, z, w], ...}``."""
    return msgspec.json.encode(transform.to_dict())


def from_json(text: bytes | str) -> Transform:
    """The transform that ``to_json`` wrote. Raises MessageError with the field at fault, InvalidInput."""
    try:
        fields = _DECODER.decode(text)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise MessageError(f"not a transform in JSON: {error}", reason="malformed") from None
    return Transform.from_dict(msgspec.structs.asdict(fields))
