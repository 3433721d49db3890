"""How old commands are when they arrive, and how many may be under way; no clocks in common.

A slow link, and the queues before it, deliver commands seconds after they were sent, also after the death of
their sender. A driver therefore counts the validity of a command from its sending.

It finds that instant by an echo of its own clock. Each DriverState has its ``instant``; a commander adds the
time since that state has arrived, and sends the sum with each command. The command was sent at that instant
of the driver's clock, or later by what the state was under way. The difference to the arrival, the *transit*,
is the way of the state and of the command together: its least in a session is the shortest way there and
back, and what a command takes longer than that, its *excess*, is time that it has waited. The clock of the
commander may be wrong, or set: its steps do not matter, only its rate.

A ROS node echoes nothing. Its transit is the arrival less its stamp, which has an unknown constant: the
excess is the same, but a first command that has waited counts as fresh. Its clock may be slow against the
driver's: the least transit rises by 0.1 % of the time between two commands, at most by the driver's ttl, so
that a command after any pause counts for at most one ttl longer. A node whose clock is set back is refused
until it is restarted: its commands look like old ones.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe_lock
from zstate.driving.messages import DriverState
from zstate.errors import MessageError, format_duration

_MOST_DRIFT = 1e-3
"""The most drift between two clocks: above what NTP slews by, 500 ppm, and an oscillator is off by."""

_KEPT_NS = 10_000_000_000
"""For so long a state of the driver is used in place of those that took longer."""

_LOST_NS = 1_000_000_000
"""A command that is not confirmed after this time counts as lost."""

_LATE_NS = 300_000_000
"""Above the period of the driver's states: a command is confirmed within that time on a good link."""

_MOST_UNCONFIRMED = 1024

_TOKEN_WITHIN_NS = 500_000_000
"""The token of a commander may arrive so much later than its first command."""

_QUIET_NS = 10_000_000_000
"""After so long without commands of sessions that are not announced, the next may be a new commander's."""

REQUEST_TTL_NS = 1_000_000_000
"""A request for a motion that has not started so long after its sending starts no more."""


class CommandAges:
    """The excess of the commands that arrive at a driver, by session. Safe from any thread.

    ``driver`` is the session of the driver's host, and ``ttl_ns`` the longest validity that it grants. All
    instants are of its monotonic clock [ns].
    """

    def __init__(self, driver: int, ttl_ns: int) -> None:
        self._driver = driver
        self._ttl_ns = ttl_ns
        self._lock = fork_safe_lock()
        self._echoed: BoundedDict[int, int] = BoundedDict()
        """The least transit of each session."""
        self._stamped: BoundedDict[int, tuple[int, int]] = BoundedDict()
        """That of sessions which echo nothing, and when it was measured."""

    def excess(self, session: int, stamp: int, arrived: int, echo: tuple[int, int] | None = None) -> int:
        """How much longer a command was under way than the fastest of its ``session`` [ns].

        All of its transit, while no command of the session has had one below the longest ttl: they may all
        have waited. Raises MessageError for an ``echo`` that is not of this driver.
        """
        if echo is None:
            with self._lock:
                return self._stamped_excess(session, arrived - stamp, arrived)
        driver, instant = echo
        if driver != self._driver:
            text = "it answers another host of this driver, such as one that has ended"
            raise MessageError(text, reason="late")
        transit = arrived - instant
        if transit < 0:
            text = f"its echo is {format_duration(-transit)} ahead of the driver's own clock"
            raise MessageError(text, reason="echo")
        with self._lock:
            least = self._echoed[session] = min(transit, self._echoed.get(session, transit))
        return transit - least if least < self._ttl_ns else transit

    def _stamped_excess(self, session: int, transit: int, arrived: int) -> int:
        least, since = self._stamped.get(session, (transit, arrived))
        # At most by the ttl: a command after an hour without any would else count 3.6 s late.
        drift = min(int((arrived - since) * _MOST_DRIFT), self._ttl_ns)
        least = min(transit, least + drift)
        self._stamped[session] = least, arrived
        return transit - least


def check_waited(waited: int, ttl: int, *, has_echo: bool) -> None:
    """Raise MessageError for a command or request that has ``waited`` for its ``ttl`` or longer [ns]."""
    if waited < ttl:
        return
    cause = "the link is too slow for it, or its program was frozen"
    if not has_echo:
        cause += ", or its clock was set back: then restart it"
    raise MessageError(
        f"it has waited for {format_duration(waited)} on its way, and is valid for {format_duration(ttl)}: "
        f"{cause}",
        reason="late",
    )


class ReceivedCommand(NamedTuple):
    """A command, by ``session`` and ``seq``, that took ``excess`` [ns] longer than the fastest.

    It has arrived at ``arrived`` [ns, monotonic].
    """

    session: int
    seq: int
    excess: int
    arrived: int


