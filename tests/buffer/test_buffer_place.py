"""Points placed at their own stamps: the result of one lookup for each, in any order, layout and format."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from helpers.buffers import EVERY_JOINT, MS, NOW, S, every_joint, filled, moving, pose_of_every, static
from hypothesis import given, settings
from hypothesis import strategies as st

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import (
    AmbiguousFrame,
    Disconnected,
    InFuture,
    InPast,
    InvalidInput,
    LookupFailed,
    UnknownFrame,
)
from zstate.model.load import load_model
from zstate.se3 import quaternion_from_rpy
from zstate.transform import Transform

MODEL = load_model(EVERY_JOINT)
POINTS = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [-3.0, 0.5, 0.25]])


def looked_up(
    buffer: TransformBuffer, points: np.ndarray, stamps: Any, source: str, target: str
) -> tuple[np.ndarray, np.ndarray]:
    """The definition: one lookup for each point."""
    placed = np.full((len(points), 3), np.nan)
    for row, (point, stamp) in enumerate(zip(points, stamps, strict=True)):
        with suppress(LookupFailed):
            placed[row] = buffer.lookup(target, source, int(stamp)).apply(point)
    return placed, ~np.isnan(placed[:, 0])


def assert_placed_as_looked_up(
    buffer: TransformBuffer, points: np.ndarray, stamps: np.ndarray, source: str, target: str
) -> np.ndarray:
    """By both kernels, to 1e-12 of the numbers involved. Which points have a pose."""
    expected, known = looked_up(buffer, points, stamps, source, target)
    scale = max(1.0, np.abs(points).max(initial=0.0), np.nanmax(np.abs(expected), initial=0.0))
    reference = buffer._path(target, source, compiled=False).place(points, stamps)
    for placed, valid in (buffer.place(points, stamps, source, target), reference):
        assert valid.tolist() == known.tolist()
        np.testing.assert_allclose(placed, expected, rtol=0.0, atol=1e-12 * scale)
    return known


def driving(rate_hz: int = 100) -> TransformBuffer:
    """A rover that drives and turns for two seconds, with a laser."""
    buffer = filled(Transform.from_rpy("base", "laser", (0.2, 0.0, 0.3), (0.1, 0.0, 3.0)))
    for n in range(2 * rate_hz):
        t = n / rate_hz
        position, rpy = (t, np.sin(t), 0.0), (0.1 * np.sin(9 * t), 0.1 * np.cos(7 * t), 1.5 * t)
        buffer.insert(Transform.from_rpy("odom", "base", position, rpy, NOW + n * S // rate_hz))
    return buffer


ORDERS = ("ascending", "descending", "shuffled", "by beam", "by column", "jumps")


def scan_stamps(order: str, count: int, seed: int, first: int, last: int) -> np.ndarray:
    """``count`` stamps of a scan in [first, last], as lidars order them."""
    rng = np.random.default_rng(seed)
    stamps = np.linspace(0, last - first, count).astype(np.int64) + first
    if order == "descending":
        return stamps[::-1].copy()
    if order == "shuffled":
        return rng.permutation(stamps)
    if order == "by beam":
        return np.resize(stamps[:: max(1, count // 7)], count)
    if order == "by column":
        return np.repeat(stamps[::5], 5)[:count]
    if order == "jumps":
        return np.concatenate(np.array_split(stamps, 4)[::-1])
    return stamps


positions = st.lists(
    st.floats(-50.0, 50.0, allow_subnormal=False),
    min_size=MODEL.position_count,
    max_size=MODEL.position_count,
)
links = st.sampled_from(["hall", *MODEL.links])


@st.composite
def scans(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    """Points and stamps, some of them at samples and at the ends of what 64 bits hold."""
    count, seed = draw(st.integers(0, 99)), draw(st.integers(0, 2**32))
    stamps = scan_stamps(draw(st.sampled_from(ORDERS)), count, seed, NOW - S // 2, NOW + 4 * S)
    if count > 9:
        stamps[3:9] = NOW, NOW + S, NOW + S // 3, NOW + 4 * S // 3, -(2**63), 2**63 - 1
    return np.random.default_rng(seed).uniform(-20.0, 20.0, (count, 3)), stamps


@settings(deadline=None)
@given(st.lists(positions, min_size=1, max_size=4), st.sampled_from([1.0, 0.01, 0.0]), links, links, scans())
@pytest.mark.long
def test_points_on_every_type_of_joint_are_placed_as_looked_up(
    samples, size: float, source: str, target: str, scan: tuple[np.ndarray, np.ndarray]
) -> None:
    """Small motions between samples and large ones, wrapped encoders, two tracks with different stamps."""
    buffer, track = every_joint()
    free = track.model.columns["free"]
    for second, numbers in enumerate(samples):
        q = samples[0] + size * (np.array(numbers) - samples[0])
        turn = q[free + 3 : free + 7]
        length = float(np.linalg.norm(turn))
        q[free + 3 : free + 7] = turn / length if length > 1e-3 else (0.0, 0.0, 0.0, 1.0)
        buffer.insert_joints(track, NOW + second * S, q)
        at = NOW + second * S + S // 3
        buffer.insert(Transform("hall", "root", q[:3], quaternion_from_rpy(*q[:3]), at))
    assert_placed_as_looked_up(buffer, *scan, source, target)


@pytest.mark.parametrize("frames", [("laser", "odom"), ("odom", "laser"), ("base", "odom")])
@pytest.mark.parametrize("order", ORDERS)
def test_scan_of_a_turning_rover_is_placed_as_looked_up(frames: tuple[str, str], order: str) -> None:
    points = np.random.default_rng(3).uniform(-30.0, 30.0, (700, 3))
    stamps = scan_stamps(order, 700, 4, NOW + 500 * MS + 3, NOW + 600 * MS)
    assert assert_placed_as_looked_up(driving(), points, stamps, *frames).all()


@pytest.mark.parametrize("columns", [1024, 9000])
def test_irregular_stamps_that_lasers_share_are_placed_as_each_by_itself(columns: int) -> None:
    """Of a real sensor: as many as are kept at once, and more."""
    rng = np.random.default_rng(6)
    stamps = np.tile(np.sort(rng.integers(NOW + S, NOW + S + 100 * MS, columns)), 4)
    points = rng.uniform(-30.0, 30.0, (len(stamps), 3))
    buffer = driving()
    placed, valid = buffer.place(points, stamps, "laser", "odom")
    expected, _ = buffer._path("odom", "laser", compiled=False).place(points, stamps)
    assert valid.all()
    np.testing.assert_allclose(placed, expected, rtol=0.0, atol=1e-12 * 30.0)


@pytest.mark.parametrize("bend", [0.01, 0.1, 0.7, 3.0, 40.0])
@pytest.mark.parametrize("order", ["ascending", "descending", "jumps"])
def test_many_points_between_two_samples_of_any_motion_are_placed_as_looked_up(
    bend: float, order: str
) -> None:
    """Joints of all types; of those that turn, some do it by ``bend`` [rad] between two samples."""
    buffer, track = every_joint()
    for n in range(3):
        free = (n, 0.0, -n, *quaternion_from_rpy(0.3 * n * n, bend * n, 0.1))
        turned = {"spin": n * n * bend, "bend": n * bend, "slide": (n * n, n, n * bend)}
        buffer.insert_joints(track, NOW + n * S, pose_of_every(track, free=free, lift=0.5 * n, **turned))
    points = np.random.default_rng(3).uniform(-30.0, 30.0, (3000, 3))
    stamps = scan_stamps(order, 3000, 0, NOW, NOW + 2 * S)
    assert assert_placed_as_looked_up(buffer, points, stamps, "second", "root").all()
    assert assert_placed_as_looked_up(buffer, points, stamps, "root", "second").all()


def test_turns_that_cancel_between_two_samples_are_placed_as_looked_up() -> None:
    # Forwards and back, about axes that are 1e-11 rad apart: what remains is tiny, and not smooth.
    model = load_model("""<robot name="linkage"><link name="base"/><link name="lever"/><link name="hand"/>
      <joint name="turn" type="continuous"><parent link="base"/><child link="lever"/>
        <axis xyz="0 0 1"/></joint>
      <joint name="back" type="continuous"><parent link="lever"/><child link="hand"/><axis xyz="0 0 1"/>
        <origin rpy="1e-11 0 0"/><mimic joint="turn" multiplier="-1"/></joint></robot>""")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    for n in range(2):
        buffer.insert_joints(track, NOW + n * S, [40.0 * n])
    stamps = NOW + np.arange(0, S, 200_000)
    points = np.tile([0.0, 0.0, 1.0], (len(stamps), 1))
    assert_placed_as_looked_up(buffer, points, stamps, "hand", "base")


def test_wall_seen_while_turning_is_straight() -> None:
    """Rays of a laser that turns at 1.5 rad/s measure the wall x = 5; in the map their ends are on it."""
    buffer = filled(*(moving("map", "laser", NOW + n * 10 * MS, yaw=0.015 * n) for n in range(20)))
    stamps = NOW + np.arange(1000) * 100_000
    yaws = 1.5 * (stamps - NOW) * 1e-9
    bearings = np.linspace(-1.0, 1.0, 1000) - yaws  # in the laser
    ranges = 5.0 / np.cos(bearings + yaws)
    rays = ranges[:, None] * np.stack((np.cos(bearings), np.sin(bearings), np.zeros(1000)), axis=1)
    placed, valid = buffer.place(rays, stamps, source="laser", target="map")
    assert valid.all()
    np.testing.assert_allclose(placed[:, 0], 5.0, atol=1e-9)


def test_mimic_joint_of_a_wrapped_encoder_is_placed_as_looked_up() -> None:
    """At the sample the mimic joint has half of the wrapped angle, just before it half of the other."""
    model = load_model("""
