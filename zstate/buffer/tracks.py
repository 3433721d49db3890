"""Tracks: the histories of one publisher, with one stamp column for all of its joints or poses."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zstate.buffer.history import History
from zstate.buffer.history_view import HistoryView
from zstate.clock import ClockOffset
from zstate.errors import InsertRefused
from zstate.model.joint_forms import JointTransform
from zstate.model.joint_transforms import shared_transforms
from zstate.model.kinematics import Kinematics
from zstate.model.robot import RobotModel
from zstate.transform import COVARIANCE_NUMBERS

ClockOffsets: TypeAlias = dict[str, Callable[[], ClockOffset | None]]


class TimeSpan(NamedTuple):
    """From the oldest stamp [ns] that is known to the newest."""

    oldest: int
    newest: int


@dataclass(eq=False, slots=True)
class TrackOwner:
    """Facts about a buffer that its tracks and their errors need."""

    clock_offsets: ClockOffsets = field(default_factory=dict[str, Callable[[], ClockOffset | None]])
    """By writer: how far its clock is ahead of the clock of this host."""
    is_recording: bool = False
    """Whether the samples come from a file: no sample is added later."""

    def check(self, track: Track) -> None:
        """Raises InsertRefused for a track that is not of this buffer."""
        if track.owner is self:
            return
        if isinstance(track, JointTrack) and track.owner is None:
            text = f"the robot {track.name!r} was removed from its buffer; add_robot gives a new track"
            reason = "removed robot"
        else:
            text = f"the track {track.name!r} belongs to another buffer; use the buffer that made it"
            reason = "another buffer"
        edge = (
            (track.name, track.frame(track.model.root)) if isinstance(track, JointTrack) else track.edges[0]
        )
        raise InsertRefused(text, reason=reason, edge=edge)


class _Samples:
    """The ``history`` of a track."""

    history: History

    @property
    def newest(self) -> int | None:
        """The stamp of the newest sample [ns]; None without any."""
        return self.history.newest

    @property
    def rate_hz(self) -> float | None:
        """The mean rate of the samples kept [Hz]; None with fewer than two."""
        return coverage(self.history.view).rate_hz

    def widen(self, columns: int) -> None:
        """Add columns to the rows, NaN in the samples so far: in another history, which takes its place."""
        self.history.close()
        old = self.history.view
        wider = History(self.history.width + columns, self.history.span_ns)
        wider.replace(
            old.kept_stamps(), np.pad(old.kept_rows(), ((0, 0), (0, columns)), constant_values=np.nan)
        )
        self.history = wider


class JointTrack(_Samples):
    """The joint positions of one robot, and its velocities from the first sample that has them.

    A row is the positions in the order of ``model.joint_names``, then the velocities; velocities
    that were not published are NaN. ``prefix`` precedes the names of all links. ``writer`` publishes the
    positions and ``model_writer`` the model, where they are known. ``owner`` is the buffer; None once the
    robot was removed from it.

    If a driver publishes only some of the joints, these have a track of their own, whose ``model`` is that
    part of the robot's (``RobotModel.part``): ``parts`` of the robot's own track has them by joint.
    """

    def __init__(self, model: RobotModel, prefix: str, span_ns: int) -> None:
        self.model = model
        self.prefix = prefix
        self._table = shared_transforms(model)
        self.forms = self._table.forms
        self.writer: str | None = None
        self.model_writer: str | None = None
        self.owner: TrackOwner | None = None
        self.parts: Mapping[str, JointTrack] = {}
        self.history = History(model.position_count, span_ns)
        self.position_count = model.position_count
        self.has_plain_joints = not self._table.has_floats
        """Whether there are no floating joints, whose quaternions have to be checked and normalised."""

    def __repr__(self) -> str:
        return f"<track of {self.name!r}, {self.history.view.size} samples>"

    @property
    def name(self) -> str:
        """The robot."""
        return self.prefix or self.model.name

    @property
    def has_velocities(self) -> bool:
        """Whether rows have columns for velocities."""
        return self.history.width > self.model.position_count

    @cached_property
    def kinematics(self) -> Kinematics:
        """The forward kinematics of all links at once."""
        return Kinematics(self.model)

    def is_continuous(self, index: int) -> bool:
        """Whether the joint of an edge is continuous: any number of turns, encoders that wrap."""
        return self.model.mimic_of(self.model.joints[index]).joint in self._continuous

    @cached_property
    def _continuous(self) -> frozenset[str]:
        return frozenset(joint.name for joint in self.model.driven_joints if joint.type == "continuous")

    def frame(self, link: str) -> str:
        """The name of a link's frame in the buffer."""
        return f"{self.prefix}/{link}" if self.prefix else link

    def edge(self, form: JointTransform) -> tuple[str, str]:
        """(parent, child) of one of ``forms``, as named in the buffer."""
        return (self.frame(form.parent), self.frame(form.child))

    def check_positions(self, positions: ArrayLike) -> NDArray[np.float64]:
        """As ``RobotModel.check_positions``, also of bytes; normalises floating joints' quaternions."""
        if isinstance(positions, bytes) and len(positions) % 8 == 0:
            positions = np.frombuffer(positions, "<f8")
        return self._table.normalised(self.model.check_positions(positions))

    def insert(
        self, stamp: int, positions: NDArray[np.float64], velocities: NDArray[np.float64] | None
    ) -> bool:
        """Insert one instant; False if it is older than the history reaches."""
        if velocities is not None and not self.has_velocities:
            self.widen(self.model.velocity_count)
        return self.history.insert(stamp, self.row(positions, velocities))

    def row(
        self, positions: NDArray[np.float64], velocities: NDArray[np.float64] | None
    ) -> NDArray[np.float64]:
        """A row of the history; ``velocities`` only if it has columns for them."""
        if not self.has_velocities:
            return positions
        if velocities is None:
            velocities = np.full(self.model.velocity_count, np.nan)
        return np.concatenate((positions, velocities))


