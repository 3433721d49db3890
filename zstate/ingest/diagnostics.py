"""The seam between a reader of robots and what observes it: events, deadlines, stamps, clock offsets."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from zstate.errors import InsertRefused
from zstate.ingest.frame_ownership import EdgeSource
from zstate.streams import StreamName
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.messages import Sample

Kind = Literal["joined", "left", "restarted", "conflict", "stale", "resumed", "cut off", "back", "set back"]


@dataclass(frozen=True, slots=True)
class WriterEvent:
    """An event of the ``writer`` of a stream of ``robot``, observed ``at`` [ns], system time.

    - "joined": it publishes from now on; "restarted": as "joined", and the same program on the same host did
      before;
    - "left": it was closed, or its process ended, while the network is up;
    - "cut off": the router that connected it is lost, or it was silent before it disappeared; it may still
      publish. "back": the same writer is connected again;
    - "stale": it is announced, but no sample came for ten of its periods (at least half a second), or for
      three and 0.2 s where its site thins the stream: it is frozen, its source is, or the link of the site is
      down. "resumed": samples come again;
    - "set back": its clock was set back, so the robot's history begins with its next sample;
    - "conflict": another writer publishes the same stream, or places the same frame.

    ``writer`` is None if it is not announced; ``text`` describes the event in full.
    """

    kind: Kind
    robot: str
    stream: StreamName
    writer: WriterId | None
    at: int
    text: str

    def __str__(self) -> str:
        return self.text


class Diagnostics:
    """Observes the writers and samples of a reader; this base ignores them.

    Called on the threads that receive, which wait for it: keep it short.
    """

    on_usual_sample: Callable[[str, int], object] | None = None
    """Called with robot and session of each usual sample, which ``on_samples`` does not get; None: never."""

    def events(self) -> tuple[WriterEvent, ...]:
        """The last events of writers, oldest first."""
        return ()

    def on_samples(
        self, samples: Sequence[tuple[str, Sample]], writers: Mapping[tuple[str, int], str]
    ) -> None:
        """Samples of a batch, each with its robot, that were handed to their ingests.

        ``writers`` are the printed names of announced writers, by robot and session.
        """

    def on_writer(self, announced: Announcement, *, alive: bool) -> None:
        """A writer is announced, or is not any more."""

    def before_losses(self) -> None:
        """Tokens have disappeared together; ``on_writer`` follows for each of their writers."""

    def on_set_back(self, robot: str, session: int, text: str) -> None:
        """The clock of a writer was set back, as ``text`` describes."""

    def on_conflict(self, stream: StreamName, source: EdgeSource, refusal: InsertRefused) -> None:
        """An edge of ``source`` was refused because of another writer."""

    def on_static_children(self, robot: str, writer: str, children: frozenset[str]) -> None:
        """The static writer of this name places the frames ``children`` now, by their full names."""
