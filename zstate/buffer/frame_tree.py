"""Frame tree: which edge places which frame, frame names, and the paths between frames.

It knows no stamps; samples are in the tracks behind the edges.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable, Collection, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from difflib import get_close_matches
from operator import itemgetter
from typing import Literal, NamedTuple

from zstate import se3
from zstate.buffer.clock_domain import ClockDomain
from zstate.buffer.edge_rules import by, loop_refusal
from zstate.buffer.tracks import JointTrack, PoseTrack, Track, coverage
from zstate.checks import name_problem
from zstate.errors import AmbiguousFrame, ClockMismatch, Disconnected, InsertRefused, UnknownFrame

EdgeKind = Literal["joint", "pose", "static"]

_SUGGESTIONS = 3


@dataclass(frozen=True, slots=True)
class Edge:
    """An edge of the tree: it places ``child`` on ``parent``.

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
    static_writer: str | None = None

    @property
    def names(self) -> tuple[str, str]:
        """(parent, child)."""
        return (self.parent, self.child)

    @property
    def writer(self) -> str | None:
        """The writer of this edge, if known."""
        if self.robot is not None:
            writer = self.robot.model_writer if self.track is None else self.track.writer
            return writer or f"the model of {self.robot.model.name!r}"
        return self.track.writer if self.track is not None else self.static_writer


@dataclass(frozen=True, slots=True)
class FrameInfo:
    """One frame and the edge that places it, as ``frames()`` lists them.

    ``kind`` is "joint" or "pose" for moving edges, "static", or "root" for a frame without a parent.
    ``oldest`` and ``newest`` [ns], ``rate_hz`` and ``count`` are of the samples kept. ``domain`` is the clock
    domain of the stamps: "system", the name of a simulated time, or None if that is not known. ``joint`` is
    the driven joint that moves the frame, of the edges of a model.
    """

    name: str
    parent: str | None
    kind: Literal["joint", "pose", "static", "root"]
    writer: str | None
    rate_hz: float | None
    oldest: int | None
    newest: int | None
    count: int
    domain: str | None = None
    joint: str | None = None

    def _repr_html_(self) -> str:
        from zstate._util.html import html_of_fields  # noqa: PLC0415 - for notebooks alone

        return html_of_fields(self)

    def newest_in(self, domain: str) -> int | None:
        """The newest stamp [ns] if it can be compared with a clock of ``domain``, else None."""
        return self.newest if self.domain in (None, domain) else None


class PathDependencies(NamedTuple):
    """The names and edges that a compiled path depends on. The path stays valid while they are unchanged.

    ``names`` are the names of the lookup, each with its frame, or None. ``edges`` are frames, each with the
    edge that places it, or None. Edges are compared as objects: a replacement is another object.
    ``domains`` are the clock domains of moving edges, one edge for each track.
    """

    names: tuple[tuple[str, str | None], ...] = ()
    edges: tuple[tuple[str, Edge | None], ...] = ()
    domains: tuple[tuple[Edge, str | None], ...] = ()


class TreePath(NamedTuple):
    """The edges from the common ancestor of two frames down to each, and what that depends on.

    ``domain`` is the clock domain of the moving edges; empty if none is known.
    """

    to_target: Sequence[Edge]
    to_source: Sequence[Edge]
    domain: str
    dependencies: PathDependencies


class TreeSnapshot(NamedTuple):
    """Every frame with the edge that places it, and every robot with its track, at one ``version``."""

    version: int
    edges: Mapping[str, Edge | None]
    robots: Mapping[str, JointTrack]


