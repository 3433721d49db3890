"""What holds at an instant of a recording."""

from __future__ import annotations

from live import RRBOT
from tales import START, pose

from zstate.record.transcript import Said, Speaker
from zstate.replaying.standing import Standing
from zstate.wire.messages import JointState, RobotDescription, StaticTransforms, order_digest, to_block


def fixed(edges: dict[tuple[str, str], list[float]], writer: str | None = "camera") -> Said:
    speaker = Speaker("arm", "tf_static", 1, writer, None, foreign=writer is None)
    return Said(speaker, StaticTransforms(1, tuple(edges), to_block(list(edges.values()))), START)


def described(urdf: str) -> Said:
    speaker = Speaker("arm", "robot_description", 1, None, None, foreign=False)
    return Said(speaker, RobotDescription(1, urdf, "", (), ()), START)


def test_a_repetition_says_nothing_new():
    standing = Standing()
    lens = fixed({("tool", "lens"): pose(1.0)})
    assert standing.take(lens) == lens
    assert standing.take(lens) is None
    moved = fixed({("tool", "lens"): pose(2.0)})
    assert standing.take(moved) == moved
    assert standing.statics == (moved,)


def test_each_writer_stands_for_itself():
    standing = Standing()
    one, other = fixed({("tool", "lens"): pose()}), fixed({("tool", "tip"): pose()}, "tip")
    standing.take(one)
    standing.take(other)
    assert standing.statics == (one, other)


def test_static_edges_of_a_bag_add_up():
    standing = Standing()
    standing.take(fixed({("a", "b"): pose(1.0)}, None))
    standing.take(fixed({("a", "c"): pose(2.0)}, None))
    standing.take(fixed({("a", "b"): pose(3.0)}, None))
    (said,) = standing.statics
    assert isinstance(said.message, StaticTransforms)
    assert said.message.edges == (("a", "b"), ("a", "c"))
    assert said.message.poses == to_block([pose(3.0), pose(2.0)])


def test_another_description_takes_the_place_of_the_first():
    standing = Standing()
    first, again, second = described(RRBOT.urdf), described(RRBOT.urdf), described("<robot name='x'/>")
    assert standing.take(first) == first
    assert standing.take(again) is None
    assert standing.take(second) == second
    assert standing.descriptions == {"arm": second}


def test_samples_do_not_stand():
    speaker = Speaker("arm", "joint_states", 1, None, None, foreign=False)
    state = JointState(START, 0, 1, order_digest(()), b"")
    assert Standing().take(Said(speaker, state, START)) is None
