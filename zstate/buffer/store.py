"""Store: everything that is written into a buffer, checked at the door."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from contextlib import suppress
from numbers import Real
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.domain import Domain
from zstate.buffer.edge import Edge
from zstate.buffer.feeds import EdgeNames, Feed, Feeds, TooOld, second_writer
from zstate.buffer.frames import FrameInfo, frame_info
from zstate.buffer.history import View, thin
from zstate.buffer.kernel import insert_together
from zstate.buffer.layout import Layout
from zstate.buffer.path import TrackUse
from zstate.buffer.tracks import ClockOffsets, Home, Interpolation, JointTrack, PoseTrack, Track
from zstate.buffer.tree import Tree
from zstate.buffer.waiting import WaitingRoom
from zstate.checks import check_names, name_problem, real_numbers
from zstate.clock import Clock, SystemClock, check_stamp
from zstate.errors import InsertRefused, InvalidInput
from zstate.locks import outlive_fork
from zstate.model.robot import RobotModel
from zstate.transform import QUATERNION_TOLERANCE, Transform

Poses = NDArray[np.float64]


class Store:
    """The half of ``TransformBuffer`` that takes data in. A refused call leaves no trace.

    Inserts may come from any thread; they take turns. Readers never wait for them.
    """

    def __init__(self, history_s: float = 10.0, clock: Clock | None = None) -> None:
        if not isinstance(history_s, Real) or not 0.0 < history_s < 1e9:
            raise InvalidInput(f"history_s is a positive number of seconds, not {history_s!r}")
        self.history_s = history_s
        self.clock: Clock = clock or SystemClock()
        self.domain = Domain(None if clock is None else clock.domain)
        """Which clock stamps the samples of each robot."""
        self.home = Home()
        """What its tracks know of it."""
        self.clock_offsets: ClockOffsets = self.home.clock_offsets
        """By writer: what tells how far its clock is ahead of this one. Filled by whoever measures that."""
        self.ignored = 0
        """How many samples were older than the history reaches."""
        self._span_ns = round(history_s * 1e9)
        self._lock = outlive_fork(threading.RLock())
        self._writes = 0
        self._tree = Tree(self.domain)
        self._room = WaitingRoom(self._tree)
        self._feeds = Feeds(self._tree, self._span_ns, self.home)

    def add_robot(
        self, model: RobotModel, prefix: str = "", *, interpolation: Interpolation = "linear"
    ) -> JointTrack:
        """Know all links of ``model``; its fixed joints answer at once. Returns the track to fill.

        With a ``prefix`` the links are called ``prefix/link``. ``interpolation="hermite"`` joins
        samples that have velocities by cubic curves. Raises InsertRefused when one of the links has a
        parent already, InvalidInput for a prefix that cannot begin a frame name.
        """
        prefix = _check_prefix(prefix)
        if interpolation not in get_args(Interpolation):
            raise InvalidInput(
                f"interpolation is one of {', '.join(get_args(Interpolation))}; got {interpolation!r}"
            )
        track = JointTrack(model, prefix, self._span_ns, interpolation)
        track.home = self.home
        with self._lock, self._tree.untouched_on_error():
            if prefix and self._tree.robots.get(prefix) is not None:
                raise InsertRefused(
                    f"there is a robot {prefix!r} in this buffer; remove_robot first",
                    reason="second writer",
                    edge=(prefix, model.root),
                )
            self._tree.add_frame(track.frame(model.root))
            for index in range(len(track.forms)):
                self._attach_joint(track, index)
            self._tree.robots[prefix] = track
        self._room.notify()
        return track

    def _attach_joint(self, track: JointTrack, index: int) -> None:
        form = track.forms[index]
        parent, child = track.edge(form)
        existing = self._tree.frames.get(child)
        if existing is not None and existing.parent == parent:
            raise second_writer(parent, child, existing, f"the model of {track.model.name!r}")
        self._tree.check_edge(parent, child, f"the model of {track.model.name!r}")
        if form.kind == "fixed":
            edge = Edge(parent, child, "static", pose=form.origin, robot=track)
        else:
            edge = Edge(parent, child, "joint", track=track, index=index, robot=track)
        self._tree.attach(edge)

    def remove_robot(self, track: JointTrack) -> None:
        """Take a robot's edges and history away. Its frames stay known, without a parent.

        Its track takes no more samples. Raises InsertRefused for a track that is not of this buffer.
        """
        with self._lock:
            self._check_ours(track)
            track.home = None
            for name, edge in list(self._tree.frames.items()):
                if edge is not None and edge.robot is track:
                    self._tree.detach(name)
            if self._tree.robots.get(track.prefix) is track:
                self._tree.robots[track.prefix] = None

    def name_robot(self, prefix: str) -> None:
        """Let frames called ``prefix/...`` answer to their bare names in inserts, as a robot's do."""
        with self._lock:
            self._tree.robots.setdefault(prefix, None)

    def add_frames(self, names: Iterable[str]) -> None:
        """Know frames by their full names, so that no robot's frame is meant by them."""
        with self._lock:
            for name in names:
                self._tree.add_frame(name)

    def edge_named(self, names: EdgeNames) -> EdgeNames:
        """The edge that an insert of these names means; one that is not unique stays as it is."""
        with self._lock, suppress(InsertRefused):
            return self._tree.named_for_insert(names[0]), self._tree.named_for_insert(names[1])
        return names

    def set_domain(self, robot: str, domain: str) -> bool:
        """Set the clock ``domain`` that stamps the samples of ``robot``. Returns whether that is a change."""
        with self._lock:
            changed = self.domain.set(robot, domain)
            if changed:
                self._tree.version += 1
        if changed:
            self._room.notify()
        return changed

    def insert_joints(
        self, track: JointTrack, stamp: int, positions: ArrayLike, velocities: ArrayLike | None = None
    ) -> bool:
        """One instant of a robot: positions (and velocities) in the order of its ``joint_names``.

        ``positions`` may also be a block: the same as float64, little-endian, in bytes.
        True, or False when it is older than the history reaches, which ``ignored`` counts. A second
        sample of one stamp replaces the first. Raises InvalidInput for wrong counts, NaN and infinity,
        and for a floating joint's quaternion that is not of length one; InsertRefused for the track of a
        robot that was removed, or of another buffer.
        """
        with self._lock:
            if track.home is not self.home:
                raise _not_ours(track)
            taken = track.take(stamp, positions, velocities)
        if taken:
            # The way of nearly every sample, without the call in between.
            self._room.notify(track)
            return True
        if taken is not None:
            return self._count(taken=False)
        stamp = check_stamp(stamp)
        numbers = track.check_positions(positions)
        rates = None if velocities is None else track.model.check_velocities(velocities)
        with self._lock:
            self._check_ours(track)  # again: it may have been removed meanwhile
            had_velocities = track.has_velocities
            taken = track.insert(stamp, numbers, rates)
            if track.has_velocities != had_velocities:
                self._tree.renew(track)
        return self._count(track, taken=taken)

    def _check_ours(self, track: Track) -> None:
        if track.home is not self.home:
            raise _not_ours(track)

    def restart(self, track: JointTrack | PoseTrack) -> None:
        """A new epoch: forget the samples of one track, because its writer or its clock began anew.

        Raises InsertRefused for a track that is not of this buffer.
        """
        with self._lock:
            self._check_ours(track)
            track.history.clear()
        self._room.begin_anew(track)

    def insert(self, transform: Transform, *, writer: str | None = None) -> bool:
        """One sample of a moving edge: ``transform.target`` is the parent, ``source`` the child.

        True, or False when it is older than the history reaches. Raises InsertRefused for a transform
        without a stamp, a self edge, a loop, a second parent, or an edge of a robot's model.
        """
        edge = (transform.target, transform.source)
        if transform.stamp is None:
            raise InsertRefused(
                f"{edge[0]!r} -> {edge[1]!r} has no stamp; use insert_static for what never moves",
                reason="no stamp",
                edge=edge,
            )
        return self._insert_poses((edge,), transform.stamp, transform.pose7[None], writer)

    def insert_many(
        self, edges: Sequence[EdgeNames], stamp: int, poses: ArrayLike, *, writer: str | None = None
    ) -> bool:
        """One instant of many moving edges, all or nothing: row i is ``parent_from_child`` of edges[i].

        ``poses`` is (N, 7), x y z [m], qx qy qz qw. Otherwise as ``insert``.
        """
        try:
            names = tuple((parent, child) for parent, child in edges)
        except (TypeError, ValueError):
            raise InvalidInput(f"edges are pairs (parent, child) of frame names; got {edges!r}") from None
        return self._insert_poses(names, check_stamp(stamp), _check_poses(names, poses), writer)

    def _insert_poses(
        self, names: tuple[EdgeNames, ...], stamp: int, poses: Poses, writer: str | None
    ) -> bool:
        with self._lock:
            try:
                feed = self._feeds.of(names, stamp, writer)
            except TooOld:
                return self._count(taken=False)
            if len(feed) == 1:
                track, rows = feed[0]
                track.history.insert(stamp, poses[rows].ravel())
            else:
                self._write_together(feed, stamp, poses)
        return self._count(*(track for track, _ in feed), taken=True)

    def _write_together(self, feed: Feed, stamp: int, poses: Poses) -> None:
        # Odd while tracks disagree: a reader that sees it asks again under the lock.
        self._writes += 1
        histories = tuple(track.history for track, _ in feed)
        insert_together(histories, stamp, tuple(poses[rows].ravel() for _, rows in feed))
        self._writes += 1

    def _count(self, *tracks: Track, taken: bool) -> bool:
        if taken:
            self._room.notify(*tracks)
        else:
            with self._lock:
                self.ignored += 1
        return taken

    def insert_static(self, transform: Transform, *, writer: str | None = None) -> None:
        """An edge that never moves, from now on and for every instant; a stamp is not looked at.

        Replaces what placed the child on that parent before. Raises InsertRefused as ``insert``.
        """
        with self._lock, self._tree.untouched_on_error():
            edge = self._feeds.admit(transform.target, transform.source, writer)
            self._feeds.separate(edge)
            pose = tuple(transform.pose7.tolist())
            self._tree.attach(Edge(*edge, "static", pose=pose, own_writer=writer))  # type: ignore[arg-type]
        self._room.notify()

    def withdraw(self, child: str) -> None:
        """Take away what places ``child``, with its history; the frame stays known.

        Raises InvalidInput for a frame nobody named, InsertRefused for a link of a robot's model.
        """
        check_names(child)
        with self._lock:
            name = self._tree.named_for_insert(child)
            if name not in self._tree.frames:
                near = self._tree.names.near(child)()
                hint = f"; did you mean {' or '.join(map(repr, near))}?" if near else ""
                raise InvalidInput(f"there is no frame {child!r} to withdraw{hint}")
            edge = self._tree.frames[name]
            if edge is not None and edge.robot is not None:
                raise InsertRefused(
                    f"{name!r} is placed by {edge.writer}; remove_robot takes the whole robot away",
                    reason="second writer",
                    edge=edge.names,
                )
            if edge is not None:
                self._feeds.separate(edge.names)
            self._tree.detach(name)

    def clear(self) -> None:
        """Forget every sample. Frames, static edges and robots stay."""
        with self._lock:
            tracks = [track for track in self._tree.tracks() if track.history.view.size]
            for track in tracks:
                track.history.clear()
        self._room.begin_anew(*tracks)

    def keep_around(self, stamps: NDArray[np.int64]) -> None:
        """Forget all samples but the first, the last, and those that answers at ``stamps`` [ns] are made of.

        Answers there stay the same, whatever else comes in meanwhile: so a history of any length fits
        into memory for whoever asks for few instants of it.
        """
        with self._lock:
            for track in self._tree.tracks():
                thin(track.history, stamps)

    def frames(self, among: Iterable[str] | None = None) -> tuple[FrameInfo, ...]:
        """Every frame ever named, in the order of their first mention; or those ``among`` full names."""
        with self._lock:
            known = self._tree.frames
            names = known if among is None else [name for name in among if name in known]
            return tuple(frame_info(name, known[name], self.domain) for name in names)

    @property
    def version(self) -> int:
        """Grows whenever a frame becomes known, or what places one changes."""
        return self._tree.version

    def layout(self) -> Layout:
        """What places every frame now, for those who read all of them at once."""
        with self._lock:
            robots = {name: track for name, track in self._tree.robots.items() if track is not None}
            return Layout(self._tree.version, dict(self._tree.frames), robots)

    def _take_views(self, uses: Sequence[TrackUse]) -> list[View]:
        """The views of several tracks at one moment between writes."""
        before = self._writes
        views = [use.track.history.view for use in uses]
        if len(uses) < 2 or (before == self._writes and not before & 1):
            return views
        with self._lock:
            return [use.track.history.view for use in uses]


