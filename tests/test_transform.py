"""Transform and Twist as values: which frames, which way, which numbers."""

from __future__ import annotations

import json
import math
import pickle
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.clock import ManualClock
from zstate.errors import FrameMismatch, InvalidInput, LibraryMissing
from zstate.transform import Transform, Twist, combine_kinds

NAN, INF = math.nan, math.inf
TURN = (0.5, -0.5, 0.5, 0.5)

COVARIANCE = np.diag([0.5, 0.4, 0.3, 0.2, 0.1, 0.05]) + 0.02

angles = st.floats(-3.0, 3.0)
numbers = st.floats(-100.0, 100.0)


def transforms(target: str, source: str) -> st.SearchStrategy[Transform]:
    triples = st.tuples(numbers, numbers, numbers), st.tuples(angles, angles, angles)
    return st.builds(lambda xyz, rpy: Transform.from_rpy(target, source, xyz, rpy), *triples)


def assert_close(a: Transform, b: Transform, atol: float = 1e-12) -> None:
    assert (a.target, a.source, a.stamp) == (b.target, b.source, b.stamp)
    np.testing.assert_allclose(a.matrix, b.matrix, atol=atol)


@given(transforms("a", "b"))
def test_the_inverse_undoes_a_transform(a_from_b: Transform) -> None:
    b_from_a = a_from_b.inverse()
    assert (b_from_a.target, b_from_a.source) == ("b", "a")
    np.testing.assert_allclose((a_from_b @ b_from_a).matrix, np.eye(4), atol=1e-12)
    assert_close(b_from_a.inverse(), a_from_b)


@given(transforms("a", "b"), transforms("b", "c"), transforms("c", "d"))
def test_composition_is_associative(a_from_b: Transform, b_from_c: Transform, c_from_d: Transform) -> None:
    assert_close((a_from_b @ b_from_c) @ c_from_d, a_from_b @ (b_from_c @ c_from_d))


@given(transforms("a", "b"), st.tuples(numbers, numbers, numbers))
def test_points_are_mapped_from_source_to_target(a_from_b: Transform, p_b) -> None:
    expected = (a_from_b.matrix @ (*p_b, 1.0))[:3]
    np.testing.assert_allclose(a_from_b.apply(p_b), expected, atol=1e-12)
    np.testing.assert_allclose(a_from_b.apply([p_b, p_b])[1], expected, atol=1e-12)
    np.testing.assert_allclose(a_from_b.apply((*p_b, 1.0)), (*expected, 1.0), atol=1e-12)
    np.testing.assert_allclose(a_from_b.apply(np.full((2, 3, 3), p_b))[1, 2], expected, atol=1e-12)


def test_a_homogeneous_direction_is_turned_and_not_moved() -> None:
    a_from_b = Transform("a", "b", (1, 2, 3), (0, 0, 1, 0))
    np.testing.assert_allclose(a_from_b.apply((1, 0, 0, 0)), (-1, 0, 0, 0), atol=1e-15)


@pytest.mark.parametrize("points", [1.0, (1.0, 2.0), np.zeros((3, 5))])
def test_points_of_another_width_are_refused(points) -> None:
    with pytest.raises(InvalidInput, match="columns"):
        Transform("a", "b", (0, 0, 0), (0, 0, 0, 1)).apply(points)


@pytest.mark.parametrize(
    "points",
    [
        (1.0, 2.0, 3.0),
        [1, 2, 3],
        np.array([1.0, 2.0, 3.0]),
        np.arange(12.0).reshape(4, 3),
        [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]],
        np.zeros((0, 3)),
        np.arange(24.0).reshape(2, 4, 3),
        np.full(3, NAN),
    ],
)
def test_a_transform_times_points_are_the_points_in_the_target(points) -> None:
    a_from_b = Transform("a", "b", (1, 2, 3), TURN)
    np.testing.assert_array_equal(a_from_b @ points, a_from_b.apply(points))


def test_products_with_points_associate() -> None:
    a_from_b, b_from_c = Transform("a", "b", (1, 2, 3), TURN), Transform("b", "c", (0, -1, 0.5), TURN)
    p_c = np.array([[0.5, 0.25, -2.0], [3.0, 2.0, 1.0]])
    np.testing.assert_allclose((a_from_b @ b_from_c) @ p_c, a_from_b @ (b_from_c @ p_c), atol=1e-15)


