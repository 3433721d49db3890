"""Ownership of frames: which writer places which frame, and which of two conflicting edges is accepted.

Frames ``robot/...`` are placed by the writers of that robot, i.e. those whose samples arrive on the robot's
keys, whatever name they announce. Other writers may place a robot's root, the frame that none of its own
writers places, in frames of theirs. A prefix that is no robot on the network, such as the ``fleet`` of
``fleet/map``, has no owner; every writer may place its frames.

If edges exclude each other (a second parent, a loop), the first by ``EdgePrecedence`` is accepted, in
whatever order they arrive (``zstate.ingest.precedence``).
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from typing import NamedTuple

import numpy as np

from zstate._util.bounded import BoundedDict
from zstate._util.fork_safe import fork_safe
from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.edge_rules import loop_refusal
from zstate.buffer.frame_tree import Edge
from zstate.buffer.tracks import JointTrack
from zstate.clock import Clock, MonotonicClock
from zstate.errors import InsertRefused
from zstate.ingest.counters import Counters
from zstate.ingest.precedence import EdgePrecedence, Rank
from zstate.model.robot import RobotModel
from zstate.streams import StreamName
from zstate.transform import Transform
from zstate.wire.keys import (
    FOREIGN_FRAME,
    EdgeNames,
    foreign_edge_problem,
    frame_owner,
    is_frame_of_another,
)

CONTESTED = ("second parent", "second writer", "loop")
"""The refusal reasons of edges that exclude each other."""

MAX_MOVING_FRAMES = 100_000
"""Limit of the frames that the writers of one robot move: a buffer removes no frame, and each takes 2 kB."""

# A static edge this close to the model's [m, or the sine of an angle] was computed from the same URDF.
_SAME_POSE = 1e-6


@dataclass(eq=False, slots=True)
class EdgeClaim:
    """An edge that one source publishes. ``pose`` is None for a moving one.

    ``is_placed`` means that this pose was the last to be inserted for the child. ``order`` numbers edges as
    they appear. It is 0 for an edge of the buffer that no source publishes: of a model, or of the buffer's
    user.
    """

    source: EdgeSource
    parent: str
    child: str
    order: int
    published: int = 0
    pose: Transform | None = None
    is_accepted: bool = False
    is_placed: bool = False
    refusal: InsertRefused | None = None

    @property
    def names(self) -> EdgeNames:
        """(parent, child)."""
        return self.parent, self.child

    @property
    def writer(self) -> str:
        """The printed name of the writer."""
        return self.source.name

    def is_as_good_as(self, other: EdgeClaim) -> bool:
        """Whether both fix the child at the same pose, as a ROS robot_state_publisher repeats the model."""
        if self.pose is None or other.pose is None:
            return False
        return np.allclose(self.pose.matrix, other.pose.matrix, rtol=0.0, atol=_SAME_POSE)


@dataclass(eq=False, slots=True)
class EdgeSource:
    """A writer of edges: the ``robot`` whose key they arrive on, and the ``session`` in its messages.

    ``name`` is only printed, no rule depends on it. ``is_model`` marks the edges of the robot's model.
    """

    robot: str
    name: str
    session: int = 0
    is_model: bool = False
    claims: dict[EdgeNames, EdgeClaim] = field(default_factory=dict[EdgeNames, EdgeClaim])

    def is_of_writer_of(self, other: EdgeSource) -> bool:
        """Whether both are edges of the same writer, for instance on two streams."""
        return (self.robot, self.session) == (other.robot, other.session)


class Admitted(NamedTuple):
    """The ``rows`` of a sample that are inserted, None for all, and the refusal of another row."""

    rows: tuple[int, ...] | None = None
    refusal: InsertRefused | None = None


@dataclass(slots=True)
class _Owner:
    """What is known of the owner of frames ``owner/...``: a robot, or a name that no robot has."""

    sources: dict[EdgeSource, None] = field(default_factory=dict["EdgeSource", None])
    """Its writers that have claims."""
    own: Counter[str] = field(default_factory=Counter[str])
    """Its frames in edges by which these writers place its frames."""
    outside: dict[EdgeClaim, None] = field(default_factory=dict["EdgeClaim", None])
    """The edges with one of its frames by which writers place frames that are not their own robot's."""
    links: frozenset[str] = frozenset()
    """The frames of its model in the buffer."""
    moved: set[str] = field(default_factory=set[str])
    """All frames that its writers have moved."""
    is_described: bool = False
    """Whether the edges of its model are published: the moving ones, and the fixed ones apart."""
    has_fixed_edges: bool = False
    """Whether the fixed ones, maybe none, are known."""

    def is_stray(self, frame: str) -> bool:
        """Whether the robot places frames, but neither this one nor any on this one.

        False until the fixed edges of a described model arrive: they may place others on the frame.
        """
        if frame in self.links or frame in self.own:
            return False
        return bool(self.links or self.own) and (self.has_fixed_edges or not self.is_described)


