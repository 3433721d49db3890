"""Insertion of cached samples into a buffer that also receives live ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from helpers.robots import RRBOT, STAMP, assert_pose

from zstate.buffer.buffer import TransformBuffer, feed_of
from zstate.buffer.history import History
from zstate.buffer.history_view import HistoryView
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.transforms import TransformIngest
from zstate.transform import COVARIANCE_NUMBERS
from zstate.wire.messages import JointState, RobotDescription, WriterTransforms, order_digest, to_block

PERIOD = 10_000_000
ORDER = order_digest(RRBOT.joint_names)
DESCRIPTION = RobotDescription(7, RRBOT.urdf, RRBOT.digest, RRBOT.joint_names, ())


def states(first: int, end: int, session: int = 7) -> list[JointState]:
    """Samples ``first`` up to ``end``; the shoulder position identifies it."""
    return [
        JointState(STAMP + seq * PERIOD, seq, session, ORDER, to_block([0.01 * seq, 0.0]))
        for seq in range(first, end)
    ]


class HistoryIngest:
    """A ingest, and what has become of the samples."""

    def __init__(self, *, described: bool = True, history_s: float = 10.0) -> None:
        self.buffer = TransformBuffer(history_s)
        self.counters = Counters()
        self.ingest = JointStateIngest("r1", FrameOwnership(self.buffer, self.counters))
        if described:
            self.ingest.describe(DESCRIPTION)

    def receive(self, *samples: JointState) -> None:
        for sample in samples:
            self.ingest.insert_sample(sample, overflowed=False)

    @property
    def counts(self) -> tuple[int, int, int]:
        """Received, missed and recalled."""
        stats = self.counters.stats()
        return stats.received, stats.missed, stats.recalled

    @property
    def stamps_known(self) -> list[int]:
        """The numbers of the samples in the buffer."""
        stamps = [STAMP + number * PERIOD for number in range(-1, 60)]
        looked = [self.buffer.explain("world", "tool", stamp) for stamp in stamps]
        return [
            (stamp - STAMP) // PERIOD
            for stamp, reason in zip(stamps, looked, strict=True)
            if reason is None and self.buffer.lookup("world", "tool", stamp).kind == "exact"
        ]


def test_received_samples_are_not_inserted_again_from_history():
    history = HistoryIngest()
    history.receive(*states(5, 10))
    assert history.ingest.insert_history(states(3, 10))
    assert (history.counts, history.stamps_known) == ((5, 0, 2), list(range(3, 10)))
    assert not history.ingest.insert_history(states(0, 3))
    assert (history.counts, history.stamps_known) == ((5, 0, 5), list(range(10)))


def test_no_older_history_is_requested_when_all_samples_were_received():
    history = HistoryIngest()
    history.receive(*states(0, 5))
    assert not history.ingest.insert_history(states(2, 5))
    assert history.counts == (5, 0, 0)


def test_history_may_arrive_before_the_first_live_sample():
    history = HistoryIngest()
    assert history.ingest.insert_history(states(5, 10))
    history.receive(*states(10, 12))
    assert not history.ingest.insert_history(states(0, 5))
    assert (history.counts, history.stamps_known) == ((2, 0, 10), list(range(12)))


def test_gap_is_filled_whether_or_not_it_was_detected_before():
    for shows_first in (True, False):
        history = HistoryIngest()
        history.receive(*states(0, 5))
        if shows_first:
            history.receive(*states(20, 21))
        assert history.ingest.insert_history(states(10, 20))
        assert not history.ingest.insert_history(states(3, 10))
        if not shows_first:
            history.receive(*states(20, 21))
        assert history.stamps_known == list(range(21))
        # It was missed all the same: a reader in a control loop did not have it in time.
        assert history.counts == (6, 15, 15)


def test_history_waits_for_the_description():
    history = HistoryIngest(described=False)
    assert history.ingest.insert_history(states(5, 10))
    assert history.ingest.insert_history(states(0, 5)) is False
    history.receive(*states(10, 12))
    assert history.counts == (0, 0, 0)
    history.ingest.describe(DESCRIPTION)
    assert (history.counts, history.stamps_known) == ((2, 0, 10), list(range(12)))


def test_history_of_a_writer_that_has_left_is_refused():
    history = HistoryIngest()
    history.receive(*states(0, 5))
    history.receive(*states(20, 21, session=8))
    assert not history.ingest.insert_history(states(0, 5))
    assert (history.counts, history.stamps_known) == ((6, 0, 0), [20])


def test_no_history_older_than_the_buffer_keeps_is_requested():
    history = HistoryIngest(history_s=0.1)
    history.receive(*states(30, 31))
    assert not history.ingest.insert_history(states(0, 30))
    assert history.stamps_known == list(range(20, 31))


def test_unusable_history_is_counted_once_per_page():
    history = HistoryIngest()
    history.receive(*states(30, 31))
    bad = [JointState(STAMP + seq * PERIOD, seq, 7, ORDER, to_block([0.0])) for seq in range(30)]
    assert not history.ingest.insert_history(bad)
    assert (history.counters.stats().refused, history.counts) == ({"bad numbers": 1}, (1, 0, 0))


@pytest.fixture
def single_inserts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The stamps of samples that were inserted one by one: among others, each copies the history."""
    stamps: list[int] = []
    for name in ("insert", "try_insert", "try_insert_poses"):
        insert = getattr(History, name)

        def counted(history: History, stamp: int, *numbers: object, insert: Any = insert) -> object:
            stamps.append(stamp)
            return insert(history, stamp, *numbers)

        monkeypatch.setattr(History, name, counted)
    return stamps


