"""What holds at an instant of a recording."""

from __future__ import annotations

from helpers.recording_builder import START, pose
from helpers.robots import RRBOT

from zstate.recording.decode import DecodedMessage, LatchedState, RecordedWriter
from zstate.wire.messages import JointState, RobotDescription, StaticTransforms, order_digest, to_block


def fixed(edges: dict[tuple[str, str], list[float]], writer: str | None = "camera") -> DecodedMessage:
    recorded = RecordedWriter("arm", "tf_static", 1, writer, None, foreign=writer is None)
    return DecodedMessage(recorded, StaticTransforms(1, tuple(edges), to_block(list(edges.values()))), START)


def described(urdf: str) -> DecodedMessage:
    recorded = RecordedWriter("arm", "robot_description", 1, None, None, foreign=False)
    return DecodedMessage(recorded, RobotDescription(1, urdf, "", (), ()), START)


def test_repeated_value_does_not_change_the_state():
    standing = LatchedState()
    lens = fixed({("tool", "lens"): pose(1.0)})
    assert standing.update(lens) == lens
    assert standing.update(lens) is None
    moved = fixed({("tool", "lens"): pose(2.0)})
    assert standing.update(moved) == moved
    assert standing.statics == (moved,)


def test_each_writer_has_its_own_latched_value():
    standing = LatchedState()
    one, other = fixed({("tool", "lens"): pose()}), fixed({("tool", "tip"): pose()}, "tip")
    standing.update(one)
    standing.update(other)
    assert standing.statics == (one, other)


def test_static_edges_of_a_bag_add_up():
    standing = LatchedState()
    standing.update(fixed({("a", "b"): pose(1.0)}, None))
    standing.update(fixed({("a", "c"): pose(2.0)}, None))
    standing.update(fixed({("a", "b"): pose(3.0)}, None))
    (decoded,) = standing.statics
    assert isinstance(decoded.message, StaticTransforms)
    assert decoded.message.edges == (("a", "b"), ("a", "c"))
    assert decoded.message.poses == to_block([pose(3.0), pose(2.0)])


def test_new_description_replaces_the_previous_one():
    standing = LatchedState()
    first, again, second = described(RRBOT.urdf), described(RRBOT.urdf), described("<robot name='x'/>")
    assert standing.update(first) == first
    assert standing.update(again) is None
    assert standing.update(second) == second
    assert standing.descriptions == {"arm": second}


def test_samples_are_not_latched():
    recorded = RecordedWriter("arm", "joint_states", 1, None, None, foreign=False)
    state = JointState(START, 0, 1, order_digest(()), b"")
    assert LatchedState().update(DecodedMessage(recorded, state, START)) is None