@pytest.mark.parametrize(
    "points", [np.eye(4), [1.0, 2.0, 3.0, 1.0], np.float64(3), [[1j, 0, 0]], ["1", "2", "3"]]
)
def test_values_that_are_not_points_are_no_factor(points) -> None:
    with pytest.raises(InvalidInput, match="points"):
        _ = Transform("a", "b", (0, 0, 0), TURN) @ points


def test_an_array_as_left_factor_and_other_types_as_factor_are_refused() -> None:
    a_from_b = Transform("a", "b", (0, 0, 0), TURN)
    for left, right in ((np.eye(3), a_from_b), (a_from_b, "xyz"), (a_from_b, None), (a_from_b, 5)):
        with pytest.raises(TypeError):
            _ = left @ right


def test_a_product_and_an_inverse_that_are_not_finite_are_refused() -> None:
    far = Transform("a", "b", (1.7e308, 0, 0), (0, 0, 0, 1))
    with pytest.raises(InvalidInput, match="not finite"):
        _ = far @ Transform("b", "c", (1.7e308, 0, 0), (0, 0, 0, 1))
    turned = Transform("a", "b", (1.7e308, 1.7e308, 0), (0, 0, math.sqrt(0.5), math.sqrt(0.5)))
    with pytest.raises(InvalidInput, match="not finite"):
        turned.inverse()


def test_angles_beyond_a_full_turn_are_refused_with_their_value_in_radians() -> None:
    with pytest.raises(
        InvalidInput, match=r"got 0, -90, 0\. If these are degrees, they are 0, -1\.5708, 0 rad"
    ):
        Transform.from_rpy("a", "b", (0, 0, 0), (0, -90, 0))
    for angle in (math.tau, -math.tau):
        np.testing.assert_allclose(
            Transform.from_rpy("a", "b", (0, 0, 0), (angle, angle, angle)).rpy, 0.0, atol=1e-12
        )


def test_inner_frames_that_differ_are_refused_with_both_named() -> None:
    a_from_b = Transform("a", "b", (0, 0, 0), (0, 0, 0, 1))
    c_from_d = Transform("c", "d", (0, 0, 0), (0, 0, 0, 1))
    with pytest.raises(FrameMismatch, match=r"'a' from 'b' @ 'c' from 'd'.*look up 'b' from 'c'"):
        _ = a_from_b @ c_from_d


def test_a_product_has_the_stamp_that_both_share_or_the_only_one() -> None:
    def stamped(target: str, source: str, stamp: int | None) -> Transform:
        return Transform(target, source, (0, 0, 0), (0, 0, 0, 1), stamp)

    assert (stamped("a", "b", 5) @ stamped("b", "c", 5)).stamp == 5
    assert (stamped("a", "b", 0) @ stamped("b", "c", None)).stamp == 0
    assert (stamped("a", "b", 5) @ stamped("b", "c", 6)).stamp is None


def test_a_product_is_of_the_less_certain_kind() -> None:
    assert combine_kinds("static", "exact") == "exact"
    assert combine_kinds("exact", "interpolated") == "interpolated"
    assert combine_kinds("predicted", "interpolated", "static") == "predicted"
    exact = Transform("a", "b", (0, 0, 0), (0, 0, 0, 1), 5)
    predicted = Transform("b", "c", (0, 0, 0), (0, 0, 0, 1), 5, kind="predicted")
    assert (exact @ predicted).kind == "predicted"


def test_a_transform_without_stamp_is_static_and_with_stamp_exact() -> None:
    assert Transform("a", "b", (0, 0, 0), (0, 0, 0, 1)).kind == "static"
    assert Transform("a", "b", (0, 0, 0), (0, 0, 0, 1), 0).kind == "exact"


def test_the_constructors_agree_on_one_pose() -> None:
    # A yaw of a quarter turn.
    half = math.sqrt(0.5)
    matrix = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    expected = Transform("a", "b", (1, 2, 3), (0, 0, half, half), 7)
    for other in (
        Transform.from_matrix("a", "b", matrix, 7),
        Transform.from_pose7("a", "b", (1, 2, 3, 0, 0, half, half), 7),
        Transform.from_rpy("a", "b", (1, 2, 3), (0, 0, math.pi / 2), 7),
    ):
        assert_close(other, expected)
        np.testing.assert_allclose(other.rpy, (0, 0, math.pi / 2), atol=1e-15)
        np.testing.assert_allclose(other.pose7, (1, 2, 3, 0, 0, half, half), atol=1e-15)


