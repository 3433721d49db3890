"""Panel interface, the context of an update, and widgets that the user and the program change."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import viser

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FramePoses
from zstate.buffer.tracks import TimeSpan

T = TypeVar("T")


class PanelContext(NamedTuple):
    """The snapshot on display, seen from the frame ``fixed``; ``is_live`` if it is the newest.

    ``now`` [ns] is for ages. It is None for a snapshot of the past, and if the stamps are not of the domain
    of the buffer's clock. ``domain`` is the time domain of the stamps, ``span`` all that can be shown.
    """

    snapshot: FramePoses
    fixed: str
    buffer: TransformBuffer
    is_live: bool
    now: int | None
    domain: str | None
    span: TimeSpan | None

    @property
    def at(self) -> int | None:
        """The stamp for lookups in the buffer: None if live."""
        return None if self.is_live else self.snapshot.stamp


class Panel(Protocol):
    """A part of the page. ``update`` applies the user's input and then shows new values."""

    def update(self, context: PanelContext) -> None: ...


class BoundWidget(Generic[T]):
    """An input that both the user and the program change; the user's change is returned once, and never lost.

    viser sets ``value`` from its own thread, so ``show`` writes only values that differ from the last one.
    """

    def __init__(self, handle: viser.GuiInputHandle[T]) -> None:
        self._handle = handle
        self._last = handle.value

    @property
    def value(self) -> T:
        """The current value."""
        return self._handle.value

    def poll_change(self) -> T | None:
        """The value that the user has set since the last call; None if unchanged."""
        value = self._handle.value
        if value == self._last:
            return None
        self._last = value
        return value

    def show(self, value: T) -> None:
        """Set ``value``, unless the program has set it already."""
        if value != self._last:
            self._handle.value = self._last = value


class FrameDropdown(BoundWidget[str]):
    """Dropdown of frame names that come and go; ``placeholder`` is its text without a selection."""

    def __init__(self, gui: viser.GuiApi, label: str, placeholder: str, hint: str | None = None) -> None:
        self._placeholder = placeholder
        self._list: viser.GuiDropdownHandle[str] = gui.add_dropdown(label, (placeholder,), hint=hint)
        super().__init__(self._list)

    @property
    def frame(self) -> str | None:
        """The selected name."""
        return None if self.value == self._placeholder else self.value

    def poll_change(self) -> str | None:
        value = super().poll_change()
        return None if value == self._placeholder else value

    def set_options(self, names: Sequence[str], selected: str | None) -> None:
        """Offer ``names``, and select one of them or none."""
        options = tuple(names) if selected is not None else (self._placeholder, *names)
        if options != self._list.options:
            self._list.options = options
        self.show(self._placeholder if selected is None else selected)
