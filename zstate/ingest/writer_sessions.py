"""The sessions that publish one stream of a robot, one of which counts, and what their descriptions say."""

from __future__ import annotations

from functools import lru_cache

from zstate._util.bounded import BoundedDict
from zstate.clock import Clock
from zstate.wire.messages import Edges, RobotDescription

SILENT_NS = 2_000_000_000
"""A writer without a token that has sent nothing for this long no longer replaces an announced one."""

# Descriptions of the last sessions are kept; each may have 16 MB.
_MAX_DESCRIPTIONS = 4


class WriterSessions:
    """The sessions of a stream; the ``current`` one is the newest to appear.

    A session that was replaced is refused until the current one leaves; or, if it is announced, until the
    current one, not announced, has been silent for 2 s by ``clock``.
    """

    def __init__(self, clock: Clock) -> None:
        self.current: int | None = None
        self.departed: int | None = None
        """The session that left while it was the current one; its last samples may arrive later."""
        self.names: BoundedDict[int, str] = BoundedDict()
        """Printed names of the announced sessions."""
        self._clock = clock
        self._replaced: BoundedDict[int, None] = BoundedDict()
        # The sample that was expected next, and when, since a replaced session was first refused.
        self._silence: tuple[int | None, int] = None, 0

    def announce(self, session: int, name: str) -> None:
        """Set the printed name of a session, which has a token."""
        self.names[session] = name
        if session == self.departed:
            self.departed = None

    def leave(self, session: int) -> bool:
        """Handle the end of a session's token. Returns whether it was the current one."""
        if session != self.current:
            return False
        self._replaced.clear()
        self.departed = session
        return True

    def accept(self, session: int, next_seq: int | None) -> bool:
        """Whether samples of another session than the current one, of which ``next_seq`` is due, count."""
        if session in self._replaced:
            if session not in self.names or not self._is_current_silent(next_seq):
                return False
            del self._replaced[session]
        return True

    def _is_current_silent(self, next_seq: int | None) -> bool:
        """Whether the current session has no token, and its samples have ended."""
        now = self._clock.now()
        if self.current in self.names:
            return False
        if self._silence[0] != next_seq:
            self._silence = next_seq, now
        return now - self._silence[1] >= SILENT_NS

    def replace(self, session: int) -> None:
        """Make ``session`` the current one."""
        if self.current is not None:
            self._replaced[self.current] = None
        self.current = session
        self._silence = None, 0


@lru_cache(maxsize=16)
def _shared(
    urdf: str, digest: str, joint_names: tuple[str, ...], moving_edges: Edges
) -> tuple[str, str, tuple[str, ...], Edges]:
    """The same; the robots of a fleet have the same model, and keep it once."""
    return urdf, digest, joint_names, moving_edges


class SessionDescriptions:
    """The last descriptions of a robot, and the clock domains in them, by session."""

    def __init__(self) -> None:
        self._descriptions: dict[int, RobotDescription] = {}
        self._domains: BoundedDict[int, str] = BoundedDict()
        self._last_domain: str | None = None

    def add(self, description: RobotDescription) -> None:
        """Add a description as the newest."""
        session = description.session
        self._last_domain = self._domains[session] = description.clock
        self._descriptions.pop(session, None)
        one = description
        model = _shared(one.urdf, one.digest, one.joint_names, one.moving_edges)
        self._descriptions[session] = RobotDescription(session, *model, one.clock)
        if len(self._descriptions) > _MAX_DESCRIPTIONS:
            del self._descriptions[next(iter(self._descriptions))]

    def of(self, session: int) -> RobotDescription | None:
        """The description of a session, if it is one of the last."""
        return self._descriptions.get(session)

    def domain(self, session: int | None) -> str | None:
        """The clock domain of a session; of the last description if its own is not known."""
        # The description may come from another program than the samples.
        return self._last_domain if session is None else self._domains.get(session, self._last_domain)