def test_numpy_reads_a_transform_as_its_matrix() -> None:
    a_from_b, b_from_c = Transform("a", "b", (1, 2, 3), TURN, 7), Transform("b", "c", (0, -1, 0.5), TURN)
    np.testing.assert_array_equal(np.asarray(a_from_b), a_from_b.matrix)
    assert np.asarray(a_from_b, dtype=np.float32).dtype == np.float32
    np.testing.assert_array_equal(np.stack([a_from_b, b_from_c])[1], b_from_c.matrix)
    np.testing.assert_array_equal(np.asarray([a_from_b, b_from_c])[0], a_from_b.matrix)
    with pytest.raises(ValueError, match="read-only"):
        np.asarray(a_from_b)[0, 3] = 9.0
    own = np.array(a_from_b)
    own[0, 3] = 9.0
    assert a_from_b.translation[0] == 1.0
    with pytest.raises(ValueError, match="no array without a copy"):
        np.asarray(a_from_b, copy=False)


def test_a_transform_is_no_array_in_sums_products_and_points() -> None:
    a_from_b, b_from_c = Transform("a", "b", (1, 2, 3), TURN), Transform("b", "c", (0, -1, 0.5), TURN)
    for points in (b_from_c, [b_from_c, b_from_c]):
        with pytest.raises(InvalidInput, match="product of transforms"):
            a_from_b.apply(points)
    with pytest.raises(InvalidInput, match="points of shape"):
        _ = a_from_b @ [b_from_c]
    for operation in (np.add, np.matmul):
        with pytest.raises(TypeError):
            operation(np.eye(4), a_from_b)
    assert a_from_b != a_from_b.matrix


def test_a_placement_of_pinocchio_is_a_transform_and_back() -> None:
    pin = pytest.importorskip("pinocchio")
    o_m_i = pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 3.0), np.array([1.0, 2.0, 3.0]))
    o_from_i = Transform.from_se3("o", "i", o_m_i, 7)
    assert (o_from_i.target, o_from_i.source, o_from_i.stamp) == ("o", "i", 7)
    np.testing.assert_allclose(o_from_i.rpy, (0.1, -0.2, 3.0), atol=1e-15)
    point = np.array([0.5, 0.25, -2.0])
    np.testing.assert_allclose(o_from_i @ point, o_m_i.act(point), atol=1e-15)
    np.testing.assert_allclose(o_from_i.se3.homogeneous, o_m_i.homogeneous, atol=1e-15)
    assert (o_from_i.se3.inverse() * o_m_i).isIdentity(1e-14)
    with pytest.raises(InvalidInput, match=r"takes a pinocchio\.SE3; got ndarray: from_matrix takes arrays"):
        Transform.from_se3("o", "i", np.eye(4))


def test_without_pinocchio_the_error_names_the_command_that_installs_it(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    with pytest.raises(LibraryMissing, match="`pip install pin`"):
        _ = Transform("a", "b", (0, 0, 0), TURN).se3


def test_scipy_reads_and_writes_quaternions_in_the_same_order() -> None:
    rotation = pytest.importorskip("scipy.spatial.transform").Rotation
    transform = Transform.from_rpy("a", "b", (1, 2, 3), (0.1, -0.2, 3.0))
    scipys = rotation.from_quat(transform.rotation)
    np.testing.assert_allclose(scipys.as_matrix(), transform.matrix[:3, :3], atol=1e-15)
    np.testing.assert_allclose(scipys.as_euler("xyz"), transform.rpy, atol=1e-15)
    assert_close(Transform("a", "b", (1, 2, 3), scipys.as_quat()), transform)


@pytest.mark.parametrize("norm", [0.9991, 1.0, 1.0009])
def test_a_quaternion_within_a_thousandth_of_unit_length_is_normalised(norm: float) -> None:
    q = np.multiply(TURN, norm)
    np.testing.assert_allclose(Transform("a", "b", (0, 0, 0), q).rotation, TURN, atol=1e-15)


@pytest.mark.parametrize(
    ("norm", "length"), [(0.0, "0"), (0.9989, "0.9989"), (1.0011, "1.0011"), (2.0, "2"), (1e200, "inf")]
)
def test_a_quaternion_farther_from_unit_length_is_refused_with_its_length(norm: float, length: str) -> None:
    with pytest.raises(InvalidInput, match=f"the quaternion of 'a' from 'b' has length {length}, which"):
        Transform("a", "b", (0, 0, 0), np.multiply(TURN, norm))


@pytest.mark.parametrize("place", range(7))
@pytest.mark.parametrize("value", [NAN, INF, -INF])
def test_nan_and_infinity_are_refused_in_each_number(place: int, value: float) -> None:
    pose7 = [0.0, 0.0, 0.0, *TURN]
    pose7[place] = value
    with pytest.raises(InvalidInput, match="must be finite"):
        Transform.from_pose7("a", "b", pose7)


@pytest.mark.parametrize("pose7", [[0.0] * 6, [[0.0] * 7], "not a pose", ["x"] * 7, None])
def test_a_pose_that_is_not_seven_numbers_is_refused(pose7) -> None:
    with pytest.raises(InvalidInput):
        Transform.from_pose7("a", "b", pose7)


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(3),
        np.full((4, 4), NAN),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.diag([1.01, 1.0, 1.0, 1.0]),
        np.eye(4) + np.eye(4)[[3, 0, 1, 2]] * 1e-3,
    ],
)
def test_a_matrix_that_is_not_homogeneous_is_refused(matrix) -> None:
    with pytest.raises(InvalidInput):
        Transform.from_matrix("a", "b", matrix)


