"""Transforms of a recording: each edge has one history, by the rules of ``Recording``."""

from __future__ import annotations

from contextlib import suppress

from zstate._util.bounded import BoundedDict
from zstate.errors import InvalidInput
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.transforms import TransformIngest
from zstate.recording.joint_states import DELAYED_NS
from zstate.wire.keys import full_name
from zstate.wire.messages import Edges, Sample, TransformSample, covariances_of


def children_of(robot: str, edges: Edges) -> set[str]:
    """The full names of the frames that ``edges`` place."""
    children: set[str] = set()
    for _, child in edges:
        with suppress(InvalidInput):  # refused and counted when it is inserted
            children.add(full_name(robot, child))
    return children


class RecordedTransformIngest(TransformIngest):
    """Inserts the edges of one writer, or of all writers of a shared topic; each edge has its own epochs."""

    def __init__(self, robot: str, ownership: FrameOwnership, epochs: EdgeEpochs) -> None:
        super().__init__(robot, ownership)
        self._epochs = epochs
        self._children: set[str] = set()
        self._names: BoundedDict[Edges, tuple[Edges, tuple[str, ...]]] = BoundedDict()

    def _insert(self, sample: Sample) -> bool | None:
        assert isinstance(sample, TransformSample)
        assert sample.edges is not None
        names = self._names.get(sample.edges)
        if names is None:
            named = self._named(sample.edges)
            names = self._names[sample.edges] = named, tuple(child for _, child in named)
        edges, children = names
        if not self._epochs.is_next(sample, children):
            if self._epochs.is_delayed(sample, children):
                return False
            self._children.update(children)
            if self._epochs.is_new_epoch(sample, children):
                self._drop_edges(set(children))
        inserted = self._buffer.insert_many(
            edges, sample.stamp, sample.poses, covariances=covariances_of(sample), writer=self.writer
        )
        self._epochs.add(sample, children)
        return inserted

    def _drop_edges(self, children: set[str]) -> None:
        for frame in self._buffer.frames():
            if frame.kind == "pose" and frame.name in children:
                self._buffer.withdraw(frame.name)
        self._epochs.remove(children)
        text = f"the clock of {sorted(children)[0]!r} went back: its history restarts"
        self._counters.warn_once(f"{self.robot} back", text)

    def _drop_history(self) -> None:
        self._drop_edges(self._children)
        self._newest_by_order.clear()


class EdgeEpochs:
    """The newest stamp of each edge, by its child, and the sessions that published it."""

    def __init__(self) -> None:
        self._newest: dict[str, int] = {}
        self._delayed: dict[str, int] = {}
        self._sessions: set[tuple[int, str]] = set()
        # The session and the edges of the last sample, whose newest stamp is that one: most samples are like
        # the one before.
        self._last: tuple[int, tuple[str, ...]] | None = None
        self._last_stamp = 0

    def is_next(self, sample: TransformSample, children: tuple[str, ...]) -> bool:
        """Whether it continues the last sample: of the same session and edges, with a later stamp."""
        return self._last == (sample.session, children) and sample.stamp > self._last_stamp

    def is_delayed(self, sample: TransformSample, children: tuple[str, ...]) -> bool:
        """Whether it is a single old sample, after which stamps may continue as before."""
        self._note_last()
        limit = sample.stamp + DELAYED_NS
        if not any(limit < self._newest.get(child, limit) for child in children):
            self._delayed.pop(children[0], None)
            return False
        before = self._delayed.pop(children[0], None)
        if before is not None and before < sample.stamp:
            return False
        self._delayed[children[0]] = sample.stamp
        return True

    def is_new_epoch(self, sample: TransformSample, children: tuple[str, ...]) -> bool:
        """Whether the clock went back: with a second old sample, or with another writer."""
        for child in children:
            newest = self._newest.get(child)
            if newest is not None and sample.stamp <= newest:
                is_new_writer = (sample.session, child) not in self._sessions
                if is_new_writer or sample.stamp < newest - DELAYED_NS:
                    return True
        return False

    def add(self, sample: TransformSample, children: tuple[str, ...]) -> None:
        """Add an inserted sample."""
        if self.is_next(sample, children):
            self._last_stamp = sample.stamp
            return
        for child in children:
            if sample.stamp > self._newest.get(child, sample.stamp - 1):
                self._newest[child] = sample.stamp
            self._sessions.add((sample.session, child))
        is_newest = all(self._newest[child] == sample.stamp for child in children)
        self._last, self._last_stamp = (sample.session, children) if is_newest else None, sample.stamp

    def remove(self, children: set[str]) -> None:
        """Remove edges whose history restarts."""
        self._note_last()
        self._last = None
        for child in children:
            self._newest.pop(child, None)

    def _note_last(self) -> None:
        """Note the stamp of the last sample for each of its edges."""
        if self._last is not None:
            self._newest |= dict.fromkeys(self._last[1], self._last_stamp)
            self._last = None
