"""Where curves come from: what is said now, and recordings."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING

from zstate.cli.documents import Document, DocumentWriter
from zstate.cli.named_joints import Named
from zstate.cli.output.console import fail, print_status
from zstate.cli.plot.curves import Curves, joint_curves, path_curves
from zstate.cli.robot_directory import RobotDirectory
from zstate.cli.stream_reader import StreamReader
from zstate.cli.waiting import PoseWaiter
from zstate.cli.words import followed
from zstate.nodes.listener import TransformListener
from zstate.recording.decode import DecodedRecording, first_descriptions
from zstate.recording.load import check_has_robot
from zstate.recording.reader import RecordingReader
from zstate.recording.recording import Recording
from zstate.wire.messages import JointState, RobotDescription

if TYPE_CHECKING:
    from zstate.net.session import Session

_WAIT_S = 10.0
_LOG = logging.getLogger("zstate")


def live_joints(session: Session, robot: str, wire: str, seconds: float) -> Curves:
    """The joints of ``robot`` for ``seconds`` from now on. Fails when no sample comes."""
    with Named(session, robot, wire) as named, StreamReader(session, robot, "joint_states", wire) as tap:
        documents = [named.document(tap.first(_WAIT_S))]
        print_status(f"listening to {robot} for {seconds:g} s ...")
        deadline = time.monotonic() + seconds
        while (left_s := deadline - time.monotonic()) > 0.0:
            tapped = tap.next(left_s)
            if tapped is not None:
                documents.append(named.document(tapped))
        return joint_curves(documents, named.model)


def live_path(session: Session, robot: str, wire: str, frames: tuple[str, str], seconds: float) -> Curves:
    """The path of frame B in frame A for ``seconds`` from now on. Fails when no pose comes."""
    with (
        RobotDirectory(session, robot, wire) as roster,
        TransformListener(
            session,
            robot,
            wire=wire,
            follow=followed(wire),
            history_s=seconds + 1.0,
            history_on_join=False,
        ) as listener,
    ):
        PoseWaiter(listener, roster, *frames).answer(timeout_s=_WAIT_S)
        print_status(f"listening for {seconds:g} s ...")
        time.sleep(seconds)
        return path_curves(listener.buffer, *frames)


def recorded_joints(path: str, robot: str | None, start_s: float, seconds: float | None) -> Curves:
    """The joints of ``robot``, or of the only one, in a recording. Raises RecordingError and InvalidInput."""
    with RecordingReader(path) as reader:
        transcript = DecodedRecording(reader, _refuse)
        name = _only(transcript.robots) if robot is None else check_has_robot(transcript, robot)
        writer = DocumentWriter()
        for described in first_descriptions(transcript, (name,)).values():
            if isinstance(described.message, RobotDescription):
                writer.describe(described.message)
        first, _ = reader.span or (0, 0)
        begin = first + round(start_s * 1e9)
        end = None if seconds is None else begin + round(seconds * 1e9)
        documents = list(_documents(transcript, name, writer, begin, end))
    if not documents:
        fail(f"{path}: no joint state of {name!r}{' in that time' if start_s or seconds else ''}")
    return joint_curves(documents, writer.model)


def _documents(
    transcript: DecodedRecording, robot: str, writer: DocumentWriter, begin: int, end: int | None
) -> Iterator[Document]:
    for said in transcript.messages((robot,), ("joint_states",), begin, end):
        if isinstance(said.message, JointState):
            yield writer.document(said.message)


def recorded_path(
    path: str, robot: str | None, frames: tuple[str, str], start_s: float, seconds: float | None
) -> Curves:
    """The path of frame B in frame A in a recording. Raises RecordingError, InvalidInput, LookupFailed."""
    with Recording(path, robot) as recording:
        return path_curves(recording.buffer(), *frames, start_s=start_s, seconds=seconds)


def _only(robots: tuple[str, ...]) -> str:
    if len(robots) != 1:
        there = f"robots {', '.join(robots)}: name one of them" if robots else "no robot"
        fail(f"the recording has {there}")
    return robots[0]


def _refuse(reason: str, text: str) -> None:
    _LOG.warning("left out (%s): %s", reason, text)