def test_invalid_shapes_stamps_and_kinds_are_refused() -> None:
    with pytest.raises(InvalidInput, match="shapes"):
        Transform("a", "b", (0, 0), (0, 0, 0, 1))
    with pytest.raises(InvalidInput, match="rpy"):
        Transform.from_rpy("a", "b", (0, 0, 0), (0, 0))
    with pytest.raises(InvalidInput, match="stamp"):
        Transform("a", "b", (0, 0, 0), (0, 0, 0, 1), 1.5)  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="'guessed'"):
        Transform("a", "b", (0, 0, 0), (0, 0, 0, 1), kind="guessed")  # type: ignore[arg-type]


def test_a_transform_cannot_be_changed_not_even_through_its_arrays() -> None:
    transform = Transform("a", "b", (1, 2, 3), TURN, 5)
    with pytest.raises(AttributeError, match="immutable"):
        transform.stamp = 6
    with pytest.raises(AttributeError, match="immutable"):
        del transform.stamp
    arrays = (
        transform.translation, transform.rotation, transform.pose7, transform.matrix, transform.rpy,
    )  # fmt: skip
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 9.0


def test_q_and_minus_q_are_equal() -> None:
    transform = Transform("a", "b", (1, 2, 3), TURN, 5)
    opposite = Transform("a", "b", (1, 2, 3), np.negative(TURN), 5)
    assert transform == opposite
    assert hash(transform) == hash(opposite)
    for other in (
        Transform("x", "b", (1, 2, 3), TURN, 5),
        Transform("a", "x", (1, 2, 3), TURN, 5),
        Transform("a", "b", (1, 2, 4), TURN, 5),
        Transform("a", "b", (1, 2, 3), (0, 0, 0, 1), 5),
        Transform("a", "b", (1, 2, 3), TURN),
        "something else",
    ):
        assert transform != other


def test_a_transform_reads_as_the_pose_of_one_frame_in_another() -> None:
    text = repr(Transform("world", "hand", (1, 2, 3), (0, 0, 0, 1), 1_500_000_000))
    assert text.startswith("<pose of hand in world at 1.500000000: xyz [1.0000, 2.0000, 3.0000] m")
    assert "-0.0000" not in repr(Transform("world", "hand", (-0.0, -1e-9, 3), (-0.0, -1e-12, 0, 1)))
    assert "at any time" in repr(Transform("world", "hand", (1, 2, 3), (0, 0, 0, 1)))


def test_a_transform_survives_json_and_pickle() -> None:
    transform = Transform("a", "b", (0.1, 0.2, 0.3), TURN, 1_790_000_000_123_456_789, kind="interpolated")
    for again in (
        Transform.from_dict(json.loads(json.dumps(transform.to_dict()))),
        pickle.loads(pickle.dumps(transform)),
    ):
        assert again == transform
        assert again.kind == "interpolated"
        assert again.covariance is None
    assert "covariance" not in transform.to_dict()
    with pytest.raises(InvalidInput, match="needs target"):
        Transform.from_dict({"source": "b"})


