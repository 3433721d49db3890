"""Messages in JSON: the form in files and for viewers of streams of other packages, which ROS does not carry.

A message is an object by the names of its fields, where the native wire has an array. Bytes are in base64.
NaN and the infinities, which JSON does not have, are "NaN", "Infinity" and "-Infinity", as in the JSON of
Protocol Buffers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple, cast

import msgspec

from zstate.errors import InvalidInput, MessageError
from zstate.stream_registry import is_measured, is_value
from zstate.streams import Stream, StreamName
from zstate.wire.messages import Message, StampedMessage
from zstate.wire.ros2.streams import ros_streams

_ENCODER = msgspec.json.Encoder()
_NOT_FINITE = (b'"NaN"', b'Infinity"')
_SCALARS = ("boolean", "integer", "number", "string")


def carried_as_json(stream: StreamName) -> bool:
    """Whether messages of ``stream`` are recorded and displayed in JSON: measurements without a ROS type."""
    return stream not in ros_streams() and (is_measured(stream) or is_value(stream))


class JsonType(NamedTuple):
    """The type of the messages of a stream: the ``name`` of its class, and ``definition``, a JSON schema."""

    name: str
    definition: str

    encoding = "json"
    schema_encoding = "jsonschema"
    hash = ""


@lru_cache(256)
def json_type(row: Stream) -> JsonType:
    """The type of the messages of ``row``, named as in "zstate_battery.Battery".

    The schema has the fields that Foxglove can display: numbers, texts, booleans, objects and arrays of
    these. Optional ones have the type of their value. Raises InvalidInput if the class has no JSON form.
    """
    kind = _class_of(row)
    try:
        schema = msgspec.json.schema(_form_of(kind))
    except (TypeError, ValueError, NameError, RecursionError) as error:
        raise _no_form(row, error) from None
    shown = _displayed(schema, schema.get("$defs", {}), ())
    package = kind.__module__.partition(".")[0]
    return JsonType(f"{package}.{kind.__name__}", json.dumps(shown))


def encode_json(message: Message) -> bytes:
    """``message`` as a JSON object. Raises InvalidInput if JSON cannot represent it."""
    return _encoded(msgspec.structs.asdict(message))


def json_text(value: object) -> str:
    """A value of a field in JSON. Raises InvalidInput if JSON cannot represent it."""
    return _encoded(value).decode()


class JsonDecoder:
    """Decodes the messages of ``row`` that ``encode_json`` has encoded, of ``version`` of the stream."""

    def __init__(self, row: Stream, version: str) -> None:
        self._row = row
        self._version = version

    def decode(self, payload: bytes) -> StampedMessage:
        """The message in ``payload``, checked as on the wire.

        Raises MessageError with the reason "malformed", "other version" or "unusable class".
        """
        row = self._row
        if self._version != str(row.version):
            text = (
                f"a message of version {self._version} of {row.name!r}, whose package here has {row.version}"
            )
            raise MessageError(text, reason="other version")
        # Numbers are read from texts only where some are not finite.
        is_strict = not any(word in payload for word in _NOT_FINITE)
        try:
            kind, decoder = _class_of(row), _decoder_of(row, is_strict)
        except InvalidInput as error:
            raise MessageError(str(error), reason="unusable class") from None
        try:
            return kind(**msgspec.structs.asdict(decoder.decode(payload)))
        except (msgspec.DecodeError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise MessageError(f"a malformed {kind.__name__}: {error}", reason="malformed") from None


def _class_of(row: Stream) -> type[StampedMessage]:
    try:
        kind = row.type
    except Exception as error:  # whatever another package's module does when it is imported
        raise _no_form(row, error) from None
    if not issubclass(kind, StampedMessage):
        raise _no_form(row, TypeError(f"{kind.__name__} is no StampedMessage"))
    return kind


def _no_form(row: Stream, error: Exception) -> InvalidInput:
    return InvalidInput(f"the messages of {row.name!r} have no form in JSON: {type(error).__name__}: {error}")


@lru_cache(256)
def _decoder_of(row: Stream, is_strict: bool) -> msgspec.json.Decoder[msgspec.Struct]:
    try:
        return msgspec.json.Decoder(_form_of(_class_of(row)), strict=is_strict)
    except (TypeError, ValueError, NameError, RecursionError) as error:
        raise _no_form(row, error) from None


def _form_of(kind: type[Message]) -> type[msgspec.Struct]:
    """A class with the fields of ``kind`` that is an object in JSON."""
    fields: list[tuple[str, Any, Any]] = []
    for one in msgspec.structs.fields(kind):
        defaults = {"default": one.default, "default_factory": one.default_factory}
        given = {name: value for name, value in defaults.items() if value is not msgspec.NODEFAULT}
        fields.append((one.name, one.type, msgspec.field(**given)))
    return msgspec.defstruct(kind.__name__, fields, kw_only=True, frozen=True, gc=False)


def _displayed(
    schema: Mapping[str, Any], definitions: Mapping[str, Any], within: tuple[str, ...]
) -> dict[str, Any] | None:
    """The part of a schema that Foxglove can display, without references; None if it has none."""
    alternatives = [one for one in schema.get("anyOf", ()) if one.get("type") != "null"]
    if len(alternatives) == 1:
        return _displayed(alternatives[0], definitions, within)
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return None if name in within else _displayed(definitions[name], definitions, (*within, name))
    kind, shown = schema.get("type"), dict(schema)
    if kind is None and "enum" in schema:
        shown["type"] = "string" if all(isinstance(one, str) for one in schema["enum"]) else "integer"
    elif kind == "object" and "properties" in schema:
        parts = {name: _displayed(one, definitions, within) for name, one in schema["properties"].items()}
        shown["properties"] = {name: part for name, part in parts.items() if part is not None}
    elif kind == "array" and isinstance(schema.get("items"), dict):
        shown["items"] = items = _displayed(schema["items"], definitions, within)
        return None if items is None or items["type"] == "array" else shown
    elif kind not in _SCALARS:
        return None
    return shown


def _encoded(value: object) -> bytes:
    try:
        encoded = _ENCODER.encode(value)
        if b"null" in encoded:  # also for a number that is not finite
            encoded = _ENCODER.encode(_spelled(msgspec.to_builtins(value, str_keys=True)))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise InvalidInput(f"JSON cannot represent it: {error}") from None
    return encoded


def _spelled(value: Any) -> Any:
    """``value`` with texts in place of the numbers that are not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    if isinstance(value, dict):
        return {key: _spelled(one) for key, one in cast("dict[str, Any]", value).items()}
    if isinstance(value, (list, tuple)):
        return [_spelled(one) for one in cast("list[Any]", value)]
    return value
