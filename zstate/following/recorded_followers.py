"""Followers of recordings: what a writer after the other said is one history, as long as time goes on."""

from __future__ import annotations

from zstate.following.edges import EdgeFollower
from zstate.following.joints import JointFollower
from zstate.following.ownership import FrameOwnership
from zstate.following.unmodelled import Unmodelled
from zstate.model.robot import RobotModel
from zstate.wire.messages import Sample, TransformSample, poses_from_block

_HELD_UP_NS = 10_000_000_000
"""A sample may come so late and still be one of its epoch, as with the history of a listener."""


class RecordedJoints(JointFollower):
    """Keeps what earlier writers said, as long as time went on."""

    def __init__(self, robot: str, ownership: FrameOwnership, unmodelled: Unmodelled) -> None:
        super().__init__(robot, ownership)
        self._newest: int | None = None
        self._unmodelled = unmodelled

    def _replace_model(self, model: RobotModel) -> None:
        super()._replace_model(model)
        self._unmodelled.learn(self.robot, model)

    def _insert(self, sample: Sample) -> bool:
        if self._newest is not None and sample.stamp < self._newest - _HELD_UP_NS:
            return False
        taken = super()._insert(sample)
        self._newest = sample.stamp if self._newest is None else max(self._newest, sample.stamp)
        return taken

    def _succeed(self, sample: Sample) -> None:
        if self._newest is not None and sample.stamp <= self._newest:
            self._restart()

    def _restart(self) -> None:
        self._newest = None
        super()._restart()


class RecordedEdges(EdgeFollower):
    """The edges of one writer, or of all that share a topic; each edge has epochs of its own."""

    def __init__(self, robot: str, ownership: FrameOwnership, times: EdgeTimes) -> None:
        super().__init__(robot, ownership)
        self._times = times
        self._children: set[str] = set()

    def _insert(self, sample: Sample) -> bool:
        assert isinstance(sample, TransformSample)
        assert sample.edges is not None
        edges = self._named(sample.edges)
        children = [child for _, child in edges]
        if self._times.is_held_up(sample, children):
            return False
        self._children.update(children)
        if self._times.begins_anew(sample, children):
            self._forget(set(children))
        poses = poses_from_block(sample.poses)
        taken = self._buffer.insert_many(edges, sample.stamp, poses, writer=self.writer)
        self._times.note(sample, children)
        return taken

    def _forget(self, children: set[str]) -> None:
        for frame in self._buffer.frames():
            if frame.kind == "pose" and frame.name in children:
                self._buffer.withdraw(frame.name)
        self._times.forget(children)
        text = f"the clock of {sorted(children)[0]!r} went back: its history begins anew"
        self._tally.note(f"{self.robot} back", text)

    def _restart(self) -> None:
        self._forget(self._children)
        self._newest_of.clear()


class EdgeTimes:
    """How new each edge is, by its child, and who said so."""

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}
        self._held_up: dict[str, int] = {}
        self._sessions: set[tuple[int, str]] = set()

    def is_held_up(self, sample: Sample, children: list[str]) -> bool:
        """Whether it is one sample of long ago, after which time may go on as before."""
        limit = sample.stamp + _HELD_UP_NS
        if not any(limit < self._newest.get(child, limit) for child in children):
            self._held_up.pop(children[0], None)
            return False
        before = self._held_up.pop(children[0], None)
        if before is not None and before < sample.stamp:
            return False
        self._held_up[children[0]] = sample.stamp
        return True

    def begins_anew(self, sample: Sample, children: list[str]) -> bool:
        """Whether time went back: by two samples of long ago, or with another writer."""
        for child in children:
            newest = self._newest.get(child)
            if newest is not None and sample.stamp <= newest:
                is_new = (sample.session, child) not in self._sessions
                if is_new or sample.stamp < newest - _HELD_UP_NS:
                    return True
        return False

    def note(self, sample: Sample, children: list[str]) -> None:
        """It was taken."""
        for child in children:
            if sample.stamp > self._newest.get(child, sample.stamp - 1):
                self._newest[child] = sample.stamp
            self._sessions.add((sample.session, child))

    def forget(self, children: set[str]) -> None:
        """They begin anew."""
        for child in children:
            self._newest.pop(child, None)