class FrameNameIndex:
    """The names of all frames in the order of their first mention; none is ever removed.

    A robot's frame, ``robot/link``, is also found by its bare name ``link`` while that is unique.
    """

    def __init__(self) -> None:
        self._all: list[str] = []
        self._by_bare: defaultdict[str, list[str]] = defaultdict(list)

    def __len__(self) -> int:
        return len(self._all)

    def add(self, name: str) -> None:
        """Add a new name."""
        self._all.append(name)
        bare = _bare(name)
        if bare:
            self._by_bare[bare].append(name)

    def truncate(self, count: int) -> list[str]:
        """Remove all but the first ``count`` names again; returns the removed ones."""
        added = self._all[count:]
        for name in reversed(added):
            bare = _bare(name)
            if bare:
                self._by_bare[bare].pop()
        del self._all[count:]
        return added

    def with_bare(self, name: str) -> tuple[str, ...]:
        """The frames that have the bare name ``name``."""
        return tuple(self._by_bare.get(name, ()))

    def near(self, name: str) -> Callable[[], list[str]]:
        """A function that finds the names similar to ``name``, best first, bare ones where those are similar.

        The search takes milliseconds among thousands of names, so it runs only when an error is read. It
        covers the names there are now, even if others are added in between.
        """
        count = len(self._all)

        def search() -> list[str]:
            known = self._all[:count]
            if "/" in name:
                return _similar(name, known)
            fulls: dict[str, list[str]] = {}
            for full in known:
                fulls.setdefault(_bare(full) or full, []).append(full)
            return [
                one
                for bare in _similar(name, fulls)
                for one in ((bare,) if len(fulls[bare]) == 1 else sorted(fulls[bare]))
            ][:_SUGGESTIONS]

        return search


def _similar(name: str, candidates: Collection[str]) -> list[str]:
    """The most similar of ``candidates``, best first, else those that begin with ``name``."""
    near = get_close_matches(name, candidates, n=_SUGGESTIONS, cutoff=0.7)
    return near or sorted(one for one in candidates if one.startswith(name))[:_SUGGESTIONS]


def _bare(name: str) -> str:
    """The name without its robot; empty if it has none, or if the rest is no frame name."""
    bare = name.partition("/")[2]
    return "" if bare.startswith("/") else bare


