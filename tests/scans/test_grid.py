"""Grid: which cell is under a point, its image, and what is refused."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate import InvalidInput, Transform
from zstate.scans import Grid

# Rows from the corner upwards: the first is that of the smallest y.
CELLS = np.array([[0, 10, 20], [30, 40, -1]], dtype=np.int8)
YAW = 0.7


def grid(**changes: Any) -> Grid:
    return Grid(**{"cells": CELLS, "resolution": 0.5, "origin": (1.0, 2.0, 0.0), **changes})


def test_columns_are_along_x_and_rows_along_y():
    points = [[1.25, 2.25], [1.75, 2.25], [2.25, 2.25], [1.25, 2.75], [1.75, 2.75], [2.25, 2.75]]
    assert grid().at(points).tolist() == [0, 10, 20, 30, 40, -1]


def test_a_cell_contains_its_lower_edges_and_not_its_upper_ones():
    assert grid().at([[1.0, 2.0], [1.5, 2.0], [1.0, 2.5]]).tolist() == [0, 10, 30]
    assert grid(cells=np.zeros((2, 3), np.int8)).at([[2.5, 2.0], [1.0, 3.0]]).tolist() == [-1, -1]


def test_outside_is_unknown_however_far():
    known = grid(cells=np.zeros((2, 3), np.int8))
    points = [[0.99, 2.2], [1.2, 1.99], [1e300, 2.2], [1.2, -1e300], [math.inf, 2.2], [math.nan, 2.2]]
    assert known.at(points).tolist() == [-1] * 6


def test_no_points_have_no_values():
    assert grid().at(np.empty((0, 3))).shape == (0,)


def test_z_of_a_point_does_not_matter_on_a_level_grid():
    assert grid().at([[1.75, 2.25, 9.0], [1.75, 2.25, -9.0]]).tolist() == [10, 10]


@given(st.floats(-math.tau, math.tau), st.integers(0, 1), st.integers(0, 2))
def test_the_yaw_turns_the_grid_about_its_corner(yaw: float, row: int, column: int):
    along_x, along_y = 0.5 * (column + 0.5), 0.5 * (row + 0.5)
    x = 1.0 + math.cos(yaw) * along_x - math.sin(yaw) * along_y
    y = 2.0 + math.sin(yaw) * along_x + math.cos(yaw) * along_y
    assert grid(origin=(1.0, 2.0, yaw)).at([[x, y]]).tolist() == [CELLS[row, column]]


def test_an_origin_is_a_transform_or_its_numbers():
    half = 0.5 * YAW
    origins = [
        (1.0, 2.0, YAW),
        (1.0, 2.0, 0.0, 0.0, 0.0, math.sin(half), math.cos(half)),
        Transform.from_rpy("map", "somewhere", (1.0, 2.0, 0.0), (0.0, 0.0, YAW)),
    ]
    poses = [grid(origin=origin).origin for origin in origins]
    assert [pose.target for pose in poses] == ["map"] * 3
    for pose in poses:
        np.testing.assert_allclose(pose.translation, (1.0, 2.0, 0.0))
        np.testing.assert_allclose(pose.rpy, (0.0, 0.0, YAW), atol=1e-15)


def test_the_size_is_in_metres():
    assert grid().size == (1.5, 1.0)


def test_the_image_has_its_top_row_first_and_transparent_unknown_cells():
    image = grid(cells=[[0, 100, 20], [30, 40, -1]]).to_image()
    assert image.shape == (2, 3, 4)
    assert image.dtype == np.uint8
    # 255 (100 - value) / 100: 178.5 for 30 rounds to even.
    assert image[1].tolist() == [[255, 255, 255, 255], [0, 0, 0, 255], [204, 204, 204, 255]]
    assert image[0].tolist() == [[178, 178, 178, 255], [153, 153, 153, 255], [128, 128, 128, 0]]


def test_cells_are_a_read_only_copy():
    cells = CELLS.astype(np.int64)
    one = grid(cells=cells)
    cells[:] = 0
    assert one.cells.dtype == np.int8
    assert one.cells.tolist() == CELLS.tolist()
    with pytest.raises(ValueError, match="read-only"):
        one.cells[0, 0] = 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        one.resolution = 1.0  # type: ignore[misc]


def test_the_repr_is_short():
    assert repr(grid()) == "<Grid of 3 x 2 cells of 0.5 m in 'map'>"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": [0, 1]}, r"shape \(height, width\), both 1 or more; got \(2,\)"),
        ({"cells": np.zeros((0, 3), np.int8)}, r"got \(0, 3\)"),
        ({"cells": [[0.5]]}, "integers, -1 or 0 to 100; got an array of float64"),
        ({"cells": [[0, 0], [101, 0]]}, r"cell \(1, 0\) is 101"),
        ({"cells": [[-2]]}, r"cell \(0, 0\) is -2"),
        ({"resolution": 0.0}, "finite and above zero; got 0.0"),
        ({"resolution": math.nan}, "got nan"),
        ({"resolution": [0.1, 0.1]}, "side of a cell"),
        ({"origin": (0.0, 0.0)}, r"got an array of shape \(2,\)"),
        ({"origin": (0.0, 0.0, 90.0)}, "angles in radians"),
        ({"origin": (0.0, math.inf, 0.0)}, "must be finite"),
        ({"origin": Transform("odom", "c", (0, 0, 0), (0, 0, 0, 1))}, "a pose in 'map'; got one in 'odom'"),
        ({"frame": "/map"}, "begins with a slash"),
        ({"stamp": 1.0}, "a stamp is a 64-bit integer"),
    ],
)
def test_what_is_no_grid_is_refused_with_the_reason(changes: dict[str, Any], message: str):
    with pytest.raises(InvalidInput, match=message):
        grid(**changes)


@pytest.mark.parametrize("shape", [(2,), (2, 4), (1, 2, 3)])
def test_points_of_other_shapes_are_refused(shape: tuple[int, ...]):
    with pytest.raises(InvalidInput, match="points in a grid"):
        grid().at(np.zeros(shape))
