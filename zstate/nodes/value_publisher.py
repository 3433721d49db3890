"""What the publishers of latched values have in common: the writers on all wires, ownership, and the end."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from typing import ClassVar

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.errors import Closed
from zstate.net.ownership import WriterClaim
from zstate.net.session import Session
from zstate.net.writer import WireWriter, write_all
from zstate.wire.identity import Announcement
from zstate.wire.messages import Message
from zstate.wire.registry import as_wire_names, get_wire


class ValuePublisher(Closeable):
    """Base of the publishers of one latched value of a robot: that of ``announced``, on all ``wires``.

    On the native wire it owns the value, unless another writer may take it over (``owns`` is False).
    """

    _KIND: ClassVar[str]
    """Used in errors, such as "static publisher"."""

    def __init__(
        self, session: Session, announced: Announcement, wires: str | Sequence[str], *, owns: bool = True
    ) -> None:
        self.robot = announced.robot
        self.writer = announced.name
        self._announced = announced
        self._closed = False
        self._lock = fork_safe_lock()
        self._claim: WriterClaim | None = None
        names = as_wire_names(wires)
        with ExitStack() as opening:
            if owns and "native" in names:  # in ROS any node may write it
                self._claim = opening.enter_context(WriterClaim(session, [announced]))
            opened = [
                opening.enter_context(WireWriter(session, get_wire(name), self.robot, announced.writer))
                for name in names
            ]
            self._latched = [one.open_latched(announced.stream, self.writer) for one in opened]
            if self._claim is not None:
                self._claim.confirm()
            self._opened = opening.pop_all()

    def _check_open(self) -> None:
        if self._closed:
            raise Closed(f"the {self._KIND} {self.writer!r} is closed")

    def _send(self, message: Message) -> None:
        """Replace the value. Raises InvalidInput if a wire cannot represent it: then none sends it."""
        write_all(self._latched, message)

    def close(self) -> None:
        """Withdraw the value. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            for latched in self._latched:
                latched.withdraw()
            self._opened.close()
