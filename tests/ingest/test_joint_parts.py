"""Drivers of one robot whose joints contradict each other, in every order of arrival: no network."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice, permutations

import pytest
from helpers.robots import RRBOT, STAMP

from zstate.buffer.buffer import TransformBuffer
from zstate.ingest.counters import Counters
from zstate.ingest.frame_ownership import FrameOwnership
from zstate.ingest.joint_parts import PartialJointStateIngest
from zstate.ingest.joint_states import JointStateIngest
from zstate.model.load import load_model
from zstate.wire.messages import JointState, RobotDescription, order_digest, to_block

FLOATING = load_model("""
<robot name="boat">
  <link name="sea"/> <link name="hull"/> <link name="rudder"/>
  <joint name="float" type="floating"> <parent link="sea"/> <child link="hull"/> </joint>
  <joint name="steer" type="continuous">
    <parent link="hull"/> <child link="rudder"/> <axis xyz="0 0 1"/>
  </joint>
</robot>""")
POSE = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0]
POSE_NAMES = tuple(f"float.{part}" for part in ("x", "y", "z", "qx", "qy", "qz", "qw"))


class Drivers:
    """The ingests of a robot and its drivers, by session."""

    def __init__(self, model=RRBOT, *, others: bool = False) -> None:
        self.model = model
        self.counters = Counters()
        self.ownership = FrameOwnership(TransformBuffer(1e6), self.counters)
        self.buffer = self.ownership.buffer
        self.whole = JointStateIngest("r1", self.ownership)
        self.parts: dict[int, PartialJointStateIngest] = {}
        self._others = others
        self._seq = 0

    def describe(self) -> None:
        description = RobotDescription(
            9, self.model.urdf, self.model.digest, self.model.joint_names, (), "system"
        )
        for ingest in (self.whole, *self.parts.values()):
            ingest.describe(description)

    def announce(self, session: int, since: int) -> None:
        self.ownership.live["r1", session] = f"driver {session}"
        self.whole.parts.add_writer(session, since)

    def leave(self, session: int) -> None:
        self.ownership.live.pop(("r1", session))
        self.whole.parts.remove_writer(session)

    def part(
        self, session: int, names: tuple[str, ...], numbers: list[float], rates: list[float] | None = None
    ) -> None:
        self.insert(self.state(session, names, numbers, rates))

    def insert(self, state: JointState) -> None:
        if state.session not in self.parts:
            self.parts[state.session] = PartialJointStateIngest(
                "r1", self.ownership, self.whole.parts, others=self._others
            )
        self.parts[state.session].insert_sample(state, overflowed=False)

    def all_joints(self, session: int, numbers: list[float]) -> None:
        state = self.state(session, self.model.joint_names, numbers)
        self.whole.insert_sample(state, overflowed=False)

    def state(self, session, names, numbers, rates=None) -> JointState:
        self._seq += 1
        block = None if rates is None else to_block(rates)
        head = (STAMP, self._seq, session, order_digest(names))
        return JointState(*head, to_block(numbers), block, None, names)

    def movers(self) -> dict[str, str | None]:
        children = {joint.child: joint.name for joint in self.model.driven_joints}
        frames = self.buffer.frames()
        return {
            children[name]: frame.writer
            for frame in frames
            if (name := frame.name.removeprefix("r1/")) in children
        }


def in_every_order(steps: Sequence[Callable[[Drivers], None]], every: int = 1) -> Iterator[Drivers]:
    """Drivers after ``steps``, in each of their orders, or in one of so many."""
    for order in islice(permutations(steps), 0, None, every):
        drivers = Drivers()
        for step in order:
            step(drivers)
        yield drivers


@pytest.mark.parametrize(
    "every",
    [
        pytest.param(11, id="459 of them"),  # divides no number of orders: each step is at each place
        pytest.param(1, marks=pytest.mark.soak, id="all 5,040"),
    ],
)
@pytest.mark.long
def test_newer_of_two_live_drivers_of_a_joint_counts_in_every_order_of_arrival(every: int):
    steps: list[Callable[[Drivers], None]] = [
        lambda drivers: drivers.announce(1, since=100),
        lambda drivers: drivers.announce(2, since=200),
        lambda drivers: drivers.announce(3, since=50),
        lambda drivers: drivers.part(1, ("shoulder", "elbow"), [0.1, 0.1]),
        lambda drivers: drivers.part(2, ("elbow",), [0.2]),
        lambda drivers: drivers.part(3, ("shoulder",), [0.3]),
        Drivers.describe,
    ]
    for drivers in in_every_order(steps, every):
        # Driver 2 started last. Driver 1, which lacks the elbow then, would be half a driver.
        assert drivers.movers() == {"shoulder": "driver 3", "elbow": "driver 2"}


@pytest.mark.parametrize(("since", "elbow"), [(50, "driver 2"), (300, "driver 1")])
def test_driver_of_all_joints_counts_by_its_start_too(since: int, elbow: str):
    steps: list[Callable[[Drivers], None]] = [
        lambda drivers: drivers.announce(1, since),
        lambda drivers: drivers.whole.name_writer(1, "driver 1"),
        lambda drivers: drivers.announce(2, since=200),
        lambda drivers: drivers.all_joints(1, [0.1, 0.1]),
        lambda drivers: drivers.part(2, ("elbow",), [0.2]),
        Drivers.describe,
    ]
    for drivers in in_every_order(steps):
        assert drivers.movers() == {"shoulder": "driver 1", "elbow": elbow}
        assert drivers.counters.stats().refused.keys() <= {"second writer"}


def test_joint_of_a_driver_that_left_goes_to_another_one():
    drivers = Drivers()
    drivers.describe()
    drivers.announce(1, since=100)
    drivers.part(1, ("shoulder", "elbow"), [0.1, 0.1])
    drivers.leave(1)
    drivers.announce(2, since=50)  # its clock is behind
    drivers.part(2, ("elbow",), [0.2])
    assert drivers.movers() == {"shoulder": "driver 1", "elbow": "driver 2"}
    positions, _ = drivers.buffer.joint_positions("r1", STAMP)
    assert positions == pytest.approx([0.1, 0.2])
    assert drivers.counters.stats().refused == {}


def test_refused_driver_is_counted_with_both_names_and_accepted_later():
    drivers = Drivers()
    drivers.describe()
    drivers.announce(1, since=100)
    drivers.announce(2, since=200)
    drivers.part(2, ("elbow",), [0.2])
    drivers.part(1, ("elbow",), [0.1])
    assert drivers.counters.stats().refused == {"second writer": 1}
    assert (
        "'elbow' is published by driver 2; refused: driver 1" in drivers.counters.refusals()["second writer"]
    )
    drivers.leave(2)
    drivers.part(1, ("elbow",), [0.3])
    assert drivers.movers()["elbow"] == "driver 1"
    assert drivers.counters.stats().received == 2


def test_samples_of_a_new_driver_count_before_its_announcement_if_the_former_one_has_left():
    drivers = Drivers()
    drivers.describe()
    drivers.announce(1, since=100)
    drivers.part(1, ("elbow",), [0.1])
    drivers.leave(1)
    drivers.part(2, ("elbow",), [0.2])
    drivers.part(3, ("shoulder",), [0.3])
    assert drivers.counters.stats().refused == {}
    positions, _ = drivers.buffer.joint_positions("r1", STAMP)
    assert positions == pytest.approx([0.3, 0.2])


def test_samples_that_arrive_before_the_tokens_of_a_handover_are_recalled():
    drivers = Drivers()
    drivers.describe()
    drivers.announce(1, since=100)
    drivers.part(1, ("elbow",), [0.1])
    early = [drivers.state(2, ("elbow",), [0.2]) for _ in range(3)]
    for state in early:
        drivers.insert(state)  # the first driver's token is still there
    assert drivers.counters.stats().refused == {"second writer": 3}
    drivers.leave(1)
    drivers.announce(2, since=200)
    drivers.parts[2].insert_history(early)
    assert drivers.counters.stats().recalled == 3
    assert drivers.movers()["elbow"] == "driver 2"


@pytest.mark.parametrize(
    ("names", "numbers", "reason"),
    [
        (("wrist",), [0.0], "unknown joints"),
        (("elbow", "wrist"), [0.0, 0.0], "unknown joints"),
        ((), [], "missing joints"),
        (("elbow",), [float("nan")], "bad numbers"),
    ],
)
def test_joints_that_cannot_be_used_are_counted_by_reason(names, numbers, reason):
    drivers = Drivers()
    drivers.describe()
    drivers.part(1, names, numbers)
    assert drivers.counters.stats().refused == {reason: 1}


def test_further_joints_are_left_out_where_a_topic_has_them():
    drivers = Drivers(others=True)
    drivers.describe()
    drivers.part(1, ("lid", "elbow"), [7.0, 0.25])
    drivers.part(1, ("elbow", "lid"), [0.5, 7.0])
    drivers.part(2, ("shoulder",), [1.0])
    positions, _ = drivers.buffer.joint_positions("r1")
    assert positions == pytest.approx([1.0, 0.5])


@pytest.mark.parametrize("is_announced", [True, False])
def test_fewer_joints_of_a_writer_are_refused_whether_it_is_announced_or_not(is_announced: bool):
    drivers = Drivers(others=True)
    drivers.describe()
    if is_announced:
        drivers.announce(1, since=1)
    drivers.part(1, ("shoulder", "elbow"), [0.5, 0.25])
    drivers.part(1, ("shoulder",), [0.0])
    assert drivers.counters.stats().refused == {"missing joints": 1}
    assert drivers.buffer.joint_positions("r1")[0] == pytest.approx([0.5, 0.25])


def test_writer_of_any_number_of_sets_of_joints_is_refused():
    links = "".join(f'<link name="l{n}"/>' for n in range(9))
    hinges = "".join(
        f'<joint name="j{n}" type="continuous"><parent link="l{n}"/><child link="l{n + 1}"/></joint>'
        for n in range(8)
    )
    drivers = Drivers(load_model(f'<robot name="chain">{links}{hinges}</robot>'))
    drivers.describe()
    joints = drivers.model.joint_names
    for count in range(1, 7):
        for first in range(3):
            names = joints[first : first + count]
            drivers.part(1, names, [0.0] * len(names))
    assert drivers.counters.stats().refused["too many sets of joints"] == 2


def test_coordinates_of_a_floating_joint_are_named_one_by_one():
    drivers = Drivers(FLOATING)
    drivers.describe()
    nan = float("nan")
    drivers.part(1, POSE_NAMES, POSE, [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, nan])
    drivers.part(1, POSE_NAMES[:-1], POSE[:-1])
    drivers.part(2, ("steer",), [0.5])
    assert drivers.counters.stats().refused == {"missing joints": 1}
    samples = drivers.buffer.joint_states("r1")
    assert samples.positions.tolist() == [[*POSE, 0.5]]
    assert samples.velocities is not None
    assert samples.velocities[0, :6].tolist() == [0.1, 0.2, 0.3, 0.4, 0.5, 0.6]
