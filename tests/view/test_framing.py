"""A camera is put where it sees all robots."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from zstate.view.framing import FIELD_OF_VIEW, framing_of
from zstate.view.moment import Moment, Tree


def moment_of(*frames: tuple[str, tuple[float, float, float]]) -> Moment:
    """Frames that all stand on the first."""
    names = tuple(name for name, _ in frames)
    poses = np.array([[*place, 0.0, 0.0, 0.0, 1.0] for _, place in frames])
    parents = np.array([-1] + [0] * (len(frames) - 1), dtype=np.intp)
    tree = Tree(names, parents, ("root",) + ("static",) * (len(frames) - 1), (None,) * len(frames))
    return Moment(None, tree, poses, np.ones(len(frames), dtype=np.bool_))


coordinates = st.floats(-20.0, 20.0)
places = st.tuples(coordinates, coordinates, coordinates)


@given(st.lists(places, min_size=1, max_size=12))
def test_every_frame_of_a_robot_is_in_the_picture(points: list[tuple[float, float, float]]):
    origin = ("a/root", (0.0, 0.0, 0.0))
    moment = moment_of(origin, *((f"a/l{n}", point) for n, point in enumerate(points)))
    framing = framing_of(moment, moment.placed("a/root"))
    assert framing is not None
    view = np.subtract(framing.look_at, framing.position)
    for point in [(0.0, 0.0, 0.0), *points]:
        ray = np.subtract(point, framing.position)
        angle = math.acos(np.clip(view @ ray / np.linalg.norm(view) / np.linalg.norm(ray), -1.0, 1.0))
        assert angle < 0.5 * FIELD_OF_VIEW


def test_it_looks_from_in_front_and_above():
    moment = moment_of(("a/root", (0.0, 0.0, 0.0)), ("a/tip", (0.0, 0.0, 1.0)))
    framing = framing_of(moment, moment.placed("a/root"))
    assert framing is not None
    assert framing.look_at == (0.0, 0.0, 0.5)
    assert framing.position[0] > 0.0
    assert framing.position[2] > 0.5


def test_the_floor_is_where_a_robot_stands_that_is_placed_by_its_hip():
    walker = moment_of(("a/hip", (0.0, 0.0, 0.0)), ("a/foot", (0.0, 0.0, -1.0)))
    arm = moment_of(("a/base", (0.0, 0.0, 0.0)), ("a/tip", (0.0, 0.0, 1.0)))
    framings = [framing_of(walker, walker.placed("a/hip")), framing_of(arm, arm.placed("a/base"))]
    assert [framing.floor for framing in framings if framing] == [-1.0, 0.0]


def test_the_floor_goes_beyond_every_robot():
    moment = moment_of(("a/root", (0.0, 0.0, 0.0)), ("b/root", (0.0, -7.5, 0.0)))
    framing = framing_of(moment, moment.placed("a/root"))
    assert framing is not None
    assert framing.reach > 8


def test_a_map_that_begins_far_away_does_not_make_the_robot_small():
    frames = (("a/root", (100.0, 0.0, 0.0)), ("a/tip", (100.0, 0.0, 1.0)))
    far = moment_of(("map", (0.0, 0.0, 0.0)), *frames)
    framing = framing_of(far, far.placed("map"))
    assert framing is not None
    assert np.linalg.norm(np.subtract(framing.position, framing.look_at)) < 5.0


def test_there_is_nothing_to_look_at_where_no_robot_has_a_place():
    moment = moment_of(("map", (0.0, 0.0, 0.0)))
    assert framing_of(moment, np.full((1, 7), np.nan)) is None
