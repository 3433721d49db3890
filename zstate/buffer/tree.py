"""Which edge places which frame: names, parents, roots and paths. Times are not its business."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

from zstate import se3
from zstate.buffer.tracks import JointTrack, PoseTrack
from zstate.errors import AmbiguousFrame, Disconnected, InsertRefused, UnknownFrame

EdgeKind = Literal["joint", "pose", "static"]


@dataclass(frozen=True, slots=True)
class Edge:
    """What places ``child`` on ``parent``.

    A static edge holds its ``pose``; a moving one its ``track`` and its ``index`` among the track's
    edges. ``robot`` is the joint track of the model the edge belongs to, fixed joints included.
    """

    parent: str
    child: str
    kind: EdgeKind
    pose: se3.Pose = se3.IDENTITY
    track: JointTrack | PoseTrack | None = None
    index: int = 0
    robot: JointTrack | None = None
    own_writer: str | None = None

    @property
    def names(self) -> tuple[str, str]:
        """(parent, child)."""
        return (self.parent, self.child)

    @property
    def writer(self) -> str | None:
        """Who gives this edge, as far as anybody said."""
        if self.robot is not None:
            return self.robot.writer or f"the model of {self.robot.model.name!r}"
        return self.track.writer if self.track is not None else self.own_writer


class Tree:
    """Frames by name, one parent each. Whoever changes it holds the buffer's lock.

    ``version`` grows with every change of an edge, so that compiled paths know when they are old.
    """

    def __init__(self) -> None:
        self.version = 0
        self.frames: dict[str, Edge | None] = {}
        self.robots: dict[str, JointTrack | None] = {}
        self._bare: defaultdict[str, list[str]] = defaultdict(list)

    def add_frame(self, name: str) -> None:
        """Know ``name``, for ever."""
        if name not in self.frames:
            self.frames[name] = None
            _, slash, bare = name.partition("/")
            if slash and not _name_problem(bare):
                self._bare[bare].append(name)
            self.version += 1

    @contextmanager
    def untouched_on_error(self) -> Generator[None]:
        """Changes inside the context are taken back when it raises."""
        before = dict(self.frames), {bare: list(names) for bare, names in self._bare.items()}
        try:
            yield
        except Exception:
            self.frames = before[0]
            self._bare = defaultdict(list, before[1])
            self.version += 1
            raise

    def attach(self, edge: Edge) -> None:
        """Place a child, or replace the edge that places it. Checked before by ``check_edge``."""
        self.add_frame(edge.parent)
        self.add_frame(edge.child)
        self.frames[edge.child] = edge
        self.version += 1

    def detach(self, child: str) -> None:
        """Take away what places ``child``; the frame stays known."""
        self.frames[child] = None
        self.version += 1

    def check_edge(self, parent: str, child: str, writer: str | None) -> None:
        """InsertRefused when the edge cannot be: names, self edge, second parent, loop."""
        for name in (parent, child):
            problem = _name_problem(name)
            if problem:
                raise InsertRefused(
                    f"{parent!r} -> {child!r}: {problem}", reason="frame name", edge=(parent, child)
                )
        if parent == child:
            raise InsertRefused(
                f"{parent!r} -> {child!r}: a frame cannot be placed on itself",
                reason="self edge",
                edge=(parent, child),
            )
        existing = self.frames.get(child)
        if existing is not None and existing.parent != parent:
            raise InsertRefused(
                f"{child!r} has the parent {existing.parent!r}{_by(existing.writer)} and cannot get a second "
                f"one, {parent!r}{_by(writer)}; withdraw({child!r}) first if it really moved",
                reason="second parent",
                edge=(parent, child),
            )
        if existing is None and child in self.frames:
            self._refuse_loop(parent, child, writer)

    def _refuse_loop(self, parent: str, child: str, writer: str | None) -> None:
        chain = list(self.upwards(parent))
        for edge in chain:
            if edge.parent == child:
                ring = " -> ".join(repr(name) for name in self._downwards(chain, child))
                raise InsertRefused(
                    f"{parent!r} -> {child!r}{_by(writer)} would close the loop {ring} -> {child!r}; "
                    f"{edge.parent!r} -> {edge.child!r} is written{_by(edge.writer) or ' by hand'}",
                    reason="loop",
                    edge=(parent, child),
                )

    @staticmethod
    def _downwards(chain: list[Edge], top: str) -> list[str]:
        names = [top]
        for edge in reversed(chain):
            if edge.parent == names[-1]:
                names.append(edge.child)
        return names

    def upwards(self, frame: str) -> Iterable[Edge]:
        """The edges above ``frame``, nearest first."""
        edge = self.frames.get(frame)
        while edge is not None:
            yield edge
            edge = self.frames.get(edge.parent)

    def root(self, frame: str) -> str:
        """The frame above ``frame`` that has no parent."""
        for edge in self.upwards(frame):
            frame = edge.parent
        return frame

    def named_for_insert(self, name: str) -> str:
        """The frame an inserted edge means: the one of that name, or a robot's by its bare name."""
        if name in self.frames:
            return name
        candidates = [full for full in self._bare.get(name, ()) if full.split("/", 1)[0] in self.robots]
        if len(candidates) > 1:
            raise InsertRefused(
                f"the frame name {name!r} is not unique: {', '.join(candidates)}; name it in full",
                reason="frame name",
                edge=(name, name),
            )
        return candidates[0] if candidates else name

    def resolve(self, name: str, target: str, source: str) -> str:
        """The frame a question means. Raises UnknownFrame or AmbiguousFrame."""
        if name in self.frames:
            return name
        candidates = self._bare.get(name, ())
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            raise AmbiguousFrame(target, source, name=name, candidates=candidates)
        raise UnknownFrame(
            target, source, name=name, near_misses=self.near(name), frame_count=len(self.frames)
        )

    def near(self, name: str) -> list[str]:
        """Names a question could use that look like ``name``, best first; bare ones where those do."""
        unique = {full[0]: bare for bare, full in self._bare.items() if len(full) == 1}
        known = [unique.get(frame, frame) if "/" not in name else frame for frame in self.frames]
        return get_close_matches(name, known, n=3, cutoff=0.7)

    def path(self, target: str, source: str) -> tuple[list[Edge], list[Edge]]:
        """The edges down to the target and down to the source, from where their ways up meet.

        Raises UnknownFrame, AmbiguousFrame or Disconnected.
        """
        target_frame = self.resolve(target, target, source)
        source_frame = self.resolve(source, target, source)
        above_target = list(self.upwards(target_frame))
        above_source = list(self.upwards(source_frame))
        target_ends = {target_frame: 0} | {edge.parent: n for n, edge in enumerate(above_target, 1)}
        names = [source_frame, *(edge.parent for edge in above_source)]
        for count, name in enumerate(names):
            if name in target_ends:
                return above_target[: target_ends[name]][::-1], above_source[:count][::-1]
        roots = (self.root(target_frame), self.root(source_frame))
        raise Disconnected(target, source, roots=roots)


def _name_problem(name: str) -> str:
    if not name:
        return "a frame name is empty"
    if name.startswith("/"):
        return f"the frame name {name!r} begins with a slash; write {name.lstrip('/')!r}"
    return ""


def _by(writer: str | None) -> str:
    return f" by {writer}" if writer else ""
