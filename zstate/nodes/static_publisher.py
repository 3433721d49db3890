"""Publisher of static transforms: edges that never move, latched for listeners that join later.

``ValuePublisher`` is what it has in common with publishers of other latched values, such as maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack

from zstate._util.closeable import Closeable
from zstate.buffer.buffer import TransformBuffer
from zstate.checks import check_names
from zstate.errors import InvalidInput
from zstate.net.edge_ownership import check_readers, claim_edges
from zstate.net.session import Session
from zstate.net.writer import write_all
from zstate.nodes.robot_writer import RobotWriter
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.keys import full_name
from zstate.wire.messages import StaticTransforms, to_block


class ValuePublisher(Closeable):
    """Base of the publishers of one latched value of a robot, on ``stream`` under the name ``writer``.

    On the native wire it owns the value, unless another writer may take it over (``owns`` is False).
    """

    def __init__(self, out: RobotWriter, stream: StreamName, writer: str, *, owns: bool = True) -> None:
        self.robot = out.robot
        self.writer = writer
        self._out = out
        self._announced = out.announcement(stream, writer)
        with out.opening():
            if owns:  # on the native wire; in ROS any node may write it
                out.own([self._announced])
            self._latched = [one.open_latched(stream, writer) for one in out.open_wires().values()]
            if out.claim is not None:
                out.claim.confirm()

    def close(self) -> None:
        """Withdraw the value. A second call does nothing."""
        self._out.close(self._latched)


class StaticPublisher(ValuePublisher):
    """Publishes static edges under one writer's name; a robot may have several such writers.

    Bare frame names are the robot's own; other frames have full names, ``robot/frame``. All edges of a
    writer travel together, and a new value replaces the previous one everywhere. ``close()`` withdraws
    them; the ROS wires cannot express that, so there only later joiners no longer receive them.

    - ``robot``: the robot that the writer belongs to.
    - ``writer``: distinguishes this publisher from others; default: the program, its process id and a random
      number.
    - ``wires``: what it publishes on, "native", "ros2" with options, or several.
    - ``program``: the writer's name for others; default: the script's name.
    - ``takeover``: publish even if another writer has the name or places the frame.

    On the native wire SecondWriter, which names the first writer, is raised if another active writer has
    the same name, and by ``set`` if another static writer of any robot places the same frame. If two do
    so at once, the later one raises it, and is closed if both have one name. Not raised with
    ``takeover``.
    """

    def __init__(
        self,
        session: Session,
        robot: str,
        writer: str | None = None,
        wires: str | Sequence[str] = ("native",),
        *,
        program: str = "",
        takeover: bool = False,
    ) -> None:
        self._edges: dict[str, Transform] = {}
        # Raises here, where the mistake is made, what every listener would refuse.
        self._check = TransformBuffer()
        out = RobotWriter(session, robot, wires, program)
        name = out.edge_writer_name(writer)
        out.title = f"the static publisher {name!r}"
        super().__init__(out, "tf_static", name, owns=not takeover)

    def __repr__(self) -> str:
        closed = ", closed" if self._out.is_closed else ""
        return f"<StaticPublisher {self.writer!r} of {self.robot!r}: {len(self._edges)} edges{closed}>"

    def set(self, transform: Transform) -> None:
        """Publish or replace the edge that places ``transform.source`` on ``transform.target``.

        Static edges count as exact: its covariance is not published. Raises InsertRefused for a self edge, a
        loop or a second parent among this writer's edges; on the native wire also for an edge that
        contradicts an announced model, or that places a frame of another robot if that robot, or a third one,
        places it. Raises InvalidInput for names that cannot be frames, SecondWriter and Closed.
        """
        parent = full_name(self.robot, transform.target)
        child = full_name(self.robot, transform.source)
        out, announced = self._out, self._announced
        with out.lock, ExitStack() as placed:
            out.check_open()
            if out.claim is not None and child not in self._edges:
                check_readers(out.session, announced, [(parent, child)])
                placed.enter_context(claim_edges(out.session, announced, [(parent, child)]))
            # Last: an earlier writer that answered above has announced itself by now. One of the same name
            # closes this publisher, which does not withdraw the value: it is the first writer's.
            out.check()
            self._check.insert_static(
                Transform(parent, child, transform.translation, transform.rotation), writer=self.writer
            )
            self._edges[child] = transform
            self._send_edges()

    def withdraw(self, child: str) -> None:
        """Withdraw the edge that places ``child``. Raises InvalidInput if this writer has none."""
        check_names(child)
        name = full_name(self.robot, child)
        with self._out.lock:
            self._out.check_open()
            if name not in self._edges:
                ours = ", ".join(map(repr, self._edges)) or "none"
                raise InvalidInput(
                    f"{child!r} is not placed by the writer {self.writer!r}; its edges: {ours}"
                )
            self._check.withdraw(name)
            del self._edges[name]
            self._send_edges()

    def _send_edges(self) -> None:
        edges = tuple((edge.target, edge.source) for edge in self._edges.values())
        poses = to_block([edge.pose7 for edge in self._edges.values()])
        write_all(self._latched, StaticTransforms(self._out.session_id, edges, poses))
