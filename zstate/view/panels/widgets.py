"""Choice: something on the page that a person changes, and the program too."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Generic, TypeVar

import viser

T = TypeVar("T")


class BoundWidget(Generic[T]):
    """Tells what a person chose since it was asked last, and never overwrites that with what was before.

    The page changes ``value`` from a thread of its own: so it is set only where the program has news.
    """

    def __init__(self, handle: viser.GuiInputHandle[T]) -> None:
        self._handle = handle
        self._known = handle.value

    @property
    def value(self) -> T:
        """What is chosen."""
        return self._handle.value

    def poll_change(self) -> T | None:
        """What a person has chosen since this was asked last; None for nothing new."""
        value = self._handle.value
        if value == self._known:
            return None
        self._known = value
        return value

    def show(self, value: T) -> None:
        """Have ``value`` chosen, unless that is what was known to be."""
        if value != self._known:
            self._handle.value = self._known = value


class FrameChoice:
    """A list to choose a frame from, of names that come and go; ``nothing`` stands there for none."""

    def __init__(self, gui: viser.GuiApi, label: str, nothing: str, hint: str | None = None) -> None:
        self._nothing = nothing
        self._list: viser.GuiDropdownHandle[str] = gui.add_dropdown(label, (nothing,), hint=hint)
        self._choice = BoundWidget[str](self._list)

    @property
    def frame(self) -> str | None:
        """The name that is chosen."""
        value = self._choice.value
        return None if value == self._nothing else value

    def poll_change(self) -> str | None:
        """The name that a person has chosen since this was asked last; None for nothing new."""
        value = self._choice.poll_change()
        return None if value == self._nothing else value

    def show(self, name: str) -> None:
        """Have ``name`` chosen, one of those on offer."""
        self._choice.show(name)

    def offer(self, names: Sequence[str], chosen: str | None) -> None:
        """Offer ``names``, with one of them chosen."""
        value = self._nothing if chosen is None else chosen
        self._list.options = tuple(names) if chosen is not None else (self._nothing, *names)
        self._choice.show(value)