<robot name="half"><link name="root"/><link name="wheel"/><link name="half"/>
  <joint name="spin" type="continuous"><parent link="root"/><child link="wheel"/><axis xyz="0 0 1"/></joint>
  <joint name="follow" type="continuous"><parent link="root"/><child link="half"/><axis xyz="0 0 1"/>
    <mimic joint="spin" multiplier="0.5"/></joint>
</robot>""")
    buffer = TransformBuffer()
    track = buffer.add_robot(model)
    for n, angle in enumerate((3.0, -3.1, -2.9)):
        buffer.insert_joints(track, NOW + n * S, [angle])
    stamps = np.sort(
        np.concatenate((NOW + np.arange(0, 2 * S, S // 16), [NOW + S - 1, NOW + S + 1, NOW + 2 * S]))
    )
    points = np.tile([1.0, 2.0, 3.0], (len(stamps), 1))
    assert assert_placed_as_looked_up(buffer, points, stamps, "half", "root").all()
    assert assert_placed_as_looked_up(buffer, points, stamps, "half", "wheel").all()


def test_one_stamp_is_that_of_all_points() -> None:
    buffer = driving()
    at = NOW + 333 * MS
    expected = buffer.lookup("odom", "laser", at).apply(POINTS)
    for stamp in (at, np.int64(at), np.datetime64(at, "ns")):
        placed, valid = buffer.place(POINTS, stamp, "laser", "odom")
        assert valid.all()
        np.testing.assert_allclose(placed, expected, atol=1e-12)
    placed, valid = buffer.place(POINTS, NOW - 1, "laser", "odom")
    assert np.isnan(placed).all()
    assert not valid.any()


def test_static_frames_need_no_samples() -> None:
    buffer = filled(static("a", "b", x=1.0, yaw=np.pi / 2), static("a", "c", x=-1.0))
    placed, valid = buffer.place(POINTS, [0, -5, NOW], "b", "c")
    assert valid.all()
    # A quarter turn maps x y z to -y x z; b is 2 m before c.
    np.testing.assert_allclose(placed, [[2, 1, 0], [0, 0, 0], [1.5, -3, 0.25]], atol=1e-12)
    same, valid = buffer.place(POINTS, [0, 1, 2], "b", "b")
    assert same.tolist() == POINTS.tolist()
    assert valid.all()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_no_points_have_no_places(dtype: type) -> None:
    for buffer, source in ((driving(), "laser"), (filled(static("odom", "b")), "b")):
        for stamps in ([], NOW, np.empty(0, np.int64)):
            placed, valid = buffer.place(np.empty((0, 3), dtype), stamps, source, "odom")
            assert (placed.shape, placed.dtype, valid.shape) == ((0, 3), dtype, (0,))


def test_rows_without_a_transform_are_nan_and_explained() -> None:
    buffer = filled(*(moving("a", "b", NOW + n * S, x=float(n)) for n in range(3)))
    stamps = np.array([NOW - 1, NOW, NOW + 2 * S, NOW + 2 * S + 1, NOW + S // 2, -7])
    placed, valid = buffer.place(np.zeros((6, 3)), stamps, "b", "a")
    assert valid.tolist() == [False, True, True, False, True, False]
    assert placed[valid, 0].tolist() == [0.0, 2.0, 0.5]
    assert np.isnan(placed[~valid]).all()
    reasons = [type(buffer.explain("a", "b", int(stamp))) for stamp in stamps[~valid]]
    assert reasons == [InPast, InFuture, InPast]


def test_robot_without_samples_has_no_places() -> None:
    buffer, _ = every_joint()
    for stamps in (NOW, [NOW, NOW + 1, NOW]):
        assert not buffer.place(POINTS, stamps, "tip", "root")[1].any()


LAYOUTS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "plain": lambda points: points,
    "columns of a wider array": lambda points: np.hstack((points, points))[:, :3],
    "every other row": lambda points: np.repeat(points, 2, axis=0)[::2],
    "backwards": lambda points: points[::-1].copy()[::-1],
    "Fortran order": np.asfortranarray,
    "big-endian": lambda points: points.astype(points.dtype.newbyteorder(">")),
    "one row repeated": lambda points: np.broadcast_to(points[:1], points.shape),
}


def packed(points: np.ndarray) -> np.ndarray:
    """A view of points that are not aligned, as in a PointCloud2 with a point_step of odd length."""
    step = points.itemsize * 3 + 1
    memory = np.zeros(len(points) * step + 1, np.uint8)
    view = np.ndarray(points.shape, points.dtype, memory.data, 1, (step, points.itemsize))
    view[...] = points
    return view


@pytest.mark.parametrize("layout", [*LAYOUTS, "packed"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_any_layout_is_read_without_being_changed(layout: str, dtype: type) -> None:
    buffer = driving()
    plain = np.random.default_rng(1).uniform(-9.0, 9.0, (50, 3)).astype(dtype)
    points = packed(plain) if layout == "packed" else LAYOUTS[layout](plain)
    points.flags.writeable = False
    before = points.copy()
    stamps = scan_stamps("ascending", 100, 0, NOW, NOW + 300 * MS)[::2]
    stamps.flags.writeable = False
    placed, valid = buffer.place(points, stamps, "laser", "odom")
    assert (placed.dtype, placed.shape, valid.all()) == (dtype, (50, 3), True)
    assert placed.flags.c_contiguous
    assert placed.flags.writeable
    assert np.array_equal(points, before)
    expected, _ = looked_up(buffer, before.astype(np.float64), stamps, "laser", "odom")
    # Computed in float64: a float32 result differs by its own rounding only.
    np.testing.assert_allclose(placed, expected, rtol=0.0, atol=1e-12 if dtype == np.float64 else 5e-7)
    assert np.all(np.abs(placed - expected) <= np.spacing(np.abs(expected).astype(dtype)) + 1e-12)


def test_lists_and_integers_are_points() -> None:
    buffer = filled(static("a", "b", x=1.0))
    for points in ([[1, 2, 3]], [(1.0, 2.0, 3.0)], np.array([[1, 2, 3]], np.uint8)):
        placed, _ = buffer.place(points, 5, "b", "a")
        assert (placed.dtype, placed.tolist()) == (np.float64, [[2.0, 2.0, 3.0]])


@pytest.mark.parametrize(
    ("points", "stamps", "match"),
    [
        (np.zeros(3), NOW, r"shape \(N, 3\).*got \(3,\)"),
        (np.zeros((2, 4)), NOW, r"got \(2, 4\).*points\[:, :3\]"),
        (np.zeros((4, 2, 3)), NOW, r"got \(4, 2, 3\).*reshape"),
        (np.zeros((2, 3), np.float16), NOW, "float16.*astype"),
        (np.zeros((2, 3), complex), NOW, "complex"),
        (np.zeros((2, 3), bool), NOW, "bool"),
        (np.ma.masked_equal(np.zeros((2, 3)), 0.0), NOW, "masks"),
        (np.zeros((2, 3)), [NOW], "2 points have 1 stamps"),
        (np.zeros((2, 3)), [NOW] * 3, "2 points have 3 stamps"),
        (np.zeros((0, 3)), [NOW], "0 points have 1 stamps"),
        (np.zeros((2, 3)), [[NOW, NOW]], r"flat array.*\(1, 2\)"),
        (np.zeros((2, 3)), 1.5, "not 1.5"),
        (np.zeros((2, 3)), [1.5, 2.5], "float64"),
        (np.zeros((2, 3)), None, "stamps"),
        (np.zeros((2, 3)), True, "True"),
        (np.zeros((2, 3)), 2**63, "64-bit"),
    ],
)
def test_wrong_points_and_stamps_are_refused(points: Any, stamps: Any, match: str) -> None:
    for buffer in (filled(moving("a", "b", NOW)), filled(static("a", "b"))):
        with pytest.raises(InvalidInput, match=match):
            buffer.place(points, stamps, "b", "a")


def test_places_too_large_for_their_format_are_not_valid() -> None:
    buffer = filled(static("a", "b", x=1e300))
    placed, valid = buffer.place(np.zeros((2, 3), np.float32), 5, "b", "a")
    assert np.isnan(placed).all()
    assert not valid.any()
    assert buffer.place(np.zeros((2, 3)), 5, "b", "a")[1].all()


def test_frames_are_checked_before_points_as_in_lookup_many() -> None:
    buffer = filled(
        static("a", "b"), static("x", "y"), static("r1/base", "r1/laser"), static("r2/base", "r2/laser")
    )
    with pytest.raises(UnknownFrame, match="lazer"):
        buffer.place("no points", "no stamps", "lazer", "a")
    with pytest.raises(Disconnected):
        buffer.place("no points", "no stamps", "y", "a")
    with pytest.raises(AmbiguousFrame):
        buffer.place("no points", "no stamps", "laser", "r1/base")
    with pytest.raises(InvalidInput, match="slash"):
        buffer.place(POINTS, 5, "/b", "a")


def test_short_and_qualified_names_are_the_same_frame() -> None:
    buffer = TransformBuffer()
    track = buffer.add_robot(load_model("rrbot"), "r1")
    for n in range(10):
        buffer.insert_joints(track, NOW + n * 10 * MS, [0.1 * n, -0.2 * n])
    stamps = [NOW, NOW + 15 * MS, NOW + 90 * MS]
    short = buffer.place(POINTS, stamps, "laser_link", "base")
    full = buffer.place(POINTS, stamps, "r1/laser_link", "r1/base")
    assert short[1].all()
    assert short[0].tolist() == full[0].tolist()


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("order", ORDERS)
def test_rows_without_a_point_are_nan_and_change_no_other_row(order: str, dtype: type) -> None:
    buffer, count = driving(), 500
    stamps = scan_stamps(order, count, 3, NOW, NOW + S)
    points = np.random.default_rng(3).normal(size=(count, 3)).astype(dtype)
    holed = points.copy()
    holed[::7, 1], holed[3::7, 0], holed[5::7] = np.nan, np.inf, -np.inf
    is_point = np.isfinite(holed).all(axis=1)
    path = buffer._path("odom", "laser", compiled=False)
    for place in (lambda p: buffer.place(p, stamps, "laser", "odom"), lambda p: path.place(p, stamps)):
        whole, all_valid = place(points)
        placed, valid = place(holed)
        assert all_valid.all()
        assert valid.tolist() == is_point.tolist()
        assert np.isnan(placed[~valid]).all()
        assert np.array_equal(placed[valid], whole[valid])


def test_static_frames_place_no_rows_without_a_point() -> None:
    points = np.array([[1.0, 2.0, 3.0], [np.nan, 0.0, 0.0], [0.0, -np.inf, 0.0]])
    for buffer in (filled(static("a", "b")), filled(moving("a", "b", NOW))):
        placed, valid = buffer.place(points, NOW, "b", "a")
        assert valid.tolist() == [True, False, False]
        assert np.isnan(placed[1:]).all()
