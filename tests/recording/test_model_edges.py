"""What is left of transforms when models place their links themselves."""

from __future__ import annotations

import numpy as np
from helpers.recording_builder import START, pose
from helpers.robots import RRBOT

from zstate.recording.model_edges import ModelEdgeFilter
from zstate.wire.messages import (
    Edges,
    StaticTransforms,
    TransformSample,
    WriterTransforms,
    covariances_of,
    order_digest,
    poses_from_block,
    to_block,
)


def sample(edges: Edges) -> TransformSample:
    block = to_block([pose(x=n) for n in range(len(edges))])
    return TransformSample(START, 4, 5, order_digest(edges), block, edges)


def rrbot_filter(robot: str = "arm") -> ModelEdgeFilter:
    model_filter = ModelEdgeFilter()
    model_filter.set_model(robot, RRBOT)
    return model_filter


def test_only_edges_outside_the_model_remain():
    message = sample((("base", "upper"), ("odom", "world"), ("tool", "lens")))
    rest = rrbot_filter().filter_sample("arm", message)
    assert rest is not None
    assert rest.edges == (("odom", "world"), ("tool", "lens"))
    assert poses_from_block(rest.poses)[:, 0].tolist() == [1.0, 2.0]
    assert (rest.stamp, rest.seq, rest.session) == (START, 4, 5)


def test_covariances_of_the_remaining_edges_remain():
    edges = (("base", "upper"), ("odom", "world"), ("tool", "lens"))
    poses, covariances = to_block([pose()] * 3), np.arange(3 * 21.0).reshape(3, 21)
    message = WriterTransforms(START, 4, 5, order_digest(edges), poses, edges, to_block(covariances))
    rest = rrbot_filter().filter_sample("arm", message)
    assert rest is not None
    assert np.array_equal(covariances_of(rest), covariances[1:])


def test_sample_of_model_edges_only_is_removed():
    assert rrbot_filter().filter_sample("arm", sample((("base", "upper"),))) is None
    assert rrbot_filter().filter_sample("arm", sample(())) is None


def test_unchanged_sample_is_returned_as_the_same_object():
    message = sample((("odom", "world"),))
    assert rrbot_filter().filter_sample("arm", message) is message


def test_links_are_recognised_by_their_full_names():
    message = sample((("arm/base", "arm/upper"), ("leg/base", "leg/upper")))
    rest = rrbot_filter().filter_sample("ros", message)
    assert rest is not None
    assert rest.edges == (("leg/base", "leg/upper"),)


def test_link_of_another_robot_with_the_same_name_remains():
    message = sample((("base", "upper"),))
    assert rrbot_filter().filter_sample("leg", message) is message


def test_invalid_names_remain_for_the_ingest_to_refuse():
    message = sample((("a", "/b"), ("a", "")))
    assert rrbot_filter().filter_sample("arm", message) is message


def test_static_edges_are_filtered_likewise():
    edges = (("world", "base"), ("tool", "lens"))
    statics = StaticTransforms(7, edges, to_block([pose(1.0), pose(2.0)]))
    rest = rrbot_filter().filter_statics("arm", statics)
    assert (rest.session, rest.edges) == (7, (("tool", "lens"),))
    assert np.array_equal(poses_from_block(rest.poses), [pose(2.0)])


def test_replaced_model_is_no_longer_filtered():
    model_filter = rrbot_filter()
    message = sample((("odom", "lens"), ("base", "upper")))
    assert model_filter.filter_sample("arm", message) is not None
    model_filter.set_model("arm", RRBOT)
    rest = model_filter.filter_sample("arm", message)
    assert rest is not None
    assert rest.edges == (("odom", "lens"),)
