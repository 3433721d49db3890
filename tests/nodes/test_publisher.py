import logging
import subprocess
import sys
import threading
from functools import partial

import numpy as np
import pytest
from helpers.matrix_kinematics import matrices
from helpers.processes import DEADLINE_S, until
from helpers.robots import RRBOT, STAMP, SampleCollector, wait_for_reader

from zstate.clock import ManualClock
from zstate.errors import Closed, InvalidInput
from zstate.model.kinematics import Kinematics, MovingEdges
from zstate.model.load import load_model
from zstate.model.pinocchio_solver import select_engine
from zstate.net.discovery import discover
from zstate.net.session import connect
from zstate.nodes import moving_edges
from zstate.nodes.partial_publisher import PartialStatePublisher
from zstate.nodes.publisher import STREAMS, StatePublisher
from zstate.nodes.publisher_status import StreamStats
from zstate.wire.messages import TransformSample, from_block, poses_from_block
from zstate.wire.native import decode, encoding_of

NAN, INF = float("nan"), float("inf")
JOINTS, TF = "zstate/r1/joint_states", "zstate/r1/tf"
# Numbers that no shorter form has: each must arrive with its last bit.
POSITIONS = [0.1 + 0.2, -1.0 / 3.0]
VELOCITIES = [5e-324, 1.2345678901234567e150]
EFFORTS = [-0.0, 2.0**-1022]
DRONE = load_model(
    '<robot name="drone"><link name="map"/><link name="body"/><link name="eye"/>'
    '<joint name="free" type="floating"><parent link="map"/><child link="body"/></joint>'
    '<joint name="fix" type="fixed"><parent link="body"/><child link="eye"/></joint></robot>'
)


def test_every_number_arrives_bit_for_bit(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_reader(writer, JOINTS)
        publisher.publish(POSITIONS, VELOCITIES, EFFORTS, STAMP)
        publisher.publish(np.array(POSITIONS), stamp=np.int64(-STAMP))
    full, bare = tap.joint_states(2)
    assert [full.positions, full.velocities, full.efforts] == [
        np.array(numbers).tobytes() for numbers in (POSITIONS, VELOCITIES, EFFORTS)
    ]
    assert (full.stamp, bare.stamp) == (STAMP, -STAMP)
    assert (bare.positions, bare.velocities, bare.efforts) == (full.positions, None, None)
    assert (bare.session, bare.seq) == (full.session, full.seq + 1)


def test_positions_may_be_given_by_name_in_any_order(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_reader(writer, JOINTS)
        publisher.publish({"elbow": 2.0, "shoulder": 1.0})
    assert from_block(tap.joint_states(1)[0].positions).tolist() == [1.0, 2.0]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (([1.0],), r"takes 2 positions, shape \(2,\).*got shape \(1,\)"),
        (([[1.0, 2.0]],), r"got shape \(1, 2\)"),
        ((["a", "b"],), "must be real numbers"),
        (([0.0, NAN],), r"must be finite; not so: 'elbow' \(nan\)"),
        (([-INF, 0.0],), r"'shoulder' \(-inf\)"),
        (({"elbow": 1.0},), "missing: 'shoulder'"),
        (({"elbow": 1.0, "shoulder": 1.0, "elbov": 1.0},), "unknown joint 'elbov'; did you mean 'elbow'"),
        (({"elbow": 1.0, "shoulder": 1.0, "lower_to_tool": 1.0},), "'lower_to_tool' is fixed"),
        (({"elbow": NAN, "shoulder": 1.0},), "must be finite"),
        (([0.0, 0.0], [1.0]), "takes 2 velocities"),
        (([0.0, 0.0], [1.0, NAN]), "velocities .* must be finite"),
        (([0.0, 0.0], None, [1.0, 2.0, 3.0]), "takes 2 efforts"),
        (([0.0, 0.0], None, None, 1.5), r"integer count of nanoseconds.*not 1\.5"),
        (([0.0, 0.0], None, None, 2**63), "64-bit"),
    ],
)
def test_refused_sample_is_not_sent_and_leaves_no_gap(sessions, arguments, text: str):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_reader(writer, JOINTS)
        publisher.publish([0.0, 0.0], stamp=1)
        with pytest.raises(InvalidInput, match=text):
            publisher.publish(*arguments)
        publisher.publish([0.0, 0.0], stamp=2)
    assert [(state.stamp, state.seq) for state in tap.joint_states(2)] == [(1, 0), (2, 1)]