class CommandAdmission:
    """Which commands count, and until when: those of announced sessions, from their sending for their ttl.

    A token may arrive after the first commands of its session, or be lost for a moment, as with a router. So
    commands count for half a second after their session has lost its token. Those of sessions without one
    count for half a second in all, whichever these are: after that all of them are refused until a session is
    announced, or until none has sent any for ten seconds.
    """

    def __init__(self, ages: CommandAges) -> None:
        self._ages = ages
        self._lock = fork_safe_lock()
        self._announced: set[int] = set()
        self._lost: BoundedDict[int, int] = BoundedDict()
        """When sessions have lost their tokens [ns, monotonic]."""
        self._unannounced: tuple[int, int] | None = None
        """When sessions that had no token began to send commands, and sent the last one [ns, monotonic]."""
        self.newest: ReceivedCommand | None = None
        """The newest command of an announced session, also if it was refused; may be read from any thread."""

    def set_announced(self, session: int, alive: bool, now: int) -> None:
        """The commander or ROS node of ``session`` is announced, or not any more; for any thread."""
        with self._lock:
            if alive:
                self._announced.add(session)
                self._lost.pop(session, None)
                self._unannounced = None
            elif session in self._announced:
                self._announced.discard(session)
                self._lost[session] = now

    def deadline(
        self, head: tuple[int, int, int], ttl: int, arrived: int, echo: tuple[int, int] | None = None
    ) -> int:
        """Until when a command with ``head``, stamp, number and session, is valid. For one thread.

        Raises MessageError for one that is too old, or whose session is not announced.
        """
        stamp, seq, session = head
        if not self._is_admitted(session, arrived):
            text = f"a command of session {session:x}, which is not announced as a commander"
            raise MessageError(text, reason="no claim")
        excess = self._ages.excess(session, stamp, arrived, echo)
        self.newest = ReceivedCommand(session, seq, excess, arrived)
        check_waited(excess, ttl, has_echo=echo is not None)
        return arrived - excess + ttl

    def _is_admitted(self, session: int, arrived: int) -> bool:
        """Whether ``session`` is announced, or its token may be under way."""
        with self._lock:
            if session in self._announced:
                return True
            since = self._lost.get(session)
            if since is None:
                since, last = self._unannounced or (arrived, arrived)
                if arrived - last > _QUIET_NS:
                    since = arrived
                self._unannounced = since, arrived
            return arrived - since <= _TOKEN_WITHIN_NS


class DriverClock:
    """The clock of a driver as its commander knows it: never ahead of it, behind by what a state takes."""

    def __init__(self) -> None:
        self.session: int = 0
        """The session of the driver's host; 0 before its first state."""
        self._offset: int = 0
        self._measured_at: int = 0

    def update(self, state: DriverState, arrived: int) -> None:
        """Take the instant of a state that has arrived at ``arrived`` [ns, monotonic clock of here]."""
        offset = state.instant - arrived
        age = arrived - self._measured_at
        if state.session != self.session or age > _KEPT_NS or offset >= self._offset - int(age * _MOST_DRIFT):
            self.session, self._offset, self._measured_at = state.session, offset, arrived

    def at(self, now: int) -> tuple[int, int]:
        """The echo of a command that is sent at ``now`` [ns, monotonic clock of here]."""
        drift = int(abs(now - self._measured_at) * _MOST_DRIFT)
        return self.session, max(0, now + self._offset - drift)


class CommandWindow:
    """How many commands may be under way without a confirmation of the driver. For one thread at a time.

    As many as a commander sends on a link that carries them. Where they wait, the number is halved with each
    state of the driver, down to one, and doubled each time so many did not wait.
    """

    def __init__(self) -> None:
        self._size = _MOST_UNCONFIRMED
        self._unconfirmed: deque[tuple[int, int]] = deque()
        """Number and instant of sending of each, oldest first."""
        self._last = self._grows_at = -1
        """The last number that was sent, and the one at whose confirmation the size may grow next."""

    def has_room(self, now: int) -> bool:
        """Whether one more may be sent at ``now`` [ns, monotonic]."""
        while self._unconfirmed and now - self._unconfirmed[0][1] > _LOST_NS:
            self._unconfirmed.popleft()
        return len(self._unconfirmed) < self._size

    def sent(self, seq: int, now: int) -> None:
        """The command ``seq`` was sent at ``now``."""
        self._unconfirmed.append((seq, now))
        self._last = seq

    def update(self, confirmed: int, excess: int, ttl: int, now: int) -> None:
        """Take a state of the driver, whose newest command is ``confirmed``, and waited for ``excess`` [ns].

        It is -1 if the driver has none of this commander.
        """
        before, waited = len(self._unconfirmed), self.waiting_ns(now)
        while self._unconfirmed and self._unconfirmed[0][0] <= confirmed:
            self._unconfirmed.popleft()
        has_news = len(self._unconfirmed) < before
        if waited > max(ttl, _LATE_NS) or (has_news and excess > ttl // 4):
            self._size = max(1, min(self._size, before) // 2)
        elif has_news and before >= self._size and confirmed >= self._grows_at:
            self._size = min(2 * self._size, _MOST_UNCONFIRMED)
        else:
            return
        self._grows_at = self._last + self._size  # once as many have shown whether they wait

    def waiting_ns(self, now: int) -> int:
        """For how long the oldest command waits for its confirmation; 0 without any. For any thread."""
        try:
            return now - self._unconfirmed[0][1]
        except IndexError:  # not asked before: another thread may take out the last one in between
            return 0
