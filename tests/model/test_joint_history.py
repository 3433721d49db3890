"""Trajectories: rows selected, joined by stamp, and completed by columns of NaN."""

from __future__ import annotations

import numpy as np

from zstate.model.joint_history import JointHistory, concatenate


def of(stamps: list[int], first: float = 0.0, efforts: bool = False) -> JointHistory:
    """One joint; row i is ``first + i``, with efforts of ten times that."""
    positions = np.arange(first, first + len(stamps))[:, None]
    names = ("lift",)
    block = 10 * positions if efforts else None
    return JointHistory(names, names, names, np.array(stamps, dtype=np.int64), positions, None, block)


def test_parts_are_joined_in_order_of_stamps_and_the_later_of_two_equal_ones_counts():
    joined = concatenate((of([10, 20, 30]), of([20, 40], first=5.0), of([15], first=9.0)))
    assert joined.stamps.tolist() == [10, 15, 20, 30, 40]
    assert joined.positions.tolist() == [[0.0], [9.0], [5.0], [2.0], [6.0]]
    assert joined.velocities is joined.efforts is None


def test_blocks_of_some_parts_are_nan_in_the_rows_of_the_others():
    joined = concatenate((of([1, 2]), of([3], first=4.0, efforts=True)))
    assert joined.kinds == {"effort"}
    np.testing.assert_array_equal(joined.efforts, [[np.nan], [np.nan], [40.0]])


def test_requested_kinds_are_added_as_nan_and_known_ones_kept():
    both = of([1, 2], efforts=True).with_kinds({"velocity", "effort"})
    assert np.isnan(both.velocities).all()
    assert both.efforts.tolist() == [[0.0], [10.0]]
    assert of([1]).with_kinds(set()).kinds == set()


def test_length_duration_and_text_describe_the_rows():
    trajectory = of([1_000_000_000, 3_500_000_000], efforts=True)
    assert len(trajectory) == 2
    assert trajectory.duration_s == 2.5
    assert repr(trajectory) == "<JointHistory of 1 joints: 2 samples in 2.500 s>"
    assert trajectory.select(slice(1, None)).efforts.tolist() == [[10.0]]
    assert len(trajectory.select(slice(0))) == trajectory.select(slice(0)).duration_s == 0
