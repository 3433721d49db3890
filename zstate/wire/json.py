"""Transforms as JSON, for whatever is not Python."""

from __future__ import annotations

from typing import Literal

import msgspec

from zstate.errors import MessageError
from zstate.transform import Transform

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
