"""Checks that the target frames of static edges exist; similar names of unknown frames."""

from __future__ import annotations

import re
import threading
from collections.abc import Collection, Sequence
from contextlib import ExitStack, suppress
from difflib import get_close_matches
from typing import TYPE_CHECKING

from zstate._util.closeable import Closeable
from zstate.clock import wait_interruptible
from zstate.errors import MessageError, ModelError, ZStateError
from zstate.model.urdf import parse_urdf
from zstate.net.latched import LatchedSubscriber
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER, full_name
from zstate.wire.messages import RobotDescription, StaticTransforms
from zstate.wire.registry import get_wire

if TYPE_CHECKING:
    from zstate.model.robot import RobotModel
    from zstate.net.session import Session
    from zstate.nodes.static_publisher import StaticPublisher
    from zstate.wire.protocol import SerializedSample

_MODEL_WITHIN_S = 1.5


def unknown_target_warnings(
    session: Session, publisher: StaticPublisher, edges: Sequence[Transform]
) -> list[str]:
    """Warnings about ``edges`` of ``publisher`` whose target frame is unknown.

    Waits up to 1.5 s for the model of each robot that a target belongs to. Without a model, or if access
    control hides it, only similar names among other static frames are reported.
    """
    full = [
        Transform(
            full_name(publisher.robot, edge.target),
            full_name(publisher.robot, edge.source),
            edge.translation,
            edge.rotation,
        )
        for edge in edges
    ]
    warnings: list[str] = []
    for robot in dict.fromkeys(edge.target.partition("/")[0] for edge in full):
        with suppress(ZStateError), KnownFrames(session, robot, publisher.writer) as frames:
            frames.wait_for_model()
            edges_on = [edge for edge in full if edge.target.startswith(f"{robot}/")]
            warnings += frames.warnings(edges_on, {edge.source for edge in full})
    return warnings


def similar_frames(name: str, known: Collection[str]) -> list[str]:
    """Frames of the same robot with a name similar to ``name``, without the robot's name."""
    robot, _, bare = name.partition("/")
    others = [frame.removeprefix(f"{robot}/") for frame in known if frame.startswith(f"{robot}/")]
    return get_close_matches(bare, sorted(others), n=3)


def without_program_advice(text: str) -> str:
    """The text of a refused edge without the advice to call ``withdraw``, which is for programs."""
    return re.sub(r"; withdraw\('[^']*'\) first if it really moved", "", text)


class KnownFrames(Closeable):
    """The links of ``robot`` and the frames of its static writers other than ``writer``."""

    def __init__(self, session: Session, robot: str, writer: str) -> None:
        self._robot, self._writer = robot, writer
        self._wire = get_wire("native")
        self._model: RobotModel | None = None
        self._described = threading.Event()
        self._statics: dict[str, frozenset[str]] = {}
        with ExitStack() as opening:
            key = self._wire.expression(robot, "tf_static")
            opening.enter_context(LatchedSubscriber(session, key, self._on_statics))
            key = self._wire.expression(robot, "robot_description")
            opening.enter_context(LatchedSubscriber(session, key, self._on_description))
            self._opened = opening.pop_all()

    def close(self) -> None:
        self._opened.close()

    def _on_description(self, arrival: SerializedSample) -> None:
        with suppress(MessageError, ModelError):
            for message in self._wire.decode("robot_description", arrival, self._robot):
                if isinstance(message, RobotDescription):
                    self._model = parse_urdf(message.urdf, f"the URDF of {self._robot!r}")
                    self._described.set()

    def _on_statics(self, arrival: SerializedSample) -> None:
        writer = self._wire.static_writer_name(arrival.key) or ""
        if writer in (MODEL_WRITER, self._writer):
            return
        with suppress(MessageError):
            for message in self._wire.decode("tf_static", arrival, self._robot):
                if isinstance(message, StaticTransforms):
                    names = (full_name(self._robot, frame) for edge in message.edges for frame in edge)
                    self._statics[writer] = frozenset(names)

    def wait_for_model(self) -> None:
        """Wait until the model has arrived, at most 1.5 s."""
        wait_interruptible(self._described, _MODEL_WITHIN_S)

    def warnings(self, edges: Sequence[Transform], placed: Collection[str]) -> list[str]:
        """Warnings about ``edges``; frames that are ``placed`` with them count as known."""
        links = () if self._model is None else self._model.links
        known = frozenset(full_name(self._robot, link) for link in links).union(*self._statics.values())
        targets = dict.fromkeys(edge.target for edge in edges if edge.target not in known.union(placed))
        sources = {edge.target: edge.source for edge in edges}
        found = [self._warning(target, sources[target], known) for target in targets]
        return list(filter(None, found))

    def _warning(self, target: str, source: str, known: frozenset[str]) -> str:
        bare, robot = target.removeprefix(f"{self._robot}/"), self._robot
        near = similar_frames(target, known)
        if near:
            which = " or ".join(map(repr, near))
            return f"{robot!r} has no frame {bare!r}; did you mean {which}? (--new if it is a new frame)"
        if self._model is None:
            return ""
        if source in known:
            return (
                f"{target!r} is a new frame of {robot!r} alone; name a frame that robots share in full, "
                f"for instance fleet/{bare} (--new if it is a new frame)"
            )
        return f"{robot!r} has no frame {bare!r}: {source!r} is not joined to it (--new if it is a new frame)"
