"""Bridge: whole robots between the native wire and a ROS wire, both ways, and nothing in a circle."""

from __future__ import annotations

import logging
import threading
from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial

from zstate.bridge.carrier import PROGRAM, Carrier, Side, Way
from zstate.closing import Closing
from zstate.errors import InvalidInput
from zstate.net.presence import watch
from zstate.net.session import Session
from zstate.net.wires import wire_named
from zstate.wire.keys import ANY, Stream, check_robot
from zstate.wire.ros2.wire import Ros2Wire
from zstate.wire.writer import Announced

_LOG = logging.getLogger("zstate")

# Whoever writes these writes the robot. All robots may stand in one /tf, which tells nothing of one.
_TELLING: tuple[Stream, ...] = ("joint_states", "robot_description")

_ADVICE = (
    "name one, as `zstate bridge panda` does, or give each its own namespace with the wire 'ros2:namespace=*'"
)


class Bridge(Closing):
    """Carries each robot that is written on one side to the other: joint states, model, static edges.

    Its moving transforms are derived again over there; those of ROS's /tf that belong to no model are
    not carried. ``robots`` names the robots; None is all, which needs a namespace for each: the
    ``ros_wire`` "ros2:namespace=*". What a bridge has written, this one or another, is
    never carried back, and a robot that others write on both sides is not carried, which is logged.

    ``on_change(robot, way)`` is called when a robot begins to be carried, or to have another model, and
    with None when it is carried no more; from threads of the bridge. Raises InvalidInput for robots
    that would share a namespace, and for a wire that does not tell who writes.
    """

    def __init__(
        self,
        native: Session,
        ros: Session,
        ros_wire: str = "ros2",
        robots: Sequence[str] | None = None,
        *,
        on_change: Callable[[str, Way | None], object] | None = None,
    ) -> None:
        _check(ros_wire, robots)
        self._sides = Side(native, "native", "native to ROS"), Side(ros, ros_wire, "ROS to native")
        self._on_change = on_change or _ignore
        self._writers: defaultdict[str, tuple[set[Announced], ...]] = defaultdict(lambda: (set(), set()))
        self._carriers: dict[str, Carrier] = {}
        self._conflicts: set[str] = set()
        self._lock = threading.RLock()  # on_change may ask for the carriers
        with ExitStack() as opening:
            opening.callback(self._end_all)
            for number, side in enumerate(self._sides):
                for robot in robots or (ANY,):
                    note = partial(self._note, number)
                    opening.enter_context(watch(side.session, robot, note, side.wire))
            self._opened = opening.pop_all()

    @property
    def carriers(self) -> tuple[Carrier, ...]:
        """Those at work, also for robots that nobody has described yet."""
        with self._lock:
            return tuple(self._carriers.values())

    def close(self) -> None:
        """Carry nothing any more. A second call does nothing."""
        self._opened.close()

    def _note(self, side: int, announced: Announced, alive: bool) -> None:
        # A ROS node is called with its namespace.
        if announced.stream in _TELLING and announced.writer.program.rpartition("/")[2] != PROGRAM:
            with self._lock:
                writers = self._writers[announced.robot]
                (writers[side].add if alive else writers[side].discard)(announced)
                self._decide(announced.robot, *writers)

    def _decide(self, robot: str, native: set[Announced], ros: set[Announced]) -> None:
        source, target = self._sides if native else reversed(self._sides)
        is_wanted = bool(native) != bool(ros)
        carrier = self._carriers.get(robot)
        if carrier is not None and not (is_wanted and carrier.source is source):
            self._end(robot)
        if is_wanted and robot not in self._carriers:
            begin = partial(self._on_change, robot, source.way)
            self._carriers[robot] = Carrier(robot, source, target, begin)
        self._note_conflict(robot, native, ros)

    def _note_conflict(self, robot: str, native: set[Announced], ros: set[Announced]) -> None:
        if not (native and ros):
            self._conflicts.discard(robot)
        elif robot not in self._conflicts:
            self._conflicts.add(robot)
            _LOG.warning(
                "%r is written natively by %s and on ROS by %s, so it is not carried; stop one of them, "
                "or give them different names",
                robot,
                _named(native),
                _named(ros),
                extra={"event": "conflict", "robot": robot},
            )

    def _end(self, robot: str) -> None:
        carrier = self._carriers.pop(robot)
        carrier.close()
        if carrier.has_begun:
            self._on_change(robot, None)

    def _end_all(self) -> None:
        with self._lock:
            for robot in list(self._carriers):
                self._end(robot)


def _ignore(robot: str, way: Way | None) -> None:
    pass


def _named(writers: set[Announced]) -> str:
    return " and ".join(sorted({repr(str(announced.writer)) for announced in writers}))


def _check(ros_wire: str, robots: Sequence[str] | None) -> None:
    wire = wire_named(ros_wire)
    if not isinstance(wire, Ros2Wire) or wire.name != "ros2":
        raise InvalidInput(
            f"a bridge leads to the wire 'ros2', not {wire.name!r}, on which it could not tell what it "
            "wrote itself"
        )
    options = wire.options
    if options.node:
        raise InvalidInput(
            f"the ros2 option node is {options.node!r}, but the nodes of a bridge are called "
            f"{PROGRAM!r}: by that bridges know each other; leave it out"
        )
    names = [check_robot(robot) for robot in robots or ()]
    if len(names) == 1:
        return
    if options.namespace != ANY:
        raise InvalidInput(
            f"the namespace '/{options.namespace}' of ROS has room for one robot, "
            f"not for {' and '.join(map(repr, names)) or 'all'}; {_ADVICE}"
        )
    if ANY not in (options.frame_prefix or ANY) and options.tf == "global":
        raise InvalidInput(f"the frames of several robots would be mixed up in /tf of ROS; {_ADVICE}")