class PoseTrack(_Samples):
    """Poses of one or several moving edges that one publisher always sends together.

    Columns 7 i to 7 i + 7 of a row are ``parent_from_child`` of ``edges[i]``. From the first sample with
    covariances on, 21 columns for each edge follow all poses, NaN where the covariance is not known.
    """

    def __init__(self, edges: tuple[tuple[str, str], ...], span_ns: int, writer: str | None) -> None:
        self.edges = edges
        self.writer = writer
        self.owner: TrackOwner | None = None
        self.history = History(7 * len(edges), span_ns)

    def __repr__(self) -> str:
        return f"<track of {len(self.edges)} edges, {self.history.view.size} samples>"

    @property
    def name(self) -> str:
        """Its edges, the first of them by name."""
        first, more = " -> ".join(self.edges[0]), len(self.edges) - 1
        return f"{first} and {more} more" if more else first

    @property
    def has_covariances(self) -> bool:
        """Whether rows have columns for covariances."""
        return self.history.width > 7 * len(self.edges)

    def poses(self, row: NDArray[np.float64]) -> NDArray[np.float64]:
        """The poses of a row of the history, without the covariances: (N, 7)."""
        return row[: 7 * len(self.edges)].reshape(-1, 7)

    def covariance_columns(self, index: int) -> slice:
        """The columns of the covariance of ``edges[index]``."""
        first = 7 * len(self.edges) + COVARIANCE_NUMBERS * index
        return slice(first, first + COVARIANCE_NUMBERS)

    def row(self, poses: NDArray[np.float64], covariances: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """A row of the history: ``poses`` (N, 7), and ``covariances`` (N, 21) if they are known."""
        if covariances is not None and not self.has_covariances:
            self.widen(COVARIANCE_NUMBERS * len(self.edges))
        if not self.has_covariances:
            return poses.ravel()
        if covariances is None:
            covariances = np.full((len(self.edges), COVARIANCE_NUMBERS), np.nan)
        return np.concatenate((poses.ravel(), covariances.ravel()))

    def split(self) -> list[PoseTrack]:
        """The same samples as one track for each edge."""
        self.history.close()
        view = self.history.view
        rows = view.kept_rows()
        singles: list[PoseTrack] = []
        for index, edge in enumerate(self.edges):
            single = PoseTrack((edge,), self.history.span_ns, self.writer)
            columns = rows[:, 7 * index : 7 * index + 7]
            if self.has_covariances:
                columns = np.hstack((columns, rows[:, self.covariance_columns(index)]))
                single.history = History(columns.shape[1], self.history.span_ns)
            single.history.replace(view.kept_stamps(), columns)
            singles.append(single)
        return singles


Track: TypeAlias = JointTrack | PoseTrack


class Coverage(NamedTuple):
    """The samples of a track as errors and ``frames()`` describe them: stamps [ns], mean rate, count."""

    oldest: int | None
    newest: int | None
    rate_hz: float | None
    samples: int


def coverage(view: HistoryView) -> Coverage:
    """The range, mean rate and number of the samples of a track."""
    if not view.size:
        return Coverage(None, None, None, 0)
    oldest, newest = view.oldest, view.newest
    rate_hz = (view.size - 1) * 1e9 / (newest - oldest) if newest > oldest else None
    return Coverage(oldest, newest, rate_hz, view.size)