_UNKNOWN = _Owner()


class FrameOwnership:
    """Decides which published edges are inserted into ``buffer``. Any thread may call it.

    ``is_shared`` means that all writers share all frames, as in ROS: no frame belongs to a robot, and moving
    edges that a model in the buffer has too are left out, because the model computes them. ``placers`` are
    the robots whose writers may place other robots' roots, None: all. If an edge is refused because of
    another writer, ``on_conflict(stream, source, refusal)`` is called; not for moving edges in ROS. The
    ingests measure the silence of writers by ``clock``.
    """

    def __init__(
        self,
        buffer: TransformBuffer,
        counters: Counters,
        *,
        is_shared: bool = False,
        placers: Collection[str] | None = None,
        on_conflict: Callable[[StreamName, EdgeSource, InsertRefused], None] | None = None,
        clock: Clock | None = None,
    ) -> None:
        self.buffer = buffer
        self.feed = feed_of(buffer)
        self.counters = counters
        self.clock = MonotonicClock() if clock is None else clock
        self.version = 0
        """Increases when the set of accepted moving edges may have changed."""
        self.live: dict[tuple[str, int], str] = {}
        """Printed names of the announced writers, by robot and session."""
        self.model_edges: dict[str, frozenset[EdgeNames]] = {}
        """The edges of the models in the buffer, by robot, if all writers share all frames; else empty."""
        self._is_shared = is_shared
        self._placers = placers
        self._on_conflict = on_conflict
        self._robots: set[str] = set()
        self._owners: dict[str, _Owner] = {}
        self._departed: BoundedDict[tuple[str, int], None] = BoundedDict()
        self._claims: dict[str, list[EdgeClaim]] = {}
        # The frames of published edges of models.
        self._model_parents: Counter[str] = Counter()
        self._model_children: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        """How many edges are refused, by reason."""
        self._unresolved: set[str] = set()
        """Frames whose edges must be compared again."""
        self._counter = count(1)
        self._lock = fork_safe(threading.RLock())

    def add_robot(self, robot: str) -> None:
        """Add a robot on the network, which owns the frames ``robot/...``."""
        if robot in self._robots:
            return
        with self._lock:
            self._robots.add(robot)
            self._compare_outside(robot)
            self.resolve()

    def add_description(self, robot: str) -> None:
        """Add a robot whose model's edges are published: the moving ones, and the fixed ones apart."""
        with self._lock:
            self._owner(robot).is_described = True
            self._compare_outside(robot)
            self.resolve()

    def add_writer(self, robot: str, session: int) -> None:
        """Add an announced writer of edges."""
        with self._lock:
            self._departed.pop((robot, session), None)
            self._resolve_contested(robot, session)

    def remove_writer(self, robot: str, session: int) -> None:
        """Remove a writer that has left. Its edges stay until they conflict with an announced one's."""
        with self._lock:
            self._departed[robot, session] = None
            self._resolve_contested(robot, session)

    def _resolve_contested(self, robot: str, session: int) -> None:
        """Compare the edges of a writer that has joined or left with those that they conflict with."""
        owner = self._owners.get(robot)
        if owner is not None and self._refused.total():
            has_loops = self._refused["loop"] > 0
            for source in owner.sources:
                if source.session == session:
                    for claim in source.claims.values():
                        if claim.refusal or has_loops or len(self._claims[claim.child]) > 1:
                            self._unresolved.add(claim.child)
        self.resolve()

    def rename(self, source: EdgeSource, name: str) -> None:
        """Set the printed name of a source, if it is announced later than its edges."""
        with self._lock:
            ours = [claim for claim in source.claims.values() if self._is_in_buffer(claim)]
            source.name = name
            for claim in ours:
                self._insert(claim)

    def place_model(self, robot: str, model: RobotModel, before: JointTrack | None) -> JointTrack:
        """Replace the track ``before`` by a model; conflicting edges are withdrawn. Raises InsertRefused."""
        with self._lock:
            links = {f"{robot}/{link}" for link in model.links} | self._owner(robot).links
            if self._refused["loop"]:  # before the edges of an earlier model are gone
                self._unresolved.update(*map(self._ring, links))
            if before is not None:
                self.buffer.remove_robot(before)
            edges = frozenset((f"{robot}/{joint.parent}", f"{robot}/{joint.child}") for joint in model.joints)
            self.model_edges = {name: known for name, known in self.model_edges.items() if name != robot}
            if self._is_shared:
                self._drop_repeated(edges)
            self._withdraw_overlapping(robot, model)
            try:
                track = self.buffer.add_robot(model, robot)
                self._owner(robot).links = frozenset(f"{robot}/{link}" for link in model.links)
                if self._is_shared:
                    self.model_edges[robot] = edges
                return track
            finally:
                self.version += self._is_shared
                self._unresolved.update(link for link in links if link in self._claims)
                self._compare_outside(robot)
                self.resolve()

    def _drop_repeated(self, edges: frozenset[EdgeNames]) -> None:
        """Remove moving edges that a model has too: those that arrived before it."""
        for child in {child for _, child in edges}.intersection(self._claims):
            for claim in list(self._claims.get(child, ())):
                if claim.pose is None and claim.names in edges:
                    self._drop(claim)

    def _withdraw_overlapping(self, robot: str, model: RobotModel) -> None:
        """Withdraw the edges that conflict with a model."""
        for joint in model.joints:
            self._withdraw(robot, joint.child, "second writer", "a link of the model")
        root = top = f"{robot}/{model.root}"
        while (above := self.feed.edge_of(top)) is not None:
            top = above.parent
        if top != root and top in {f"{robot}/{link}" for link in model.links}:
            # The edges between are valid children of the model; the one that places its root closes the loop.
            self._withdraw(robot, model.root, "loop", "the root of the model, below the model")

    def _withdraw(self, robot: str, link: str, reason: str, what: str) -> None:
        """Withdraw an edge that conflicts with a model. Claims are reported when they are resolved."""
        frame = f"{robot}/{link}"
        edge = self.feed.edge_of(frame)
        if edge is not None:
            self.buffer.withdraw(frame)
            if frame not in self._claims:
                text = f"{edge.writer or 'hand'!r} placed {frame!r}, {what}"
                self.counters.for_robot(robot).count_refusal(reason, text)

    def set_statics(
        self, source: EdgeSource, edges: Mapping[EdgeNames, Transform], *, adds: bool = False
    ) -> None:
        """Replace the static edges of ``source``; with ``adds``, as in ROS, only of the same children."""
        with self._lock:
            if source.is_model and not self._owner(source.robot).has_fixed_edges:
                self._set_fixed_edges(source.robot, are_known=True)
            edges = {self._named(names): pose for names, pose in edges.items()}
            children = {child for _, child in edges}
            for names, claim in list(source.claims.items()):
                if names not in edges and (not adds or names[1] in children):
                    self._drop(claim)
            published: list[EdgeClaim] = []
            for names, pose in edges.items():
                claim = self._claim(source, names)
                claim.pose, claim.published = pose, next(self._counter)
                published.append(claim)
            contested = [claim for claim in published if not self._insert_uncontested(claim)]
            self._unresolved.update(claim.child for claim in contested)
            self.resolve(contested)

    def _insert_uncontested(self, claim: EdgeClaim) -> bool:
        """Insert a claim that conflicts with nothing; False if conflicts must be resolved first."""
        if self._is_uncontested(claim):
            with suppress(InsertRefused):  # the buffer has an edge that no source publishes
                self._insert(claim)
                return True
        return False

    def _is_uncontested(self, claim: EdgeClaim) -> bool:
        """Whether no rule and no other edge conflicts with it; those of the buffer's caller still may."""
        is_alone = claim.refusal is None and len(self._claims[claim.child]) == 1
        if not is_alone or claim.child in self._unresolved or self._rank(claim) == Rank.OTHERS:
            return False
        return not self._may_close_loop(claim)

    def _may_close_loop(self, claim: EdgeClaim) -> bool:
        """Whether published edges, refused ones included, lead from its parent up to its child."""
        frame, seen = claim.parent, set[str]()
        while frame != claim.child and frame not in seen:
            claims = self._claims.get(frame, ())
            if len(claims) > 1:
                return len(self._ring(claim.child)) > 1
            seen.add(frame)
            edge = claims[0] if claims else self.feed.edge_of(frame)
            if edge is None:
                return False
            frame = edge.parent
        return frame == claim.child

    def admit(self, source: EdgeSource, edges: Sequence[EdgeNames]) -> Admitted:
        """Decide which of these moving edges of ``source`` may be inserted.

        If all writers share all frames, edges of models are left out, and one refused edge refuses the whole
        sample. Raises InsertRefused if the robot's writers have moved 100,000 frames, for a sample with
        another one.
        """
        with self._lock:
            named = {row: self._named(names) for row, names in enumerate(edges)}
            if self._is_shared:
                named = {row: names for row, names in named.items() if not self._repeats_model(names)}
            self._count_frames(source.robot, named.values())
            fresh = [
                self._claim(source, names)
                for names in dict.fromkeys(named.values())
                if names not in source.claims
            ]
            claims = {row: source.claims[names] for row, names in named.items()}
            for claim in fresh:
                claim.is_accepted = self._is_uncontested(claim)
            self._unresolved.update(claim.child for claim in claims.values() if not claim.is_accepted)
            self.resolve()
            refusals = (claim.refusal for claim in claims.values() if claim.refusal is not None)
            refusal = next(refusals, None)
            if refusal is not None and self._is_shared:
                for claim in fresh:
                    self._drop(claim)
                return Admitted((), refusal)
            if refusal is not None and not source.is_model:
                self.report_conflict("transforms", source, refusal)
            for claim in fresh:
                if claim.is_accepted:
                    self._add_frames(claim)
            rows = tuple(row for row, claim in claims.items() if claim.is_accepted)
            return Admitted(None if len(rows) == len(edges) else rows, refusal)

    def repeats_models(self, edges: Sequence[EdgeNames]) -> bool:
        """Whether all ``edges`` are among ``model_edges``."""
        with self._lock:
            return all(self._repeats_model(self._named(names)) for names in edges)

    def _repeats_model(self, names: EdgeNames) -> bool:
        return any(names in edges for edges in self.model_edges.values())

    def _count_frames(self, robot: str, edges: Collection[EdgeNames]) -> None:
        moved = self._owner(robot).moved
        new = {child for _, child in edges}.difference(moved)
        if new and len(moved) + len(new) > MAX_MOVING_FRAMES:
            text = (
                f"{robot!r} moves {len(moved)} frames, and {len(new)} more would exceed the limit of "
                f"{MAX_MOVING_FRAMES}; give each frame the same name for as long as the robot runs"
            )
            raise InsertRefused(text, reason="too many frames", edge=next(iter(edges)))
        moved |= new

    def withdraw_statics(self, source: EdgeSource) -> None:
        """Remove the static edges of ``source``."""
        with self._lock:
            if source.is_model:
                self._set_fixed_edges(source.robot, are_known=False)
            self.release(source)

    def _set_fixed_edges(self, robot: str, *, are_known: bool) -> None:
        self._owner(robot).has_fixed_edges = are_known
        self._compare_outside(robot)

    def release(self, source: EdgeSource) -> None:
        """Remove all edges of ``source``."""
        with self._lock:
            for claim in list(source.claims.values()):
                self._drop(claim)
            self.resolve()

    def remove_child(self, child: str) -> None:
        """Remove all published edges of ``child``."""
        with self._lock:
            for claim in list(self._claims.get(child, ())):
                self._drop(claim)

    def replace_departed(self, source: EdgeSource, children: Collection[str]) -> None:
        """Remove the moving edges of ``children`` by writers of the same robot that have left."""
        with self._lock:
            for child in children:
                for claim in list(self._claims.get(child, ())):
                    other = claim.source
                    is_another = other is not source and other.robot == source.robot
                    if claim.pose is None and is_another and not self._is_live(other):
                        self._drop(claim)

    def others_move(self, source: EdgeSource) -> bool:
        """Whether another announced writer moves one of the same frames."""
        with self._lock:
            return any(
                other.pose is None and other.source.session != source.session and self._is_live(other.source)
                for _, child in source.claims
                for other in self._claims[child]
            )

    def _is_live(self, source: EdgeSource) -> bool:
        return (source.robot, source.session) in self.live

    def _named(self, names: EdgeNames) -> EdgeNames:
        # In ROS a slash in a name has no meaning, and the name may be that of a link of the robot.
        return self.feed.edge_named(names) if self._is_shared else names

    def _claim(self, source: EdgeSource, names: EdgeNames) -> EdgeClaim:
        claim = source.claims.get(names)
        if claim is None:
            claim = source.claims[names] = EdgeClaim(source, *names, next(self._counter))
            self._claims.setdefault(names[1], []).append(claim)
            self._owner(source.robot).sources[source] = None
            if frame_owner(names[1]) == source.robot:
                self._count_own(claim, 1)
            else:
                for robot in set(map(frame_owner, names)):
                    self._owner(robot).outside[claim] = None
        return claim

    def _owner(self, name: str) -> _Owner:
        owner = self._owners.get(name)
        if owner is None:
            owner = self._owners[name] = _Owner()
        return owner

    def _count_own(self, claim: EdgeClaim, number: int) -> None:
        """Count an edge of a robot's own for the rules that ask what the robot places."""
        robot = claim.source.robot
        own = self._owner(robot).own
        before = len(own)
        for frame in claim.names:
            if frame_owner(frame) == robot:
                own[frame] = own.get(frame, 0) + number
                if not own[frame]:
                    del own[frame]
        if len(own) != before:
            self._compare_outside(robot)
        if self._rank(claim) == Rank.MODEL:
            self._model_parents[claim.parent] += number
            self._model_children[claim.child] += number
            if self._refused.total():
                self._unresolved.update(frame for frame in claim.names if frame in self._claims)

    def _compare_outside(self, robot: str) -> None:
        """Compare the edges of other robots' writers that name a frame of ``robot``."""
        if owner := self._owners.get(robot):
            self._unresolved.update(claim.child for claim in owner.outside)

    def _is_root_of_model(self, frame: str) -> bool:
        is_published = self._model_parents[frame] > 0 and not self._model_children[frame]
        return is_published or self.feed.is_model_root(frame)

    def _drop(self, claim: EdgeClaim) -> None:
        source, child = claim.source, claim.child
        if self._refused["loop"] and claim.is_accepted:  # before the edge is gone
            self._unresolved |= self._ring(child)
        del source.claims[claim.names]
        if not source.claims:
            del self._owner(source.robot).sources[source]
        rest = self._claims[child]
        rest.remove(claim)
        if claim.is_accepted:
            self._unresolved.add(child)
        if not rest:
            del self._claims[child]
            self._unresolved.discard(child)
        if frame_owner(child) == source.robot:
            self._count_own(claim, -1)
        for robot in {source.robot, *map(frame_owner, claim.names)}:
            owner = self._owner(robot)
            owner.outside.pop(claim, None)
            if owner == _UNKNOWN:
                del self._owners[robot]
        self._set_refusal(claim, None)
        # If all writers share all frames, samples that are refused as a whole have no claims.
        self.version += self._is_shared or claim.pose is None
        if self._is_in_buffer(claim):
            self.buffer.withdraw(claim.child)

    def _is_in_buffer(self, claim: EdgeClaim) -> bool:
        """Whether it places its child there: the caller may have changed the buffer, too."""
        return claim.is_accepted and _is_edge_of(claim, self.feed.edge_of(claim.child))

    def _insert(self, claim: EdgeClaim) -> None:
        assert claim.pose is not None
        self._add_frames(claim)
        self.buffer.insert_static(claim.pose, writer=claim.source.name)
        for other in self._claims[claim.child]:
            other.is_placed = other is claim
        claim.is_accepted = True
        self._set_refusal(claim, None)

    def _add_frames(self, claim: EdgeClaim) -> None:
        # Not if these are bare names of a robot's frames.
        if self.feed.edge_named(claim.names) != claim.names:
            self.feed.add_frames(claim.names)

    def _rank(self, claim: EdgeClaim) -> Rank:
        robot, child = claim.source.robot, claim.child
        if not claim.order:
            return Rank.MODEL if claim.source.is_model else Rank.CALLER
        if not self._is_shared and is_frame_of_another(robot, child, self._robots, self._placers):
            return Rank.OTHERS
        return Rank.MODEL if claim.source.is_model else Rank.OWN

    def _precedence(self, claim: EdgeClaim) -> EdgePrecedence:
        is_departed = self._is_departed(claim)
        return EdgePrecedence(
            self._rank(claim),
            self._is_root_of_model(claim.child),
            is_departed,
            is_departed and not claim.is_accepted,
            claim.pose is not None,
            claim.order,
        )

    def resolve_edges(self, edges: Collection[EdgeNames]) -> None:
        """Compare these edges with those that the buffer holds, for instance of its caller."""
        with self._lock:
            self._unresolved.update(self._named(names)[1] for names in edges)
            self.resolve()

    def resolve(self, published: Collection[EdgeClaim] = ()) -> None:
        """Compare the edges that may conflict, and make the buffer hold the accepted ones.

        These are the edges of unresolved frames, and those that may form a loop with them: whether an edge is
        accepted depends on no others. Reports refused static edges that were ``published`` just now, or
        accepted before.
        """
        if not self._unresolved:
            return
        with self._lock:
            frames = self._compared_frames()
            accepted = {frame: edge for frame in frames if (edge := self._unclaimed_edge(frame)) is not None}
            claims = [claim for frame in frames for claim in self._claims.get(frame, ())]
            refusals: dict[EdgeClaim, InsertRefused] = {}
            for claim in sorted(claims, key=self._precedence):
                error = self._refusal(claim, accepted)
                if error is not None:
                    refusals[claim] = error
                elif self._prevails(claim, accepted.get(claim.child)):
                    accepted[claim.child] = claim
            before = [claim for claim in claims if claim.is_accepted]
            for claim in refusals:
                if self._is_in_buffer(claim):
                    self.buffer.withdraw(claim.child)
                claim.is_placed = False
            for claim in claims:
                self.version += claim.pose is None and claim.is_accepted == (claim in refusals)
                claim.is_accepted = claim not in refusals
                self._set_refusal(claim, refusals.get(claim))
            self._unresolved.clear()
            for claim in accepted.values():
                if claim.order and (claim in published or not self._is_in_buffer(claim)):
                    self._insert_accepted(claim)
            for claim in {*before, *published}.intersection(refusals):
                if claim.pose is not None:
                    self._report(claim.source, refusals[claim])

    def _set_refusal(self, claim: EdgeClaim, refusal: InsertRefused | None) -> None:
        if claim.refusal is not None:
            self._refused[claim.refusal.reason] -= 1
        if refusal is not None:
            self._refused[refusal.reason] += 1
        claim.refusal = refusal

    def _compared_frames(self) -> list[str]:
        """The unresolved frames, each with those that may form a loop with it."""
        frames: dict[str, None] = {}
        for frame in self._unresolved:
            if frame not in frames:
                frames.update(dict.fromkeys(self._ring(frame)))
        return list(frames)

    def _ring(self, frame: str) -> set[str]:
        """The frames on all loops through ``frame`` that edges would form, refused ones too; and itself."""
        below: dict[str, list[str]] = {}
        found, waiting = {frame}, [frame]
        while waiting:
            child = waiting.pop()
            for parent in self._candidate_parents(child):
                below.setdefault(parent, []).append(child)
                if parent not in found:
                    found.add(parent)
                    waiting.append(parent)
        ring, waiting = {frame}, [frame]
        while waiting:
            for child in below.get(waiting.pop(), ()):
                if child not in ring:
                    ring.add(child)
                    waiting.append(child)
        return ring

    def _candidate_parents(self, child: str) -> set[str]:
        parents = {claim.parent for claim in self._claims.get(child, ())}
        if edge := self.feed.edge_of(child):
            parents.add(edge.parent)
        return parents

    def _unclaimed_edge(self, child: str) -> EdgeClaim | None:
        """The edge in the buffer that places ``child``, unless a source publishes it."""
        edge = self.feed.edge_of(child)
        if edge is None:
            return None
        is_static, is_model = edge.kind == "static", edge.robot is not None
        if any(_is_edge_of(claim, edge) for claim in self._claims.get(child, ())):
            return None
        pose = Transform.from_pose7(edge.parent, child, edge.pose) if is_static else None
        source = EdgeSource("", edge.writer or "hand", is_model=is_model)
        return EdgeClaim(source, edge.parent, child, 0, pose=pose)

    def _is_departed(self, claim: EdgeClaim) -> bool:
        is_unannounced = not self._is_shared and claim.pose is None and not self._is_live(claim.source)
        return is_unannounced or (claim.source.robot, claim.source.session) in self._departed

    def _refusal(self, claim: EdgeClaim, accepted: Mapping[str, EdgeClaim]) -> InsertRefused | None:
        """The refusal of an edge that conflicts with the edges accepted before it."""
        parent, child = names = claim.names
        by, rank = claim.writer, self._rank(claim)
        if rank == Rank.OTHERS:
            rule = foreign_edge_problem(claim.source.robot, names, self._robots, self._placers)
            owner = frame_owner(child)
            if not rule and self._owner(owner).is_stray(child):
                rule = (
                    f"{child!r} is a frame of robot {owner!r}, but not its root, which is all that writers "
                    f"of robot {claim.source.robot!r} may place; publish it as robot {owner!r} "
                    f"(--robot {owner})"
                )
            if rule:
                return InsertRefused(rule, reason=FOREIGN_FRAME, edge=names)
        there = accepted.get(child)
        if there is None:
            return loop_refusal(parent, child, by, accepted.get)
        is_same_edge = there.parent == parent
        # The last value of static edges counts; samples of two writers would alternate. ROS allows that.
        both_move = there.order > 0 and there.pose is None and claim.pose is None
        is_own = there.source.is_of_writer_of(claim.source)
        there_rank = self._rank(there)
        may_share = is_own or (there_rank == rank and (self._is_shared or not both_move))
        if is_same_edge and (there.is_as_good_as(claim) or may_share):
            return None
        if rank == Rank.OTHERS and there_rank < Rank.OTHERS:
            text = (
                f"{child!r} is placed on {there.parent!r} by robot {frame_owner(child)!r} itself "
                f"({there.writer}), whose edge counts; that of robot {claim.source.robot!r}, on {parent!r}, "
                "does not"
            )
            return InsertRefused(text, reason=FOREIGN_FRAME, edge=names)
        if is_same_edge:
            text = f"{parent!r} -> {child!r} is written by {there.writer} already; refused: {by}"
            return InsertRefused(f"{text}; one edge has one writer", reason="second writer", edge=names)
        text = (
            f"{child!r} has the parent {there.parent!r} by {there.writer} and cannot get a second one, "
            f"{parent!r} by {by}; withdraw one of the two"
        )
        return InsertRefused(text, reason="second parent", edge=names)

    def _prevails(self, claim: EdgeClaim, there: EdgeClaim | None) -> bool:
        """Whether it is the claim that is inserted, of all claims of the same edge."""
        if there is None:
            return True
        if not there.order or there.pose is None or claim.pose is None:
            return False
        if self._rank(there) != self._rank(claim):
            return False
        if self._is_departed(claim) != self._is_departed(there):
            return self._is_departed(there)
        return claim.published > there.published

    def _insert_accepted(self, claim: EdgeClaim) -> None:
        if claim.pose is not None:
            try:
                self._insert(claim)
            except InsertRefused as error:  # the caller has changed the buffer since
                claim.is_accepted = False
                self._set_refusal(claim, error)
                self._report(claim.source, error)

    def _report(self, source: EdgeSource, error: InsertRefused) -> None:
        text = f"static edge of {source.name!r}: {error}"
        self.counters.for_robot(source.robot).count_refusal(error.reason, text)
        self.report_conflict("tf_static", source, error)

    def report_conflict(self, stream: StreamName, source: EdgeSource, error: InsertRefused) -> None:
        """Call ``on_conflict`` if ``error`` refuses an edge of ``source`` because of another writer."""
        if error.reason in (*CONTESTED, FOREIGN_FRAME) and self._on_conflict is not None:
            self._on_conflict(stream, source, error)


def _is_edge_of(claim: EdgeClaim, edge: Edge | None) -> bool:
    """Whether ``edge``, which places the child in the buffer, was inserted for ``claim``."""
    if edge is None or edge.parent != claim.parent:
        return False
    if claim.pose is None:
        return edge.kind == "pose"
    return claim.is_placed and edge.kind == "static" and edge.static_writer == claim.writer
