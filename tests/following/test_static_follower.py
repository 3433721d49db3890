import pytest

from zstate.buffer.buffer import TransformBuffer
from zstate.following.statics import StaticFollower
from zstate.following.tally import Tally
from zstate.wire.messages import StaticTransforms, to_block


class Following:
    """Static writers of one robot on one buffer."""

    def __init__(self) -> None:
        self.buffer, self.tally = TransformBuffer(), Tally()

    def writer(self, name: str) -> StaticFollower:
        return StaticFollower("r1", name, self.buffer, self.tally)

    def edges(self) -> dict[str, tuple[str, str | None]]:
        return {f.name: (f.parent, f.writer) for f in self.buffer.frames() if f.parent is not None}


@pytest.fixture
def following() -> Following:
    return Following()


def statics(*edges: tuple[str, str], pose=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) -> StaticTransforms:
    return StaticTransforms(3, edges, to_block([pose] * len(edges)))


def test_the_buffer_holds_what_the_writer_says_now_no_more_and_no_less(following: Following):
    mount = following.writer("mount")
    mount.replace(statics(("tool", "camera"), ("camera", "lens")))
    mount.replace(statics(("tool", "camera"), ("tool", "laser")))
    assert following.edges() == {"r1/camera": ("r1/tool", "mount"), "r1/laser": ("r1/tool", "mount")}
    mount.replace(statics())
    assert following.edges() == {}


def test_one_message_may_move_a_child_to_another_parent_and_turn_an_edge_round(following: Following):
    mount = following.writer("mount")
    mount.replace(statics(("tool", "camera"), ("tool", "laser")))
    mount.replace(statics(("camera", "tool"), ("base", "laser")))
    assert following.edges() == {"r1/tool": ("r1/camera", "mount"), "r1/laser": ("r1/base", "mount")}
    assert following.tally.stats().refused == {}


@pytest.mark.parametrize(
    ("bad", "pose", "reason"),
    [
        (("tool", "tool"), (0, 0, 0, 0, 0, 0, 1), "self edge"),
        (("camera", "tool"), (0, 0, 0, 0, 0, 0, 1), "loop"),
        (("base", "camera"), (0, 0, 0, 0, 0, 0, 1), "second parent"),
        (("tool", "/lens"), (0, 0, 0, 0, 0, 0, 1), "frame name"),
        (("tool", ""), (0, 0, 0, 0, 0, 0, 1), "frame name"),
        (("tool", "lens"), (float("nan"), 0, 0, 0, 0, 0, 1), "bad numbers"),
        (("tool", "lens"), (0, 0, 0, 0, 0, 0, 0.5), "bad numbers"),
        (("tool", "lens"), (0, 0, 0, 0, 0, 0, 0), "bad numbers"),
    ],
)
def test_an_impossible_edge_is_counted_and_the_others_are_taken(following: Following, bad, pose, reason: str):
    following.writer("mount").replace(statics(("tool", "camera")))
    following.writer("bad").replace(statics(bad, pose=pose))
    following.writer("good").replace(statics(("tool", "laser")))
    assert following.tally.stats().refused == {reason: 1}
    assert following.edges() == {"r1/camera": ("r1/tool", "mount"), "r1/laser": ("r1/tool", "good")}


def test_a_writer_withdraws_only_what_is_still_its_own(following: Following):
    old, new = following.writer("old"), following.writer("new")
    old.replace(statics(("tool", "camera"), ("tool", "laser")))
    new.replace(statics(("tool", "camera")))
    old.withdraw()
    assert following.edges() == {"r1/camera": ("r1/tool", "new")}
    new.withdraw()
    new.withdraw()
    assert following.edges() == {}


def test_a_full_name_may_belong_to_another_robot(following: Following):
    following.writer("site").replace(statics(("fleet/map", "odom")))
    assert following.edges() == {"r1/odom": ("fleet/map", "site")}
