"""Which messages of browsers reach viser: those that the page of `zstate view` sends.

viser lets a browser set any attribute of any widget, for all browsers: the callbacks of a button, too.
So only the types of message that the page sends pass, and of a widget only its value, if the user of a
browser can select it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import msgspec
import viser

# As the viser client names them: the camera of a browser, and its picture when one is requested.
_PASSED = ("ViewerCameraMessage", "GetRenderResponseMessage")
_GUI_UPDATE = "GuiUpdateMessage"
_MAX_TEXT = 1000


class Widget(Protocol):
    """An input of the page."""

    @property
    def value(self) -> Any: ...


def accept_message(raw: bytes | str, widget: Callable[[str], Widget | None]) -> bytes | None:
    """A message of a browser as viser may receive it; None if the page does not send such a message.

    ``widget`` returns an input of the page by its identifier. A number outside its range becomes the nearest
    one inside: a range may change while the user moves a slider.
    """
    try:
        message = msgspec.msgpack.decode(raw) if isinstance(raw, bytes) else None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return None
    match message:
        case {"type": str(name)} if name in _PASSED:
            return raw if isinstance(raw, bytes) else None
        case {"type": name, "uuid": str(uuid), "updates": {"value": value} as updates} if (
            name == _GUI_UPDATE and len(updates) == 1
        ):
            found = widget(uuid)
            accepted = None if found is None else _accept_value(found, value)
            update = {"type": name, "uuid": uuid, "updates": {"value": accepted}}
            return None if accepted is None else msgspec.msgpack.encode(update)
        case _:
            return None


def _accept_value(widget: Widget, value: object) -> bool | float | str | None:
    """A value as ``widget`` may have it; None if its user cannot select it."""
    if isinstance(widget.value, bool) or isinstance(value, bool):
        return value if isinstance(value, bool) and isinstance(widget.value, bool) else None
    if isinstance(widget.value, str):
        if not isinstance(value, str) or len(value) > _MAX_TEXT:
            return None
        options: tuple[str, ...] = getattr(widget, "options", (value,))
        return value if value in options else None
    if isinstance(widget, viser.GuiSliderHandle | viser.GuiNumberHandle) and isinstance(value, int | float):
        lower = -math.inf if widget.min is None else widget.min
        upper = math.inf if widget.max is None else widget.max
        return min(max(value, lower), upper) if math.isfinite(value) else None
    return None
