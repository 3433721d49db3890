"""Lag: samples that come later after their stamps than those before them. They are used, and named once."""

from __future__ import annotations

from dataclasses import dataclass

from zstate.errors.times import duration_text
from zstate.following.bounded import remember
from zstate.following.tally import Tally

LATE_NS = 1_000_000_000
"""Younger samples are never looked at: what waits for less is no backlog."""

_GROWN_NS = 1_000_000_000

# After so long without a late one what comes is another backlog, such as that of another cut.
_PAUSE_NS = 2_000_000_000


@dataclass(slots=True)
class _Backlog:
    least_ns: int
    last_ns: int
    is_told: bool = False


class Lag:
    """Logs, once for each program that writes a robot's samples, that they fell behind by a second more.

    The clocks of both sides may disagree: only what the age of samples at arrival grows by counts. A burst
    after a cut begins with its oldest sample, so that it does not look like this.
    """

    def __init__(self, tally: Tally) -> None:
        self._tally = tally
        self._backlogs: dict[tuple[str, str], _Backlog] = {}

    def note(self, robot: str, writer: str | None, age_ns: int, now_ns: int) -> None:
        """A sample of ``writer`` has come ``age_ns`` after its stamp, which is late."""
        key = (robot, program_of(writer))
        known = self._backlogs.get(key)
        if known is None:
            remember(self._backlogs, key, _Backlog(age_ns, now_ns))
            return
        went_on = now_ns - known.last_ns <= _PAUSE_NS
        known.last_ns = now_ns
        known.least_ns = min(known.least_ns, age_ns) if went_on else age_ns
        if age_ns > known.least_ns + _GROWN_NS and not known.is_told:
            known.is_told = True
            age, before = duration_text(age_ns), duration_text(known.least_ns)
            self._tally.note(
                f"lag {' '.join(key)}",
                f"{samples_of(robot, writer)} come {age} after their stamps, {before} shortly before: more "
                "is sent than the network carries, or than this program takes; `zstate monitor` shows where "
                "it waits, and a lower rate helps either way",
            )


def program_of(writer: str | None) -> str:
    """Which program on which host it is, whenever it was started; empty if it is not announced."""
    name, is_known, _ = (writer or "").rpartition(" pid ")
    return name if is_known else writer or ""


def samples_of(robot: str, writer: str | None) -> str:
    """Whose samples those are, in the words of a warning."""
    return f"samples of {robot!r}{f', which {writer} writes,' if writer else ''}"
