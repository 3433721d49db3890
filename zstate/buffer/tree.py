"""Which edge places which frame: names, parents, roots and paths. Times are not its business."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from dataclasses import replace
from typing import NamedTuple

from zstate.buffer.domain import Domain
from zstate.buffer.edge import Edge
from zstate.buffer.footing import Footing
from zstate.buffer.names import Names
from zstate.buffer.tracks import JointTrack, Track
from zstate.checks import name_problem
from zstate.errors import AmbiguousFrame, Disconnected, InsertRefused, UnknownFrame


class _Gone(NamedTuple):
    """An edge that was taken away, by whom it had been given, and when, by a monotonic clock [s]."""

    edge: tuple[str, str]
    writer: str | None
    at_s: float


class Tree:
    """Frames by name, one parent each. Whoever changes it holds the buffer's lock.

    ``version`` grows with every change of an edge, and of a robot's clock ``domain``: then what was made of
    the tree asks whether its footing ``holds``.
    """

    def __init__(self, domain: Domain | None = None) -> None:
        self.version = 0
        self.domain = domain or Domain()
        self.frames: dict[str, Edge | None] = {}
        self.robots: dict[str, JointTrack | None] = {}
        self.names = Names()
        self._gone: dict[str, _Gone] = {}
        # What placed each frame before the context of untouched_on_error changed that; None outside of it.
        self._before: dict[str, Edge | None] | None = None

    def add_frame(self, name: str) -> None:
        """Know ``name``, for ever."""
        if name not in self.frames:
            self.frames[name] = None
            self.names.add(name)
            self.version += 1

    @contextmanager
    def untouched_on_error(self) -> Generator[None]:
        """Changes inside the context are taken back when it raises."""
        count = len(self.names)
        before: dict[str, Edge | None] = {}
        self._before = before
        try:
            yield
        except Exception:
            self.frames.update(before)
            for name in self.names.cut(count):
                del self.frames[name]
            self.version += 1
            raise
        finally:
            self._before = None

    def attach(self, edge: Edge) -> None:
        """Place a child, or replace the edge that places it. Checked before by ``check_edge``."""
        self.add_frame(edge.parent)
        self.add_frame(edge.child)
        self._place(edge.child, edge)

    def detach(self, child: str) -> None:
        """Take away what places ``child``; the frame stays known."""
        edge = self.frames.get(child)
        if edge is not None:
            self._gone[child] = _Gone(edge.names, edge.writer, time.monotonic())
        self._place(child, None)

    def renew(self, track: JointTrack) -> None:
        """What was made of a robot's edges has to be made anew: samples have other columns now."""
        for _, child in map(track.edge, track.forms):
            edge = self.frames.get(child)
            if edge is not None and edge.track is track:
                self._place(child, replace(edge))

    def _place(self, child: str, edge: Edge | None) -> None:
        if self._before is not None:
            self._before.setdefault(child, self.frames[child])
        self.frames[child] = edge
        self.version += 1

    def check_edge(self, parent: str, child: str, writer: str | None) -> None:
        """InsertRefused when the edge cannot be: names, self edge, second parent, loop."""
        self.check_names(parent, child)
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

    @staticmethod
    def check_names(parent: str, child: str) -> None:
        """InsertRefused for an edge between what cannot be frame names."""
        for name in (parent, child):
            if problem := name_problem(name):
                raise InsertRefused(
                    f"{parent!r} -> {child!r}: {problem}", reason="frame name", edge=(parent, child)
                )

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

    def tracks(self) -> Iterable[Track]:
        """The tracks behind all moving edges, once each."""
        edges = [edge for edge in self.frames.values() if edge is not None]
        return dict.fromkeys(edge.track for edge in edges if edge.track is not None)

    def named_for_insert(self, name: str) -> str:
        """The frame an inserted edge means: the one of that name, or a robot's by its bare name."""
        if name in self.frames:
            return name
        candidates = [full for full in self.names.with_bare(name) if full.split("/", 1)[0] in self.robots]
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
        candidates = self.names.with_bare(name)
        if len(candidates) == 1:
            return candidates[0]
        if candidates:
            raise AmbiguousFrame(target, source, name=name, candidates=candidates)
        near = self.names.near(name)
        raise UnknownFrame(target, source, name=name, near_misses=near, frame_count=len(self.names))

    def path(self, target: str, source: str) -> tuple[list[Edge], list[Edge]]:
        """The edges down to the target and down to the source, from where their ways up meet.

        Raises UnknownFrame, AmbiguousFrame or Disconnected.
        """
        target_frame = self.resolve(target, target, source)
        source_frame = self.resolve(source, target, source)
        ways = self._ways(target_frame, source_frame)
        if ways is None:
            raise self._disconnected(target, source, (self.root(target_frame), self.root(source_frame)))
        return ways

    def _disconnected(self, target: str, source: str, roots: tuple[str, str]) -> Disconnected:
        failure = Disconnected(target, source, roots=roots)
        gone = [self._gone[root] for root in roots if root in self._gone]
        if gone:
            last = max(gone, key=lambda one: one.at_s)
            failure.edge, failure.writer = last.edge, last.writer
            failure.gone_s = time.monotonic() - last.at_s
        return failure

    def _ways(self, target_frame: str, source_frame: str) -> tuple[list[Edge], list[Edge]] | None:
        above_target = list(self.upwards(target_frame))
        above_source = list(self.upwards(source_frame))
        target_ends = {target_frame: 0} | {edge.parent: n for n, edge in enumerate(above_target, 1)}
        names = [source_frame, *(edge.parent for edge in above_source)]
        for count, name in enumerate(names):
            if name in target_ends:
                return above_target[: target_ends[name]][::-1], above_source[:count][::-1]
        return None

    def footing(self, target: str, source: str) -> Footing:
        """What decides the ``path`` between two frames, or the reason why there is none."""
        meanings = {name: self._meaning(name) for name in (target, source)}
        frames = [frame for frame in meanings.values() if frame is not None]
        if len(frames) < len(meanings):
            return Footing(tuple((name, frame) for name, frame in meanings.items() if frame is None))
        ways = self._ways(frames[0], frames[-1])
        if ways is not None:
            edges = [(edge.child, edge) for way in ways for edge in way]
        else:
            edges = [(edge.child, edge) for frame in frames for edge in self.upwards(frame)]
            edges += [(self.root(frame), None) for frame in frames]
        moving = {edge.track: edge for _, edge in edges if edge is not None and edge.track is not None}
        domains = tuple((edge, self.domain.of_edge(edge)) for edge in moving.values())
        return Footing(tuple(meanings.items()), tuple(edges), domains)

    def holds(self, footing: Footing) -> bool:
        """Whether the same would be found now. May be asked without the lock."""
        meaning, frames, domain_of = self._meaning, self.frames, self.domain.of_edge
        return (
            all(meaning(name) == frame for name, frame in footing.names)
            and all(frames.get(frame) is edge for frame, edge in footing.edges)
            and all(domain_of(edge) == domain for edge, domain in footing.domains)
        )

    def _meaning(self, name: str) -> str | None:
        """The frame that a question means; None where no frame, or more than one, is called so."""
        if name in self.frames:
            return name
        candidates = self.names.with_bare(name)
        return candidates[0] if len(candidates) == 1 else None


def _by(writer: str | None) -> str:
    return f" by {writer}" if writer else ""
