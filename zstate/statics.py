"""StaticPublisher: edges that never move, for everybody, whenever they join."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from contextlib import ExitStack
from urllib.parse import quote

from zstate.buffer.buffer import TransformBuffer
from zstate.checks import check_names
from zstate.closing import Closing
from zstate.errors import Closed, InvalidInput, SecondWriter
from zstate.locks import new_lock
from zstate.net.claims import Claim
from zstate.net.outlets import Outlets
from zstate.net.placing import check_readers, placing
from zstate.net.presence import writer_here
from zstate.net.session import Session
from zstate.net.wires import wire_named, wire_names
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER, check_robot, check_writer, full_name
from zstate.wire.messages import StaticTransforms, to_block
from zstate.wire.writer import Announced, Writer


class StaticPublisher(Closing):
    """Publishes static edges under one writer's name; several writers of a robot coexist.

    Bare frame names are the robot's own; other frames are named in full, ``robot/frame``. All edges
    of a writer travel together, and a new value replaces the old one everywhere. ``close()`` withdraws
    them; the ROS wires cannot say that, so that there only late joiners do not get them any more.
    ``writer`` tells this publisher from others: unless given, the program, its process id and a random
    number. ``program`` is the script's name unless given.

    On the native wire SecondWriter is raised, and names the first, where somebody else who lives writes
    under the same name, and by ``set`` for a frame that another static writer of any robot places; of two
    that do so at the same moment by the later one, which is closed by it where both have one name. Not
    with ``takeover``.
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
        identity = writer_here(secrets.randbits(32), program)
        self.robot = check_robot(robot)
        self.writer = check_writer(_default_writer(identity) if writer is None else writer)
        if self.writer == MODEL_WRITER:
            raise InvalidInput(f"the writer name {MODEL_WRITER!r} belongs to the robot's own model")
        self._session_id = identity.session
        self._edges: dict[str, Transform] = {}
        # Refuses here, where the mistake is made, what every reader would refuse.
        self._check = TransformBuffer()
        self._lock = new_lock()
        self._closed = False
        self._session = session
        self._announced = Announced(self.robot, "tf_static", identity, self.writer)
        self._claim: Claim | None = None
        with ExitStack() as opening:
            if "native" in wire_names(wires) and not takeover:  # in ROS static edges are everybody's
                self._claim = opening.enter_context(Claim(session, [self._announced]))
            self._latched = [
                opening.enter_context(Outlets(session, wire_named(wire), robot, identity)).latched(
                    "tf_static", self.writer
                )
                for wire in wire_names(wires)
            ]
            if self._claim is not None:
                self._claim.settle()
            self._opened = opening.pop_all()

    def __repr__(self) -> str:
        closed = ", closed" if self._closed else ""
        return f"<StaticPublisher {self.writer!r} of {self.robot!r}: {len(self._edges)} edges{closed}>"

    def set(self, transform: Transform) -> None:
        """Publish or replace the edge that places ``transform.source`` on ``transform.target``.

        Raises InsertRefused for a self edge, a loop or a second parent among this writer's edges, and on
        the native wire for an edge that contradicts a model that is announced or places a frame of another
        robot where that robot, or a third one, has a say; InvalidInput for names that cannot be frames,
        SecondWriter and Closed.
        """
        parent = full_name(self.robot, transform.target)
        child = full_name(self.robot, transform.source)
        with self._lock, ExitStack() as placed:
            self._check_open()
            if self._claim is not None:
                if child not in self._edges:
                    check_readers(self._session, self._announced, [(parent, child)])
                    placed.enter_context(placing(self._session, self._announced, [(parent, child)]))
                # Now: of those who have answered we have heard, too, if they came before.
                self._yield_to_the_first(self._claim)
            self._check.insert_static(
                Transform(parent, child, transform.translation, transform.rotation), writer=self.writer
            )
            self._edges[child] = transform
            self._send()

    def _yield_to_the_first(self, claim: Claim) -> None:
        try:
            claim.check()
        except SecondWriter:
            self._opened.close()  # not withdrawn: what is under this name is the first one's
            raise

    def withdraw(self, child: str) -> None:
        """Take back the edge that places ``child``. Raises InvalidInput if it is not one of ours."""
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
            self._send()

    def _check_open(self) -> None:
        if self._closed:
            raise Closed(f"the static publisher {self.writer!r} is closed")

    def _send(self) -> None:
        edges = tuple((edge.target, edge.source) for edge in self._edges.values())
        poses = to_block([edge.pose7 for edge in self._edges.values()])
        message = StaticTransforms(self._session_id, edges, poses)
        # All of them first: what one wire cannot say is said on none.
        said = [(latched, latched.encode(message)) for latched in self._latched]
        for latched, payload in said:
            latched.put(payload)

    def close(self) -> None:
        """Withdraw the edges. A second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            for latched in self._latched:
                latched.withdraw()
            self._opened.close()


def _default_writer(identity: Writer) -> str:
    # The name of a script may have blanks, which no key has.
    return f"{quote(identity.program, safe='')}.{identity.pid}.{identity.session:08x}"
