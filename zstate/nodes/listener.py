"""TransformListener: subscribes to robots on the network and fills a transform buffer."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, NoReturn

from zstate._util.closeable import Closeable
from zstate._util.format import did_you_mean
from zstate._util.tf2_methods import missing_method
from zstate.buffer.buffer import DEFAULT_HISTORY_S, TransformBuffer, feed_of
from zstate.clock import Clock
from zstate.errors import InvalidInput
from zstate.ingest.counters import Counters, ListenerStats
from zstate.ingest.diagnostics import WriterEvent
from zstate.ingest.robot_ingests import Follow
from zstate.net.presence import announced_robots
from zstate.net.service_thread import ServiceThread
from zstate.net.session import Session
from zstate.nodes.state_reader import StateReader
from zstate.transform import Transform
from zstate.wire.keys import ANY, check_robot, shortened
from zstate.wire.protocol import Wire, selected_robots
from zstate.wire.registry import get_wire


class TransformListener(Closeable):
    """Fills ``buffer`` with the transforms of one robot, of several, or of all robots with ``robot="*"``.

    - ``robot``: a name, ``"*"``, or on the native wire a sequence of names. Nothing of other robots crosses
      the link, and the named robots share the threads of one listener; its attribute ``robot`` is then
      ``"*"``.
    - ``buffer``: the one to fill; default: a new one with ``history_s`` [s] of history and ``clock``.
    - ``wire``: where the robots are, "native", or "ros2" with options.
    - ``follow``: "joint_states" subscribes to joint positions and the model and computes the kinematics here;
      "tf" subscribes to transforms and needs no model.
    - ``clock``: the one that ages are measured with; default: the system's. For simulated robots a
      ``SimulatedClock``.
    - ``history_on_join``: the buffer also gets the samples that publishers of the native wire cached in the
      seconds before (their ``cache_s``).
    - ``on_event``: is called, with a ``WriterEvent``, on a thread of its own when a writer joins, leaves, is
      restarted, is cut off or comes back, falls silent, or conflicts with another one.
    - ``placers``: the robots whose writers may place the roots of others, in their frames; None: every robot.
      A frame ``robot/...`` is placed by that robot's own writers; if ``placers`` are given, also while no
      such robot is known.

    Raises InvalidInput if a sequence of robots is empty, or contains ``"*"``, an invalid name or a name
    twice; on the ROS wires if it has more than one name.

    Frames are named ``robot/frame`` in the buffer; bare names work while they are unique. Joint positions may
    come from several drivers, each with its own joints (``PartialStatePublisher``, in ROS any node): each
    joint is interpolated between the samples of its own driver, and one that stops leaves exactly its own
    links behind. The edges of other writers of the robot, of a ``StaticPublisher``, a ``TransformPublisher``
    or an ``OdometryPublisher``, come in either way; on the ROS wires these are all edges of /tf and
    /tf_static but those of a model, which robot_state_publisher repeats. A context manager.

    The clock domain of each robot is the one in its description, and robots of different domains may share
    the buffer; a lookup across two of them raises ClockMismatch. So does one to a robot of a site whose clock
    is more than 0.1 s off, as measured. Input that cannot be used is counted in
    ``stats``, logged once through ``logging``, and never stops the stream.

    In a forked process nothing fills the buffer: it answers from the samples it has, waits end at once, and
    errors name this as the reason.
    """

    def __init__(  # noqa: PLR0917 - the order is that of the published contract
        self,
        session: Session,
        robot: str | Sequence[str] = ANY,
        buffer: TransformBuffer | None = None,
        wire: str = "native",
        follow: Follow = "joint_states",
        history_s: float = DEFAULT_HISTORY_S,
        *,
        clock: Clock | None = None,
        history_on_join: bool = True,
        on_event: Callable[[WriterEvent], None] | None = None,
        placers: Collection[str] | None = None,
    ) -> None:
        # A reader inserts without them; each listener has them, to count, warn and log events.
        from zstate.nodes.listener_diagnostics import ListenerDiagnostics  # noqa: PLC0415

        if follow not in ("joint_states", "tf"):
            raise InvalidInput(f"follow is 'joint_states' or 'tf', not {follow!r}")
        self._wire = get_wire(wire)
        self._robots = selected_robots(robot, self._wire)
        self.robot = self._robots[0] if len(self._robots) == 1 else ANY
        self.buffer = TransformBuffer(history_s, clock) if buffer is None else buffer
        if clock is not None:
            feed_of(self.buffer).use_clock(clock)
        placers = _checked_placers(placers, self._wire)
        self._counters = Counters()
        self._session, self._pid = session, os.getpid()
        with ExitStack() as opening:
            # What may be slow, such as loading the model of a robot, does not delay samples.
            thread = opening.enter_context(ServiceThread(session, "requests"))
            self._diagnostics = opening.enter_context(
                ListenerDiagnostics(
                    session,
                    self._wire,
                    follow,
                    self.buffer,
                    thread=thread,
                    counters=self._counters,
                    on_event=on_event,
                )
            )
            self._reader = opening.enter_context(
                StateReader(
                    session,
                    self._robots,
                    self._wire,
                    follow,
                    self.buffer,
                    thread=thread,
                    counters=self._counters,
                    history_on_join=history_on_join,
                    placers=placers,
                    diagnostics=self._diagnostics,
                )
            )
            self._opened = opening.pop_all()
        feed_of(self.buffer).explain_unknown(self._explain_unknown)
        _LISTENERS.add(self)

    def __repr__(self) -> str:
        robots, received = len(self.robots()), self.stats.received
        names = ", ".join(map(repr, self._robots))
        return f"<TransformListener of {names}: {robots} robots, {received} samples received>"

    if not TYPE_CHECKING:  # type checkers report such names themselves

        def __getattr__(self, name: str) -> NoReturn:
            raise missing_method(self, name, self.__dict__.get("buffer"))

    def lookup(
        self,
        target: str,
        source: str,
        at: int | None = None,
        *,
        exact: bool = False,
        timeout_s: float = 1.0,
    ) -> Transform:
        """``buffer.lookup(target, source, at)``; with ``exact`` the writers are asked for all their samples.

        A router between may thin the samples, and then a lookup interpolates over long intervals. With
        ``exact`` the samples around ``at`` that are missing are requested from the writers that move the
        path, for up to ``timeout_s`` [s], and inserted: the answer equals that of a listener next to them.
        Writers keep their last seconds (their ``cache_s``). Raises as ``buffer.wait``, and Unreachable if a
        writer does not reply. On the ROS wires raises InvalidInput.
        """
        if not exact:
            return self.buffer.lookup(target, source, at)
        if self._wire.name != "native":
            raise InvalidInput(
                f"exact=True needs the native wire; nodes of {self._wire.name!r} keep no samples"
            )
        from zstate.nodes.exact_lookup import ExactLookup  # noqa: PLC0415 - for thinned streams alone

        return ExactLookup(self.buffer, self._reader).lookup(target, source, at, timeout_s)

    @property
    def stats(self) -> ListenerStats:
        """Counts of samples received, lost and refused so far."""
        return self._counters.stats()

    def stats_of(self, robot: str) -> ListenerStats:
        """The part of ``stats`` that concerns one robot."""
        return self._counters.for_robot(robot).stats()

    @property
    def refusals(self) -> dict[str, str]:
        """The text of the first refusal of each reason in ``stats.refused``."""
        return self._counters.refusals()

    def refusals_of(self, robot: str) -> dict[str, str]:
        """The part of ``refusals`` that concerns one robot."""
        return self._counters.for_robot(robot).refusals()

    def robots(self) -> tuple[str, ...]:
        """The robots that sent any message so far, sorted by name."""
        return self._reader.ingests.robots()

    def events(self) -> tuple[WriterEvent, ...]:
        """The last 1024 events of writers, oldest first.

        Without ``on_event`` there are no "stale" events, and a writer that froze before it disappeared has
        "left".
        """
        return self._diagnostics.events()

    def add_observer(self, notify: Callable[[], object]) -> None:
        """Call ``notify()`` after each batch of messages that was processed, on its thread: keep it short."""
        self._reader.add_observer(notify)

    def close(self) -> None:
        """Stop listening; the buffer keeps its samples. A second call does nothing."""
        _LISTENERS.discard(self)
        feed_of(self.buffer).explain_unknown(None)
        self._opened.close()

    def _explain_unknown(self, frame_count: int) -> str:
        """Why a frame is unknown among ``frame_count``, for an error.

        Without any frame these are the robots that are missing, and similar names: queries the tokens of all
        robots if one is missing, which takes up to a second.
        """
        if self._wire.shared:
            return ""
        if frame_count:
            robots = ", ".join(map(repr, self._robots))
            return "" if ANY in self._robots else f"this listener receives {shortened(robots)} alone"
        present = {robot for robot, _ in list(self._reader.ingests.writers)}
        missing = [name for name in self._robots if name not in (ANY, *present)]
        if missing:
            robots = announced_robots(self._session, self._wire)
            names = (f"robot {name!r} is not announced{did_you_mean(name, robots)}" for name in missing)
            return f"{'; '.join(names)} (announced: {shortened(', '.join(robots) or 'no robot')})"
        if not present:
            return ""
        return f"{shortened(', '.join(sorted(present)))} is announced, but no frame of it has arrived yet"

    def end_after_fork(self) -> None:
        """End the buffer in a forked child, where nothing fills it."""
        self.buffer.stop(
            f"its listener belongs to process {self._pid} and does not run after a fork: no more data comes; "
            "call connect() and open a listener in the child processes alone, or start them with the 'spawn' "
            "or 'forkserver' method"
        )


def _checked_placers(placers: Collection[str] | None, wire: Wire) -> frozenset[str] | None:
    if placers is None:
        return None
    if isinstance(placers, str):
        raise InvalidInput(f"placers is a collection of robot names, for instance {[placers]!r}")
    if wire.shared:
        raise InvalidInput(f"placers need the native wire; on {wire.name!r} no frame belongs to a robot")
    return frozenset(map(check_robot, placers))


_LISTENERS: weakref.WeakSet[TransformListener] = weakref.WeakSet()
os.register_at_fork(after_in_child=lambda: [listener.end_after_fork() for listener in tuple(_LISTENERS)])
