"""Recorded robots: a whole recording on its way into a buffer.

Of one writer a buffer learns the same from a recording as it did live. What a listener forgets when
another writer appears, a recording keeps:

==========================================  ============================================================
what the recording holds                    what becomes of it
==========================================  ============================================================
a writer ends, a new one goes on later      one history; between the two it is interpolated as elsewhere
a new writer whose clock is back            the history begins anew with it
two samples in a row more than 0.1 s back   the clock was set back: the history begins anew
another model (URDF) of a robot             the robot begins anew
a static edge is withdrawn                  it holds until something else places the frame
==========================================  ============================================================
"""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InvalidInput
from zstate.following.follower import Follower
from zstate.following.ownership import FrameOwnership
from zstate.following.recorded_followers import EdgeTimes, RecordedEdges, RecordedJoints
from zstate.following.statics import StaticFollower
from zstate.following.tally import Stats, Tally
from zstate.following.unmodelled import Unmodelled
from zstate.model.robot import RobotModel
from zstate.record.models import first_descriptions, model_of
from zstate.record.reader import RecordReader
from zstate.record.transcript import Said, Speaker, Transcript
from zstate.wire.keys import MODEL_WRITER, full_name
from zstate.wire.messages import (
    JointState,
    RobotDescription,
    StaticTransforms,
    TransformSample,
)

HISTORY_S = 9e8
"""The history of a buffer that keeps all of a recording [s]: 28 years, of whatever clock."""

_BATCH = 4096
"""At least so many messages are taken before those are forgotten that no answer needs."""

_UNNAMED = "a ROS node"


def fill(
    buffer: TransformBuffer,
    reader: RecordReader,
    robot: str | None = None,
    *,
    around: NDArray[np.int64] | None = None,
) -> Stats:
    """Put a recording into ``buffer``: all of it, or what answers at the stamps ``around`` [ns] need.

    Raises InvalidInput when it tells nothing of ``robot``.
    """
    tally = Tally()
    buffer.is_recording = True
    transcript = Transcript(reader, tally.refuse)
    robots = None if robot is None else (check_recorded(transcript, robot),)
    shares_frames = any(speaker.foreign or _is_of_ros(speaker) for speaker in transcript.speakers)
    followed = RecordedRobots(buffer, tally, () if shares_frames else transcript.robots)
    for description in first_descriptions(transcript, robots).values():
        model = model_of(transcript, description, tally.refuse)
        if model is not None:
            followed.follow(description, model)
    stamps = None if around is None else np.unique(around)
    batch = _BATCH if stamps is None else max(_BATCH, len(stamps))
    for count, said in enumerate(transcript.said(robots), 1):
        followed.take(said)
        if stamps is not None and not count % batch:
            buffer.keep_only_around(stamps)
    return tally.stats()


def check_recorded(transcript: Transcript, robot: str) -> str:
    """``robot``, if the recording tells of it. Raises InvalidInput, with those it tells of."""
    if robot not in transcript.robots:
        there = ", ".join(map(repr, transcript.robots)) or "none"
        raise InvalidInput(f"the recording tells nothing of {robot!r}; its robots: {there}")
    return robot


def _is_of_ros(speaker: Speaker) -> bool:
    return speaker.stream == "tf_static" and speaker.static_writer is None


class RecordedRobots:
    """Takes what was said of robots, in the order of the recording, into ``buffer``.

    Frames of ``robots`` are placed as a listener has it, see ``FrameOwnership``; without any all share all.
    """

    def __init__(self, buffer: TransformBuffer, tally: Tally, robots: Collection[str]) -> None:
        self._tally = tally
        self._ownership = FrameOwnership(buffer, tally, is_shared=not robots)
        for robot in robots:
            self._ownership.add_robot(robot)
        self._joints: dict[str, RecordedJoints] = {}
        self._edges: dict[tuple[str, int], RecordedEdges] = {}
        self._statics: dict[tuple[str, str | int], StaticFollower] = {}
        self._said: dict[tuple[str, str | int], StaticTransforms] = {}
        self._withdrawn: set[str] = set()
        self._named: set[Speaker] = set()
        self._unmodelled = Unmodelled()
        self._times = EdgeTimes()

    def follow(self, description: Said, model: RobotModel) -> None:
        """Follow the joint states of a robot, whose ``model`` that is. Before anything is taken."""
        robot = description.speaker.robot
        self._unmodelled.learn(robot, model)
        self._joints[robot] = RecordedJoints(robot, self._ownership, self._unmodelled)
        self.take(description)

    def take(self, said: Said) -> None:
        """The next message."""
        speaker, message, _ = said
        if isinstance(message, JointState):
            self._take_joints(speaker, message)
        elif isinstance(message, TransformSample):
            self._take_edges(speaker, message)
        elif isinstance(message, StaticTransforms):
            self._take_statics(speaker, message)
        elif isinstance(message, RobotDescription) and speaker.robot in self._joints:
            self._name(self._joints[speaker.robot], speaker)
            self._joints[speaker.robot].describe(message)

    def _take_joints(self, speaker: Speaker, state: JointState) -> None:
        follower = self._joints.get(speaker.robot)
        if follower is None:
            text = f"{speaker.robot!r}: no robot_description fits its joint states"
            self._tally.refuse("no description", text)
        else:
            self._name(follower, speaker)
            follower.take(state, overflowed=False)

    def _take_edges(self, speaker: Speaker, sample: TransformSample) -> None:
        rest = self._unmodelled.sample(speaker.robot, sample)
        if rest is None or rest.edges is None:
            return
        self._make_way(speaker.robot, rest.edges)
        key = speaker.robot, speaker.session
        if key not in self._edges:
            self._edges[key] = RecordedEdges(speaker.robot, self._ownership, self._times)
        self._name(self._edges[key], speaker)
        self._edges[key].take(rest, overflowed=False)

    def _take_statics(self, speaker: Speaker, statics: StaticTransforms) -> None:
        robot, writer = speaker.robot, speaker.static_writer
        if writer == MODEL_WRITER and robot in self._joints:
            return  # the model itself says the same
        key = robot, speaker.session if writer is None else writer
        before = self._said.get(key)
        if before is not None and (before.edges, before.poses) == (statics.edges, statics.poses):
            return  # repeated for those who read from the middle
        self._said[key] = statics
        rest = self._unmodelled.statics(robot, statics)
        self._make_way(robot, rest.edges)
        if before is not None and writer is not None:
            self._withdrawn |= _children(robot, before.edges) - _children(robot, statics.edges)
        name = writer or speaker.program or _UNNAMED
        make = StaticFollower(robot, name, self._ownership)
        self._statics.setdefault(key, make).add(rest)

    def _name(self, follower: Follower, speaker: Speaker) -> None:
        if speaker not in self._named and speaker.program is not None:
            follower.name_writer(speaker.session, speaker.program)
            self._named.add(speaker)

    def _make_way(self, robot: str, edges: tuple[tuple[str, str], ...]) -> None:
        """Give up withdrawn edges whose frame is placed anew."""
        if self._withdrawn:
            for child in self._withdrawn & _children(robot, edges):
                self._withdrawn.discard(child)
                self._ownership.forget(child)


def _children(robot: str, edges: tuple[tuple[str, str], ...]) -> set[str]:
    found: set[str] = set()
    for _, child in edges:
        with suppress(InvalidInput):  # refused, and counted, by the follower
            found.add(full_name(robot, child))
    return found
