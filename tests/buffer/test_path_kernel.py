"""The C extension and the reference in Python: the same samples kept, the same answers, the same errors."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable

import numpy as np
import pytest
from helpers.buffers import EVERY_JOINT, NOW, S, every_joint, filled, moving
from helpers.processes import DEADLINE_S
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.buffer.buffer import TransformBuffer
from zstate.buffer.history import History, insert_together
from zstate.buffer.path import CompiledPath, TransformPath
from zstate.buffer.reference_history import ReferenceHistory
from zstate.buffer.tracks import JointTrack
from zstate.errors import InvalidInput, LookupFailed
from zstate.extension import kernel
from zstate.model.load import load_model
from zstate.se3 import ARRAYS, conjugate, multiply, quaternion_from_rpy, unstack
from zstate.transform import Transform

pytestmark = pytest.mark.skipif(kernel != "c", reason=f"runs on the reference: {kernel.reason}")

MODEL = load_model(EVERY_JOINT)
SPAN_NS = 40
US = 1000
EXTREMES = (-(2**63), -(2**63) + 1, -1, 0, 2**63 - 2, 2**63 - 1)

# Nearly regular, bursts and gaps, and the ends of what 64 bits hold.
steps = st.sampled_from([0, 1, 1, 1, 2, 5, 39, 40, 41, 1000])
stamps = st.one_of(
    st.lists(steps, max_size=60).map(np.cumsum), st.lists(st.sampled_from(EXTREMES), max_size=9)
)
orders = st.randoms(use_true_random=False)


def kept(history) -> tuple[list[int], list[list[float]]]:
    return history.view.kept_stamps().tolist(), history.view.kept_rows().tolist()


@given(stamps, orders, st.integers(0, 3), st.booleans())
def test_histories_keep_the_same_samples(column, order, width: int, shuffled: bool) -> None:
    ours, theirs = History(width, SPAN_NS), ReferenceHistory(width, SPAN_NS)
    column = [int(stamp) for stamp in column]
    if shuffled:
        order.shuffle(column)
    for number, stamp in enumerate(column):
        row = np.full(width, float(number))
        assert ours.reaches(stamp) == theirs.reaches(stamp)
        assert ours.insert(stamp, row) == theirs.insert(stamp, row)
        assert kept(ours) == kept(theirs)
    copy = History(width, SPAN_NS)
    copy.replace(theirs.view.kept_stamps(), theirs.view.kept_rows())
    assert kept(copy) == kept(theirs)
    assert ours.newest == theirs.newest == max(column, default=None)
    ours.clear()
    assert kept(ours) == ([], [])
    assert ours.newest is None


@given(st.lists(st.integers(0, 400), min_size=1, max_size=80, unique=True), st.lists(st.integers(-5, 405)))
def test_search_is_correct_for_any_spacing_of_stamps(column: list[int], asked: list[int]) -> None:
    buffer = filled(*(moving("a", "b", NOW + n * n, x=float(n)) for n in sorted(column)), history_s=1e6)
    paths = both_paths(buffer, "a", "b")
    for stamp in [NOW + n for n in (*asked, *(n * n for n in asked))]:
        assert_agree(*paths, stamp)


def both_paths(buffer: TransformBuffer, target: str, source: str) -> tuple[TransformPath, TransformPath]:
    """The same path with the extension and without."""
    path, reference = buffer._path(target, source), buffer._path(target, source, compiled=False)
    assert isinstance(path, CompiledPath)
    assert type(reference) is TransformPath
    return path, reference


def outcome(ask: Callable[[], Transform | None]) -> Transform | LookupFailed | None:
    try:
        return ask()
    except LookupFailed as reason:
        return reason


def facts_of(transform: Transform) -> tuple[object, ...]:
    return transform.target, transform.source, transform.stamp, transform.kind, transform.predicted_s


def assert_agree(path: TransformPath, reference: TransformPath, stamp: int | None) -> None:
    """One lookup by both."""
    theirs = outcome(lambda: reference.transform(stamp))
    if isinstance(theirs, LookupFailed):
        assert path.at(stamp) is None
        ours = outcome(lambda: path.transform(stamp))
        assert type(ours) is type(theirs)
        assert vars(ours) == vars(theirs)
        return
    ours = path.at(stamp)
    assert ours is not None
    assert isinstance(theirs, Transform)
    assert facts_of(ours) == facts_of(theirs)
    assert_same_poses(ours.pose7, theirs.pose7)
    assert path.raise_if_outside(stamp) is None


def assert_same_poses(ours: np.ndarray, theirs: np.ndarray) -> None:
    """To 1e-14 of the numbers involved."""
    ours, theirs = np.atleast_2d(ours), np.atleast_2d(theirs)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))
    scale = max(1.0, np.nanmax(np.abs(theirs[:, :3]), initial=0.0))
    np.testing.assert_allclose(ours[:, :3], theirs[:, :3], rtol=0.0, atol=1e-14 * scale)
    turn = multiply(conjugate(unstack(ours)[3:]), unstack(theirs)[3:])
    assert np.all(np.isnan(turn[3]) | (ARRAYS.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2) < 1e-14))


positions = st.lists(
    st.floats(-50.0, 50.0, allow_subnormal=False),
    min_size=MODEL.position_count,
    max_size=MODEL.position_count,
)


def a_robot(samples: list[list[float]]) -> tuple[TransformBuffer, JointTrack]:
    """The robot with every type of joint on a cart of its own, a second apart."""
    buffer, track = every_joint()
    free = track.model.columns["free"]
    for second, numbers in enumerate(samples):
        q = np.array(numbers)
        turn = q[free + 3 : free + 7]
        length = float(np.linalg.norm(turn))
        q[free + 3 : free + 7] = turn / length if length > 1e-3 else (0.0, 0.0, 0.0, 1.0)
        buffer.insert_joints(track, NOW + second * S, q)
        at = NOW + second * S + S // 3
        buffer.insert(Transform("hall", "root", q[:3], quaternion_from_rpy(*q[:3]), at))
    return buffer, track


links = st.sampled_from(["hall", *MODEL.links])
instants = st.lists(st.integers(-1, 32).map(lambda n: NOW + n * S // 8), max_size=20)


@settings(deadline=None)
@given(st.lists(positions, max_size=4), links, links, instants)
@pytest.mark.long
def test_paths_over_every_type_of_joint_agree(samples, target: str, source: str, asked: list[int]) -> None:
    buffer, _ = a_robot(samples)
    try:
        path, reference = both_paths(buffer, target, source)
    except LookupFailed:
        return
    for stamp in [None, *EXTREMES, *asked]:
        assert_agree(path, reference, stamp)
    column = np.array([*EXTREMES, *asked])
    ours, theirs = path.poses(column), reference.poses(column)
    assert ours[1].tolist() == theirs[1].tolist()
    assert_same_poses(ours[0], theirs[0])


@given(
    st.lists(positions, min_size=1, max_size=4),
    links,
    links,
    st.lists(st.integers(-1, 32).map(lambda n: NOW + n * S // 8), max_size=40),
)
def test_instants_beside_each_other_have_the_bits_of_each_alone(
    samples, target: str, source: str, asked: list[int]
) -> None:
    """However many are in one call, in any order, some of them without a pose."""
    path, _ = both_paths(a_robot(samples)[0], target, source)
    poses, valid = path.poses(np.array(asked, np.int64))
    for stamp, pose, is_valid in zip(asked, poses, valid, strict=True):
        alone = path.at(stamp)
        assert is_valid == (alone is not None)
        if alone is not None:
            assert pose.tobytes() == alone.pose7.tobytes()


@given(positions, st.sampled_from(["spin", "bend", "raise"]))
def test_results_are_bit_identical_where_the_arithmetic_is_the_same(numbers, joint: str) -> None:
    """A single joint's own edge: nothing is multiplied out beforehand."""
    buffer, track = a_robot([numbers, numbers[::-1]])
    of = {one.name: one for one in track.model.joints}[joint]
    path, reference = both_paths(buffer, of.parent, of.child)
    for stamp in range(NOW, NOW + S + 1, S // 7):
        assert path.at(stamp).pose7.tolist() == reference.transform(stamp).pose7.tolist()  # type: ignore[union-attr]


@pytest.mark.parametrize("spread", [1e-9, 1e-4, 0.1, 0.27, 0.29, 1.0, 3.0])
def test_small_and_large_turns_agree(spread: float) -> None:
    buffer = filled(moving("a", "b", NOW), moving("a", "b", NOW + S, yaw=spread))
    for stamp in range(NOW, NOW + S + 1, S // 13):
        assert_agree(*both_paths(buffer, "a", "b"), stamp)


def test_unusual_input_falls_back_to_the_reference() -> None:
    """The extension reports input that it cannot handle, and the reference handles it."""
    history = History(3, SPAN_NS)
    row = np.zeros(3)
    for plain in (True, 1.5, "now", None, 2**63, np.int64(3)):
        assert history.try_insert(plain, row, None, 3) is None
    for numbers in (
        [0, 0, 0],
        row.astype(np.float32),
        np.zeros((1, 3)),
        np.zeros(6)[::2],
        row * np.nan,
        np.ma.masked_equal(row, 0.0),
        row.astype(complex),
        row.astype(bool),
        row.astype(object),
        "abc",
    ):
        assert history.try_insert(1, numbers, None, 3) is None
    for block in (b"", b"x" * 24 + b"y", row.tobytes()[8:], (row * np.nan).tobytes(), bytearray(24)):
        assert history.try_insert(1, block, None, 3) is None
    assert history.try_insert(1, row, None, 3) is True
    assert history.try_insert(2, row.tobytes(), None, 3) is True
    assert history.try_insert(-(2**63), row, None, 3) is False
    assert len(history.view.kept_rows()) == 2


def test_poses_as_a_block_are_inserted_as_in_the_reference() -> None:
    """The same bits, whether the extension inserts a block or the checks in Python do."""
    edges = (("odom", "base"), ("base", "arm"))
    by_block, by_array = TransformBuffer(), TransformBuffer()
    random = np.random.default_rng(7)
    for stamp in range(200):
        poses = random.normal(size=(2, 7))
        poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
        poses[:, 3:] *= 1.0 + random.uniform(-9e-4, 9e-4, size=(2, 1))  # is normalised
        by_block.insert_many(edges, stamp, poses.tobytes())
        by_array.insert_many(edges, stamp, poses)
    stamps = np.arange(200)
    for target, source in edges:
        of_blocks, _ = by_block.lookup_many(target, source, stamps)
        of_arrays, _ = by_array.lookup_many(target, source, stamps)
        assert of_blocks.tobytes() == of_arrays.tobytes()


@pytest.mark.parametrize(
    ("block", "match"),
    [
        (b"", "shape"),
        (bytes(55), "shape"),
        (np.array([0, 0, 0, 0, 0, 0, 1.0, 0]).tobytes(), "shape"),
        (np.array([np.nan, 0, 0, 0, 0, 0, 1.0]).tobytes(), "seven finite numbers"),
        (np.array([0, 0, 0, 0, 0, 0, 1.01]).tobytes(), "length 1"),
        (np.array([0, 0, 0, 1e200, 0, 0, 1e200]).tobytes(), "length 1"),
    ],
    ids=["empty", "cut off", "eight numbers", "NaN", "not a unit quaternion", "overflow"],
)
def test_block_that_holds_no_pose_is_refused(block: bytes, match: str) -> None:
    buffer = TransformBuffer()
    edges, good = (("odom", "base"),), np.array([0, 0, 0, 0, 0, 0, 1.0]).tobytes()
    buffer.insert_many(edges, 1, good)  # the second sample takes the short way
    with pytest.raises(InvalidInput, match=match):
        buffer.insert_many(edges, 2, block)
    assert buffer.latest("odom", "base") == 1
    with pytest.raises(InvalidInput, match="stamp"):
        buffer.insert_many(edges, 2.5, good)  # type: ignore[arg-type]


def test_views_are_read_only_and_outlive_their_history() -> None:
    history = History(1, 10**9)
    history.insert(1, np.array([5.0]))
    view = history.view
    with pytest.raises(ValueError, match="read-only"):
        view.rows[0, 0] = 0.0
    for stamp in range(2, 1000):
        history.insert(stamp, np.array([float(stamp)]))
    history.clear()
    del history
    assert view.kept_rows().tolist() == [[5.0]]


def test_instant_of_several_histories_is_inserted_entirely_or_not_at_all() -> None:
    pair = History(1, SPAN_NS), History(2, SPAN_NS)
    insert_together(pair, 5, (np.ones(1), np.ones(2)))
    with pytest.raises(ValueError, match="as wide as its history"):
        insert_together(pair, 6, (np.ones(1), np.ones(3)))
    with pytest.raises(ValueError, match="each history once"):
        insert_together((pair[0], pair[0]), 6, (np.ones(1), np.ones(1)))
    assert [kept(history)[0] for history in pair] == [[5], [5]]


def test_batch_lookups_survive_concurrent_inserts_that_reallocate() -> None:
    """A batch has no lock and no GIL: rows it reads must stay as they were, to the last."""
    buffer = TransformBuffer(history_s=0.01)
    written, stop = threading.Event(), threading.Event()

    def write() -> None:
        # Fed alone first, the edges get a track each, to be written to at one moment.
        buffer.insert(moving("hall", "left", NOW - S))
        for n in itertools.count():
            # Late samples, in between, make new blocks of memory.
            stamp = NOW + n * US - (n % 7 == 3) * 3 * US // 2
            x = float(stamp - NOW)
            poses = [(x, 0, 0, 0, 0, 0, 1), (-x, 1, 0, 0, 0, 0, 1)]
            buffer.insert_many([("hall", "left"), ("left", "right")], stamp, poses)
            if n == 100:
                written.set()
            if stop.is_set():
                return

    writer = threading.Thread(target=write)
    writer.start()
    answered = 0
    try:
        assert written.wait(DEADLINE_S)
        for _ in range(40):
            stamps = buffer.latest("hall", "right") - np.arange(-US, 12_000 * US, 370)
            left, known = buffer.lookup_many("hall", "left", stamps)
            np.testing.assert_allclose(left[known, 0], (stamps - NOW)[known], rtol=1e-12, atol=1e-3)
            right, known = buffer.lookup_many("hall", "right", stamps)
            np.testing.assert_allclose(right[known, :2] - (0.0, 1.0), 0.0, atol=1e-3)
            answered += int(known.sum())
    finally:
        stop.set()
        writer.join(DEADLINE_S)
    assert answered > 0