def fill(history: HistoryIngest, first: int, end: int, page: int = 100) -> bool:
    """Samples ``first`` up to ``end`` come from the cache, the newest page first."""
    wanted = True
    for start in range(end - page, first - 1, -page):
        wanted = history.ingest.insert_history(states(start, start + page))
    return wanted


def view_of(history: HistoryIngest) -> HistoryView:
    track = history.ingest._track
    assert track is not None
    return track.history.view


@pytest.mark.parametrize("shows_first", [True, False])
@pytest.mark.parametrize("size", [1000, 10_000])
def test_samples_of_a_gap_are_not_inserted_one_by_one(
    single_inserts: list[int], size: int, shows_first: bool
):
    """Each would copy the history: the work for a gap would grow with its square."""
    history = HistoryIngest(history_s=1e6)
    history.receive(*states(0, 100))
    if shows_first:
        history.receive(*states(100 + size, 110 + size))
    before = view_of(history)
    stamps = before.kept_stamps().tolist()
    single_inserts.clear()
    assert not fill(history, 0, 100 + size)
    assert single_inserts == []
    if not shows_first:
        history.receive(*states(100 + size, 110 + size))
    assert history.counts[2] == size
    view = view_of(history)
    assert view.kept_stamps().tolist() == [STAMP + seq * PERIOD for seq in range(110 + size)]
    assert view.kept_rows()[:, 0].tolist() == [0.01 * seq for seq in range(110 + size)]
    assert before.kept_stamps().tolist() == stamps


def test_gap_and_what_is_older_than_all_samples_are_inserted_together(single_inserts: list[int]):
    history = HistoryIngest()
    history.receive(*states(20, 30), *states(50, 51))
    single_inserts.clear()
    assert not history.ingest.insert_history(states(0, 50))
    assert single_inserts == []
    assert history.stamps_known == list(range(51))


# Moving edges, which are in the same stream as others of their writer


EDGES = (("odom", "base"), ("base", "camera"))