def test_floating_joint_without_a_unit_quaternion_is_refused_on_every_stream(sessions):
    writer, reader = sessions
    taps = [SampleCollector(reader, JOINTS), SampleCollector(reader, TF)]
    with StatePublisher(writer, DRONE, "r1") as publisher:
        for key in (JOINTS, TF):
            wait_for_reader(writer, key)
        with pytest.raises(InvalidInput, match=r"quaternion of length 0\.5"):
            publisher.publish([0, 0, 0, 0, 0, 0, 0.5])
        publisher.publish([0, 0, 0, 0, 0, 0, 1.0])
        assert [len(tap.payloads(1)) for tap in taps] == [1, 1]


def test_both_streams_carry_the_same_instant_and_agree_with_kinematics(sessions):
    writer, reader = sessions
    model = load_model("gripper")
    joints, transforms = SampleCollector(reader, JOINTS), SampleCollector(reader, TF)
    with StatePublisher(writer, model, "r1") as publisher:
        for key in (JOINTS, TF):
            wait_for_reader(writer, key)
        publisher.publish([0.03, 0.4], stamp=STAMP)
        named = publisher.description().moving_edges
    state = joints.joint_states(1)[0]
    sample = decode(transforms.payloads(1)[0], encoding_of(TransformSample), TransformSample)
    assert (sample.stamp, sample.seq, sample.session) == (state.stamp, state.seq, state.session)
    kinematics = Kinematics(model)
    edges = dict(zip(kinematics.edges, kinematics.edge_poses([0.03, 0.4]), strict=True))
    moving = [(joint.parent, joint.child) for joint in model.joints if joint.type != "fixed"]
    assert list(named) == moving
    expected = matrices(np.array([edges[edge] for edge in moving]))
    assert np.allclose(matrices(poses_from_block(sample.poses)), expected, rtol=0.0, atol=1e-15)


def test_moving_and_fixed_edges_are_separate_and_complete(sessions):
    with StatePublisher(sessions[0], RRBOT) as publisher:
        description, statics = publisher.description(), publisher.statics()
    edges = dict(zip(statics.edges, poses_from_block(statics.poses).tolist(), strict=True))
    assert edges == {(j.parent, j.child): list(j.origin) for j in RRBOT.joints if j.type == "fixed"}
    assert {*edges, *description.moving_edges} == set(Kinematics(RRBOT).edges)
    assert (description.urdf, description.digest) == (RRBOT.urdf, RRBOT.digest)
    assert description.joint_names == RRBOT.joint_names


def test_transforms_are_computed_and_sent_only_while_they_have_a_reader(sessions, monkeypatch):
    computed = []
    poses = MovingEdges.poses
    monkeypatch.setattr(MovingEdges, "poses", lambda *given: computed.append(given) or poses(*given))
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        computed.clear()  # those of the comparison at opening

        def transform_stats() -> StreamStats:
            return publisher.stats.streams["native", "tf"]

        publisher.publish([0.0, 0.0], stamp=1)
        assert computed == []
        transforms = SampleCollector(reader, TF)
        # A second observer learns of readers a moment later than the first.
        until(lambda: publisher.publish([0.0, 0.0], stamp=2) or transforms.arrivals)
        first = decode(transforms.payloads(1)[0], encoding_of(TransformSample), TransformSample)
        assert (first.stamp, first.seq) == (2, transform_stats().suppressed)
        transforms.close()
        until(lambda: publisher.publish([0.0, 0.0], stamp=3) or transform_stats().suppressed > first.seq)
        assert len(computed) == transform_stats().samples


