import pytest
from helpers.robots import RRBOT

from zstate.buffer.buffer import TransformBuffer
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.transforms import StaticTransformIngest
from zstate.wire.messages import StaticTransforms, to_block


class StaticIngests:
    """Static writers of one robot on one buffer."""

    def __init__(self) -> None:
        self.buffer, self.counters = TransformBuffer(), Counters()
        self.ownership = FrameOwnership(self.buffer, self.counters)

    def writer(self, name: str) -> StaticTransformIngest:
        return StaticTransformIngest("r1", name, self.ownership)

    def edges(self) -> dict[str, tuple[str, str | None]]:
        return {f.name: (f.parent, f.writer) for f in self.buffer.frames() if f.parent is not None}


@pytest.fixture
def ingests() -> StaticIngests:
    return StaticIngests()


def statics(
    *edges: tuple[str, str], pose=(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), session: int = 3
) -> StaticTransforms:
    return StaticTransforms(session, edges, to_block([pose] * len(edges)))


def test_buffer_holds_exactly_the_edges_that_the_writer_publishes_now(ingests: StaticIngests):
    mount = ingests.writer("mount")
    mount.replace(statics(("tool", "camera"), ("camera", "lens")))
    mount.replace(statics(("tool", "camera"), ("tool", "laser")))
    assert ingests.edges() == {"r1/camera": ("r1/tool", "mount"), "r1/laser": ("r1/tool", "mount")}
    mount.replace(statics())
    assert ingests.edges() == {}


def test_one_message_may_reparent_a_child_and_invert_an_edge(ingests: StaticIngests):
    mount = ingests.writer("mount")
    mount.replace(statics(("tool", "camera"), ("tool", "laser")))
    mount.replace(statics(("camera", "tool"), ("base", "laser")))
    assert ingests.edges() == {"r1/tool": ("r1/camera", "mount"), "r1/laser": ("r1/base", "mount")}
    assert ingests.counters.stats().refused == {}


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
def test_impossible_edge_is_counted_and_the_others_are_inserted(
    ingests: StaticIngests, bad, pose, reason: str
):
    ingests.writer("mount").replace(statics(("tool", "camera")))
    ingests.writer("bad").replace(statics(bad, pose=pose))
    ingests.writer("good").replace(statics(("tool", "laser")))
    assert ingests.counters.stats().refused == {reason: 1}
    assert ingests.edges() == {"r1/camera": ("r1/tool", "mount"), "r1/laser": ("r1/tool", "good")}


def test_writer_withdraws_only_edges_it_still_owns(ingests: StaticIngests):
    old, new = ingests.writer("old"), ingests.writer("new")
    old.replace(statics(("tool", "camera"), ("tool", "laser")))
    new.replace(statics(("tool", "camera")))
    old.withdraw()
    assert ingests.edges() == {"r1/camera": ("r1/tool", "new")}
    new.withdraw()
    new.withdraw()
    assert ingests.edges() == {}


def test_full_name_may_belong_to_another_robot(ingests: StaticIngests):
    ingests.writer("site").replace(statics(("fleet/map", "odom")))
    assert ingests.edges() == {"r1/odom": ("fleet/map", "site")}


def xs(ingests: StaticIngests) -> dict[str, float]:
    statics = [frame for frame in ingests.buffer.frames() if frame.kind == "static"]
    return {f.name: ingests.buffer.lookup(f.parent or "", f.name).translation[0] for f in statics}


def at(x: float) -> tuple[float, ...]:
    return (x, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def test_ros_static_edges_accumulate_and_the_newest_pose_of_any_writer_is_used(ingests: StaticIngests):
    one, other = ingests.writer("one"), ingests.writer("other")
    one.add(statics(("tool", "camera"), pose=at(1.0)))
    one.add(statics(("tool", "laser"), pose=at(2.0)))
    other.add(statics(("tool", "camera"), pose=at(3.0)))
    assert xs(ingests) == {"r1/camera": 3.0, "r1/laser": 2.0}
    one.add(statics(("tool", "camera"), pose=at(4.0)))
    assert xs(ingests) == {"r1/camera": 4.0, "r1/laser": 2.0}
    assert ingests.counters.stats().refused == {}


def test_ros_writer_may_reparent_its_child(ingests: StaticIngests):
    mount = ingests.writer("mount")
    mount.add(statics(("tool", "camera"), ("camera", "lens")))
    mount.add(statics(("base", "camera")))
    assert ingests.edges() == {"r1/camera": ("r1/base", "mount"), "r1/lens": ("r1/camera", "mount")}
    assert ingests.counters.stats().refused == {}


def test_ros_child_of_another_writer_is_moved_only_after_that_writer_left(ingests: StaticIngests):
    old, new = ingests.writer("old"), ingests.writer("new")
    old.add(statics(("tool", "camera"), ("tool", "laser"), session=3))
    new.add(statics(("base", "camera"), session=4))
    assert ingests.counters.stats().refused == {"second parent": 1}
    ingests.ownership.remove_writer("r1", 3)
    assert ingests.edges() == {"r1/camera": ("r1/base", "new"), "r1/laser": ("r1/tool", "old")}
    assert ingests.counters.stats().refused == {"second parent": 2}


def test_late_writer_name_is_set_on_edges_it_still_owns(ingests: StaticIngests):
    one, other = ingests.writer("a ROS node 1"), ingests.writer("a ROS node 2")
    one.add(statics(("tool", "camera"), ("tool", "laser"), pose=at(1.0)))
    other.add(statics(("tool", "camera"), pose=at(2.0)))
    one.name_writer("/one")
    assert ingests.edges() == {"r1/camera": ("r1/tool", "a ROS node 2"), "r1/laser": ("r1/tool", "/one")}
    other.name_writer("/other")
    assert ingests.edges()["r1/camera"] == ("r1/tool", "/other")
    assert xs(ingests) == {"r1/camera": 2.0, "r1/laser": 1.0}


FIXED = [joint for joint in RRBOT.joints if joint.type == "fixed"]


def own_edges(turned: float = 1.0) -> StaticTransforms:
    poses = [[*joint.origin[:3], *(turned * number for number in joint.origin[3:])] for joint in FIXED]
    return StaticTransforms(3, tuple((j.parent, j.child) for j in FIXED), to_block(poses))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ros_edges_that_repeat_the_model_are_neither_inserted_nor_counted(
    ingests: StaticIngests, sign: float
):
    ingests.buffer.add_robot(RRBOT, "r1")
    before = ingests.edges()
    ingests.writer("rsp").add(own_edges(sign))
    assert ingests.edges() == before
    assert ingests.counters.stats().refused == {}


@pytest.mark.parametrize(
    ("edge", "reason"),
    [
        (("world", "base"), "second writer"),
        (("base", "upper"), "second writer"),
        (("cart", "base"), "second parent"),
    ],
)
def test_static_edge_that_contradicts_the_model_is_counted_and_refused(
    ingests: StaticIngests, edge, reason: str
):
    ingests.buffer.add_robot(RRBOT, "r1")
    before = ingests.edges()
    ingests.writer("wrong").add(statics(edge, pose=at(9.0)))
    assert ingests.edges() == before
    assert ingests.counters.stats().refused == {reason: 1}