def moving(seq: int, *edges: tuple[str, str], variance: float | None = None) -> WriterTransforms:
    """Sample ``seq``; the x of each edge identifies it."""
    pose = [0.01 * seq, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    covariances = None if variance is None else to_block([variance] * COVARIANCE_NUMBERS * len(edges))
    head = (STAMP + seq * PERIOD, seq, 7, order_digest(edges))
    return WriterTransforms(*head, to_block(pose * len(edges)), edges, covariances)


class MovingHistory:
    """Moving edges in a buffer of 1e6 s."""

    def __init__(self) -> None:
        self.buffer = TransformBuffer(1e6)
        self.counters = Counters()
        self.ingest = TransformIngest("r1", FrameOwnership(self.buffer, self.counters))

    def receive(self, samples: list[WriterTransforms]) -> None:
        for sample in samples:
            self.ingest.insert_sample(sample, overflowed=False)

    def fill(self, samples: list[WriterTransforms], page: int = 100) -> None:
        """They come from the cache, the newest page first."""
        for start in range(len(samples) - page, -1, -page):
            self.ingest.insert_history(samples[start : start + page])

    def view(self, child: str) -> HistoryView:
        edge = feed_of(self.buffer).edge_of(child)
        assert edge is not None
        assert edge.track is not None
        return edge.track.history.view

    def known(self, child: str) -> list[int]:
        """The numbers of the samples that place a frame."""
        view = self.view(child)
        numbers = [(stamp - STAMP) // PERIOD for stamp in view.kept_stamps().tolist()]
        assert view.kept_rows()[:, 0].tolist() == [0.01 * number for number in numbers]
        return numbers


@pytest.mark.parametrize("shows_first", [True, False])
@pytest.mark.parametrize("size", [1000, 10_000])
@pytest.mark.long
def test_samples_of_a_gap_of_moving_edges_are_not_inserted_one_by_one(
    single_inserts: list[int], size: int, shows_first: bool
):
    """Whether the writer sends its edges together, in turns, or with covariances."""
    for edges_of, variance in (
        (lambda _: EDGES, None),
        (lambda _: EDGES, 0.5),
        (lambda seq: EDGES[seq % 2 : seq % 2 + 1], None),
    ):
        samples = [moving(seq, *edges_of(seq), variance=variance) for seq in range(110 + size)]
        history = MovingHistory()
        history.receive(samples[:100])
        if shows_first:
            history.receive(samples[100 + size :])
        before = history.view("r1/base")
        stamps = before.kept_stamps().tolist()
        single_inserts.clear()
        history.fill(samples[: 100 + size])
        assert single_inserts == []
        if not shows_first:
            history.receive(samples[100 + size :])
        for _, child in EDGES:
            known = [sample.seq for sample in samples if child in dict(map(reversed, sample.edges or ()))]
            assert history.known(f"r1/{child}") == known
        assert history.counters.stats().recalled == size
        assert before.kept_stamps().tolist() == stamps


def test_past_of_moving_edges_before_all_that_is_known_is_inserted():
    history = MovingHistory()
    samples = [moving(seq, *EDGES) for seq in range(500)]
    history.receive(samples[400:])
    history.fill(samples[:400])
    assert history.known("r1/camera") == list(range(500))


def test_samples_of_a_gap_of_moving_edges_end_at_one_that_cannot_be_used():
    history = MovingHistory()
    samples = [moving(seq, *EDGES) for seq in range(51)]
    history.receive([*samples[:5], samples[50]])
    page = samples[5:50]
    bad = to_block([math.nan] * 14)
    page[20] = WriterTransforms(page[20].stamp, page[20].seq, 7, page[20].order, bad, EDGES)
    history.fill(page, len(page))
    assert history.known("r1/base") == [*range(5), *range(26, 51)]
    assert history.counters.stats().refused == {"not a pose": 1}


def test_a_gap_in_which_the_edges_of_a_writer_change_is_filled():
    """Two edges become one, the other one, three and two again; some have covariances."""
    history = MovingHistory()
    samples = [
        *(moving(seq, *EDGES) for seq in range(40)),
        *(moving(seq, EDGES[0]) for seq in range(40, 60)),
        *(moving(seq, EDGES[1], variance=0.5) for seq in range(60, 80)),
        *(moving(seq, *EDGES, ("base", "lidar")) for seq in range(80, 100)),
        *(moving(seq, *EDGES) for seq in range(100, 120)),
    ]
    history.receive([*samples[:5], samples[119]])
    history.fill(samples[5:119], 57)
    assert history.known("r1/base") == [*range(60), *range(80, 120)]
    assert history.known("r1/camera") == [*range(40), *range(60, 120)]
    assert history.known("r1/lidar") == list(range(80, 100))
    triangles = history.view("r1/camera").kept_rows()[:, 7:]
    assert np.isfinite(triangles).all(axis=1).tolist() == [
        60 <= seq < 80 for seq in [*range(40), *range(60, 120)]
    ]


def test_gap_is_filled_no_further_than_the_buffer_reaches():
    for shows_first in (True, False):
        history = HistoryIngest(history_s=10.0)
        history.receive(*states(0, 5), *(states(1500, 1501) if shows_first else ()))
        assert not fill(history, 0, 1500)
        newest = 1500 if shows_first else 1499
        kept = view_of(history).kept_stamps().tolist()
        assert kept == [STAMP + seq * PERIOD for seq in range(newest - 1000, newest + 1)]
        assert history.counts[2] == 1000 + (not shows_first)


def test_samples_of_a_gap_end_at_one_that_cannot_be_used():
    history = HistoryIngest()
    history.receive(*states(0, 5), *states(50, 51))
    page = states(5, 50)
    page[20] = JointState(page[20].stamp, page[20].seq, 7, ORDER, to_block([math.nan, 0.0]))
    assert not history.ingest.insert_history(page)
    assert history.counts == (6, 45, 24)
    assert history.counters.stats().refused == {"bad numbers": 1}
    assert history.stamps_known == [*range(5), *range(26, 51)]


def test_velocities_of_a_gap_are_recalled():
    history = HistoryIngest()
    live = [
        JointState(state.stamp, state.seq, 7, ORDER, state.positions, to_block([1.0, 2.0]))
        for state in states(0, 50)
    ]
    history.receive(*live[:5], live[49])
    assert not history.ingest.insert_history([*states(5, 10), *live[10:49]])
    rows = view_of(history).kept_rows()
    assert rows[:, 2].tolist() == pytest.approx([1.0] * 5 + [math.nan] * 5 + [1.0] * 40, nan_ok=True)


def test_live_samples_go_on_after_a_gap_was_filled():
    history = HistoryIngest()
    history.receive(*states(0, 5), *states(50, 51))
    before = history.buffer.lookup("world", "tool", STAMP + 2 * PERIOD)
    assert not history.ingest.insert_history(states(0, 50))
    history.receive(*states(51, 60))
    assert history.stamps_known == list(range(60))
    assert_pose(history.buffer.lookup("world", "tool", STAMP + 2 * PERIOD), before.matrix)
