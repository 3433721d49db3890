"""Checks that the target frames of static edges exist; similar names of unknown frames."""

from __future__ import annotations

import re
import threading
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, suppress
from difflib import get_close_matches
from typing import TYPE_CHECKING

from zstate._util.closeable import Closeable
from zstate.clock import wait_interruptible
from zstate.errors import ModelError, ZStateError
from zstate.model.urdf import parse_urdf
from zstate.net.subscription import Received, subscribe
from zstate.wire.keys import MODEL_WRITER, full_name
from zstate.wire.messages import RobotDescription, StaticTransforms
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.nodes.static_publisher import StaticPublisher
    from zstate.transform import Transform

_MODEL_WITHIN_S = 1.5


def unknown_target_warnings(
    session: Session, publisher: StaticPublisher, edges: Sequence[Transform]
) -> list[str]:
    """Warnings about ``edges`` of ``publisher`` whose target frame is unknown.

    Waits up to 1.5 s for the model of each robot that a target belongs to. Without a model, or if access
    control hides it, only similar names among other static frames are reported.
    """
    owner = publisher.robot
    full = {full_name(owner, edge.target): full_name(owner, edge.source) for edge in edges}
    placed = {full_name(owner, edge.source) for edge in edges}
    warnings: list[str] = []
    for robot in dict.fromkeys(target.partition("/")[0] for target in full):
        with suppress(ZStateError), _KnownFrames(session, robot, publisher.writer) as frames:
            wait_interruptible(frames.described, _MODEL_WITHIN_S)
            known = frames.names()
            for target, source in full.items():
                if target.startswith(f"{robot}/") and target not in known | placed:
                    warnings += frames.warnings(target, source, known)
    return warnings


def similar_frames(name: str, known: Collection[str]) -> list[str]:
    """Frames of the same robot with a name similar to ``name``, without the robot's name."""
    robot, _, bare = name.partition("/")
    others = [frame.removeprefix(f"{robot}/") for frame in known if frame.startswith(f"{robot}/")]
    return get_close_matches(bare, sorted(others), n=3)


def without_program_advice(text: str) -> str:
    """The text of a refused edge without the advice to call ``withdraw``, which is for programs."""
    return re.sub(r"; withdraw\('[^']*'\) first if it really moved", "", text)


class _KnownFrames(Closeable):
    """The links of ``robot`` and the frames of its static writers other than ``writer``."""

    def __init__(self, session: Session, robot: str, writer: str) -> None:
        self._robot, self._writer = robot, writer
        self._wire = get_wire("native")
        self._model: RobotModel | None = None
        self.described = threading.Event()
        self._statics: dict[str, frozenset[str]] = {}
        with ExitStack() as opening:
            for stream in ("tf_static", "robot_description"):
                opening.enter_context(subscribe(session, self._wire, robot, stream, self._on_messages))
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def _on_messages(self, received: list[Received]) -> None:
        for _, key, message in received:
            if isinstance(message, StaticTransforms):
                writer = self._wire.edge_writer_name(key) or ""
                if writer not in (MODEL_WRITER, self._writer):
                    names = (full_name(self._robot, frame) for edge in message.edges for frame in edge)
                    self._statics[writer] = frozenset(names)
            elif isinstance(message, RobotDescription):
                with suppress(ModelError):
                    self._model = parse_urdf(message.urdf, f"the URDF of {self._robot!r}")
                    self.described.set()

    def names(self) -> frozenset[str]:
        """The full names of all known frames."""
        links = () if self._model is None else self._model.links
        return frozenset(full_name(self._robot, link) for link in links).union(*self._statics.values())

    def warnings(self, target: str, source: str, known: frozenset[str]) -> Iterator[str]:
        """The warning about an unknown ``target``; none without a model and a similar name."""
        bare, robot = target.removeprefix(f"{self._robot}/"), self._robot
        if near := similar_frames(target, known):
            which = " or ".join(map(repr, near))
            yield f"{robot!r} has no frame {bare!r}; did you mean {which}? (--new if it is a new frame)"
        elif self._model is not None and source in known:
            yield (
                f"{target!r} is a new frame of {robot!r} alone; name a frame that robots share in full, "
                f"for instance fleet/{bare} (--new if it is a new frame)"
            )
        elif self._model is not None:
            fact = f"{robot!r} has no frame {bare!r}: {source!r} is not joined to it"
            yield f"{fact} (--new if it is a new frame)"
