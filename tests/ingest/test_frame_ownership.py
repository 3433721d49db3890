"""Whose edge counts: the model's, the robot's own writers', then those of others, in any order of arrival."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import permutations

import pytest
from helpers.robots import RRBOT

from zstate.buffer.buffer import TransformBuffer
from zstate.errors import InsertRefused
from zstate.ingest.base import StreamIngest
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_states import JointStateIngest
from zstate.ingest.transforms import StaticTransformIngest, TransformIngest
from zstate.model.kinematics import Kinematics
from zstate.model.load import load_model
from zstate.transform import Transform
from zstate.wire.keys import MODEL_WRITER
from zstate.wire.messages import RobotDescription, StaticTransforms, TransformSample, order_digest, to_block

Edge = tuple[str, str]
Step = Callable[["Network"], object]

MOVING = tuple((joint.parent, joint.child) for joint in RRBOT.joints if joint.type != "fixed")
FIXED = tuple((joint.parent, joint.child) for joint in RRBOT.joints if joint.type == "fixed")
OWN = {(f"r1/{joint.parent}", f"r1/{joint.child}") for joint in RRBOT.joints}
AT_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
SHORTER = load_model(RRBOT.urdf.replace('name="tool"', 'name="hand"').replace('link="tool"', 'link="hand"'))


class Network:
    """What a listener receives, handed over directly, and what its buffer holds."""

    def __init__(
        self, follow: type[StreamIngest] = JointStateIngest, placers: Sequence[str] | None = None
    ) -> None:
        self.conflicts: list[tuple[str, str, str]] = []
        self.ownership = FrameOwnership(
            TransformBuffer(),
            Counters(),
            placers=placers,
            on_conflict=lambda _, source, refusal: self.conflicts.append(
                (source.robot, source.name, refusal.edge[1])
            ),
        )
        self.buffer = self.ownership.buffer
        self._follow = follow
        self._followers: dict[str, StreamIngest] = {}
        self._writers: dict[tuple[str, str], StaticTransformIngest] = {}
        self._seq = 0

    def ingest(self, robot: str) -> StreamIngest:
        if robot not in self._followers:
            self.ownership.add_robot(robot)
            self._followers[robot] = self._follow(robot, self.ownership)
        return self._followers[robot]

    def model(self, robot: str = "r1", model=RRBOT) -> None:
        """The description, and with ready transforms also fixed edges and a sample."""
        ingest = self.ingest(robot)
        moving = tuple((joint.parent, joint.child) for joint in model.joints if joint.type != "fixed")
        ingest.describe(RobotDescription(1, model.urdf, model.digest, model.joint_names, moving))
        if isinstance(ingest, TransformIngest):
            self.statics(robot, MODEL_WRITER, *FIXED)
            self.sample(robot)

    def sample(self, robot: str, session: int = 7, edges: Sequence[Edge] | None = None) -> None:
        self._seq += 1
        named = None if edges is None else tuple(edges)
        poses = to_block([AT_ORIGIN] * len(named or MOVING))
        order = order_digest(named or MOVING)
        self.ingest(robot).insert_sample(
            TransformSample(self._seq, self._seq, session, order, poses, named), overflowed=False
        )

    def writer(self, robot: str, name: str) -> StaticTransformIngest:
        self.ownership.add_robot(robot)
        make = StaticTransformIngest(robot, name, self.ownership, is_model=name == MODEL_WRITER)
        return self._writers.setdefault((robot, name), make)

    def statics(self, robot: str, name: str, *edges: Edge, session: int = 3) -> None:
        poses = to_block([AT_ORIGIN] * len(edges))
        self.writer(robot, name).replace(StaticTransforms(session, edges, poses))

    @property
    def edges(self) -> set[Edge]:
        return {(frame.parent, frame.name) for frame in self.buffer.frames() if frame.parent is not None}

    @property
    def refused(self) -> dict[str, int]:
        return self.ownership.counters.stats().refused


def set_statics(robot: str, name: str, *edges: Edge) -> Step:
    return lambda network: network.statics(robot, name, *edges)


def in_every_order(*steps: Step, follow: type[StreamIngest] = JointStateIngest) -> list[Network]:
    networks = [Network(follow) for _ in permutations(steps)]
    for network, order in zip(networks, permutations(steps), strict=True):
        for step in order:
            step(network)
    return networks


FOLLOWS = pytest.mark.parametrize("follow", [JointStateIngest, TransformIngest])


@FOLLOWS
@pytest.mark.parametrize(
    ("wrong", "right", "refused"),
    [
        ([set_statics("r1", "wrong", ("tool", "world"))], set(), "r1/world"),
        ([set_statics("r1", "wrong", ("tool", "base"))], set(), "r1/base"),
        ([set_statics("r1", "wrong", ("map", "upper"))], set(), "r1/upper"),
        (
            [set_statics("r1", "wrong", ("upper", "base"), ("base", "cart"))],
            {("r1/base", "r1/cart")},
            "r1/base",
        ),
        (
            [set_statics("r1", "mount", ("tool", "jig")), set_statics("r1", "wrong", ("jig", "world"))],
            {("r1/tool", "r1/jig")},
            "r1/world",
        ),
        (
            [set_statics("r1", "both", ("jig", "world"), ("tool", "plate"), ("plate", "jig"))],
            {("r1/tool", "r1/plate"), ("r1/plate", "r1/jig")},
            "r1/world",
        ),
        (
            [
                set_statics("r1", "wrong", ("tool", "world")),
                set_statics("r1", "room", ("fleet/map", "world")),
            ],
            {("fleet/map", "r1/world")},
            "r1/world",
        ),
    ],
)
def test_model_wins_over_conflicting_static_edges_in_every_order(
    follow, wrong: list[Step], right: set[Edge], refused: str
):
    """Each order refuses the wrong edge, whose child is ``refused``."""
    for network in in_every_order(lambda network: network.model(), *wrong, follow=follow):
        assert network.edges == OWN | right
        assert sum(network.refused.values()) >= 1
        assert set(network.refused) <= {"loop", "second parent", "second writer"}
        (texts,) = {tuple(sorted(network.ownership.counters.refusals()))}
        assert texts
        assert all("static edge of" in text for text in network.ownership.counters.refusals().values())
        assert {child for _, name, child in network.conflicts if name in {"wrong", "both"}} == {refused}


@FOLLOWS
def test_refusal_names_the_writer_and_the_loop(follow):
    for network in in_every_order(
        lambda network: network.model(), set_statics("r1", "mistake", ("lower", "world")), follow=follow
    ):
        assert network.refused == {"loop": 1}
        text = network.ownership.counters.refusals()["loop"]
        assert text.startswith("static edge of 'mistake': 'r1/lower' -> 'r1/world' by mistake would close")
        assert network.conflicts == [("r1", "mistake", "r1/world")]


def test_corrected_or_withdrawn_edge_leaves_no_refusal():
    for network in in_every_order(
        lambda network: network.model(), set_statics("r1", "one", ("tool", "world"))
    ):
        network.statics("r1", "one", ("tool", "world"))
        assert network.refused == {"loop": 2}
        network.statics("r1", "one", ("map", "world"))
        assert network.edges == OWN | {("r1/map", "r1/world")}
        network.writer("r1", "one").withdraw()
        assert network.edges == OWN
        assert network.refused == {"loop": 2}


def test_refused_edge_is_accepted_when_a_new_model_allows_it():
    for network in in_every_order(lambda network: network.model(), set_statics("r1", "one", ("map", "tool"))):
        assert network.edges == OWN
        network.model(model=SHORTER)
        assert ("r1/map", "r1/tool") in network.edges
        network.model()
        assert network.edges == OWN


def test_edge_inserted_by_the_caller_yields_to_the_model():
    network = Network()
    network.buffer.insert_static(Transform("r1/tool", "r1/world", (0, 0, 0), (0, 0, 0, 1)))
    network.buffer.insert(Transform("r1/map", "r1/upper", (0, 0, 0), (0, 0, 0, 1), 5))
    network.model()
    assert network.edges == OWN
    assert network.refused == {"loop": 1, "second writer": 1}


def test_circular_placement_of_model_roots_is_accepted_except_one_edge():
    steps = (
        lambda network: network.model("r1"),
        lambda network: network.model("r2"),
        set_statics("r1", "one", ("r2/tool", "world")),
        set_statics("r2", "one", ("r1/tool", "world")),
    )
    for network in in_every_order(*steps):
        across = {edge for edge in network.edges if edge[0][:2] != edge[1][:2]}
        assert len(across) == 1
        assert len(network.edges) == 2 * len(OWN) + 1
        assert network.refused == {"loop": 1}


@FOLLOWS
def test_own_writers_of_a_robot_win_over_others_in_every_order(follow):
    steps = (
        set_statics("r1", "mount", ("base", "camera")),
        set_statics("r2", "thief", ("r2/map", "r1/camera")),
        lambda network: network.model(),
    )
    for order, network in zip(
        permutations(("mount", "thief", "model")), in_every_order(*steps, follow=follow), strict=True
    ):
        assert network.edges == OWN | {("r1/base", "r1/camera")}
        assert network.refused == {"foreign frame": 1}
        text = network.ownership.counters.refusals()["foreign frame"]
        # Until the model and the own edge of the frame are known, any writer may place it.
        if order[-1] == "mount":
            assert "'r1/camera' is a frame of robot 'r1', but not its root" in text
        else:
            assert "'r1/camera' is placed on 'r1/base' by robot 'r1' itself (mount)" in text
        assert network.conflicts == [("r2", "thief", "r1/camera")]
        network.statics("r1", "mount")
        assert network.edges == OWN  # it is no root of r1


@FOLLOWS
def test_other_writers_may_place_only_the_root_of_a_robot(follow):
    steps = (
        set_statics("r2", "thief", ("x", "r1/camera"), ("y", "r1/world")),
        lambda network: network.model("r1"),
        lambda network: network.sample("r2", edges=[("x", "r1/gripper")]),
    )
    for network in in_every_order(*steps, follow=follow):
        assert network.edges == OWN | {("r2/y", "r1/world")}
        assert set(network.refused) == {"foreign frame"}
        text = network.ownership.counters.refusals()["foreign frame"]
        assert "is a frame of robot 'r1', but not its root" in text


def test_robot_that_places_nothing_yet_may_be_placed_by_any_frame():
    network = Network()
    network.ownership.add_robot("r1")
    network.statics("r2", "site", ("map", "r1/laser"))
    assert network.edges == {("r2/map", "r1/laser")}
    network.statics("r1", "mount", ("base", "camera"))
    assert network.edges == {("r1/base", "r1/camera")}
    network.statics("r1", "mount", ("laser", "mirror"))
    assert network.edges == {("r2/map", "r1/laser"), ("r1/laser", "r1/mirror")}


def test_robots_own_frames_are_compared_with_every_remaining_edge_after_another_was_withdrawn():
    network = Network()
    network.ownership.add_robot("r1")
    network.statics("r2", "site", ("map", "r1/laser"))
    network.statics("r3", "shelf", ("map", "r1/lamp"))
    network.writer("r3", "shelf").withdraw()
    network.statics("r1", "mount", ("base", "camera"))
    assert network.edges == {("r1/base", "r1/camera")}
    assert network.refused == {"foreign frame": 1}


def test_other_writers_may_place_the_root_in_their_frames_and_in_unowned_ones():
    for network in in_every_order(
        set_statics("cell", "site", ("map", "r1/world")),
        set_statics("cell", "site 2", ("fleet/map", "r2/world")),
        lambda network: network.model("r1"),
        lambda network: network.model("r2"),
    ):
        assert {("cell/map", "r1/world"), ("fleet/map", "r2/world")} < network.edges
        assert network.refused == {}


def test_root_is_placed_before_the_fixed_edges_of_its_model_arrive_and_after_they_left():
    moving = RobotDescription(1, RRBOT.urdf, RRBOT.digest, RRBOT.joint_names, MOVING)

    def sample(network: Network) -> None:
        network.ingest("r1").describe(moving)
        network.sample("r1")

    steps = (
        sample,
        set_statics("r1", MODEL_WRITER, *FIXED),
        set_statics("cell", "site", ("map", "r1/world")),
    )
    for network in in_every_order(*steps, follow=TransformIngest):
        assert network.edges == OWN | {("cell/map", "r1/world")}
        network.writer("r1", MODEL_WRITER).withdraw()
        assert ("cell/map", "r1/world") in network.edges
        assert (network.refused, network.conflicts) == ({}, [])


def test_other_frames_than_the_root_are_refused_once_the_model_is_complete():
    root, stray = (
        set_statics("cell", "site", ("map", "r1/base")),
        set_statics("cell", "thief", ("map", "r1/x")),
    )
    moving = RobotDescription(1, "", "", (), MOVING)
    for fixed in ((), FIXED):
        network = Network(TransformIngest)
        network.ingest("r1").describe(moving)
        network.sample("r1")
        stray(network)
        assert ("cell/map", "r1/x") in network.edges
        assert network.refused == {}
        network.statics("r1", MODEL_WRITER, *fixed)
        assert ("cell/map", "r1/x") not in network.edges
        assert network.refused == {"foreign frame": 1}
        root(network)
        assert (("cell/map", "r1/base") in network.edges) == (not fixed)


@pytest.mark.parametrize("parent", ["r1/base", "r3/base"])
def test_other_writers_cannot_place_frames_of_a_robot_in_a_third_robots_frames(parent: str):
    steps = (
        set_statics("r2", "thief", (parent, "r1/marker")),
        lambda network: network.ownership.add_robot("r1"),
        lambda network: network.ownership.add_robot("r3"),
    )
    for network in in_every_order(*steps):
        assert network.edges == set()
        assert network.refused == {"foreign frame": 1}
        assert "(--robot r1)" in network.ownership.counters.refusals()["foreign frame"]


def test_unowned_frames_may_be_placed_by_every_writer_until_a_robot_owns_them():
    network = Network()
    network.statics("r1", "one", ("map", "fleet/map"))
    network.statics("r2", "two", ("fleet/map", "fleet/dock"))
    assert network.edges == {("r1/map", "fleet/map"), ("fleet/map", "fleet/dock")}
    network.ownership.add_robot("fleet")
    assert network.edges == {("r1/map", "fleet/map")}


def test_only_placers_may_place_roots_of_other_robots():
    network = Network(placers=["site"])
    network.model()
    network.statics("r2", "thief", ("r2/map", "r1/world"))
    assert network.refused == {"foreign frame": 1}
    assert "not among the placers ('site')" in network.ownership.counters.refusals()["foreign frame"]
    network.statics("site", "map", ("site/map", "r1/world"))
    assert network.edges == OWN | {("site/map", "r1/world")}


def test_only_placers_may_place_a_robot_that_is_not_known_yet():
    """A reader that joins knows some robots before others."""
    network = Network(placers=["site"])
    network.statics("r2", "thief", ("r2/map", "r1/world"))
    assert network.refused == {"foreign frame": 1}
    network.statics("site", "map", ("site/map", "r1/world"))
    assert network.edges == {("site/map", "r1/world")}
    network.statics("r2", "mast", ("map", "mast"))
    assert network.edges == {("site/map", "r1/world"), ("r2/map", "r2/mast")}


def test_static_writers_of_one_name_and_two_robots_are_separate():
    network = Network()
    network.statics("r1", "calib", ("fleet/map", "fleet/board"))
    network.statics("r2", "calib", ("fleet/map", "fleet/board"))
    network.writer("r1", "calib").withdraw()
    assert network.edges == {("fleet/map", "fleet/board")}
    network.writer("r2", "calib").withdraw()
    assert network.edges == set()


def test_departed_static_writer_yields_to_an_announced_one():
    network = Network()
    network.statics("r1", "old", ("base", "camera"), session=3)
    network.statics("r1", "new", ("tool", "camera"), session=4)
    assert network.edges == {("r1/base", "r1/camera")}
    network.ownership.remove_writer("r1", 3)
    assert network.edges == {("r1/tool", "r1/camera")}
    network.ownership.add_writer("r1", 3)
    network.statics("r1", "old", ("base", "camera"), session=3)
    assert network.edges == {("r1/base", "r1/camera")}


def test_edge_of_a_departed_writer_stays_also_if_an_earlier_departed_one_placed_the_frame_elsewhere():
    network = Network()
    network.statics("r1", "old", ("base", "camera"), session=3)
    network.statics("r1", "new", ("tool", "camera"), session=4)
    network.ownership.remove_writer("r1", 3)
    network.ownership.remove_writer("r1", 4)
    assert network.edges == {("r1/tool", "r1/camera")}


def test_transforms_of_another_robot_neither_insert_nor_drop_edges_of_this_one():
    network = Network(TransformIngest)
    network.ownership.live |= {("r1", 7): "driver@arm pid 4", ("r2", 8): "driver@arm pid 4"}
    network.ingest("r1").name_writer(7, "driver@arm pid 4")
    network.ingest("r2").name_writer(8, "driver@arm pid 4")
    network.model("r1")
    before = network.edges
    stolen = [("r1/upper", "r1/lower"), ("r2/base", "r1/tool"), ("r2/base", "arm")]
    for _ in range(3):
        network.sample("r2", 8, stolen)
        network.sample("r1", 7)
    assert network.edges == before | {("r2/base", "r2/arm")}
    assert network.refused == {"foreign frame": 3}
    assert len(Kinematics(RRBOT).edges) == len(before)
    lower = next(frame for frame in network.buffer.frames() if frame.name == "r1/lower")
    assert lower.count == 4


@pytest.mark.parametrize("own_first", [True, False])
def test_moving_root_placed_by_others_yields_to_the_robots_own_edge(own_first: bool):
    network = Network(TransformIngest)

    def own() -> None:
        network.sample("r1", 7, [("map", "odom")])

    def foreign() -> None:
        network.sample("site", 8, [("site/map", "r1/odom"), ("site/map", "dock")])

    for step in (own, foreign) if own_first else (foreign, own):
        step()
    foreign()
    assert network.edges == {("r1/map", "r1/odom"), ("site/map", "site/dock")}
    network.ingest("r1")._drop_history()
    foreign()
    assert network.edges == {("site/map", "r1/odom"), ("site/map", "site/dock")}


def test_description_that_names_frames_of_another_robot_gets_none_of_them():
    network = Network(TransformIngest)
    network.model("r1")
    moving = (("r1/base", "r1/upper"), ("base", "arm"))
    network.ingest("r2").describe(RobotDescription(1, "", "", (), moving))
    order = order_digest(moving)
    poses = to_block([AT_ORIGIN] * 2)
    network.ingest("r2").insert_sample(TransformSample(1, 0, 8, order, poses), overflowed=False)
    assert ("r2/base", "r2/arm") in network.edges
    assert network.refused == {"foreign frame": 1}


def test_bare_name_with_a_slash_gives_no_access_to_frames_of_another_robot():
    network = Network()
    slashed = load_model(RRBOT.urdf.replace('"upper"', '"x/y"'))
    network.model("r1", slashed)
    before = network.edges
    network.statics("r2", "thief", ("r2/map", "x/y"))
    assert network.edges == before | {("r2/map", "x/y")}


def test_unpublished_edges_in_the_buffer_remain():
    network = Network()
    network.buffer.insert_static(Transform("a/x", "a/y", (0, 0, 0), (0, 0, 0, 1)))
    network.statics("a", "one", ("z", "y"))
    assert network.refused == {"second parent": 1}
    with pytest.raises(InsertRefused):
        network.buffer.insert_static(Transform("a/y", "a/x", (0, 0, 0), (0, 0, 0, 1)))