def test_stamp_is_the_time_of_the_clock_by_default(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1", clock=ManualClock(STAMP)) as publisher:
        wait_for_reader(writer, JOINTS)
        publisher.publish([0.0, 0.0])
        publisher.publish([0.0, 0.0], stamp=0)
    assert [state.stamp for state in tap.joint_states(2)] == [STAMP, 0]


def test_closed_publisher_raises_closed_and_closes_twice(sessions):
    publisher = StatePublisher(sessions[0], RRBOT, "r1")
    publisher.close()
    publisher.close()
    with pytest.raises(Closed, match="publisher of 'r1' is closed"):
        publisher.publish([0.0, 0.0])


def test_publisher_of_a_closed_session_raises_closed():
    with connect() as session:
        publisher = StatePublisher(session, RRBOT)
    with pytest.raises(Closed, match="session is closed"):
        publisher.publish([0.0, 0.0])
    publisher.close()


@pytest.mark.parametrize("name", ["a/b", "a b", "*", "a$", "@a", "r?", "r#1", "tab\t"])
def test_invalid_robot_name_is_refused(sessions, name: str):
    with pytest.raises(InvalidInput, match=r"robot name .* one chunk of a Zenoh key"):
        StatePublisher(sessions[0], RRBOT, name)


def test_unknown_wire_and_stream_errors_list_the_known_ones(sessions):
    with pytest.raises(InvalidInput, match="no wire 'dds'; known: 'native'"):
        StatePublisher(sessions[0], RRBOT, wires=["native", "dds"])
    with pytest.raises(InvalidInput, match="'joints' is not one of the streams 'joint_states', 'tf'"):
        StatePublisher(sessions[0], RRBOT, streams=["joints"])  # type: ignore[list-item]
    assert discover(sessions[1], timeout_s=0.3) == ()


@pytest.mark.parametrize("streams", [STREAMS, ("joint_states",), ("tf", "tf_static", "robot_description")])
def test_publisher_announces_the_streams_it_writes_until_it_closes(sessions, streams):
    writer, reader = sessions
    with StatePublisher(writer, RRBOT, "r1", streams=streams):
        until(lambda: discover(reader))
        (robot,) = discover(reader)
        assert robot.name == "r1"
        assert {stream for stream, _ in robot.writers} == set(streams)
        assert len({identity for _, identity in robot.writers}) == 1
    until(lambda: discover(reader, timeout_s=0.3) == ())


def test_robot_without_moving_joints_can_be_published(sessions):
    writer, reader = sessions
    model = load_model('<robot name="stone"><link name="only"/></robot>')
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, model, "r1") as publisher:
        wait_for_reader(writer, JOINTS)
        publisher.publish([], stamp=3)
    assert tap.joint_states(1)[0].positions == b""


