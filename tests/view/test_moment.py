"""A moment places every frame in any other that known edges join it to."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zstate.errors import UnknownFrame
from zstate.transform import Transform
from zstate.view.moment import Moment, Tree

QUARTER = np.sqrt(0.5)
AHEAD = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
AHEAD_AND_LEFT = (1.0, 0.0, 0.0, 0.0, 0.0, QUARTER, QUARTER)
STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def tree_of(*parents: int) -> Tree:
    names = tuple(f"f{row}" for row in range(len(parents)))
    kinds = tuple("root" if parent < 0 else "pose" for parent in parents)
    return Tree(names, np.array(parents, dtype=np.intp), kinds, (None,) * len(parents))


def moment_of(tree: Tree, poses: object, *unknown: int) -> Moment:
    known = np.ones(len(tree.names), dtype=np.bool_)
    known[list(unknown)] = False
    return Moment(5, tree, np.array(poses, dtype=np.float64), known)


def test_each_frame_goes_on_from_its_parent():
    moment = moment_of(tree_of(-1, 0, 1), [STILL, AHEAD_AND_LEFT, AHEAD])
    # One ahead and turned left; the next is one ahead of that, so one to the left.
    assert moment.placed("f0")[2] == pytest.approx((1.0, 1.0, 0.0, 0.0, 0.0, QUARTER, QUARTER))
    assert moment.placed("f0")[0] == pytest.approx(STILL)


def test_a_chosen_frame_is_where_everything_is_measured_from():
    moment = moment_of(tree_of(-1, 0, 1), [STILL, AHEAD_AND_LEFT, AHEAD])
    assert moment.placed("f2")[2] == pytest.approx(STILL)
    assert moment.placed("f2")[1, :3] == pytest.approx((-1.0, 0.0, 0.0))
    assert moment.placed("f2")[0, :3] == pytest.approx((-1.0, 1.0, 0.0))


def test_frames_under_another_root_have_no_place():
    placed = moment_of(tree_of(-1, 0, -1, 2), [STILL, AHEAD, STILL, AHEAD]).placed("f1")
    assert np.isnan(placed[2:]).all()
    assert not np.isnan(placed[:2]).any()


def test_an_edge_without_a_pose_cuts_the_tree_there_and_nowhere_else():
    moment = moment_of(tree_of(-1, 0, 1, 0), [STILL, STILL, AHEAD, AHEAD], 1)
    assert np.isnan(moment.placed("f0")[[1, 2]]).all()
    assert moment.placed("f0")[3, :3] == pytest.approx((1.0, 0.0, 0.0))
    assert moment.placed("f1")[2, :3] == pytest.approx((1.0, 0.0, 0.0))


def test_a_frame_that_nobody_named_is_an_error_with_its_near_misses():
    with pytest.raises(UnknownFrame) as caught:
        moment_of(tree_of(-1, 0), [STILL, AHEAD]).placed("f01")
    assert "f1" in caught.value.near_misses


@given(st.integers(0, 2**32 - 1), st.integers(1, 40))
def test_any_tree_is_placed_as_its_edges_multiplied_one_by_one(seed: int, size: int):
    rng = np.random.default_rng(seed)
    parents = [int(rng.integers(-1, row)) for row in range(size)]
    numbers = rng.normal(size=(size, 7))
    numbers[:, 3:] /= np.linalg.norm(numbers[:, 3:], axis=1)[:, None]
    numbers[[row for row, parent in enumerate(parents) if parent < 0]] = STILL
    moment = moment_of(tree_of(*parents), numbers)
    fixed = int(rng.integers(size))
    matrices: list[np.ndarray] = []
    for row, parent in enumerate(parents):
        own = Transform.from_pose7("a", "b", numbers[row]).matrix
        matrices.append(own if parent < 0 else matrices[parent] @ own)
    roots = moment.tree.roots
    for row, placed in enumerate(moment.placed(f"f{fixed}")):
        if roots[row] != roots[fixed]:
            assert np.isnan(placed).all()
        else:
            expected = np.linalg.inv(matrices[fixed]) @ matrices[row]
            np.testing.assert_allclose(Transform.from_pose7("a", "b", placed).matrix, expected, atol=1e-9)
