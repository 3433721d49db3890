"""Lookup requests over the network: selector parameters, and transforms and errors as JSON."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import msgspec

from zstate.clock import check_stamp
from zstate.errors import InvalidInput, ZStateError
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


def error_to_json(error: ZStateError) -> bytes:
    """``{"error": class name, "message": text, ...}``, with every attribute of the error."""
    facts = {name: value for name, value in error.facts().items() if not name.startswith("_")}
    return msgspec.json.encode({**facts, "error": type(error).__name__, "message": str(error)})


def to_json(transform: Transform) -> bytes:
    """``{"target": ..., "source": ..., "translation": [x, y, z], "rotation": [x, y, z, w], ...}``."""
    return msgspec.json.encode(transform.to_dict())
