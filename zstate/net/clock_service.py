"""Clock service: replies of a writer to the readers that measure how far its clock is ahead of theirs.

``zstate.net.clock_offset`` measures that.
"""

from __future__ import annotations

from zstate.clock import Clock
from zstate.net.queryable import Queryable, Reply
from zstate.net.session import Session
from zstate.wire.identity import WriterId
from zstate.wire.keys import WRITER_CLOCK
from zstate.wire.messages import ClockMessage
from zstate.wire.native import encode, encoding_of


class ClockService(Queryable):
    """Replies with the time of ``clock``, which stamps what one writer of ``robot`` publishes."""

    def __init__(self, session: Session, robot: str, writer: WriterId, clock: Clock) -> None:
        def answer(_: object) -> Reply:
            message = ClockMessage(clock.now(), self.answered, writer.session)
            return Reply(encode(message), encoding_of(ClockMessage))

        super().__init__(session, WRITER_CLOCK.key(robot, writer.identity), answer)
