"""The wires there are, by name."""

from __future__ import annotations

from zstate.errors import InvalidInput
from zstate.wire.native import NativeWire
from zstate.wire.wire import Wire

_WIRES: dict[str, type[Wire]] = {NativeWire.name: NativeWire}


def wire_named(name: str) -> Wire:
    """The wire a user calls ``name``. Raises InvalidInput listing those there are."""
    if name not in _WIRES:
        raise InvalidInput(f"there is no wire {name!r}; known: {', '.join(map(repr, _WIRES))}")
    return _WIRES[name]()