def test_covariance_survives_json() -> None:
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    transform = Transform("a", "b", (0.1, 0.2, 0.3), TURN, 5).with_covariance(covariance)
    again = Transform.from_dict(json.loads(json.dumps(transform.to_dict())))
    assert again == transform
    assert np.array_equal(again.covariance, covariance)
    with pytest.raises(InvalidInput, match=r"shape \(6, 6\)"):
        Transform.from_dict({**transform.to_dict(), "covariance": [1.0]})


def test_age_is_measured_by_the_clock_and_is_zero_if_static() -> None:
    clock = ManualClock(3_500_000_000)
    assert Transform("a", "b", (0, 0, 0), (0, 0, 0, 1), 1_000_000_000).age(clock) == 2.5
    assert Transform("a", "b", (0, 0, 0), (0, 0, 0, 1)).age(clock) == 0.0


def test_a_twist_names_its_frame_and_its_axes() -> None:
    twist = Twist("hand", "map", (1, 2, 3), (4, 5, 6), None)
    assert (twist.about, twist.expressed_in) == ("hand", "map")
    assert repr(twist).startswith("<twist of hand in map: linear [1.0000, 2.0000, 3.0000] m/s")
    with pytest.raises(ValueError, match="read-only"):
        twist.linear[0] = 9.0


def test_covariance_is_kept_and_cannot_be_written():
    covariance = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    covariance[0, 5] = covariance[5, 0] = 0.5
    transform = Transform("a", "b", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), 5)
    uncertain = transform.with_covariance(covariance)
    assert np.array_equal(uncertain.covariance, covariance)
    assert not uncertain.covariance.flags.writeable
    assert transform.covariance is None
    assert uncertain == transform
    copied = pickle.loads(pickle.dumps(uncertain))
    assert np.array_equal(copied.covariance, covariance)
    assert (copied.stamp, copied.kind) == (5, "exact")


@given(transforms("a", "b"), transforms("b", "c"), transforms("c", "d"))
def test_covariances_follow_the_algebra_of_their_transforms(
    a_from_b: Transform, b_from_c: Transform, c_from_d: Transform
) -> None:
    first, second = a_from_b.with_covariance(COVARIANCE), b_from_c.with_covariance(2.0 * COVARIANCE)
    for one, other in (
        (first, first.inverse().inverse()),
        ((first @ second).inverse(), second.inverse() @ first.inverse()),
        ((first @ second) @ c_from_d, first @ (second @ c_from_d)),  # c_from_d is static: exact
    ):
        assert one.covariance is not None
        assert other.covariance is not None
        # Arms of some hundred metres multiply each other, and cancel.
        scale = float(np.abs(one.covariance).max())
        np.testing.assert_allclose(one.covariance, other.covariance, atol=1e-9 * max(scale, 1e5))


def test_turn_about_an_arm_away_displaces_and_correlates():
    """c is 3 m from b, along y of a: a turn w of b about z of a moves c by -3 w along x of a."""
    turn = np.diag([0.0, 0.0, 0.0, 0.0, 0.0, 0.01])
    a_from_b = Transform("a", "b", (7.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)).with_covariance(turn)
    product = a_from_b @ Transform("b", "c", (0.0, 3.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    expected = turn.copy()
    expected[0, 0], expected[0, 5], expected[5, 0] = 0.09, -0.03, -0.03
    assert product.covariance is not None
    np.testing.assert_allclose(product.covariance, expected, atol=1e-15)


def test_covariance_of_a_product_is_unknown_if_that_of_a_moving_factor_is():
    moving = Transform("a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), 5)
    fixed = Transform("b", "c", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    assert (moving @ fixed.with_covariance(COVARIANCE)).covariance is None
    assert (moving @ fixed).covariance is None
    assert (fixed @ fixed.inverse()).covariance is None
    assert (moving.with_covariance(COVARIANCE) @ fixed).covariance is not None
    assert (moving.inverse()).covariance is None


@pytest.mark.parametrize(
    ("covariance", "match"),
    [
        (np.eye(3), r"shape \(6, 6\); got \(3, 3\)"),
        (np.full((6, 6), np.nan), "must be finite"),
        (np.triu(np.ones((6, 6))), "symmetric; got 1 in row 0, column 1, and 0"),
        (-np.eye(6), "no negative eigenvalue; got -1"),
        (np.eye(6) + 2 * np.eye(6)[::-1], "no negative eigenvalue; got -1"),
    ],
)
def test_matrix_that_is_no_covariance_is_refused(covariance, match):
    transform = Transform("a", "b", (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0))
    with pytest.raises(InvalidInput, match=match):
        transform.with_covariance(covariance)
