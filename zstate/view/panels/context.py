"""Look: what the panels are told each time."""

from __future__ import annotations

from typing import NamedTuple, Protocol

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.snapshot import FramePoses
from zstate.errors import format_duration


class PanelContext(NamedTuple):
    """A moment as it is drawn: seen from the frame ``fixed``, and the newest of everything or not.

    ``now`` [ns] tells how old things are; it is None where that means nothing: in the past, and where
    stamps are not of the time that the buffer's clock tells. ``domain`` says whose time they are.
    """

    moment: FramePoses
    fixed: str
    buffer: TransformBuffer
    is_present: bool
    now: int | None
    domain: str | None

    @property
    def at(self) -> int | None:
        """The stamp to ask a buffer about: None for the present."""
        return None if self.is_present else self.moment.stamp

    def age_text(self, stamp: int | None) -> str:
        """How long ago an instant was."""
        return "-" if stamp is None or self.now is None else format_duration(self.now - stamp)


class Panel(Protocol):
    """A part of the page. Its callbacks note what is wanted; ``update`` does it, and tells the news."""

    def update(self, look: PanelContext) -> None: ...
