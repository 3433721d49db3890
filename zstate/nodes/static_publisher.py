"""Publisher of static transforms: edges that never move, latched for listeners that join later.

``ValuePublisher`` is what it has in common with publishers of other latched values, such as maps.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from contextlib import ExitStack
from typing import ClassVar
from urllib.parse import quote

from zstate._util.closeable import Closeable
from zstate._util.fork_safe import fork_safe_lock
from zstate.buffer.buffer import TransformBuffer
from zstate.checks import check_names
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.net.ownership import WriterClaim, check_readers, claim_edges
from zstate.net.presence import local_writer
from zstate.net.session import Session
from zstate.net.writer import WireWriter, write_all
from zstate.transform import Transform
from zstate.wire.identity import Announcement, WriterId
from zstate.wire.keys import MODEL_WRITER, check_robot, check_writer, full_name
from zstate.wire.messages import Message, StaticTransforms, to_block
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


def edge_writer_name(writer: str | None, identity: WriterId) -> str:
    """The name under which a writer publishes edges. Raises InvalidInput if it cannot be one."""
    if writer is None:
        # A script name may have blanks, which a key cannot.
        writer = f"{quote(identity.program, safe='')}.{identity.pid}.{identity.session:08x}"
    if check_writer(writer) == MODEL_WRITER:
        raise InvalidInput(f"the writer name {MODEL_WRITER!r} belongs to the robot's own model")
    return writer


class StaticPublisher(ValuePublisher):
    """Publishes static edges under one writer's name; a robot may have several such writers.

    Bare frame names are the robot's own; other frames have full names, ``robot/frame``. All edges of a
    writer travel together, and a new value replaces the previous one everywhere. ``close()`` withdraws
    them; the ROS wires cannot express that, so there only later joiners no longer receive them.
    ``writer`` distinguishes this publisher from others; default: the program, its process id and a
    random number. ``program`` is the script's name by default.

    On the native wire SecondWriter, which names the first writer, is raised if another active writer has
    the same name, and by ``set`` if another static writer of any robot places the same frame. If two do
    so at once, the later one raises it, and is closed if both have one name. Not raised with
    ``takeover``.
    """

    _KIND = "static publisher"

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
        identity = local_writer(secrets.randbits(32), program)
        name = edge_writer_name(writer, identity)
        self._session = session
        self._edges: dict[str, Transform] = {}
        # Raises here, where the mistake is made, what every listener would refuse.
        self._check = TransformBuffer()
        announced = Announcement(check_robot(robot), "tf_static", identity, name)
        super().__init__(session, announced, wires, owns=not takeover)

    def __repr__(self) -> str:
        closed = ", closed" if self._closed else ""
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
        with self._lock, ExitStack() as placed:
            self._check_open()
            if self._claim is not None:
                if child not in self._edges:
                    check_readers(self._session, self._announced, [(parent, child)])
                    placed.enter_context(claim_edges(self._session, self._announced, [(parent, child)]))
                # Last: an earlier writer that answered above has announced itself by now.
                try:
                    self._claim.check()
                except SecondWriter:
                    self._opened.close()  # without withdrawing: the value of this name is the first writer's
                    raise
            self._check.insert_static(
                Transform(parent, child, transform.translation, transform.rotation), writer=self.writer
            )
            self._edges[child] = transform
            self._send_edges()

    def withdraw(self, child: str) -> None:
        """Withdraw the edge that places ``child``. Raises InvalidInput if this writer has none."""
        check_names(child)
        name = full_name(self.robot, child)
        with self._lock:
            self._check_open()
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
        self._send(StaticTransforms(self._announced.writer.session, edges, poses))