def _check_prefix(prefix: object) -> str:
    if isinstance(prefix, str) and not prefix:
        return ""
    if problem := name_problem(prefix):
        raise InvalidInput(f"the prefix of a robot stands before its frames' names; {problem}")
    return str(prefix).removesuffix("/")


def _not_ours(track: Track) -> InsertRefused:
    if isinstance(track, JointTrack) and track.home is None:
        what = f"the robot {track.name!r} was removed from its buffer; add_robot gives a new track"
        reason = "removed robot"
    else:
        what = f"the track {track.name!r} belongs to another buffer; use the buffer that made it"
        reason = "another buffer"
    edge = (track.name, track.frame(track.model.root)) if isinstance(track, JointTrack) else track.edges[0]
    return InsertRefused(what, reason=reason, edge=edge)


def _check_poses(edges: Sequence[EdgeNames], poses: ArrayLike) -> Poses:
    array = real_numbers(poses, "poses")
    if not edges or array.shape != (len(edges), 7):
        raise InvalidInput(
            f"{len(edges)} edges take poses of shape ({len(edges)}, 7), at least one; got {array.shape}"
        )
    # einsum, as numpy warns of an overflow in a sum of squares, and the check below refuses that anyway
    norms: Poses = np.sqrt(np.einsum("ij,ij->i", array[:, 3:], array[:, 3:]))
    good = np.isfinite(array).all(axis=1) & (np.abs(norms - 1.0) <= QUATERNION_TOLERANCE)
    if not good.all():
        worst = int(good.argmin())
        parent, child = edges[worst]
        raise InsertRefused(
            f"{parent!r} -> {child!r}: a pose is seven finite numbers, the last four a quaternion x y z w of "
            f"length 1; got {array[worst].tolist()}",
            reason="not a pose",
            edge=(parent, child),
        )
    return np.hstack((array[:, :3], array[:, 3:] / norms[:, None]))