class FrameTree:
    """Frames by name, one parent each. Changes need the buffer's lock.

    ``version`` grows with every change of an edge, and of a robot's clock ``domain``; a cached path then
    has to check that its dependencies are still current.
    """

    def __init__(self, domain: ClockDomain | None = None) -> None:
        self.version = 0
        self.domain = domain or ClockDomain()
        self.frames: dict[str, Edge | None] = {}
        self.robots: dict[str, JointTrack | None] = {}
        self.hint: Callable[[int], str] | None = None
        """The end of errors about unknown frames as long as there is no frame."""
        self.names = FrameNameIndex()
        # By child: when its edge was removed, by a monotonic clock [s], the edge's names and its writer.
        self._removed: dict[str, tuple[float, tuple[str, str], str | None]] = {}
        # The edges of frames before a transaction changed them; None outside of one.
        self._before: dict[str, Edge | None] | None = None

    def add_frame(self, name: str) -> None:
        """Add ``name``; frames are never removed."""
        if name not in self.frames:
            self.frames[name] = None
            self.names.add(name)
            self.version += 1

    @contextmanager
    def transaction(self) -> Generator[None]:
        """Changes inside the context are undone if it raises."""
        count = len(self.names)
        before: dict[str, Edge | None] = {}
        self._before = before
        try:
            yield
        except Exception:
            self.frames.update(before)
            for name in self.names.truncate(count):
                del self.frames[name]
            self.version += 1
            raise
        finally:
            self._before = None

    def attach(self, edge: Edge) -> None:
        """Place a child, or replace the edge that places it. ``check_edge`` comes before."""
        self.add_frame(edge.parent)
        self.add_frame(edge.child)
        self._place(edge.child, edge)

    def detach(self, child: str) -> None:
        """Remove the edge that places ``child``; the frame stays."""
        edge = self.frames.get(child)
        if edge is not None:
            self._removed[child] = (time.monotonic(), edge.names, edge.writer)
        self._place(child, None)

    def invalidate(self, track: Track) -> None:
        """Make paths over a track's edges compile again, because the columns of its samples have changed."""
        edges = track.edges if isinstance(track, PoseTrack) else map(track.edge, track.forms)
        for _, child in edges:
            edge = self.frames.get(child)
            if edge is not None and edge.track is track:
                self._place(child, replace(edge))

    def _place(self, child: str, edge: Edge | None) -> None:
        if self._before is not None:
            self._before.setdefault(child, self.frames[child])
        self.frames[child] = edge
        self.version += 1

    def check_edge(self, parent: str, child: str, writer: str | None) -> None:
        """Raises InsertRefused for bad names, a self edge, a second parent and a loop."""
        self.check_names(parent, child)
        existing = self.frames.get(child)
        if parent == child or (existing is None and child in self.frames):  # no frame is below a new one
            refusal = loop_refusal(parent, child, writer, self.frames.get)
            if refusal is not None:
                raise refusal
        elif existing is not None and existing.parent != parent:
            text = (
                f"{child!r} has the parent {existing.parent!r}{by(existing.writer)} and cannot get a second "
                f"one, {parent!r}{by(writer)}; withdraw({child!r}) first if it really moved"
            )
            raise InsertRefused(text, reason="second parent", edge=(parent, child))

    @staticmethod
    def check_names(parent: str, child: str) -> None:
        """Raises InsertRefused if a name cannot be a frame name."""
        for name in (parent, child):
            if problem := name_problem(name):
                text = f"{parent!r} -> {child!r}: {problem}"
                raise InsertRefused(text, reason="frame name", edge=(parent, child))

    def edges_above(self, frame: str) -> Iterable[Edge]:
        """The edges from ``frame`` up to its root, nearest first."""
        edge = self.frames.get(frame)
        while edge is not None:
            yield edge
            edge = self.frames.get(edge.parent)

    def root(self, frame: str) -> str:
        """The ancestor of ``frame`` that has no parent."""
        for edge in self.edges_above(frame):
            frame = edge.parent
        return frame

    def moving(self) -> dict[Track, Edge]:
        """The tracks behind all moving edges, each with the last of its edges."""
        edges = list(self.frames.values())
        return {edge.track: edge for edge in edges if edge is not None and edge.track is not None}

    def robot_of(self, edge: Edge) -> str:
        """The robot whose writer places ``edge``."""
        return edge.robot.prefix if edge.robot is not None else self.domain.robot_placing(edge.child)

    def domain_of(self, edge: Edge) -> str | None:
        """The clock domain of the samples of a moving edge: that of the robot whose writer places it."""
        return self.domain.comparable(self.robot_of(edge))

    def frame_info(self, name: str) -> FrameInfo:
        """The facts about one frame that is in the tree."""
        edge = self.frames[name]
        if edge is None:
            return FrameInfo(name, None, "root", None, None, None, None, 0)
        if edge.track is None:
            return FrameInfo(name, edge.parent, "static", edge.writer, None, None, None, 0)
        oldest, newest, rate_hz, count = coverage(edge.track.history.view)
        facts = (edge.parent, edge.kind, edge.writer, rate_hz, oldest, newest, count)
        joint = None
        if isinstance(edge.track, JointTrack):
            model = edge.track.model
            joint = model.mimic_of(model.joints[edge.index]).joint
        return FrameInfo(name, *facts, self.domain_of(edge) or None, joint)

    def snapshot(self) -> TreeSnapshot:
        """A copy of all frames and robots."""
        robots = {name: track for name, track in self.robots.items() if track is not None}
        return TreeSnapshot(self.version, dict(self.frames), robots)

    def find_robot(self, name: str) -> JointTrack | None:
        """The robot with this prefix, else the one without a prefix whose model has this name."""
        track = self.robots.get(name)
        return track or next((one for one in self._unprefixed_robots() if one.name == name), None)

    def robot_names(self) -> list[str]:
        """The names of all robots with a model."""
        prefixed = [name for name, track in self.robots.items() if name and track is not None]
        return prefixed + [track.name for track in self._unprefixed_robots()]

    def _unprefixed_robots(self) -> list[JointTrack]:
        # ``robots`` has the last of them only, and a model of a single link has no edge.
        tracks = [self.robots.get(""), *(edge.robot for edge in self.frames.values() if edge is not None)]
        return list(dict.fromkeys(track for track in tracks if track is not None and not track.prefix))

    def resolve_for_insert(self, name: str) -> str:
        """The frame that a name of an insert means: the one of that name, or a robot's by its bare name."""
        if name in self.frames:
            return name
        candidates = [full for full in self.names.with_bare(name) if full.split("/", 1)[0] in self.robots]
        if len(candidates) > 1:
            text = f"the frame name {name!r} is not unique: {', '.join(candidates)}; name it in full"
            raise InsertRefused(text, reason="frame name", edge=(name, name))
        return candidates[0] if candidates else name

    def resolve(self, name: str, target: str, source: str) -> str:
        """The frame that a name of a lookup means. Raises UnknownFrame or AmbiguousFrame."""
        frame = self._find(name)
        if frame is not None:
            return frame
        if candidates := self.names.with_bare(name):
            raise AmbiguousFrame(target, source, name=name, candidates=candidates)
        near = self.names.near(name)
        count, hint = len(self.names), self.hint
        raise UnknownFrame(target, source, name=name, near_misses=near, frame_count=count, hint=hint)

    def path(self, target: str, source: str) -> TreePath:
        """The edges between both. Raises UnknownFrame, AmbiguousFrame, Disconnected or ClockMismatch."""
        target_frame = self.resolve(target, target, source)
        source_frame = self.resolve(source, target, source)
        parts = self._split_at_common_ancestor(target_frame, source_frame)
        if parts is None:
            roots = (self.root(target_frame), self.root(source_frame))
            failure = Disconnected(target, source, roots=roots)
            removed = [self._removed[root] for root in roots if root in self._removed]
            if removed:
                at_s, failure.edge, failure.writer = max(removed, key=itemgetter(0))
                failure.gone_s = time.monotonic() - at_s
            raise failure
        edges = [edge for part in parts for edge in part]
        dependencies = self._depend_on({target: target_frame, source: source_frame}, edges)
        return TreePath(*parts, self._common_domain(target, source, edges), dependencies)

    def _split_at_common_ancestor(
        self, target_frame: str, source_frame: str
    ) -> tuple[list[Edge], list[Edge]] | None:
        """The edges from the common ancestor down to each frame; None without one."""
        above_target = list(self.edges_above(target_frame))
        above_source = list(self.edges_above(source_frame))
        depth_by_frame = {target_frame: 0} | {edge.parent: n for n, edge in enumerate(above_target, 1)}
        for count, name in enumerate([source_frame, *(edge.parent for edge in above_source)]):
            if name in depth_by_frame:
                return above_target[: depth_by_frame[name]][::-1], above_source[:count][::-1]
        return None

    def _depend_on(
        self,
        frame_by_name: Mapping[str, str | None],
        edges: Iterable[Edge],
        roots: tuple[tuple[str, None], ...] = (),
    ) -> PathDependencies:
        placed = tuple((edge.child, edge) for edge in edges)
        moving = {edge.track: edge for edge in edges if edge.track is not None}
        domains = tuple((edge, self.domain_of(edge)) for edge in moving.values())
        return PathDependencies(tuple(frame_by_name.items()), placed + roots, domains)

    def _common_domain(self, target: str, source: str, edges: Sequence[Edge]) -> str:
        """The clock domain of all moving edges; empty if none is known. Raises ClockMismatch for two."""
        known = [(edge, name) for edge in edges if edge.track is not None and (name := self.domain_of(edge))]
        if not known:
            return ""
        first, common = known[0]
        for edge, domain in known:
            if domain != common:
                pair, domains = (first.names, edge.names), (common, domain)
                robots = (self.robot_of(first), self.robot_of(edge))
                raise ClockMismatch(target, source, edges=pair, robots=robots, domains=domains)
        return common

    def dependencies(self, target: str, source: str) -> PathDependencies:
        """The facts that decide the ``path`` between two frames, also if there is none."""
        frame_by_name = {name: self._find(name) for name in (target, source)}
        frames = [frame for frame in frame_by_name.values() if frame is not None]
        if len(frames) < len(frame_by_name):
            return PathDependencies(tuple((name, None) for name, found in frame_by_name.items() if not found))
        parts = self._split_at_common_ancestor(frames[0], frames[-1])
        if parts is not None:
            return self._depend_on(frame_by_name, [edge for part in parts for edge in part])
        edges = [edge for frame in frames for edge in self.edges_above(frame)]
        return self._depend_on(frame_by_name, edges, tuple((self.root(frame), None) for frame in frames))

    def is_current(self, dependencies: PathDependencies) -> bool:
        """Whether nothing of it has changed. May be called without the lock."""
        find, frames, domain_of = self._find, self.frames, self.domain_of
        return (
            all(find(name) == frame for name, frame in dependencies.names)
            and all(frames.get(frame) is edge for frame, edge in dependencies.edges)
            and all(domain_of(edge) == domain for edge, domain in dependencies.domains)
        )

    def _find(self, name: str) -> str | None:
        """The frame that a name of a lookup means; None for no frame, or more than one."""
        if name in self.frames:
            return name
        candidates = self.names.with_bare(name)
        return candidates[0] if len(candidates) == 1 else None
