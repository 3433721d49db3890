"""Wire formats by name."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from zstate.errors import InvalidInput
from zstate.wire.native import NativeWire
from zstate.wire.protocol import Wire

if TYPE_CHECKING:
    from zstate.wire.ros2.options import Ros2Options

DOMAIN_VARIABLE = "ROS_DOMAIN_ID"

NAMES = ("native", "ros2", "ros2dds")


def as_wire_names(wires: str | Sequence[str]) -> tuple[str, ...]:
    """The names of one wire format or several."""
    return (wires,) if isinstance(wires, str) else tuple(wires)


def get_wire(name: str) -> Wire:
    """The wire format ``name``: "native", "ros2" or "ros2dds".

    A ROS wire takes options after a colon, as ``Ros2Options.parse`` reads them, for instance
    "ros2:domain=5,namespace=r1". The domain defaults to ROS_DOMAIN_ID. Raises InvalidInput.
    """
    kind, colon, options = name.partition(":")
    if kind not in NAMES:
        raise InvalidInput(f"there is no wire {name!r}; known: {', '.join(map(repr, NAMES))}")
    if kind == "native":
        if colon:
            raise InvalidInput(f"the native wire has no options; {name!r} gives some")
        return NativeWire()
    # Loaded only for a ROS wire, because of its hash library.
    from zstate.wire.ros2.wire import Ros2DdsWire, Ros2Wire  # noqa: PLC0415

    return Ros2Wire(ros_options(options)) if kind == "ros2" else Ros2DdsWire(ros_options(options))


def ros_options(text: str) -> Ros2Options:
    """The options after "ros2:"; the domain defaults to ROS_DOMAIN_ID. Raises InvalidInput."""
    from zstate.wire.ros2.options import Ros2Options  # noqa: PLC0415 - as above

    domain = os.environ.get(DOMAIN_VARIABLE, "")
    options = Ros2Options.parse(text)
    if not domain or re.search(r"\bdomain\s*=", text):
        return options
    try:
        return replace(options, domain=int(domain) if domain.isascii() and domain.isdecimal() else domain)
    except InvalidInput as error:
        raise InvalidInput(f"{error} (the domain is that of {DOMAIN_VARIABLE})") from None