def test_samples_of_several_threads_are_numbered_without_a_gap(sessions):
    writer, reader = sessions
    tap = SampleCollector(reader, JOINTS)
    with StatePublisher(writer, RRBOT, "r1") as publisher:
        wait_for_reader(writer, JOINTS)

        def send() -> None:
            for _ in range(50):
                publisher.publish([0.0, 0.0])

        threads = [threading.Thread(target=send) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert [state.seq for state in tap.joint_states(200)] == list(range(200))


ARM = load_model(
    '<robot name="arm"><link name="base"/><link name="tip"/>'
    '<joint name="lift" type="revolute"><parent link="base"/><child link="tip"/><axis xyz="0 0 1"/>'
    '<limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>'
)


def test_positions_outside_limits_are_published_counted_and_logged_once(sessions, caplog):
    tap = SampleCollector(sessions[1], JOINTS)
    with caplog.at_level(logging.WARNING, "zstate"), StatePublisher(sessions[0], ARM, "r1") as publisher:
        wait_for_reader(sessions[0], JOINTS)
        for number in range(200):
            # Every second sample is in degrees; one second holds all but the first and the last.
            publisher.publish([45.0 * (number % 2)], stamp=STAMP + number * 1_000_000)
        publisher.publish([45.0], stamp=STAMP + 2_000_000_000)
        stats = publisher.stats
        assert len(tap.payloads(201)) == 201
    text = "'lift' at 45.0 rad is outside -2 to 2; this looks like degrees: convert with math.radians"
    assert (stats.sent, stats.outside_limits, stats.last_excess) == (201, 101, text)
    assert [record.getMessage() for record in caplog.records] == [
        f"r1: {text}; further samples outside limits are only counted"
    ]
    tap.close()


def test_first_sample_outside_limits_is_logged_at_once(sessions, caplog):
    with caplog.at_level(logging.WARNING, "zstate"), StatePublisher(sessions[0], ARM, "r1") as publisher:
        publisher.publish({"lift": -3.5}, stamp=STAMP)
        assert publisher.stats.outside_limits == 1
    (record,) = caplog.records
    assert "'lift' at -3.5 rad is outside -2 to 2; further" in record.getMessage()


class ActingHandler(logging.Handler):
    """Does something with a publisher at its first record, as handlers that report to the network do."""

    def __init__(self, action) -> None:
        super().__init__(logging.WARNING)
        self._action = action

    def emit(self, record: logging.LogRecord) -> None:
        action, self._action = self._action, lambda: None
        action()


@pytest.mark.parametrize("is_partial", [False, True])
@pytest.mark.parametrize("closes", [False, True])
def test_handler_of_the_warning_about_limits_may_publish_or_close(sessions, is_partial, closes):
    """Also from another thread that it waits for."""
    opened = PartialStatePublisher(sessions[0], ARM, ["lift"], "r1") if is_partial else None
    with opened or StatePublisher(sessions[0], ARM, "r1") as publisher:

        def act() -> None:
            action = publisher.close if closes else partial(publisher.publish, [2.5], stamp=STAMP + 1)
            other = threading.Thread(target=action, daemon=True)
            other.start()
            other.join(DEADLINE_S)
            assert not other.is_alive()
            done.set()

        handler, done = ActingHandler(act), threading.Event()
        logging.getLogger("zstate").addHandler(handler)
        try:
            threading.Thread(target=lambda: publisher.publish([2.5], stamp=STAMP), daemon=True).start()
            assert done.wait(2.0 * DEADLINE_S)
        finally:
            logging.getLogger("zstate").removeHandler(handler)
        until(lambda: publisher.stats.outside_limits == (1 if closes else 2))


def test_stats_name_the_engine_of_transforms_and_nothing_without_the_stream(sessions):
    with StatePublisher(sessions[0], RRBOT, "r1") as publisher:
        assert publisher.stats.kinematics == select_engine().name
    with StatePublisher(sessions[0], RRBOT, "r1", streams=["joint_states"]) as publisher:
        assert publisher.stats.kinematics == ""


def test_without_pinocchio_closed_forms_serve_and_one_warning_names_what_mends_it(
    sessions, monkeypatch, caplog
):
    monkeypatch.setitem(sys.modules, "pinocchio", None)
    moving_edges._warn_of_closed_forms.cache_clear()
    writer, reader = sessions
    transforms = SampleCollector(reader, TF)
    with caplog.at_level(logging.WARNING, "zstate"):
        for robot in ("r1", "r2"):
            with StatePublisher(writer, RRBOT, robot) as publisher:
                assert publisher.stats.kinematics == "closed forms"
                if robot == "r1":
                    wait_for_reader(writer, TF)
                    publisher.publish([0.25, -0.5])
    (record,) = [one for one in caplog.records if "closed forms" in one.message]
    assert "`pip install pin`" in record.message
    moves = [joint.type != "fixed" for joint in RRBOT.joints]
    sample = decode(transforms.payloads(1)[0], encoding_of(TransformSample), TransformSample)
    expected = Kinematics(RRBOT).edge_poses([0.25, -0.5])[moves]
    assert poses_from_block(sample.poses).tolist() == expected.tolist()
    moving_edges._warn_of_closed_forms.cache_clear()


WITHOUT_TRANSFORMS = """
import sys
from zstate import StatePublisher, connect, load_model
with connect() as session:
    with StatePublisher(session, load_model("rrbot"), streams=["joint_states"]) as publisher:
        publisher.publish([0.0, 0.0])
        print("pinocchio" in sys.modules)
    with StatePublisher(session, load_model("rrbot")):
        print("pinocchio" in sys.modules)
"""


def test_pinocchio_is_loaded_when_a_publisher_of_transforms_opens():
    command = [sys.executable, "-c", WITHOUT_TRANSFORMS]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stdout.split() == ["False", "True"]
