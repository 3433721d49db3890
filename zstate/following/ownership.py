"""FrameOwnership: which writer places which frame, and whose edge counts where edges contradict each other.

A robot's frames are called ``robot/...`` and are placed by the writers of that robot: those whose samples
come on the keys of that robot, whatever they call themselves. Others may place a robot's root, the frame
that none of its own writers places, in frames of theirs. A prefix that is no robot on the network, such as
the ``fleet`` of ``fleet/map``, belongs to nobody, and every writer may place its frames.

Of edges that exclude each other (a second parent, a loop) the first of this list counts, whichever came
first:

1. edges of a robot's own model,
2. edges that the robot's own writers publish, and those of frames that belong to no robot,
3. edges by which others place the robot's root.

Among equals an edge that places the root of a model gives way to one that does not, one whose writer is
gone to one whose writer is there, a static one to a moving one, and only then the later to the earlier.
What is refused is kept, and taken as soon as nothing contradicts it any more: the buffer depends on what is
published, not on the order in which it arrives.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from itertools import count
from typing import NamedTuple

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.frame_tree import Edge
from zstate.buffer.tracks import JointTrack
from zstate.errors import InsertRefused
from zstate.following.bounded import remember
from zstate.following.edge_claims import (
    CONTESTED,
    Admitted,
    EdgeClaim,
    EdgeSource,
    are_same,
)
from zstate.following.tally import Tally
from zstate.locks import outlive_fork
from zstate.model.robot import RobotModel
from zstate.transform import Transform
from zstate.wire.keys import FOREIGN, EdgeNames, foreign_objection, robot_in

_MODEL, _OWN, _OTHERS = range(3)


class _Standing(NamedTuple):
    """An edge that counts, while edges are weighed; ``claim`` is None if no source of ours publishes it."""

    parent: str
    writer: str
    claim: EdgeClaim | None
    pose: Transform | None
    is_model: bool = False

    def is_as_good_as(self, claim: EdgeClaim) -> bool:
        """Whether both fix the child at the same place: a ROS state publisher says what the model does."""
        return self.pose is not None and claim.pose is not None and are_same(self.pose, claim.pose)


class FrameOwnership:
    """Decides which published edges stand in ``buffer``. Any thread may call it.

    ``is_shared`` says that all writers share all frames, as in ROS: then no frame belongs to a robot.
    ``placers`` are the robots whose writers may place other robots' roots, None: all. When a static edge
    is refused, ``on_conflict(robot, writer, child, text)`` is called.
    """

    def __init__(
        self,
        buffer: TransformBuffer,
        tally: Tally,
        *,
        is_shared: bool = False,
        placers: Collection[str] | None = None,
        on_conflict: Callable[[str, str, str, str], None] | None = None,
    ) -> None:
        self.buffer = buffer
        self.tally = tally
        self.version = 0
        """Grows when other moving edges may count than before."""
        self.live: dict[tuple[str, int], str] = {}
        """The writers that are announced: their printed names by robot and session."""
        self._is_shared = is_shared
        self._placers = placers
        self._on_conflict = on_conflict
        self._robots: set[str] = set()
        self._departed: dict[tuple[str, int], None] = {}
        self._claims: dict[str, list[EdgeClaim]] = {}
        self._outside: dict[EdgeClaim, None] = {}
        self._refused: dict[EdgeClaim, None] = {}
        self._placed: dict[str, EdgeClaim] = {}
        self._is_settled = True
        self._counter = count(1)
        self._lock = outlive_fork(threading.RLock())

    def add_robot(self, robot: str) -> None:
        """``robot`` is on the network: frames ``robot/...`` are its own."""
        if robot in self._robots:
            return
        with self._lock:
            self._robots.add(robot)
            if any(robot in map(robot_in, claim.names) for claim in self._outside):
                self._settle()

    def add_writer(self, robot: str, session: int) -> None:
        """A writer of static edges is announced."""
        with self._lock:
            self._departed.pop((robot, session), None)

    def remove_writer(self, robot: str, session: int) -> None:
        """It is announced no more. Its edges stay, until they contradict those of a writer that is there."""
        with self._lock:
            remember(self._departed, (robot, session), None)
            if self._refused:
                self._settle()

    def rename(self, source: EdgeSource, name: str) -> None:
        """The printed name of a source, if that is learned later than its edges."""
        with self._lock:
            ours = [claim for claim in source.claims.values() if self._is_in_buffer(claim)]
            source.name = name
            for claim in ours:
                self._insert(claim)

    def place_model(self, robot: str, model: RobotModel, before: JointTrack | None) -> JointTrack:
        """Put a robot's model into the buffer, in the place of the one ``before``.

        Edges that exclude it are withdrawn, whoever published them. Raises InsertRefused.
        """
        with self._lock:
            if before is not None:
                self.buffer.remove_robot(before)
            made_room = self._make_room(robot, model)
            try:
                return self.buffer.add_robot(model, robot)
            finally:
                self.version += self._is_shared
                if made_room or before is not None or self._refused:
                    self._settle()

    def _make_room(self, robot: str, model: RobotModel) -> bool:
        """Whether edges had to be withdrawn for the model."""
        links = {f"{robot}/{link}" for link in model.links}
        joints = {f"{robot}/{joint.child}": joint for joint in model.joints}
        taken = [frame for frame in self.buffer.frames(joints) if frame.parent is not None]
        for frame in taken:
            self.buffer.withdraw(frame.name)
            if frame.name not in self._claims:  # which are reported when they are weighed
                text = f"{frame.writer or 'hand'!r} placed {frame.name!r}, a link of the model"
                self.tally.refuse("second writer", text)
        root = f"{robot}/{model.root}"
        top = self._top(root)
        if top in links and top != root:
            # The edges between hang below the model rightly; that which places its root closes the loop.
            (frame,) = self.buffer.frames((root,))
            self.buffer.withdraw(root)
            if root not in self._claims:
                text = f"{frame.writer or 'hand'!r} placed {root!r}, the root of the model, below the model"
                self.tally.refuse("loop", text)
            return True
        return bool(taken)

    def _top(self, frame: str) -> str:
        """The frame above ``frame`` that has no parent."""
        known = self.buffer.frames((frame,))
        while known and known[0].parent is not None:
            frame = known[0].parent
            known = self.buffer.frames((frame,))
        return frame

    def set_statics(
        self, source: EdgeSource, edges: Mapping[EdgeNames, Transform], *, adds: bool = False
    ) -> None:
        """The static edges that ``source`` publishes now; those that it published before end.

        With ``adds`` they stay, as in ROS, but for those of the same children.
        """
        with self._lock:
            edges = {self._named(names): pose for names, pose in edges.items()}
            children = {child for _, child in edges}
            for names, claim in list(source.claims.items()):
                if names not in edges and (not adds or names[1] in children):
                    self._drop(claim)
            published: list[EdgeClaim] = []
            for names, pose in edges.items():
                if names[0] == names[1]:
                    text = f"{names[0]!r} -> {names[1]!r}: a frame cannot be placed on itself"
                    self._report(source, InsertRefused(text, reason="self edge", edge=names))
                    continue
                claim = self._claim(source, names)
                claim.pose, claim.published = pose, next(self._counter)
                published.append(claim)
            alone = [self._insert_alone(claim) for claim in published]
            if self._refused or not self._is_settled or not all(alone):
                self._settle(published)

    def _insert_alone(self, claim: EdgeClaim) -> bool:
        """Whether it went into the buffer without anything to be weighed against it."""
        if self._refused or not self._is_free(claim):
            return False
        try:
            self._insert(claim)
        except InsertRefused as error:
            if error.reason in CONTESTED:
                return False
            self._drop(claim)
            self._report(claim.source, error)
        return True

    def _is_free(self, claim: EdgeClaim) -> bool:
        """Whether no rule and no other source stands against it; the buffer still may."""
        return self._is_settled and len(self._claims[claim.child]) == 1 and self._rank(claim) != _OTHERS

    def admit(self, source: EdgeSource, edges: Sequence[EdgeNames]) -> Admitted:
        """Which of these moving edges of ``source`` may be inserted, and why another one may not.

        Where all writers share all frames, none of a sample counts of which one is refused; else
        the others do.
        """
        with self._lock:
            named = [self._named(names) for names in edges]
            fresh = [
                self._claim(source, names) for names in dict.fromkeys(named) if names not in source.claims
            ]
            if self._refused or not all(self._is_free(claim) for claim in fresh):
                self._settle()
            else:
                for claim in fresh:
                    claim.is_accepted = True
            claims = [source.claims[names] for names in named]
            refusal = next((claim.refusal for claim in claims if claim.refusal is not None), None)
            if refusal is not None and self._is_shared:
                for claim in fresh:
                    self._drop(claim)
                return Admitted((), refusal)
            for claim in fresh:
                if claim.is_accepted:
                    self._add_frames(claim)
            rows = [row for row, claim in enumerate(claims) if claim.is_accepted]
            return Admitted(None if refusal is None else tuple(rows), refusal)

    def weigh(self) -> None:
        """The buffer refused an edge that was admitted: weigh all edges against what stands there."""
        with self._lock:
            self._settle()

    def release(self, source: EdgeSource) -> None:
        """``source`` publishes none of its edges any more; what they said is forgotten."""
        with self._lock:
            for claim in list(source.claims.values()):
                self._drop(claim)
            if self._refused or not self._is_settled:
                self._settle()

    def forget(self, child: str) -> None:
        """Nothing that was published of ``child`` counts any more."""
        with self._lock:
            for claim in list(self._claims.get(child, ())):
                self._drop(claim)

    def take_over(self, source: EdgeSource, children: Collection[str]) -> None:
        """``source`` begins to move ``children``: the samples of writers of its robot that are gone end."""
        with self._lock:
            for child in children:
                for claim in list(self._claims.get(child, ())):
                    other = claim.source
                    is_another = other is not source and other.robot == source.robot
                    if claim.pose is None and is_another and not self._is_live(other):
                        self._drop(claim)

    def others_move(self, source: EdgeSource) -> bool:
        """Whether another writer that is there moves one of the same frames."""
        with self._lock:
            return any(
                other.pose is None and other.source.session != source.session and self._is_live(other.source)
                for _, child in source.claims
                for other in self._claims[child]
            )

    def _is_live(self, source: EdgeSource) -> bool:
        return (source.robot, source.session) in self.live

    def _named(self, names: EdgeNames) -> EdgeNames:
        # In ROS a slash in a name is just that, and a link of the robot may be meant.
        return self.buffer.edge_named(names) if self._is_shared else names

    def _claim(self, source: EdgeSource, names: EdgeNames) -> EdgeClaim:
        claim = source.claims.get(names)
        if claim is None:
            claim = source.claims[names] = EdgeClaim(source, *names, next(self._counter))
            self._claims.setdefault(names[1], []).append(claim)
            if robot_in(names[1]) != source.robot:
                self._outside[claim] = None
        return claim

    def _drop(self, claim: EdgeClaim) -> None:
        del claim.source.claims[claim.names]
        rest = self._claims[claim.child]
        rest.remove(claim)
        if not rest:
            del self._claims[claim.child]
        self._outside.pop(claim, None)
        self._refused.pop(claim, None)
        self.version += self._is_shared  # samples that are refused as a whole have no claims to be weighed
        if self._is_in_buffer(claim):
            self.buffer.withdraw(claim.child)
            self._is_settled &= not rest
        if self._placed.get(claim.child) is claim:
            del self._placed[claim.child]

    def _is_in_buffer(self, claim: EdgeClaim) -> bool:
        """Whether it places its child there: others may have changed the buffer, too."""
        if claim.pose is not None and self._placed.get(claim.child) is not claim:
            return False
        if not claim.is_accepted:
            return False
        kind = "pose" if claim.pose is None else "static"
        for frame in self.buffer.frames((claim.child,)):
            is_ours = claim.pose is None or frame.writer == claim.source.name
            return (frame.parent, frame.kind) == (claim.parent, kind) and is_ours
        return False

    def _insert(self, claim: EdgeClaim) -> None:
        assert claim.pose is not None
        self._add_frames(claim)
        self.buffer.insert_static(claim.pose, writer=claim.source.name)
        self._placed[claim.child] = claim
        claim.is_accepted, claim.refusal = True, None

    def _add_frames(self, claim: EdgeClaim) -> None:
        # Not the frames of a robot whose bare names these are.
        if self.buffer.edge_named(claim.names) != claim.names:
            self.buffer.add_frames(claim.names)

    def _rank(self, claim: EdgeClaim) -> int:
        robot, owner = claim.source.robot, robot_in(claim.child)
        if self._is_shared or owner == robot:
            return _MODEL if claim.source.is_model else _OWN
        return _OTHERS if owner in self._robots else _OWN

    def _rank_of(self, there: _Standing) -> int:
        """That of the model for a model's edge; what is there by hand is nobody's."""
        if there.claim is None:
            return _MODEL if there.is_model else _OTHERS + 1
        return self._rank(there.claim)

    def _settle(self, published: Collection[EdgeClaim] = ()) -> None:
        """Weigh all edges anew, and make the buffer hold those that count.

        Of the refused static ones those are reported that were ``published`` just now, or counted before.
        """
        standing, roots = self._standing()
        claims = [claim for claims in self._claims.values() for claim in claims]
        claims.sort(key=lambda claim: self._precedence(claim, roots))
        refusals: dict[EdgeClaim, InsertRefused] = {}
        for claim in claims:
            error = self._objection(claim, standing)
            if error is not None:
                refusals[claim] = error
            elif self._prevails(claim, standing.get(claim.child)):
                standing[claim.child] = _Standing(claim.parent, claim.source.name, claim, claim.pose)
        before = [claim for claim in claims if claim.is_accepted]
        self._take_out(refusals)
        for claim in claims:
            self.version += claim.pose is None and claim.is_accepted == (claim in refusals)
            claim.is_accepted, claim.refusal = claim not in refusals, refusals.get(claim)
        self._refused, self._is_settled = dict.fromkeys(refusals), True
        self._put_in(standing.values(), published)
        for claim in {*before, *published}.intersection(refusals):
            if claim.pose is not None:
                self._report(claim.source, refusals[claim])

    def _standing(self) -> tuple[dict[str, _Standing], set[str]]:
        """What places frames in the buffer and is no claim of ours, by child; and the roots of models."""
        layout = self.buffer.tree_snapshot()
        standing: dict[str, _Standing] = {}
        for child, edge in layout.edges.items():
            if edge is not None and (edge.robot is not None or not self._is_claimed(edge)):
                pose = None
                if edge.kind == "static":
                    pose = Transform.from_pose7(edge.parent, edge.child, edge.pose)
                by = edge.writer or "hand"
                standing[child] = _Standing(edge.parent, by, None, pose, edge.robot is not None)
        roots = {track.frame(track.model.root) for track in layout.robots.values()}
        ours = [claim for claims in self._claims.values() for claim in claims if self._rank(claim) == _MODEL]
        roots |= {claim.parent for claim in ours} - {claim.child for claim in ours}
        return standing, roots

    def _is_claimed(self, edge: Edge) -> bool:
        placed = self._placed.get(edge.child)
        if edge.kind == "static":
            return (
                placed is not None
                and placed.parent == edge.parent
                and edge.static_writer == placed.source.name
            )
        claims = self._claims.get(edge.child, ())
        return any(claim.pose is None and claim.parent == edge.parent for claim in claims)

    def _precedence(self, claim: EdgeClaim, roots: Collection[str]) -> tuple[int, bool, bool, bool, int]:
        """Smaller for what counts more."""
        rank, is_root = self._rank(claim), claim.child in roots
        return rank, is_root, self._is_departed(claim), claim.pose is not None, claim.order

    def _is_departed(self, claim: EdgeClaim) -> bool:
        return (claim.source.robot, claim.source.session) in self._departed

    def _objection(self, claim: EdgeClaim, standing: Mapping[str, _Standing]) -> InsertRefused | None:
        """Why an edge cannot stand beside those that count more."""
        parent, child = names = claim.names
        by, rank = claim.source.name, self._rank(claim)
        if rank == _OTHERS:
            rule = foreign_objection(claim.source.robot, names, self._robots, self._placers)
            if rule:
                return InsertRefused(rule, reason=FOREIGN, edge=names)
        there = standing.get(child)
        if there is None:
            return _loop(names, by, standing)
        is_same_edge = there.parent == parent
        if is_same_edge and (there.is_as_good_as(claim) or self._rank_of(there) == rank):
            return None
        if rank == _OTHERS and self._rank_of(there) < _OTHERS:
            text = (
                f"{child!r} is placed on {there.parent!r} by robot {robot_in(child)!r} itself "
                f"({there.writer}), whose edge counts; that of robot {claim.source.robot!r}, on {parent!r}, "
                "does not"
            )
            return InsertRefused(text, reason=FOREIGN, edge=names)
        if is_same_edge:
            text = f"{parent!r} -> {child!r} is written by {there.writer} already; refused: {by}"
            return InsertRefused(f"{text}; one edge has one writer", reason="second writer", edge=names)
        text = (
            f"{child!r} has the parent {there.parent!r} by {there.writer} and cannot get a second one, "
            f"{parent!r} by {by}; withdraw one of the two"
        )
        return InsertRefused(text, reason="second parent", edge=names)

    def _prevails(self, claim: EdgeClaim, there: _Standing | None) -> bool:
        """Whether it is what places its child, of all that publish the same edge."""
        if there is None:
            return True
        if there.claim is None or there.pose is None or claim.pose is None:
            return False
        if self._rank(there.claim) != self._rank(claim):
            return False
        if self._is_departed(claim) != self._is_departed(there.claim):
            return self._is_departed(there.claim)
        return claim.published > there.claim.published

    def _take_out(self, refused: Collection[EdgeClaim]) -> None:
        for claim in refused:
            if self._is_in_buffer(claim):
                self.buffer.withdraw(claim.child)
            if self._placed.get(claim.child) is claim:
                del self._placed[claim.child]

    def _put_in(self, standing: Iterable[_Standing], published: Collection[EdgeClaim]) -> None:
        for one in standing:
            claim = one.claim
            if claim is None or claim.pose is None:
                continue
            if claim in published or not self._is_in_buffer(claim):
                try:
                    self._insert(claim)
                except InsertRefused as error:  # somebody changed the buffer by hand meanwhile
                    claim.is_accepted, claim.refusal = False, error
                    self._refused[claim] = None
                    self._report(claim.source, error)

    def _report(self, source: EdgeSource, error: InsertRefused) -> None:
        self.tally.refuse(error.reason, f"static edge of {source.name!r}: {error}")
        if error.reason in (*CONTESTED, FOREIGN) and self._on_conflict is not None:
            self._on_conflict(source.robot, source.name, error.edge[1], str(error))


def _loop(names: EdgeNames, by: str, standing: Mapping[str, _Standing]) -> InsertRefused | None:
    """The refusal of an edge that would close a loop."""
    parent, child = names
    ring = [parent]
    while ring[-1] != child:
        above = standing.get(ring[-1])
        if above is None:
            return None
        ring.append(above.parent)
    way = " -> ".join(map(repr, reversed(ring)))
    writer = standing[ring[-2]].writer if len(ring) > 1 else by
    text = (
        f"{parent!r} -> {child!r} by {by} would close the loop {way} -> {child!r}; "
        f"{child!r} -> {ring[-2] if len(ring) > 1 else child!r} is written by {writer}"
    )
    return InsertRefused(text, reason="loop", edge=names)
